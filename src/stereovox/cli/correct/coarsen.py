# SPDX-License-Identifier: Apache-2.0
"""Make a map of larger cells; each gets the worst state of its parts: occupied, then tentative, unknown, free."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.maps import check_new, open_map, save_new

EXAMPLES = """stereovox coarsen kitchen.svox kitchen10.svox --factor 2
stereovox coarsen kitchen.svox kitchen20.svox --factor 4 --json"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("out", metavar="OUT", help="folder of the new map")
    parser.add_argument("--factor", type=int, metavar="N", required=True, help="cells along each side that become one")


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and save it with larger cells."""
    from stereovox.products.edit import coarsen

    check_new(arguments.out, arguments.map)
    return save_new(coarsen(open_map(arguments.map), arguments.factor), arguments.out)
