# SPDX-License-Identifier: Apache-2.0
"""How a depth camera moved, from its images alone: each is registered with an earlier one (small_gicp)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.planes import Link, Surface, refined
from stereovox.errors import MissingExtra
from stereovox.geometry import Transform, inverse, rotation_vector

CELL = 0.08
"""Metres; points nearer to each other than this are merged."""
REACH = 0.3
"""Metres; points further apart do not belong together."""
FEWEST = 200
"""Points an image needs."""
INLIERS = 0.55
"""Share of the points that must find a partner."""
NEW_REFERENCE = (np.radians(35), 0.6, 0.7)
"""The reference is renewed beyond this turn (radians) or way (metres), or below this share of partners."""
WEAKEST = (np.radians(1.0), 0.05)
"""A registration that leaves any turn or way less certain than this is none: one wall says nothing about sliding."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """How a camera moved between the images of a recording.

    stamps_ns: (N,) int64. reference: (N,) the number of the image that each was registered with, -1 for none.
    T_reference_camera: (N, 4, 4), NaN without reference. covariance: (N, 6, 6) of the small motion (rotation vector,
    then translation) by which it may be off, seen from the camera: T_true = T exp(error).
    """

    stamps_ns: NDArray[np.int64]
    reference: NDArray[np.intp]
    T_reference_camera: NDArray[np.float64]
    covariance: NDArray[np.float64]

    @property
    def steps(self) -> NDArray[np.float64]:
        """Return (N - 1, 4, 4) T_i_j from each image i to the next j, NaN where it is not known."""
        T, reference = self.T_reference_camera, self.reference
        steps = np.full((max(len(T) - 1, 0), 4, 4), np.nan)
        for i in range(len(steps)):
            if reference[i + 1] == i:
                steps[i] = T[i + 1]
            elif reference[i + 1] >= 0 and reference[i + 1] == reference[i]:
                steps[i] = inverse(T[i]) @ T[i + 1]
        return steps


def camera_motion(clouds: Iterable[tuple[int, NDArray[np.float64]]]) -> CameraMotion:
    """Return the motion between images, given in order as time in nanoseconds and (M, 3) points in the optical frame.

    An image that cannot be registered becomes the next reference itself, without a link to those before.
    Raises MissingExtra without small_gicp.
    """
    register = _Registration()
    stamps: list[int] = []
    links: list[Link] = []
    key, step = -1, np.eye(4)
    for i, (stamp_ns, points) in enumerate(clouds):
        stamps.append(stamp_ns)
        guess = links[-1].T @ step if key >= 0 and key != i - 1 else step
        found = register.against(points, guess) if key >= 0 else None
        links.append(replace(found, reference=key) if found else Link())
        step = np.eye(4)
        if found:
            step = found.T if key == i - 1 else inverse(links[-2].T) @ found.T
        if not found or _is_far(found):
            key = i if register.take(points) else -1
    return CameraMotion(
        np.array(stamps, np.int64),
        np.array([link.reference for link in links], np.intp),
        np.reshape([link.T for link in links], (-1, 4, 4)),
        np.reshape([link.covariance for link in links], (-1, 6, 6)),
    )


def _is_far(link: Link) -> bool:
    turn, way, share = NEW_REFERENCE
    turned, moved = np.linalg.norm(rotation_vector(link.T[:3, :3])), np.linalg.norm(link.T[:3, 3])
    return bool(turned > turn or moved > way or link.share < share)


class _Registration:
    """Registers point clouds with the one that was taken as reference last."""

    def __init__(self) -> None:
        self._gicp = _small_gicp()
        self._target: Any = None

    def take(self, points: NDArray[np.float64]) -> bool:
        """Make these points the reference; False where they are too few."""
        if len(points) < FEWEST:
            return False
        self._target = self._gicp.preprocess_points(points, CELL, num_neighbors=12)
        return True

    def against(self, points: NDArray[np.float64], guess: Transform) -> Link | None:
        """Return where the points' camera stood in the reference's frame; None where that is not certain enough."""
        if len(points) < FEWEST:
            return None
        cloud, _ = self._gicp.preprocess_points(points, CELL, num_neighbors=12)
        target, tree = self._target
        limits = {"max_correspondence_distance": REACH, "max_iterations": 30}
        rough = self._gicp.align(target, cloud, tree, guess, registration_type="GICP", **limits)
        link = refined(np.array(rough.T_target_source), Surface.of(cloud), Surface.of(target), tree)
        return link if link.share >= INLIERS and _is_certain(link) else None


def _is_certain(link: Link) -> bool:
    parts = link.covariance[:3, :3], link.covariance[3:, 3:]
    return all(np.linalg.eigvalsh(part).max() < limit**2 for part, limit in zip(parts, WEAKEST, strict=True))


def _small_gicp() -> Any:
    try:
        import small_gicp
    except ImportError:
        raise MissingExtra("small_gicp", "pair") from None
    return small_gicp
