"""Makes two data sets with the same frame ids, and detections of another program on both: one as KITTI text, one as
result.pkl. For measurements of time and memory.

    python3 tests/golden/results/make_many.py FOLDER [FRAMES] [BOXES]

Default: 20000 frames with 50 detections each, a million on each data set. Writes measured/ and sim/ (KITTI's layout,
labels in the LiDAR frame, clouds of eight points), dets/measured/*.txt, dets/sim/result.pkl and many.toml.
"""

import pathlib
import pickle
import sys

import numpy as np

folder = pathlib.Path(sys.argv[1])
n_frames = int(sys.argv[2]) if len(sys.argv) > 2 else 20000
n_boxes = int(sys.argv[3]) if len(sys.argv) > 3 else 50
n_labels = 8
rng = np.random.default_rng(0)
ids = [f"{i:06}" for i in range(n_frames)]
cloud = np.zeros((8, 4), np.float32)
cloud[:, 0] = np.arange(1, 9)

for name in ("measured", "sim"):
    for part in ("velodyne", "label_2", "ImageSets"):
        (folder / name / part).mkdir(parents=True, exist_ok=True)
    (folder / name / "ImageSets/test.txt").write_text("\n".join(ids) + "\n")
    (folder / name / "dataset.toml").write_text('layout = "kitti"\nlabel_frame = "lidar"\nclasses = ["Car"]\n'
                                                '[splits]\ntest = "ImageSets/test.txt"\n')
(folder / "dets/measured").mkdir(parents=True, exist_ok=True)
(folder / "dets/sim").mkdir(parents=True, exist_ok=True)

frames = []
for frame in ids:
    place = np.stack([rng.uniform(5, 95, n_labels), rng.uniform(-30, 30, n_labels), rng.uniform(-1, 0, n_labels)], 1)
    truth = np.concatenate([place, np.tile([4.2, 1.8, 1.5], (n_labels, 1)), rng.uniform(-3, 3, (n_labels, 1))], 1)
    text = "".join(f"Car 0 0 -10 0 0 50 50 {h} {w} {l} {x:.3f} {y:.3f} {z:.3f} {yaw:.3f}\n"
                   for x, y, z, l, w, h, yaw in truth)
    for name in ("measured", "sim"):
        (folder / name / f"label_2/{frame}.txt").write_text(text)
        (folder / name / f"velodyne/{frame}.bin").write_bytes(cloud.tobytes())
    for name, noise in (("measured", 0.1), ("sim", 0.2)):
        hits = truth + rng.normal(0, 1, truth.shape) * [noise, noise, noise, 0.1, 0.05, 0.05, 0.03]
        n_alarms = n_boxes - n_labels
        alarms = np.stack([rng.uniform(0, 100, n_alarms), rng.uniform(-40, 40, n_alarms), rng.uniform(-1, 0, n_alarms),
                           *(np.full(n_alarms, v) for v in (4.2, 1.8, 1.5)), rng.uniform(-3, 3, n_alarms)], 1)
        boxes = np.concatenate([hits, alarms]).astype(np.float32)
        scores = np.concatenate([rng.uniform(0.3, 1, n_labels), rng.uniform(0.05, 0.5, n_alarms)]).astype(np.float32)
        if name == "measured":
            lines = (f"Car -1 -1 -10 0 0 50 50 {h:.4f} {w:.4f} {l:.4f} {x:.4f} {y:.4f} {z:.4f} {yaw:.4f} {score:.4f}\n"
                     for (x, y, z, l, w, h, yaw), score in zip(boxes.tolist(), scores.tolist()))
            (folder / f"dets/measured/{frame}.txt").write_text("".join(lines))
        else:
            zeros = np.zeros(n_boxes)
            frames.append({
                "name": np.array(["Car", "Pedestrian", "Cyclist"])[np.zeros(n_boxes, int)], "truncated": zeros,
                "occluded": zeros, "alpha": zeros.astype(np.float32), "bbox": np.zeros((n_boxes, 4), np.float32),
                "dimensions": boxes[:, 3:6], "location": boxes[:, :3], "rotation_y": boxes[:, 6], "score": scores,
                "boxes_lidar": boxes, "frame_id": frame})
with open(folder / "dets/sim/result.pkl", "wb") as file:
    pickle.dump(frames, file)
(folder / "many.toml").write_text('''name = "many"
about = ["Made-up detections of another program."]
[[dataset]]
name = "measured"
source = { path = "measured" }
[[dataset]]
name = "sim"
source = { path = "sim" }
[[frozen]]
name = "other"
detections = { measured = "dets/measured", sim = "dets/sim/result.pkl" }
[evaluation]
distance_frames = 5
''')
