# SPDX-License-Identifier: Apache-2.0
"""Depth images laid onto the surfaces that the ones before have seen."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth import DepthPipeline
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Frame
from stereovox.integrate.views import PerCamera
from stereovox.se3 import Transform
from stereovox.sensors.noise import RangeNoise
from stereovox.track.fit import LOST, Fit, Limits, Stage, both, contrary, deviations, holding, settled
from stereovox.track.photos import Beside, Photos, Sighted, sighted_or_why
from stereovox.track.surfels import CONVERGED, Patches, SurfelMap, patches_of
from stereovox.track.views import View, contradiction, is_new, stood_free, unlike, view_of

BIAS = 3.0
"""Errors of a real camera's depth that patches do not average out, in standard deviations of one pixel."""
FLOOR_M = 0.002
ROWS_PER_METRE, FARTHEST_M = 20.0, 100.0
"""Of the table of standard deviations."""
MIN_PATCHES = 150
"""Patches with a surface that an image needs."""
VIEW_M, VIEW_RAD, VIEWS = 0.3, np.radians(15), 1000
"""Views this far apart are kept, to find the way back from; so many, the latest."""
TRIED = 6
"""Kept views that are tried when lost: those that look most like the image."""
SEARCH = np.full(6, 0.4)
"""Radians and metres around them in which the pose is sought."""
LOOKED_THROUGH = 0.05
"""Share of what is seen again that may lie where other views looked through: something that moved, not a wall."""
CLOSE, QUIETEST = 2.0, 0.01
"""Where a pose is expected with less than so many times the usual variance, most of an image lies where it should; what
is far beyond the residuals of that moves, down to this variance of theirs, by what is expected of the camera."""
LENIENT = 1.5
"""How many times the share of landmarks counts that are where they should be: pictures are seldom taken at the very
moment of the depth, nor all their rows at once."""
STRONG = 40
"""Landmarks of an image that agree with each other and count against depth that says something else."""
KEPT_M, CHECKED = 15.0, 100
"""Surfels farther than this along an axis are forgotten, looked for every so many images."""


class Seen(NamedTuple):
    """What of a frame is used: patches of its depth image, and the image that was taken along, if it can be used.

    why: why that image cannot be used, as that of `sighted_or_why`.
    """

    patches: Patches
    sighted: Sighted | None
    why: str | None


