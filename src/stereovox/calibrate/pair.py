# SPDX-License-Identifier: Apache-2.0
"""Extrinsics and clock offset of a depth camera on a tracker, from a recording of both.

The camera's motion comes from its depth images, the tracker's from its poses. Their angular speeds give the offset of
the clocks, whatever the extrinsics; hand-eye calibration gives rotation and translation; then all are refined together.

Hand-eye calibration in closed form: A X = X B for motions A of the tracker, B of the camera on the same body. Rotation
after Park & Martin 1994 (rotation vectors of A are those of B, turned by X); translation by linear least squares of
(R_A - I) t_X = R_X t_B - t_A (Tsai & Lenz 1989).

Not cv2.calibrateHandEye: OpenCV 5 has none, and version 4's takes poses, not motions, and has no outlier rejection
(`benchmarks/hand_eye.py`: errors of 0.1 deg and 3 mm here, of 0.4 deg and 13 mm or more there; with 5 % of the motions
wrong 0.1 deg and 3 mm here, 3 deg and 9 cm there).

Joint robust refinement of clock offset, rotation and translation, with jackknife standard deviations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.calibrate.odometry import CameraMotion, camera_motion
from stereovox.calibrate.tracker import Offset, PoseTrack, find_offsets
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import DepthImage, Frame, Reason
from stereovox.geometry.se3 import Transform, rotation_matrix
from stereovox.opening import DepthSource
from stereovox.sources.poses.poses import Poses

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


MIN_TURN = np.radians(3.0)
"""Least root mean square turn of the camera between registered images, in radians."""
MIN_SECOND_TURN = np.radians(1.2)
"""The same about the second axis: rotation about one axis leaves the camera's position along it open."""
COLUMNS = 106
"""Approximate width of an image in blocks: 8 pixels each for 848."""
SPREAD = 0.15
"""Blocks whose inverse depths differ by more than this share of their mean are across an edge."""
MIN_IMAGES = 20
"""Fewest registered images with trusted poses for a calibration."""
MIN_REGISTERED = 0.5
"""Least share of registered images."""
MAX_RANGE = 5.0
"""Metres; depth beyond is too noisy to register."""
UNIQUE, SAME_S = 2.0, 0.05
"""A second offset (farther away than SAME_S seconds) must fit this many times worse."""


def calibrate_pair(
    depth: DepthSource,
    poses: Poses,
    *,
    min_confidence: float = 2.0,
    max_speed_mps: float = 10.0,
    max_turn_dps: float = 720.0,
    guess_s: float = 0.0,
    within_s: float | None = None,
    progress: Callable[[Iterable[Frame], int], Iterable[Frame]] | None = None,
) -> PairCalibration:
    """Return extrinsics and clock offset of a depth camera and a tracker.

    poses: T_world_tracker with the body in optical axes, on the tracker's own clock. The three limits are as in a
    `pair.toml`. within_s: only offsets this near to `guess_s`; None: any. progress: wraps the frames as they are read.
    Raises StereovoxError if motion or depth do not suffice or the recordings do not overlap;
    MissingExtra without small_gicp.
    """
    motion = camera_motion(_clouds(depth, progress))
    _check_depth(motion, depth)
    track = PoseTrack(poses, min_confidence, max_speed_mps, max_turn_dps)
    starts = (int(motion.stamps_ns[0]) - track.start_ns) / 1e9
    between = None if within_s is None else (guess_s - starts - within_s, guess_s - starts + within_s)
    check_turning(_rotation_vectors(motion))
    found, correlation = _best(motion, track, find_offsets(motion, track, between))
    return _result(found, starts, correlation, motion)


@dataclass(frozen=True, eq=False)
class PairCalibration:
    """The result of `calibrate_pair`.

    T_tracker_camera: (4, 4) metres, depth camera's optical frame to the tracker's body, both in optical axes.
    clock_offset_s: depth stamp = tracker stamp + offset, seconds.
    offset_std_s, rotation_std_deg (3,) about the camera's axes, translation_std_m (3,) along the tracker's: standard
    deviations. rotation_residual_deg, translation_residual_m: median misfit of registered pairs of images.
    correlation: of the two angular speeds. images, registered, pairs: the numbers of each.
    """

    T_tracker_camera: Transform
    clock_offset_s: float
    offset_std_s: float
    rotation_std_deg: NDArray[np.float64]
    translation_std_m: NDArray[np.float64]
    rotation_residual_deg: float
    translation_residual_m: float
    correlation: float
    images: int
    registered: int
    pairs: int

    def as_dict(self) -> dict[str, Any]:
        """Return the fields with lists instead of arrays."""
        return {key: getattr(value, "tolist", lambda value=value: value)() for key, value in vars(self).items()}


