# SPDX-License-Identifier: Apache-2.0
"""Measure the noise of a depth camera in front of flat walls, and write a profile with the result.

Record a flat, textured wall with a still camera from three or more distances, about 30 frames each, from the nearest to
the farthest you will use. Only the middle of the image is used. Use the result with: stereovox map SOURCE --profile
FILE. To compare light, emitter power or textures, name those of each recording with --condition.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING, Any

from stereovox.cli.recordings import add_recordings, check_count, check_distances, check_outputs, read_walls
from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.calibrate.noise import ConditionNoise, NoiseAt, NoiseCalibration

EXAMPLES = """stereovox calibrate noise wall-1m wall-2m wall-4m --out my-d435.toml --report noise-report
stereovox calibrate noise wall-2m --out my-d435.toml --json"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    add_recordings(parser)
    parser.add_argument("--out", required=True, metavar="FILE", help="profile to write, for example my-d435.toml")
    parser.add_argument(
        "--camera", metavar="FILE", help="camera file that replaces the recordings' own, with correction"
    )
    parser.add_argument(
        "--region",
        default="0.6x0.4",
        metavar="WxH",
        help="part of the wall around its middle to use, in metres (%(default)s)",
    )
    parser.add_argument(
        "--condition",
        action="append",
        default=[],
        metavar="TEXT",
        help="light, emitter power or texture in words, for example 'dark, 150 mW', once for each RECORDING; "
        "prints a table of errors and valid pixels by condition",
    )
    parser.add_argument(
        "--terms", default="s0,s1,s2", metavar="S,...", help="coefficients to fit; each needs a distance (%(default)s)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Calibrate, write the profile and print the result."""
    from stereovox.calibrate.noise import calibrate_noise

    region, terms = _region(arguments.region), _terms(arguments.terms)
    check_distances(arguments.recordings, arguments.distance)
    check_count(arguments.recordings, arguments.condition, "--condition")
    check_outputs(arguments.out, arguments.report)
    walls = read_walls(
        arguments.recordings, arguments.distance, arguments.frames, arguments.camera, conditions=arguments.condition
    )
    found = calibrate_noise(walls, region, terms)
    _write(arguments.out, found)
    _print_result(found, arguments.out)
    result = {**found.as_dict(), "out": arguments.out}
    if arguments.report:
        from stereovox.view.report.calibration import write_noise_report

        result["report"] = str(write_noise_report(arguments.report, found, arguments.out))
        say(f"report: {result['report']}")
    return result


def _region(text: str) -> tuple[float, float]:
    try:
        width, height = (float(word) for word in text.lower().split("x"))
    except ValueError:
        width = height = 0.0
    if not (0 < width < 1000 and 0 < height < 1000):
        raise StereovoxError(f"--region {text}: write width x height in metres, for example 0.6x0.4")
    return width, height


def _terms(text: str) -> list[str]:
    from stereovox.calibrate.noise import TERMS

    terms = [word.strip() for word in text.split(",")]
    if len(set(terms)) < len(terms) or not set(terms) <= set(TERMS):
        raise StereovoxError(f"--terms {text}: name some of {', '.join(TERMS)}, for example s0,s2")
    return terms


def _write(out: str, found: NoiseCalibration) -> None:
    from stereovox.files.safe_io import replacing

    with replacing(out) as file:
        file.write(profile_text(found).encode())


def profile_text(found: NoiseCalibration) -> str:
    """Return the profile as text, with the measurements it was fitted to as comments."""
    lines = ["# range noise sigma(z) = s0 + s1 z + s2 z^2 in metres, measured by stereovox calibrate noise"]
    if found.subpixel is not None:
        lines.append(f"# s2 is a disparity error of {found.subpixel:.4f} px")
    lines += [f"# {point.distance_m:.3f} m: RMSE {1000 * point.rmse_m:.2f} mm" for point in found.points]
    lines += ["# correlation_px: errors of neighbouring pixels correlate as if smoothed by a Gaussian of this width"]
    names = ("s0", "s1", "s2", "correlation_px")
    lines += ["[noise]", *(f"{name} = {float(getattr(found, name))!r}" for name in names)]
    return "\n".join(lines) + "\n"


def _print_result(found: NoiseCalibration, out: str) -> None:
    for note in found.notes:
        say(f"note: {note}")
    for point in found.points:
        parts = ""
        if point.temporal_m is not None and point.fixed_m is not None:
            parts = f" ({1000 * point.temporal_m:.2f} from frame to frame, {1000 * point.fixed_m:.2f} fixed)"
        subpixel = "" if point.subpixel is None else f", sub-pixel {point.subpixel:.3f}"
        say(
            f"  at {point.distance_m:.2f} m: RMSE {1000 * point.rmse_m:.2f} mm{parts}{subpixel}, "
            f"{point.valid_share:.1%} of the pixels valid, {_independent(point)}"
        )
    for one in found.conditions:
        say(f"  {_condition(one)}")
    subpixel = "" if found.subpixel is None else f"; s2 is {found.subpixel:.4f} px of disparity"
    say(f"sigma(z) = {found.s0:.3g} + {found.s1:.3g} z + {found.s2:.3g} z^2 m{subpixel}")
    say(f"errors of neighbouring pixels correlate over a Gaussian of {found.correlation_px:.2f} px")
    say("fitted to the whole RMSE: a constant error does not average out, so it belongs to sigma")
    say(f"saved {out}; use it with: stereovox map SOURCE --out MAP --profile {out}")


def _independent(point: NoiseAt) -> str:
    return f"8x8 of them count as {point.looks:.1f} independent ones"


def _condition(one: ConditionNoise) -> str:
    error = f"{one.rmse_percent:.2f} %" if one.subpixel is None else f"{one.rmse_percent:.2f} % ({one.subpixel:.3f} px)"
    grey = "" if one.grey is None else f", mean grey {one.grey:.0f}"
    return f"{one.condition}: RMSE {error}, {one.valid_share:.1%} valid, {one.gross_share:.2%} gross errors{grey}"
