# SPDX-License-Identifier: Apache-2.0
"""Time stereovox and other mapping libraries on the same frames, in one process (how accurate: `benchmark`).

Without SOURCE the frames come from the built-in room. The figures are meaningful only on an otherwise idle machine.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.terminal import progress_bar, say, say_about_compiling
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox_lab.bench.rows import Variant

GROUP = "Prove"
EXAMPLES = """stereovox bench recordings/kitchen --voxel-size 0.1 --voxel-size 0.05 --peers octomap,pyoctomap
stereovox bench --peers octomap --json"""
VOXEL_SIZES = (0.2, 0.1, 0.05, 0.02)
FAR = ("both", "unknown", "free")
BUILT_IN = "sim:room?frames=60"


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "source",
        metavar="SOURCE",
        nargs="?",
        default=BUILT_IN,
        help="recorded folder or file, or a simulation (%(default)s)",
    )
    parser.add_argument("--out", metavar="DIR", help="folder for bench.json, bench.md and bench.png")
    parser.add_argument(
        "--voxel-size", type=float, action="append", metavar="M", help="cell size in metres; repeatable"
    )
    parser.add_argument(
        "--peers",
        metavar="A,B",
        help="other libraries: octomap, pyoctomap, wavemap, octomap-rays; in C++, once built: octomap-cpp, bonxai, "
        "ufomap, wavemap-cpp; or a class of yours, module:Class (default: the first three, if installed)",
    )
    parser.add_argument(
        "--integrators",
        metavar="A,B",
        default="projective",
        help="integrators of stereovox: projective, ray, line (%(default)s)",
    )
    parser.add_argument("--threads", type=int, metavar="N", help="threads of stereovox (both 1 and all cores)")
    parser.add_argument("--max-range", type=float, metavar="M", help="largest depth used, in metres (5)")
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames, as a Python slice")
    parser.add_argument(
        "--far",
        choices=FAR,
        default="both",
        help="pixels beyond the maximum range: without a value (unknown), clearing space up to there (free), or one "
        "table for each (%(default)s)",
    )
    parser.add_argument(
        "--also",
        metavar="A,B",
        default="",
        help="further measurements: threads, first-frame, start-up, overhead, map-size, path",
    )
    parser.add_argument("--all", action="store_true", help="run all of these")
    parser.add_argument(
        "--frames-long", type=int, metavar="N", help="frames of the simulated flight of `path`, at least 500 (6000)"
    )
    parser.add_argument(
        "--most-cells", type=int, metavar="N", help="largest map of `map-size`, at least 10000 (100000000)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the comparison and all requested measurements; print the tables and write the files."""
    from stereovox.view.report.page import out_folder
    from stereovox_lab.bench import files

    folder = out_folder(arguments.out) if arguments.out is not None else None
    result: dict[str, Any] = {}

    def so_far(found: dict[str, Any]) -> None:
        result.update(found)
        if folder is not None:
            files.write(result, folder)

    try:
        _measure(arguments, so_far)
    except (KeyboardInterrupt, StereovoxError, MemoryError):
        if result:
            say(f"stopped; this much is done{f' and written into {folder}' if folder else ''}:\n")
            _print_result(result, folder)
        raise
    _print_result(result, folder)
    return result


def _measure(arguments: Namespace, so_far: Callable[[dict[str, Any]], None]) -> None:
    """Run all requested measurements, and pass on each result as soon as it is ready."""
    from stereovox.opening import open_source
    from stereovox_lab.bench.frames import read_frames
    from stereovox_lab.bench.more import MEASUREMENTS, Given, check_names
    from stereovox_lab.bench.rows import compare, find_peers

    measurements = check_names(list(MEASUREMENTS) if arguments.all else _named(arguments.also))
    sizes = arguments.voxel_size or VOXEL_SIZES
    variants = _variants(arguments)
    # bad settings raise here, before the work
    configs = [variant.config(size, arguments.max_range) for variant in variants for size in sizes]
    limits = _limits(arguments, measurements)
    peers, missing = _peers(arguments.peers)
    kinds = find_peers(peers, configs[0].voxel_size)
    source = open_source(arguments.source, arguments.frames)
    say_about_compiling()
    with progress_bar() as bar:
        task = bar.add_task("loading", note="")

        def show(done: int, total: int, text: str) -> None:
            bar.update(task, completed=done, total=total, description=text)

        read = read_frames(source, configs[0], tell=show, far=arguments.far != "unknown")
        recording = read if arguments.far == "free" else read.without_far(configs[0])
        missed = {"not_installed": missing}
        same = sizes, kinds, variants, arguments.max_range, show
        result = compare(recording, *same, so_far=lambda found: so_far(found | missed))
        if read.far_share and recording is not read:
            result["clearing"] = compare(
                read, *same, so_far=lambda found: so_far(result | missed | {"clearing": found})
            )
        given = Given(recording, sizes, variants[0], arguments.max_range, tell=show, **limits)
        more: dict[str, Any] = {}
        for name in measurements:
            more[name] = MEASUREMENTS[name].run(given)
            so_far(result | missed | {"more": more})


def _variants(arguments: Namespace) -> list[Variant]:
    """Return the variants of stereovox to time: each integrator on one thread and on all cores, or on --threads."""
    from stereovox import registry
    from stereovox.integrate import INTEGRATORS
    from stereovox_lab.bench.machine import cores
    from stereovox_lab.bench.rows import Variant

    threads = dict.fromkeys((1, cores())) if arguments.threads is None else (arguments.threads,)
    integrators = _named(arguments.integrators)
    if not integrators:
        raise StereovoxError("--integrators: name at least one, for example projective")
    for name in integrators:
        registry.find("integrators", INTEGRATORS, name)
    return [Variant(name, number) for name in integrators for number in threads]


def _limits(arguments: Namespace, measurements: Sequence[str]) -> dict[str, int]:
    """Return the requested sizes of measurements; raises StereovoxError for invalid ones."""
    from stereovox_lab.bench.growth import CELLS, MIN_FRAMES

    options = (
        ("--frames-long", "path_frames", arguments.frames_long, MIN_FRAMES, "path"),
        ("--most-cells", "most_cells", arguments.most_cells, CELLS[0], "map-size"),
    )
    limits = {}
    for option, name, number, least, measurement in options:
        if number is None:
            continue
        if measurement not in measurements:
            raise StereovoxError(f"{option} goes with --also {measurement} or --all; add one of these")
        if number < least:
            raise StereovoxError(f"{option} {number}: give at least {least}")
        limits[name] = number
    return limits


def _peers(text: str | None) -> tuple[list[str], list[str]]:
    """Return the peers to compare with, and a line for each default one that is not installed."""
    from stereovox_lab.bench.peers import installed

    if text is None:
        return installed()
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a user's module:Class is here, as for `python -m`
    return _named(text), []


def _named(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]


def _print_result(result: dict[str, Any], folder: Path | None) -> None:
    """Print the tables and the paths of the files; draw the picture."""
    from stereovox_lab.bench import files

    say(files.text(result))
    if folder is not None:
        files.write_picture(result, folder)
        say(f"written into {folder}: bench.json, bench.md, bench.png")
