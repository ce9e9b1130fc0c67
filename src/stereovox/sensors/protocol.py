# SPDX-License-Identifier: Apache-2.0
"""The protocol of inverse sensor models, and the lookup table that kernels use instead."""

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
"""Table columns: distances from the measurement. Even, so that no column is exactly on the measurement."""
REACH_SIGMA = 4.0
"""The table ends this many sigma before and behind the measurement; beyond it the model is p_free or p_unknown."""

END_SIGMA = REACH_SIGMA * (1 - 1 / COLUMNS)
"""Distance of the outermost columns from the measurement."""
FAR_SIGMA = 12.0
"""Distance from a measurement at which a model must have reached p_free and p_unknown."""
END_TOLERANCE = 0.02
"""Largest deviation from them at FAR_SIGMA."""


class InverseSensorModel(Protocol):
    """An inverse sensor model: a dataclass of numbers with one function. Write it in plain NumPy and register it.

    The cell that holds the measured point gets `probability` at that point. Two optional methods refine this:
    `hit(z_measured, sigma, voxel_size)` returns the probability of that cell instead, for models that consider its
    size; `passed(z, sigma, voxel_size)` returns a lower bound for a cell at depth `z` that a ray passes through,
    if it must stay above p_free because an object in it may be thinner than a pixel.

    Attributes:
        p_free: Probability of occupancy far before a measurement.
        p_unknown: Probability of occupancy far behind one.
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
        """Return the probability of occupancy of points on a ray. All arguments broadcast.

        Args:
            z: Depth of the points in metres.
            z_measured: Measured depth in metres.
            sigma: Standard deviation of the measurement in metres.

        Returns:
            p(occupied), strictly inside (0, 1).
        """
        ...


@dataclass(frozen=True, eq=False)
class SensorTable:
    """A tabulated sensor model.

    log_odds: (ROWS, COLUMNS) of a point at `z = z_measured + offset_sigma[column] * sigma[row]`; p_unknown is 0. The
    first column holds for everything farther in front of a measurement, and is p_free; the last for everything
    farther behind, and is 0.
    hit: (ROWS,) log-odds of the cell that holds the measured point.
    passed: (ROWS,) least log-odds, at most 0, of a cell at the row's depth that rays pass through.
    sigma: (ROWS,) noise in metres; row r is for measured depths around `(r + 0.5) / rows_per_metre`.
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
    """Tabulate `model` for measured depths up to `max_range` metres and cells of `voxel_size` metres.

    Evidence is log(p / (1 - p)) minus the same of p_unknown (Valenti 2018, Eq 6.2: the prior is not counted twice).
    Sigma is capped at `max_range`, so that no ray is followed farther than 1 + REACH_SIGMA times that. With noisy
    poses,
    the width of a hit combines pose and range noise.
    Raises ConfigError if the model leaves (0, 1), or does not reach p_free and p_unknown far off.
    """
    z_measured: Array = (np.arange(ROWS, dtype=float) + 0.5) * (max_range / ROWS)
    sigma = np.clip(noise.sigma(z_measured), 1e-6, max_range)  # a noisier point could be anywhere
    z = z_measured[:, None] + offset_sigma() * sigma[:, None]
    _check_ends(model, z_measured, sigma)
    log_odds = _log_odds(model, model.probability(z, z_measured[:, None], sigma[:, None]))
    log_odds[:, 0], log_odds[:, -1] = _log_odds(model, np.array(model.p_free)), 0
    at = model.probability(z_measured, z_measured, sigma)
    width = sigma if pose_noise is None else np.hypot(sigma, pose_noise.sigma(z_measured))
    hit = _log_odds(model, model.hit(z_measured, width, voxel_size) if hasattr(model, "hit") else at)
    passed = log_odds[:, 0].copy()
    if hasattr(model, "passed"):
        least = _log_odds(model, model.passed(z_measured, width, voxel_size))
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
            raise ConfigError(
                f"sensor model {type(model).__name__}: gives {worst:.3g} {where}, must be {name} {wanted}"
            )


def _log_odds(model: InverseSensorModel, p: Array) -> Array:
    if not ((p > 0) & (p < 1)).all():
        raise ConfigError(f"sensor model {type(model).__name__}: probability must stay strictly inside (0, 1)")
    return np.log(p / (1 - p)) - np.log(model.p_unknown / (1 - model.p_unknown))
