"""Writes two made-up logs of 123D and what they show.

Run in this folder, with py123d from PyPI (0.7.0 with pyarrow 26.0.1 was used), which writes the logs.

made_up_val/curve: four moments. Two LiDARs in one merged table, compressed within the points (`ipc_zstd`); a batch for
each row. The second moment has no cloud, the third one no boxes.
made_up_val/still: two moments. One LiDAR, points uncompressed (`ipc`), tables compressed with LZ4; no intensity,
no channel.
made_up_path/paths: one moment. The table of points has the path of a file.
expected.json: points (x, y, z, intensity, channel with 256 for each sensor before, time in s), pose and boxes of each
frame, computed with matrices in numpy. The LiDAR frame has the axes of the IMU and its origin in the upper LiDAR.
"""

import json
import shutil

import numpy as np
from py123d.api.scene.arrow.arrow_log_writer import ArrowLogWriter
from py123d.api.scene.arrow.utils.log_writer_config import LogWriterConfig
from py123d.datatypes.detections.box_detections import BoxDetectionAttributes, BoxDetectionSE3, BoxDetectionsSE3
from py123d.datatypes.detections.box_detections_metadata import BoxDetectionsSE3Metadata
from py123d.datatypes.metadata.log_metadata import LogMetadata
from py123d.datatypes.sensors.lidar import Lidar, LidarID, LidarMergedMetadata, LidarMetadata
from py123d.datatypes.time.timestamp import Timestamp
from py123d.datatypes.vehicle_state.dynamic_state import DynamicStateSE3
from py123d.datatypes.vehicle_state.ego_state import EgoStateSE3
from py123d.datatypes.vehicle_state.ego_state_metadata import EgoStateSE3Metadata
from py123d.geometry import BoundingBoxSE3, PoseSE3, Vector3D
from py123d.parser.base_dataset_parser import ModalitiesSync, ParsedLidar
from py123d.parser.registry import AV2SensorBoxDetectionLabel, NuScenesBoxDetectionLabel

SPLIT = "made_up_val"
START_US = 1_550_083_467_346_370
random = np.random.default_rng(11)


