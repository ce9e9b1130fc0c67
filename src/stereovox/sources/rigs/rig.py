# SPDX-License-Identifier: Apache-2.0
"""Recordings of stereo rigs: a folder with a rig file, the images of each pair, and the vehicle's poses."""

from __future__ import annotations

import os
from abc import ABC
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import StereoPair
from stereovox.errors import FrameRefused, NoPoses, SourceError
from stereovox.frame import StereoFrame
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Part, Source
from stereovox.sources.parameters import file_of
from stereovox.sources.photos import EYE_KINDS, file_names, png_size, read_picture_png
from stereovox.sources.poses.poses import Poses, UnknownPoses
from stereovox.sources.poses.trajectory import Trajectory, by_time, inside, stamped_lines
from stereovox.sources.rgbd.folder import SECOND, folder_part
from stereovox.sources.rgbd.pose_files import number_in
from stereovox.sources.rigs.rig_file import FILE, Rig, RigPair, read_rig
from stereovox.sources.rigs.rig_options import POSES, as_body, folder_and_options, poses_of_images

SHORTEST_NS = 1_000_000
"""Image names of a pair that span less than this are numbers, not times."""


class Shot(NamedTuple):
    """One picture of one pair: time, number of the pair, both files."""

    stamp_ns: int
    pair: int
    left: Path
    right: Path


