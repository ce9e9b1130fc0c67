# SPDX-License-Identifier: Apache-2.0
"""Thickness of the surface in a cell: line, sheet or bulk, by the surface cells around it."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.truth_cells import Neighbourhood

WINDOW = 2
"""Cells inspected to each side."""
THIN = 2.5
"""Extent in cells below which a shape counts as one or two cells thick."""


class Thickness(IntEnum):
    """Shape of the surface cells around a cell.

    LINE: one or two cells across in two directions, like poles, wires, table legs and lone cells. SHEET: in one
    direction, like walls and floors, with their edges and corners. BULK: in none, where surfaces meet.
    """

    LINE = 0
    SHEET = 1
    BULK = 2


def thickness(surface: Neighbourhood) -> NDArray[np.uint8]:
    """Return the `Thickness` (S,) uint8 of each surface cell.

    It uses the surface cells in the cube of 5 cells a side around it, in any orientation: a row of w cells has
    the variance (w^2 - 1) / 12, so that sqrt(12 v + 1) is the extent in cells along a principal axis of variance v.
    """
    variances = np.linalg.eigvalsh(surface.spread(WINDOW))  # (S, 3), ascending
    extents = np.sqrt(12 * np.maximum(variances, 0) + 1)
    return (extents >= THIN)[:, :2].sum(axis=1).astype(np.uint8)
