"""Writes a made-up segment of the Waymo Open Dataset (version 2) and the points that it shows.

Run in this folder, with numpy and pyarrow from PyPI (26.0.1 was used). Nothing of lidarshift or of Waymo's code is
used.

lidar/, lidar_calibration/, lidar_pose/, vehicle_pose/, lidar_box/: the components, with the column names and types of
Waymo's schema. Three frames; the upper LiDAR (8 x 32, a pose for each pixel, given inclinations) and one at the front
(4 x 16, uniform inclinations). Row groups of two rows, so that frames cross them.
expected.json: points (x, y, z, intensity, row), pose and boxes of each frame, computed with matrices in numpy. The
LiDAR frame has the axes of the vehicle and its origin in the upper LiDAR.
"""

import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

SEGMENT = "made_up_0000_000_0020_000"
STAMPS = [1_550_083_467_346_370 + 99_990 * i for i in range(3)]
random = np.random.default_rng(7)


def matrix(roll, pitch, yaw, x, y, z):
    """4x4: first turned by roll about x, then by pitch about y, then by yaw about z, then moved."""
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    whole = np.eye(4)
    whole[:3, :3] = about_z @ about_y @ about_x
    whole[:3, 3] = [x, y, z]
    return whole


def vehicle_at(seconds):
    """Roll, pitch, yaw, x, y, z of the vehicle in the world: a curve with 12 m/s."""
    yaw = 0.4 + 0.3 * seconds
    return np.array([0.01, -0.02, yaw, 480 + 12 * seconds, -310 + 5 * seconds, 11 + 0.4 * seconds])


# Extrinsic calibration, inclinations (ascending) or their range, size of the image, time of a turn.
TOP, FRONT = 1, 2
EXTRINSIC = {TOP: matrix(0.004, -0.006, 2.58, 1.43, 0.02, 2.184), FRONT: matrix(0.0, 0.01, -0.03, 4.07, 0.1, 0.69)}
EACH = {TOP: np.array([-0.31, -0.24, -0.18, -0.12, -0.07, -0.03, 0.01, 0.04]), FRONT: None}
RANGE = {TOP: (-0.31, 0.04), FRONT: (-1.5707, 0.5236)}
SIZE = {TOP: (8, 32), FRONT: (4, 16)}


def points_of(laser, image, pixel_poses, vehicle):
    """Points (x, y, z in the frame of the vehicle, intensity, row) of a range image."""
    height, width = SIZE[laser]
    if EACH[laser] is None:
        low, high = RANGE[laser]
        inclinations = np.array([low + (i + 0.5) / height * (high - low) for i in range(height)])
    else:
        inclinations = EACH[laser]
    inclinations = np.flip(inclinations)
    turned = np.arctan2(EXTRINSIC[laser][1, 0], EXTRINSIC[laser][0, 0])
    found = []
    for row in range(height):
        for column in range(width):
            distance, intensity = image[row, column, :2].astype(float)
            if distance <= 0:
                continue
            azimuth = ((width - column - 0.5) / width * 2 - 1) * np.pi - turned
            ray = [
                np.cos(inclinations[row]) * np.cos(azimuth),
                np.cos(inclinations[row]) * np.sin(azimuth),
                np.sin(inclinations[row]),
            ]
            point = EXTRINSIC[laser] @ np.append(distance * np.array(ray), 1)
            if pixel_poses is not None:
                point = np.linalg.inv(vehicle) @ matrix(*pixel_poses[row, column].astype(float)) @ point
            found.append([*point[:3], intensity, row])
    return found


def image_of(laser):
    """Range, intensity, elongation, zone without labels; some pixels have no return."""
    height, width = SIZE[laser]
    image = np.empty((height, width, 4), np.float32)
    image[..., 0] = random.uniform(2, 60, (height, width))
    image[..., 1] = random.exponential(0.3, (height, width))
    image[..., 2] = random.uniform(0, 1, (height, width))
    image[..., 3] = random.choice([-1, 1], (height, width))
    image[random.uniform(size=(height, width)) < 0.2] = -1
    image[0, 3, 0] = 0
    return image


rows = {name: [] for name in ["lidar", "lidar_calibration", "lidar_pose", "vehicle_pose", "lidar_box"]}
expected = []
for laser in [TOP, FRONT]:
    low, high = RANGE[laser]
    rows["lidar_calibration"].append((SEGMENT, laser, EXTRINSIC[laser].ravel(), low, high, EACH[laser]))
