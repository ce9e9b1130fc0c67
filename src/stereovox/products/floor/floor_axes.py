# SPDX-License-Identifier: Apache-2.0
"""Heights and floors of maps whose `up` is any axis."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.errors import StereovoxError

MAX_CELLS = 2**30
"""Cells of the largest grid."""
MAX_TILT = np.radians(10.0)
"""Largest angle between a map's layers and the floor."""
Heights = tuple[float, float]
"""Lowest and highest metres above the floor."""


def floor_axes(up: str) -> tuple[int, int, int, int]:
    """Return the map axes that are x and y of its floor, the axis normal to the floor, and the sign of the latter along
    `up`.

    x and y are the map's if z is up; else the two axes that make a right-handed frame with `up`: y and z for x, z
    and x for y, and with a minus the same two swapped.
    """
    upright = "xyz".index(up[-1])
    x, y = (upright + 1) % 3, (upright + 2) % 3
    return (y, x, upright, -1) if up.startswith("-") else (x, y, upright, 1)


def upright_axes(up: str) -> NDArray[np.float64]:
    """Return rows (3, 3) x, y and z of a right-handed frame whose z is a map's `up`, as directions in the map's frame.

    These are the axes of the grid from `projection.project`.
    """
    x, y, upright, sign = floor_axes(up)
    unit = np.eye(3)
    return np.stack([unit[x], unit[y], sign * unit[upright]])


def up_of(config: Config) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points up in the world of a map with these settings."""
    return upright_axes(config.up)[2] if config.up_direction is None else np.array(config.up_direction)


def nearest_axis(direction: NDArray[np.float64]) -> str:
    """Return the axis (`z`, `-y`, ...) that is nearest to a direction (3,)."""
    k = int(np.argmax(np.abs(direction)))
    return f"{'-' if direction[k] < 0 else ''}{'xyz'[k]}"


def heights_of(points: ArrayLike, up: str) -> NDArray[np.float64]:
    """Return the heights (N,) in metres of points (N, 3)."""
    _, _, upright, sign = floor_axes(up)
    return np.asarray(points, float)[:, upright] * sign


def checked_heights(heights: Heights) -> Heights:
    """Validate two heights; raises StereovoxError if they do not ascend."""
    low, high = heights
    if not low < high:
        raise StereovoxError(f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres")
    return low, high


def checked_band(heights: Heights) -> Heights:
    """Validate two heights above the floor; raises StereovoxError if they do not ascend from 0 or more."""
    low, high = heights
    if not (0 <= low < high < np.inf):
        raise StereovoxError(
            f"heights {low:g}:{high:g} must be two numbers that rise, LO:HI in metres above the floor, 0 or more"
        )
    return low, high


def check_level(config: Config) -> None:
    """Raise StereovoxError if the layers of a map are too far from level to show a floor."""
    if config.tilt > MAX_TILT:
        tilt = f"{np.degrees(config.tilt):.0f} degrees off {config.up}"
        raise StereovoxError(f"up is {tilt}, so no layer of the map is level; map the recording again with --level")
