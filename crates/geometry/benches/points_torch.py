"""Sampling, ball query and three nearest neighbours in plain PyTorch on two threads: medians, and the indices for comparison.

Called by the benchmark `points` with the folder of `points.f32`.
"""

import pathlib
import statistics
import sys
import time

import torch

CENTERS, RADIUS_M, SAMPLES = 4096, 0.5, 32


def farthest(points):
    picks = torch.zeros(CENTERS, dtype=torch.int64)
    distance = torch.full((len(points),), float("inf"))
    last = points[0]
    for i in range(1, CENTERS):
        distance = torch.minimum(distance, ((points - last) ** 2).sum(1))
        picks[i] = torch.argmax(distance)
        last = points[picks[i]]
    return picks


def ball(points, centers):
    rows = []
    number = torch.arange(len(points))
    for part in centers.split(512):
        square = ((part[:, None] - points[None]) ** 2).sum(2)
        inside = torch.where(square < RADIUS_M**2, number, len(points))
        first = inside.topk(SAMPLES, dim=1, largest=False, sorted=True).values
        rows.append(torch.where(first == len(points), first[:, :1], first))
    return torch.cat(rows)


def three(points, centers):
    rows = [((part[:, None] - centers[None]) ** 2).sum(2).topk(3, dim=1, largest=False).indices for part in points.split(2048)]
    return torch.cat(rows)


def main():
    torch.set_num_threads(2)
    folder = pathlib.Path(sys.argv[1])
    points = torch.frombuffer(bytearray((folder / "points.f32").read_bytes()), dtype=torch.float32).reshape(-1, 3)
    centers = points[farthest(points)]
    for i, (name, work) in enumerate(
        [
            ("sampling", lambda: farthest(points)),
            ("ball query", lambda: ball(points, centers)),
            ("three nearest", lambda: three(points, centers)),
        ]
    ):
        times = []
        for _ in range(5):
            start = time.perf_counter()
            found = work()
            times.append(time.perf_counter() - start)
        (folder / f"{i}.i64").write_bytes(bytes(found.contiguous().flatten().untyped_storage()))
        print(f"{name}: PyTorch {1e3 * statistics.median(times):.1f} ms")


main()
