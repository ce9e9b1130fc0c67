# SPDX-License-Identifier: Apache-2.0
"""AMCL's particle set: resampling, clustering, and recovery when the robot is lost.

AMCL's models: odometry motion, and the likelihood of a scan from many poses (likelihood field and beam model).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config.robot import AmclConfig
from stereovox.geometry import se2
from stereovox.geometry.se2 import Pose
from stereovox.localize.amcl import _amcl
from stereovox.localize.track import Beams
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State

NEIGHBOURS = np.array([step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)])
"""Half of a bin's 26 neighbours; the other half is covered from the neighbours' side."""


class Recovery:
    """A long and a short memory of how well scans fit the map.

    strangers: share of particles that should be drawn at random, `max(0, 1 - short / long)`; 0 below `recovery_least`.

    The memories average the likelihood per beam, the K-th root of that of K beams, so that the number of beams does not
    matter. Early on both are the plain mean of all observations, so that a start from anywhere fades.
    """

    def __init__(self, config: AmclConfig):
        self._alpha_slow, self._alpha_fast = config.alpha_slow, config.alpha_fast
        self._least = config.recovery_least
        self._long = self._short = 0.0
        self._seen = 0

    def observe(self, log_likelihood: NDArray[np.float64], weights: NDArray[np.float64], beams: int) -> None:
        """Add (N,) log likelihoods of `beams` beams, by particles whose weights sum to 1."""
        if self._alpha_slow <= 0 or self._alpha_fast <= 0:
            return
        best = log_likelihood.max()
        per_beam = float(np.exp((best + np.log(weights @ np.exp(log_likelihood - best))) / beams))
        self._seen += 1
        self._long += max(self._alpha_slow, 1 / self._seen) * (per_beam - self._long)
        self._short += max(self._alpha_fast, 1 / self._seen) * (per_beam - self._short)

    @property
    def strangers(self) -> float:
        """Share of particles to be drawn at random, 0 to 1."""
        share = 1 - self._short / self._long if self._long > 0 else 0.0
        return share if share > self._least else 0.0


def particles_needed(bins: int, error: float, z: float) -> float:
    """Return how many particles keep a distribution over `bins` bins within `error` of the true one.

    error: Kullback-Leibler distance; z: upper quantile of the normal distribution (2.33 for 99 %). Fox 2003, Eq 7.
    """
    if bins < 2:
        return 1.0
    share = 2 / (9 * (bins - 1))
    return (bins - 1) / (2 * error) * (1 - share + np.sqrt(share) * z) ** 3


def low_variance(weights: NDArray[np.float64], count: int, offset: float) -> NDArray[np.int64]:
    """Return the (count,) indices of particles drawn by (N,) weights of sum 1 (table 4.4).

    offset: 0 to 1, the one random number. Each particle is drawn `count` times its weight, rounded up or down.
    """
    ends = np.cumsum(weights)
    places = (np.arange(count) + offset) * (ends[-1] / count)
    last = np.searchsorted(ends, ends[-1])  # the last with weight: rounding may reach the very end
    return np.minimum(np.searchsorted(ends, places, side="right"), last)


def bin_indices(particles: Pose, config: AmclConfig) -> NDArray[np.int64]:
    """Return the (N, 3) bins of x, y and yaw of (N, 3) particles; yaw wraps around."""
    round_ = yaw_bins(config)
    turn = np.floor(particles[:, 2] * (round_ / (2 * np.pi))).astype(np.int64) % round_
    across = np.floor(particles[:, :2] / config.kld_bin).astype(np.int64)
    return np.column_stack([across, turn])


def yaw_bins(config: AmclConfig) -> int:
    """Return the number of yaw bins in a full turn: of the requested width, or slightly wider."""
    return max(int(360 / config.kld_bin_deg + 1e-9), 1)


def bin_keys(indices: NDArray[np.int64], round_: int) -> NDArray[np.int64]:
    """Return one (N,) number for each (N, 3) bin; `round_`: bins per full turn. Good for 2^27 bins along x and y."""
    return ((indices[:, 0] << 28) + indices[:, 1]) * round_ + indices[:, 2]


def draw(
    weights: NDArray[np.float64],
    bins: NDArray[np.int64],
    config: AmclConfig,
    offset: float,
    strangers: float = 0.0,
    weights_strangers: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the indices of particles to keep and of strangers to add: as many as their spread requires.

    weights: (N,) of sum 1; bins: (N + M,) int64, bin index of each particle and stranger, from 0.
    strangers: share of strangers among the new particles; weights_strangers: their (M,) weights of sum 1.
    offset: 0 to 1, the one random number.

    The number grows until it suffices for the bins drawn (table 8.4), in rounds instead of one by one, because low
    variance sampling needs it beforehand.
    """
    few, many = config.particles_min, config.particles_max
    count = few
    while True:
        foreign, taken = 0, np.empty(0, np.int64)
        if weights_strangers is not None and (foreign := round(strangers * count)):
            taken = low_variance(weights_strangers, foreign, offset)
        kept = low_variance(weights, count - foreign, offset)
        hit = np.zeros(int(bins.max()) + 1, bool)
        hit[bins[kept]] = True
        hit[bins[len(weights) + taken]] = True
        needed = int(np.ceil(particles_needed(int(hit.sum()), config.kld_error, config.kld_z)))
        if count >= min(needed, many):
            return kept, taken
        count = min(needed, many)


