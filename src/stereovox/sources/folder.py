# SPDX-License-Identifier: Apache-2.0
"""A folder of depth PNGs: all that the layouts have in common. A layout says which files there are and their poses."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from dataclasses import replace
from pathlib import Path

import numpy as np

from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame
from stereovox.geometry import Transform
from stereovox.sources.base import DepthSource
from stereovox.sources.images import common_size, read_depth_png
from stereovox.sources.intrinsics import Intrinsics, find_camera


class DepthFolder(DepthSource, ABC):
    """Frames from depth PNGs, one file each; a file that cannot be used becomes a frame with a `fault`.

    A layout sets `depth_scale` (metres per unit), `baseline` (metres) and `intrinsics` (what 640x480 images have
    without a calibration file), calls `_set_camera` when it is made, and tells each frame's image and pose.
    The PNGs hold 0 or 65535 for every pixel without value and do not say why: all are UNKNOWN, none clears.
    """

    depth_scale: float
    baseline: float
    intrinsics: Intrinsics

    def __init__(self, where: str | os.PathLike[str]):
        self.folder = Path(where)
        self.name = self.folder.resolve().name

    @abstractmethod
    def image(self, i: int) -> tuple[Path, int]:
        """Return the image file of frame `i` (0 to len - 1) and its time in nanoseconds."""

    @abstractmethod
    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) of frame `i` (0 to len - 1); raises FrameRefused where there is none."""

    def frame(self, i: int) -> Frame:
        """Return frame `i`; depth is (0, 0) and the pose NaN where the frame has a `fault`."""
        i = range(len(self))[i]
        path, stamp_ns = self.image(i)
        try:
            T_world_camera = self.pose(i)
            depth = read_depth_png(path, (self.camera.width, self.camera.height))
        except FrameRefused as refused:
            nothing, nowhere = np.empty((0, 0), np.uint16), np.full((4, 4), np.nan)
            blank = Frame(nothing, self.camera, nowhere, stamp_ns, self.depth_scale, name=str(path))
            return replace(blank, fault=refused.reason, fault_detail=str(refused))
        return Frame(depth, self.camera, T_world_camera, stamp_ns, self.depth_scale, name=str(path))

    def _set_camera(self, *calibration_folders: Path) -> None:
        paths = [self.image(i)[0] for i in range(len(self))]
        size = common_size(paths)
        if size is None:
            raise SourceError(f"{self.folder}: none of its {len(paths)} depth images is a readable 16-bit grey PNG")
        self.camera, notes = find_camera(calibration_folders, size, self.baseline, self.intrinsics)
        self.notes = (*self.notes, *notes)


def file_names(folder: Path) -> list[str]:
    """Return the names of what lies in `folder`; raises SourceError where it cannot be listed."""
    try:
        return os.listdir(folder)
    except OSError as error:
        raise SourceError(f"{folder}: {error.strerror}; give a folder you may read") from None
