# SPDX-License-Identifier: Apache-2.0
"""Correct the history of a map after the poses of its frames were corrected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from stereovox.geometry.se3 import Transform, inverse
from stereovox.maps.record.camera_path import CameraPath, StampedPose
from stereovox.maps.record.history import History


def correct_history(
    history: History, before: Sequence[tuple[str, StampedPose]], after: Sequence[tuple[str, StampedPose]]
) -> None:
    """Give a history the corrected poses, so that the next frames are compared with them.

    Waits and doubts of a sensor's frames referred to the old map: they are cleared. So are the lines of loops, for
    their places have moved.

    before, after: sensor and pose of the frames, in the order in which they entered the map.
    """
    history.path, history.loops = CameraPath(), None
    for sensor, seen in after:
        history.path.walk(sensor, seen)
    last = {sensor: (old, new) for (sensor, old), (_, new) in zip(before, after, strict=True)}
    for sensor, (old, new) in last.items():
        if new != old:
            _correct_sensor(history, sensor, old, new)


def matrix_of(seen: StampedPose) -> Transform:
    """Return T_world_sensor (4, 4)."""
    return np.array([*seen.pose, 0, 0, 0, 1], float).reshape(4, 4)


def _correct_sensor(history: History, sensor: str, old: StampedPose, new: StampedPose) -> None:
    """Move the poses remembered for a sensor as its last frame was moved."""
    T_new_old = matrix_of(new) @ inverse(matrix_of(old))
    history.waiting.pop(sensor, None)
    history.doubts.pop(sensor, None)
    history.glances.pop(sensor, None)
    if (look := history.looks.get(sensor)) is not None:
        history.looks[sensor] = look._replace(pose=_moved(look.pose, T_new_old))
    if (trusted := history.trusted.get(sensor)) is not None:  # a merged map has no trusted frame yet
        later = trusted._replace(pose=_moved(trusted.pose, T_new_old))
        history.trusted[sensor] = new if trusted == old else later


def _moved(pose: tuple[float, ...], T_new_old: Transform) -> tuple[float, ...]:
    return tuple((T_new_old @ matrix_of(StampedPose(0, pose))).ravel().tolist()[:12])
