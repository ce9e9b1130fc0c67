# SPDX-License-Identifier: Apache-2.0
"""The decisions of a map by range, by thickness of the surface, and by number of looks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.evaluate.decisions import Decisions, decide
from stereovox.evaluate.distance import distances, round_edges
from stereovox.evaluate.thickness import Thickness, thickness
from stereovox.evaluate.truth_cells import Reading, TruthCells

LOOKS = (0, 0.5, 3, 10, 30, np.inf)
"""Limits of the classes of looks: none, 1 or 2, 3 to 9, 10 to 29, 30 and more."""
LOOKS_NAMES = ("0", "1 to 2", "3 to 9", "10 to 29", "30 or more")


@dataclass(frozen=True)
class Part:
    """The decisions over a part of the truth's cells.

    by: `range`, `thickness` or `looks`; name: of the part, such as `2 to 4 m`, `line`, `3 to 9`. Thickness and looks
    refer to surface cells, so their parts have no free cells of the truth.
    """

    by: str
    name: str
    decisions: Decisions

    def as_dict(self) -> dict[str, Any]:
        """Return all numbers for JSON."""
        return {"by": self.by, "name": self.name, **asdict(self.decisions)}


def decision_parts(
    reading: Reading,
    truth: TruthCells,
    path: ArrayLike | None = None,
    edges: ArrayLike | None = None,
    looks: NDArray[np.floating] | None = None,
) -> tuple[Part, ...]:
    """Return the decisions by part; parts without cells are left out.

    path: camera positions (P, 3) in metres, world frame: parts by distance to the nearest one, in rings between `edges`
    (M + 1,) in metres or of a round width; None: not by range. looks: (S,) of each surface cell; None: not by looks.
    """
    split = [
        *_by_surface(
            "thickness", thickness(truth.neighbourhood)[truth.counted], [kind.name.lower() for kind in Thickness]
        )
    ]
    if looks is not None:
        split += _by_surface("looks", np.searchsorted(LOOKS, looks, "right") - 1, LOOKS_NAMES)
    parts = [(by, name, _as_cells(truth, chosen)) for by, name, chosen in split]
    if path is not None:
        parts = [*_by_range(truth, path, edges), *parts]
    return tuple(Part(by, name, decide(reading, truth, chosen)) for by, name, chosen in parts if chosen.any())


def _by_surface(by: str, group: NDArray[Any], names: Any) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    for i, name in enumerate(names):
        yield by, name, group == i


def _as_cells(truth: TruthCells, chosen: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which cells of the truth (N,) are the `chosen` ones of its surface (S,)."""
    cells = truth.occupied.copy()
    cells[truth.occupied] = chosen
    return cells


def _by_range(
    truth: TruthCells, path: ArrayLike, edges: ArrayLike | None
) -> Iterator[tuple[str, str, NDArray[np.bool_]]]:
    distance = distances(truth.centers(), path)
    limits = round_edges(float(distance.max())) if edges is None else np.asarray(edges, float)
    for low, high in pairwise(limits):
        yield "range", f"{low:g} to {high:g} m", (distance >= low) & (distance < high)
