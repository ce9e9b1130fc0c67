# SPDX-License-Identifier: Apache-2.0
"""Reproduce the experiments of a paper: one report with its figures next to ours.

All of Chien 2020 is simulated and takes some minutes. --data also maps your own recording under its profile.
Valenti 2018 maps recordings with lidar: --data is a folder with KITTI tracking sequences, or a drive of KITTI raw data.
Thresholds are never chosen and scored on the same drive; a single drive is split into two halves of its street.
IST 2019 drives a simulated robot through two floors and maps them from the bags; --data is your own bag instead.
--audit checks the formulas alone: which claim falls when one of them, or a setting of the profile, is wrong.
A reference map that SLAM's self-check doubts is reported, with exit status 3, and no claim based on it holds.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.terminal import progress_bar, say, say_about_compiling

GROUP = "Prove"
EXAMPLES = """stereovox reproduce chien2020 --out chien2020
stereovox reproduce valenti2018 --audit --out formulas"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("paper", metavar="PAPER", help="chien2020, valenti2018 or ist2019")
    parser.add_argument("--out", required=True, metavar="DIR", help="folder for report.html and numbers.json")
    parser.add_argument(
        "--data", metavar="SOURCE", help="valenti2018: folder of recordings; others: your own recording"
    )
    parser.add_argument(
        "--camera", metavar="NAME", help="chien2020: simulated camera: simple (default), or honest: d435, kinect"
    )
    parser.add_argument("--quick", action="store_true", help="few frames: a trial run, not figures to quote")
    parser.add_argument(
        "--audit", action="store_true", help="only the formulas: what falls under each of many faults (1 to 3 minutes)"
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Run the experiments and print which claims hold."""
    from stereovox_lab.papers import reproduce

    say_about_compiling()
    with progress_bar() as bar:
        task = bar.add_task("starting", note="")
        result = reproduce(
            arguments.paper,
            arguments.out,
            data=arguments.data,
            quick=arguments.quick,
            camera=arguments.camera,
            audit=arguments.audit,
            progress=lambda done, total, text: bar.update(task, completed=done, total=total, description=text),
        )
    _print_result(result)
    return result


def _print_result(result: dict[str, Any]) -> None:
    failed, unjudged = result["does_not_hold"], result["cannot_be_judged"]
    judged = f"{result['holds']} claims hold, {len(failed)} do not, {len(unjudged)} cannot be judged"
    say(f"{judged}, in {result['seconds']:.0f} s")
    if result["quick"] and failed:
        say("only few frames were used (--quick): a claim that fails here may hold for the whole run")
    for text in failed:
        say(f"does not hold: {text}")
    for text in unjudged:
        say(f"cannot be judged: {text}")
    for doubt in result.get("doubts", ()):
        say(f"warning: the reference map of {doubt['experiment']} may be wrong: {doubt['text']}")
    for name, path in result["files"].items():
        say(f"{name:>8}: {path}")
