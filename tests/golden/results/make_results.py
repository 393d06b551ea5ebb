"""Writes result.pkl files as tools/test.py of OpenPCDet writes them, once for each protocol, and one with the less
usual forms of an array.

    pip install 'numpy<2' && python3 tests/golden/results/make_results.py numpy1
    pip install 'numpy>=2' && python3 tests/golden/results/make_results.py numpy2

NUMPY_protocolP.pkl: three frames "000000" (two cars and a pedestrian), "000001" (none), "000007" (one car).
numpy2_other_forms.pkl: names as objects and as a list, ids as numbers and numpy's texts, nine columns, Fortran's
order, half precision.
"""

import pathlib
import pickle
import sys

import numpy as np

HERE = pathlib.Path(__file__).parent
CLASSES = np.array(["Car", "Pedestrian", "Cyclist"])


def boxes(n, first):
    """Row k: x = first + 10 k, y = -1.5 k, z = -0.75, sizes 4, 1.75, 1.5, heading 0.25 k."""
    k = np.arange(n, dtype=np.float32)
    one = np.ones(n, np.float32)
    return np.stack([first + 10 * k, -1.5 * k, -0.75 * one, 4 * one, 1.75 * one, 1.5 * one, 0.25 * k], 1)


def scores(n):
    return (1 - np.arange(n, dtype=np.float32) / 4).astype(np.float32)


def annotation(frame_id, labels, first):
    """As get_template_prediction and generate_single_sample_dict of KittiDataset."""
    n = len(labels)
    found = {
        "name": np.zeros(n), "truncated": np.zeros(n), "occluded": np.zeros(n), "alpha": np.zeros(n),
        "bbox": np.zeros([n, 4]), "dimensions": np.zeros([n, 3]), "location": np.zeros([n, 3]),
        "rotation_y": np.zeros(n), "score": np.zeros(n), "boxes_lidar": np.zeros([n, 7]),
    }
    if n:
        found["name"] = CLASSES[np.array(labels) - 1]
        found["score"] = scores(n)
        found["boxes_lidar"] = boxes(n, first)
    return found | {"frame_id": frame_id}


def usual():
    return [annotation("000000", [1, 2, 1], 10), annotation("000001", [], 0), annotation("000007", [1], 20)]


def other_forms():
    nine = np.concatenate([boxes(2, 10), np.ones((2, 2), np.float32)], 1)
    return [
        {"frame_id": 5, "name": np.array(["Car", "Car"], dtype=object), "score": scores(2), "boxes_lidar": nine},
        {"frame_id": np.str_("000006"), "name": ["Car", "Car"], "score": [1.0, 0.75], "boxes_lidar": np.asfortranarray(boxes(2, 10))},
        {"frame_id": np.int64(7), "name": np.array([b"Car", b"Car"]), "score": scores(2).astype(np.float64),
         "boxes_lidar": boxes(2, 10).astype(np.float16)},
        {"frame_id": np.array("000008"), "name": np.array(["Car", "Car"]), "score": scores(2), "boxes_lidar": boxes(2, 10)[::-1][::-1]},
    ]


which = sys.argv[1]
for protocol in (2, 4, 5):
    (HERE / f"{which}_protocol{protocol}.pkl").write_bytes(pickle.dumps(usual(), protocol))
if which == "numpy2":
    (HERE / "numpy2_other_forms.pkl").write_bytes(pickle.dumps(other_forms(), 4))
