# SPDX-License-Identifier: Apache-2.0
"""Folders with one file per cloud, and a file of poses."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, MapFileError, NoPoses, SourceError, did_you_mean
from stereovox.frame import Cloud
from stereovox.frame.validate import MAX_INT
from stereovox.sources.base import Part
from stereovox.sources.clouds.options import CloudSource, LidarOptions, no_others, options_of
from stereovox.sources.lidar import BinLayout, find_layout, read_velodyne
from stereovox.sources.parameters import file_of, mounted
from stereovox.sources.photos import file_names
from stereovox.sources.point_files import read_points
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rgbd.pose_fit import CloudReading, clouds_misfit
from stereovox.sources.rigs.rig_options import poses_of_images

ENDINGS = (".pcd", ".ply", ".bin")
SUBFOLDERS = ("", "clouds", "scans", "velodyne", "velodyne_points/data", "lidar", "pcd", "ply", "points")
POSE_FILES = ("poses.txt", "poses.tum", "groundtruth.txt", "trajectory.txt", "trajectory.tum", "poses.csv")
TIMES = ("times.txt", "timestamps.txt")
NANOSECONDS = re.compile(r"\d{16,19}")
SECONDS = re.compile(r"\d{1,10}\.\d+")
NUMBERED = re.compile(r"\d{2}$|^\d+$")
"""Endings of the names of KITTI's clouds; points3D.bin is not one."""
MAX_COLUMNS, TRIED = 32, 5
"""Most numbers a point in a `.bin`, and most files tried to find their layout."""
RATE_HZ = 10.0
"""Default clouds per second, if no times are given: the rate of most spinning lidars."""


@dataclass(frozen=True)
class Options(LidarOptions):
    """Those of all clouds (`LidarOptions`), and:

    poses: file of the poses, of any form, instead of the folder's own. axes: axes of the
    posed body if it is not the lidar (x forward, y left, z up): `optical`, `opengl` or `ned`. mount: where the lidar is
    on that body: x,y,z in metres, then yaw, pitch and roll in radians. invert, poses_scale, max_gap: as for depth
    images. fps: clouds per second, if they have no times.
    columns: float32 numbers a point in `.bin` files (0: found from the files, else KITTI's 4).
    """

    poses: str = ""
    axes: str = ""
    mount: str = ""
    invert: bool = False
    poses_scale: float = 1.0
    max_gap: float = 0.0
    fps: float = 0.0
    columns: int = 0

    def __post_init__(self) -> None:
        mounted("mount", self.mount)
        if not (self.columns == 0 or 3 <= self.columns <= MAX_COLUMNS):
            raise SourceError(f"columns={self.columns} must be 3 to {MAX_COLUMNS}: numbers a point of the .bin files")
        if self.axes and self.axes not in AXES:
            raise SourceError(f"axes={self.axes} is unknown{did_you_mean(self.axes, AXES)}")
        if self.fps < 0 or self.max_gap < 0 or not self.poses_scale > 0:
            key = "fps" if self.fps < 0 else "max_gap" if self.max_gap < 0 else "poses_scale"
            raise SourceError(f"{key}={getattr(self, key):g} must be positive")


