# SPDX-License-Identifier: Apache-2.0
"""Prepare a depth image: check the frame, convert to metres, assign a reason to each pixel without a value, denoise.

Each step is also a function: depth correction, denoising, block minima, a shorter range.

The depth pipeline from frame to depth image: match, check, clean, and gather on the spherical grid.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from math import isnan

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.depth import _denoise, _images
from stereovox.depth.quality import SPARSE, check_depth, check_light, check_unit
from stereovox.depth.sphere.image import through_sphere
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.errors import ConfigError, FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, DepthImage, Frame, Rays, Reason, StereoFrame, name_of
from stereovox.frame.validate import for_kernels, rigid_pose, validate_fields
from stereovox.sensors.noise import RangeNoise

DTYPES = (np.dtype(np.uint16), np.dtype(np.float32), np.dtype(np.float64))
SATURATED = 65535
"""Value that many cameras write into uint16 images for "no value"."""
NO_REASONS = for_kernels(np.empty(0, np.uint8))
"""Stand-in for frames without reasons, so that the kernel is compiled before the first frame with some."""
SMALLEST = 1e-30
"""Smallest scale in metres per unit that float32 can multiply with."""
MAX_REASON = max(Reason)
FINE = 0.15
"""Noise below this share of a cell does not thicken a surface noticeably."""
WORTH = 0.5
"""If no noise exceeds this share of a cell, raw depth maps equally well; in the demo at 0.2 m slightly better."""
STEPS = np.array([1, 2, 4])
"""Distance of the neighbours in pixels, pass by pass."""
FROM = np.array([1, 1, 3])
"""A pixel takes part in a pass if its noise is more than this many times FINE cells."""
WIDTHS = np.array([4.5, 4.5, 4.0], np.float32)
"""A neighbour counts less the more it differs, and not at all beyond this many sigma."""
APART = 2.5
"""Pixels this many `noise.correlation_px` apart count as independent: their errors have a correlation of 0.2."""
FARTHEST_APART = 4
"""Largest factor on the steps for that: the last then reaches 16 pixels. Farther pixels show other objects."""
LIMIT = 1.3
"""Cap of sigma in cells: surfaces that the map can separate are not mixed, however noisy the camera."""


def prepare(frame: Frame, config: Config) -> DepthImage:
    """Return the frame's depth image in metres, corrected if its camera has a `correction`.

    A pixel is UNKNOWN if the value is zero, negative, NaN, +inf or a saturated uint16; TOO_NEAR and TOO_FAR outside
    [min_range, max_range], TOO_NEAR also if it is -inf. The source's own reason, if any, takes precedence; but
    its TOO_FAR only if neither a depth at the pixel nor the frame's `farthest` contradicts it. `depth.far` sets
    which sources of "too far" count.
    Raises FrameRefused with the reason: the source's `fault`, `bad_form` and others of `validate_fields`, `bad_dtype`,
    `bad_shape`, `bad_scale`, `bad_units`, `bad_reason`, `no_pose`, `pose_not_finite`, `pose_not_rigid`,
    `no_valid_depth`.
    """
    _check_image(frame)
    T_world_sensor = rigid_pose(frame, config.pose_rigidity_tolerance)
    depth_m = np.empty(frame.depth.shape, np.float32)
    reason = np.empty(frame.depth.shape, np.uint8)
    usable = _classify(frame, config, depth_m, reason)
    if usable < SPARSE * depth_m.size:
        check_unit(frame, _sample_depths(frame), config)
    if not usable and not (reason == Reason.TOO_FAR).any():
        cure = "check its depth correction" if getattr(frame.camera, "correction", None) else "is the lens covered?"
        raise FrameRefused("no_valid_depth", f"{name_of(frame)}: no pixel has a valid depth; {cure}")
    denoise(depth_m, frame.camera, config)
    image = DepthImage(depth_m, reason, frame.camera, T_world_sensor, int(frame.stamp_ns))
    return downsample(image, config.depth.downsample)


def correct(depth_m: NDArray[np.float32], camera: PinholeCamera) -> None:
    """Correct (height, width) float32 metres in place by the camera's `correction`; NaN and infinities stay."""
    if camera.correction is None:
        return
    x, y = camera.ray_slopes()
    if camera.correction.model == "thesis":
        _images.thesis(np.array(camera.correction.coefficients, np.float32), x, depth_m)
    else:
        s, q = quadratics(camera.correction)
        _images.quadratics(s.astype(np.float32), q.astype(np.float32), x, y, depth_m)


