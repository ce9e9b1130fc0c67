# SPDX-License-Identifier: Apache-2.0
"""All settings of a run, typed and checked. Lengths in metres unless the name says otherwise.

A profile is a TOML file in `profiles/` or anywhere else; what it does not name keeps the default below.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ByteSize, ConfigDict, Field, ValidationError, model_validator

from stereovox.config.robot import AmclConfig, GridConfig, ScanConfig, Section, SlamConfig
from stereovox.config.safety import PaceConfig, TrustConfig
from stereovox.errors import ConfigError, did_you_mean
from stereovox.safe_io import read_text, shown, toml_table

MAX_CELLS = 8192
"""Cells that fit between the camera and the maximum range."""
BLIND_RANGE = 0.3
"""Metres within which depth cameras see nothing, most of them."""
MAX_UNEQUAL = 16
"""Largest over smallest side of a cell."""
MAX_WINDOW = 1e6
"""Metres along each side of a window."""


class NoiseConfig(Section):
    """Range noise sigma(z) = s0 + s1 z + s2 z^2 in metres.

    s0, s1: constant and linear part.
    s2: quadratic part. Not set: from the camera, `subpixel / (focal_px * baseline)` (Chien 2020, Eq 3.5 with the square
        that is missing in print).
    subpixel: standard deviation of the disparity in pixels. Not set: the camera's own (`stereo.subpixel` for images
        that are matched here), else 0.08.
    default_baseline: metres between the two eyes, for cameras whose file does not give it.
    pose_m, pose_deg: standard deviation of the tracker's poses along and about each axis; hits and passes count as less
        sure, with models that know how wide noise is.
    """

    s0: float = Field(0.0, ge=0)
    s1: float = Field(0.0, ge=0)
    s2: float | None = Field(None, ge=0)
    subpixel: float | None = Field(None, gt=0)
    default_baseline: float = Field(0.05, gt=0)
    pose_m: float = Field(0.0, ge=0, le=10)
    pose_deg: float = Field(0.0, ge=0, le=90)


class SensorConfig(BaseModel):
    """The inverse sensor model by name, and its own parameters beside it (`p_free`, ...).

    model: `stereo`, `constant`, `andert`, `valenti`, or one that another package registers.
    """

    model_config = ConfigDict(frozen=True, extra="allow")
    model: str = "stereo"

    def parameters(self) -> dict[str, Any]:
        """Return what the model itself is to be made with."""
        return dict(self.model_extra or {})


class RayConfig(Section):
    """How the integrators `ray` and `line` combine the rays of one frame.

    update: a cell changes `once` a frame, hits first, or `every` ray adds its weighted part (Chien 2020, Eq 3.21). That
        counts pixels: a pole that fills less than about a quarter of its cell's width is outvoted by the rays beside it
        and becomes free.
    """

    update: Literal["every", "once"] = "once"


class ProjectiveConfig(Section):
    """How the projective integrator counts hits.

    full_share: a cell's hit counts in full when so much of the cell's footprint in the image falls into it, with less
    by the square root of the part, since a few pixels may be wrong; 0: every hit counts in full.
    """

    full_share: float = Field(0.1, ge=0, le=1)


class DepthConfig(Section):
    """What happens to a depth image before it becomes evidence.

    denoise: average depths that the camera's noise cannot tell apart, where it is large against the cells.
    downsample: n by n pixels become one that holds the smallest valid depth of its block (Chien 2020, 3.2); 1: none.
    far: what is believed to be too far away, and so clears cells up to the maximum range. `measured`: only depths that
        were measured beyond it; `told`: also pixels of which the source says so; `infinite`: also +inf (REP 117), for
        cameras that never write it for what is too near or unmatched.
    """

    denoise: bool = True
    downsample: int = Field(1, ge=1, le=64)
    far: Literal["measured", "told", "infinite"] = "told"


class StereoConfig(Section):
    """How the disparity of a stereo pair is found (Valenti 2018, 5.1 and 5.2); lengths are pixels of the full image.

    method: `sgm` (OpenCV's semi-global matching along three paths), `sgm8` (eight), `hh4` (four), `block`, `onnx`.
    model: the file of a network for `onnx`: two images in, a disparity out.
    disparities: how many are searched, from 0 on.
    block_size: side of the window by which two pixels are compared; odd. p1, p2: what a step of one disparity and of
        more costs, for each pixel of the window. uniqueness: per cent by which the best match must beat the second.
    from_below: the vertical path of `sgm` comes from below: better where a road fills the lower half of the view.
    unlock: spread fractions of a pixel evenly, which semi-global matching pulls towards whole ones.
    speckle_size, speckle_range: smaller patches are dropped; a step of more disparity ends a patch. 0: none dropped.
    left_right: most by which the disparities of both images may differ; 0: not checked.
    aligned: the image whose pixels get a depth (Valenti 2018: right).
    halve: match at half the resolution: four to five times as quick and smoother (Valenti 2018, 5.1); maps of streets
        come out the same. The result is of full size, and the numbers above stand for full pixels all the same. Not
        set: images of more than 450,000 pixels are halved.
    rcrop: columns dropped at the border that the other eye cannot see: the right one for the right image (Valenti
        2018, Eq 5.1). Pixels whose match lies outside of the other image are dropped in any case.
    min_confidence: pixels that are less sure have no value (0 to 1, see docs/stereo.md).
    texture: mean step of grey over two columns below which pixels have no value. 1 drops what is quite flat, 2 to 3
        also clear skies, and smooth roads with them; 0: not asked for.
    subpixel: standard deviation of the disparities that are left, in pixels; what the map takes for their noise.
    threads: threads of the matcher; the disparity does not depend on it.
    """

    method: str = "sgm"
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
    """The spherical grid round the vehicle between depth and map (Valenti 2018, 5.3): none without `step_deg`.

    step_deg: width of a cell in both angles; must go into 180 degrees a whole number of times.
    statistic: what a cell keeps of the ranges in it: `robust` is their mean less `spread` standard deviations where
        the standard deviation is below `std_threshold` metres, else the smallest (Eq 5.4); `minimum` the smallest.
    std_threshold: metres. spread: standard deviations; both for `robust`.
    polar_deg, azimuth_deg: from and to; polar from the body's z axis (0: up, 90: level, 180: down), azimuth from its x
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
            raise ValueError("step_deg must go into 180 a whole number of times, as 0.5, 1, 1.5, 2, 3, 5 do")
        if not 0 <= self.polar_deg[0] < self.polar_deg[1] <= 180:
            raise ValueError("polar_deg must rise, from 0 (up) to 180 (down)")
        if not (-180 <= self.azimuth_deg[0] < self.azimuth_deg[1] <= self.azimuth_deg[0] + 360):
            raise ValueError("azimuth_deg must rise from -180 or more, and span 360 at most")
        return self


class WindowConfig(Section):
    """A box that moves with the camera by whole cells and bounds the map's memory (Chien 2020, 3.6).

    size: extents along the world's axes in metres; without them the map is unbounded and the rest has no meaning.
    centre: the middle of a window that stays where it is, a fixed box (Valenti 2018, 7.1: the global map); without it
        the window follows the camera (7.2: the local map), and only then the rest but `outside` has a meaning.
    trigger: half width in metres of the box round the window's centre in which the camera moves freely; half a cell at
        least.
    lead_s: the centre runs ahead of the camera by so many seconds of its flight.
    grow_s: the window is longer by so many seconds of flight along each axis.
    largest: extents that it may grow to; not set: `size`.
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


class MapConfig(Section):
    """What a cell is kept in, the range of its log-odds, and the probabilities that tell the states apart.

    cell: `int16` holds thousandths of log-odds, `int8` steps of 1/32 from -4 to 3.97; `uint8` is Chien's byte (2020,
    3.5): 127 unknown, 0 free, 255 occupied.
    prior: probability that a cell is occupied before the first evidence on it (l0 of Valenti 2018, Eq 6.2). Most cells
    a camera sees are free, so probabilities agree with what is really there when it is well below a half. `prior` of
    the sensor model `stereo` should be the same. A cell that evidence made likelier than that is never free.
    confirm_hits: frames that must hit an unknown cell at least before it is occupied; one frame raises it by no more
        than that part of the way.
    keep_times: remember for each cell when it got its last evidence (4 bytes a cell on top).
    log_odds_min, log_odds_max: limits of a cell's log-odds.
    free_below, occupied_above: probabilities below which a cell is free, and above which it is occupied.
    forget_s: a cell without evidence for so many seconds of the recording becomes unknown; needs `keep_times`.
    """

    cell: Literal["int16", "int8", "uint8"] = "int16"
    log_odds_min: float = Field(-4.0, lt=0, ge=-30)
    log_odds_max: float = Field(3.5, gt=0, le=30)
    prior: float = Field(0.1, gt=0, lt=1)
    free_below: float = Field(0.3, gt=0, lt=1)
    occupied_above: float = Field(0.7, gt=0, lt=1)
    confirm_hits: int = Field(1, ge=1, le=100)
    keep_times: bool = False
    forget_s: float | None = Field(None, gt=0)

    @model_validator(mode="after")
    def _ordered(self) -> MapConfig:
        if self.free_below >= self.occupied_above:
            raise ValueError("free_below must be smaller than occupied_above")
        if self.forget_s is not None and not self.keep_times:
            raise ValueError("forget_s needs keep_times = true")
        return self


class Config(Section):
    """Every setting of a run; the resolved one is saved inside the map.

    profile: name of the profile that the settings come from.
    dimensions: 3 for a voxel map, 2 for the grid of a floor (IST 2019).
    voxel_size: side of a cell.
    steps: sides of a cell along x, y and z where they differ, at most 16-fold (Valenti 2018, 7.1); `voxel_size` is then
        the largest. Pictures and exports are made in cubes of the smallest.
    min_range, max_range: depths along the optical axis that count.
    up: which axis of the world points up (`z`, `-y`, ...): pictures and heights follow it.
    blind_range: depth in metres up to which a camera clears nothing, for it does not see what stands so near, only what
        is beside it. Not set: 0.3, but no more than a tenth of max_range, and no less than min_range.
    integrator: `projective`, `ray`, `line`, or one that another package registers.
    threads: threads of the integrator; the map does not depend on it.
    pose_rigidity_tolerance: largest entry of abs(R^T R - I) of a pose that is still taken for rounding.
    deadline_ms: milliseconds a frame may take; where frames take longer, `pace` says what is left out. Not set: none.
    max_memory: bytes that the cells may take, as a number or like "500 MB". when_full: frames that need more are
        refused (`refuse`); or the map is a window of that size round the camera, which drops what it leaves (`roll`) or
        keeps it on disk (`spill`).
    """

    profile: str = "default"
    dimensions: Literal[2, 3] = 3
    voxel_size: float = Field(0.05, gt=0, le=100)
    steps: tuple[float, float, float] | None = None
    min_range: float = Field(0.1, ge=0)
    max_range: float = Field(5.0, gt=0, le=1000)
    blind_range: float | None = Field(None, ge=0, le=1000)
    up: str = Field("z", pattern="^[+-]?[xyz]$")
    integrator: str = "projective"
    threads: int = Field(1, ge=1, le=256)
    pose_rigidity_tolerance: float = Field(5e-3, gt=0, le=0.1)
    deadline_ms: float | None = Field(None, gt=0)
    max_memory: ByteSize | None = Field(None, gt=0, le=10**12)
    when_full: Literal["refuse", "roll", "spill"] = "refuse"
    trust: TrustConfig = Field(default_factory=lambda: TrustConfig.model_validate({}))
    pace: PaceConfig = Field(default_factory=lambda: PaceConfig.model_validate({}))
    sensor: SensorConfig = Field(default_factory=SensorConfig)
    noise: NoiseConfig = Field(default_factory=lambda: NoiseConfig.model_validate({}))
    depth: DepthConfig = Field(default_factory=lambda: DepthConfig.model_validate({}))
    stereo: StereoConfig = Field(default_factory=lambda: StereoConfig.model_validate({}))
    sphere: SphereConfig = Field(default_factory=lambda: SphereConfig.model_validate({}))
    map: MapConfig = Field(default_factory=lambda: MapConfig.model_validate({}))
    window: WindowConfig = Field(default_factory=lambda: WindowConfig.model_validate({}))
    ray: RayConfig = Field(default_factory=RayConfig)
    projective: ProjectiveConfig = Field(default_factory=lambda: ProjectiveConfig.model_validate({}))
    scan: ScanConfig = Field(default_factory=lambda: ScanConfig.model_validate({}))
    grid: GridConfig = Field(default_factory=lambda: GridConfig.model_validate({}))
    amcl: AmclConfig = Field(default_factory=lambda: AmclConfig.model_validate({}))
    slam: SlamConfig = Field(default_factory=lambda: SlamConfig.model_validate({}))

    @model_validator(mode="before")
    @classmethod
    def _largest_step(cls, settings: Any) -> Any:
        steps = settings.get("steps") if isinstance(settings, dict) else None
        if not (isinstance(steps, list | tuple) and steps and all(isinstance(step, int | float) for step in steps)):
            return settings
        return {**settings, "voxel_size": max(steps)}

    @property
    def cell(self) -> tuple[float, float, float]:
        """Sides of a cell along x, y and z in metres."""
        side = self.voxel_size
        return self.steps or (side, side, side)

    @property
    def blind(self) -> float:
        """Depth in metres up to which nothing is cleared."""
        if self.blind_range is not None:
            return self.blind_range
        return min(max(self.min_range, BLIND_RANGE), max(self.min_range, 0.1 * self.max_range))

    @model_validator(mode="after")
    def _ordered(self) -> Config:
        if min(self.cell) < self.voxel_size / MAX_UNEQUAL or min(self.cell) <= 0:
            raise ValueError(f"steps {list(self.cell)} must be above 0 and differ by a factor of at most {MAX_UNEQUAL}")
        for name, value in (("min_range", self.min_range), ("blind_range", self.blind)):
            if value >= self.max_range:
                raise ValueError(f"{name} {value:g} must be smaller than max_range {self.max_range:g}")
        if self.dimensions == 2 and (self.map.keep_times or (self.max_memory and self.when_full != "refuse")):
            raise ValueError('a floor\'s grid has no map.keep_times, and when_full can only be "refuse"')
        if self.when_full != "refuse" and self.max_memory is None:
            raise ValueError(f'when_full "{self.when_full}" needs max_memory, for example max_memory="500 MB"')
        if self.dimensions == 2 and self.deadline_ms is not None:
            raise ValueError("deadline_ms is for maps in space; leave it out for the map of a floor")
        if self.max_range / self.voxel_size > MAX_CELLS:
            raise ValueError(
                f"max_range {self.max_range} spans more than {MAX_CELLS} cells of {self.voxel_size}; use larger cells"
            )
        return self


def load_config(profile: str | Path | Config | Mapping[str, Any] = "default", **overrides: Any) -> Config:
    """Return the settings of a profile (built-in name, TOML file, Config or plain dict) with `overrides` on top.

    Overrides name settings as in the file; a dot reaches into a section (`{"sensor.p_free": 0.3}`).
    Raises ConfigError: one line with the setting, its value and the cure.
    """
    where = str(profile) if isinstance(profile, str | Path) else "config"
    where = "" if where in profile_names() else f"{where}: "  # what is built in is right: a setting on top is not
    settings = _as_settings(profile)
    for key, value in overrides.items():
        _put(settings, key, value)
    _check_keys(settings, where)
    try:
        return Config.model_validate(settings)
    except ValidationError as error:
        raise ConfigError(_one_line(error, where)) from None


def profile_names() -> list[str]:
    """Return the names of the built-in profiles."""
    return sorted(entry.name.removesuffix(".toml") for entry in _profiles().iterdir() if entry.name.endswith(".toml"))


def parse_value(text: str) -> Any:
    """Return a command line value as TOML reads it (`0.5`, `true`, `[1, 2]`); anything else is a plain string."""
    try:
        return toml_table(f"value = {text}")["value"]
    except ValueError:
        return text


def _profiles() -> Any:
    return files("stereovox.config") / "profiles"


def _as_settings(profile: str | Path | Config | Mapping[str, Any]) -> dict[str, Any]:
    if isinstance(profile, Config):
        return profile.model_dump()
    return copy.deepcopy(dict(profile)) if isinstance(profile, Mapping) else _read_profile(profile)


def _read_profile(profile: str | Path) -> dict[str, Any]:
    builtin = _profiles() / f"{profile}.toml"
    path = Path(profile)
    try:
        if path.suffix == ".toml":
            return {"profile": path.stem, **toml_table(read_text(path))}
        if builtin.is_file():
            return {"profile": str(profile), **toml_table(builtin.read_text())}
    except (OSError, UnicodeDecodeError) as error:
        why = getattr(error, "strerror", None) or "it is no text"
        raise ConfigError(f"{path}: cannot read the profile ({why}); give a readable TOML file") from None
    except ValueError as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from None
    raise ConfigError(f"unknown profile '{profile}'{did_you_mean(str(profile), profile_names())}; or name a .toml file")


def _put(settings: dict[str, Any], dotted: str, value: Any) -> None:
    *sections, key = dotted.split(".")
    for section in sections:
        settings = settings.setdefault(section, {})
        if not isinstance(settings, dict):
            raise ConfigError(f"setting '{dotted}': '{section}' is a value, not a section")
    settings[key] = value


def _check_keys(settings: dict[str, Any], where: str, model: type[BaseModel] = Config, prefix: str = "") -> None:
    for key, value in settings.items():
        if key not in model.model_fields:
            if model.model_config.get("extra") == "allow":
                continue
            raise ConfigError(f"{where}unknown setting '{prefix}{key}'{did_you_mean(key, model.model_fields, prefix)}")
        section = model.model_fields[key].annotation
        if isinstance(value, dict) and isinstance(section, type) and issubclass(section, BaseModel):
            _check_keys(value, where, section, f"{prefix}{key}.")


def _one_line(error: ValidationError, where: str) -> str:
    first = error.errors()[0]
    location, value, message = first["loc"], first["input"], first["msg"].removeprefix("Value error, ")
    at = next((n for n in range(1, len(location) + 1) if _tuple_length(location[:n])), None)
    if at and first["type"] in ("tuple_type", "missing", "too_long"):
        length, location = _tuple_length(location[:at]), location[:at]
        letters = "xyz" if length == 3 else "abcdefgh"
        message = f"give a list of {length} numbers, [{', '.join(letters[:length])}]"
    if first["type"].startswith("byte_size"):
        message = 'give bytes, or a size like "500 MB"'
    if first["type"] == "string_pattern_mismatch":  # `up` alone has one
        message = "give x, y, z, -x, -y or -z"
    name = ".".join(map(str, location)) or "settings"
    given = "" if isinstance(value, dict) or value == "" else f" {shown(value)}"
    return f"{where}{name}{given}: {message}"


def _tuple_length(location: tuple[int | str, ...]) -> int:
    """Return how many numbers belong into the setting at `location`; 0 where it is no list."""
    model: Any = Config
    for name in location:
        field = getattr(model, "model_fields", {}).get(name)
        model = field.annotation if field else None
    kinds = [kind for kind in (model, *get_args(model)) if get_origin(kind) is tuple]
    return len(get_args(kinds[0])) if kinds else 0
