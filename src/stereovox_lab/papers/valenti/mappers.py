# SPDX-License-Identifier: Apache-2.0
"""Mappers to compare, behind one small interface: two profiles of ours, and OctoMap."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline
from stereovox.errors import FrameRefused, MissingExtra
from stereovox.evaluate.truth import indices, keys
from stereovox.formats.octomap import read_octomap
from stereovox.frame import Frame, Reason
from stereovox.geometry.se3 import transform_points
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.sources.base import prefetch
from stereovox_lab.bench.peers import OctomapPython
from stereovox_lab.papers.valenti.recordings import Drive

PIXEL_BYTES = 5
"""Depth and reason of a pixel."""
THESIS, DEFAULT, OCTOMAP = "valenti2018", "default", "OctoMap"
MAPPERS = {THESIS: THESIS, DEFAULT: DEFAULT, OCTOMAP: DEFAULT}
"""Names of all mappers, each with the profile that its pairs are matched by."""


class Matched:
    """The frames of a drive as depth images, for any number of passes; refused pairs are left out.

    numbers: of the frames. config: matching settings. room: bytes that may be kept between passes; a
    recording that needs more is matched again in each pass.
    """

    def __init__(self, drive: Drive, numbers: Sequence[int], config: Config, room: float = 1e9):
        self._drive, self._numbers, self._depth = drive, numbers, DepthPipeline(config)
        camera = drive.camera
        self._keep = len(numbers) * camera.width * camera.height * PIXEL_BYTES <= room
        self._kept: list[tuple[int, Frame]] | None = None

    def __iter__(self) -> Iterator[tuple[int, Frame]]:
        """Yield number and frame, each with float32 depth."""
        if self._kept is not None:
            yield from self._kept
            return
        kept = []
        for found in self._match():
            if self._keep:
                kept.append(found)
            yield found
        self._kept = kept if self._keep else None

    def _match(self) -> Iterator[tuple[int, Frame]]:
        pairs = prefetch(lambda n: self._drive.frame(self._numbers[n]), len(self._numbers))
        for number, pair in zip(self._numbers, pairs, strict=True):
            try:
                yield number, self._depth.matched(pair)
            except FrameRefused:
                continue


class Setting(NamedTuple):
    """Cell size and maximum range in metres."""

    voxel_size: float
    max_range: float

    def __str__(self) -> str:
        return f"{self.voxel_size:g} m, to {self.max_range:g} m"


class Contestant(Protocol):
    """A mapper under test."""

    def add(self, frame: Frame) -> None:
        """Add a frame."""
        ...

    def map(self) -> VoxelMap:
        """Return the current map."""
        ...


def make_contestant(name: str, setting: Setting) -> Contestant:
    """Return the mapper of this name in `MAPPERS`. Raises MissingExtra if its library is not installed."""
    return OctomapContestant(setting) if name == OCTOMAP else _Ours(config_of(name, setting))


def config_of(profile: str, setting: Setting, **more: object) -> Config:
    """Return the settings of a profile at this cell size and range, its map as large as the drive."""
    sizes = {"voxel_size": setting.voxel_size, "max_range": setting.max_range, "window.size": None}
    return load_config(profile, **{**sizes, **more})


def why_missing(name: str) -> str:
    """Return how to install the library of this mapper, '' if it is installed."""
    try:
        make_contestant(name, Setting(0.5, 20.0))
    except MissingExtra as error:
        return str(error)
    return ""


class _Ours:
    def __init__(self, config: Config):
        self._mapper = Mapper(config)

    def add(self, frame: Frame) -> None:
        self._mapper.add(frame)

    def map(self) -> VoxelMap:
        return self._mapper.map


class OctomapContestant(OctomapPython):
    """OctoMap with its own settings; a pixel beyond the range clears its ray up to the range, as in ours.

    Its range is a distance, ours a depth: points between the two, at the image's corners, are marked occupied without
    a ray to them, so that they are not lost. Points that share a cell become one ray.
    """

    def __init__(self, setting: Setting):
        super().__init__(setting.voxel_size)
        self._setting = setting

    def add(self, frame: Frame) -> None:
        """Add all points of a frame: in range as hits, beyond it to clear space up to the range."""
        size, reach = self._setting
        depth = np.asarray(frame.depth, float) * frame.depth_scale
        if frame.reason is not None:  # nearly parallel rays: some point far beyond the range
            depth = np.where(frame.reason == Reason.TOO_FAR, 10 * reach, depth)
        shown = np.isfinite(depth) & (depth > 0)
        seen = frame.camera.middle.back_project(depth)[shown]
        points = np.ascontiguousarray(transform_points(frame.T_world_sensor, seen))
        self._tree.insertPointCloud(points, frame.T_world_sensor[:3, 3].copy(), reach, True, self.discretize)
        corners = points[(seen[:, 2] <= reach) & (np.linalg.norm(seen, axis=1) > reach)]
        cells = indices(np.unique(keys(np.floor(corners / size))))
        self._tree.updateNodes((cells + 0.5) * size, True, True)

    def map(self) -> VoxelMap:
        """Return the tree as a voxel map, its log-odds to the nearest thousandth."""
        self._tree.updateInnerOccupancy()
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "tree.ot"
            self._tree.write(os.fsencode(file))
            return read_octomap(file)