def quadratics(correction: DepthCorrection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coefficients (6,) of s and of q, see `DepthCorrection`; not for the model `thesis`."""
    numbers, nothing = np.array(correction.coefficients), np.zeros(6)
    if correction.model == "scale+disparity":
        return numbers[:6], numbers[6:]
    return (numbers, nothing) if correction.model == "scale" else (nothing, numbers)


def denoise(depth_m: NDArray[np.float32], camera: VirtualCamera, config: Config) -> None:
    """Average each depth with similar neighbours, in place.

    depth_m: (height, width) float32 metres with REP 117's special values, contiguous. Pixels without value stay as they
    are and do not count; values stay within min_range and max_range.

    A sigma filter (Lee 1983) whose weights (1 - (difference / (k sigma))^2)^4 fall smoothly, in passes with holes
    ("a trous", Dammertz 2010): with the next neighbours to the left and right, above and below, then with those 2
    pixels away, then 4. So few neighbours reach far, and stereo noise, which is correlated over about the matching
    window, is removed too. It works on inverse depth, in which stereo noise is uniform and a plane is
    linear, so a mean over symmetric neighbours has no bias. sigma is from the noise model, configured or from
    the camera. Errors that are correlated over more than the next pixel (`noise.correlation_px`) do not average out
    there:
    all steps are stretched until the neighbours are independent, as the filter assumes.
    A pixel takes part in no more passes than it needs: it is left unchanged if sigma(depth) is at most
    FINE cells, and by the last pass up to three times that. So near surfaces keep every detail. Nothing is done if
    even the noise at the maximum range is less than WORTH cells.

    Averaging row and column together keeps thin objects: a pole has similar neighbours along the column while its row
    shows the wall behind, and a wire the other way round; in later passes the remaining noise no longer hides the step.
    Averaging rows first would remove a pole two sigma in front of its wall.

    Even so, a rod one or two pixels wide, two to three sigma before its wall, is mostly averaged into it, and rays past
    it then clear its cells. So finally a pixel takes the mean of a line of five measured pixels (vertical, horizontal
    or diagonal) if that is nearer, and both halves of the line are 1.5 sigma in front of both sides: three pixels on,
    after all passes. Noise alone does so at one pixel in a thousand. This is left out up to three times FINE cells of
    noise, as the last pass is, and unless `depth.keep_lines` is set. Registration goes without it: there, the few
    pixels that noise puts in front matter more than thin objects.

    Limitation: a step of less than about two sigma is smoothed over some pixels.
    """
    if not config.depth.denoise:
        return
    noise, farthest = RangeNoise.of(config.noise, camera), config.max_range
    if noise.s0 + (noise.s1 + noise.s2 * farthest) * farthest > WORTH * config.voxel_size:
        _run(depth_m, noise, FINE * config.voxel_size, config)


def downsample(image: DepthImage, n: int) -> DepthImage:
    """Return the image of block minima and its camera; n = 1 returns the image itself.

    A block without any valid pixel is TOO_NEAR if one of its pixels is, TOO_FAR only if all of them are, else
    MASKED if one is, else UNMATCHED if one is, else UNKNOWN. Blocks at the right and lower border may be cut.
    Raises ConfigError for a wide camera, FrameRefused `bad_camera` if larger pixels do not form a valid pinhole camera.
    """
    if n == 1:
        return image
    if not isinstance(image.camera, PinholeCamera):
        raise ConfigError(f"depth.downsample {n}: a wide camera's image cannot be downsampled; use sphere.step_deg")
    try:
        camera = image.camera.binned(n)
    except StereovoxError as error:
        raise FrameRefused("bad_camera", f"blocks of {n} by {n} pixels: {error}") from None
    depth_m = np.empty((camera.height, camera.width), np.float32)
    reason = np.empty(depth_m.shape, np.uint8)
    _images.block_minimum(image.depth_m, image.reason, n, np.empty(image.camera.width, np.float32), depth_m, reason)
    return DepthImage(depth_m, reason, camera, image.T_world_sensor, image.stamp_ns)


def shortened(image: DepthImage, valid_to: float, far_from: float) -> DepthImage:
    """Return the image with depths up to `valid_to` metres; farther than `far_from` is TOO_FAR.

    Pixels between the two are UNMATCHED: their noise could have put them there, so nothing may be cleared along them.
    """
    depth_m, reason = np.empty_like(image.depth_m), np.empty_like(image.reason)
    given, made = (image.depth_m, image.reason), (depth_m, reason)
    limits = np.float32(valid_to), np.float32(far_from)
    _images.shorten(*(array.reshape(-1) for array in given), *limits, *(array.reshape(-1) for array in made))
    return DepthImage(depth_m, reason, image.camera, image.T_world_sensor, image.stamp_ns)


def _check_image(frame: Frame) -> None:
    validate_fields(frame, Frame)
    name, depth, camera = name_of(frame), frame.depth, frame.camera
    if not isinstance(depth, np.ndarray) or depth.dtype not in DTYPES:
        kind = getattr(depth, "dtype", type(depth).__name__)
        raise FrameRefused("bad_dtype", f"{name}: depth is {kind}; give a uint16, float32 or float64 array")
    if depth.shape != (camera.height, camera.width):
        wanted = f"({camera.height}, {camera.width})"
        raise FrameRefused("bad_shape", f"{name}: depth image is {depth.shape}, its camera has {wanted}")
    if depth.dtype.kind == "u" and isnan(frame.depth_scale):
        cure = "give metres per unit, depth_scale=0.001 for millimetres"
        raise FrameRefused("bad_scale", f"{name}: depth is {depth.dtype} and has no depth_scale; {cure}")
    if not SMALLEST < float(frame.depth_scale) < 1 / SMALLEST:  # also NaN
        raise FrameRefused("bad_scale", f"{name}: depth_scale {frame.depth_scale} must be positive and finite")
    if frame.reason is not None and not _are_reasons(frame.reason, depth.shape):
        given = f"{np.shape(frame.reason)} {getattr(frame.reason, 'dtype', type(frame.reason).__name__)}"
        wanted = f"{depth.shape} uint8 of values 0 to {MAX_REASON}"
        raise FrameRefused("bad_reason", f"{name}: reason is {given}; give {wanted}")


def _are_reasons(given: NDArray, shape: tuple[int, ...]) -> bool:
    return given.dtype == np.uint8 and given.shape == shape and np.max(given.view(np.ndarray), initial=0) <= MAX_REASON


def _classify(frame: Frame, config: Config, depth_m: NDArray, reason: NDArray) -> int:
    raw, scale = for_kernels(frame.depth).reshape(-1), np.float32(frame.depth_scale)
    none = np.float32(SATURATED if raw.dtype == np.uint16 else 0)
    camera = frame.camera
    infinite = np.float32(np.inf if config.depth.far == "infinite" else np.nan)
    if isinstance(camera, PinholeCamera) and camera.correction:  # before the limits, which apply to true depths
        raw, scale, none = corrected(raw, scale, none, infinite, camera), np.float32(1), np.float32(0)
    limits = (np.float32(config.min_range), np.float32(config.max_range))
    into = depth_m.reshape(-1), reason.reshape(-1)
    counts = config.depth.far != "measured" and float(frame.farthest) >= config.max_range
    far = np.uint8(Reason.TOO_FAR if counts else Reason.UNKNOWN)
    given = NO_REASONS if frame.reason is None else for_kernels(frame.reason).reshape(-1)
    return _images.classify(raw, scale, *limits, none, infinite, given, far, *into)


def corrected(
    raw: NDArray[np.generic], scale: np.float32, none: np.float32, infinite: np.float32, camera: PinholeCamera
) -> NDArray[np.float32]:
    """Return the corrected depth (height * width,) in metres, float32, of a flat raw image; NaN: no value.

    scale: metres per unit; none, infinite: as in `_images.classify`; infinities stay. A pixel whose corrected
    depth is not positive has no value and clears nothing.
    """
    depth_m = np.empty(raw.size, np.float32)
    _images.classify(
        raw, scale, np.float32(0), np.float32(np.inf), none, infinite, NO_REASONS, np.uint8(Reason.TOO_FAR), depth_m,
        np.empty(raw.size, np.uint8),
    )  # fmt: skip
    correct(depth_m.reshape(camera.height, camera.width), camera)
    return depth_m


def _sample_depths(frame: Frame) -> NDArray[np.float64]:
    """Return a sample of a frame's depths (N,) in metres, without those that its source marks as invalid."""
    rows, columns = (slice(n // 128, None, max(1, n // 64)) for n in frame.depth.shape)
    raw = np.asarray(frame.depth)[rows, columns]
    none = raw == SATURATED if raw.dtype == np.uint16 else np.zeros(raw.shape, bool)
    if frame.reason is not None:
        none |= np.asarray(frame.reason)[rows, columns] != Reason.VALID
    return raw[~none].astype(float) * float(frame.depth_scale)


def _run(depth_m: NDArray[np.float32], noise: RangeNoise, fine: float, config: Config) -> None:
    steps = STEPS * stretched(config.noise.correlation_px)
    margin, passes = int(steps[-1]), len(steps)
    width = -(-depth_m.shape[1] // _denoise.SEGMENT) * _denoise.SEGMENT
    rows = passes * margin + (_denoise.SIDE + _denoise.TAPS) * int(steps[0]) + 1
    rings = np.empty((passes + 1, rows, width + 2 * margin), np.float32)
    noisy = np.empty((rows, width // _denoise.SEGMENT), np.uint8)
    low, high, limit = np.float32(config.min_range), np.float32(config.max_range), np.float32(LIMIT * config.voxel_size)
    sigma, leaves = _numbers(noise, fine)
    _denoise.denoise(depth_m, sigma, steps, leaves, WIDTHS, limit, low, high, rings, noisy, config.depth.keep_lines)


def stretched(correlation_px: float) -> int:
    """Return the factor on the distance of neighbours for errors that are correlated over this many pixels."""
    return min(max(1, round(APART * correlation_px)), FARTHEST_APART)


@lru_cache
def _numbers(noise: RangeNoise, fine: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return s0, s1, s2 (3,) of the noise, and for each pass the noise in metres that it leaves alone."""
    return np.array([noise.s0, noise.s1, noise.s2], np.float32), (fine * FROM).astype(np.float32)


class DepthPipeline:
    """Turns frames into depth images as configured."""

    def __init__(self, config: Config):
        self._config = config

    def matched(self, frame: AnyFrame) -> Frame:
        """Return a stereo frame with its depth, any other frame unchanged.

        Raises FrameRefused as `StereoDepth` and `check_light`, and `bad_form` for clouds and anything that is not a
        frame.
        """
        if isinstance(frame, Frame):
            return frame  # `prepare` validates its fields
        if isinstance(frame, Rays):
            validate_fields(frame, type(frame))
            detail = "is not an image: it can be mapped with given poses, but not tracked"
            raise FrameRefused("bad_form", f"{name_of(frame)}: {detail}")
        validate_fields(frame, StereoFrame, Frame)
        assert isinstance(frame, StereoFrame)
        check_light(frame, self._config.trust.max_unexposed_share)
        return self._stereo(frame)

    def image(self, frame: Frame) -> DepthImage:
        """Return the frame's depth image. Raises FrameRefused as `prepare` and `check_depth`."""
        return through_sphere(self.checked(frame), self._config)

    def checked(self, frame: Frame) -> DepthImage:
        """Return what `image` returns, but before it is gathered on a spherical grid."""
        image = prepare(frame, self._config)
        check_depth(image, frame, self._config)
        return image

    @cached_property
    def _stereo(self) -> StereoDepth:
        """Created for the first stereo frame: other recordings need no OpenCV."""
        return StereoDepth(self._config.stereo)
