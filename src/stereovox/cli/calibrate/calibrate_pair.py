# SPDX-License-Identifier: Apache-2.0
"""Calibrate the pose of a depth camera on a tracker, and their clock offset, from a recording of both.

RECORDING is a folder with depth images and a tracker's poses (tracker.txt, or the file in its pair.toml). Move both
for ten seconds or more in a furnished room: rotate by 20 degrees or more in pitch, yaw and roll, not too fast.
"""

from __future__ import annotations

import os
from argparse import ArgumentParser, Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from stereovox.cli.recordings import check_outputs
from stereovox.cli.terminal import command_line, say, tracked
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.calibrate.pair import PairCalibration
    from stereovox.opening import DepthSource
    from stereovox.sources.rigs.pair_file import PairSettings

EXAMPLES = """stereovox calibrate pair recordings/flight --out recordings/flight/pair.toml
stereovox calibrate pair recordings/flight --out pair.toml --json"""
UNCERTAIN = (0.5, 0.02)
"""Standard deviations (degrees, metres) above which the user is warned."""

SHORT_S = 3.0
"""A calibration that fails on a shorter recording most likely fails for that reason."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("recording", metavar="RECORDING", help="folder with depth images and a tracker's poses")
    parser.add_argument("--out", metavar="FILE", help="pair.toml to write; without it the result is only printed")
    parser.add_argument("--frames", metavar="A:B:S", help="only these images, as a Python slice")
    parser.add_argument(
        "--within", type=float, metavar="S", help="search clock offsets within S seconds of the one in pair.toml (all)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Calibrate, print the result and write it."""
    from stereovox.opening import Selection, open_depth

    folder = Path(arguments.recording)
    settings = _settings(folder)
    if arguments.within is not None and not 0 < arguments.within < 1e9:
        raise StereovoxError(f"--within {arguments.within:g}: give a number of seconds above 0")
    if arguments.out is not None:
        check_outputs(arguments.out)
    depth = open_depth(folder, settings)
    for note in depth.notes:
        say(f"note: {note}")
    depth = cast("DepthSource", Selection(depth, arguments.frames)) if arguments.frames else depth
    try:
        found = _calibrate(depth, folder, settings, arguments.within)
    except StereovoxError as error:
        if type(error) is not StereovoxError:
            raise  # a missing file or library
        raise StereovoxError(f"{_too_short(depth)}{error}") from None
    _print_result(found)
    _write(arguments, folder, settings, found)
    return {**found.as_dict(), "out": arguments.out}


def _calibrate(depth: DepthSource, folder: Path, settings: PairSettings, within_s: float | None) -> PairCalibration:
    from stereovox.calibrate.pair import calibrate_pair
    from stereovox.sources.rigs.pair import open_poses

    return calibrate_pair(
        depth,
        open_poses(folder, replace(settings, clock_offset_s=0.0)),
        min_confidence=settings.min_confidence,
        max_speed_mps=settings.max_speed_mps,
        max_turn_dps=settings.max_turn_dps,
        guess_s=settings.clock_offset_s,
        within_s=within_s,
        progress=lambda frames, total: tracked(frames, total, "registering images"),
    )


def _too_short(depth: DepthSource) -> str:
    """Return the beginning of the error message if the recording is too short, else an empty string."""
    from stereovox.sources.rigs.pair import image_times

    first_ns, last_ns = image_times(depth)
    seconds = (last_ns - first_ns) / 1e9
    if seconds >= SHORT_S:
        return ""
    return f"{depth.name}: {len(depth)} images in {max(seconds, 0):.1f} s are too few; record for ten seconds or more: "


def _settings(folder: Path) -> PairSettings:
    from stereovox.sources.rigs.pair_file import FILE, PairSettings, read_pair

    file, usual = folder / FILE, PairSettings()
    if os.path.isfile(file):
        return read_pair(file)
    if not os.path.isfile(folder / usual.poses):
        raise StereovoxError(f"{folder}: neither {FILE} nor {usual.poses} in it; put the tracker's poses there")
    return usual


def _print_result(found: PairCalibration) -> None:
    import numpy as np

    from stereovox.geometry.se3 import rotation_vector

    turn = np.degrees(rotation_vector(found.T_tracker_camera[:3, :3]))
    place = 1000 * found.T_tracker_camera[:3, 3]
    say(f"clock_offset_s {found.clock_offset_s:.4f}, standard deviation {1000 * found.offset_std_s:.1f} ms")
    say(f"camera in the tracker's frame (x right, y down, z forward): {_format_xyz(place, '+.1f')} mm,")
    say(f"  standard deviations {_format_xyz(1000 * found.translation_std_m, '.1f')} mm")
    turn_std = _format_xyz(found.rotation_std_deg, ".2f")
    say(f"  turned by {_format_xyz(turn, '+.2f')} deg, standard deviations {turn_std} deg")
    fit = f"{found.rotation_residual_deg:.2f} deg and {1000 * found.translation_residual_m:.1f} mm"
    say(f"{found.pairs} of {found.images} images used; camera and tracker agree within {fit} (median)")
    degrees, metres = UNCERTAIN
    if found.rotation_std_deg.max() > degrees or found.translation_std_m.max() > metres:
        say("note: this is uncertain; record for longer, with more pitch, yaw and roll, near corners and furniture")


def _format_xyz(numbers: Any, form: str) -> str:
    return " ".join(f"{name} {number:{form}}" for name, number in zip("xyz", numbers, strict=True))


def _write(arguments: Namespace, folder: Path, settings: PairSettings, found: PairCalibration) -> None:
    from stereovox.files.safe_io import replacing
    from stereovox.sources.rigs.pair_file import FILE, pair_text

    if not arguments.out:
        say(f"nothing is written; keep it with: {command_line('calibrate', 'pair', folder, '--out', folder / FILE)}")
        return
    out = Path(arguments.out)
    depth, poses = (os.path.relpath(folder / path, out.parent) for path in (settings.depth, settings.poses))
    T, offset_s = found.T_tracker_camera, found.clock_offset_s
    found_settings = replace(settings, depth=depth, poses=poses, T_tracker_camera=T, clock_offset_s=offset_s)
    remarks = (
        f"T_tracker_camera and clock_offset_s: stereovox calibrate pair, {found.pairs} of {found.images} images",
        f"standard deviations: {1000 * found.offset_std_s:.2g} ms, {found.rotation_std_deg.max():.2g} deg, "
        f"{1000 * found.translation_std_m.max():.2g} mm",
    )
    with replacing(out) as file:
        file.write(pair_text(found_settings, remarks).encode())
    say(f"saved {out}")
