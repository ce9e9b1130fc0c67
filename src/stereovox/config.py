# SPDX-License-Identifier: Apache-2.0
"""All settings of a run, typed and checked. Lengths in metres unless the name says otherwise.

A profile is a TOML file in `profiles/` or anywhere else; what it does not name keeps the default below.
"""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from stereovox.errors import ConfigError, did_you_mean

MOST_CELLS = 8192
"""Cells that fit between the camera and the maximum range."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class NoiseConfig(_Section):
    """Range noise sigma(z) = s0 + s1 z + s2 z^2 in metres.

    Where `s2` is not set it follows from the camera: `subpixel / (focal_px * baseline)` (Chien 2020, Eq 3.5 with the
    square that is missing in print). `default_baseline` serves cameras whose file does not tell theirs.
    """

    s0: float = Field(0.0, ge=0)
    s1: float = Field(0.0, ge=0)
    s2: float | None = Field(None, ge=0)
    subpixel: float = Field(0.08, gt=0)
    default_baseline: float = Field(0.05, gt=0)


class SensorConfig(BaseModel):
    """The inverse sensor model by name, and its own parameters beside it (`p_hit`, `p_free`, ...)."""

    model_config = ConfigDict(frozen=True, extra="allow")
    model: str = "stereo"

    def parameters(self) -> dict[str, Any]:
        """Return what the model itself is to be made with."""
        return dict(self.model_extra or {})


class RayConfig(_Section):
    """How rays of one frame share a cell: `every` ray adds its weighted part, or the cell changes `once` a frame."""

    update: Literal["every", "once"] = "every"


class DepthConfig(_Section):
    """What happens to a depth image before it becomes evidence.

    denoise: average depths that the camera's noise cannot tell apart, where it is large against the cells.
    downsample: n by n pixels become one that holds the smallest valid depth of its block (Chien 2020, 3.2); 1: none.
    """

    denoise: bool = True
    downsample: int = Field(1, ge=1, le=64)


class WindowConfig(_Section):
    """A box that moves with the camera by whole cells and bounds the map's memory (Chien 2020, 3.6).

    size: extents along the world's axes in metres; without them the map is unbounded and the rest has no meaning.
    trigger: half width in metres of the box round the window's centre in which the camera moves freely.
    lead_s: the centre runs ahead of the camera by so many seconds of its flight.
    grow_s: the window is longer by so many seconds of flight along each axis, up to `largest`.
    outside: cells that leave are lost (`drop`), or kept in tiles on disk and restored when they return (`keep`).
    """

    size: tuple[float, float, float] | None = None
    largest: tuple[float, float, float] | None = None
    trigger: float = Field(1.0, ge=0)
    lead_s: float = Field(0.0, ge=0, le=10)
    grow_s: float = Field(0.0, ge=0, le=10)
    outside: Literal["drop", "keep"] = "drop"

    @model_validator(mode="after")
    def _fitting(self) -> WindowConfig:
        if self.size is None:
            return self
        if min(self.size) <= 0 or any(b < a for a, b in zip(self.size, self.largest or self.size, strict=True)):
            raise ValueError("size must be positive, and largest no smaller than size")
        if 2 * self.trigger >= min(self.size):
            raise ValueError(f"trigger {self.trigger} must be less than half of the smallest size")
        return self


class MapConfig(_Section):
    """What a cell is kept in, the range of its log-odds, and the probabilities that tell the states apart.

    cell: `int16` holds thousandths of log-odds; `uint8` is Chien's byte (2020, 3.5): 127 unknown, 0 free, 255 occupied.
    """

    cell: Literal["int16", "uint8"] = "int16"
    log_odds_min: float = Field(-2.0, lt=0, ge=-30)
    log_odds_max: float = Field(3.5, gt=0, le=30)
    free_below: float = Field(0.3, gt=0, lt=1)
    occupied_above: float = Field(0.7, gt=0, lt=1)

    @model_validator(mode="after")
    def _ordered(self) -> MapConfig:
        if self.free_below >= self.occupied_above:
            raise ValueError("free_below must be smaller than occupied_above")
        return self


class Config(_Section):
    """Every setting of a run; the resolved one is saved inside the map.

    up: which axis of the world points up (`z`, `-y`, ...): pictures and heights follow it.
    """

    profile: str = "default"
    voxel_size: float = Field(0.05, gt=0, le=100)
    min_range: float = Field(0.1, ge=0)
    max_range: float = Field(5.0, gt=0, le=1000)
    up: str = Field("z", pattern="^[+-]?[xyz]$")
    integrator: str = "projective"
    threads: int = Field(1, ge=1, le=256)
    pose_rigidity_tolerance: float = Field(5e-3, gt=0, le=0.1)
    sensor: SensorConfig = Field(default_factory=SensorConfig)
    noise: NoiseConfig = Field(default_factory=lambda: NoiseConfig.model_validate({}))
    depth: DepthConfig = Field(default_factory=lambda: DepthConfig.model_validate({}))
    map: MapConfig = Field(default_factory=lambda: MapConfig.model_validate({}))
    window: WindowConfig = Field(default_factory=lambda: WindowConfig.model_validate({}))
    ray: RayConfig = Field(default_factory=RayConfig)

    @model_validator(mode="after")
    def _ordered(self) -> Config:
        if self.min_range >= self.max_range:
            raise ValueError("min_range must be smaller than max_range")
        if self.max_range / self.voxel_size > MOST_CELLS:
            raise ValueError(
                f"max_range {self.max_range} spans more than {MOST_CELLS} cells of {self.voxel_size}; use larger cells"
            )
        return self


def load_config(profile: str | Path | Config | Mapping[str, Any] = "default", **overrides: Any) -> Config:
    """Return the settings of a profile (built-in name, TOML file, Config or plain dict) with `overrides` on top.

    Overrides name settings as in the file; a dot reaches into a section (`{"sensor.p_hit": 0.8}`).
    Raises ConfigError: one line with the setting, its value and the cure.
    """
    where = str(profile) if isinstance(profile, str | Path) else "config"
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
        return tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        return text


def _profiles() -> Any:
    return files("stereovox") / "profiles"


def _as_settings(profile: str | Path | Config | Mapping[str, Any]) -> dict[str, Any]:
    if isinstance(profile, Config):
        return profile.model_dump()
    return copy.deepcopy(dict(profile)) if isinstance(profile, Mapping) else _read_profile(profile)


def _read_profile(profile: str | Path) -> dict[str, Any]:
    builtin = _profiles() / f"{profile}.toml"
    path = Path(profile)
    try:
        if path.suffix == ".toml":
            return {"profile": path.stem, **tomllib.loads(path.read_text())}
        if builtin.is_file():
            return {"profile": str(profile), **tomllib.loads(builtin.read_text())}
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot read the profile ({error}); give a readable TOML file") from None
    except tomllib.TOMLDecodeError as error:
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
            raise ConfigError(f"{where}: unknown setting '{prefix}{key}'{did_you_mean(key, model.model_fields)}")
        section = model.model_fields[key].annotation
        if isinstance(value, dict) and isinstance(section, type) and issubclass(section, BaseModel):
            _check_keys(value, where, section, f"{prefix}{key}.")


def _one_line(error: ValidationError, where: str) -> str:
    first = error.errors()[0]
    name = ".".join(map(str, first["loc"])) or "settings"
    value = first["input"] if not isinstance(first["input"], dict) else ""
    return (
        f"{where}: {name} {value!r}: {first['msg'].removeprefix('Value error, ')}"
        if value != ""
        else f"{where}: {name}: {first['msg'].removeprefix('Value error, ')}"
    )