class Surfaces:
    """Evidence of a depth camera: patches of its images, point to plane on surfels (see `SurfelMap`).

    Args:
        config: Depth, noise and range are prepared as for a map.
    """

    limits = Limits(
        spread=np.array([0.08, 0.08, 0.08, 0.06, 0.06, 0.06]),
        unsure=(np.radians(1), 0.02),
        adrift=(np.radians(10), 0.3),
    )

    def __init__(self, config: Config):
        self._config, self._depth = config, DepthPipeline(config)
        self._sigma: PerCamera[VirtualCamera, NDArray[np.float64]] = PerCamera(self._sigma_of)
        self._map, self._views, self._learned = SurfelMap(), list[View](), 0
        self._photos = Photos()

    def see(self, frame: AnyFrame) -> Seen:
        """Return what of a frame is used; raises FrameRefused, also where too few patches lie on surfaces."""
        image = self._depth.image(self._depth.matched(replace(frame, T_world_sensor=np.eye(4))))
        sigma_of = self._sigma[image.camera]
        patches = patches_of(image, sigma_of, ROWS_PER_METRE)
        if len(patches.points) < MIN_PATCHES:
            words = f"only {len(patches.points)} patches of the image lie on surfaces, {MIN_PATCHES} are needed"
            raise FrameRefused(LOST, words)
        photo = frame.photo if isinstance(frame, Frame) else None
        return Seen(patches, *sighted_or_why(photo, image, sigma_of, ROWS_PER_METRE))

    def count(self, seen: Seen) -> None:
        """Take note of an image whose pose is asked for."""
        self._photos.count(seen.why)

    def _sigma_of(self, camera: VirtualCamera) -> NDArray[np.float64]:
        depths = np.arange(round(FARTHEST_M * ROWS_PER_METRE)) / ROWS_PER_METRE
        return FLOOR_M + BIAS * RangeNoise.of(self._config.noise, camera).sigma(depths)

    def picture_use(self) -> str:
        """Return what was made of the pictures beside depth images so far, in words; "" where there are none."""
        return self._photos.picture_use()

    def forget(self) -> None:
        """Forget all that was learned."""
        self._map, self._views, self._learned = SurfelMap(), [], 0
        self._photos.forget()

    def fit(self, seen: Seen, expected: Transform, doubt: NDArray[np.float64]) -> Fit:
        """Return the pose that lays an image onto the surfels, near the expected one; `doubt` as in `settled`.

        The landmarks of an image that was taken along hold it as well.
        """
        close = doubt[3:, 3:].trace() < CLOSE * float(np.sum(self.limits.spread[3:] ** 2))
        patches = self._lasting(seen.patches, expected)
        beside = self._photos.follow(seen.sighted, expected, self._views)
        return self._fit(patches, beside, expected, doubt, QUIETEST if close else 1.0)

    def _fit(
        self, patches: Patches, beside: Beside | None, expected: Transform, doubt: NDArray[np.float64], quietest: float
    ) -> Fit:
        """Return how patches, and landmarks beside them, fit."""
        levels = self._map.levels(patches, quietest)
        stages = [Stage(level, CONVERGED * level.size) for level in levels]
        T, covariance = settled(stages, expected, doubt)
        alone = Fit(T, covariance, levels[-1].known, levels[-1].usual)
        seen = None if beside is None else beside.fit(expected, doubt)
        if beside is None or seen is None:
            return alone
        turn, shift = deviations(covariance)
        held = turn < self.limits.unsure[0] and shift < self.limits.unsure[1]
        apart = contrary(T, seen.T_map_camera, covariance + seen.covariance)
        moved = not contrary(T, seen.T_map_camera, covariance + seen.covariance + beside.lag)
        if held and apart and (moved or len(beside.found) < STRONG or not self._photos.trusted()):
            return alone
        together = [Stage(both(holding(level, doubt), beside.equations()), CONVERGED * level.size) for level in levels]
        if held and apart:
            T, covariance = settled(together, expected, doubt, seen.T_map_camera)
        elif held:
            self._photos.agree(T)
            T, covariance = settled(together[-1:], expected, doubt, T)
        else:  # the landmarks are right to a part of the finest surfels; coarse ones could only contradict them
            T, covariance = settled(together[-1:], expected, doubt, seen.T_map_camera)
        return Fit(T, covariance, levels[-1].known, min(levels[-1].usual, LENIENT * beside.usual(T)))

    def _lasting(self, patches: Patches, T: Transform) -> Patches:
        """Return the patches of an image at T_map_camera that do not stand where views saw free space: people walk."""
        there = ~stood_free(patches.points, patches.sigma, T, self._views)
        return Patches(*(np.ascontiguousarray(part[there]) for part in patches))

    def advance(self, seen: Seen, T: Transform) -> None:
        """Follow the corners of an image that was taken along; nothing follows depth that is not learned from."""
        self._photos.advance(seen.sighted, T)

    def learn(self, seen: Seen, T: Transform) -> None:
        """Add an image that is believed to be at T_map_camera."""
        self._photos.learn(seen.sighted, T)
        patches = seen.patches
        self._map.add(self._lasting(patches, T), T)
        if is_new([view.T for view in self._views], T, VIEW_M, VIEW_RAD):
            self._views = [*self._views[1 - VIEWS :], view_of(patches.points, patches.sigma, T)]
        self._learned += 1
        if self._learned % CHECKED == 0:
            self._map.forget(T[:3, 3], KEPT_M)
            self._views = [view for view in self._views if np.abs(view.T[:3, 3] - T[:3, 3]).max() < KEPT_M]

    def seek(self, seen: Seen, last: Transform) -> list[Fit]:
        """Return how an image fits at the last pose and near the kept views that look most like it."""
        here = view_of(seen.patches.points, seen.patches.sigma, last)
        alike = sorted(self._views, key=lambda view: unlike(view, here))
        common = self._photos.seek(seen.sighted)
        starts = [(last, None), *((view.T, None) for view in alike[:TRIED]), *common]
        doubt = np.diag(SEARCH**2)
        fits = [self._fit(seen.patches, beside, T, doubt, 1.0) for T, beside in starts]
        agreed = next((beside for T, beside in common if beside.fit(T, doubt)), None)
        if agreed is None:
            return fits
        return [fit._replace(usual=min(fit.usual, LENIENT * agreed.usual(fit.T_map_camera))) for fit in fits]

    def contradicted(self, seen: Seen, T: Transform) -> str:
        """Return what speaks against an image having been taken from T_map_camera, "" where nothing does."""
        patches = seen.patches
        share, number = contradiction(view_of(patches.points, patches.sigma, T), self._views)
        if number < MIN_PATCHES:
            return f"only {number} places of it were seen before, {MIN_PATCHES} are needed"
        return f"{share:.0%} of it lies where other views looked through" if share > LOOKED_THROUGH else ""
