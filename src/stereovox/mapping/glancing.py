# SPDX-License-Identifier: Apache-2.0
"""Compare each frame with what its sensor saw lately from elsewhere: does it look through what stood there?"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.frame import AnyImage, CheckedCloud
from stereovox.geometry.se3 import Transform, apart
from stereovox.integrate.views import PerCamera, camera_rays
from stereovox.maps.record._glance import NEARER, SAME, SIDE, UNSEEN, bin_image, place
from stereovox.maps.record.glance import AT_REST, Glance, binned, marks_of
from stereovox.maps.record.history import MAX_GLANCES
from stereovox.sensors.noise import RangeNoise

LOOKED = 4000
"""Most points of a frame that are looked at."""
FARTHEST = 10
"""Maximum ranges beyond which points do not count: a lidar may give any number, and the map ends somewhere."""
BLUR = 1.5
"""Tolerance from glance to glance, as a multiple of that towards the map: both are noisy."""
STEP, TURN = 0.1, np.radians(8)
"""A glance is kept once the sensor has moved this share of the distance of what it sees, or turned so far."""
THROUGH = 0.15
"""Share of what was seen before that a frame may look through."""
NEAR, NEAR_TURN = 0.3, 0.4
"""The same, up to which a glance is from near by."""
ENOUGH, FEW = 100, 20
"""Points of the glances that must be in view to say something, and that must be in the sensor alone."""
REPEATED = 0.9
"""Share of the points of a glance that must be unmoved in the sensor for an image to repeat it."""
FROZEN = 1.5
"""How many times more points are unmoved in the sensor than in the world if what it shows is old."""


class Lately(NamedTuple):
    """What glances at what a sensor saw lately say of a frame.

    seen: how many of their points it sees something in the direction of. through: how many it looks through. world,
    sensor: how many stayed in the world alone, or in the sensor alone, as if it had not moved; of glances
    from near by, since from afar many points are somewhere by chance.
    """

    seen: int = 0
    through: int = 0
    world: int = 0
    sensor: int = 0

    @property
    def looks_through(self) -> bool:
        """Whether the frame looks through what was there."""
        return self.seen >= ENOUGH and self.through > THROUGH * self.seen

    @property
    def old(self) -> bool:
        """Whether the frame shows what was seen from elsewhere."""
        return self.sensor >= FEW and self.sensor > FROZEN * self.world

    @property
    def contradicts(self) -> bool:
        """Whether the frame is in doubt."""
        return self.looks_through or self.old


NOTHING_SEEN = Lately()
"""If nothing was seen before."""


class Looker:
    """Looks at frames: what they show, and what earlier glances say of it."""

    def __init__(self, config: Config):
        self._reach, self._least = FARTHEST * config.max_range, config.voxel_size
        self._noise = PerCamera(partial(RangeNoise.of, config.noise))

    def tolerance(self, camera: VirtualCamera | Lidar, metres: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return by how much (N,) distances from the sensor may be off the map."""
        return np.maximum(self._least, self._noise[camera].sigma(metres))

    def ranges(self, image: AnyImage) -> NDArray[np.float32]:
        """Return how far it sees something in each direction (SIDE, SIDE) metres, 0: nothing."""
        if isinstance(image, CheckedCloud):
            some = slice(None, None, max(1, -(-len(image.ends) // LOOKED)))
            points = image.ends[some][image.hits[some]]
            with np.errstate(over="ignore"):
                return binned(points[np.einsum("ni,ni->n", points, points) <= self._reach**2])
        ranges = np.zeros((SIDE, SIDE), np.float32)
        step = max(1, round((image.depth_m.size / LOOKED) ** 0.5))
        bin_image(image.depth_m, *camera_rays(image.camera), step // 2, step, np.float32(self._reach), ranges)
        return ranges

    def lately(
        self, glances: Sequence[Glance], camera: VirtualCamera | Lidar, T: Transform, ranges: NDArray[np.float32]
    ) -> Lately:
        """Return what glances say of a frame that was taken at T_world_sensor and saw `ranges` (SIDE, SIDE)."""
        if not glances:
            return NOTHING_SEEN
        marks = [marks_of(glance) for glance in glances]
        moved = self._found(ranges, camera, (np.concatenate([one.world for one in marks]) - T[:3, 3]) @ T[:3, :3])
        fixed = self._found(ranges, camera, np.concatenate([one.sensor for one in marks]))
        seen, same, stuck = moved != UNSEEN, moved == SAME, fixed == SAME
        near = np.repeat([_is_near(glance, T) for glance in glances], [len(one.world) for one in marks]) & seen
        return Lately(
            *(int(np.count_nonzero(one)) for one in (seen, moved == NEARER, near & same & ~stuck, near & stuck & ~same))
        )

    def repeats(self, glance: Glance | None, image: AnyImage, ranges: NDArray[np.float32]) -> bool:
        """Return whether an image from elsewhere shows what a glance saw: everything is unmoved in the sensor."""
        if glance is None or not _is_elsewhere(glance, image.T_world_sensor):
            return False
        found = self._found(ranges, image.camera, marks_of(glance).sensor)
        seen = np.count_nonzero(found != UNSEEN)
        return bool(seen >= ENOUGH and np.count_nonzero(found == SAME) > REPEATED * seen)

    def _found(
        self, ranges: NDArray[np.float32], camera: VirtualCamera | Lidar, points: NDArray[np.floating]
    ) -> NDArray[np.uint8]:
        """Return where points (N, 3) in the sensor's frame lie among what it sees."""
        tolerance = BLUR * self.tolerance(camera, np.sqrt(np.einsum("ni,ni->n", points, points)))
        found = np.empty(len(points), np.uint8)
        place(ranges, points.astype(np.float32), AT_REST, tolerance.astype(np.float32), found)
        return found


def _is_near(glance: Glance, T: Transform) -> bool:
    metres, angle = apart(glance.pose, tuple(T[:3].ravel().tolist()))
    return metres < NEAR * glance.typical_m and angle < NEAR_TURN


def kept(glances: tuple[Glance, ...], T: Transform, ranges: NDArray[np.float32]) -> tuple[Glance, ...]:
    """Return the glances to keep after a frame: it is added if it was taken elsewhere than the last one."""
    if glances and not _is_elsewhere(glances[-1], T):
        return glances
    return (*glances, Glance.of(ranges, T))[-MAX_GLANCES:]


def _is_elsewhere(glance: Glance, T: Transform) -> bool:
    metres, angle = apart(glance.pose, tuple(T[:3].ravel().tolist()))
    return metres >= STEP * glance.typical_m or angle >= TURN