def reduced_points(image: DepthImage, farthest: float) -> NDArray[np.float64]:
    """Return (N, 3) points up to depth `farthest`, one for each block of pixels that sees one smooth surface.

    The mean is taken over inverse depth: there a stereo camera's noise is even, and a plane is linear in the pixel.
    A block counts if half of its pixels are VALID and their inverse depths are close together. The image must reach
    farther than `farthest`: a limit on pixels would keep those that noise brings nearer, a shell that moves along.
    """
    n = max(1, round(image.camera.width / COLUMNS))
    valid = image.reason == Reason.VALID
    inverse = np.divide(1.0, image.depth_m, where=valid, out=np.zeros(valid.shape))
    counts, sums = _blocks(valid, n).sum((1, 3)), _blocks(inverse, n).sum((1, 3))
    lowest = _blocks(np.where(valid, inverse, np.inf), n).min((1, 3))
    highest = _blocks(inverse, n).max((1, 3))
    usable = counts >= max(1, n * n // 2)
    mean = np.divide(sums, counts, where=usable, out=np.ones(sums.shape))
    usable &= (highest - lowest <= SPREAD * mean) & (mean * farthest >= 1)
    rows, columns = np.nonzero(usable)
    camera, middle = image.camera, (n - 1) / 2
    assert isinstance(camera, PinholeCamera)
    depth = 1 / mean[rows, columns]
    x = (columns * n + middle - camera.cx) / camera.fx
    y = (rows * n + middle - camera.cy) / camera.fy
    return np.stack([x * depth, y * depth, depth], axis=1)


def hand_eye(A: NDArray[np.float64], B: NDArray[np.float64]) -> Transform:
    """Return X (4, 4) with A X = X B, of (N, 4, 4) motions; pairs whose turns differ in size are outliers."""
    from scipy.spatial.transform import Rotation

    a, b = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (A, B))
    differ = np.abs(np.linalg.norm(a, axis=1) - np.linalg.norm(b, axis=1))
    usual = differ <= 3 * np.median(differ) + 1e-9
    X = np.eye(4)
    X[:3, :3] = Rotation.align_vectors(a[usual], b[usual])[0].as_matrix()
    X[:3, 3] = _translation(A[usual], B[usual], X[:3, :3])
    return X


def check_turning(vectors: NDArray[np.float64]) -> None:
    """Raise StereovoxError if (N, 3) rotation vectors are too small or all about one axis."""
    weights, axes = np.linalg.eigh(vectors.T @ vectors / max(len(vectors), 1))
    first, second = np.sqrt(np.maximum(weights[::-1][:2], 0))
    if first < MIN_TURN:
        raise StereovoxError(
            f"motion: too small, images are turned by {np.degrees(first):.1f} deg (rms); turn by 30 deg about two axes"
        )
    if second < MIN_SECOND_TURN:
        axis = " ".join(f"{number:+.2f}" for number in axes[:, -1])
        raise StereovoxError(
            f"motion: turns about one axis only ({axis} in the camera's frame); pitch, yaw and roll while recording"
        )


def _translation(A: NDArray[np.float64], B: NDArray[np.float64], R: NDArray[np.float64]) -> NDArray[np.float64]:
    left = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ R.T - A[:, :3, 3]).ravel()
    return np.linalg.lstsq(left, right, rcond=None)[0].astype(float)


def _blocks(image: NDArray, n: int) -> NDArray:
    """Return (rows, n, columns, n); what is left over at the right and lower border is cut off."""
    height, width = image.shape[0] // n * n, image.shape[1] // n * n
    return image[:height, :width].reshape(height // n, n, width // n, n)


def _best(motion: CameraMotion, track: PoseTrack, offsets: list[Offset]) -> tuple[Refined, float]:
    """Return the best fit among the offsets that angular speeds allow; the mount exposes false ones."""
    tried = [(found, rough.correlation) for rough in offsets if (found := _refined(motion, track, rough.seconds))]
    if not tried:
        raise StereovoxError(f"poses: fewer than {MIN_IMAGES} images have trusted poses; record for longer, or slower")
    tried.sort(key=lambda one: one[0].misfit)
    if len(tried) > 1 and tried[1][0].misfit < UNIQUE * tried[0][0].misfit:
        apart = abs(tried[1][0].offset - tried[0][0].offset)
        if apart > SAME_S:
            found = f"two offsets {apart:.2f} s apart fit equally well"
            raise StereovoxError(f"clocks: {found}; turn irregularly, or allow fewer with --within")
    return tried[0]


def _refined(motion: CameraMotion, track: PoseTrack, offset: float) -> Refined | None:
    pairs = usable_pairs(motion, track, offset)
    if len(pairs.first) < MIN_IMAGES:
        return None
    return refine(pairs, track, offset, hand_eye(tracker_motion(pairs, track, offset), pairs.T_first_second))


def _clouds(
    depth: DepthSource, progress: Callable[[Iterable[Frame], int], Iterable[Frame]] | None
) -> Iterator[tuple[int, NDArray[np.float64]]]:
    """Yield time and points of every usable image; the source's poses are ignored."""
    config = load_config("default", max_range=2 * MAX_RANGE, **{"depth.denoise": False})  # registration wants it raw
    for frame in progress(depth, len(depth)) if progress else depth:
        try:
            image = prepare(replace(frame, T_world_sensor=np.eye(4)), config)
            yield frame.stamp_ns, reduced_points(image, MAX_RANGE)
        except FrameRefused:
            continue


def _check_depth(motion: CameraMotion, depth: DepthSource) -> None:
    registered = int((motion.reference >= 0).sum())
    if registered < max(MIN_IMAGES, MIN_REGISTERED * len(depth)):
        raise StereovoxError(
            f"{depth.name}: only {registered} of {len(depth)} depth images could be registered with another; film "
            f"corners and furniture within {MAX_RANGE:g} m, for at least some seconds, and move slowly"
        )


def _rotation_vectors(motion: CameraMotion) -> NDArray[np.float64]:
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(motion.T_reference_camera[motion.reference >= 0, :3, :3]).as_rotvec()


def _result(found: Refined, starts: float, correlation: float, motion: CameraMotion) -> PairCalibration:
    return PairCalibration(
        T_tracker_camera=found.X,
        clock_offset_s=found.offset + starts,
        offset_std_s=float(found.deviations[0]),
        rotation_std_deg=np.degrees(found.deviations[1:4]),
        translation_std_m=found.deviations[4:],
        rotation_residual_deg=float(np.degrees(found.residual_rotation)),
        translation_residual_m=found.residual_translation,
        correlation=correlation,
        images=len(motion.stamps_ns),
        registered=int((motion.reference >= 0).sum()),
        pairs=found.pairs,
    )
