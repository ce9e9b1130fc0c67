# SPDX-License-Identifier: Apache-2.0
"""Settings of a ground robot: scans out of depth images, 2-D grids, localisation, SLAM. Part of `config.Config`."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A part of the settings: unknown names are errors, numbers are finite, values do not change."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class ScanConfig(Section):
    """How a depth image becomes a scan (IST 2019, III-C).

    method: `rows` takes the nearest of `rows` rows round the row that looks level, for a camera that is level; `cloud`
        the nearest point between `heights`, for one that is tilted.
    rows: 1 is the middle row alone (IST 2019).
    heights: lowest and highest metres over the floor (z of the world) that count as an obstacle.
    angle_step_deg: width of a beam; not set: that of a pixel in the middle of the image.
    """

    method: Literal["rows", "cloud"] = "cloud"
    rows: int = Field(1, ge=1, le=4096)
    heights: tuple[float, float] = (0.1, 1.8)
    angle_step_deg: float | None = Field(None, gt=0, le=10)

    @model_validator(mode="after")
    def _ordered(self) -> ScanConfig:
        if self.heights[0] >= self.heights[1]:
            raise ValueError(f"heights {list(self.heights)} must rise: [lowest, highest]")
        return self


class GridConfig(Section):
    """How scans become a 2-D occupancy grid (IST 2019, II).

    traversal: cells of a beam by `bresenham`'s line, or `exact`: every cell that it touches.
    update: a cell changes `once` a scan (a hit beats a pass), or by `every` beam that crosses it (IST 2019).
    thickness: metres behind the measured point that are occupied too (alpha of IST 2019, II-B); 0: its cell alone.
    p_occupied, p_free: what one beam says of a cell it ends in, and of one it passes.
    """

    traversal: Literal["bresenham", "exact"] = "exact"
    update: Literal["once", "every"] = "once"
    thickness: float = Field(0.0, ge=0, le=5)
    p_occupied: float = Field(0.7, gt=0.5, lt=1)
    p_free: float = Field(0.4, gt=0, lt=0.5)


class AmclConfig(Section):
    """Adaptive Monte Carlo localisation (Thrun, Burgard and Fox 2005, tables 5.6, 6.3, 8.3 and 8.4)."""

    particles_min: int = Field(500, ge=10)
    particles_max: int = Field(30000, ge=10)


class SlamConfig(Section):
    """Simultaneous localisation and mapping from a 2-D lidar."""

    voxel_size: float = Field(0.05, gt=0)
