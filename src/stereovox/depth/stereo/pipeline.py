# SPDX-License-Identifier: Apache-2.0
"""From a stereo frame to a depth image: match, remove implausible disparities, convert to metres.

Rectification: both images as their pair's virtual camera would have taken them, with matching rows.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.rigs import StereoPair, VirtualCamera
from stereovox.cameras.wide import Lens
from stereovox.config import StereoConfig
from stereovox.depth.stereo.disparity import FAR_PX, Disparity, doubled, explained, halved, match_aligned
from stereovox.depth.stereo.matchers import make_matcher
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, Reason, StereoFrame, name_of
from stereovox.frame.validate import matrix_of
from stereovox.geometry.se3 import Transform
from stereovox.kernels.threads import in_shards, shards

__all__ = ["Disparity", "StereoDepth"]

ROWS = 32
"""Rows that are converted to depth at once."""
LARGE = 450_000
"""Larger images are halved if `stereo.halve` is not set: street cameras, but not 848x480 ones."""


class StereoDepth:
    """Turns stereo frames into depth frames, as configured. Not for concurrent use by several threads."""

    def __init__(self, config: StereoConfig) -> None:
        """Raises ConfigError for an unknown method, MissingExtra if its library is missing."""
        self.config = config
        self._matchers = {bool(config.halve): make_matcher(_of_half(config) if config.halve else config)}

    def __call__(self, frame: StereoFrame) -> Frame:
        """Return the frame as a depth image: float32 metres, reasons, camera and pose of the aligned eye.

        Depth is `camera.depth_of` the disparity, NaN: none. TOO_FAR pixels hold a lower bound of their
        depth, so a map that reaches farther does not take them for free. No pixel is UNKNOWN, but UNMATCHED if the
        images disagree, TOO_NEAR if the disparity is the largest searched, MASKED by rig and `rcrop`.
        Raises as `disparity`, and StereovoxError if the pair's camera has no baseline.
        """
        camera = frame.pair.camera
        if camera.baseline is None:
            raise StereovoxError(f"stereo pair '{frame.pair.name}': its camera has no baseline; give it in metres")
        found = self.disparity(frame)
        depth_m = self._depth(found, camera)
        pose = _eye_pose(frame.T_world_sensor, camera.baseline, self.config.aligned)
        camera = replace(camera, subpixel=camera.subpixel or self.config.subpixel)
        return Frame(
            depth_m, camera, pose, frame.stamp_ns, reason=found.reason, name=frame.name, sensor=frame.sensor,
            pose_off_ns=frame.pose_off_ns,
            pose_sigma=frame.pose_sigma,
        )  # fmt: skip

    def _depth(self, found: Disparity, camera: VirtualCamera) -> NDArray[np.float32]:
        """Return the depth (height, width) in metres; a few rows at a time stay in the cache."""
        depth_m = np.empty(found.disparity.shape, np.float32)

        def fill(part: slice) -> None:
            for first in range(part.start, part.stop, ROWS):
                rows = slice(first, min(first + ROWS, part.stop))
                far = found.reason[rows] == Reason.TOO_FAR
                least = np.where(far, np.float32(FAR_PX), found.disparity[rows])
                depth_m[rows] = camera.depth_of(least, self.config.aligned)

        in_shards(fill, shards(len(depth_m), self.config.threads))
        return depth_m

    def disparity(self, frame: StereoFrame) -> Disparity:
        """Return the disparity of the aligned image, after rectification if the pair has `eyes`.

        Raises FrameRefused: the source's `fault`, `bad_dtype`, `bad_shape`.
        """
        frame = grey_rectified(frame)
        left, right = frame.left, frame.right
        config = self._decided(left.shape)
        raw = self._raw(left, right, config)
        sides = (left, _checked(frame.pair.valid, frame)), (right, _checked(frame.pair.valid_right, frame))
        (image, valid), (_, valid_other) = sides if self.config.aligned == "left" else sides[::-1]
        return explained(raw, image, valid, valid_other, config)

    def _decided(self, shape: tuple[int, ...]) -> StereoConfig:
        """Return the settings with `halve` decided for images of this shape."""
        if self.config.halve is not None:
            return self.config
        return self.config.model_copy(update={"halve": shape[0] * shape[1] > LARGE})

    def _raw(self, left: NDArray[np.uint8], right: NDArray[np.uint8], config: StereoConfig) -> NDArray[np.float32]:
        halve = bool(config.halve)
        if halve not in self._matchers:
            self._matchers[halve] = make_matcher(_of_half(config) if halve else config)
        if not halve:
            return match_aligned(self._matchers[halve], left, right, config.aligned)
        return doubled(
            match_aligned(self._matchers[halve], halved(left), halved(right), config.aligned),
            left.shape,
            config.threads,
        )


def _of_half(config: StereoConfig) -> StereoConfig:
    """Return the settings in pixels of halved images."""
    return config.model_copy(
        update={
            "block_size": max(3, config.block_size // 2 | 1),
            "disparities": max(16, -(-config.disparities // 32) * 16),
            "speckle_size": config.speckle_size // 4,
            "speckle_range": config.speckle_range / 2,
            "left_right": config.left_right / 2,
        }
    )


def _checked(mask: NDArray[np.bool_] | None, frame: StereoFrame) -> NDArray[np.bool_] | None:
    size = frame.pair.camera.height, frame.pair.camera.width
    if mask is not None and mask.shape != size:
        raise StereovoxError(f"stereo pair '{frame.pair.name}': mask is {mask.shape}, its camera has {size}")
    return mask


def grey_rectified(frame: StereoFrame) -> StereoFrame:
    """Return a stereo frame with rectified grey images (height, width) of the size of its pair's camera.

    Raises FrameRefused: the source's `fault`, `bad_dtype`, `bad_shape`.
    """
    if frame.fault:
        raise FrameRefused(frame.fault, frame.fault_detail or f"{frame.name}: {frame.fault}")
    frame = _rectified(frame)
    camera, name = frame.pair.camera, name_of(frame)
    left, right = (
        grey(image, (camera.width, camera.height), f"{name}: {side} image")
        for image, side in ((frame.left, "left"), (frame.right, "right"))
    )
    return replace(frame, left=left, right=right)


def _rectified(frame: StereoFrame) -> StereoFrame:
    if frame.pair.eyes is None:
        return frame

    return rectified(frame)


def grey(image: NDArray[np.uint8], size: tuple[int, int], name: str) -> NDArray[np.uint8]:
    """Return a grey or RGB image (height, width[, 3]) as a grey one (height, width); `name` names it in messages.

    Its size must be (width, height) = `size`. Raises FrameRefused: `bad_dtype`, `bad_shape`.
    """
    if not isinstance(image, np.ndarray) or image.dtype != np.uint8:
        raise FrameRefused("bad_dtype", f"{name} is {getattr(image, 'dtype', type(image).__name__)}; give uint8")
    if image.shape not in (size[::-1], (*size[::-1], 3)):
        raise FrameRefused("bad_shape", f"{name} is {image.shape}, its camera has ({size[1]}, {size[0]})")
    if image.ndim == 2:
        return np.ascontiguousarray(image)
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _eye_pose(T_world_left: Transform, baseline: float, aligned: str) -> Transform:
    """Return T_world_eye (4, 4): the right eye is one baseline along x from the left."""
    T = matrix_of(T_world_left)
    if T.shape != (4, 4):
        return T_world_left  # `prepare` refuses it with the reason
    if aligned == "right":
        T[:3, 3] += T[:3, 0] * baseline
    return T


BAND_ROWS = 64
"""Rows of a map made at once: the lens model needs some hundred bytes a pixel."""


class Maps(NamedTuple):
    """Positions of a virtual camera's pixels in an image.

    columns, rows: (height, width) float32 pixels, -2 outside the lens's view. valid: (height, width) bool.
    """

    columns: NDArray[np.float32]
    rows: NDArray[np.float32]
    valid: NDArray[np.bool_]


class _Prepared(NamedTuple):
    left: Maps
    right: Maps
    pair: StereoPair


_PREPARED: WeakKeyDictionary[StereoPair, _Prepared] = WeakKeyDictionary()


def rectified(frame: StereoFrame) -> StereoFrame:
    """Return the frame with both images rectified to `pair.camera`, and a pair without eyes.

    Unchanged if the pair has no eyes or the frame has a fault. `valid` and `valid_right` of the new pair are
    also False outside the lens's view; pixels there are 0. All frames of one pair share one new
    pair. Raises FrameRefused: `bad_shape` for images of another size than the lenses', `bad_dtype`.
    """
    if frame.pair.eyes is None or frame.fault:
        return frame
    _check(frame)
    left, right, pair = _prepared(frame.pair)
    return replace(frame, left=warped(frame.left, left), right=warped(frame.right, right), pair=pair)


def warped(image: NDArray[np.uint8], maps: Maps) -> NDArray[np.uint8]:
    """Return an image (height, width) or (height, width, 3) resampled at `maps`, bilinear; 0 outside."""
    import cv2

    taken = cv2.remap(image, maps.columns, maps.rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
    return np.asarray(taken, np.uint8)


def maps_of(lens: Lens, R_lens_camera: NDArray[np.float64], camera: VirtualCamera) -> Maps:
    """Return where `lens` shows the rays of `camera`'s pixels, turned by R_lens_camera (3, 3)."""
    across, down = camera.rays()
    found = np.empty((camera.height, camera.width, 2), np.float32)
    for start in range(0, camera.height, BAND_ROWS):
        part = down[start : start + BAND_ROWS].astype(float)
        rays = np.empty((len(part), camera.width, 3))
        rays[..., 0], rays[..., 1:] = across, part[:, None]
        found[start : start + BAND_ROWS] = lens.project(rays.reshape(-1, 3) @ R_lens_camera.T).reshape(
            -1, camera.width, 2
        )
    u, v = found[..., 0], found[..., 1]
    valid = (u >= 0) & (u <= lens.width - 1) & (v >= 0) & (v <= lens.height - 1)  # False for NaN
    nowhere = np.float32(-2)
    return Maps(np.where(valid, u, nowhere), np.where(valid, v, nowhere), valid)


