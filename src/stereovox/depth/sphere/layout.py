# SPDX-License-Identifier: Apache-2.0
"""The directions of the cells of a spherical grid."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import SphereConfig, load_config
from stereovox.errors import ConfigError

ROUNDING = 1e-6
"""Share of a cell by which a bound may exceed a cell without adding another."""


class KernelLayout(NamedTuple):
    """A layout as kernels read it."""

    per_radian: np.float32  # cells a radian
    half_turn: np.int32  # cells from pole to pole
    turn: np.int32  # cells round the pole
    first_polar: np.int32
    first_azimuth: np.int32
    polars: np.int32
    azimuths: np.int32


@dataclass(frozen=True)
class SphereLayout:
    """The cells of a spherical grid, in the frame of the body: x forward, y left, z up.

    Polar angle theta counts from the z axis, azimuth phi from the x axis to the y axis (Valenti 2018, Eq 5.2). All
    grids of one step share one lattice, so they can be stitched whatever their bounds: polar cells count from theta =
    0, azimuth cells from phi = -180 degrees and on round the pole.
    per_half_turn: cells in 180 degrees. first_polar, first_azimuth: the first cell; polars, azimuths: their number.
    """

    per_half_turn: int
    first_polar: int
    first_azimuth: int
    polars: int
    azimuths: int

    @classmethod
    def of(
        cls,
        step_deg: float,
        polar_deg: tuple[float, float] = (0.0, 180.0),
        azimuth_deg: tuple[float, float] = (-180.0, 180.0),
    ) -> SphereLayout:
        """Return the smallest layout of whole cells that contains these angles.

        Raises ConfigError, one line, as for the settings of the same names.
        """
        given = {"step_deg": step_deg, "polar_deg": polar_deg, "azimuth_deg": azimuth_deg}
        return cls.configured(load_config(sphere=given).sphere)

    @classmethod
    def configured(cls, config: SphereConfig) -> SphereLayout:
        """Return the layout of the settings. Raises ConfigError if they have no step."""
        if config.step_deg is None:
            raise ConfigError(
                "sphere.step_deg is not set, so there is no spherical grid; set it to degrees, for example 2"
            )
        n = round(180 / config.step_deg)
        step = 180 / n
        low, high = (_whole(angle / step) for angle in config.polar_deg)
        left, right = (_whole((angle + 180) / step) for angle in config.azimuth_deg)
        azimuths = min(math.ceil(right) - math.floor(left), 2 * n)
        return cls(n, math.floor(low), math.floor(left) % (2 * n), math.ceil(high) - math.floor(low), azimuths)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape (azimuths, polars) of the grid's arrays."""
        return self.azimuths, self.polars

    @property
    def step(self) -> float:
        """Width of a cell in both angles, radians."""
        return math.pi / self.per_half_turn

    def whole(self) -> SphereLayout:
        """Return the layout of the same step that holds all directions."""
        return SphereLayout(self.per_half_turn, 0, 0, self.per_half_turn, 2 * self.per_half_turn)

    def polar(self) -> NDArray[np.float64]:
        """Return the polar angle (polars,) of the cells' centres in radians, 0 (up) to pi (down)."""
        return (self.first_polar + np.arange(self.polars, dtype=float) + 0.5) * self.step

    def azimuth(self) -> NDArray[np.float64]:
        """Return the azimuth (azimuths,) of the cells' centres in radians; ascending, from -pi to 3 pi at most."""
        return (self.first_azimuth + np.arange(self.azimuths, dtype=float) + 0.5) * self.step - math.pi

    def directions(self) -> NDArray[np.float64]:
        """Return the unit vectors (azimuths, polars, 3) of the cells' centres, frame of the body."""
        theta, phi = self.polar()[None, :], self.azimuth()[:, None]
        parts = np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
        return np.stack(parts, axis=-1)

    def cells_of(self, directions: ArrayLike) -> NDArray[np.int64]:
        """Return the number (N,) of the cell of each direction (N, 3) of any length, -1 outside (Eq 5.2)."""
        x, y, z = np.asarray(directions, float).reshape(-1, 3).T
        polar = np.arctan2(np.hypot(x, y), z) / self.step
        j = np.minimum(polar.astype(np.int64), self.per_half_turn - 1) - self.first_polar
        i = np.floor((np.arctan2(y, x) + math.pi) / self.step).astype(np.int64) - self.first_azimuth
        i %= 2 * self.per_half_turn
        inside = (i < self.azimuths) & (j >= 0) & (j < self.polars)
        return np.where(inside, i * self.polars + j, -1)

    def places_in(self, other: SphereLayout) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the indices of this layout's azimuth (azimuths,) and polar cells (polars,) in one that contains
        them."""
        i = (self.first_azimuth - other.first_azimuth + np.arange(self.azimuths)) % (2 * self.per_half_turn)
        return i, self.first_polar - other.first_polar + np.arange(self.polars)

    def for_kernels(self) -> KernelLayout:
        """Return the layout as kernels read it."""
        n = self.per_half_turn
        whole = (n, 2 * n, self.first_polar, self.first_azimuth, self.polars, self.azimuths)
        return KernelLayout(np.float32(n / math.pi), *map(np.int32, whole))


def union(layouts: Sequence[SphereLayout]) -> SphereLayout:
    """Return a layout that contains all of these. Raises ConfigError if their steps differ."""
    steps = sorted({layout.per_half_turn for layout in layouts})
    if len(steps) != 1:
        found = " and ".join(f"{180 / n:g}" for n in reversed(steps)) or "none"
        raise ConfigError(f"sphere: only grids of equal steps can be stitched, these have {found} deg")
    low = min(layout.first_polar for layout in layouts)
    high = max(layout.first_polar + layout.polars for layout in layouts)
    first, azimuths = _arc([(layout.first_azimuth, layout.azimuths) for layout in layouts], 2 * steps[0])
    return SphereLayout(steps[0], low, first, high - low, azimuths)


def _arc(arcs: list[tuple[int, int]], turn: int) -> tuple[int, int]:
    """Return first cell and length of the shortest arc round the pole that contains all of these."""
    best = (0, turn)
    for first, _ in sorted(arcs):
        length = max((start - first) % turn + count for start, count in arcs)
        if length < best[1]:
            best = (first, length)
    return best


def _whole(cells: float) -> float:
    return round(cells) if abs(cells - round(cells)) < ROUNDING else cells
