# SPDX-License-Identifier: Apache-2.0
"""Joint robust refinement of clock offset, rotation and translation, with jackknife standard deviations."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.odometry import CameraMotion
from stereovox.calibrate.tracker import PoseTrack
from stereovox.geometry.se3 import Transform, rotation_matrix

BLOCKS = 10
"""Most parts of the recording left out in turn, to see how much the result depends on each."""
STEPS = np.array([1e-2, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4])
"""Steps of the derivatives: seconds (several poses, or their jitter looks like motion), radians, metres."""


@dataclass(frozen=True, eq=False)
class Pairs:
    """Registered pairs of images: times (N,) of both in seconds since the first image, and the camera's motion.

    T_first_second: (N, 4, 4). whitening: (N, 6, 6), gives errors (rotation vector, translation) equal weight.
    """

    first: NDArray[np.float64]
    second: NDArray[np.float64]
    T_first_second: NDArray[np.float64]
    whitening: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Refined:
    """Offset in seconds, X = T_tracker_camera, deviations (7,): s, 3 x rad, 3 x m; median residuals in rad and m.

    misfit: median of the residuals in the registrations' own standard deviations. pairs: number of them.
    """

    offset: float
    X: Transform
    deviations: NDArray[np.float64]
    residual_rotation: float
    residual_translation: float
    misfit: float
    pairs: int


def usable_pairs(motion: CameraMotion, track: PoseTrack, offset: float) -> Pairs:
    """Return the registered pairs with a trusted tracker pose at both times, without a jump between them."""
    times = (motion.stamps_ns - motion.stamps_ns[0]) / 1e9
    second = np.flatnonzero(motion.reference >= 0)
    first = motion.reference[second]
    parts = track.parts(times - offset)
    second, first = (chosen[(parts[first] >= 0) & (parts[first] == parts[second])] for chosen in (second, first))
    whitening = np.linalg.inv(np.linalg.cholesky(motion.covariance[second]))
    return Pairs(times[first], times[second], motion.T_reference_camera[second], whitening)


def tracker_motion(pairs: Pairs, track: PoseTrack, offset: float) -> NDArray[np.float64]:
    """Return (N, 4, 4) the tracker's motion between the two times of each pair."""
    return inverses(track.at(pairs.first - offset)) @ track.at(pairs.second - offset)


def refine(pairs: Pairs, track: PoseTrack, offset: float, X: Transform) -> Refined:
    """Return the offset and X near the given ones that best fit A(offset) X = X B.

    Errors are weighted by the covariance of each registration and softened beyond three deviations (soft L1).
    Deviations are by a jackknife over contiguous parts of the recording, because errors of neighbouring images are
    not independent.
    """
    from scipy.optimize import least_squares

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        errors = _errors(pairs, track, offset + p[0], _turned(X, p[1:]))
        return np.einsum("nij,nj->ni", pairs.whitening, errors).ravel()

    def jacobian(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.stack([(residuals(p + h) - residuals(p - h)) / (2 * h.sum()) for h in np.diag(STEPS)], axis=1)

    soft = 3 * max(1.4826 * float(np.median(np.abs(residuals(np.zeros(7))))), 1e-6)
    given: Any = jacobian  # scipy's stubs accept only the names of its own schemes
    found = least_squares(residuals, np.zeros(7), jac=given, loss="soft_l1", f_scale=soft, x_scale=STEPS)
    best_offset, best = offset + found.x[0], _turned(X, found.x[1:])
    errors = _errors(pairs, track, best_offset, best)
    typical = tuple(float(np.sqrt(np.median(np.sum(e**2, axis=1)))) for e in (errors[:, :3], errors[:, 3:]))
    deviations, misfit = _deviations(found.jac, found.fun, soft, pairs.first), float(np.median(np.abs(found.fun)))
    return Refined(float(best_offset), best, deviations, typical[0], typical[1], misfit, len(pairs.first))


def _errors(pairs: Pairs, track: PoseTrack, offset: float, X: Transform) -> NDArray[np.float64]:
    """Return (N, 6) the error of the tracker's motion, seen from the camera, against the camera's own."""
    from scipy.spatial.transform import Rotation

    predicted = inverses(X[None]) @ tracker_motion(pairs, track, offset) @ X
    E = inverses(pairs.T_first_second) @ predicted
    return np.hstack([Rotation.from_matrix(E[:, :3, :3]).as_rotvec(), E[:, :3, 3]])


def _turned(X: Transform, change: NDArray[np.float64]) -> Transform:
    """Return X, turned by a rotation vector in the camera's frame and moved in the tracker's."""
    result = X.copy()
    result[:3, :3] = X[:3, :3] @ rotation_matrix(change[:3])
    result[:3, 3] += change[3:]
    return result


def _deviations(
    J: NDArray[np.float64], r: NDArray[np.float64], soft: float, reference: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return standard deviations by a jackknife over parts in time, each with one Gauss-Newton step.

    Pairs with one `reference` (N,) stay together, because they share its errors. scipy's J is weighted for soft L1,
    its r is not: J^T r is the gradient once r has grown by (1 + (r / soft)^2)^(1/4).
    """
    r = r * (1 + (r / soft) ** 2) ** 0.25
    H, g = J.T @ J, J.T @ r
    _, group = np.unique(reference, return_inverse=True)
    parts = np.array_split(np.arange(group.max() + 1), BLOCKS)
    steps = []
    for part in filter(len, parts):
        rows = np.repeat(np.isin(group, part), 6)
        steps.append(np.linalg.lstsq(H - J[rows].T @ J[rows], -(g - J[rows].T @ r[rows]), rcond=None)[0])
    return np.sqrt((len(steps) - 1) * np.mean(np.square(steps), axis=0))


def inverses(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the inverses of (N, 4, 4) rigid motions."""
    R = np.swapaxes(T[:, :3, :3], 1, 2)
    result = np.zeros_like(T)
    result[:, :3, :3], result[:, 3, 3] = R, 1
    result[:, :3, 3] = -np.einsum("nij,nj->ni", R, T[:, :3, 3])
    return result