class CloudFolder(CloudSource):
    """Clouds in `.pcd`, `.ply` or KITTI's `.bin` files, with the poses of the lidar.

    where: the folder, with the files in it or in one of `clouds`, `scans`, `velodyne`, `lidar`, `pcd`, `ply`, `points`;
        `Options` may follow.
    Poses: `poses.txt` or the like, T_world_lidar in any form; interpolated if they have times, else one for each
        cloud.
    Times: from the files' names, if these are seconds with a fraction or nanoseconds; else lines of seconds in
        `times.txt`; else 10 clouds a second, with a note.
    A `.bin` has 3 to 8 numbers a point, float32 or float64: x, y, z first (KITTI 4, nuScenes 5), found from the files.
    Faults: `unreadable`, `no_pose`, `bad_pose_file`.
    Raises SourceError if there is no cloud, or times and poses do not fit.
    """

    layout = "a folder of clouds (.pcd, .ply, .bin) with poses of the lidar (poses.txt)"
    parts = (
        Part(("*.pcd", "*.ply", "*[0-9][0-9].bin", "*/*.pcd", "*/*.ply", "*/*.bin"), "clouds (.pcd, .ply, .bin)"),
        Part(POSE_FILES, "poses of the lidar (poses.txt)"),
    )

    def __init__(self, where: str):
        folder = Path(folder_part(where))
        options, others = options_of(where, len(str(folder_part(where))), Options)
        no_others(where, others, Options)
        self.name, self.lidar, self.notes = folder.resolve().name, options.lidar, ()
        self._files = _clouds_in(folder)
        if not self._files:
            raise SourceError(f"{folder}: has no clouds ({', '.join(ENDINGS)}); give a folder with clouds")
        timed = sorted(zip(self._times(folder, options.fps), self._files, strict=True), key=lambda one: one[0])
        self._stamps, self._files = [stamp_ns for stamp_ns, _ in timed], [path for _, path in timed]
        poses = _poses_in(folder) if not options.poses else file_of(options.poses, folder)
        if poses is None:
            raise NoPoses(f"{folder}: has no {POSE_FILES[0]}; put it there or name ?poses=FILE")
        self._poses = poses_of_images(poses, self._stamps)
        self._poses.max_gap_ns = round(options.max_gap * 1e9)
        mount = mounted("mount", options.mount)
        self._reading = CloudReading(options.axes or "ros", options.invert, options.poses_scale)
        if mount is not None:
            self._reading = self._reading._replace(mount=tuple(mount.ravel().tolist()))
        self._layout = self._find_layout(options.columns)
        found = clouds_misfit(self._points, self._raw, len(self), self._reading)
        self.notes = (*self.notes, *filter(None, (self._poses.note, found)))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with clouds and poses, or names its poses."""
        folder = folder_part(where)
        if not os.path.isdir(folder):
            return False
        posed = "poses=" in where[len(folder) :] or _poses_in(Path(folder)) is not None
        return posed and bool(_clouds_in(Path(folder)))

    def __len__(self) -> int:
        return len(self._files)

    def stamp_ns(self, i: int) -> int:
        """Return the time of cloud `i`."""
        return self._stamps[i]

    def file(self, i: int) -> Path:
        """Return its file."""
        return self._files[i]

    def cloud(self, i: int) -> Cloud:
        """Return cloud `i`."""
        points, T = self._points(i), self._reading.pose(self._raw(i))
        return Cloud(points, T, self._stamps[i], self.lidar, name=str(self._files[i]))

    def _points(self, i: int) -> NDArray[np.floating]:
        path = self._files[i]
        return read_velodyne(path, self._layout) if path.suffix.lower() == ".bin" else _measured(path)

    def _raw(self, i: int) -> NDArray[np.float64]:
        return self._poses.at(self._stamps[i])

    def _find_layout(self, columns: int) -> BinLayout:
        """Return the layout of `.bin` files; raises SourceError if it cannot be found."""
        if columns:
            return BinLayout(columns)
        for path in [path for path in self._files if path.suffix.lower() == ".bin"][:TRIED]:
            try:
                found = find_layout(path)
            except FrameRefused as refused:
                if "columns=" in str(refused):
                    raise SourceError(str(refused)) from None
                continue  # reported when it is read
            if found != BinLayout():
                self.notes = (*self.notes, f"{self.name}: its .bin files have {found.words} (?columns=)")
            return found
        return BinLayout()

    def _times(self, folder: Path, fps: float) -> list[int]:
        """Return the times of all clouds; times in names need not ascend: 7.5 sorts behind 7.25."""
        stems = [path.stem for path in self._files]
        if not fps and all(NANOSECONDS.fullmatch(stem) and int(stem) < MAX_INT for stem in stems):
            return [int(stem) for stem in stems]
        if not fps and all(SECONDS.fullmatch(stem) for stem in stems):
            return [ns_from_seconds(stem) for stem in stems]
        listed = next((folder / name for name in TIMES if (folder / name).is_file()), None)
        if not fps and listed is not None:
            return self._listed(listed)
        rate = fps or RATE_HZ
        if not fps:
            self.notes = (f"{self.name}: clouds have no times; assuming {rate:g} a second (?fps=)",)
        return [round(1e9 * i / rate) for i in range(len(stems))]

    def _listed(self, path: Path) -> list[int]:
        try:
            stamps = [ns_from_seconds(line.split()[0]) for line in path.read_text().splitlines() if line.strip()]
        except (OSError, UnicodeDecodeError, ValueError) as error:
            raise SourceError(f"{path}: {error}; write a time in seconds in each line") from None
        if len(stamps) != len(self._files) or any(b <= a for a, b in pairwise(stamps)):
            raise SourceError(
                f"{path}: has {len(stamps)} times for {len(self._files)} clouds; write one for each, ascending"
            )
        return stamps


def _measured(path: Path) -> NDArray[np.float64]:
    """Return the points of a `.pcd` or `.ply` (N, 3); raises FrameRefused `unreadable`.

    If a `.pcd` has another viewpoint, rays from its origin would clear space that was never seen.
    """
    try:
        found = read_points(path)
    except MapFileError as error:
        raise FrameRefused("unreadable", str(error)) from None
    if found.turned:
        cure = "write VIEWPOINT 0 0 0 1 0 0 0 if points are in the lidar's own frame, else move them into it"
        raise FrameRefused("unreadable", f"{path}: its VIEWPOINT moves or turns the lidar; {cure}")
    return found.xyz


def _clouds_in(folder: Path) -> list[Path]:
    """Return the clouds of a folder, or of its first subfolder with clouds, in the order of the numbers in their
    names."""
    for place in (folder / name for name in SUBFOLDERS):
        if place.is_dir():
            found = [place / name for name in file_names(place) if _is_cloud(name, place == folder)]
            if found:
                return sorted(found, key=lambda path: _in_order(path.stem))
    return []


def _is_cloud(name: str, top: bool) -> bool:
    """Return whether a file is a cloud by its name; in the folder itself a `.bin` must be numbered."""
    path = Path(name)
    ending = path.suffix.lower()
    return ending in ENDINGS and not (top and ending == ".bin" and not NUMBERED.search(path.stem))


def _in_order(stem: str) -> tuple[list[int], str]:
    return [int(number) for number in re.findall(r"\d{1,30}", stem)], stem


def _poses_in(folder: Path) -> Path | None:
    return next((folder / name for name in POSE_FILES if (folder / name).is_file()), None)
