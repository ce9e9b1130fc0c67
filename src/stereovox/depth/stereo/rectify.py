# SPDX-License-Identifier: Apache-2.0
"""Rectification: both images as their pair's virtual camera would have taken them, with matching rows."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lenses import Lens
from stereovox.cameras.rigs import StereoPair, VirtualCamera
from stereovox.errors import FrameRefused
from stereovox.frame import StereoFrame

ROWS = 64
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
    for start in range(0, camera.height, ROWS):
        part = down[start : start + ROWS].astype(float)
        rays = np.empty((len(part), camera.width, 3))
        rays[..., 0], rays[..., 1:] = across, part[:, None]
        found[start : start + ROWS] = lens.project(rays.reshape(-1, 3) @ R_lens_camera.T).reshape(-1, camera.width, 2)
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