def quaternion(roll, pitch, yaw):
    """w x y z of a turn by yaw about z, then pitch about the new y, then roll about the new x."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(np.array([roll, pitch, yaw]) / 2), np.sin(np.array([roll, pitch, yaw]) / 2)
    return np.array(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def matrix(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def pose(position, q):
    return PoseSE3(*map(float, position), *map(float, q))


TOP_PLACE = np.array([0.9, 0.05, 1.8])
TOP = LidarMetadata("up", LidarID.LIDAR_TOP, pose(TOP_PLACE, quaternion(0.01, 0.0, 0.5)))
FRONT = LidarMetadata("front", LidarID.LIDAR_FRONT, pose([3.7, 0.0, 0.6], quaternion(0.0, 0.1, 0.0)))
EGO = EgoStateSE3Metadata("made up", 1.9, 4.8, 1.6, 2.9, pose([1.4, 0, 0.4], [1, 0, 0, 0]), pose([0, 0, 0], [1, 0, 0, 0]))
CURVE_CLASSES, STILL_CLASSES = map(BoxDetectionsSE3Metadata, [NuScenesBoxDetectionLabel, AV2SensorBoxDetectionLabel])
LABEL = {CURVE_CLASSES: NuScenesBoxDetectionLabel.VEHICLE_CAR, STILL_CLASSES: AV2SensorBoxDetectionLabel.REGULAR_VEHICLE}


def cloud(stamp_us, sensors, whole):
    """A table of points in the frame of the IMU, and what is expected of them."""
    count = 40
    xyz = np.stack([random.uniform(-40, 40, count), random.uniform(-40, 40, count), random.uniform(-1, 3, count)], axis=1)
    xyz = xyz.astype(np.float32)
    ids = np.sort(random.choice([int(s.lidar_id) for s in sensors], count)).astype(np.uint8)
    times = stamp_us + np.sort(random.integers(0, 100_000, count)).astype(np.int64)
    features = {"ids": ids, "timestamps": times}
    intensity, channel = np.zeros(count), None
    if whole:
        features["intensity"] = random.integers(0, 256, count).astype(np.uint8)
        features["channel"] = random.integers(0, 32, count).astype(np.uint8)
        intensity = features["intensity"] / 255
        channel = [int(c) + 256 * (int(i) == int(LidarID.LIDAR_FRONT)) for c, i in zip(features["channel"], ids)]
    points = [
        [*(xyz[i].astype(float) - TOP_PLACE), intensity[i], channel[i] if channel else -1, (times[i] - stamp_us) * 1e-6]
        for i in range(count)
    ]
    return xyz, features, [[round(float(v), 6) for v in point] for point in points]


def write_log(name, count, codec, compression, sensors, classes, whole, batch_bytes):
    writer = ArrowLogWriter(
        LogWriterConfig(
            force_log_conversion=True,
            lidar_store_option="binary",
            lidar_codec=codec,
            ipc_max_batch_bytes=batch_bytes,
        ),
        logs_root=".",
        sensors_root=".",
        ipc_compression=compression,
    )
    writer.reset(LogMetadata("made-up", SPLIT, name, "nowhere"))
    frames = []
    for moment in range(count):
        seconds = 0.1 * moment
        stamp_us = START_US + 100_000 * moment
        stamp = Timestamp.from_us(stamp_us)
        position = np.array([480 + 12 * seconds, -310 + 5 * seconds, 11 + 0.4 * seconds])
        turned = quaternion(0.01, -0.02, 0.4 + 0.3 * seconds)
        rotation = matrix(turned)
        modalities = [EgoStateSE3.from_imu(pose(position, turned), EGO, stamp, DynamicStateSE3.from_list([0.0] * 9))]
        boxes, seen = [], []
        for track, x in [("a-1", 20.0), ("17", -7.5)]:
            center, yaw, size = np.array([x + moment, 3.0, 0.9]), 0.2 * moment, [4.5, 2.0, 1.7]
            # The box in the world: turned about the vertical axis of the IMU.
            whole_turn = rotation @ matrix(quaternion(0, 0, yaw))
            q = np.array(quaternion_of(whole_turn))
            box = BoundingBoxSE3(pose(position + rotation @ center, q), *size)
            attributes = BoxDetectionAttributes(LABEL[classes], track, 5)
            boxes.append(BoxDetectionSE3(attributes, box, Vector3D(0.0, 0.0, 0.0)))
            seen.append([track, LABEL[classes].name, [round(float(v), 6) for v in [*(center - TOP_PLACE), *size, yaw]]])
        if moment == 2:
            seen = []
        else:
            modalities.append(BoxDetectionsSE3(boxes, stamp, classes))
        if moment != 1 or name == "still":
            xyz, features, points = cloud(stamp_us, sensors, whole)
            merged = LidarMergedMetadata({s.lidar_id: s for s in sensors})
            modalities.append(Lidar(stamp, Timestamp.from_us(stamp_us + 100_000), merged, xyz, features))
            place = position + rotation @ TOP_PLACE
            frames.append(
                {
                    "id": f"{name}_{stamp_us}",
                    "points": points,
                    "boxes": seen,
                    "place": [round(float(v), 6) for v in place],
                    "rotation": rotation.tolist(),
                }
            )
        writer.write_sync(ModalitiesSync(stamp, modalities))
    writer.close()
    return frames


def quaternion_of(rotation):
    w = np.sqrt(max(0.0, 1 + np.trace(rotation))) / 2
    x = (rotation[2, 1] - rotation[1, 2]) / (4 * w)
    y = (rotation[0, 2] - rotation[2, 0]) / (4 * w)
    z = (rotation[1, 0] - rotation[0, 1]) / (4 * w)
    return w, x, y, z


def write_paths():
    writer = ArrowLogWriter(LogWriterConfig(force_log_conversion=True), logs_root=".", sensors_root=".")
    writer.reset(LogMetadata("made-up", "made_up_path", "paths", "nowhere"))
    stamp = Timestamp.from_us(START_US)
    merged = LidarMergedMetadata({TOP.lidar_id: TOP})
    writer.write_sync(ModalitiesSync(stamp, [ParsedLidar(merged, stamp, stamp, ".", "sweeps/1.bin")]))
    writer.close()


for split in [SPLIT, "made_up_path"]:
    shutil.rmtree(split, ignore_errors=True)
frames = write_log("curve", 4, "ipc_zstd", None, [TOP, FRONT], CURVE_CLASSES, True, 1)
frames += write_log("still", 2, "ipc", "lz4", [TOP], STILL_CLASSES, False, None)
write_paths()
with open("expected.json", "w") as file:
    file.write("[\n" + ",\n".join(json.dumps(frame) for frame in frames) + "\n]\n")