class Clusters:
    """Particles sorted into bins, and bins into clusters of adjacent bins (also across 360 degrees).

    bins: (N,) int64, index of each particle's bin, from 0; cluster: (N,) int64, index of each particle's cluster.
    """

    def __init__(self, particles: se2.Pose, config: AmclConfig):
        indices = bin_indices(particles, config)
        keys = bin_keys(indices, yaw_bins(config))
        distinct, first, self.bins = np.unique(keys, return_index=True, return_inverse=True)
        joined = np.empty(len(distinct), np.int64)
        _amcl.join(indices[first], distinct, yaw_bins(config), NEIGHBOURS, joined)
        self.cluster = joined[self.bins]

    def heaviest(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.bool_], float]:
        """Return which particles are in the heaviest cluster, (N,) bool, and its share of the total weight."""
        sums = np.bincount(self.cluster, weights)
        best = int(sums.argmax())
        return self.cluster == best, float(sums[best] / sums.sum())


def mean_pose(particles: se2.Pose, weights: NDArray[np.float64]) -> se2.Pose:
    """Return the (3,) weighted mean of (N, 3) particles; yaw as a circular mean."""
    total = weights.sum()
    x, y = weights @ particles[:, :2] / total
    return np.array([x, y, np.arctan2(weights @ np.sin(particles[:, 2]), weights @ np.cos(particles[:, 2]))])


def spread(particles: se2.Pose, weights: NDArray[np.float64], pose: se2.Pose) -> NDArray[np.float64]:
    """Return the (3, 3) weighted mean squared deviation of (N, 3) particles from a pose: its covariance."""
    off = particles - pose
    off[:, 2] = se2.wrapped(off[:, 2])
    return (off * weights[:, None]).T @ off / weights.sum()


MIN_TRAVEL = 0.01
"""Metres of travel below which its direction is meaningless: the robot turned in place."""
LENGTHS = 1024
"""Bins of beam length in the beam model, from 0 to the longest."""
MIN_LEVEL = 1e-6
"""Horizontal share of a beam's direction below which it points straight up or down."""
WITNESSES = 500
"""Most particles that vote on whether a beam fits the map."""


class FieldModel:
    """Likelihood field: beams should end at any obstacle (table 6.3); beams without a return do not count."""

    hits_only = True

    def __init__(self, grid: OccupancyGrid, config: AmclConfig):
        self.config = config
        self.field = distance_field(grid, config.field_distance)
        self._near = _bordered(-self.field.distance_m, -config.field_distance)
        self._tables: dict[float, NDArray[np.float32]] = {}

    def log_likelihood(self, particles: se2.Pose, beams: Beams) -> NDArray[np.float32]:
        """Return the (N,) float32 log of the product over all beams, for (N, 3) particles; a density, 1 / metre."""
        out = np.empty(len(particles), np.float32)
        poses, ends = _poses(particles, self.field, 1), _in_cells(beams.ends, self.field)
        _amcl.sum_at_ends(poses, ends, self._table(beams.range_max), out)
        return out

    def agreeing(self, particles: se2.Pose, beams: Beams) -> NDArray[np.float64]:
        """Return the (K,) share of particles for which a beam ends within `beam_skip_distance` of an obstacle."""
        return _agreeing(particles, beams, self.field, self._near, self.config)

    def _table(self, range_max: float) -> NDArray[np.float32]:
        if range_max not in self._tables:
            likely = field_likelihood(-self._near, range_max, self.config)
            self._tables = {range_max: np.log(likely).astype(np.float32)}
        return self._tables[range_max]


