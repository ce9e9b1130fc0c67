# SPDX-License-Identifier: Apache-2.0
"""Options shared by commands: recordings of walls, recordings of robots, and checks of the files they write."""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.options import add_settings, overrides
from stereovox.cli.terminal import command_line, say, tracked
from stereovox.errors import StereovoxError
from stereovox.files.safe_io import check_folder

if TYPE_CHECKING:
    from stereovox.calibrate.surface import WallRecording
    from stereovox.config import Config
    from stereovox.localize.track import Track
    from stereovox.opening import Stream
    from stereovox.sources.robots.robot import Robot


LIVE_FRAMES = 60
"""Number of frames to take from a live camera if --frames has no end."""


def add_recordings(parser: ArgumentParser) -> None:
    """Declare the recordings of walls and their distances."""
    parser.add_argument(
        "recordings", nargs="+", metavar="RECORDING", help="recording of a flat wall by a still camera; no poses"
    )
    parser.add_argument(
        "--distance",
        action="append",
        type=float,
        default=[],
        metavar="M",
        help="measured distance in metres from the camera to the wall along the optical axis, once for each RECORDING",
    )
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames of each, as a Python slice")
    parser.add_argument("--report", metavar="DIR", help="folder for a page with figures and pictures")


def check_outputs(out: str, report: str | None = None) -> None:
    """Raise StereovoxError, before the work, if a result cannot be written or `out` does not end in .toml."""
    if Path(out).suffix != ".toml":
        raise StereovoxError(f"--out {out}: give a name that ends in .toml")
    if os.path.isdir(out):
        raise StereovoxError(f"--out {out}: is a folder; name a file")
    check_folder(Path(out).absolute().parent, f"--out {out}")
    if report is not None:
        if os.path.exists(report) and not os.path.isdir(report):
            raise StereovoxError(f"--report {report}: is a file; name a folder")
        existing = next(path for path in (Path(report).absolute(), *Path(report).absolute().parents) if path.exists())
        check_folder(existing, f"--report {report}")


def read_walls(
    names: Sequence[str],
    distances: Sequence[float],
    frames: str | None,
    camera: str | None = None,
    raw: bool = False,
    conditions: Sequence[str] = (),
) -> list[WallRecording]:
    """Return the walls of the recordings; `distances` as for `check_distances`, `conditions` likewise.

    camera: a camera file that replaces their own. raw: use the measured depths without any correction.
    """
    measured, named = distances or [None] * len(names), conditions or [""] * len(names)
    return [
        _read(name, distance, frames, camera, raw, condition)
        for name, distance, condition in zip(names, measured, named, strict=True)
    ]


def _read(
    name: str, distance: float | None, frames: str | None, camera: str | None, raw: bool, condition: str
) -> WallRecording:
    from stereovox.calibrate.surface import read_wall
    from stereovox.config import load_config
    from stereovox.depth import DepthPipeline
    from stereovox.opening import open_images, parse_slice
    from stereovox.sources.calibration.camera_file import with_camera

    stream: Stream = open_images(name, frames)
    if camera is not None:
        stream = with_camera(stream, camera)
    for note in stream.notes:
        say(f"note: {note}")
    if raw and stream.camera.correction:
        say(f"note: {name}: its depth correction is ignored here, since a new one is estimated")
    count = stream.length
    if count is None and (frames is None or parse_slice(frames).stop is None):
        count = LIVE_FRAMES
    path = DepthPipeline(load_config())
    shown = tracked(islice(stream, count), count, name)
    lens = replace(stream.camera, correction=None) if raw else stream.camera
    return read_wall(shown, name, lens, distance, path.matched, condition)


def check_count(names: Sequence[str], given: Sequence[object], option: str) -> None:
    """Raise StereovoxError unless the option was given once for each recording, or not at all."""
    if given and len(given) != len(names):
        many = f"{len(names)} recording{'s' * (len(names) != 1)}"
        raise StereovoxError(f"{many} but {len(given)} x {option}: give one for each, in the same order, or none")


def check_distances(names: Sequence[str], distances: Sequence[float], option: str = "--distance") -> None:
    """Raise StereovoxError unless each recording has a valid distance, or none has one."""
    check_count(names, distances, option)
    for distance in distances:
        if not 0 < distance < 1000:
            raise StereovoxError(f"{option} {distance:g}: give metres, above 0")


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
