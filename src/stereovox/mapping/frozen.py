# SPDX-License-Identifier: Apache-2.0
"""Find a frame that repeats its sensor's view from another pose: it is frozen, whatever noise each image has.

Things in the world stay in place as the sensor moves; the contents of a frozen image move with the sensor. So a frame
is compared with earlier glances from other poses: which of their points are unmoved in the sensor, and in the world?
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import AnyImage, CheckedCloud
from stereovox.geometry.se3 import Transform, apart
from stereovox.integrate.views import PerCamera, camera_rays
from stereovox.maps.record._glance import SAME, SIDE, UNSEEN, bin_image, place
from stereovox.maps.record.glance import AT_REST, Glance, binned, marks_of
from stereovox.maps.record.history import MAX_GLANCES, StampedPose
from stereovox.sensors.noise import RangeNoise

SAMPLED = 4000
"""Most points of a frame that are compared."""
FARTHEST = 10
"""Points farther than this many times `max_range` do not count: a lidar may report any distance."""
BLUR = 1.5
"""Tolerance between two frames, as a multiple of the noise of one: both are noisy."""
STEP, TURN = 0.1, np.radians(8)
"""A glance is kept once the sensor has moved by this share of the median distance in view, or turned by this angle."""
NEAR, NEAR_TURN = 0.3, 0.4
"""Glances are compared up to this motion: from farther away, many points are unmoved by chance."""
HASTE = 4
"""Times the speed before that a step must have to be a jump of the pose."""
POSE_ERROR_M = 0.1
"""Error of poses that is no motion."""
REPEATED = 0.75
"""Least share of a glance's points that are unmoved in the sensor: wrong depths move them, a frozen image does not."""
FEW, TIMES = 20, 1.5
"""A frame is frozen if this many points are unmoved in the sensor alone, and this many times more than in the world."""


class FrozenViews:
    """Compares frames with recent glances of the same sensor."""

    def __init__(self, config: Config):
        self._reach, self._least = FARTHEST * config.max_range, max(config.voxel_size, POSE_ERROR_M)
        self._noise = PerCamera(partial(RangeNoise.of, config.noise))

    def ranges(self, image: AnyImage) -> NDArray[np.float32]:
        """Return the range in each direction, (SIDE, SIDE) metres, 0 for none."""
        if isinstance(image, CheckedCloud):
            points = image.ends[:: max(1, -(-len(image.ends) // SAMPLED))]
            points = points[image.hits[:: max(1, -(-len(image.ends) // SAMPLED))]]
            with np.errstate(over="ignore"):
                return binned(points[np.einsum("ni,ni->n", points, points) <= self._reach**2])
        ranges = np.zeros((SIDE, SIDE), np.float32)
        step = max(1, round((image.depth_m.size / SAMPLED) ** 0.5))
        bin_image(image.depth_m, *camera_rays(image.camera), step // 2, step, np.float32(self._reach), ranges)
        return ranges

    def unmoved(
        self, glances: tuple[Glance, ...], camera: VirtualCamera | Lidar, T: Transform, ranges: NDArray[np.float32]
    ) -> tuple[int, int]:
        """Return how many points of `glances` are unmoved in the sensor alone, and in the world alone.

        T: T_world_sensor (4, 4) of the frame. ranges: its ranges, (SIDE, SIDE) metres.
        """
        in_sensor = in_world = 0
        for glance in glances:
            metres, angle = apart(glance.pose, tuple(T[:3].ravel().tolist()))
            if metres >= NEAR * glance.typical_m or angle >= NEAR_TURN:
                continue
            marks = marks_of(glance)
            moved = self._placed(ranges, camera, (marks.world - T[:3, 3]) @ T[:3, :3])
            fixed = self._placed(ranges, camera, marks.sensor)
            if np.count_nonzero(fixed == SAME) >= REPEATED * np.count_nonzero(fixed != UNSEEN):
                in_sensor += int(np.count_nonzero((moved != UNSEEN) & (moved != SAME) & (fixed == SAME)))
                in_world += int(np.count_nonzero((moved == SAME) & (fixed != SAME)))
        return in_sensor, in_world

    def _placed(
        self, ranges: NDArray[np.float32], camera: VirtualCamera | Lidar, points: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """Return where points (N, 3) in the sensor's frame are among its ranges, as `place`."""
        distances = np.sqrt(np.einsum("ni,ni->n", points, points))
        tolerance = BLUR * np.maximum(self._least, self._noise[camera].sigma(distances))
        found = np.empty(len(points), np.uint8)
        place(ranges, points.astype(np.float32), AT_REST, tolerance.astype(np.float32), found)
        return found


def is_frozen(in_sensor: int, in_world: int) -> bool:
    """Return whether these numbers of unmoved points show a frozen image."""
    return in_sensor >= FEW and in_sensor > TIMES * in_world


def jumped(glances: tuple[Glance, ...], before: StampedPose, now: StampedPose) -> bool:
    """Return whether the pose jumped after `before`, as a tracker does that corrects itself: the image did not move.

    Its step is large, and HASTE times faster than the sensor moved from the last glance to `before`.
    """
    earlier = [glance for glance in glances if glance.stamp_ns < before.stamp_ns]
    if not earlier or now.stamp_ns <= before.stamp_ns:
        return False
    last = earlier[-1]
    share = (now.stamp_ns - before.stamp_ns) / (before.stamp_ns - last.stamp_ns)
    least = STEP / 2 * last.typical_m, TURN / 2
    steps = zip(apart(before.pose, now.pose), apart(last.pose, before.pose), least, strict=True)
    return any(step >= large and step > HASTE * share * usual for step, usual, large in steps)


def with_glance(glances: tuple[Glance, ...], now: StampedPose, ranges: NDArray[np.float32]) -> tuple[Glance, ...]:
    """Return the glances to keep after a frame: its own is added if it was taken elsewhere than the last one."""
    if glances:
        metres, angle = apart(glances[-1].pose, now.pose)
        if metres < STEP * glances[-1].typical_m and angle < TURN:
            return glances
    return (*glances, Glance.of(ranges, now.pose, now.stamp_ns))[-MAX_GLANCES:]
