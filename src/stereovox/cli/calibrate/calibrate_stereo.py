# SPDX-License-Identifier: Apache-2.0
"""Calibrate the lenses and the relative pose of a stereo camera from image pairs of a chessboard.

FOLDER holds left01.png, right01.png and so on, or imageL0.png and imageR0.png, or folders left/ and right/. Take ten
pairs or more: near and far, in all corners of both images, and tilted. The board must be flat and still.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.recordings import check_outputs
from stereovox.cli.terminal import say, tracked
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.calibrate.stereo import StereoCalibration

EXAMPLES = """stereovox calibrate stereo boards --board 9x6 --square 0.025 --out rig.toml --report boards-report
stereovox calibrate stereo boards --board 9x6 --square 0.025 --lens fisheye --out rig.toml"""
GOOD_PX = 0.5
MAX_BASELINE_M = 5.0
"""A longer baseline likely means a square given in millimetres."""
SHOWN = 5


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("folder", metavar="FOLDER", help="image pairs of a chessboard")
    parser.add_argument("--board", required=True, metavar="CxR", help="inner corners across and down, for example 9x6")
    parser.add_argument("--square", required=True, type=float, metavar="M", help="side of a square in metres")
    parser.add_argument("--out", required=True, metavar="FILE", help="rig file to write, for example rig.toml")
    parser.add_argument("--lens", default="pinhole", metavar="MODEL", help="pinhole (default) or fisheye")
    parser.add_argument("--name", default="stereo", metavar="NAME", help="name of the pair (%(default)s)")
    parser.add_argument("--rectify", metavar="MODEL", help="pinhole, spherical or cylindrical (chosen by the lens)")
    parser.add_argument("--report", metavar="DIR", help="folder for a page with figures and pictures")


def run(arguments: Namespace) -> dict[str, Any]:
    """Calibrate, write the rig file and print how well it fits."""
    from stereovox.calibrate.stereo import calibrate_stereo, check_model, read_boards, unmatched

    board = _board(arguments.board, arguments.square)
    check_model(arguments.lens)
    check_outputs(arguments.out, arguments.report)
    pairs = read_boards(arguments.folder, board, lambda items: tracked(items, len(items), "finding the board"))
    found = calibrate_stereo(pairs, board, arguments.lens)
    _write(arguments, found)
    alone = unmatched(arguments.folder)
    _print_result(found, arguments, alone)
    result = {**found.as_dict(), "unmatched": alone, "out": arguments.out}
    if arguments.report:
        from stereovox.view.report.calibration import write_stereo_report

        result["report"] = str(write_stereo_report(arguments.report, found, arguments.out))
        say(f"report: {result['report']}")
    return result


def _board(text: str, square: float) -> Any:
    from stereovox.calibrate.stereo import Board

    try:
        columns, rows = (int(word) for word in text.lower().split("x"))
    except ValueError:
        raise StereovoxError(f"--board {text}: write inner corners across and down, for example 9x6") from None
    return Board(columns, rows, square)


def _write(arguments: Namespace, found: StereoCalibration) -> None:
    from stereovox.files.safe_io import replacing
    from stereovox.sources.rigs.rig_file import Rig, RigPair, Virtual, rig_text

    model = arguments.rectify or ("spherical" if found.eyes.left.model == "fisheye" else "pinhole")
    pair = RigPair(arguments.name, eyes=found.eyes, virtual=Virtual(model))
    pair.stereo_pair(Path(arguments.out).parent)  # raises before an unusable rig file is written
    used = f"{len(found.used)} of {len(found.pairs)} pairs of {Path(arguments.folder).resolve().name}"
    figures = f"RMS {found.overall('rms_px'):.3f} px, epipolar {found.overall('epipolar_px'):.3f} px"
    with replacing(arguments.out) as file:
        file.write(rig_text(Rig((pair,)), (f"stereovox calibrate stereo: {used}", figures)).encode())


def _print_result(found: StereoCalibration, arguments: Namespace, alone: list[str]) -> None:
    for pair in found.pairs:
        if pair.why:
            say(f"  {pair.name}: skipped, {pair.why}")
        else:
            say(f"  {pair.name}: corners off by {pair.rms_px:.3f} px RMS, rows by {pair.epipolar_px:.3f} px")
    if alone:
        more = f" and {len(alone) - SHOWN} more" if len(alone) > SHOWN else ""
        say(f"note: no image of the other eye for {', '.join(alone[:SHOWN])}{more}")
    figures = found.as_dict()
    unseen_px = figures["unseen_px"]
    unseen = "" if unseen_px is None else f" ({unseen_px:.3f} px in pairs the calibration has not seen)"
    say(f"{figures['used']} of {len(found.pairs)} pairs: corners off by {figures['rms_px']:.3f} px RMS,")
    say(f"  rows after rectification by {figures['epipolar_px']:.3f} px{unseen}")
    say(f"baseline {1000 * figures['baseline_m']:.2f} mm; fields of view {_format_fields(figures)} deg")
    if figures["baseline_m"] > MAX_BASELINE_M:
        length = f"{figures['baseline_m']:.4g} m is a long baseline"
        say(f"note: {length}; is --square {arguments.square:g} in millimetres? Give metres")
    if max(figures["rms_px"], figures["epipolar_px"]) > GOOD_PX:
        say("note: these errors are large; is the board flat, the picture sharp, and --lens right? See the report")
    if len(found.used) < 10:
        say("note: few pairs; take ten or more, in all corners of the images")
    say(f"saved {arguments.out}")


def _format_fields(figures: dict[str, Any]) -> str:
    return " and ".join(f"{across:.1f} x {down:.1f}" for across, down in figures["field_of_view_deg"])
