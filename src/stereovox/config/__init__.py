# SPDX-License-Identifier: Apache-2.0
"""All settings of a run, typed and checked. Lengths are in metres unless the name says otherwise.

A profile is a TOML file in `profiles/` or elsewhere; settings that it does not name keep their defaults.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, get_args, get_origin

from pydantic import BaseModel, ByteSize, Field, ValidationError, model_validator

from stereovox.config.maps import (
    DepthConfig,
    MapConfig,
    NoiseConfig,
    ProjectiveConfig,
    RayConfig,
    Section,
    SensorConfig,
    SphereConfig,
    StereoConfig,
    WindowConfig,
)
from stereovox.config.robot import AmclConfig, GridConfig, LoopsConfig, PaceConfig, ScanConfig, SlamConfig, TrustConfig
from stereovox.errors import ConfigError, did_you_mean
from stereovox.files.safe_io import read_text, shown, toml_table

MAX_CELLS = 8192
"""Most cells between the camera and the maximum range."""
BLIND_RANGE = 0.3
"""Depth in metres below which most depth cameras measure nothing."""
MAX_UNEQUAL = 16
"""Largest allowed ratio between two sides of a cell."""


class Config(Section):
    """Every setting of a run; the resolved one is saved inside the map.

    Attributes:
        profile: Name of the profile that the settings come from.
        dimensions: 3 for a voxel map, 2 for the grid of a floor (IST 2019).
        voxel_size: Side of a cell.
        steps: Sides of a cell along x, y and z if they differ, at most 16-fold (Valenti 2018, 7.1); `voxel_size` is
            then the largest. Pictures and exports use cubes of the smallest side.
        min_range: Smallest depth along the optical axis that is used.
        max_range: Largest depth along the optical axis that is used.
        up: The axis of the world that points up (`z`, `-y`, ...); pictures and heights follow it.
        up_direction: Unit vector that points up, if no axis does so exactly; `up` is then the nearest axis.
        levelled_from: Direction in the recording's world that is z in this map; `map --level` sets
            it when it rotates the poses.
        blind_range: Depth in metres below which a camera clears no cells, because it measures nothing that near. Not
            set: 0.3, but at most a tenth of max_range and at least min_range.
        integrator: `projective`, `ray`, `line`, or one that another package registers.
        threads: Threads of the integrator; the map does not depend on their number.
        device: `cpu`, or `cuda` for an NVIDIA graphics card: the integrator `projective` with pinhole cameras, for maps
            without a window, `max_memory`, `map.keep_times`, `map.keep_frames` or `sphere`. Without such a card, `cpu`
            is used and a note is printed.
        pose_rigidity_tolerance: Largest entry of abs(R^T R - I) that counts as rounding of a pose.
        deadline_ms: Milliseconds a frame may take; `pace` sets what is left out if frames take longer. Not set:
            no limit.
        max_memory: Bytes that the cells may take, as a number or like "500 MB".
        when_full: When memory runs out, refuse frames that need more (`refuse`), or keep a window of that size
            round the camera and drop what leaves it (`roll`) or keep it on disk (`spill`).
        trust: Which frames may change the map; see TrustConfig.
        pace: What is left out under `deadline_ms`; see PaceConfig.
        sensor: Inverse sensor model; see SensorConfig.
        noise: Range and pose noise; see NoiseConfig.
        depth: Depth images; see DepthConfig.
        stereo: Stereo matching; see StereoConfig.
        sphere: Spherical grid; see SphereConfig.
        map: Cells; see MapConfig.
        window: Moving window; see WindowConfig.
        ray: Ray integrators; see RayConfig.
        projective: Projective integrator; see ProjectiveConfig.
        scan: Depth images as scans; see ScanConfig.
        grid: 2-D grids; see GridConfig.
        amcl: Localisation; see AmclConfig.
        slam: SLAM; see SlamConfig.
        loops: Loop closure in space; see LoopsConfig.
    """

    profile: str = "default"
    dimensions: Literal[2, 3] = 3
    voxel_size: float = Field(0.05, gt=0, le=100)
    steps: tuple[float, float, float] | None = None
    min_range: float = Field(0.1, ge=0)
    max_range: float = Field(5.0, gt=0, le=1000)
    blind_range: float | None = Field(None, ge=0, le=1000)
    up: str = Field("z", pattern="^[+-]?[xyz]$")
    up_direction: tuple[float, float, float] | None = None
    levelled_from: tuple[float, float, float] | None = None
    integrator: str = "projective"
    threads: int = Field(1, ge=1, le=256)
    device: Literal["cpu", "cuda"] = "cpu"
    pose_rigidity_tolerance: float = Field(5e-3, gt=0, le=0.1)
    deadline_ms: float | None = Field(None, gt=0)
    max_memory: ByteSize | None = Field(None, gt=0, le=10**12)  # pyrefly: ignore[bad-argument-type] - whole bytes
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
    loops: LoopsConfig = Field(default_factory=lambda: LoopsConfig.model_validate({}))

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
        """Depth in metres below which nothing is cleared."""
        if self.blind_range is not None:
            return self.blind_range
        return min(max(self.min_range, BLIND_RANGE), max(self.min_range, 0.1 * self.max_range))

    @property
    def tilt(self) -> float:
        """Angle in radians between the axis `up` and `up_direction`."""
        if self.up_direction is None:
            return 0.0
        return math.acos(min(1.0, self._along_up()))

    def _along_up(self) -> float:
        """Return the component of `up_direction` along the axis `up`."""
        x, y, z = self.up_direction or (0.0, 0.0, 0.0)
        return {"x": x, "y": y, "z": z}[self.up[-1]] * (-1 if self.up.startswith("-") else 1)

    @model_validator(mode="after")
    def _upright(self) -> Config:
        if self.up_direction is not None:
            length = math.hypot(*self.up_direction)
            if not abs(length - 1) < 0.01 or self._along_up() < 0.99 * max(map(abs, self.up_direction)):
                raise ValueError(
                    f"up_direction {list(self.up_direction)} must be a unit vector nearest to up {self.up}"
                )
        return self

    @model_validator(mode="after")
    def _fit_for_device(self) -> Config:
        if self.device == "cpu":
            return self
        not_there = {
            "dimensions": self.dimensions == 2,
            "integrator": self.integrator != "projective",
            "threads": self.threads > 1,
            "window.size": self.window.size is not None,
            "max_memory": self.max_memory is not None,
            "map.keep_times": self.map.keep_times,
            "map.keep_frames": self.map.keep_frames,
            "sphere.step_deg": self.sphere.step_deg is not None,
        }
        for name, wanted in not_there.items():
            if wanted:
                value = self
                for part in name.split("."):
                    value = getattr(value, part)
                raise ValueError(f'{name} {value} does not work with device "cuda"; leave it out, or use device "cpu"')
        return self

    @model_validator(mode="after")
    def _ordered(self) -> Config:
        if min(self.cell) < self.voxel_size / MAX_UNEQUAL or min(self.cell) <= 0:
            raise ValueError(f"steps {list(self.cell)} must be above 0 and differ by a factor of at most {MAX_UNEQUAL}")
        for name, value in (("min_range", self.min_range), ("blind_range", self.blind)):
            if value >= self.max_range:
                raise ValueError(f"{name} {value:g} must be smaller than max_range {self.max_range:g}")
        if self.dimensions == 2 and (self.map.keep_times or (self.max_memory and self.when_full != "refuse")):
            raise ValueError('a floor\'s grid has no map.keep_times, and when_full can only be "refuse"')
        if self.dimensions == 2 and self.map.keep_frames:
            raise ValueError("map.keep_frames is for maps in space; leave it out for the map of a floor")
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
    """Return the settings of a profile with overrides.

    Args:
        profile: Built-in name, TOML file, `Config` or plain dict.
        **overrides: Settings by their names in the file; a dot reaches into a section (`**{"sensor.p_free": 0.3}`).

    Returns:
        The checked settings.

    Raises:
        ConfigError: A profile cannot be read, or a setting is unknown, of the wrong type or out of range.
    """
    where = str(profile) if isinstance(profile, str | Path) else "config"
    where = "" if where in profile_names() else f"{where}: "  # built-in profiles are valid: the override is wrong
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
    """Return a command line value parsed as TOML (`0.5`, `true`, `[1, 2]`); anything else is a string."""
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
        why = getattr(error, "strerror", None) or "it is not text"
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
    if first["type"] == "string_pattern_mismatch":  # only `up` has a pattern
        message = "give x, y, z, -x, -y or -z"
    name = ".".join(map(str, location)) or "settings"
    given = "" if isinstance(value, dict) or value == "" else f" {shown(value)}"
    return f"{where}{name}{given}: {message}"


def _tuple_length(location: tuple[int | str, ...]) -> int:
    """Return the length of the list that the setting at `location` takes; 0 if it takes no list."""
    model: Any = Config
    for name in location:
        field = getattr(model, "model_fields", {}).get(name)
        model = field.annotation if field else None
    kinds = [kind for kind in (model, *get_args(model)) if get_origin(kind) is tuple]
    return len(get_args(kinds[0])) if kinds else 0
