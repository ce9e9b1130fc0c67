# SPDX-License-Identifier: Apache-2.0
"""Random cameras and stereo pairs: small ordinary ones, and odd ones of any shape that a constructor accepts."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.cameras.pinhole import CORRECTIONS, DepthCorrection
from stereovox.cameras.rigs import Eyes, StereoPair, VirtualCamera
from stereovox.cameras.wide import CylindricalCamera, Lens, SphericalCamera
from stereovox.errors import StereovoxError

BASELINES = (None, None, 0.05, 1e-6, 50.0)
ODD_SIZES = (1, 1, 2, 3, 7, 16, 40, 97, 400)
"""Pixels; width and height are drawn separately."""
ODD_FOCALS = (1e-300, 1e-30, 1e30, 1e300, -20.0, 0.0, np.nan, np.inf)
LARGE = ((640, 480, 580.0), (848, 480, 420.0), (1280, 720, 640.0), (320, 240, 150.0))
RARE = (
    sv.PinholeCamera(16, 12, 0.9, 0.9, 0.0, 0.0), SphericalCamera(9, 7, 0.33, 0.8, 4.0, 3.0, 1e-6),
    CylindricalCamera(12, 9, 0.5, 0.6, 5.5, 4.0, 1e-6),
    sv.PinholeCamera(9, 7, 9.0, 9.0, 4.0, 3.0, correction=DepthCorrection("scale", (0.0,) * 6)),
)  # fmt: skip
"""Cameras with rare needs: cells so far to the side that their indices take 64 bits, and a correction."""
TRIES = 50
"""Most odd cameras drawn until one is accepted."""


class RandomCameras:
    """Draws cameras. odd: include some that nobody builds but anyone can specify."""

    def __init__(self, rng: np.random.Generator, odd: bool = True):
        self._rng, self._odd_too = rng, odd

    def camera(self) -> VirtualCamera:
        """Return a camera; one in three is odd."""
        if self._odd_too and self._chance(0.35):
            for _ in range(TRIES):
                try:
                    return self._one_of((self._odd_pinhole, self._odd_spherical, self._odd_cylindrical))()
                except StereovoxError:  # a constructor may raise nothing else
                    continue
        return self._wide() if self._chance(0.15) else self._pinhole()

    def large(self) -> VirtualCamera:
        """Return a camera of realistic size."""
        width, height, focal = self._one_of(LARGE)
        if self._chance(0.2):
            kind = self._one_of((SphericalCamera, CylindricalCamera))
            return kind.from_field_of_view(width, height, self._rng.uniform(60, 170), self._rng.uniform(60, 180), 0.05)
        return sv.PinholeCamera(width, height, focal, focal, width / 2, height / 2, 0.05)

    def pair(self, model: str | None) -> StereoPair:
        """Return a stereo pair: rectified, or with fisheye lenses to be rectified to a camera of the model."""
        width, height = int(self._rng.integers(20, 70)), int(self._rng.integers(8, 40))
        if model is None:
            return StereoPair(sv.PinholeCamera(width, height, 40.0, 40.0, width / 2, height / 2, 0.1))
        lens = Lens.from_field_of_view("fisheye", width, height, 160.0)
        T_left_right = np.eye(4)
        T_left_right[0, 3] = 0.1
        return StereoPair.from_eyes(Eyes(lens, lens, T_left_right), model, size=(40, 30))

    def _pinhole(self) -> sv.PinholeCamera:
        rng = self._rng
        width, height = int(rng.integers(1, 25)), int(rng.integers(1, 19))
        focal = self._one_of((20.0, 20.0, 60.0, 600.0, 1e5))
        u, v = self._one_of((0.5, 0.5, 0.0, -3.0)) * width, self._one_of((0.5, 0.5, 0.0, 9.0)) * height
        correction = self._correction() if self._chance(0.1) else None
        return sv.PinholeCamera(width, height, focal, focal, u, v, self._one_of(BASELINES), correction=correction)

    def _wide(self) -> VirtualCamera:
        rng, kind = self._rng, self._one_of((SphericalCamera, CylindricalCamera))
        width, height = int(rng.integers(1, 25)), int(rng.integers(1, 19))
        return kind.from_field_of_view(width, height, rng.uniform(5, 170), rng.uniform(5, 359), self._one_of(BASELINES))

    def _odd_pinhole(self) -> sv.PinholeCamera:
        width, height = self._size()
        focal = self._focal()
        return sv.PinholeCamera(
            width, height, focal, focal if self._chance(0.5) else self._focal(), self._middle(width),
            self._middle(height), self._one_of(BASELINES), correction=self._correction() if self._chance(0.3) else None,
            **self._sensor(),
        )  # fmt: skip

    def _odd_spherical(self) -> SphericalCamera:
        width, height = self._size()
        steps = self._span(88) / width, self._span(360) / height
        middles = self._middle(width), self._middle(height)
        return SphericalCamera(width, height, *steps, *middles, self._one_of(BASELINES), **self._sensor())

    def _odd_cylindrical(self) -> CylindricalCamera:
        width, height = self._size()
        middles = self._middle(width), self._middle(height)
        step = self._span(360) / height
        return CylindricalCamera(
            width, height, self._focal(), step, *middles, self._one_of(BASELINES), **self._sensor()
        )

    def _size(self) -> tuple[Any, Any]:
        width, height = self._one_of(ODD_SIZES), self._one_of(ODD_SIZES)
        kind: Callable[[int], Any] = self._one_of((int, int, int, int, np.int64, np.uint16, float))
        return kind(width), kind(height)

    def _focal(self) -> float:
        """Return pixels from a thousandth to ten millions, and occasionally an invalid value."""
        return self._one_of(ODD_FOCALS) if self._chance(0.03) else float(10 ** self._rng.uniform(-3, 7))

    def _span(self, widest_deg: float) -> float:
        """Return an angle in radians, narrow and wide ones equally often."""
        return float(np.radians(10 ** self._rng.uniform(-5, np.log10(widest_deg))))

    def _middle(self, size: Any) -> float:
        """Return a principal point, possibly outside the image."""
        if self._chance(0.1):
            return self._one_of((np.nan, np.inf, -1e300, 1e6, -1e4, 1e30))
        return float(self._one_of((0.5, 0.5, 0.5, 0.0, 1.0, self._rng.uniform(-2, 3))) * size)

    def _sensor(self) -> dict[str, Any]:
        return {
            "binning": self._one_of((1, 1, 1, 2, 8, 1000)),
            "subpixel": self._one_of((None, None, 0.08, 1e-9, 1e9)),
        }

    def _correction(self) -> DepthCorrection:
        model, scale = self._one_of(tuple(CORRECTIONS)), self._one_of((1e-3, 1.0, 1e30))
        return DepthCorrection(model, tuple(self._rng.normal(size=CORRECTIONS[model]) * scale))

    def _one_of(self, choices: Any) -> Any:
        return choices[self._rng.integers(len(choices))]

    def _chance(self, share: float) -> bool:
        return self._rng.random() < share
