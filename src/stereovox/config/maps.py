# SPDX-License-Identifier: Apache-2.0
"""Settings of depth images (noise, stereo matching, sphere) and of maps (sensor model, integrator, cells, window).

Every section inherits from the base class here.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from pydantic import BaseModel, ByteSize, ConfigDict, Field, model_validator


class Section(BaseModel):
    """A section of the settings: immutable, unknown names are errors, numbers must be finite."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NoiseConfig(Section):
    """Range noise sigma(z) = s0 + s1 z + s2 z^2 in metres.

    s0, s1: constant and linear part.
    s2: quadratic part. Not set: from the camera, `subpixel / (focal_px * baseline)` (Chien 2020, Eq 3.5 with the square
        that is missing in print).
    subpixel: standard deviation of the disparity in pixels. Not set: the camera's own (`stereo.subpixel` for images
        that are matched here), else 0.08.
    correlation_px: errors of neighbouring pixels are correlated as if smoothed by a Gaussian of this standard deviation
        in pixels, so they average out more slowly than independent ones; `calibrate noise` measures it. 0: independent.
    default_baseline: metres between the two eyes, for cameras whose file does not give it.
    pose_m, pose_deg: standard deviation of the tracker's poses along and about each axis; sensor models that know the
        noise then give hits and misses less weight.
    """

    s0: float = Field(0.0, ge=0)
    s1: float = Field(0.0, ge=0)
    s2: float | None = Field(None, ge=0)
    subpixel: float | None = Field(None, gt=0)
    correlation_px: float = Field(0.0, ge=0, le=16)
    default_baseline: float = Field(0.05, gt=0)
    pose_m: float = Field(0.0, ge=0, le=10)
    pose_deg: float = Field(0.0, ge=0, le=90)


class DepthConfig(Section):
    """Preparation of a depth image before it becomes evidence.

    denoise: average depths that differ by no more than the camera's noise, if that is large compared with the cells.
    keep_lines: a line of measured pixels in front of both its sides, such as a rod before a wall, keeps its own mean.
        Fewer thin objects are lost, but what has moved away clears later (docs/thin.md).
    downsample: merge n by n pixels into one with the smallest valid depth of the block (Chien 2020, 3.2); 1: off.
    far: which pixels count as too far, and so clear cells up to the maximum range. `measured`: only depths measured
        beyond it; `reported`: also pixels that the source reports as too far;
        `infinite`: also +inf (REP 117), for cameras that never write it for pixels that are too near or unmatched.
    """

    denoise: bool = True
    keep_lines: bool = False
    downsample: int = Field(1, ge=1, le=64)
    far: Literal["measured", "reported", "infinite"] = "reported"


class StereoConfig(Section):
    """How the disparity of a stereo pair is found (Valenti 2018, 5.1 and 5.2); lengths are pixels of the full image.

    method: `census` (own semi-global matching along three paths), `sgm` (OpenCV's), `sgm8` (with eight paths), `hh4`
        (with four), `block`, `onnx`.
    model: the file of a network for `onnx`: two images in, a disparity out.
    disparities: number of disparities searched, from 0.
    block_size: side of the window that is compared; odd. p1, p2: cost of a step of one disparity and of
        more, per pixel of the window. uniqueness: per cent by which the best match must beat the second best.
    from_below: start the vertical path of `census` and `sgm` at the bottom: better if a road fills the lower half of
        the view.
    unlock: spread fractions of a pixel evenly; semi-global matching pulls them towards whole pixels.
    speckle_size, speckle_range: drop smaller patches; a larger step of disparity ends a patch. 0: keep all.
    left_right: largest difference between the disparities of both images; 0: not checked.
    aligned: the image that the depth belongs to (Valenti 2018: right).
    halve: match at half the resolution: four to five times as fast, and smoother (Valenti 2018, 5.1), with equally good
        maps of streets. The result has full size, and the settings above still count full pixels. Not set: images
        of more than 450,000 pixels are halved.
    rcrop: columns dropped at the border that the other eye cannot see: the right one for the right image (Valenti
        2018, Eq 5.1). Pixels whose match is outside the other image are always dropped.
    min_confidence: pixels with less confidence are invalid (0 to 1, see docs/stereo.md).
    texture: mean grey step over two columns below which pixels are invalid. 1 drops only flat areas, 2 to 3
        also clear skies, but smooth roads too; 0: not checked.
    subpixel: standard deviation of the remaining disparities in pixels, which the map assumes as their noise.
    threads: threads from images to depth; the result does not depend on it.
    """

    method: str = "census"
    model: str | None = None
    disparities: int = Field(128, ge=16, le=1024, multiple_of=16)
    block_size: int = Field(5, ge=1, le=51)
    p1: float = Field(16.0, ge=0, le=100)
    p2: float = Field(64.0, gt=0, le=400)
    uniqueness: int = Field(15, ge=0, le=99)
    from_below: bool = False
    unlock: bool = True
    speckle_size: int = Field(400, ge=0)
    speckle_range: float = Field(2.0, gt=0)
    left_right: float = Field(1.0, ge=0)
    aligned: Literal["left", "right"] = "left"
    halve: bool | None = None
    rcrop: int = Field(0, ge=0)
    min_confidence: float = Field(0.5, ge=0, le=1)
    texture: float = Field(1.0, ge=0)
    subpixel: float = Field(0.4, gt=0)
    threads: int = Field(2, ge=1, le=256)

    @model_validator(mode="after")
    def _fitting(self) -> StereoConfig:
        if self.block_size % 2 == 0:
            raise ValueError(f"block_size {self.block_size} must be odd")
        if self.p1 >= self.p2:
            raise ValueError(f"p1 {self.p1} must be smaller than p2 {self.p2}")
        return self


class SphereConfig(Section):
    """The spherical grid round the vehicle between depth and map (Valenti 2018, 5.3); off without `step_deg`.

    step_deg: width of a cell in both angles; must divide 180 degrees evenly.
    statistic: how a cell summarises its ranges. `robust`: their mean less `spread` standard deviations if
        the standard deviation is below `std_threshold` metres, else the smallest (Eq 5.4); `minimum`: the smallest.
    std_threshold: metres. spread: standard deviations; both for `robust`.
    polar_deg, azimuth_deg: limits; polar from the body's z axis (0: up, 90: level, 180: down), azimuth from its x
        axis to its y axis (0: forward, 90: left, 270 or -90: right). They are widened to whole cells.
    """

    step_deg: float | None = Field(None, ge=0.05, le=30)
    statistic: Literal["robust", "minimum"] = "robust"
    std_threshold: float = Field(0.1, gt=0)
    spread: float = Field(3.0, ge=0, le=10)
    polar_deg: tuple[float, float] = (0.0, 180.0)
    azimuth_deg: tuple[float, float] = (-180.0, 180.0)

    @model_validator(mode="after")
    def _fitting(self) -> SphereConfig:
        if self.step_deg is not None and abs(180 / self.step_deg - round(180 / self.step_deg)) > 1e-6:
            raise ValueError("step_deg must divide 180 evenly, as 0.5, 1, 1.5, 2, 3, 5 do")
        if not 0 <= self.polar_deg[0] < self.polar_deg[1] <= 180:
            raise ValueError("polar_deg must rise, from 0 (up) to 180 (down)")
        if not (-180 <= self.azimuth_deg[0] < self.azimuth_deg[1] <= self.azimuth_deg[0] + 360):
            raise ValueError("azimuth_deg must rise from -180 or more, and span 360 at most")
        return self


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
