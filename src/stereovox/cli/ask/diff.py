# SPDX-License-Identifier: Apache-2.0
"""Show what changed from one map to another: which cells appeared, vanished or became known."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.correct.merge import add_transform
from stereovox.cli.maps import open_map
from stereovox.cli.options import check_ending, transform_of
from stereovox.cli.terminal import say, thousands

if TYPE_CHECKING:
    from stereovox.products.difference import Difference

EXAMPLES = """stereovox diff monday.svox tuesday.svox --picture changes.png
stereovox diff monday.svox tuesday.svox --json"""

KINDS = {
    "appeared": "appeared: free in A, occupied in B",
    "vanished": "vanished: occupied in A, free in B",
    "became_known": "became known: seen in B, unknown in A",
    "became_unknown": "became unknown: seen in A, unknown in B",
}


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("a", metavar="A", help="folder of the earlier map")
    parser.add_argument("b", metavar="B", help="folder of the later map, with cells of the same size")
    parser.add_argument("--out", metavar="FILE.npz", help="file for the cells of each kind")
    parser.add_argument("--picture", metavar="FILE.png", help="picture of the changes, from above")
    add_transform(parser)


def run(arguments: Namespace) -> dict[str, Any]:
    """Compare the maps and print the number of changed cells."""
    from stereovox.maps import State
    from stereovox.products.difference import difference, write_difference
    from stereovox.products.moved import moved

    check_ending("--out", arguments.out, ".npz")
    check_ending("--picture", arguments.picture, ".png")
    T_a_b = None if arguments.transform is None else transform_of(arguments.transform)
    a, b = open_map(arguments.a), open_map(arguments.b)
    if T_a_b is not None:
        b = moved(b, T_a_b)
    changes = difference(a, b)
    result: dict[str, Any] = {kind: _print_count(changes, kind) for kind in KINDS}
    names = [state.name.lower() for state in State]
    result["counts"] = {
        name: dict(zip(names, row, strict=True)) for name, row in zip(names, changes.counts.tolist(), strict=True)
    }
    if arguments.out:
        write_difference(changes, a.config.cell, arguments.out)
        say(f"saved {arguments.out}")
    if arguments.picture:
        from stereovox.view.above import draw_changes
        from stereovox.view.figures import save

        save(draw_changes(a, b, f"{Path(arguments.a).stem} to {Path(arguments.b).stem}"), arguments.picture)
        say(f"saved {arguments.picture}")
    return result


def _print_count(changes: Difference, kind: str) -> int:
    number = len(getattr(changes, kind))
    say(f"{thousands(number):>12} cells {KINDS[kind]}")
    return number
