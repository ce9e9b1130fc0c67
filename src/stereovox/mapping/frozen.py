# SPDX-License-Identifier: Apache-2.0
"""Find a frame that repeats its sensor's view from another pose: it is frozen, whatever noise each image has.

Things in the world stay in place as the sensor moves; the contents of a frozen image move with the sensor. So a frame
is compared with earlier glances from other poses: which of their points are unmoved in the sensor, and in the world?
"""

from __future__ import annotations

from functools import partial
from math import radians

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import AnyImage, CheckedCloud
from stereovox.geometry.se3 import Transform, apart
from stereovox.integrate.views import PerCamera, camera_rays
from stereovox.maps.record._glance import ELSEWHERE, SAME, SIDE, bin_image, place
from stereovox.maps.record.glance import AT_REST, Glance, binned, marks_of
from stereovox.maps.record.history import MAX_GLANCES, MAX_SENSORS, StampedPose
from stereovox.sensors.noise import RangeNoise

SAMPLED = 4000
"""Most points of a frame that are compared."""
FARTHEST = 10
"""Points farther than this many times `max_range` do not count: a lidar may report any distance."""
BLUR = 1.5
"""Tolerance between two frames, as a multiple of the noise of one: both are noisy."""
STEP, TURN = 0.1, radians(8)
"""A glance is kept once the sensor has moved by this share of the median distance in view, or turned by this angle."""
CHECKED = 4
"""How often frames are compared within such a step; those between two comparisons have hardly moved."""
LEAST_M = 0.01
"""Least median distance: nothing is nearer."""
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
        self._tolerances: dict[Glance, NDArray[np.float32]] = {}

    def ranges(self, image: AnyImage) -> NDArray[np.float32]:
        """Return the range in each direction, (SIDE, SIDE) metres, 0 for none."""
        if isinstance(image, CheckedCloud):
            some = slice(None, None, max(1, -(-len(image.ends) // SAMPLED)))
            points = image.ends[some][image.hits[some]]
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
        pose, into = tuple(T[:3].ravel().tolist()), _turned_back(T)
        for glance in glances:
            metres, angle = apart(glance.pose, pose)
            share = metres / max(glance.typical_m, LEAST_M)
            if share >= NEAR or angle >= NEAR_TURN or (share < STEP / 2 and angle < TURN / 2):
                continue
            marks, tolerance = marks_of(glance), self._tolerance(glance, camera)
            fixed, moved = np.empty((2, len(tolerance)), np.uint8)
            place(ranges, marks.sensor, AT_REST, tolerance, fixed)
            if np.count_nonzero(fixed == SAME) >= REPEATED * np.count_nonzero(fixed):
                place(ranges, (marks.world - T[:3, 3]).astype(np.float32), into, tolerance, moved)
                in_sensor += int(np.count_nonzero((moved == ELSEWHERE) & (fixed == SAME)))
                in_world += int(np.count_nonzero((moved == SAME) & (fixed != SAME)))
        return in_sensor, in_world

    def warm_up(self, glance: Glance, camera: VirtualCamera | Lidar, ranges: NDArray[np.float32]) -> None:
        """Compile with the first frame what later ones need."""
        tolerance = self._tolerance(glance, camera)
        place(ranges, marks_of(glance).sensor, AT_REST, tolerance, np.empty(len(tolerance), np.uint8))

    def _tolerance(self, glance: Glance, camera: VirtualCamera | Lidar) -> NDArray[np.float32]:
        """Return by how many metres the ranges of a glance's points may differ, (N,)."""
        if glance not in self._tolerances:
            if len(self._tolerances) >= MAX_GLANCES * MAX_SENSORS:
                self._tolerances.clear()
            sigma = self._noise[camera].sigma(np.linalg.norm(marks_of(glance).sensor, axis=1))
            self._tolerances[glance] = (BLUR * np.maximum(self._least, sigma)).astype(np.float32)
        return self._tolerances[glance]


def _turned_back(T: Transform) -> NDArray[np.float32]:
    """Return the matrix (3, 4) that turns points from the world's axes into the sensor's."""
    turned = np.zeros((3, 4), np.float32)
    turned[:, :3] = T[:3, :3].T
    return turned


def moved_on(glance: Glance, before: tuple[float, ...], now: tuple[float, ...]) -> bool:
    """Return whether the sensor is another CHECKED part of a step away from a glance than it was before."""
    (metres, angle), (metres_now, angle_now) = apart(glance.pose, before), apart(glance.pose, now)
    part_m, part = STEP / CHECKED * max(glance.typical_m, LEAST_M), TURN / CHECKED
    return metres // part_m != metres_now // part_m or angle // part != angle_now // part


def is_frozen(in_sensor: int, in_world: int) -> bool:
    """Return whether these numbers of unmoved points show a frozen image."""
    return in_sensor >= FEW and in_sensor > TIMES * in_world


def jumped(glances: tuple[Glance, ...], before: StampedPose, now: StampedPose) -> bool:
    """Return whether the pose jumped after `before`, as a tracker does that corrects itself: the image did not move.

    Its step is large, and HASTE times faster than the sensor moved from the last glance to `before`.
    """
    last = next((one for one in reversed(glances) if one.stamp_ns < before.stamp_ns), None)
    if last is None or now.stamp_ns <= before.stamp_ns:
        return False
    step_m, step = apart(before.pose, now.pose)
    large_m, large = step_m > STEP / 2 * last.typical_m, step > TURN / 2
    if not (large_m or large):
        return False
    usual_m, usual = apart(last.pose, before.pose)
    haste = HASTE * (now.stamp_ns - before.stamp_ns) / (before.stamp_ns - last.stamp_ns)
    return (large_m and step_m > haste * usual_m) or (large and step > haste * usual)


def with_glance(glances: tuple[Glance, ...], now: StampedPose, ranges: NDArray[np.float32]) -> tuple[Glance, ...]:
    """Return the glances to keep after a frame: its own is added if it was taken elsewhere than the last one."""
    if glances:
        metres, angle = apart(glances[-1].pose, now.pose)
        if metres < STEP * glances[-1].typical_m and angle < TURN:
            return glances
    return (*glances, Glance.of(ranges, now.pose, now.stamp_ns))[-MAX_GLANCES:]
