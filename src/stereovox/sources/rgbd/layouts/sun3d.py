# SPDX-License-Identifier: Apache-2.0
"""Folders of Princeton's SUN3D (Xtion), whose depth images have their bits rotated."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from stereovox.errors import SourceError
from stereovox.sources.base import Part
from stereovox.sources.photos import file_names
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.depth_files import Depth
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses, read_poses

FILE = re.compile(r"(\d+)-(\d+)\.\w+")


class Sun3d(DepthFolder):
    """`depth/0000001-000000033369.png` with the last of `extrinsics/*.txt`, 3x4 matrices, one for each colour image.

    Names hold a number and a time in microseconds; poses are interpolated from the times of `image/` to those of the
    depth images. Images hold millimetres rotated left by three bits: d = raw >> 3 | raw << 13. Camera:
    `intrinsics.txt`. World: y down.
    """

    layout = "a SUN3D folder (depth/N-TIME.png with extrinsics/*.txt)"
    parts = (
        Part(("depth/*-*.png",), "depth images"),
        Part(("extrinsics/*.txt",), "poses", "put extrinsics/ there, or add ?poses=FILE"),
    )
    baseline = 0.075
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the depth images in order of time."""
        return _stamped(self.folder / "depth")

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses over the times of the colour images, or one for each depth image."""
        path = sorted((self.folder / "extrinsics").glob("*.txt"))[-1]
        found = read_poses(path)
        if not isinstance(found, ImagePoses):
            raise SourceError(f"{path}: needs a 3x4 matrix for each colour image; give another with ?poses=FILE")
        place = self.folder / "image"
        colour = _stamped(place) if place.is_dir() else []
        if len(colour) != len(found):
            return self.fitted(found)
        return Poses([image.stamp_ns for image in colour], [found.at(i) for i in range(len(found))], where=str(path))

    def read(self, i: int) -> Depth:
        """Return the depth image (height, width) uint16 in millimetres; raises FrameRefused (`read_depth`)."""
        raw = super().read(i)
        if raw.dtype != np.uint16:
            return raw
        bits = raw.astype(np.uint32)
        return (bits >> 3 | bits << 13).astype(np.uint16)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images of this naming, and extrinsics."""
        folder = folder_part(where)
        images, poses = cls.parts
        return images.count(folder) > 0 and poses.count(folder) > 0 and bool(_stamped(Path(folder) / "depth"))


def _stamped(folder: Path) -> list[ImageFile]:
    """Return the files `NUMBER-MICROSECONDS.suffix` in order of time; of several at one time, the first."""
    try:
        found = {
            int(m[2]) * 1000: name for name in sorted(file_names(folder), reverse=True) if (m := FILE.fullmatch(name))
        }
    except SourceError:
        return []
    return [ImageFile(folder / found[stamp], stamp) for stamp in sorted(found)]
