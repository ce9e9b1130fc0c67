# SPDX-License-Identifier: Apache-2.0
"""Parts shared by the commands for ground robots: recordings, settings, and the files they write."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, overrides
from stereovox.cli.terminal import command_line, say

if TYPE_CHECKING:
    from stereovox.config import Config
    from stereovox.localize.track import Track
    from stereovox.sources.robots.robot import Robot


def add_robot(parser: ArgumentParser) -> None:
    """Declare the recording and the settings."""
    parser.add_argument(
        "source", metavar="ROBOT", help="a bag with scans, a CARMEN log (.clf, .log, packed or not) or sim:floor"
    )
    parser.add_argument("--profile", default="default", metavar="P", help="profile name or TOML file (default)")
    add_settings(parser, "slam.voxel_size=0.1")


def settings_of(arguments: Namespace) -> Config:
    """Return the settings from the profile and the options."""
    from stereovox.config import load_config

    return load_config(arguments.profile or "default", **overrides(arguments))


def open_noting(name: str) -> Robot:
    """Open the recording and print its notes."""
    from stereovox import opening

    robot = opening.open_robot(name)
    for note in robot.notes:
        say(f"note: {note}")
    return robot


def print_trajectory_error(track: Track, robot: Robot) -> dict[str, Any]:
    """Print and return the error of the trajectory; empty if the true one is unknown."""
    if robot.truth is None:
        return {}
    from stereovox.evaluate import trajectory

    error = trajectory.trajectory_error(track, robot.truth)
    off = f"{100 * error.position_rms_m:.1f} cm (RMS) and {error.yaw_rms_deg:.2f} degrees"
    say(f"aligned with the true trajectory as a whole, the error is {off}")
    return {"position_rms_m": error.position_rms_m, "yaw_rms_deg": error.yaw_rms_deg}


def picture_line(out: Path) -> str:
    """Return the command that draws the map at `out`; it avoids a .png of that name, which may hold the map's cells."""
    name = f"{out.stem}-picture.png" if out.with_suffix(".png").exists() else f"{out.stem}.png"
    return command_line("picture", out.with_suffix(".yaml"), name)
