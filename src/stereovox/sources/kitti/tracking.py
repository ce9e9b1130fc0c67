# SPDX-License-Identifier: Apache-2.0
"""Sequences of KITTI's object tracking data."""

from __future__ import annotations

import math
import os
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.geometry.se3 import Transform
from stereovox.sources.kitti.base import KittiSource, numbers_in
from stereovox.sources.kitti.calibration import KittiCalibration, read_calibration
from stereovox.sources.kitti.poses import FramePoses, read_named_poses, read_oxts_file
from stereovox.sources.lidar import Box
from stereovox.sources.parameters import file_of
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig_options import POSES, folder_and_options

FIELDS = 17
"""frame, track, kind, truncated, occluded, alpha, 4 of the 2-D box, h, w, l, x, y, z, rotation_y; perhaps a score."""
NO_BOX = "DontCare"
"""Marks an image region without annotations; it has no 3-D box."""
Label = tuple[int, str, tuple[float, ...]]
IMAGE = re.compile(r"(\d{6})\.png")
SEQUENCE = re.compile(r"(\d{4})")
LEFT, RIGHT, OXTS = "image_02", "image_03", "oxts"
FPS, SECOND_NS = 10.0, 1_000_000_000


class KittiTracking(KittiSource):
    """One sequence: `training/image_02/0000/000000.png`, image_03, velodyne, oxts, calib, label_02.

    where: `training/image_02/0000`, or `training?sequence=0000`; further options:
            poses: a file of T_world_cam0 of any form (see `rgbd.pose_files`) instead of `oxts/0000.txt`. axes: of the
                posed camera, `optical` (default), `opengl` or `ros`. invert: 1 for world to camera.
            fps: frames a second.
        Time: the files have none; frame number / 10 Hz, or `fps`. Colour images; label boxes are in rectified camera 0.
        World and faults: see `KittiSource`. Raises SourceError if a whole part is missing, and for bad labels.
    """

    layout = "a KITTI tracking sequence (training?sequence=0000 with image_02/0000 and calib/0000.txt)"

    def __init__(self, where: str | os.PathLike[str]):
        folder, options = folder_and_options(where, {"sequence": "", "fps": FPS, **POSES})
        self.folder, self.sequence = _sequence(folder, options["sequence"])
        self.name, self.eyes = f"kitti_tracking_{self.sequence}", (2, 3)
        self.calibration: KittiCalibration = read_calibration(self._file("calib"))
        numbers = numbers_in(self.folder / LEFT / self.sequence, IMAGE)
        if not numbers:
            raise SourceError(f"{self.folder / LEFT / self.sequence}: no 000000.png in it; give a folder with images")
        self._frames, self._fps = int(numbers[-1]) + 1, options["fps"]
        self.camera = self.calibration.camera(*self.eyes, self._size())
        self.poses = self._poses(options["poses"], options["axes"], options["invert"])
        self._labels = self._read_labels()

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder of sequences as in KITTI tracking, or the left images of one."""
        folder = Path(os.path.abspath(folder_part(where)))  # unlike resolve(), it accepts any text
        if folder.parent.name == LEFT:
            return os.path.isdir(folder) and os.path.isdir(folder.parents[1] / "calib")
        return os.path.isdir(folder / LEFT) and os.path.isdir(folder / "calib")

    def __len__(self) -> int:
        return self._frames

    def images(self, i: int) -> tuple[Path, Path]:
        """Return the left and right image files of frame `i`."""
        left, right = (self.folder / eye / self.sequence / f"{i:06d}.png" for eye in (LEFT, RIGHT))
        return left, right

    def stamp_ns(self, i: int) -> int:
        """Return the time of frame `i` in nanoseconds after the first."""
        return int(i * SECOND_NS / self._fps)

    def velodyne(self, i: int) -> Path:
        """Return the scan file of frame `i`."""
        return self.folder / "velodyne" / self.sequence / f"{i:06d}.bin"

    def boxes(self, i: int) -> tuple[Box, ...]:
        """Return the annotated objects of frame `i`; raises FrameRefused if there is no pose."""
        i = range(len(self))[i]
        return self._labels.boxes(i, self.poses.at(i))

    def _file(self, kind: str) -> Path:
        return self.folder / kind / f"{self.sequence}.txt"

    def _poses(self, choice: str, axes: str, inverted: bool) -> FramePoses:
        if choice and choice != OXTS:
            stamps = [self.stamp_ns(i) for i in range(len(self))]
            return read_named_poses(file_of(choice, self.folder), stamps, axes, inverted)
        c = self.calibration
        if c.T_cam0_velo is None or c.T_velo_imu is None:
            missing = "R_rect and Tr_velo_cam" if c.T_cam0_velo is None else "Tr_imu_velo"
            raise SourceError(f"{c.where}: has no {missing}, poses from oxts need it; put the original file back")
        return read_oxts_file(self._file(OXTS), len(self), c.T_cam0_velo @ c.T_velo_imu)

    def _read_labels(self) -> Labels:
        path = self._file("label_02")
        if os.path.isfile(path):
            return read_labels(path)
        self.notes = (f"{path}: no such file, so objects are not annotated; moving ones stay in the truth",)
        return Labels({})


@dataclass(frozen=True)
class Labels:
    """The annotated objects of a sequence by frame: track, kind, and h, w, l, x, y, z, rotation_y as in the file."""

    by_frame: dict[int, list[Label]]

    def boxes(self, i: int, T_world_cam0: Transform) -> tuple[Box, ...]:
        """Return the boxes of frame `i` in the world; T_world_cam0: pose of rectified camera 0 at that frame."""
        return tuple(
            Box(T_world_cam0 @ box_pose(*numbers), (numbers[2], numbers[1], numbers[0]), kind, track)
            for track, kind, numbers in self.by_frame.get(i, [])
        )


def box_pose(h: float, w: float, l: float, x: float, y: float, z: float, rotation_y: float) -> Transform:  # noqa: E741
    """Return T_cam0_box (4, 4): from the frame of `Box` into rectified camera 0.

    KITTI's position is the centre of the box's bottom, y points down, and rotation_y turns about y: at 0 the object
    faces along camera x, at -90 degrees along the optical axis.
    """
    c, s = math.cos(rotation_y), math.sin(rotation_y)
    return np.array([[c, s, 0, x], [0, 0, -1, y - h / 2], [-s, c, 0, z], [0, 0, 0, 1.0]])


def read_labels(path: Path) -> Labels:
    """Return the annotated objects; raises SourceError with file and line if one cannot be read."""
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    found: dict[int, list[Label]] = defaultdict(list)
    for n, line in enumerate(lines, 1):
        words = line.split()
        if words and (len(words) < 3 or words[2] != NO_BOX):
            frame, label = _label(words, f"{path}:{n}")
            found[frame].append(label)
    return Labels(dict(found))


def _label(words: list[str], where: str) -> tuple[int, Label]:
    try:
        frame, track, kind, *rest = words
        numbers = tuple(float(word) for word in rest)
        label = int(track), kind, numbers[7:14]
        good = len(numbers) >= FIELDS - 3 and all(map(math.isfinite, numbers[7:14])) and min(numbers[7:10]) > 0
        if good:
            return int(frame), label
    except ValueError:
        pass
    raise SourceError(f"{where}: needs {FIELDS} fields 'frame track kind ... h w l x y z rotation_y'; correct the line")


def _sequence(folder: Path, choice: str) -> tuple[Path, str]:
    """Return the folder of all sequences, and the number of the selected one."""
    whole = Path(os.path.abspath(folder))
    if whole.parent.name == LEFT:
        if choice:
            raise SourceError(f"{folder}: is already a sequence; leave sequence={choice} out")
        return whole.parents[1], whole.name
    known = numbers_in(folder / LEFT, SEQUENCE)
    if not choice and len(known) == 1:
        return folder, known[0]
    if choice not in known:
        found = f"holds sequences {', '.join(known)}" if known else f"has no sequence in {LEFT}"
        raise SourceError(f"{folder}: {found}; choose one: {folder}?sequence={known[0] if known else '0000'}")
    return folder, choice
