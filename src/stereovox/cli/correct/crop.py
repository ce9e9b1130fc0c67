# SPDX-License-Identifier: Apache-2.0
"""Crop a map to a box: the new map holds the cells whose centre is inside."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from typing import Any

from stereovox.cli.maps import check_new, open_map, save_new
from stereovox.cli.options import CORNERS, numbers_of
from stereovox.errors import StereovoxError

EXAMPLES = """stereovox crop kitchen.svox table.svox --box=-1,-1,0,1,1,2
stereovox crop kitchen.svox floor.svox --box=-5,-5,-0.2,5,5,0.2"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map")
    parser.add_argument("out", metavar="OUT", help="folder of the new map")
    parser.add_argument(
        "--box",
        metavar=CORNERS,
        required=True,
        help="lowest and highest corner in metres; inf and -inf for no limit. Write --box=... if it begins with -",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and save the cropped one."""
    from stereovox.products.edit import crop

    box = numbers_of("--box", arguments.box, CORNERS)
    check_new(arguments.out, arguments.map)
    whole = open_map(arguments.map)
    part = crop(whole, box[:3], box[3:])
    bounds = whole.bounds()
    if part.bounds() is None and bounds is not None:
        low, high = bounds.round(3).tolist()
        raise StereovoxError(f"--box {arguments.box}: holds no known cell; the map extends from {low} to {high} m")
    return save_new(part, arguments.out)
