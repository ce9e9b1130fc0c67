# SPDX-License-Identifier: Apache-2.0
"""The axes of a map for those who want to look at it, or drive in it, with the height third."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def upright_axes(up: str) -> NDArray[np.float64]:
    """Return rows (3, 3) x, y and z of a right-handed frame whose z is a map's `up`, as directions in the map's frame.

    up: as in the settings, `z` or `-y`. They are the axes of `projection.project`'s grid, and its floor's frame.
    """
    axis = "xyz".index(up[-1])
    unit = np.eye(3)
    across, along = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
    return np.stack([along, across, -unit[axis]] if up.startswith("-") else [across, along, unit[axis]])
