# SPDX-License-Identifier: Apache-2.0
"""What the commands for ground robots have in common: recordings, settings, and the files they write."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Iterable, Mapping
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.recordings import check_folder
from stereovox.cli.settings import add_settings, overrides
from stereovox.cli.terminal import command_line, say
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.localize.track import Track
    from stereovox.sources.robot import Robot

GRID_ENDINGS = (".yaml", ".pgm", ".png")
"""Files of a 2-D map: the picture and its .yaml are written together, whichever is named."""
GRID_FILES = (*GRID_ENDINGS, ".yml")
"""Those that can be read."""


def add_robot(parser: ArgumentParser) -> None:
    """Declare the recording and the settings."""
    parser.add_argument(
        "source", metavar="ROBOT", help="a bag with scans, a CARMEN log (.clf, .log, packed or not) or sim:floor"
    )
    parser.add_argument("--profile", default="default", metavar="P", help="profile name or TOML file (default)")
    add_settings(parser, "slam.voxel_size=0.1")


def settings_of(arguments: Namespace) -> Config:
    """Return the settings that profile and options ask for."""
    from stereovox.config import load_config

    return load_config(arguments.profile, **overrides(arguments))


def opened(where: str) -> Robot:
    """Open the recording and say what had to be assumed about it."""
    from stereovox.sources import open_robot

    robot = open_robot(where)
    for note in robot.notes:
        say(f"note: {note}")
    return robot


def say_refused(refused: Mapping[str, int], first: str = "") -> None:
    """Say how many scans could not be used, by reason."""
    if refused:
        reasons = ", ".join(f"{number} x {reason}" for reason, number in refused.items())
        say(f"{sum(refused.values())} scans refused: {reasons}" + (f", first: {first}" if first else ""))


def way_error(track: Track, robot: Robot) -> dict[str, Any]:
    """Say how far the way found is from the true one, where that is known, and return it."""
    if robot.truth is None:
        return {}
    from stereovox.evaluate.trajectory_error import trajectory_error

    error = trajectory_error(track, robot.truth)
    off = f"{100 * error.position_rms_m:.1f} cm (RMS) and {error.yaw_rms_deg:.2f} degrees"
    say(f"laid on the true way as a whole, it is off by {off}")
    return {"position_rms_m": error.position_rms_m, "yaw_rms_deg": error.yaw_rms_deg}


def picture_line(out: Path) -> str:
    """Return the command that draws the map at `out`, whose own cells may lie in a .png of its name."""
    name = f"{out.stem}-picture.png" if out.with_suffix(".png").exists() else f"{out.stem}.png"
    return command_line("picture", out.with_suffix(".yaml"), name)


def check_in_space(out: str | Path) -> None:
    """Raise StereovoxError where a map in space would get the name of a floor's map."""
    if Path(out).suffix.lower() in GRID_FILES:
        raise StereovoxError(f"{out}: names a floor's map; end the name of a map in space in .svox, or leave it bare")


def only_writer_of_floor(out: Path) -> AbstractContextManager[None]:
    """Be the only one who writes a floor's map, its pictures and its way, whichever of them `out` names."""
    from stereovox.maps.lock import only_writer_of

    yaml, *pictures, way = (out.with_suffix(ending) for ending in (*GRID_ENDINGS, ".tum"))
    between = [picture.with_name(f".{picture.name}") for picture in pictures]
    return only_writer_of(yaml, *pictures, *between, way)


def check_file(out: str, endings: Iterable[str], option: str = "--out") -> Path:
    """Return `out` as a path; raises StereovoxError before the work where it could not be written after it."""
    path = Path(out)
    if path.suffix.lower() not in endings:
        raise StereovoxError(f"{option} {out}: give a name that ends in {' or '.join(endings)}")
    if os.path.isdir(out):
        raise StereovoxError(f"{option} {out}: is a folder; name a file")
    check_folder(path.absolute().parent, option, out)
    return path
