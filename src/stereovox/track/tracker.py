# SPDX-License-Identifier: Apache-2.0
"""Depth odometry: the pose of each depth image from the image itself, or the word that it is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config, load_config
from stereovox.depth import DepthPipeline
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame
from stereovox.integrate.views import PerCamera
from stereovox.se3 import Transform, inverse, orthonormalise
from stereovox.sensors.noise import RangeNoise
from stereovox.track.surfels import Fit, Patches, SurfelMap, patches_of
from stereovox.track.views import View, contradiction, far_apart, unlike, view_of

LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of the first image unless another is given: the camera looks along x, level; z is up."""
BIAS = 3.0
"""Errors of a real camera's depth that patches do not average out, in standard deviations of one pixel."""
FLOOR_M = 0.002
ROWS_PER_METRE, FARTHEST_M = 20.0, 100.0
"""Of the table of standard deviations."""
SPREAD = np.array([0.08, 0.08, 0.08, 0.06, 0.06, 0.06])
"""Radians and metres by which a camera may leave its even motion from one image to the next."""
MIN_PATCHES = 150
"""Patches with a surface that an image needs."""
UNSURE_M, UNSURE_RAD = 0.02, np.radians(1)
"""Standard deviations beyond which a pose is not known: nothing in view holds it along some direction."""
VIEW_M, VIEW_RAD = 0.3, np.radians(15)
"""Views this far apart are kept, to find the way back from."""
TRIED = 6
"""Kept views that are tried when lost: those that look most like the image."""
ADRIFT_M, ADRIFT_RAD = 0.3, np.radians(10)
"""Standard deviations up to which a pose that is open is still followed, without being believed."""
SEARCH = np.full(6, 0.4)
"""As SPREAD, where the way back is sought."""
LOOKED_THROUGH = 0.05
"""Share of what is seen again that may lie where other views looked through: something that moved, not a wall."""
RIVAL = 0.9
"""Two fits of which one explains this share of what the other does, at places that differ: neither is believed."""
CONFIRMED = 5
"""Images in a row that must be tracked after a view is found again, without teaching, until poses count."""
KEPT_M, CHECKED = 30.0, 100
"""Surfels farther than this along an axis are forgotten, looked for every so many images."""


class Demand(NamedTuple):
    """Share of the patches that must be known, and of those that must lie where they are expected."""

    known: float
    usual: float


FOLLOWING, RETURNING = Demand(0.2, 0.6), Demand(0.5, 0.8)


@dataclass(frozen=True, eq=False)
class Tracked:
    """The pose of one frame.

    Attributes:
        T_world_sensor: (4, 4) float64, maps the optical frame into the tracker's world; of the last frame that was
            tracked where this one is lost.
        covariance: (6, 6) float64 of its place on the surfaces seen so far: rotation about the camera in radians, then
            position in metres, along the world's axes. Drift since the start is not in it.
        lost: Why the pose is not known, in words; "" where it is.
    """

    T_world_sensor: Transform
    covariance: NDArray[np.float64]
    lost: str = ""


