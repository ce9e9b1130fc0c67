# SPDX-License-Identifier: Apache-2.0
"""Annotated boxes of KITTI tracking (`label_02/0000.txt`)."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereovox.errors import SourceError
from stereovox.geometry import Transform
from stereovox.sources.lidar import Box
from stereovox.untrusted import MOST_LIST, read_text

FIELDS = 17
"""frame, track, kind, truncated, occluded, alpha, 4 of the 2-D box, h, w, l, x, y, z, rotation_y; perhaps a score."""
NO_BOX = "DontCare"
"""Marks a region of the image in which nothing is annotated; it has no 3-D box."""
Label = tuple[int, str, tuple[float, ...]]


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

    KITTI's position is the middle of the box's bottom, y points down, and rotation_y turns about y: at 0 the object
    faces along camera x, at -90 degrees along the optical axis.
    """
    c, s = math.cos(rotation_y), math.sin(rotation_y)
    return np.array([[c, s, 0, x], [0, 0, -1, y - h / 2], [-s, c, 0, z], [0, 0, 0, 1.0]])


def read_labels(path: Path) -> Labels:
    """Return the annotated objects; raises SourceError, one line with file and line, for what cannot be read."""
    try:
        lines = read_text(path, MOST_LIST, "replace").splitlines()
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