class RigSource(Source, ABC):
    """Frames of stereo pairs whose images are files, with the poses of the vehicle over time.

    A layout calls `_set` in its constructor.
    Frames: a `StereoFrame` for each shot. Pose: interpolated between the neighbours of the image's time, times
    T_body_camera; both must be less than 0.1 s away. World: the poses'. Each pair is a sensor of its own, by its
    name. Faults: those of `read_picture_png` and of `Poses.at`.
    """

    pairs: list[StereoPair]
    _calibration: str
    """The file with the images' sizes, for messages."""

    def _set(
        self, rig: Rig, folder: Path, shots: Iterable[Shot], poses: Poses | UnknownPoses, calibration: str
    ) -> None:
        """Set the pairs and their images, which are sorted by time."""
        self.pairs = rig.stereo_pairs(folder)
        self.camera = self.pairs[0].camera.middle
        self._shots = sorted(shots, key=lambda shot: (shot.stamp_ns, shot.pair))
        self._poses, self._calibration = poses, calibration

    @classmethod
    def depth_only(cls, where: str) -> Self:
        """Return the images without searching for poses: every pose is NaN."""
        return cls(where, posed=False)  # pyrefly: ignore[bad-argument-count, unexpected-keyword] - by each layout

    def __len__(self) -> int:
        return len(self._shots)

    def frame(self, i: int) -> StereoFrame:
        """Return frame `i`; its images are (0, 0) and its pose NaN if it has a `fault`."""
        shot = self._shots[range(len(self))[i]]
        pair = self.pairs[shot.pair]
        no_image, no_pose = np.empty((0, 0), np.uint8), np.full((4, 4), np.nan)
        frame = StereoFrame(no_image, no_image, pair, no_pose, shot.stamp_ns, str(shot.left), sensor=pair.name)
        try:
            T_world_camera = self._pose(shot, pair)
            left, right = (self._picture(path, size) for path, size in zip(shot[2:], _sizes(pair), strict=True))
        except FrameRefused as refused:
            return replace(frame, fault=refused.reason, fault_detail=str(refused))
        return replace(frame, left=left, right=right, T_world_sensor=T_world_camera)

    def pose(self, i: int) -> Transform:
        """Return T_world_sensor (4, 4) of frame `i`, without its images; raises FrameRefused if missing."""
        shot = self._shots[range(len(self))[i]]
        return self._pose(shot, self.pairs[shot.pair])

    def _pose(self, shot: Shot, pair: StereoPair) -> Transform:
        try:
            return self._poses.at(shot.stamp_ns) @ pair.T_body_camera
        except FrameRefused as refused:
            raise FrameRefused(refused.reason, f"{shot.left}: {refused}") from None

    def _picture(self, path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
        try:
            return read_picture_png(path, size, EYE_KINDS)
        except FrameRefused as refused:
            if refused.reason != "bad_shape":
                raise
        (width, height), expected = png_size(path, EYE_KINDS), f"{size[0]}x{size[1]}"
        said = f"{path}: {width}x{height} pixels, {self._calibration} has {expected}"
        raise FrameRefused("bad_shape", f"{said}; correct width and height there, or the image") from None


class StereoRig(RigSource):
    """A folder with `rig.toml` (see `Rig`), images of each pair, and a file of poses T_world_body in TUM format.

    posed: if False, poses are not searched for, and are NaN.
    where: the folder, or with options `flight?poses=trajectory.log&fps=20`:
        poses: a file or folder of poses of any form (see `rgbd.pose_files`) instead of the rig file's.
        axes: the poses are the first pair's left eye's, in `optical`, `opengl` or `ros` axes, not the body's.
        invert: 1 if poses map the world into the posed frame. fps: images a second, if their names are numbers.
    Frames: a `StereoFrame` for each left image of each pair, in order of time; at one time in the rig file's order.
    Both images of a moment have the same name, their time in nanoseconds, or share a line of the pair's index.
    Poses and faults: see `RigSource`. Reasons of invalid pixels come from matching (`depth.stereo`); the rig's
    masks make pixels MASKED. Raises SourceError for a bad rig file, unreadable masks or folders, names that are not
    times, and if there is no image or no file of poses.
    Names of several images that span less than a millisecond are not times.
    """

    layout = f"a stereo rig ({FILE} that names pairs, folders of images and poses)"
    parts = (
        Part(("left/*.png", "*/left/*.png"), "left images"),
        Part(("right/*.png", "*/right/*.png"), "right images"),
        Part((FILE,), FILE, f"write it with: stereovox calibrate import CALIBRATION --out {FILE} (docs/rigs.md)"),
    )

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        self.folder, options = folder_and_options(where, {**POSES, "fps": 0.0})
        self.name = self.folder.resolve().name
        file = self.folder / FILE
        rig = read_rig(file)
        try:
            rig.stereo_pairs(self.folder)
        except SourceError as error:
            raise SourceError(f"{file}: {error}") from None
        fps = options["fps"]
        shots = [shot for number, pair in enumerate(rig.pairs) for shot in _shots(self.folder, number, pair, fps)]
        poses = self._read_poses(rig, shots, options) if posed else UnknownPoses()
        self._set(rig, self.folder, shots, poses, FILE)

    def _read_poses(self, rig: Rig, shots: Sequence[Shot], options: Mapping[str, Any]) -> Poses:
        if options["poses"]:
            poses = poses_of_images(file_of(options["poses"], self.folder), [shot.stamp_ns for shot in shots])
        else:
            poses = _poses(self.folder, rig.poses)
        return as_body(poses, rig.pairs[0].T_body_left, options["axes"], options["invert"])

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a `rig.toml`."""
        return os.path.isfile(os.path.join(folder_part(where), FILE))


def _poses(folder: Path, name: str) -> Trajectory:
    if not os.path.isfile(folder / name):
        raise NoPoses(
            f"{folder / name}: no such file of poses; write it, or set poses = in {folder / FILE}, or add ?poses=FILE"
        )
    return Trajectory(folder / name)


def _sizes(pair: StereoPair) -> tuple[tuple[int, int], tuple[int, int]]:
    left, right = (pair.eyes.left, pair.eyes.right) if pair.eyes else (pair.camera, pair.camera)
    return (left.width, left.height), (right.width, right.height)


def _shots(folder: Path, number: int, pair: RigPair, fps: float) -> list[Shot]:
    """Return the images of a pair. fps: images a second, with numbers as names; 0: names are times."""
    left, right = (folder / name for name in pair.folders())
    for side, place in (("left", left), ("right", right)):
        if not os.path.isdir(place):
            cure = f"put the {side} images of pair '{pair.name}' there, or set its {side} = in {folder / FILE}"
            raise SourceError(f"{place}: no such folder; {cure}")
    if pair.index:
        return _listed(folder / pair.index, number, left, right)
    names = sorted(name for name in file_names(left) if name.endswith(".png"))
    if not names:
        raise SourceError(f"{left}: holds no PNG; put the left images of pair '{pair.name}' there, named by ns")
    if fps:
        stamp_of = {name: int(number_in(name)[0] * SECOND / fps) for name in names}
    else:
        stamp_of = {name: _stamp(left / name) for name in names}
    shots = [Shot(stamp_of[name], number, left / name, right / name) for name in names]
    stamps = [shot.stamp_ns for shot in shots]
    if len(shots) > 1 and max(stamps) - min(stamps) < SHORTEST_NS:
        said = f"its {len(shots)} images would all be taken within a millisecond ({names[0]} to {names[-1]})"
        raise SourceError(f"{left}: {said}; name them by time in ns, give an index file, or add ?fps=")
    return shots


def _listed(path: Path, number: int, left: Path, right: Path) -> list[Shot]:
    shots = []
    for stamp_ns, rest, where in by_time(stamped_lines(path)):
        names = rest.split()
        if len(names) not in (1, 2):
            raise SourceError(f"{where}: needs 'stamp left [right]'; correct or delete the line")
        for name in names:
            inside(name, where)
        shots.append(Shot(stamp_ns, number, left / names[0], right / names[-1]))
    if not shots:
        raise SourceError(f"{path}: names no image; write lines 'stamp left [right]'")
    return shots


def _stamp(path: Path) -> int:
    if not (path.stem.isascii() and path.stem.isdecimal() and int(path.stem) < 2**63):
        raise SourceError(
            f"{path}: its name is not a time in nanoseconds; rename it, or list the images in an index file"
        )
    return int(path.stem)
