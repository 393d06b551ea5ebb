"""Writes `events.out.tfevents` from `metrics.jsonl` with TensorBoard's own writer, and reads it with TensorBoard's own readers.

    pip install tensorboard && python make_events.py            # writes the golden file, then checks it
    python make_events.py FOLDER                                # shows what TensorBoard reads in a folder
"""

import json
import pathlib
import sys

from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.compat.proto.event_pb2 import Event
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

HERE = pathlib.Path(__file__).parent
WALL_TIME = 1_700_000_000.0


def scalars(tag, value):
    if isinstance(value, dict):
        for key, below in value.items():
            if key not in ("step", "epoch", "validation"):
                yield from scalars(f"{tag}/{key}", below)
    elif isinstance(value, (int, float)):
        yield tag, value


def of_line(line):
    if line["kind"] == "step":
        return list(scalars("train", line))
    return list(scalars("validation", line["validation"])) + list(scalars("epoch", line))


def read(folder):
    accumulator = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    accumulator.Reload()
    return {tag: [(e.step, e.value) for e in accumulator.Scalars(tag)] for tag in accumulator.Tags()["scalars"]}


if len(sys.argv) > 1:
    for tag, values in sorted(read(sys.argv[1]).items()):
        print(tag, len(values), values[:3])
    sys.exit()

lines = [json.loads(line) for line in (HERE / "metrics.jsonl").read_text().splitlines()]
with open(HERE / "events.out.tfevents", "wb") as file:
    writer = RecordWriter(file)
    writer.write(Event(wall_time=WALL_TIME, file_version="brain.Event:2").SerializeToString())
    for line in lines:
        values = [Summary.Value(tag=tag, simple_value=value) for tag, value in of_line(line)]
        event = Event(wall_time=WALL_TIME, step=line["step"], summary=Summary(value=values))
        writer.write(event.SerializeToString())

found = read(HERE)
for line in lines:
    for tag, value in of_line(line):
        assert any(step == line["step"] and abs(value - v) < 1e-6 * abs(v) + 1e-12 for step, v in found[tag]), tag
print(f"{len(found)} curves are read as they were written")
