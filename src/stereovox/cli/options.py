# SPDX-License-Identifier: Apache-2.0
"""Options shared by several commands: settings, numbers, checkpoints, file suffixes."""

from __future__ import annotations

import math
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.geometry.se3 import Transform
    from stereovox.runs.engine import RunOptions

CORNERS = "X0,Y0,Z0,X1,Y1,Z1"
"""Syntax of a box: its lowest and its highest corner."""
MAX_FILE = 10_000
"""Largest size in bytes of a file with a transform."""
CHECKPOINT_S = 10.0
"""Copy of `runs.engine.CHECKPOINT_S`, so that `--help` need not import it."""
OWN_OPTIONS = ("voxel_size", "integrator", "max_range", "threads", "device")
"""Settings that may have their own option."""


USUAL: dict[str, dict[str, Any]] = {
    "profile": {"metavar": "P", "help": "profile name or TOML file (default)"},
    "voxel-size": {"type": float, "metavar": "M", "help": "cell size in metres"},
    "max-range": {"type": float, "metavar": "M", "help": "largest depth to use, in metres"},
    "threads": {"type": int, "metavar": "N", "help": "threads (1); the map does not depend on it"},
    "frames": {"metavar": "A:B:S", "help": "only these frames, as a Python slice"},
    "camera": {"metavar": "FILE", "help": "camera file (camera.toml) that replaces the recording's own"},
}
"""Options that mean the same in several commands."""


def add_usual(parser: ArgumentParser, *names: str) -> None:
    """Declare some of the options that mean the same in several commands."""
    for name in names:
        parser.add_argument(f"--{name}", **USUAL[name])


def numbers_of(option: str, text: str, names: str) -> list[float]:
    """Parse as many numbers as there are `names` ("X,Y,Z"); raises StereovoxError that names the option."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(names.split(",")) or any(map(math.isnan, numbers)):
        raise StereovoxError(f"{option} {text}: write {names}, numbers in metres with commas and no spaces")
    return numbers


def point(text: str) -> tuple[float, float, float]:
    """Parse X,Y,Z in metres; raises ArgumentTypeError for anything else."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise ArgumentTypeError(f"'{text}' is not a point; give X,Y,Z in metres")
    return x, y, z


def transform_of(text: str) -> Transform:
    """Parse --transform: seven numbers, or a file with them or with a 4x4 matrix.

    Raises StereovoxError: one line that names the value or file and the cure.
    """
    import numpy as np

    from stereovox.files.safe_io import read_text
    from stereovox.geometry.se3 import from_quaternion
    from stereovox.products.moved import rigid

    where = f"--transform {text}"
    try:
        words = text if "," in text else read_text(Path(text), MAX_FILE)
        numbers = np.array([float(word) for word in words.replace(",", " ").split()])
    except (OSError, UnicodeError, ValueError):
        numbers = np.array([])
    if numbers.size == 7 and np.isfinite(numbers).all() and numbers[3:].any():
        return from_quaternion(numbers[:3], numbers[3:])
    if numbers.size != 16 or not np.isfinite(numbers).all():
        raise StereovoxError(f"{where}: write tx,ty,tz,qx,qy,qz,qw, or name a file with these or a 4x4 matrix")
    try:
        return rigid(numbers.reshape(4, 4))
    except StereovoxError as error:
        raise StereovoxError(f"{where}: {error}") from None


def heights_of(text: str | None) -> tuple[float, float] | None:
    """Parse --heights LO:HI; raises StereovoxError for anything else."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        heights = float(low), float(high)
    except ValueError:
        raise StereovoxError(f"--heights {text}: write LO:HI in metres, for example --heights 0.1:1.8") from None
    if not heights[0] < heights[1]:
        raise StereovoxError(f"--heights {text}: the second must be higher than the first")
    return heights


def add_checkpoint(parser: ArgumentParser) -> None:
    """Declare --checkpoint."""
    parser.add_argument(
        "--checkpoint",
        type=float,
        default=CHECKPOINT_S,
        metavar="SECONDS",
        dest="checkpoint_s",
        help=f"save the map at this interval ({CHECKPOINT_S:g}; 0: only at the end), taking at most 4 %% of the time",
    )


def check_ending(option: str, file: str | None, *endings: str) -> None:
    """Raise StereovoxError if the file of an option does not have one of these suffixes."""
    if file is not None and Path(file).suffix.lower() not in endings:
        raise StereovoxError(f"{option} {file}: end the file's name with {' or '.join(endings)}")


def add_settings(parser: ArgumentParser, example: str) -> None:
    """Declare --set; `example` is a setting for its help."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help=f"any other setting, for example {example}; repeatable",
    )


def options_of(kind: type[RunOptions], arguments: Namespace) -> dict[str, Any]:
    """Return the options of a run from the command line: those that the command has, and settings."""
    settings, names = overrides(arguments), kind.names()
    for name in sorted(set(settings) & set(names)):
        option = f"use --{name.removesuffix('_s').replace('_', '-')}"
        raise StereovoxError(
            f"--set {name}: this is not a setting; {option if hasattr(arguments, name) else 'leave it out'}"
        )
    return {name: getattr(arguments, name) for name in names if hasattr(arguments, name)} | settings | {"notify": say}


def overrides(arguments: Namespace) -> dict[str, Any]:
    """Return the settings that options override; raises StereovoxError for a bad --set."""
    from stereovox.config import parse_value

    found = {}
    for setting in arguments.settings:
        key, equals, value = setting.partition("=")
        if not equals or not key:
            raise StereovoxError(f"--set {setting}: write KEY=VALUE, for example --set sensor.p_free=0.3")
        if key.strip() in ("profile", "resume"):
            raise StereovoxError(f"--set {setting}: this is not a setting; use --{key.strip()}")
        if key.strip() in ("tiles", "self"):  # other arguments of `Mapper`
            raise StereovoxError(f"--set {setting}: this is not a setting; leave it out")
        found[key.strip()] = parse_value(value.strip())
    named = {name: getattr(arguments, name, None) for name in OWN_OPTIONS}
    return {**found, **{name: value for name, value in named.items() if value is not None}}
