# SPDX-License-Identifier: Apache-2.0
"""Scale of displayed log-odds, with colours: plain, or as the bytes that a map stores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import VoxelMap
from stereovox.maps.cells.cell_format import CellFormat, CellRules

COLOURS = ("#1f5f8b", "#6fa8c9", "#eef0ee", "#e8a27a", "#c23b2a")
"""From certainly free to certainly occupied, at equal steps; the middle means no evidence."""


@dataclass(frozen=True)
class Scale:
    """How a map's log-odds are displayed.

    label: name of the numbers; unknown, free_below, occupied_above, lowest, highest: in these numbers.
    """

    label: str
    cell_format: CellFormat
    unknown: float
    free_below: float
    occupied_above: float
    lowest: float
    highest: float

    def shown(self, log_odds: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the numbers to show for log-odds of any shape; NaN stays NaN."""
        values = np.asarray(log_odds, float)
        if not self.unknown:
            return values
        return np.where(np.isnan(values), np.nan, self.cell_format.stored(np.nan_to_num(values)))

    def colours(self) -> tuple[Any, Any]:
        """Return matplotlib's colour map and norm; no evidence is in the middle."""
        from matplotlib.colors import LinearSegmentedColormap, Normalize

        reach = max(self.highest - self.unknown, self.unknown - self.lowest)
        colours = LinearSegmentedColormap.from_list("log-odds", COLOURS)
        return colours, Normalize(self.unknown - reach, self.unknown + reach)


def scale_of(voxel_map: VoxelMap) -> Scale:
    """Return the scale of a map: log-odds, or bytes for a map that keeps bytes (Chien 2020, 3.5)."""
    rules = CellRules(voxel_map.config.map)
    cell_format = rules.format
    in_bytes = bool(cell_format.unknown)
    unit = 1.0 if in_bytes else cell_format.per_log_odds
    numbers = (rules.free_below, rules.occupied_above, float(rules.lowest), float(rules.highest))
    label = f"cell value ({cell_format.unknown}: unknown)" if in_bytes else "log-odds"
    return Scale(label, cell_format, float(cell_format.unknown), *(number / unit for number in numbers))
