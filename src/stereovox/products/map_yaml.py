# SPDX-License-Identifier: Apache-2.0
"""The .yaml of a map_server map: what its picture means."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import MapFileError, did_you_mean
from stereovox.untrusted import MOST_YAML, read_bounded, shown, yaml_value

MODES = ("trinary", "scale", "raw")
NEEDED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")


@dataclass(frozen=True)
class Meaning:
    """What a map's picture means.

    image: the picture. resolution: side of a cell in metres. origin: x, y in metres and yaw of its lower left corner.
    negate: white is occupied. occupied_thresh, free_thresh: probabilities. mode: one of MODES.
    """

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: str

    def text(self) -> str:
        """Return it as YAML."""
        origin = ", ".join(map(_plain, self.origin))
        return (
            f"image: {_quoted(self.image.name)}\nmode: {self.mode}\nresolution: {_plain(self.resolution)}\n"
            f"origin: [{origin}]\nnegate: {int(self.negate)}\n"
            f"occupied_thresh: {_plain(self.occupied_thresh)}\nfree_thresh: {_plain(self.free_thresh)}\n"
        )


def read_meaning(path: Path) -> Meaning:
    """Return what the .yaml `path` says; `image` is relative to it. Raises MapFileError, one line, for all else."""
    try:
        if path.is_dir():
            raise MapFileError(
                f"{path}: no map of a floor; make one of a map in space: stereovox export {path} floor.yaml"
            )
        if not path.is_file():
            raise MapFileError(f"{path}: no such file; give the .yaml of a map_server map")
        says: Any = yaml_value(read_bounded(path, MOST_YAML))
    except OSError as error:
        raise MapFileError(f"{path}: cannot be read ({error.strerror or error})") from None
    except MapFileError:
        raise
    except ValueError as error:
        raise MapFileError(f"{path}: is no YAML ({str(error)[:200]})") from None
    if not isinstance(says, dict) or not any(name in says for name in NEEDED):
        raise MapFileError(f"{path}: is not the .yaml of a map_server map")
    return _checked(path, says)


def _checked(path: Path, says: dict[Any, Any]) -> Meaning:
    missing = [name for name in NEEDED if name not in says]
    if missing:
        raise MapFileError(f"{path}: has no '{missing[0]}', which the .yaml of a map_server map needs")
    mode, origin, image = says.get("mode", MODES[0]), says["origin"], says["image"]
    if mode not in MODES:
        raise MapFileError(f"{path}: mode '{mode}'{did_you_mean(str(mode), MODES)}")
    if not isinstance(origin, list) or len(origin) != 3:
        raise MapFileError(f"{path}: origin {shown(origin)}; give [x, y, yaw]")
    if not isinstance(image, str) or not image or "\0" in image:
        raise MapFileError(f"{path}: image {shown(image)}; give the name of the picture")
    x, y, yaw = (_number(path, "origin", number) for number in origin)
    resolution, occupied, free, negate = (
        _number(path, name, says[name]) for name in ("resolution", "occupied_thresh", "free_thresh", "negate")
    )
    if not resolution > 0:
        raise MapFileError(f"{path}: resolution {resolution:g}; cells have a side above 0 metres")
    if not 0 <= free < occupied <= 1:
        raise MapFileError(f"{path}: free_thresh {free:g} and occupied_thresh {occupied:g} must rise, from 0 to 1")
    return Meaning(path.parent / image, resolution, (x, y, yaw), bool(negate), occupied, free, str(mode))


def _number(path: Path, name: str, value: Any) -> float:
    try:
        number = float(value)  # text too: YAML takes 1e-5 for such
    except (TypeError, ValueError, OverflowError):
        number = np.nan
    if not np.isfinite(number):
        raise MapFileError(f"{path}: {name} {shown(value)} is no number")
    return number


def _plain(number: float) -> str:
    """Return a number in full and without exponent, which YAML would take for text."""
    return np.format_float_positional(float(number), trim="0")


def _quoted(name: str) -> str:
    """Return a file name as YAML takes it for text, whatever is in it."""
    import yaml

    return yaml.safe_dump(name, allow_unicode=True, width=10**6).removesuffix("\n").removesuffix("\n...")
