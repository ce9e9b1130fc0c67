# SPDX-License-Identifier: Apache-2.0
"""Correct depth images by what `stereovox calibrate wall` found out about their camera (Chien 2020, App. A)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras import DepthCorrection, PinholeCamera
from stereovox.depth import _correct, _cpu


def corrected(
    raw: NDArray[np.generic], scale: np.float32, none: np.float32, infinite: np.float32, camera: PinholeCamera
) -> NDArray[np.float32]:
    """Return the corrected depth (height * width,) in metres, float32, of a flat raw image; NaN: no value.

    scale: metres per unit; none, infinite: as in `_cpu.classify`; infinities stay what they are. A pixel whose
    correction leads to no positive depth has no value either: this clears nothing.
    """
    depth_m = np.empty(raw.size, np.float32)
    _cpu.classify(raw, scale, np.float32(0), np.float32(np.inf), none, infinite, depth_m, np.empty(raw.size, np.uint8))
    correct(depth_m.reshape(camera.height, camera.width), camera)
    return depth_m


def correct(depth_m: NDArray[np.float32], camera: PinholeCamera) -> None:
    """Correct (height, width) float32 metres in place by the camera's `correction`; NaN and infinities stay."""
    if camera.correction is None:
        return
    x, y = camera.ray_slopes()
    if camera.correction.model == "thesis":
        _correct.thesis(np.array(camera.correction.coefficients, np.float32), x, depth_m)
    else:
        s, q = quadratics(camera.correction)
        _correct.quadratics(s.astype(np.float32), q.astype(np.float32), x, y, depth_m)


def quadratics(correction: DepthCorrection) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the coefficients (6,) of s and of q, see `DepthCorrection`; not for the model `thesis`."""
    numbers, nothing = np.array(correction.coefficients), np.zeros(6)
    if correction.model == "scale+disparity":
        return numbers[:6], numbers[6:]
    return (numbers, nothing) if correction.model == "scale" else (nothing, numbers)