def _prepared(pair: StereoPair) -> _Prepared:
    found = _PREPARED.get(pair)
    if found is None:
        found = _PREPARED[pair] = _prepare(pair)
    return found


def _prepare(pair: StereoPair) -> _Prepared:
    assert pair.eyes is not None
    R_left, R_right = pair.eyes.rectifying_rotations()
    left, right = maps_of(pair.eyes.left, R_left, pair.camera), maps_of(pair.eyes.right, R_right, pair.camera)
    valid, valid_right = _both(left.valid, pair.valid), _both(right.valid, pair.valid_right)
    return _Prepared(left, right, replace(pair, eyes=None, valid=valid, valid_right=valid_right))


def _both(seen: NDArray[np.bool_], allowed: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    return seen if allowed is None else seen & allowed


def _check(frame: StereoFrame) -> None:
    assert frame.pair.eyes is not None
    for side, image, lens in (
        ("left", frame.left, frame.pair.eyes.left),
        ("right", frame.right, frame.pair.eyes.right),
    ):
        name = frame.name or f"frame at {frame.stamp_ns} ns"
        if image.dtype != np.uint8:
            raise FrameRefused("bad_dtype", f"{name}: the {side} image is {image.dtype}; give uint8")
        if image.shape not in ((lens.height, lens.width), (lens.height, lens.width, 3)):
            wanted = f"the lens of pair '{frame.pair.name}' has {(lens.height, lens.width)}"
            raise FrameRefused(
                "bad_shape", f"{name}: the {side} image is {image.shape}, {wanted}; calibrate at this size"
            )
