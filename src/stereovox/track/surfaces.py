# SPDX-License-Identifier: Apache-2.0
"""Registration of depth images to surfaces seen earlier."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Frame
from stereovox.geometry.se3 import Transform
from stereovox.integrate.views import PerCamera
from stereovox.sensors.noise import RangeNoise
from stereovox.track.color_images import PhotoLandmarks, Photos, Sighted, sighted_or_why
from stereovox.track.fit import (
    LOST,
    Fit,
    Limits,
    Stage,
    both,
    contrary,
    deviations,
    holding,
    motion_between,
    solve_stages,
)
from stereovox.track.surfels import CONVERGED, Elders, Patches, SurfelMap, beside_planes, patches_of
from stereovox.track.views import (
    View,
    contradiction,
    far_apart,
    is_new,
    passed_through,
    stood_free,
    turned,
    unlike,
    view_of,
    with_edges,
)

BIAS = 3.0
"""Depth errors of a real camera that patches do not average out, in standard deviations of one pixel."""
FLOOR_M = 0.002
ROWS_PER_METRE, FARTHEST_M = 20.0, 100.0
"""Resolution and range of the table of standard deviations."""
MIN_PATCHES = 150
"""Fewest patches on surfaces that an image needs."""
VIEW_M, VIEW_RAD, VIEWS = 0.3, np.radians(15), 1000
"""Least distance between kept views, used for relocalization; only the latest are kept, this many."""
TRIED = 6
"""Number of kept views tried when lost: those most similar to the image."""
DETAILS = 2
"""Index of the cell size at which distinctive surfaces are checked."""
ASIDE = np.radians([0, -25, 25, -50, 50])
"""Yaw angles tried around the last pose when relocalizing; the first two also around the most similar views."""
ROUGHLY, ROUGH, CLOSELY, THROUGH = 2, 0.05, 4, 4.0
"""For relocalization: one of this many patches is used for coarse fits, which end at a step below this share of a cell;
this many distinct poses are then refined; the share of them that looks through
surfaces counts this many times against them."""
SAME_M, SAME_RAD = 0.1, np.radians(5)
SEARCH = np.full(6, 0.4)
"""Search region around those poses, in radians and metres."""
LOOKED_THROUGH = 0.03
"""Largest share of re-observed places where other views saw free space: moved objects, not walls."""
STIR = 0.01
"""Share of an image in earlier free space above which its neighbourhood is taken as moving too."""
DISTURBED, CHECKED_BY, EVERY = 0.03, 3, 4
"""Share of a view in conflict with free space at which something moves or the pose is wrong; checked in this many of
the nearest views, at one of this many of their points."""
ELDERS_RAD, ELDERS_M = np.radians(1.5), 0.03
"""Largest standard deviations of a pose that older surfels constrain by themselves."""
ELDERS_OFF = np.diag(np.repeat([np.radians(0.3), 0.01], 3) ** 2)
"""Covariance added to that of a pose by older surfels."""
AGREE, APART = 16.0, 100.0
"""Largest squared deviations, of six, of that pose while much moves, and while little moves."""
CLOSE, QUIETEST = 2.0, 0.01
"""If a pose is expected with less than this many times the usual variance, most of an image fits. Residuals far beyond
the others are then taken as motion, down to this share of the camera's expected variance."""
LENIENT = 1.5
"""Factor on the share of inlier landmarks: color images are seldom taken at the very moment of the depth, nor all their
rows at once."""
STRONG = 40
"""Fewest landmarks that, in agreement with each other, overrule depth."""
KEPT_M, CHECKED = 15.0, 100
"""Surfels farther than this along an axis are dropped, once every this many images."""


class Seen(NamedTuple):
    """The used parts of a frame: patches of its depth image, and its color image, if usable.

    why: why that image is unusable, as in `sighted_or_why`.
    """

    patches: Patches
    sighted: Sighted | None
    why: str | None


