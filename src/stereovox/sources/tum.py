# SPDX-License-Identifier: Apache-2.0
"""Folders of the TUM RGB-D benchmark, and of the many tools that write its layout."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from stereovox.errors import SourceError
from stereovox.se3 import Transform
from stereovox.sources.images import DepthFolder, file_names
from stereovox.sources.trajectory import StampedLine, Trajectory, by_time, inside, ns_from_seconds, stamped_lines

LIST, IMAGES, POSES = "depth.txt", "depth", "groundtruth.txt"


class StampedImages(DepthFolder):
    """`depth.txt` (lines `stamp file`), else all `depth/<stamp>.png`; uint16, 5000 per metre. No poses: all are NaN.

    Camera: `camera.toml`, else `camera-intrinsics.txt` (3x3), else `calibration.txt` (fx fy cx cy) in the folder. The
    layout has no such file of its own; without one, 640x480 images get 525 525 319.5 239.5, which TUM recommends for
    all its sequences because the depth is registered to the colour image with it. Baseline 0.075 m (Kinect v1, Xtion).
    Images are in order of time, of several with one stamp the first counts; stamps are exact to the nanosecond.
    Faults: those of `read_depth_png`. Raises SourceError with file and line for a bad depth.txt.
    """

    layout = "stamped depth images (depth.txt or depth/*.png)"
    depth_scale = 1 / 5000
    baseline = 0.075
    intrinsics = (525.0, 525.0, 319.5, 239.5)

    def __init__(self, where: str | os.PathLike[str]):
        super().__init__(where)
        lines = _listed(self.folder) if os.path.isfile(self.folder / LIST) else _named(self.folder)
        self._images = by_time(lines)
        if len(lines) > len(self._images):
            self.notes = (f"{self.folder}: left out {len(lines) - len(self._images)} images with a stamp used before",)
        if not self._images:
            raise SourceError(f"{self.folder}: {LIST} and {IMAGES}/ name no image; give a folder that has some")
        self._set_camera(self.folder)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a list of depth images or a folder of them."""
        return os.path.isfile(os.path.join(where, LIST)) or os.path.isdir(os.path.join(where, IMAGES))

    def __len__(self) -> int:
        return len(self._images)

    def image(self, i: int) -> tuple[Path, int]:
        """Return the image file of frame `i` and its time in nanoseconds."""
        stamp_ns, name, _ = self._images[i]
        return self.folder / name, stamp_ns

    def pose(self, i: int) -> Transform:
        """Return a (4, 4) of NaN: nothing is known."""
        return np.full((4, 4), np.nan)


class TumRgbd(StampedImages):
    """Stamped images (see `StampedImages`) with `groundtruth.txt`, the poses of the optical frame.

    World: that of groundtruth.txt (TUM's motion capture: z up).
    Pose: between the neighbours before and after the image's time, straight in position, even in turning; both must
    be less than 0.1 s away. Further faults: those of `Poses.at`.
    """

    layout = "a TUM RGB-D folder (depth.txt or depth/*.png, with groundtruth.txt)"

    def __init__(self, where: str | os.PathLike[str]):
        self._trajectory = Trajectory(Path(where) / POSES)
        super().__init__(where)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder that has poses, and a list of depth images or a folder of them."""
        return super().recognises(where) and os.path.isfile(os.path.join(where, POSES))

    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) at the image's time; raises FrameRefused `no_pose` or `bad_pose_file`."""
        return self._trajectory.at(self._images[i][0])


def _listed(folder: Path) -> list[StampedLine]:
    lines = stamped_lines(folder / LIST)
    for _, name, where in lines:
        if not name:
            raise SourceError(f"{where}: needs 'stamp file'; correct or delete the line")
        inside(name, where)
    return lines


def _named(folder: Path) -> list[StampedLine]:
    images = [f"{IMAGES}/{name}" for name in sorted(file_names(folder / IMAGES)) if name.endswith(".png")]
    return [(_stamp(folder / image), image, image) for image in images]


def _stamp(path: Path) -> int:
    try:
        return ns_from_seconds(path.stem)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; name images by their time or list them in {LIST}") from None
