# SPDX-License-Identifier: Apache-2.0
"""Settings of maps: sensor model, integrators, cells, the window."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ByteSize, ConfigDict, Field, model_validator

from stereovox.config.base import Section

MAX_WINDOW = 1e6
"""Metres along each side of a window."""
BASE_RATE = 0.1
"""Share of surfaces among the cells that cameras see, for which costs are thresholds of probability."""


class Decision(NamedTuple):
    """The probabilities below which a cell is free, and above which it is occupied."""

    free_below: float
    occupied_above: float


class SensorConfig(BaseModel):
    """The inverse sensor model by name, and its own parameters next to it (`p_free`, ...).

    model: `stereo`, `constant`, `andert`, `valenti`, or one that another package registers.
    """

    model_config = ConfigDict(frozen=True, extra="allow")
    model: str = "stereo"

    def parameters(self) -> dict[str, Any]:
        """Return the parameters of the model itself."""
        return dict(self.model_extra or {})


class RayConfig(Section):
    """How the integrators `ray` and `line` combine the rays of a frame.

    update: a cell changes `once` a frame, hits first, or `every` ray adds its weighted part (Chien 2020, Eq 3.21). The
        latter counts pixels: a pole narrower than about a quarter of its cell is outvoted by the rays next to
        it and becomes free.
    """

    update: Literal["every", "once"] = "once"


class ProjectiveConfig(Section):
    """How the projective integrator counts hits and passes.

    full_share: a hit counts in full if at least this share of the cell's footprint in the image measures the cell; a
        smaller share counts as its square root, since a few pixels may be wrong; 0: every hit counts in full.
    edge_share: a cell that is seen through, but has something nearer within an area about twice as wide, loses only
        this share of the usual evidence: at edges depths are often wrong. 1: as much as elsewhere.
    """

    full_share: float = Field(0.05, ge=0, le=1)
    edge_share: float = Field(0.5, gt=0, le=1)


class MapConfig(Section):
    """Storage of a cell, the range of its log-odds, and the costs of wrong decisions.

    cell: `int16` holds thousandths of log-odds, `int8` steps of 1/32 from -4 to 3.97; `uint8` is Chien's byte (2020,
    3.5): 127 unknown, 0 free, 255 occupied.
    prior: probability that a cell is occupied before any evidence (l0 of Valenti 2018, Eq 6.2). Most cells a camera
    sees are free, so a value well below one half gives calibrated probabilities. Give `prior` of the sensor model
    `stereo` the same value. A cell that evidence has made more likely than `prior` is never free.
    confirm_hits: smallest number of frames that must hit an unknown cell before it is occupied; one frame raises it by
        at most that fraction.
    keep_times: store when each cell got its last evidence (4 more bytes a cell).
    log_odds_min, log_odds_max: limits of a cell's log-odds.
    missed_obstacle, false_alarm: what it costs to call a surface free, and to call air occupied, if leaving a cell
        tentative costs 1. A cell of probability p is free if p * missed_obstacle < 1, and occupied if
        (1 - p) * false_alarm < 1: the decision of least expected cost (Berger 1985, 4.4). This holds for a prior of
        0.1; with another one the thresholds move with it, so that the same evidence decides.
        A cell at `log_odds_min` is free whatever it costs, if its probability is then below 0.3.
    free_below, occupied_above: probabilities below which a cell is free, and above which it is occupied; not set: by
        the costs.
    forget_s: a cell without evidence for this many seconds of the recording becomes unknown; needs `keep_times`.
    keep_frames: keep the depth images of all frames in the map, without loss, so that their poses can be corrected
        later (docs/corrections.md).
    frames_budget: bytes that kept frames may take, as a number or like "500 MB"; if they need more, only the frames
        with the most different views are kept. Not set: no limit.
    """

    cell: Literal["int16", "int8", "uint8"] = "int16"
    log_odds_min: float = Field(-4.0, lt=0, ge=-30)
    log_odds_max: float = Field(3.5, gt=0, le=30)
    prior: float = Field(BASE_RATE, gt=0, lt=1)
    missed_obstacle: float = Field(18.0, gt=1, le=1e6)
    false_alarm: float = Field(1.4, gt=1, le=1e6)
    free_below: float | None = Field(None, gt=0, lt=1)
    occupied_above: float | None = Field(None, gt=0, lt=1)
    confirm_hits: int = Field(1, ge=1, le=100)
    keep_times: bool = False
    forget_s: float | None = Field(None, gt=0)
    keep_frames: bool = False
    frames_budget: ByteSize | None = Field(None, gt=0, le=10**13)  # pyrefly: ignore[bad-argument-type] - whole bytes

    @model_validator(mode="after")
    def _ordered(self) -> MapConfig:
        free_below, occupied_above = self.decision
        if free_below >= occupied_above:
            raise ValueError(
                f"cells would be free below {free_below:.3g} and occupied above {occupied_above:.3g}; free_below must "
                "be smaller than occupied_above: change one, or increase missed_obstacle or false_alarm"
            )
        if self.forget_s is not None and not self.keep_times:
            raise ValueError("forget_s needs keep_times = true")
        if self.frames_budget is not None and not self.keep_frames:
            raise ValueError("frames_budget needs keep_frames = true")
        return self

    @property
    def decision(self) -> Decision:
        """The thresholds that are set, or else follow from the costs."""
        base = BASE_RATE * (1 - self.prior) / ((1 - BASE_RATE) * self.prior)
        free, occupied = self.free_below, self.occupied_above
        if free is None:
            free = 1 / (1 + base * (self.missed_obstacle - 1))
        if occupied is None:
            occupied = (self.false_alarm - 1) / (self.false_alarm - 1 + base)
        return Decision(free, occupied)


class WindowConfig(Section):
    """A box that moves with the camera by whole cells and bounds the map's memory (Chien 2020, 3.6).

    size: extents along the world's axes in metres. Not set: the map is unbounded, and the other settings are ignored.
    centre: the middle of a window that stays in place, a fixed box (Valenti 2018, 7.1: the global map). Not set:
        the window follows the camera (7.2: the local map); the others except `outside` need this.
    trigger: half width in metres of the box round the window's centre in which the camera moves freely; at least half a
        cell.
    lead_s: the centre runs ahead of the camera by this many seconds of motion.
    grow_s: the window is longer by this many seconds of motion along each axis.
    largest: largest extents that it may grow to; not set: `size`.
    outside: cells that leave are lost (`drop`), or kept in tiles on disk and restored when they return (`keep`).
    """

    size: tuple[float, float, float] | None = None
    largest: tuple[float, float, float] | None = None
    centre: tuple[float, float, float] | None = None
    trigger: float = Field(1.0, ge=0)
    lead_s: float = Field(0.0, ge=0, le=10)
    grow_s: float = Field(0.0, ge=0, le=10)
    outside: Literal["drop", "keep"] = "drop"

    @model_validator(mode="after")
    def _fitting(self) -> WindowConfig:
        if self.size is None:
            if self.centre is not None:
                raise ValueError("window.centre needs window.size, for example window.size=[20,20,5]")
            return self
        if min(self.size) <= 0 or any(b < a for a, b in zip(self.size, self.largest or self.size, strict=True)):
            raise ValueError("size must be positive, and largest no smaller than size")
        if max(self.largest or self.size) > MAX_WINDOW:
            raise ValueError(f"size and largest must be at most {MAX_WINDOW:g} m")
        if self.centre is None and 2 * self.trigger >= min(self.size):
            raise ValueError(f"trigger {self.trigger} must be less than half of the smallest size")
        return self
