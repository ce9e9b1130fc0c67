# SPDX-License-Identifier: Apache-2.0
"""Map many recordings with lidars one by one, score each map against its own truth, and print a table.

RECORDING is a KITTI recording with lidar, a pattern ('training/image_02/*'), a list (@drives.txt) or an s3:// prefix.
The table is Valenti 2018, Table 8.1, for any number of recordings and profiles. Finished scores are kept: --resume adds
the missing ones.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from typing import Any

from stereovox.cli.options import add_settings, add_usual, overrides
from stereovox.cli.terminal import progress_of_steps, say, say_about_compiling, say_table, thousands

EXAMPLES = """stereovox score 'training/image_02/*' --profile default --profile valenti2018 --out scores
stereovox score drives/* --voxel-size 0.2 --out scores --json"""
SHOWN = ("recording", "profile", "frames", "refused", "accuracy", "precision", "recall", "specificity", "npv", "error",
         "correlation")  # fmt: skip


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "recordings", metavar="RECORDING", nargs="+", help="recordings, patterns, @lists, s3:// prefixes"
    )
    parser.add_argument(
        "--out", metavar="DIR", required=True, help="folder or s3:// URL for scores.csv and scores.json"
    )
    about = "profile name or TOML file; repeatable, to compare profiles (default, with suggested cells and range)"
    parser.add_argument("--profile", action="append", metavar="P", help=about)
    add_usual(parser, "voxel-size", "max-range")
    parser.add_argument("--frames", metavar="A:B:S", help="only these frames of each recording, as a Python slice")
    parser.add_argument(
        "--free",
        choices=("view", "rays"),
        default="view",
        help="free cells of the truth: all others in view of a frame (view), or only those that a lidar ray "
        "crosses (rays)",
    )
    parser.add_argument(
        "--threshold", type=float, metavar="P", help="a cell is called occupied above it (default: the map's own)"
    )
    parser.add_argument("--tolerance", type=int, default=1, metavar="CELLS", help="distance that counts as a match (1)")
    parser.add_argument("--workers", type=int, metavar="N", help="processes on this machine (one per core)")
    parser.add_argument("--scheduler", metavar="URL", help="Dask scheduler (tcp://host:8786) instead of these")
    parser.add_argument("--resume", action="store_true", help="continue the scores at --out")
    add_settings(parser, "sensor.model=andert")


def run(arguments: Namespace) -> dict[str, Any]:
    """Score the recordings and print the table."""
    from stereovox.fleet import ScoreOptions, score_fleet

    options = ScoreOptions(arguments.free, arguments.frames, arguments.threshold, arguments.tolerance)
    say_about_compiling()
    with progress_of_steps("recordings") as progress:
        scores = score_fleet(
            arguments.recordings, arguments.out, arguments.profile, options=options, notify=say,
            resume=arguments.resume, workers=arguments.workers, scheduler=arguments.scheduler, progress=progress,
            **overrides(arguments),
        )  # fmt: skip
    for one in scores.scored:
        if one.error:
            say(f"skipped: {one.recording}: {one.error}")
    table = scores.table()
    names = _short([row["recording"] for row in table])
    say_table(SHOWN, [[_cell({**row, "recording": names[row["recording"]]}[name]) for name in SHOWN] for row in table])
    say(f"saved in {arguments.out}: scores.csv (this table, with counts of cells), scores.json (all measures)")
    return scores.summary()


def _short(recordings: Sequence[str]) -> dict[str, str]:
    """Return a name for each recording that fits into a table: its last part, if these differ."""
    lasts = {one: one.rstrip("/").rpartition("/")[2] for one in recordings}
    return lasts if len(set(lasts.values())) == len(lasts) else {one: one for one in recordings}


def _cell(value: str | float | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3f}"
    return value if isinstance(value, str) else thousands(value)
