# SPDX-License-Identifier: Apache-2.0
"""Check a frame, convert its depth to metres, give every pixel without a value its reason."""

from __future__ import annotations

from math import isnan

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import PinholeCamera
from stereovox.config import Config
from stereovox.depth import _cpu
from stereovox.depth.correct import corrected
from stereovox.depth.denoise import denoise
from stereovox.depth.downsample import downsample
from stereovox.depth.form import check_form, for_kernels, rigid_pose
from stereovox.depth.quality import SPARSE, check_unit
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Frame, Reason, name_of

DTYPES = (np.dtype(np.uint16), np.dtype(np.float32), np.dtype(np.float64))
SATURATED = 65535
"""What many cameras write into uint16 images for "no value"."""
NO_REASONS = for_kernels(np.empty(0, np.uint8))
"""What is taken where a frame gives none: so the kernel is there when the first one does."""
SMALLEST = 1e-30
"""Metres per unit of a depth image that float32 can still multiply with."""
MOST = max(Reason)


def prepare(frame: Frame, config: Config) -> DepthImage:
    """Return the frame's depth image in metres, corrected where its camera has a `correction`.

    A pixel is UNKNOWN where the value is zero, negative, NaN, +inf or a saturated uint16; TOO_NEAR and TOO_FAR outside
    [min_range, max_range], TOO_NEAR also where it is -inf. The source's own reason, where it has one, comes first; but
    its TOO_FAR only where nothing contradicts it: a depth beside it, or the frame's `farthest`. `depth.far` says whose
    word is taken for too far.
    Raises FrameRefused with the reason: the source's `fault`, `bad_form` and others of `check_form`, `bad_dtype`,
    `bad_shape`, `bad_scale`, `bad_units`, `bad_reason`, `no_pose`, `pose_not_finite`, `pose_not_rigid`,
    `no_valid_depth`.
    """
    _check_image(frame)
    T_world_sensor = rigid_pose(frame, config.pose_rigidity_tolerance)
    depth_m = np.empty(frame.depth.shape, np.float32)
    reason = np.empty(frame.depth.shape, np.uint8)
    usable = _classify(frame, config, depth_m, reason)
    if usable < SPARSE * depth_m.size:
        check_unit(frame, _said(frame), config)
    if not usable and not (reason == Reason.TOO_FAR).any():
        cure = "check its depth correction" if getattr(frame.camera, "correction", None) else "is the lens covered?"
        raise FrameRefused("no_valid_depth", f"{name_of(frame)}: not one pixel has a valid depth; {cure}")
    denoise(depth_m, frame.camera, config)
    image = DepthImage(depth_m, reason, frame.camera, T_world_sensor, int(frame.stamp_ns))
    return downsample(image, config.depth.downsample)


def _classify(frame: Frame, config: Config, depth_m: NDArray, reason: NDArray) -> int:
    raw, scale = for_kernels(frame.depth).reshape(-1), np.float32(frame.depth_scale)
    none = np.float32(SATURATED if raw.dtype == np.uint16 else 0)
    camera = frame.camera
    infinite = np.float32(np.inf if config.depth.far == "infinite" else np.nan)
    if isinstance(camera, PinholeCamera) and camera.correction:  # before the limits, which hold for true depths
        raw, scale, none = corrected(raw, scale, none, infinite, camera), np.float32(1), np.float32(0)
    limits = (np.float32(config.min_range), np.float32(config.max_range))
    into = depth_m.reshape(-1), reason.reshape(-1)
    usable = _cpu.classify(raw, scale, *limits, none, infinite, *into)
    told = config.depth.far != "measured" and float(frame.farthest) >= config.max_range
    far = np.uint8(Reason.TOO_FAR if told else Reason.UNKNOWN)
    given = NO_REASONS if frame.reason is None else for_kernels(frame.reason).reshape(-1)
    taken = _cpu.take_given(given, far, *into)
    return usable if frame.reason is None else taken


def _said(frame: Frame) -> NDArray[np.float64]:
    """Return some of a frame's depths (N,) in metres, but those that its source says are none."""
    rows, columns = (slice(n // 128, None, max(1, n // 64)) for n in frame.depth.shape)
    raw = np.asarray(frame.depth)[rows, columns]
    none = raw == SATURATED if raw.dtype == np.uint16 else np.zeros(raw.shape, bool)
    if frame.reason is not None:
        none |= np.asarray(frame.reason)[rows, columns] != Reason.VALID
    return raw[~none].astype(float) * float(frame.depth_scale)


def _check_image(frame: Frame) -> None:
    check_form(frame, Frame)
    name, depth, camera = name_of(frame), frame.depth, frame.camera
    if not isinstance(depth, np.ndarray) or depth.dtype not in DTYPES:
        kind = getattr(depth, "dtype", type(depth).__name__)
        raise FrameRefused("bad_dtype", f"{name}: depth is {kind}; give a uint16, float32 or float64 array")
    if depth.shape != (camera.height, camera.width):
        wanted = f"({camera.height}, {camera.width})"
        raise FrameRefused("bad_shape", f"{name}: depth image is {depth.shape}, its camera says {wanted}")
    if depth.dtype.kind == "u" and isnan(frame.depth_scale):
        cure = "give metres per unit, depth_scale=0.001 for millimetres"
        raise FrameRefused("bad_scale", f"{name}: depth is {depth.dtype} and has no depth_scale; {cure}")
    if not SMALLEST < float(frame.depth_scale) < 1 / SMALLEST:  # NaN as well
        raise FrameRefused("bad_scale", f"{name}: depth_scale {frame.depth_scale} must be positive and finite")
    if frame.reason is not None and not _are_reasons(frame.reason, depth.shape):
        raise FrameRefused("bad_reason", f"{name}: reason must be {depth.shape} uint8 of values 0 to {MOST}")


def _are_reasons(given: NDArray, shape: tuple[int, ...]) -> bool:
    return given.dtype == np.uint8 and given.shape == shape and np.max(given.view(np.ndarray), initial=0) <= MOST