class Surfaces:
    """Evidence of a depth camera: point-to-plane registration of patches to surfels (see `SurfelMap`).

    Args:
        config: Depth, noise and range are prepared as for a map.
    """

    limits = Limits(
        spread=np.array([0.08, 0.08, 0.08, 0.06, 0.06, 0.06]),
        unsure=(np.radians(1), 0.02),
        adrift=(np.radians(10), 0.3),
    )

    def __init__(self, config: Config):
        self._config, self._depth = config, DepthPipeline(load_config(config, **{"depth.keep_lines": False}))
        self._sigma: PerCamera[VirtualCamera, NDArray[np.float64]] = PerCamera(self._sigma_of)
        self._map, self._elders, self._views, self._learned = SurfelMap(), Elders(), list[View](), 0
        self._photos, self._free = Photos(), 0.0

    def see(self, frame: AnyFrame) -> Seen:
        """Return the used parts of a frame; raises FrameRefused, also if too few patches lie on surfaces."""
        image = self._depth.image(self._depth.matched(replace(frame, T_world_sensor=np.eye(4))))
        sigma_of = self._sigma[image.camera]
        patches = patches_of(image, sigma_of, ROWS_PER_METRE)
        if len(patches.points) < MIN_PATCHES:
            words = f"only {len(patches.points)} patches of the image lie on surfaces, {MIN_PATCHES} are needed"
            raise FrameRefused(LOST, words)
        photo = frame.photo if isinstance(frame, Frame) else None
        return Seen(patches, *sighted_or_why(photo, image, sigma_of, ROWS_PER_METRE))

    def count(self, seen: Seen) -> None:
        """Count an image whose pose is requested."""
        self._photos.count(seen.why)

    def _sigma_of(self, camera: VirtualCamera) -> NDArray[np.float64]:
        depths = np.arange(round(FARTHEST_M * ROWS_PER_METRE)) / ROWS_PER_METRE
        return FLOOR_M + BIAS * RangeNoise.of(self._config.noise, camera).sigma(depths)

    def picture_use(self) -> str:
        """Return how the color images were used so far, in words; "" if there are none."""
        return self._photos.picture_use()

    def forget(self) -> None:
        """Forget everything learned."""
        self._map, self._elders, self._views, self._learned = SurfelMap(), Elders(), [], 0
        self._photos.forget()

    def fit(self, seen: Seen, expected: Transform, doubt: NDArray[np.float64]) -> Fit:
        """Return the pose that registers an image to the surfels, near the expected one; `doubt` as in `solve_stages`.

        The landmarks of a color image constrain it too.
        """
        close = doubt[3:, 3:].trace() < CLOSE * float(np.sum(self.limits.spread[3:] ** 2))
        patches = self._lasting(seen.patches, expected)
        beside = self._photos.follow(seen.sighted, expected, self._views)
        return self._fit(patches, beside, expected, doubt, QUIETEST if close else 1.0)

    def _fit(
        self,
        patches: Patches,
        beside: PhotoLandmarks | None,
        expected: Transform,
        doubt: NDArray[np.float64],
        quietest: float,
    ) -> Fit:
        """Return how patches, and landmarks next to them, fit."""
        levels = self._map.levels(patches, quietest)
        stages = [Stage(level, CONVERGED * level.size) for level in levels]
        T, covariance = solve_stages(stages, expected, doubt)
        rough, fine = levels[1].known, levels[2].known
        alone = Fit(T, covariance, levels[-1].known, levels[-1].inlier_share, min(fine / max(rough, 1e-6), 1.0))
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
            T, covariance = solve_stages(together, expected, doubt, seen.T_map_camera)
        elif held:
            self._photos.agree(T)
            T, covariance = solve_stages(together[-1:], expected, doubt, T)
        else:  # landmarks are more accurate than the finest surfels; coarse ones could only contradict them
            T, covariance = solve_stages(together[-1:], expected, doubt, seen.T_map_camera)
        return alone._replace(
            T_map_camera=T,
            covariance=covariance,
            inlier_share=min(levels[-1].inlier_share, LENIENT * beside.inlier_share(T)),
        )

    def _lasting(self, patches: Patches, T: Transform) -> Patches:
        """Return the patches of an image at T_map_camera outside the free space of earlier views: people walk."""
        free = stood_free(patches.points, patches.sigma, T, self._views)
        if np.mean(free) > STIR:
            free = with_edges(free, patches.points, T)
        self._free, there = float(np.mean(free)), ~free
        return Patches(*(np.ascontiguousarray(part[there]) for part in patches))

    def advance(self, seen: Seen, T: Transform) -> None:
        """Track the corners of a color image; depth that is not learned has nothing to advance."""
        self._photos.advance(seen.sighted, T)

    def learn(self, seen: Seen, T: Transform) -> None:
        """Add an image with the accepted pose T_map_camera."""
        self._photos.learn(seen.sighted, T)
        lasting = self._lasting(seen.patches, T)
        self._map.add(lasting, T)
        self._elders.add(lasting, T)
        if is_new([view.T for view in self._views], T, VIEW_M, VIEW_RAD):
            self._views = [*self._views[1 - VIEWS :], view_of(lasting.points, lasting.sigma, T)]
        self._learned += 1
        if self._learned % CHECKED == 0:
            self._map.forget(T[:3, 3], KEPT_M)
            self._elders.forget(T[:3, 3], KEPT_M)
            self._views = [view for view in self._views if np.abs(view.T[:3, 3] - T[:3, 3]).max() < KEPT_M]

    def seek(self, seen: Seen, last: Transform) -> list[Fit]:
        """Return how an image fits at the last pose, at turns of it, and near the most similar kept views.

        A coarse registration starts from each of them, and a fine one from the best.
        """
        here = view_of(seen.patches.points, seen.patches.sigma, last)
        alike = [view.T for view in sorted(self._views, key=lambda view: unlike(view, here))[:TRIED]]
        common = self._photos.seek(seen.sighted)
        places = [*turned(last, ASIDE), *alike, *(T for one in alike[:2] for T in turned(one, ASIDE[1:3]))]
        doubt = np.diag(SEARCH**2)
        starts = [(T, None) for T in self._roughly(seen.patches, here, places, doubt)]
        fits = [self._fit(seen.patches, beside, T, doubt, 1.0) for T, beside in (*starts, *common)]
        agreed = next((beside for T, beside in common if beside.fit(T, doubt)), None)
        if agreed is None:
            return fits
        return [
            fit._replace(inlier_share=min(fit.inlier_share, LENIENT * agreed.inlier_share(fit.T_map_camera)))
            for fit in fits
        ]

    def _roughly(
        self, patches: Patches, here: View, places: list[Transform], doubt: NDArray[np.float64]
    ) -> list[Transform]:
        """Return the distinct poses near these places at which an image fits best in large cells and looks through few
        known surfaces.
        """
        found, kept = list[tuple[float, Transform]](), list[Transform]()
        few = patches.thinned(ROUGHLY)
        for place in places:
            levels = self._map.levels(few)[:2]
            T, _ = solve_stages([Stage(level, ROUGH * level.size) for level in levels], place, doubt)
            through = passed_through(here._replace(T=T), self._views, CHECKED_BY, EVERY)
            found.append((levels[1].known * levels[1].inlier_share * max(1 - THROUGH * through, 0.0), T))
        for _, T in sorted(found, key=lambda one: -one[0]):
            if len(kept) < CLOSELY and all(far_apart(T, other, SAME_M, SAME_RAD) for other in kept):
                kept.append(T)
        return kept

    def doubted(self, seen: Seen, fit: Fit) -> str:
        """Return an objection to the pose of a tracked image, "" if there is none.

        If much of the view has changed, something moves or the pose is wrong: then older surfels must support the same
        pose.
        """
        patches, T = self._lasting(seen.patches, fit.T_map_camera), fit.T_map_camera
        here = view_of(seen.patches.points, seen.patches.sigma, T)
        stir = max(self._free, passed_through(here, self._views, CHECKED_BY, EVERY))
        if stir <= STIR:
            return ""
        elder = self._elders.fit(patches, T)
        turn, shift = deviations(elder.covariance)
        off = motion_between(T, elder.T_map_camera)
        squares = float(off @ np.linalg.solve(elder.covariance + ELDERS_OFF, off))
        held = turn < ELDERS_RAD and shift < ELDERS_M
        if held and squares > (AGREE if stir > DISTURBED else APART):
            words = f"{np.linalg.norm(off[3:]):.2f} m and {np.degrees(np.linalg.norm(off[:3])):.1f} degrees"
            return f"what was seen longer ago lies {words} elsewhere"
        return "" if held or stir <= DISTURBED else f"{stir:.0%} of the view moves, and the rest does not hold the pose"

    def ambiguous(self, seen: Seen, T: Transform, known: float) -> str:
        """Return why an image may be from another place that resembles T_map_camera, "" if it is not.

        Any two room corners match, so this share must be known of the parts outside the largest planes.
        """
        details = beside_planes(seen.patches)
        if len(details.points) < MIN_PATCHES:
            return "all of it lies on a few planes, such as any corner of a room"
        level = self._map.levels(details)[DETAILS]
        level(T)
        few = level.known < known
        return f"{level.known:.0%} of what is not on its largest planes is known, {known:.0%} is needed" if few else ""

    def contradicted(self, seen: Seen, T: Transform) -> str:
        """Return an objection to an image having been taken from T_map_camera, "" if there is none."""
        patches = seen.patches
        share, number = contradiction(view_of(patches.points, patches.sigma, T), self._views)
        if number < MIN_PATCHES:
            return f"only {number} places of it were seen before, {MIN_PATCHES} are needed"
        return f"{share:.0%} of it lies where other views looked through" if share > LOOKED_THROUGH else ""
