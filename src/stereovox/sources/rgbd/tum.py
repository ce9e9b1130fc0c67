# SPDX-License-Identifier: Apache-2.0
"""Folders of the TUM RGB-D benchmark, and of the many tools that write its layout."""

from __future__ import annotations

import os
from pathlib import Path

from stereovox.errors import SourceError
from stereovox.sources.base import Part
from stereovox.sources.images import file_names
from stereovox.sources.rgbd.depth_files import SUFFIXES
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part
from stereovox.sources.trajectory import (
    FORMAT,
    StampedLine,
    Trajectory,
    by_time,
    inside,
    ns_from_seconds,
    stamped_lines,
)

LIST, IMAGES, POSES = "depth.txt", "depth", "groundtruth.txt"


class StampedImages(DepthFolder):
    """`depth.txt` (lines `stamp file`), else all `depth/<stamp>.png`; 5000 per metre by convention. No poses.

    Camera: `camera.toml`, else `camera-intrinsics.txt` (3x3), else `calibration.txt` (fx fy cx cy) in the folder. The
    layout has no such file of its own; without one, 640x480 images get 525 525 319.5 239.5, which TUM recommends for
    all its sequences because the depth is registered to the colour image with it. Baseline 0.075 m (Kinect v1, Xtion).
    Images are in order of time, of several with one stamp the first counts; stamps are exact to the nanosecond.
    Faults: see `DepthFolder`. Raises SourceError with file and line for a bad depth.txt.
    """

    layout = "stamped depth images (depth.txt or depth/*.png)"
    parts = (Part((LIST, f"{IMAGES}/*"), "depth images"),)
    depth_scale = 1 / 5000
    baseline = 0.075
    intrinsics = (525.0, 525.0, 319.5, 239.5)

    def list_images(self) -> list[ImageFile]:
        """Return the image files in order of time, of several with one stamp the first."""
        lines = _listed(self.folder) if os.path.isfile(self.folder / LIST) else _named(self.folder)
        images = by_time(lines)
        if len(lines) > len(images):
            self.notes = (f"{self.folder}: left out {len(lines) - len(images)} images with a stamp used before",)
        if not images:
            raise SourceError(f"{self.folder}: {LIST} and {IMAGES}/ name no image; give a folder that has some")
        return [ImageFile(self.folder / name, stamp_ns) for stamp_ns, name, _ in images]

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a list of depth images or a folder of them."""
        folder = folder_part(where)
        return os.path.isfile(os.path.join(folder, LIST)) or os.path.isdir(os.path.join(folder, IMAGES))


class TumRgbd(StampedImages):
    """Stamped images (see `StampedImages`) with `groundtruth.txt`, the poses of the optical frame.

    World: that of groundtruth.txt (TUM's motion capture: z up).
    Pose: between the neighbours before and after the image's time, straight in position, even in turning; both must
    be less than 0.1 s away. Further faults: those of `Poses.at`.
    """

    layout = "a TUM RGB-D folder (depth.txt or depth/*.png, with groundtruth.txt)"
    parts = (
        *StampedImages.parts,
        Part((POSES,), "poses", f"write {POSES} with lines '{FORMAT}', or add ?poses=FILE (other forms too)"),
    )

    def read_poses(self) -> Trajectory:
        """Return the poses of groundtruth.txt."""
        return Trajectory(self.folder / POSES)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder that has poses, and a list of depth images or a folder of them."""
        return super().recognises(where) and os.path.isfile(os.path.join(folder_part(where), POSES))

    @classmethod
    def depth_only(cls, where: str) -> StampedImages:
        """Return the images without looking for poses: every pose is NaN."""
        return StampedImages(where)


def _listed(folder: Path) -> list[StampedLine]:
    lines = stamped_lines(folder / LIST)
    for _, name, where in lines:
        if not name:
            raise SourceError(f"{where}: needs 'stamp file'; correct or delete the line")
        inside(name, where)
    return lines


def _named(folder: Path) -> list[StampedLine]:
    images = [f"{IMAGES}/{name}" for name in sorted(file_names(folder / IMAGES)) if name.lower().endswith(SUFFIXES)]
    return [(_stamp(folder / image), image, image) for image in images]


def _stamp(path: Path) -> int:
    try:
        return ns_from_seconds(path.stem)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; name images by their time or list them in {LIST}") from None
