"""Writes a data set of made-up frames in shards, detections on it as one Parquet file, and a study of them.

usage: make_shards.py FOLDER [FRAMES]        (default: a million frames; needs pyarrow)

A frame has nine points and one labelled car; a detection is near it, and every tenth frame has a false one. Writes
set/ (layout `shards`, 2 KiB a frame), detections.parquet, study.toml (those detections evaluated on the set) and
tiny.toml (a small PointPillars).
"""

import json
import random
import struct
import sys
from pathlib import Path

import pyarrow
import pyarrow.parquet

PER_SHARD = 10_000
TINY = """name = "tiny"
classes = ["Car"]
channels = 4
range_m = [0.0, -5.12, -3.0, 10.24, 5.12, 1.0]
[network]
kind = "pointpillars"
vfe_filters = 8
[network.pillars]
size_m = [0.32, 0.32, 4.0]
max_points = 8
max_train = 1000
max_test = 1000
[network.backbone]
layers = [0, 1]
strides = [2, 2]
filters = [8, 16]
upsample_strides = [1, 2]
upsample_filters = [8, 8]
[[network.anchors]]
class = "Car"
size_m = [3.9, 1.6, 1.56]
bottom_m = -1.78
matched = 0.6
unmatched = 0.45
[optimization]
batch_size = 2
"""
STUDY = """name = "million"
about = ["Made up."]
splits = { test = "val" }
[[dataset]]
name = "set"
source = { path = "set" }
[[frozen]]
name = "made_up"
detections = { set = "detections.parquet" }
[evaluation.matrix.bootstrap]
replicates = 100
"""


def member(name: str, content: bytes) -> bytes:
    """A file in a tar: its header (ustar) and its bytes, in blocks of 512 bytes."""
    head = bytearray(512)
    head[: len(name)] = name.encode()
    head[100:108] = b"0000644\0"
    head[108:124] = b"0000000\0" * 2
    head[124:136] = b"%011o\0" % len(content)
    head[136:148] = b"%011o\0" % 0
    head[148:156] = b" " * 8
    head[156:157] = b"0"
    head[257:265] = b"ustar\x0000"
    head[148:156] = b"%06o\0 " % sum(head)
    return bytes(head) + content + bytes(-len(content) % 512)


def main():
    folder, count = Path(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 1_000_000
    draw = random.Random(1)
    for name in ["set/shards", "set/ImageSets"]:
        (folder / name).mkdir(parents=True, exist_ok=True)
    columns = {name: [] for name in ["frame", "score", "x_m", "y_m"]}
    index = []
    for first in range(0, count, PER_SHARD):
        shard, frames = bytearray(), []
        for i in range(first, min(first + PER_SHARD, count)):
            frame = f"{i:07}"
            x, y = draw.uniform(3, 7), draw.uniform(-3, 3)
            points = [v for k in range(9) for v in (x + 0.3 * (k % 3) - 0.3, y + 0.3 * (k // 3) - 0.3, -1.2, 0.5)]
            cloud = struct.pack("<36f", *points)
            label = f"Car 0 0 0 0 0 0 0 1.5 1.6 3.9 {x:.3f} {y:.3f} -1 0.1\n".encode()
            begin = len(shard) + 512
            shard += member(f"{frame}.bin", cloud)
            frames.append([frame, [begin, len(cloud)], [len(shard) + 512, len(label)]])
            shard += member(f"{frame}.txt", label)
            for dx in [0.0] if i % 10 else [0.0, 20.0]:
                columns["frame"].append(frame)
                columns["score"].append(draw.random())
                columns["x_m"].append(x + dx + draw.gauss(0, 0.2))
                columns["y_m"].append(y + draw.gauss(0, 0.1))
        shard += bytes(1024)
        name = f"shard-{first // PER_SHARD:06}.tar"
        (folder / "set/shards" / name).write_bytes(shard)
        index.append(json.dumps({"shard": name, "bytes": len(shard), "frames": frames}))
    (folder / "set/shards/index.jsonl").write_text("\n".join(index) + "\n")
    (folder / "set/dataset.toml").write_text(
        'layout = "shards"\nname = "set"\nclasses = ["Car"]\nlabel_frame = "lidar"\n'
        '[splits]\ntrain = "ImageSets/all.txt"\nval = "ImageSets/all.txt"\n'
    )
    (folder / "set/ImageSets/all.txt").write_text("".join(f"{i:07}\n" for i in range(count)))
    rows = len(columns["frame"])
    same = {"class": ["Car"], "height_m": [1.5], "width_m": [1.6], "length_m": [3.9], "z_m": [-1.0]}
    same["rotation_y_rad"] = [0.1]
    table = pyarrow.table({**columns, **{name: value * rows for name, value in same.items()}})
    pyarrow.parquet.write_table(table, folder / "detections.parquet", compression="zstd")
    (folder / "study.toml").write_text(STUDY)
    (folder / "tiny.toml").write_text(TINY)


main()
