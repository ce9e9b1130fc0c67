# SPDX-License-Identifier: Apache-2.0
"""Fit the models of `DepthCorrection` to walls, all by linear least squares in 1/z.

With m = 1/z measured and a plane 1/z = a + b x + c y, the models scale and disparity say a + b x + c y = m (1 + s) + q
for each pixel: linear in the coefficients of the quadratics s and q and in b and c of each wall.

What is linear across the image cannot be told from a wall that leans. So s and q have no terms x and y, and the lean is
the wall's; only walls that are known to stand square to the optical axis fix these terms too. A constant term needs
measured distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from stereovox.calibrate.surface import Array, fit_plane, terms
from stereovox.cameras import CORRECTIONS, DepthCorrection
from stereovox.depth.correct import quadratics

SIMPLEST_FIRST = ("scale", "disparity", "scale+disparity")


@dataclass(frozen=True, eq=False)
class Points:
    """Pixels of one wall: slopes x, y and measured 1/z in 1/m, each (N,).

    distance: where the optical axis meets the wall in metres, None: not known. square: the wall is known to stand
    perpendicular to the axis.
    """

    x: Array
    y: Array
    inverse: Array
    distance: float | None = None
    square: bool = False


def fit(model: str, walls: Sequence[Points]) -> DepthCorrection:
    """Return the correction of this model that makes the walls as flat as can be, in shares of their depth.

    Either all walls have a distance or none.
    """
    if model == "thesis":
        return _fit_thesis(walls)
    active = _active_terms(walls)
    count = int(active.sum()) * (2 if model == "scale+disparity" else 1)
    A, b = _equations(model, walls, active, count)
    solution = np.linalg.lstsq(A, b, rcond=None)[0][:count]
    coefficients = np.zeros((count // int(active.sum()), active.size))
    coefficients[:, active] = solution.reshape(len(coefficients), -1)
    return DepthCorrection(model, tuple(coefficients.ravel()))


def corrected_inverse(correction: DepthCorrection | None, x: Array, y: Array, inverse: Array) -> Array:
    """Return the corrected 1/z (N,) in 1/m; NaN where the correction leads to no depth."""
    if correction is None:
        return inverse
    if correction.model == "thesis":
        p1, p2, p3 = correction.coefficients
        X = x / inverse
        result = 1 / (1 / inverse - (p1 * X * X + p2 * X + p3))
    else:
        s, q = quadratics(correction)
        columns = terms(x, y)
        result = inverse * (1 + columns @ s) + columns @ q
    return np.where(result > 0, result, np.nan)


def plane_of(wall: Points, correction: DepthCorrection | None = None) -> Array:
    """Return (a, b, c) of the plane 1/z = a + b x + c y nearest to the corrected wall, through its known distance."""
    inverse = corrected_inverse(correction, wall.x, wall.y, wall.inverse)
    known = np.isfinite(inverse)
    return fit_plane(wall.x[known], wall.y[known], inverse[known], wall.distance, wall.square)


def residual(wall: Points, correction: DepthCorrection | None, plane: Array | None = None) -> Array:
    """Return (z - z_plane) / z_plane of the corrected points (N,); without `plane` that of `plane_of`."""
    a, b, c = plane_of(wall, correction) if plane is None else plane
    return (a + b * wall.x + c * wall.y) / corrected_inverse(correction, wall.x, wall.y, wall.inverse) - 1


def rms(values: Array) -> float:
    """Return the root mean square of what is not NaN; infinite where nothing is left."""
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else float("inf")


def _active_terms(walls: Sequence[Points]) -> np.ndarray:
    square = all(wall.square for wall in walls)
    measured = all(wall.distance is not None for wall in walls)
    return np.array([measured, square, square, True, True, True])


def _equations(model: str, walls: Sequence[Points], active: np.ndarray, count: int) -> tuple[Array, Array]:
    """Return A and b of the least squares problem: first the shared coefficients, then (a, b, c) of each wall."""
    rows, right = [], []
    for k, wall in enumerate(walls):
        columns = terms(wall.x, wall.y)
        m = wall.inverse[:, None]
        quadratic = columns[:, active]
        parts = {"scale": [quadratic * m], "disparity": [quadratic], "scale+disparity": [quadratic * m, quadratic]}
        planes = np.zeros((len(m), 3 * len(walls)))
        free = [wall.distance is None, not wall.square, not wall.square]
        planes[:, 3 * k : 3 * k + 3] = columns[:, :3] * free
        weight = 1 / (m * np.sqrt(len(m)))
        rows.append(np.hstack([*(-part for part in parts[model]), planes]) * weight)
        known = 0.0 if wall.distance is None else 1 / wall.distance
        right.append((m[:, 0] - known) * weight[:, 0])
    assert rows[0].shape[1] == count + 3 * len(walls)
    return np.vstack(rows), np.concatenate(right)


def _fit_thesis(walls: Sequence[Points]) -> DepthCorrection:
    """Return the quadratic in X of Chien 2020, Eq A.1 and A.2: dZ = p1 X^2 + p2 X + p3, X in metres.

    His wall is square and at a measured distance; else p2 or p3 stays zero, see the top of this file.
    """
    straight = fit("scale", walls)
    columns, errors = [], []
    for wall in walls:
        z = 1 / wall.inverse
        X = wall.x * z
        a, b, c = plane_of(wall, straight)
        weight = wall.inverse / np.sqrt(len(z))
        columns.append(np.stack([X * X, X, np.ones_like(X)], axis=1) * weight[:, None])
        errors.append((z - 1 / (a + b * wall.x + c * wall.y)) * weight)
    active = _active_terms(walls)[[3, 1, 0]]
    p = np.zeros(CORRECTIONS["thesis"])
    p[active] = np.linalg.lstsq(np.vstack(columns)[:, active], np.concatenate(errors), rcond=None)[0]
    return DepthCorrection("thesis", tuple(p))