class BeamModel:
    """Beams should be as long as ray casting in the map predicts (table 6.1)."""

    hits_only = False

    def __init__(self, grid: OccupancyGrid, config: AmclConfig):
        self.config = config
        self.field = distance_field(grid, np.hypot(*grid.cells.shape) * grid.resolution)
        self._clear = self.field.distance_m / np.float32(grid.resolution)
        self._near = _bordered(-self.field.distance_m, -self.field.farthest)
        self._tables: dict[float, NDArray[np.float32]] = {}

    def log_likelihood(self, particles: se2.Pose, beams: Beams) -> NDArray[np.float32]:
        """Return the (N,) float32 log of the product over all beams, for (N, 3) particles; a density, 1 / metre."""
        table, cell = self._table(beams.range_max), self.field.resolution
        bins = table.shape[1] - 1
        row = np.where(beams.at_max, bins + 1, np.rint(beams.ranges * (bins / beams.range_max))).astype(np.int64)
        level = np.maximum(np.hypot(*beams.directions.T), MIN_LEVEL)
        across = (beams.directions / level[:, None]).astype(np.float32)
        farthest, out = beams.range_max * level / cell, np.empty(len(particles), np.float32)
        poses, origin = _poses(particles, self.field, 0), _in_cells(beams.origin, self.field)
        per_bin = (bins / farthest).astype(np.float32)
        _amcl.sum_of_casts(poses, origin, across, self._clear, farthest.astype(np.float32), per_bin, table[row], out)
        return out

    def agreeing(self, particles: se2.Pose, beams: Beams) -> NDArray[np.float64]:
        """Return the (K,) share as `FieldModel.agreeing` does; 1 for beams without a return."""
        fits = _agreeing(particles, beams, self.field, self._near, self.config)
        return np.where(beams.at_max, 1.0, fits)

    def _table(self, range_max: float) -> NDArray[np.float32]:
        """Return the log likelihood by measured range (last row: no return) and expected range."""
        if range_max not in self._tables:
            lengths = np.linspace(0, range_max, LENGTHS)
            at_max = np.zeros((LENGTHS + 1, 1), bool)
            at_max[-1] = True
            measured = np.append(lengths, range_max)[:, None]
            likely = beam_likelihood(measured, at_max, lengths, range_max, self.config)
            self._tables = {range_max: np.log(np.maximum(likely, 1e-12)).astype(np.float32)}
        return self._tables[range_max]


def turn_go_turn(pose_odom_before: se2.Pose, pose_odom_after: se2.Pose) -> NDArray[np.float64]:
    """Return first turn, travel and second turn (3,) (radians, metres) from one (3,) pose to the other."""
    step = se2.relative(pose_odom_before, pose_odom_after)
    way = float(np.hypot(step[0], step[1]))
    first = float(np.arctan2(step[1], step[0])) if way >= MIN_TRAVEL else 0.0
    return np.array([first, way, float(se2.wrapped(step[2] - first))])


def deviations(motion: NDArray[np.float64], config: AmclConfig) -> NDArray[np.float64]:
    """Return the (3,) standard deviations of first turn, travel and second turn (table 5.6, with variances).

    A robot that reverses does not turn by 180 degrees twice: a turn counts by its difference from 0 or 180 degrees.
    """
    first, way, second = motion
    turn1, turn2 = (min(abs(turn), np.pi - abs(turn)) for turn in (first, second))
    return np.sqrt(
        [
            config.alpha1 * turn1**2 + config.alpha2 * way**2,
            config.alpha3 * way**2 + config.alpha4 * (turn1**2 + turn2**2),
            config.alpha1 * turn2**2 + config.alpha2 * way**2,
        ]
    )


def moved(particles: se2.Pose, motion: NDArray[np.float64], config: AmclConfig, rng: np.random.Generator) -> se2.Pose:
    """Return (N, 3) particles after a (3,) motion of `turn_go_turn`, each with its own noise."""
    noise = rng.standard_normal((3, len(particles))) * deviations(motion, config)[:, None]
    first, way, second = motion[:, None] - noise
    heading = particles[:, 2] + first
    x, y = particles[:, 0] + way * np.cos(heading), particles[:, 1] + way * np.sin(heading)
    return np.column_stack([x, y, se2.wrapped(heading + second)])


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances to the nearest occupied cell, cell by cell.

    distance_m: (rows, columns) float32 metres from a cell's middle to the middle of the nearest occupied cell, at most
        `farthest`; 0 in occupied cells.
    resolution, origin: as in `OccupancyGrid`.
    farthest: cap in metres, also the value everywhere outside the map.
    """

    distance_m: NDArray[np.float32]
    resolution: float
    origin: tuple[float, float, float]
    farthest: float

    def at(self, points: ArrayLike) -> NDArray[np.float32]:
        """Return the (N,) float32 distance of the cells that hold (N, 2) points x, y of the map's frame, in metres."""
        cells = np.floor(self.in_cells(points))
        columns, rows = cells[:, 0], cells[:, 1]
        inside = (rows >= 0) & (columns >= 0) & (rows < self.distance_m.shape[0]) & (columns < self.distance_m.shape[1])
        found = np.full(len(cells), self.farthest, np.float32)
        found[inside] = self.distance_m[rows[inside].astype(np.int64), columns[inside].astype(np.int64)]
        return found

    def in_cells(self, points: ArrayLike) -> NDArray[np.float64]:
        """Return (N, 2) points of the map's frame as columns and rows: (0, 0) is the corner of cell (0, 0)."""
        return se2.transform(se2.inverse(self.origin), points) / self.resolution