class Tracker:
    """Finds the pose of each depth image or stereo pair by the surfaces that the ones before have seen.

    Each image is laid onto surfels, point to plane, from coarse to fine, from where even motion takes the camera. Where
    too little is seen or known, or nothing holds the pose along some direction (a bare wall), the frame is lost and
    teaches nothing; the way back is sought among the views that were kept. Poses that frames bring are not used.

    Args:
        profile: Profile name, TOML file or `Config`: depth, noise and range are prepared as for a map.
        start: (4, 4) T_world_sensor of the first image; without it the camera looks along x, level, z up.
        **overrides: Settings that replace those of the profile.

    Attributes:
        config: The resolved settings.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """

    def __init__(self, profile: str | Path | Config = "default", *, start: Transform | None = None, **overrides: Any):
        self.config = load_config(profile, **overrides)
        self._depth = DepthPipeline(self.config)
        self._sigma: PerCamera[NDArray[np.float64]] = PerCamera(self._sigma_of)
        self._start = LEVEL if start is None else np.asarray(start, float)
        self._map = SurfelMap()
        self._T, self._motion, self._covariance = self._start, np.eye(4), np.zeros((6, 6))
        self._views: list[View] = []
        self._seen = 0
        self._trial: int | None = None  # images until poses count: 0 while following, None while lost

    def add(self, frame: AnyFrame) -> Tracked:
        """Return the pose of a frame. Frames come in the order they were taken.

        Args:
            frame: Depth image or stereo pair; its pose is not used.

        Returns:
            Its pose, or why it is lost: also where the image itself cannot be used.
        """
        try:
            seen = self._patches(frame)
        except FrameRefused as refused:
            return self._lose(refused.reason)
        if len(seen.points) < MIN_PATCHES:
            return self._lose(f"only {len(seen.points)} patches of the image lie on surfaces, of {MIN_PATCHES} needed")
        if self._seen < 2 and self._trial != 0:
            return self._begin(seen)
        if self._trial is None:
            return self._seek(seen)
        fit = self._map.fit(seen, self._T @ self._motion, self._covariance + np.diag(SPREAD**2))
        demand = RETURNING if self._trial else FOLLOWING
        why = _doubt(fit, demand) or _open(fit, ADRIFT_M, ADRIFT_RAD)
        if not why and self._trial:
            why = self._contradicted(seen, fit.T_map_camera)
        if why:
            return self._begin(seen) if self._seen < 2 else self._lose(why)
        return self._follow(seen, fit)

    def _patches(self, frame: AnyFrame) -> Patches:
        posed = replace(frame, T_world_sensor=np.eye(4))
        image = self._depth.image(self._depth.matched(posed))
        return patches_of(image, self._sigma[image.camera], ROWS_PER_METRE)

    def _sigma_of(self, camera: VirtualCamera) -> NDArray[np.float64]:
        depths = np.arange(round(FARTHEST_M * ROWS_PER_METRE)) / ROWS_PER_METRE
        return FLOOR_M + BIAS * RangeNoise.of(self.config.noise, camera).sigma(depths)

    def _begin(self, seen: Patches) -> Tracked:
        """Start the map with an image; a start counts once the next image is tracked on it."""
        self._map, self._views = SurfelMap(), []
        self._T, self._motion, self._trial = self._start, np.eye(4), 0
        self._covariance = np.zeros((6, 6))
        self._learn(seen)
        self._seen = 1
        return Tracked(
            self._start, np.full((6, 6), np.inf), "the first image; poses count from the next one that fits it"
        )

    def _follow(self, seen: Patches, fit: Fit) -> Tracked:
        """Take the pose of an image that fits, and learn from it unless the way back is still on trial."""
        T = orthonormalise(fit.T_map_camera)
        self._motion, self._T, self._covariance = inverse(self._T) @ T, T, fit.covariance
        why = _open(fit, UNSURE_M, UNSURE_RAD)
        if why:
            self._trial = max(self._trial, 1)
        elif self._trial:
            self._trial -= 1
            why = f"found again; {self._trial + 1} more images must agree"
        if why:
            return Tracked(T, np.full((6, 6), np.inf), why)
        self._learn(seen)
        return Tracked(T, fit.covariance)

    def _learn(self, seen: Patches) -> None:
        self._map.add(seen, self._T)
        if all(far_apart(self._T, view.T, VIEW_M, VIEW_RAD) for view in self._views):
            self._views.append(view_of(seen.points, seen.sigma, self._T))
        self._seen += 1
        if self._seen % CHECKED == 0:
            here = self._T[:3, 3]
            self._map.forget(here, KEPT_M)
            self._views = [view for view in self._views if np.abs(view.T[:3, 3] - here).max() < KEPT_M]

    def _lose(self, why: str) -> Tracked:
        if self._trial != 0 or self._seen >= 2:
            self._trial = None
        return Tracked(self._T, np.full((6, 6), np.inf), why)

    def _seek(self, seen: Patches) -> Tracked:
        """Look for an image at the last pose and at the kept views that look most like it."""
        here = view_of(seen.points, seen.sigma, self._T)
        alike = sorted(self._views, key=lambda view: unlike(view, here))
        starts = [self._T, *(view.T for view in alike[:TRIED])]
        fits = sorted(
            (self._map.fit(seen, T, np.diag(SEARCH**2)) for T in starts), key=lambda fit: -fit.known * fit.usual
        )
        best = fits[0]
        why = _doubt(best, RETURNING) or _open(best, UNSURE_M, UNSURE_RAD)
        rivals = (fit for fit in fits if fit.known * fit.usual > RIVAL * best.known * best.usual)
        if not why and any(far_apart(best.T_map_camera, fit.T_map_camera, VIEW_M, VIEW_RAD) for fit in rivals):
            why = "it fits at several places"
        why = why or self._contradicted(seen, best.T_map_camera)
        if why:
            return self._lose(f"not found again: {why}")
        self._T, self._motion, self._trial = orthonormalise(best.T_map_camera), np.eye(4), CONFIRMED
        self._covariance = best.covariance
        return Tracked(self._T, np.full((6, 6), np.inf), f"found again; {CONFIRMED} more images must agree")

    def _contradicted(self, seen: Patches, T: Transform) -> str:
        share, number = contradiction(view_of(seen.points, seen.sigma, T), self._views)
        if number < MIN_PATCHES:
            return f"only {number} places of it were seen before, of {MIN_PATCHES} needed"
        return f"{share:.0%} of it lies where other views looked through" if share > LOOKED_THROUGH else ""


def _doubt(fit: Fit, demand: Demand) -> str:
    """Return why a fit is not believed, "" where it is."""
    if fit.known < demand.known:
        return f"{fit.known:.0%} of what it sees is known, {demand.known:.0%} is needed"
    if fit.usual < demand.usual:
        return f"{fit.usual:.0%} of what is known lies where it should, {demand.usual:.0%} is needed"
    return ""


def _open(fit: Fit, metres: float, radians: float) -> str:
    """Return by how much a pose is open, where it is by more than this; "" where it is not."""
    turn, shift = (np.sqrt(np.linalg.eigvalsh(part)[-1]) for part in (fit.covariance[:3, :3], fit.covariance[3:, 3:]))
    if shift > metres or turn > radians:
        return f"what it sees leaves the pose open by {shift:.3f} m and {np.degrees(turn):.1f} degrees"
    return ""
