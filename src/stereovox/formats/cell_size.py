# SPDX-License-Identifier: Apache-2.0
"""Suggest a cell size from the density and the extent of points."""

from __future__ import annotations

from math import floor, log10
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

SAMPLE, QUERIES = 400_000, 4_000
"""Points sampled from a larger cloud, and how many of them are queried for their neighbours."""
NEIGHBOUR = 4
"""Neighbour whose distance counts: on a surface of even density it is about the spacing of the points."""
FEWEST = 10
"""Distinct points below which nothing is suggested."""
PER_CELL = 2.0
"""Cells per spacing: with fewer a surface has holes."""
MOST_ALONG = 2000
"""Cells along the longest side of the cloud."""
LARGEST = 100.0
"""Metres; the settings allow no larger cells."""
MESH_ALONG = 256
"""Cells along the longest side of a mesh, whose vertices give no cell size."""
OUTLIERS = 0.1
"""Per cent of the points at each end of an axis that its extent leaves out."""
STEPS = (1, 2, 5, 10)


class SuggestedCell(NamedTuple):
    """voxel_size: metres, 1, 2 or 5 times a power of ten. why: a short reason. spacing: metres between neighbours."""

    voxel_size: float
    why: str
    spacing: float | None = None


def suggested_cell(xyz: NDArray[np.float64]) -> SuggestedCell | None:
    """Return the cell size for finite points (N, 3) in metres; None if they are too few, or all in one place.

    Twice the typical distance of neighbouring points, so that a surface has no holes; larger if the longest side
    would have more than `MOST_ALONG` cells.
    """
    spacing = typical_spacing(xyz)
    if spacing is None:
        return None
    extent = float(extents(xyz).max())
    if extent / MOST_ALONG > PER_CELL * spacing:
        return SuggestedCell(_allowed(extent / MOST_ALONG), f"since it is {extent:.3g} m long", spacing)
    return SuggestedCell(
        _allowed(PER_CELL * spacing),
        f"since its points are about {spacing if spacing < 10 else round(spacing):.3g} m apart",
        spacing,
    )


def suggested_for_mesh(vertices: NDArray[np.float64]) -> SuggestedCell | None:
    """Return the cell size for a mesh with vertices (N, 3) in metres; None if all are in one place."""
    extent = float(np.ptp(vertices, axis=0).max()) if len(vertices) else 0.0
    if not extent > 0:
        return None
    return SuggestedCell(_allowed(extent / MESH_ALONG), f"since it is {extent:.3g} m long")


def typical_spacing(xyz: NDArray[np.float64]) -> float | None:
    """Return the median distance in metres of points (N, 3) from their `NEIGHBOUR`-th neighbour; None: too few points.

    A large cloud is sampled, and the distances are scaled as on surfaces.
    """
    from scipy.spatial import KDTree

    dice = np.random.default_rng(0)
    some = xyz if len(xyz) <= SAMPLE else xyz[dice.choice(len(xyz), SAMPLE, replace=False)]
    points = np.unique(some, axis=0)
    if len(points) < FEWEST:
        return None
    asked = points if len(points) <= QUERIES else points[dice.choice(len(points), QUERIES, replace=False)]
    distances, _ = KDTree(points, balanced_tree=False, compact_nodes=False).query(asked, NEIGHBOUR + 1)
    spacing = float(np.median(distances[:, NEIGHBOUR])) * np.sqrt(len(some) / len(xyz))
    return spacing if spacing > 0 and np.isfinite(spacing) else None


def extents(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the length (3,) of points (N, 3) along each axis, without outliers."""
    low, high = np.percentile(xyz, [OUTLIERS, 100 - OUTLIERS], axis=0)
    return high - low


def _allowed(number: float) -> float:
    return min(rounded_up(number), LARGEST)


def rounded_up(number: float) -> float:
    """Return the next of 1, 2 and 5 times a power of ten that is not below a positive number."""
    power = floor(log10(number))
    steps = (float(f"{step}e{power}") for step in STEPS)
    return next(rounded for rounded in steps if rounded >= number * (1 - 1e-9))
