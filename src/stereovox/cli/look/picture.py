# SPDX-License-Identifier: Apache-2.0
"""Draw a map: an overview, one layer, the cells along the camera's optical axis, or all cells in 3-D.

A floor map in map_server files (.yaml) is drawn as a plan; --view and its options are for 3-D maps.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from stereovox.cli.maps import dimensions, open_cubes, refuse_options
from stereovox.cli.options import point
from stereovox.cli.terminal import say
from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap

EXAMPLES = """stereovox picture kitchen.svox kitchen.png --view layer --up=-y
stereovox picture kitchen.svox kitchen.png --view space"""

VIEW_OPTIONS = {"overview": (), "layer": ("at", "eye", "toward"), "axis": ("eye", "toward"), "space": ("eye", "toward")}
"""The options that each view uses besides the common ones."""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("map", metavar="MAP", help="folder of a map, or the .yaml of a floor map")
    parser.add_argument(
        "file",
        nargs="?",
        metavar="FILE.png",
        help="picture to write; .pdf and .svg keep letters and lines (default: NAME.png here, unless there is one)",
    )
    parser.add_argument("--view", metavar="NAME", help="overview (default), layer, axis or space")
    parser.add_argument("--at", type=float, metavar="M", help="height of the layer along --up (default: the camera's)")
    parser.add_argument(
        "--up", metavar="AXIS", help="axis that points up: z, -y, x ... (default: from the map's settings)"
    )
    parser.add_argument(
        "--eye", type=point, metavar="X,Y,Z", help="position of the camera (default: that of the last frame)"
    )
    parser.add_argument("--toward", type=point, metavar="X,Y,Z", help="a point on its optical axis; goes with --eye")
    parser.add_argument("--dark", action="store_true", help="a dark page, for dark slides and sites")
    parser.add_argument("--title", metavar="TEXT", help="title instead of the map's name")
    parser.add_argument("--dpi", type=float, metavar="N", help="dots per inch (120; with --width-mm 600)")
    parser.add_argument(
        "--width-mm",
        type=float,
        metavar="W",
        help="one panel for a paper, as wide as its column, with small letters and no title; overview is the top view",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load the map and write its picture."""
    from stereovox.view.figures import checked_ending, darken, save

    arguments.file = arguments.file or _usual_file(arguments.map)
    file = Path(arguments.file)
    checked_ending(file, arguments.dpi)
    heading = _plain(arguments.title or Path(arguments.map).stem)
    drawn = DRAW[dimensions(arguments.map)](arguments, heading)
    if arguments.dark:
        darken(drawn)
    save(drawn, file, arguments.dpi)
    say(f"saved {file}")
    return {"picture": str(file)}


def _usual_file(path: str) -> str:
    """Return the default name of the picture; raises StereovoxError if that would replace a file."""
    from stereovox.descriptions.files import command_line, picture_name

    name = picture_name(path)
    if Path(name).exists():
        raise StereovoxError(f"{name}: already exists; replace it with: {command_line('picture', path, name)}")
    return name


def _draw_cells(arguments: Namespace, heading: str) -> Any:
    """Return the figure of a 3-D map."""
    from stereovox.products.moved import levelled
    from stereovox.view.drawn import checked_up, viewpoint_at
    from stereovox.view.paper import draw_paper
    from stereovox.view.views import draw_view

    arguments.view = arguments.view or "overview"
    _check_options(arguments)
    voxel_map = counted = open_cubes(arguments.map)
    if arguments.up is None and voxel_map.config.up_direction is not None:
        voxel_map = levelled(voxel_map)
        heading = heading if arguments.title else f"{heading}, turned upright"
        say("note: turned upright for the picture, so its axes differ from the map's")
    up = checked_up(arguments.up or voxel_map.config.up)
    viewpoint = viewpoint_at(voxel_map, arguments.eye, arguments.toward, up)
    if arguments.width_mm is None:
        drawn = draw_view(voxel_map, arguments.view, heading, up, arguments.at, viewpoint, counted)
    else:
        drawn = draw_paper(voxel_map, arguments.view, up, arguments.width_mm, arguments.at, viewpoint)
    if arguments.at is not None:
        _note_if_outside(voxel_map, up, arguments.at)
    return drawn


def _draw_grid(arguments: Namespace, heading: str) -> Any:
    """Return the figure of a floor map."""
    from stereovox.cli.maps import check_not_map_image, open_grid
    from stereovox.view.grid import draw_grid

    refuse_options(
        arguments, ("view", "at", "up", "eye", "toward", "width_mm"), f"{arguments.map} is a floor map, always a plan"
    )
    check_not_map_image(arguments.file, arguments.map)
    return draw_grid(open_grid(arguments.map), heading)


DRAW = {2: _draw_grid, 3: _draw_cells}


def _check_options(arguments: Namespace) -> None:
    """Raise StereovoxError for an option that the view does not use."""
    for name in ("at", "eye", "toward") if arguments.view in VIEW_OPTIONS else ():
        if getattr(arguments, name) is not None and name not in VIEW_OPTIONS[arguments.view]:
            users = ", ".join(f"--view {view}" for view, options in VIEW_OPTIONS.items() if name in options)
            raise StereovoxError(f"--{name}: the view '{arguments.view}' does not use it; use it with: {users}")


def _note_if_outside(voxel_map: VoxelMap, up: str, at_m: float) -> None:
    bounds = voxel_map.bounds()
    if bounds is None:
        return
    low, high = sorted(bounds[:, "xyz".index(up[-1])] * (-1 if up.startswith("-") else 1) + 0.0)  # no "-0"
    if not low <= at_m < high:
        say(f"note: --at {at_m:g} is outside the map ({up} = {low:g} to {high:g} m), so all its cells are unknown")


def _plain(text: str) -> str:
    """Return text that matplotlib draws literally, without formulas or undecodable bytes."""
    return text.encode("utf-8", "replace").decode().replace("$", r"\$")
