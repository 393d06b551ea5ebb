"""The rays that `race_rays` wrote, cast by Embree through Open3D: speed on one and two threads, and how far it agrees."""

import sys
import time
from pathlib import Path

import numpy as np
import open3d as o3d

FRAMES, ROUNDS = 20, 10
folder = Path(sys.argv[1])
read = lambda name: np.fromfile(folder / name, np.float32)
tensor = o3d.core.Tensor

static = read("static.f32").reshape(-1, 3)
rays = [tensor(read(f"rays_{i:02}.f32").reshape(-1, 6)) for i in range(FRAMES)]
count = sum(r.shape[0] for r in rays)

line = "Embree (Open3D):"
for threads in (1, 2):
    scenes = []
    for i in range(FRAMES):
        vertices = np.concatenate([static, read(f"cars_{i:02}.f32").reshape(-1, 3)])
        triangles = np.arange(len(vertices), dtype=np.uint32).reshape(-1, 3)
        scene = o3d.t.geometry.RaycastingScene(nthreads=threads)
        scene.add_triangles(tensor(vertices), tensor(triangles))
        scene.cast_rays(rays[i][:4096], nthreads=threads)  # builds the tree
        scenes.append(scene)
    best = 1e9
    for run in range(4):
        start = time.perf_counter()
        for scene, frame in zip(scenes, rays):
            for _ in range(ROUNDS):
                scene.cast_rays(frame, nthreads=threads)
        if run:
            best = min(best, time.perf_counter() - start)
    line += f" {count * ROUNDS / best / 1e6:.1f} Mrays/s on {threads} threads"
print(line, flush=True)

differs, far = 0, 0.0
for i, (scene, frame) in enumerate(zip(scenes, rays)):
    theirs, ours = scene.cast_rays(frame)["t_hit"].numpy(), read(f"hits_{i:02}.f32")
    both = np.isfinite(theirs) & np.isfinite(ours)
    differs += int(np.sum(np.isfinite(theirs) != np.isfinite(ours)))
    off = np.abs(theirs - ours)[both]
    differs += int(np.sum(off > 0.01))
    far = max(far, float(off[off <= 0.01].max()))
print(f"{differs} of {count} rays differ by more than 1 cm or in whether they hit; the others by at most {far * 1e3:.2f} mm", flush=True)
