# SPDX-License-Identifier: Apache-2.0
"""Correlation of the errors of neighbouring pixels, and the number of independent measurements in a patch."""

from __future__ import annotations

from dataclasses import dataclass
from math import e, sqrt

import numpy as np
from numpy.typing import NDArray

from stereovox.sensors.noise import kept_by_means

LAGS = 16
"""Pixels up to which errors are compared."""
SHAPE_FROM = 12
"""Correlation at this lag and beyond is due to the shape of the wall's image, not noise, and is subtracted."""
LEAST = 0.05
"""A correlation below this counts as zero and ends the sum."""
INDEPENDENT = 1.02
"""Sums up to this mean independent pixels."""
WIDEST_PX = 8.0
"""Largest standard deviation in pixels of the fitted Gaussian."""


@dataclass(frozen=True)
class Correlation:
    """Correlation of the errors of pixels 0 to LAGS apart.

    rows, columns: along a row and along a column; 1 at lag 0.
    """

    rows: tuple[float, ...]
    columns: tuple[float, ...]

    @classmethod
    def of(cls, products: NDArray[np.float64]) -> Correlation:
        """Return the correlation from sums as `add_products` makes them; independent pixels if there are no errors."""
        means = products[..., 0] / np.maximum(products[..., 1], 1)
        if not (means[:, 0] > 0).all():
            means = np.broadcast_to(np.arange(LAGS + 1) == 0, means.shape).astype(float)
        means = means / means[:, :1]
        shape = np.maximum(means[:, SHAPE_FROM:].mean(axis=1, keepdims=True), 0)
        rows, columns = (means - shape) / np.maximum(1 - shape, 1e-6)
        return cls(tuple(rows.tolist()), tuple(columns.tolist()))

    @property
    def length_px(self) -> float:
        """Standard deviation in pixels of the Gaussian that, smoothing independent noise, makes large patches as noisy.

        0: pixels are independent. For noise smoothed by it the correlation falls to 1/e at twice that.
        """
        share = sqrt(_sum(self.rows) * _sum(self.columns))
        if share < INDEPENDENT:
            return 0.0
        widths = np.linspace(0, WIDEST_PX, 801)
        return float(np.interp(share, [kept_by_means(width) for width in widths.tolist()], widths))

    @property
    def falls_to_1_e_px(self) -> tuple[float, float]:
        """Pixels at which the correlation along rows and along columns falls to 1/e; LAGS if it does not."""
        return _falls(self.rows), _falls(self.columns)

    def looks(self, side: int) -> float:
        """Return the number of independent measurements in a patch of side x side pixels, for side up to LAGS.

        That many independent ones would have an equally noisy mean. The correlation along a diagonal is taken as the
        product of row and column correlations, as for a Gaussian.
        """
        weights = 1 - np.arange(side) / side
        counts = [1 + 2 * float(np.sum(weights[1:] * line[1:side])) for line in (self.rows, self.columns)]
        return side * side / max(counts[0] * counts[1], 1e-9)


def add_products(products: NDArray[np.float64], errors: NDArray[np.floating]) -> None:
    """Add to `products` (2, LAGS + 1, 2), for each lag along rows and columns, the products' sum and number.

    errors: (height, width), NaN if missing.
    """
    known = np.isfinite(errors)
    values, there = np.where(known, errors, 0).astype(np.float32), known.astype(np.float32)
    for axis in range(2):
        across, there_ = (values.T, there.T) if axis else (values, there)
        across, there_ = np.ascontiguousarray(across), np.ascontiguousarray(there_)
        width = across.shape[1]
        for lag in range(min(LAGS + 1, width)):
            cut = width - lag
            products[axis, lag] += (
                np.einsum("ij,ij->", across[:, :cut], across[:, lag:], dtype=np.float64),
                np.einsum("ij,ij->", there_[:, :cut], there_[:, lag:], dtype=np.float64),
            )


def _sum(line: tuple[float, ...]) -> float:
    """Return the sum of a correlation over lags of both signs, up to its end."""
    values = np.array(line)
    ends = np.flatnonzero(values < LEAST)
    return 1 + 2 * float(values[1 : ends[0] if ends.size else len(values)].sum())


def _falls(line: tuple[float, ...]) -> float:
    values = np.array(line)
    below = np.flatnonzero(values < 1 / e)
    if not below.size:
        return float(LAGS)
    i = int(below[0])
    return float(i - 1 + (values[i - 1] - 1 / e) / (values[i - 1] - values[i]))
