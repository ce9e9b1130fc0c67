# SPDX-License-Identifier: Apache-2.0
"""Precision and recall by distance from the camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.curves import shares
from stereovox.evaluate.truth_cells import Reading, TruthCells

RINGS = 8


@dataclass(frozen=True, eq=False)
class ByDistance:
    """Precision and recall of the cells in M rings; ring i covers edges[i] <= distance < edges[i + 1], in metres.

    edges: (M + 1,). marked, surface: (M,) number of cells that the map calls occupied, and of truly occupied ones.
    The others: (M,), NaN in a ring without such cells.
    """

    edges: NDArray[np.float64]
    marked: NDArray[np.int64]
    surface: NDArray[np.int64]
    precision: NDArray[np.float64]
    recall: NDArray[np.float64]
    tolerance_precision: NDArray[np.float64]
    tolerance_recall: NDArray[np.float64]

    def rows(self) -> list[dict[str, float | None]]:
        """Return one dict per ring for JSON: `from_m`, `to_m` and the values of the arrays, None instead of NaN."""
        columns = {"from_m": self.edges[:-1], "to_m": self.edges[1:], **vars(self)}
        columns.pop("edges")
        rows = zip(*(column.tolist() for column in columns.values()), strict=True)
        return [{name: None if x != x else x for name, x in zip(columns, row, strict=True)} for row in rows]


def by_distance(
    reading: Reading, truth: TruthCells, path: ArrayLike, threshold: float, edges: ArrayLike | None = None
) -> ByDistance:
    """Compute precision and recall by distance to the nearest camera position.

    path: camera positions (P, 3), or one (3,), in metres, world frame. edges: rising limits (M + 1,) of the rings in
    metres; by default about eight of a round width. Cells beyond the last are left out; unobserved cells count as free.
    Raises StereovoxError for an invalid path.
    """
    distance = distances(truth.centers(), path)
    limits = round_edges(float(distance.max())) if edges is None else np.asarray(edges, float)
    marked, actual = reading.marked(threshold), truth.occupied
    chosen = (marked, actual, marked & actual, marked & truth.near)
    n_marked, n_surface, right, close = (np.histogram(distance[cells], limits)[0] for cells in chosen)
    found = np.histogram(distance[actual][reading.found(threshold)], limits)[0]
    return ByDistance(
        limits,
        n_marked,
        n_surface,
        shares(right, n_marked),
        shares(right, n_surface),
        shares(close, n_marked),
        shares(found, n_surface),
    )


def distances(points: NDArray[np.float64], path: ArrayLike) -> NDArray[np.float64]:
    """Return the distance (N,) in metres from each point (N, 3) to the nearest position of `path` (P, 3)."""
    from scipy.spatial import KDTree

    positions = np.asarray(path, float)
    if positions.size == 0 or positions.shape[-1] != 3 or not np.isfinite(positions).all():
        raise StereovoxError(f"a path of shape {positions.shape} is not a list of points; give (P, 3) metres")
    return KDTree(positions.reshape(-1, 3)).query(points)[0]


def round_edges(maximum: float) -> NDArray[np.float64]:
    """Return edges from 0 to beyond `maximum`, in about eight steps of 1, 2 or 5 times a power of ten."""
    rough = max(maximum, 1e-3) / RINGS
    power = 10.0 ** np.floor(np.log10(rough))
    width = next(step * power for step in (1, 2, 5, 10) if step * power >= rough * (1 - 1e-9))
    return width * np.arange(np.floor(maximum / width) + 2)