for frame, stamp in enumerate(STAMPS):
    begin = (stamp - STAMPS[0]) * 1e-6
    vehicle = matrix(*vehicle_at(begin))
    rows["vehicle_pose"].append((SEGMENT, stamp, vehicle.ravel()))
    origin = EXTRINSIC[TOP][:3, 3]
    points = []
    # The first frame has the sensors in another order; the last one has no sensor at the front.
    lasers = [[FRONT, TOP], [TOP, FRONT], [TOP]][frame]
    images = {laser: image_of(laser) for laser in lasers}
    for laser in lasers:
        image = images[laser]
        rows["lidar"].append((SEGMENT, stamp, laser, image.ravel(), image.shape, image.ravel(), image.shape))
    for laser in sorted(lasers):
        poses = None
        if laser == TOP:
            height, width = SIZE[TOP]
            times = begin + 0.1 * (np.arange(width) / width - 0.5)
            poses = np.tile(np.array([vehicle_at(t) for t in times], np.float32), (height, 1, 1))
            rows["lidar_pose"].append((SEGMENT, stamp, laser, poses.ravel(), poses.shape))
        first = 0 if laser == TOP else SIZE[TOP][0]
        for *xyz, intensity, row in points_of(laser, images[laser], poses, vehicle):
            points.append([*np.round(xyz - origin, 5), round(intensity, 6), first + row])
    boxes = []
    objects = [("a-1", 1, "Vehicle", 20.0), ("b-2", 2, "Pedestrian", -7.5), ("c", 4, "Cyclist", 9.0)]
    for track, kind, class_name, x in objects:
        if track == "c" and frame == 0:
            continue
        box = [x + frame, 3.0, 0.9, 4.5, 2.0, 1.7, 0.2 * frame]
        rows["lidar_box"].append((SEGMENT, stamp, track, *box, kind))
        boxes.append([track, class_name, [*np.round([*(np.array(box[:3]) - origin), *box[3:]], 6)]])
    place = (vehicle @ np.append(origin, 1))[:3]
    rotation = vehicle[:3, :3].tolist()
    frame = {"stamp_us": stamp, "points": points, "boxes": boxes, "place": [*np.round(place, 6)], "rotation": rotation}
    expected.append(frame)

KEYS = [("key.segment_context_name", pa.string()), ("key.frame_timestamp_micros", pa.int64())]
LASER = ("key.laser_name", pa.int8())
reals, triple, pose = pa.list_(pa.float32()), pa.list_(pa.int32(), 3), pa.list_(pa.float64(), 16)


def image_columns(component, number):
    name = f"[{component}].range_image_return{number}"
    return [(f"{name}.values", reals), (f"{name}.shape", triple)]


box_columns = ["box.center.x", "box.center.y", "box.center.z", "box.size.x", "box.size.y", "box.size.z", "box.heading"]
inclination = "[LiDARCalibrationComponent].beam_inclination"
COLUMNS = {
    "lidar": [*KEYS, LASER, *image_columns("LiDARComponent", 1), *image_columns("LiDARComponent", 2)],
    "lidar_calibration": [
        KEYS[0],
        LASER,
        ("[LiDARCalibrationComponent].extrinsic.transform", pose),
        (f"{inclination}.min", pa.float64()),
        (f"{inclination}.max", pa.float64()),
        (f"{inclination}.values", pa.list_(pa.float64())),
    ],
    "lidar_pose": [*KEYS, LASER, *image_columns("LiDARPoseComponent", 1)],
    "vehicle_pose": [*KEYS, ("[VehiclePoseComponent].world_from_vehicle.transform", pose)],
    "lidar_box": [
        *KEYS,
        ("key.laser_object_id", pa.string()),
        *[(f"[LiDARBoxComponent].{name}", pa.float64()) for name in box_columns],
        ("[LiDARBoxComponent].type", pa.int8()),
    ],
}
for name, columns in COLUMNS.items():
    os.makedirs(name, exist_ok=True)
    schema = pa.schema([pa.field(column, kind) for column, kind in columns])
    values = [list(column) for column in zip(*rows[name])]
    table = pa.table([pa.array(v, field.type) for v, field in zip(values, schema)], schema=schema)
    compression = "zstd" if name == "lidar_pose" else "snappy"
    pq.write_table(table, f"{name}/{SEGMENT}.parquet", compression=compression, row_group_size=2)
with open("expected.json", "w") as file:
    file.write("[\n" + ",\n".join(json.dumps(frame) for frame in expected) + "\n]\n")