def distance_field(grid: OccupancyGrid, farthest: float = np.inf) -> DistanceField:
    """Return the exact Euclidean distances of a map; all of it is `farthest` (metres) if nothing is occupied."""
    from scipy.ndimage import distance_transform_edt

    occupied = grid.states == State.OCCUPIED
    if occupied.any():
        distance = np.asarray(distance_transform_edt(~occupied), np.float32) * np.float32(grid.resolution)
    else:
        distance = np.full(occupied.shape, farthest, np.float32)
    return DistanceField(np.minimum(distance, np.float32(farthest)), grid.resolution, grid.origin, farthest)


MODELS = {"field": FieldModel, "beam": BeamModel}


def field_likelihood(distance_m: ArrayLike, range_max: float, config: AmclConfig) -> NDArray[np.float64]:
    """Return the likelihood (1 / metre) of a beam that ends this far (metres) from the nearest obstacle (table 6.3)."""
    return config.z_hit * _normal(np.asarray(distance_m, float), config.sigma_hit) + config.z_rand / range_max


def beam_likelihood(
    measured: ArrayLike, at_max: ArrayLike, expected: ArrayLike, range_max: float, config: AmclConfig
) -> NDArray[np.float64]:
    """Return the likelihood (1 / metre) of ranges whose expected length is `expected` metres (Eq 6.4 to 6.12).

    measured, expected: metres; at_max: bool, no return up to `range_max`. Broadcast against each other.

    Beams without a return have a probability, not a density; it counts as if spread over a metre (table 6.1). Noise
    that carries a beam beyond `range_max` makes it one of them. Dividing the four shares by their sum then makes the
    total 1.
    """
    from scipy.special import ndtr

    z, longest = np.asarray(measured, float), np.asarray(expected, float)
    sigma, rate, open_ = config.sigma_hit, config.lambda_short, longest >= range_max
    above_zero = ndtr(longest / sigma)
    hit = np.where(open_, 0, _normal(z - longest, sigma) / above_zero)
    least = np.maximum(longest, 1e-6)
    short = np.where(z <= longest, rate * np.exp(-rate * z) / -np.expm1(-rate * least), 0)
    beyond = np.where(open_, 1, ndtr((longest - range_max) / sigma) / above_zero)
    whole = config.z_hit + config.z_short + config.z_max + config.z_rand
    ends = config.z_hit * hit + config.z_short * short + config.z_rand / range_max
    return np.where(np.asarray(at_max), config.z_hit * beyond + config.z_max, ends) / whole


def _normal(off: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    return np.exp(-0.5 * (off / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))


def _agreeing(
    particles: se2.Pose, beams: Beams, field: DistanceField, near: NDArray[np.float32], config: AmclConfig
) -> NDArray[np.float64]:
    asked = particles[:: max(len(particles) // WITNESSES, 1)]
    counts = np.empty(len(beams.ranges), np.int32)
    least = np.float32(-config.beam_skip_distance)
    _amcl.count_above(_poses(asked, field, 1), _in_cells(beams.ends, field), near, least, counts)
    return counts / len(asked)


def _poses(particles: se2.Pose, field: DistanceField, border: int) -> NDArray[np.float32]:
    """Return (N, 4) float32: column, row, cosine and sine of the turn in the grid; `border` cells were put round it."""
    turn = particles[:, 2] - field.origin[2]
    cells = field.in_cells(particles[:, :2]) + border
    return np.column_stack([cells, np.cos(turn), np.sin(turn)]).astype(np.float32)


def _in_cells(points_base: NDArray[np.float64], field: DistanceField) -> NDArray[np.float32]:
    return (points_base / field.resolution).astype(np.float32)


def _bordered(table: NDArray[np.float32], outside: float) -> NDArray[np.float32]:
    return np.pad(table, 1, constant_values=outside)
