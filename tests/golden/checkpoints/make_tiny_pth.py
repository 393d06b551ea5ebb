"""Writes tiny_legacy.pth and tiny_zip.pth, byte for byte in the two forms of torch.save, without torch.

    python3 tests/golden/checkpoints/make_tiny_pth.py

Both hold {"epoch": 3, "model_state": {"a.weight": f32 [2, 3], "b.bias": f32 [2], "b.num_batches_tracked": i64 []}}.
"""

import collections
import io
import pathlib
import pickle
import struct
import sys
import types
import zipfile

torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")
FloatStorage = type("FloatStorage", (), {"__module__": "torch"})
LongStorage = type("LongStorage", (), {"__module__": "torch"})


def _rebuild_tensor_v2(*_):
    raise NotImplementedError


_rebuild_tensor_v2.__module__ = "torch._utils"
torch.FloatStorage, torch.LongStorage, torch._utils = FloatStorage, LongStorage, utils
utils._rebuild_tensor_v2 = _rebuild_tensor_v2
sys.modules.update({"torch": torch, "torch._utils": utils})


class Tensor:
    def __init__(self, key, storage, shape, data):
        self.key, self.storage, self.shape, self.data = key, storage, shape, data

    def __reduce__(self):
        stride, step = [], 1
        for extent in reversed(self.shape):
            stride.insert(0, step)
            step *= extent
        storage = types.SimpleNamespace(tensor=self)
        return _rebuild_tensor_v2, (storage, 0, self.shape, tuple(stride), False, collections.OrderedDict())


class Pickler(pickle.Pickler):
    def __init__(self, file, legacy):
        super().__init__(file, protocol=2)
        self.legacy = legacy

    def persistent_id(self, value):
        if not isinstance(value, types.SimpleNamespace):
            return None
        t = value.tensor
        length = len(t.data) // (4 if t.storage is FloatStorage else 8)
        return ("storage", t.storage, t.key, "cpu", length) + ((None,) if self.legacy else ())


TENSORS = [
    Tensor("0", FloatStorage, (2, 3), struct.pack("<6f", *[0.5, -1.0, 2.0, 3.5, 0.0, 1e-3])),
    Tensor("1", FloatStorage, (2,), struct.pack("<2f", 7.0, -7.0)),
    Tensor("2", LongStorage, (), struct.pack("<q", 12)),
]
STATE = collections.OrderedDict(zip(["a.weight", "b.bias", "b.num_batches_tracked"], TENSORS))
CHECKPOINT = {"epoch": 3, "model_state": STATE}


def pickled(value, legacy):
    out = io.BytesIO()
    Pickler(out, legacy).dump(value)
    return out.getvalue()


folder = pathlib.Path(__file__).parent
info = {"protocol_version": 1001, "little_endian": True, "type_sizes": {"short": 2, "int": 4, "long": 4}}
parts = [pickled(v, True) for v in (0x1950A86A20F9469CFC6C, 1001, info, CHECKPOINT, [t.key for t in TENSORS])]
for t in TENSORS:
    parts.append(struct.pack("<q", len(t.data) // (4 if t.storage is FloatStorage else 8)) + t.data)
(folder / "tiny_legacy.pth").write_bytes(b"".join(parts))

with zipfile.ZipFile(folder / "tiny_zip.pth", "w") as archive:
    members = [("data.pkl", pickled(CHECKPOINT, False)), ("byteorder", b"little")]
    members += [(f"data/{t.key}", t.data) for t in TENSORS] + [("version", b"3\n")]
    for name, data in members:
        archive.writestr(zipfile.ZipInfo(f"tiny/{name}"), data)
