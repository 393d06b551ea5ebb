"""LiDAR detectors trained in simulation: why they lose on real data, and what must change in the simulator.

Clouds are numpy arrays N x 3 (x, y, z) or N x 4 (x, y, z, intensity), float32, m, in the frame x forward, y left,
z up. Boxes are M x 7, float64: x, y, z of the centre, length, width, height (m), yaw (rad, counter-clockwise from +x).

The package contains the program: ``lidarshift --help`` or ``python -m lidarshift --help``.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from . import _native
from ._native import LidarshiftError, __version__

__all__ = [
    "Dataset",
    "Effects",
    "Frame",
    "LidarshiftError",
    "__version__",
    "apply_effects",
    "diagnose",
    "kitti_ap",
    "read_cloud",
    "run",
    "twin",
]


def _array(data, dtype, *shape):
    """A writable array of the bytes that the native half gives; None stays None."""
    return None if data is None else np.frombuffer(data, dtype).reshape(shape)


def _points(data_and_channels):
    data, channels = data_and_channels
    return _array(data, "<f4", -1, channels)


def _bytes(points):
    """Bytes and columns of points."""
    points = np.ascontiguousarray(points, dtype="<f4")
    if points.ndim != 2:
        raise ValueError(f"points have the shape {points.shape}; give N x 3 or N x 4")
    return points.tobytes(), points.shape[1]


def read_cloud(path, columns="xyzi"):
    """Reads a cloud from a ``.bin`` (KITTI) or ``.pcd``.

    :param path: the file.
    :param columns: columns of a ``.bin``, ``"xyzi"`` or ``"xyz"``. ``"xyz"`` drops the intensity of a ``.pcd``.
    :returns: points, N x 4 or N x 3, float32.
    :raises LidarshiftError: a file that cannot be read, an empty cloud, values that are not finite.
    """
    return _points(_native.read_cloud(os.fspath(path), columns))


@dataclass
class Frame:
    """A frame of a data set. What is not known is ``None``."""

    #: Id of the frame.
    id: str
    #: Points, N x 4 or N x 3, float32.
    points: np.ndarray
    #: Boxes in the LiDAR frame, M x 7, float64.
    boxes: np.ndarray
    #: Classes of the boxes.
    classes: list = field(default_factory=list)
    #: Name of the track of each box, or None.
    tracks: list = field(default_factory=list)
    #: Time stamp, s since the start of the sequence.
    stamp_s: float | None = None
    #: Pose of the LiDAR in the world, 4 x 4.
    world_from_lidar: np.ndarray | None = None
    #: Ring of each point, uint16.
    ring: np.ndarray | None = None
    #: Time of each point relative to the stamp, s, float32.
    time_s: np.ndarray | None = None


class Dataset:
    """A data set on disk: its folder, its TOML, or an MCAP file. Iterates over its frames.

    :param path: the data set. All layouts of the program are read.
    :param split: the split over which it iterates; all frames without one.
    :raises LidarshiftError: what is no data set.
    """

    def __init__(self, path, split=None):
        self._native = _native.Dataset(os.fspath(path))
        self._ids = self._native.ids(split)

    @property
    def name(self):
        """Name of the data set."""
        return self._native.name

    @property
    def root(self):
        """Root of its files."""
        return Path(self._native.root)

    @property
    def layout(self):
        """Layout of its files, such as ``"kitti"``."""
        return self._native.layout

    @property
    def rig(self):
        """TOML with its sensors, or None."""
        rig = self._native.rig
        return None if rig is None else Path(rig)

    @property
    def classes(self):
        """Classes of its labels."""
        return self._native.classes

    @property
    def splits(self):
        """Names of its splits."""
        return self._native.splits

    @property
    def ids(self):
        """Ids of the frames over which it iterates."""
        return list(self._ids)

    def cloud(self, frame):
        """Points of a frame, by its id or its number.

        :returns: points, N x 4 or N x 3, float32.
        """
        return _points(self._native.cloud(self._id(frame)))

    def frame(self, frame):
        """A frame, by its id or its number.

        :raises LidarshiftError: a frame that cannot be read.
        """
        name = self._id(frame)
        points, boxes, classes, tracks, stamp_s, pose, ring, time_s = self._native.frame(name)
        return Frame(
            name,
            _points(points),
            _array(boxes, "<f8", -1, 7),
            classes,
            tracks,
            stamp_s,
            _array(pose, "<f8", 4, 4),
            _array(ring, "<u2", -1),
            _array(time_s, "<f4", -1),
        )

    def _id(self, frame):
        return frame if isinstance(frame, str) else self._ids[frame]

    def __len__(self):
        return len(self._ids)

    def __getitem__(self, frame):
        return self.frame(frame)

    def __iter__(self):
        return (self.frame(name) for name in self._ids)

    def __repr__(self):
        return f"Dataset({self.name!r}, layout={self.layout!r}, frames={len(self)})"


class Effects:
    """A sensor model for clouds: a callable, such as a transform of a PyTorch data set.

    :param model: TOML with a list of effects, such as ``extended.toml`` of a diagnosis.
    :param rig: TOML with the poses and patterns of the sensors; one sensor at the origin of the clouds without it.
    :param like: a :class:`Dataset` whose clouds tell the scan patterns, and whose rig is taken if none is given. Frames
        of this data set then get the bits that ``lidarshift resim`` gives them. Without it, the patterns of each cloud
        are found in itself: the bits of ``resim`` on a data set that has this cloud alone.
    :param seed: random seed.
    :raises LidarshiftError: a list or a rig that cannot be read.
    """

    def __init__(self, model, *, rig=None, like=None, seed=0):
        clouds = None
        if like is not None:
            ids = like._native.ids(None)
            clouds = [_bytes(like.cloud(ids[at])) for at in _native.Effects.pattern_frames(len(ids))]
            rig = like.rig if rig is None else rig
        rig = None if rig is None else os.fspath(rig)
        self._native = _native.Effects(os.fspath(model), rig, clouds)
        self.seed = seed

    def __call__(self, points, frame=0, seed=None):
        """The points with the effects applied.

        :param points: N x 3 or N x 4, converted to float32.
        :param frame: number of the cloud, from 0: in the order of the sorted ids of its data set.
        :param seed: random seed; that of the object without it.
        :returns: points, float32, as many columns. It may have fewer or more points, or none.
        :raises LidarshiftError: an effect that finished clouds cannot have, or points that are not finite.
        """
        seed = self.seed if seed is None else seed
        return _points(self._native.apply(*_bytes(points), seed, frame))


def apply_effects(points, model, *, seed=0, frame=0, rig=None):
    """The points with a sensor model applied: the bits of ``lidarshift resim`` on a data set that has this cloud alone.

    :class:`Effects` reads the model once for many clouds.

    :param points: N x 3 or N x 4, converted to float32.
    :param model: TOML with a list of effects.
    :param seed: random seed.
    :param frame: number of the cloud; clouds with unlike numbers get independent random numbers.
    :param rig: TOML with the poses and patterns of the sensors.
    :returns: points, float32, as many columns.
    :raises LidarshiftError: as :class:`Effects`.
    """
    return Effects(model, rig=rig, seed=seed)(points, frame)


def kitti_ap(labels, detections, *, classes=(), overlaps=(), max_range_m=None, label_frame="lidar"):
    """KITTI's average precision: AP11, AP40, exact area, and recall.

    :param labels: a folder of KITTI text, or a list with a dictionary for each frame: ``boxes`` (M x 7, LiDAR frame),
        ``classes`` (M).
    :param detections: a folder of KITTI text with scores, or a list with a dictionary for each frame: ``boxes``,
        ``classes``, ``scores`` (M).
    :param classes: classes to evaluate; those of the labels and detections without it.
    :param overlaps: further overlap limits, from 0 to 1.
    :param max_range_m: ignore what is farther away on the ground plane, m.
    :param label_frame: of folders: ``"lidar"`` or ``"camera"`` (KITTI's own convention).
    :returns: the report of ``lidarshift eval ap --json``: a dictionary with ``rows`` (class, metric, overlap,
        difficulty, ``ap11``, ``ap40``, ``ap_area`` in percent) and ``recall``.
    :raises LidarshiftError: unlike frames, boxes that are not M x 7, files that cannot be read.
    """
    classes, overlaps = list(classes), list(overlaps)
    if isinstance(labels, (str, os.PathLike)):
        if label_frame not in ("lidar", "camera"):
            raise ValueError(f'label_frame is {label_frame!r}; give "lidar" or "camera"')
        folders = os.fspath(labels), os.fspath(detections)
        text = _native.kitti_ap_of_folders(*folders, label_frame == "camera", classes, overlaps, max_range_m)
        return json.loads(text)

    def boxes(frame):
        array = np.ascontiguousarray(frame["boxes"], dtype="<f8")
        if array.size and (array.ndim != 2 or array.shape[1] != 7):
            raise ValueError(f"boxes have the shape {array.shape}; give M x 7 (x y z dx dy dz yaw, m and rad)")
        return array.tobytes()

    truth = [(boxes(f), list(f["classes"])) for f in labels]
    found = [(boxes(f), list(f["classes"]), [float(s) for s in f["scores"]]) for f in detections]
    return json.loads(_native.kitti_ap(truth, found, classes, overlaps, max_range_m))


def run(*arguments, check=True):
    """Runs a command of the program in a process of its own.

    :param arguments: words of the command line, such as ``"doctor", "my-data"``.
    :param check: raise an error if it fails.
    :returns: the finished process with ``returncode``, ``stdout`` and ``stderr`` as text.
    :raises LidarshiftError: the command failed. ``code`` is its exit code.
    """
    if not check:
        return _process(arguments)
    return _checked(arguments)


def _process(arguments):
    command = [sys.executable, "-m", "lidarshift", *(os.fspath(a) for a in arguments)]
    return subprocess.run(command, capture_output=True, text=True, encoding="utf-8")


def _checked(arguments, sound=(0,)):
    """The finished process; an exit code that is not sound is raised."""
    done = _process(["--errors", "json", *arguments])
    if done.returncode in sound:
        return done
    last = done.stderr.rstrip("\n").rpartition("\n")[2]
    try:
        report = dict(json.loads(last))
        error = LidarshiftError(report["message"])
    except (ValueError, TypeError, KeyError):
        # It ended by a signal.
        report = {"code": done.returncode}
        error = LidarshiftError(last or f"ended with {done.returncode}")
    for name in ("file", "line", "hint", "code", "kind"):
        setattr(error, name, report.get(name))
    raise error


def _options(options):
    """Keyword arguments as options of the command line: ``max_range=50`` is ``--max-range 50``."""
    words = []
    for name, value in options.items():
        option = "--" + name.replace("_", "-")
        if value is True:
            words.append(option)
        elif isinstance(value, (list, tuple)):
            words += [word for item in value for word in (option, str(item))]
        elif value is not None and value is not False:
            words += [option, os.fspath(value) if isinstance(value, os.PathLike) else str(value)]
    return words


def diagnose(measured, simulated, out, **options):
    """Finds the differences between measured and simulated data and their causes.

    :param measured: the measured data set.
    :param simulated: the simulated data set of the same scenes.
    :param out: folder for the results.
    :param options: options of ``lidarshift diagnose``, such as ``sensor="rig.toml"`` or ``split="test"``.
    :returns: ``diagnosis.json`` as a dictionary. Data sets of unlike scenes have the verdict
        ``not_scenario_identical``.
    :raises LidarshiftError: a diagnosis that could not be made.
    """
    words = ["diagnose", "--measured", measured, "--simulated", simulated, "--out", out, *_options(options)]
    _checked(words, sound=(0, 3))
    return json.loads((Path(out) / "diagnosis.json").read_text(encoding="utf-8"))


def twin(recording, out, **options):
    """Makes a simulated partner of a recording that has no simulation.

    :param recording: the recording.
    :param out: folder for the pair.
    :param options: options of ``lidarshift twin``.
    :returns: what the command printed.
    :raises LidarshiftError: a recording of which no twin can be made.
    """
    return run("twin", recording, "--out", out, *_options(options)).stdout
