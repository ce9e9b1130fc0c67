# SPDX-License-Identifier: Apache-2.0
"""Compare how accurate the maps of several libraries are, by a fixed protocol (how fast they are: `bench`).

DATASET is a recording, by its folder, or a simulation; by default simulations with realistic cameras.
The truth is exact geometry for a simulation, the lidar if a recording has one, otherwise held-out frames.
"""

from __future__ import annotations

import os
import sys
from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import command_line, progress_of_steps, say, say_about_compiling, say_table

GROUP = "Prove"
EXAMPLES = """stereovox benchmark recordings/kitchen --libraries stereovox,octomap --out kitchen-benchmark
stereovox benchmark sim:room --voxel-size 0.1 --out room-benchmark"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("data", metavar="DATASET", nargs="*", help="recorded folder or file, or a simulation")
    parser.add_argument("--out", metavar="DIR", help="folder for benchmark.html and benchmark.json")
    parser.add_argument(
        "--libraries",
        metavar="A,B",
        help="stereovox, stereovox:PROFILE, octomap, octomap-rays, pyoctomap, wavemap, or a class of yours, "
        "module:Class (default: stereovox, octomap, pyoctomap and wavemap, if installed)",
    )
    parser.add_argument("--voxel-size", type=float, metavar="M", help="cell size in metres (0.05; with a lidar 0.2)")
    parser.add_argument("--max-range", type=float, metavar="M", help="distance that is mapped (5; with a lidar 20)")
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames of each recording, as a Python slice")
    parser.add_argument(
        "--most-frames", type=int, default=100, metavar="N", help="frames used, evenly chosen (%(default)s)"
    )
    parser.add_argument(
        "--seed", type=int, action="append", metavar="N", help="of simulated noise; repeatable (7001, 7002 and 7003)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the benchmark; print the tables and write page and figures."""
    from stereovox.view.report.page import out_folder
    from stereovox_lab.benchmark.data import SEEDS
    from stereovox_lab.benchmark.run import run_benchmark
    from stereovox_lab.report import benchmark as report

    folder = out_folder(arguments.out) if arguments.out is not None else None
    libraries = None if arguments.libraries is None else _named(arguments.libraries)
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())  # a user's module:Class is here, as for `python -m`
    say_about_compiling()

    def so_far(result: dict[str, Any]) -> None:
        if folder is not None:
            report.write_benchmark(folder, result)

    with progress_of_steps("starting") as tell:
        result = run_benchmark(
            arguments.data,
            libraries,
            voxel_size=arguments.voxel_size,
            max_range=arguments.max_range,
            frames=arguments.frames,
            seeds=arguments.seed or SEEDS,
            most_frames=arguments.most_frames,
            command=_typed(arguments),
            tell=tell,
            so_far=so_far,
        )
    for line in result["not_installed"]:
        say(f"left out: {line}")
    for name in dict.fromkeys(about["name"] for about in result["data"]):
        say(report.title_of(result, name))
        say_table(report.heads(), report.rows_of(result, name))
    if folder is None:
        return result
    files = report.write_benchmark(folder, result)
    say(f"written: {', '.join(files.values())}")
    return {**result, "files": files}


def _typed(arguments: Namespace) -> str:
    """Return the command that repeats this run."""
    words = ["benchmark", *arguments.data]
    for name in ("libraries", "voxel_size", "max_range", "frames", "most_frames", "out"):
        value = getattr(arguments, name)
        words += [] if value is None else [f"--{name.replace('_', '-')}", value]
    for seed in arguments.seed or ():
        words += ["--seed", seed]
    return command_line(*words)


def _named(text: str) -> list[str]:
    return [name.strip() for name in text.split(",") if name.strip()]
