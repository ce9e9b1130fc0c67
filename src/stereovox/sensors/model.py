# SPDX-License-Identifier: Apache-2.0
"""What an inverse sensor model is, and how it becomes the table that kernels read."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import ConfigError
from stereovox.sensors.noise import PoseNoise, RangeNoise

Array = NDArray[np.float64]

ROWS = 128
"""Table rows: measured depths from 0 to the maximum range."""
COLUMNS = 128
"""Table columns: distances from the measurement. Even, so that no column stands exactly on the measurement."""
REACH_SIGMA = 4.0
"""The table ends this many sigma before and behind the measurement; beyond it the model is p_free or p_unknown."""

FAR_SIGMA = 12.0
"""So far from a measurement a model must have come to p_free and p_unknown."""
END_TOLERANCE = 0.02
"""How far it may still be from them there."""


class InverseSensorModel(Protocol):
    """A sensor model: a dataclass of numbers with one function. Write one in plain NumPy and register it.

    `p_free` is what the model says far before a measurement, `p_unknown` what it says far behind one. What it says of
    the cell that holds the measured point is `probability` at that point; a model that knows better, since a cell has
    a size, has another function `hit(z_measured, sigma, voxel_size)`. And where a cell that is looked through must not
    lose as much as p_free says, since what stands in it may be thinner than a pixel, a function `passed(z, sigma,
    voxel_size)` returns the least probability for it, by the depth of the cell.
    """

    @property
    def p_free(self) -> float:
        """Probability of occupancy far before a measurement."""
        ...

    @property
    def p_unknown(self) -> float:
        """Probability of occupancy far behind a measurement."""
        ...

    def probability(self, z: Array, z_measured: Array, sigma: Array) -> Array:
        """Return p(occupied) of points at depth `z` on a ray that measured `z_measured` with noise `sigma`.

        All in metres along the ray's depth axis, any shapes that broadcast. Strictly inside (0, 1).
        """
        ...


@dataclass(frozen=True, eq=False)
class SensorTable:
    """A sensor model as numbers.

    log_odds: (ROWS, COLUMNS) of a point at `z = z_measured + offset_sigma[column] * sigma[row]`; p_unknown is 0.
    hit: (ROWS,) log-odds of the cell that holds the measured point.
    passed: (ROWS,) least log-odds, not positive, of a cell at the row's depth that is looked through.
    sigma: (ROWS,) noise in metres; row r stands for measured depths around `(r + 0.5) / rows_per_metre`.
    """

    log_odds: Array
    hit: Array
    passed: Array
    sigma: Array
    rows_per_metre: float


def tabulate(
    model: InverseSensorModel,
    noise: RangeNoise,
    max_range: float,
    voxel_size: float = 0.05,
    pose_noise: PoseNoise | None = None,
) -> SensorTable:
    """Return `model` as a table for measured depths up to `max_range` metres and cells of `voxel_size` metres.

    Evidence is log(p / (1 - p)) less that of p_unknown (Valenti 2018, Eq 6.2: the prior is not counted twice). Noise
    counts up to `max_range`, so that no ray is followed farther than 1 + REACH_SIGMA times as far. Where poses are
    noisy a hit is as wide as they and the range noise make it together.
    Raises ConfigError when the model leaves (0, 1), or does not come to p_free and p_unknown far off.
    """
    z_measured: Array = (np.arange(ROWS, dtype=float) + 0.5) * (max_range / ROWS)
    sigma = np.clip(noise.sigma(z_measured), 1e-6, max_range)  # one that is noisier could be anywhere, too
    z = z_measured[:, None] + offset_sigma() * sigma[:, None]
    _check_ends(model, z_measured, sigma)
    log_odds = _log_odds(model, model.probability(z, z_measured[:, None], sigma[:, None]))
    log_odds[:, -1] = 0  # what lies farther behind is looked up there, and nothing is said about it
    at = model.probability(z_measured, z_measured, sigma)
    width = sigma if pose_noise is None else np.hypot(sigma, pose_noise.sigma(z_measured))
    hit = _log_odds(model, model.hit(z_measured, width, voxel_size) if hasattr(model, "hit") else at)  # pyright: ignore
    passed = np.full(ROWS, log_odds[:, 0].mean())
    if hasattr(model, "passed"):
        least = _log_odds(model, model.passed(z_measured, width, voxel_size))  # pyright: ignore
        passed = np.clip(least, passed, 0)
    return SensorTable(log_odds, hit, passed, sigma, ROWS / max_range)


def offset_sigma() -> Array:
    """Return the distance (COLUMNS,) of each table column from the measurement, in sigma."""
    return ((np.arange(COLUMNS, dtype=float) + 0.5) / COLUMNS * 2 - 1) * REACH_SIGMA


def _check_ends(model: InverseSensorModel, z_measured: Array, sigma: Array) -> None:
    for name, side, wanted in (("p_free", -1, model.p_free), ("p_unknown", 1, model.p_unknown)):
        p = model.probability(z_measured + side * FAR_SIGMA * sigma, z_measured, sigma)
        worst = p[np.argmax(np.abs(p - wanted))]
        if not abs(worst - wanted) <= END_TOLERANCE:
            where = f"{FAR_SIGMA:g} sigma {'before' if side < 0 else 'behind'} a measurement"
            raise ConfigError(f"sensor model {type(model).__name__}: says {worst:.3g} {where}, must be {name} {wanted}")


def _log_odds(model: InverseSensorModel, p: Array) -> Array:
    if not ((p > 0) & (p < 1)).all():
        raise ConfigError(f"sensor model {type(model).__name__}: probability must stay strictly inside (0, 1)")
    return np.log(p / (1 - p)) - np.log(model.p_unknown / (1 - model.p_unknown))
