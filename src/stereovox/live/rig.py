# SPDX-License-Identifier: Apache-2.0
"""The cameras of a live run, their mounts and clocks, and the source of poses; `live.toml`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.errors import SourceError, StereovoxError, did_you_mean
from stereovox.files.safe_io import is_number, read_table, shown
from stereovox.frame.validate import matrix_of
from stereovox.geometry.se3 import Transform, from_quaternion, orthonormalise, rigidity_error
from stereovox.sources.base import Stream, stream_of

TOLERANCE = 5e-3
"""Largest entry of abs(R^T R - I) that passes for rounding."""
MAX_CAMERAS = 16
KEYS = ("name", "source", "mount", "T_body_camera", "clock_offset_s")
TOP = ("poses", "camera")
MAX_OFFSET_S = 9e9


@dataclass(frozen=True, eq=False)
class LiveCamera:
    """A camera of a live run.

    Attributes:
        source: A live camera (`realsense:SERIAL`), a recording or simulation that is played at its own pace like one,
            or a `Stream` of your own.
        name: Its name in the map, in reports and in recordings; "": the name of its source.
        T_body_camera: (4, 4) float64, maps the camera's optical frame (x right, y down, z forward) into the body's
            (x forward, y left, z up). Without it the camera is at the body's origin and looks ahead. For a lidar, give
            the mount of a camera in its place that looks along its x axis.
        clock_offset_s: Image stamp minus the stamp of a pose at the same moment, in seconds.

    Raises:
        SourceError: The mount is no rigid motion, or the offset is not finite.
    """

    source: str | Path | Stream
    name: str = ""
    T_body_camera: Transform = field(default_factory=lambda: T_BODY_OPTICAL.copy())
    clock_offset_s: float = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.source, str | Path):
            stream_of(self.source)  # raises if it is no stream
        T = matrix_of(self.T_body_camera)
        if rigidity_error(T) > TOLERANCE:
            rows = "four rows of four numbers, a rotation and metres, below them 0 0 0 1"
            raise SourceError(f"{self.title}: T_body_camera must be {rows}")
        object.__setattr__(self, "T_body_camera", orthonormalise(T))
        if not (is_number(self.clock_offset_s) and abs(self.clock_offset_s) <= MAX_OFFSET_S):
            raise SourceError(f"{self.title}: clock_offset_s = {shown(self.clock_offset_s)} must be seconds")

    @property
    def title(self) -> str:
        """Its name, or the name of its source."""
        return self.name or (str(self.source) if isinstance(self.source, str | Path) else self.source.name)


@dataclass(frozen=True, eq=False)
class LiveSetup:
    """The contents of a `live.toml`: the cameras, and the source of poses ("" if not given)."""

    cameras: tuple[LiveCamera, ...]
    poses: str = ""


def mount_of(numbers: ArrayLike) -> Transform:
    """Return T_body_camera (4, 4) of a mount `x y z roll pitch yaw` or `x y z qx qy qz qw`.

    Metres along the body's axes (x forward, y left, z up). Degrees (roll about x, then pitch about y, then yaw about z,
    the body's axes) or a quaternion turn a camera that looks ahead: zeros keep it so, pitch 30 turns it 30 degrees
    down, yaw 90 to the left.
    Raises StereovoxError for anything else.
    """
    try:
        values = np.asarray(numbers, float)
    except (TypeError, ValueError):
        values = np.empty(0)
    if values.shape not in ((6,), (7,)) or not np.isfinite(values).all() or np.abs(values).max() > 1e4:
        raise StereovoxError("a mount is x, y, z, roll, pitch, yaw in metres and degrees, or x, y, z, qx, qy, qz, qw")
    if len(values) == 7:
        if np.linalg.norm(values[3:]) < 1e-6:
            raise StereovoxError("a mount needs a quaternion that is not zero")
        return from_quaternion(values[:3], values[3:]) @ T_BODY_OPTICAL
    return from_quaternion(values[:3], Rotation.from_euler("xyz", values[3:], degrees=True).as_quat()) @ T_BODY_OPTICAL


def read_live(path: str | Path) -> LiveSetup:
    """Read a `live.toml`: `poses`, and a table `[[camera]]` for each camera.

    Keys of a camera: `source`, `name`, `mount` (six or seven numbers, see `mount_of`) or `T_body_camera` (four rows of
    four), `clock_offset_s`. Relative paths of recordings start at the file's own folder.

    Raises:
        SourceError: One line that names file, camera and key.
    """
    table, folder = read_table(Path(path)), Path(path).parent
    try:
        _check_keys(table, TOP)
        tables = table.get("camera")
        if not isinstance(tables, list) or not tables or not all(isinstance(one, dict) for one in tables):
            raise SourceError("holds no camera; write one table [[camera]] per camera")
        cameras = [_camera(number, one, folder) for number, one in enumerate(tables, 1)]
        return LiveSetup(check_cameras(cameras), _word(table, "poses") if "poses" in table else "")
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None


def check_cameras(cameras: Sequence[LiveCamera]) -> tuple[LiveCamera, ...]:
    """Return the cameras; raises SourceError for none, for too many, or for two with one name."""
    names = [camera.title for camera in cameras]
    if not 1 <= len(names) <= MAX_CAMERAS:
        raise SourceError(f"{len(names)} cameras; give 1 to {MAX_CAMERAS}")
    if len(set(names)) < len(names):
        raise SourceError(f"two cameras have one name (names: {', '.join(names)}); give each its own")
    return tuple(cameras)


def _camera(number: int, table: dict[str, Any], folder: Path) -> LiveCamera:
    try:
        _check_keys(table, KEYS)
        source = _word(table, "source")
        if ":" not in source and (folder / source).exists():
            source = str(folder / source)
        given: dict[str, Any] = {"name": _word(table, "name")} if "name" in table else {}
        if "clock_offset_s" in table:
            given["clock_offset_s"] = table["clock_offset_s"]
        if "mount" in table and "T_body_camera" in table:
            raise SourceError("has mount and T_body_camera; keep one")
        if "mount" in table:
            given["T_body_camera"] = mount_of(table["mount"])
        if "T_body_camera" in table:
            given["T_body_camera"] = table["T_body_camera"]
        return LiveCamera(source, **given)
    except StereovoxError as error:
        raise SourceError(f"camera {number}: {error}") from None


def _word(table: dict[str, Any], key: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value or "\0" in value:
        raise SourceError(f"{key} = {shown(value)} must be a text" if key in table else f"{key} is missing")
    return value


def _check_keys(table: dict[str, Any], known: Sequence[str]) -> None:
    for key in table:
        if key not in known:
            raise SourceError(f"unknown key '{key}'{did_you_mean(key, known)}")
