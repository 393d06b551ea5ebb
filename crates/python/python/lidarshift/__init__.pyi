import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

_Path = Union[str, os.PathLike[str]]

__version__: str

class LidarshiftError(ValueError):
    file: str | None
    line: int | None
    hint: str | None
    code: int
    kind: str | None

def read_cloud(path: _Path, columns: str = "xyzi") -> NDArray[np.float32]: ...
@dataclass
class Frame:
    id: str
    points: NDArray[np.float32]
    boxes: NDArray[np.float64]
    classes: list[str] = ...
    tracks: list[str | None] = ...
    stamp_s: float | None = None
    world_from_lidar: NDArray[np.float64] | None = None
    ring: NDArray[np.uint16] | None = None
    time_s: NDArray[np.float32] | None = None

class Dataset:
    def __init__(self, path: _Path, split: str | None = None) -> None: ...
    @property
    def name(self) -> str: ...
    @property
    def root(self) -> Path: ...
    @property
    def layout(self) -> str: ...
    @property
    def rig(self) -> Path | None: ...
    @property
    def classes(self) -> list[str]: ...
    @property
    def splits(self) -> list[str]: ...
    @property
    def ids(self) -> list[str]: ...
    def cloud(self, frame: str | int) -> NDArray[np.float32]: ...
    def frame(self, frame: str | int) -> Frame: ...
    def __len__(self) -> int: ...
    def __getitem__(self, frame: str | int) -> Frame: ...
    def __iter__(self) -> Iterator[Frame]: ...

class Effects:
    seed: int
    def __init__(
        self, model: _Path, *, rig: _Path | None = None, like: Dataset | None = None, seed: int = 0
    ) -> None: ...
    def __call__(self, points: ArrayLike, frame: int = 0, seed: int | None = None) -> NDArray[np.float32]: ...

def apply_effects(
    points: ArrayLike, model: _Path, *, seed: int = 0, frame: int = 0, rig: _Path | None = None
) -> NDArray[np.float32]: ...
def kitti_ap(
    labels: _Path | Sequence[Mapping[str, Any]],
    detections: _Path | Sequence[Mapping[str, Any]],
    *,
    classes: Sequence[str] = (),
    overlaps: Sequence[float] = (),
    max_range_m: float | None = None,
    label_frame: str = "lidar",
) -> dict[str, Any]: ...
def run(*arguments: _Path, check: bool = True) -> subprocess.CompletedProcess[str]: ...
def diagnose(measured: _Path, simulated: _Path, out: _Path, **options: Any) -> dict[str, Any]: ...
def twin(recording: _Path, out: _Path, **options: Any) -> str: ...
