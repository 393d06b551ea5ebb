"""Writes the recordings of this folder with sqlite3, struct and nothing of lidarshift. Run in this folder.

plain.mcap, zstd.mcap: the whole recording in chunks of 600 bytes, with a metadata record and an attachment, written by
the package mcap from PyPI (1.6.0 was used).
drive_0.db3, drive_1.db3: one recording of rosbag2 in two files, the tables of version 3 of its schema.
compressed.db3: the same messages, each compressed with the program zstd (compression_mode MESSAGE).
"""

import os
import sqlite3
import struct
import subprocess

from mcap.writer import CompressionType, Writer

START_NS = 1_700_000_000_000_000_000


class Cdr:
    """Little-endian CDR: values are aligned to their size, counted from behind the encapsulation."""

    def __init__(self):
        self.bytes = b""

    def put(self, form, *values):
        for value in values:
            size = struct.calcsize("<" + form)
            self.bytes += b"\0" * (-len(self.bytes) % size) + struct.pack("<" + form, value)
        return self

    def text(self, text):
        self.put("I", len(text) + 1)
        self.bytes += text.encode() + b"\0"
        return self

    def header(self, stamp_ns, frame):
        return self.put("I", stamp_ns // 10**9, stamp_ns % 10**9).text(frame)

    def message(self):
        return b"\0\1\0\0" + self.bytes


def cloud(stamp_ns, first_x):
    """Three points with x, y, z, intensity (float32), ring (uint16), time (float32), 22 bytes each."""
    fields = [("x", 0, 7), ("y", 4, 7), ("z", 8, 7), ("intensity", 12, 7), ("ring", 16, 4), ("time", 18, 7)]
    points = [(first_x, 1.5, 0.5, 10, 0, -0.05), (2, 2.5, 0.25, 20, 1, 0), (float("nan"), 0, 0, 0, 2, 0), (4, 4.5, -1, 255, 63, 0.05)]
    data = b"".join(struct.pack("<ffffHf", *point) for point in points)
    cdr = Cdr().header(stamp_ns, "lidar").put("I", 1, len(points), len(fields))
    for name, offset, kind in fields:
        cdr.text(name).put("I", offset).put("B", kind).put("I", 1)
    cdr.put("B", 0).put("I", 22, 22 * len(points), len(data))
    cdr.bytes += data
    return cdr.put("B", 1).message()


def tf(stamp_ns, parent, child, x):
    return Cdr().put("I", 1).header(stamp_ns, parent).text(child).put("d", x, 0, 2, 0, 0, 0, 1).message()


TOPICS = [
    (1, "/points", "sensor_msgs/msg/PointCloud2"),
    (2, "/tf", "tf2_msgs/msg/TFMessage"),
    (3, "/rosout", "rcl_interfaces/msg/Log"),
]


def write(name, messages):
    if os.path.exists(name):
        os.remove(name)
    base = sqlite3.connect(name)
    base.execute("PRAGMA page_size = 512")
    base.executescript(
        """
        CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
        CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL, metadata TEXT NOT NULL);
        CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
            serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);
        CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER NOT NULL,
            data BLOB NOT NULL);
        CREATE INDEX timestamp_idx ON messages (timestamp ASC);
        INSERT INTO schema VALUES (3, 'humble');
        """
    )
    base.executemany("INSERT INTO topics VALUES (?, ?, ?, 'cdr', '')", TOPICS)
    base.executemany("INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)", messages)
    base.commit()
    base.close()


def part(first, count):
    """Clouds every 0.1 s, poses every 0.05 s: the car drives with 10 m/s, the cloud is logged 7 ns after its stamp."""
    messages = []
    for i in range(first, first + count):
        stamp = START_NS + i * 10**8
        messages.append((1, stamp + 7, cloud(stamp, 1 + i)))
        messages += [(2, at, tf(at, "map", "lidar", (at - START_NS) * 1e-8)) for at in (stamp, stamp + 5 * 10**7)]
        messages.append((3, stamp, b"\0\1\0\0a log"))
    # Messages are not written in the order of their times.
    return messages[::-1]


def compressed(data):
    return subprocess.run(["zstd", "-q", "-c"], input=data, stdout=subprocess.PIPE, check=True).stdout


write("drive_0.db3", part(0, 2))
write("drive_1.db3", part(2, 1))
write("compressed.db3", [(topic, at, compressed(data)) for topic, at, data in part(0, 3)])


def write_mcap(name, compression):
    with open(name, "wb") as file:
        writer = Writer(file, chunk_size=600, compression=compression)
        writer.start(profile="ros2", library="make.py")
        channels = {}
        for number, topic, kind in TOPICS:
            schema = writer.register_schema(name=kind, encoding="ros2msg", data=b"# left out")
            channels[number] = writer.register_channel(topic, "cdr", schema, metadata={"offered_qos_profiles": ""})
        writer.add_metadata("rosbag2", {"ROS_DISTRO": "humble"})
        writer.add_attachment(START_NS, START_NS, "notes.txt", "text/plain", b"made up")
        for topic, at, data in part(0, 3):
            writer.add_message(channels[topic], at, data, at)
        writer.finish()


write_mcap("plain.mcap", CompressionType.NONE)
write_mcap("zstd.mcap", CompressionType.ZSTD)
