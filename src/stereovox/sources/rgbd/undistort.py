# SPDX-License-Identifier: Apache-2.0
"""Conversion of depth images of a distorting lens into those of a pinhole camera."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera

Image = TypeVar("Image", bound=NDArray[Any])

NEGLIGIBLE_PX = 0.5
"""Distortion of at most this is ignored."""


class Undistortion:
    """Moves the pixels of depth images to their positions in a pinhole camera with the same intrinsics.

    Each pixel takes the value of the nearest pixel of the distorted image, since depth must not be averaged across
    edges.

    Args:
        camera: The pinhole camera.
        coefficients: k1, k2, p1, p2, k3 and so on, in OpenCV's order.

    Attributes:
        moved_px: Largest displacement of a pixel; 0 if it is negligible, and then nothing is changed.
    """

    def __init__(self, camera: PinholeCamera, coefficients: Sequence[float]):
        self._maps: tuple[NDArray[Any], NDArray[Any]] | None = None
        self.moved_px = 0.0
        if not any(coefficients):
            return
        import cv2

        K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
        size = camera.width, camera.height
        columns, rows = cv2.initUndistortRectifyMap(K, np.array(coefficients), np.eye(3), K, size, cv2.CV_32FC1)
        v, u = np.mgrid[: camera.height, : camera.width]
        moved = float(np.hypot(columns - u, rows - v).max())
        if not moved <= NEGLIGIBLE_PX:
            self._maps, self.moved_px = (columns, rows), moved

    def __call__(self, image: Image) -> Image:
        """Return the undistorted image (height, width), 0 outside the distorted one."""
        if self._maps is None:
            return image
        import cv2

        return cast("Image", cv2.remap(image, *self._maps, cv2.INTER_NEAREST, borderValue=0))
