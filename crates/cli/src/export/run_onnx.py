#!/usr/bin/env python3
"""Runs pillar_net.onnx and backbone_head.onnx on a cloud, or compares them with check.safetensors.

    python run_onnx.py CLOUD.bin
    python run_onnx.py --check

Needs numpy and onnxruntime. A cloud is little-endian float32, N x 4 (or N x 3 for a detector of 3 channels): x forward,
y left, z up (m), intensity. Suppression and the decoding of boxes are not part of the graphs.
"""

import json
import pathlib
import sys

import numpy as np
import onnxruntime

FOLDER = pathlib.Path(__file__).resolve().parent
DETECTOR = json.loads((FOLDER / "detector.json").read_text())


def session(name):
    return onnxruntime.InferenceSession(str(FOLDER / name), providers=["CPUExecutionProvider"])


def pillars(points):
    """Decorated points of each pillar (P x points x features), and cells y and x of each pillar (P x 2)."""
    low, high = np.float32(DETECTOR["range_m"][:3]), np.float32(DETECTOR["range_m"][3:])
    size, grid = np.float32(DETECTOR["pillar_size_m"]), np.array(DETECTOR["grid_size"])
    place = (points[:, :3] - low) / size
    points = points[((place >= 0) & (place < grid.astype(np.float32))).all(axis=1)]
    cells = ((points[:, :3] - low) / size).astype(np.int64)
    flat = (cells[:, 2] * grid[1] + cells[:, 1]) * grid[0] + cells[:, 0]
    _, first, pillar = np.unique(flat, return_index=True, return_inverse=True)
    # Pillars in the order of their first points; the first points of a pillar are kept.
    rank = np.argsort(np.argsort(first))
    pillar, order = rank[pillar], np.sort(first)
    kept = min(len(order), DETECTOR["max_pillars"])
    coords = cells[order[:kept]]
    features = np.zeros((kept, DETECTOR["max_points"], points.shape[1] + 6), np.float32)
    count = np.zeros(kept, np.int64)
    for point, p in zip(points, pillar):
        if p < kept and count[p] < DETECTOR["max_points"]:
            features[p, count[p], : points.shape[1]] = point
            count[p] += 1
    filled = np.arange(DETECTOR["max_points"]) < count[:, None]
    xyz, width = features[:, :, :3], points.shape[1]
    mean = xyz.sum(axis=1) / count[:, None].astype(np.float32)
    center = coords.astype(np.float32) * size + (size / 2 + low)
    features[:, :, width : width + 3] = np.where(filled[:, :, None], xyz - mean[:, None], 0)
    features[:, :, width + 3 :] = np.where(filled[:, :, None], xyz - center[:, None], 0)
    return features, coords[:, [1, 0]]


def run(features, coords):
    """Outputs of the head by name."""
    nx, ny, _ = DETECTOR["grid_size"]
    (found,) = session("pillar_net.onnx").run(None, {"features": features})
    canvas = np.zeros((1, found.shape[1], ny, nx), np.float32)
    canvas[0, :, coords[:, 0], coords[:, 1]] = found
    head = session("backbone_head.onnx")
    names = [output.name for output in head.get_outputs()]
    outputs = dict(zip(names, head.run(names, {"spatial_features": canvas})))
    return {"pillar_features": found, "spatial_features": canvas, **outputs}


def read_safetensors(path):
    data = path.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header, body = json.loads(data[8 : 8 + length]), data[8 + length :]
    types = {"F32": np.float32, "I64": np.int64}
    tensors = {}
    for name, entry in header.items():
        if name != "__metadata__":
            begin, end = entry["data_offsets"]
            tensors[name] = np.frombuffer(body[begin:end], types[entry["dtype"]]).reshape(entry["shape"])
    return tensors


def check():
    """Compares the graphs with what lidarshift computed; prints the largest difference of each output."""
    wanted = read_safetensors(FOLDER / "check.safetensors")
    outputs, largest = run(wanted["features"], wanted["coords"]), 0.0
    for name, value in outputs.items():
        if value.shape != wanted[name].shape:
            sys.exit(f"{name}: {value.shape}, not {wanted[name].shape}")
        apart = float(np.abs(value - wanted[name]).max())
        largest = max(largest, apart)
        print(f"{name} {apart:.3g}")
    print(f"largest {largest:.3g}")
    return 0 if largest <= 1e-4 else 1


def main():
    if sys.argv[1:] == ["--check"]:
        return check()
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    if DETECTOR["ground"]:
        sys.exit("this detector counts heights from the ground: subtract the height of the ground first")
    points = np.fromfile(sys.argv[1], "<f4").reshape(-1, 4)[:, : DETECTOR["channels"]]
    outputs = run(*pillars(points))
    for name, value in outputs.items():
        print(f"{name} {value.shape}")
    scores = outputs["cls"][0] if "cls" in outputs else outputs["hm_0"][0].reshape(outputs["hm_0"].shape[1], -1).T
    best = 1 / (1 + np.exp(-scores.max()))
    print(f"best score {best:.3f}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
