# SPDX-License-Identifier: Apache-2.0
"""The properties of a map besides its cells, and how each output handles them: every output must have an answer.

`OUTPUTS` is the table. Each cell begins with an action: `uses` the property, `refuses` if it is bad, `carries along`
data that states it, or `not meaningful, because` of a reason. A test checks a bad case for each cell that uses or
refuses, and fails for an output that is missing in the table.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np

from stereovox.config import Config
from stereovox.maps.record.health import UNFIT, Health
from stereovox.products.floor_axes import up_of
from stereovox.products.floor_heights import FloorHeights


class HasMap(Protocol):
    """A mapper, or anything with settings that reports how old its map is."""

    config: Config

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is."""
        ...


@dataclass(frozen=True)
class MapContext:
    """What a user of a map must know besides its cells.

    Attributes:
        world: Name of the frame of the coordinates.
        up: Unit vector (3,) that points up in it.
        tilt_deg: Degrees between `up` and the nearest axis of the map, to which layers and columns are aligned.
        floor: Height of the floor at each place, or unknown; None: it was not searched for.
        stamp_ns: Time of the last event that the map shows, by the clock of its stamps; None: unknown.
        age_s: Seconds since that event; None: unknown, as for a loaded map.
        health: Of the mapper; None without one.
        unknown: What an unknown cell means for the output.
    """

    world: str
    up: tuple[float, float, float]
    tilt_deg: float
    floor: FloorHeights | None = None
    stamp_ns: int | None = None
    age_s: float | None = None
    health: Health | None = None
    unknown: str = "unknown cells are not free"

    @property
    def stale(self) -> str:
        """Why the map is too old to act on, or waiting for frames; "" if it is not, or is no live map."""
        return self.health.text if self.health is not None and self.health.state in UNFIT else ""


def context_of(mapper: HasMap, world: str = "map") -> MapContext:
    """Return the context of a growing map; its floor is not searched.

    Args:
        mapper: Its mapper.
        world: Name of its frame.
    """
    config, health = mapper.config, mapper.health()
    up = tuple(map(float, up_of(config)))
    return MapContext(
        world, (up[0], up[1], up[2]), float(np.degrees(config.tilt)), None, health.stamp_ns, health.age_s, health
    )


NO_MEANING = "not meaningful, because "


class Leaves(NamedTuple):
    """What an output does with each property of a map."""

    frame: str
    up: str
    floor: str
    age: str
    health: str
    unknown: str


def nothing(why: str, age: str = "", health: str = "") -> Leaves:
    """Return a row in which no property has a meaning, except age and health if given."""
    none = f"{NO_MEANING}{why}"
    return Leaves(none, none, none, age or none, health or none, none)


WORLD = "carries along: coordinates in the map's world"
SPACE = "not meaningful, because coordinates in space need no direction up"
NO_FLOOR = "not meaningful, because no height is measured from a floor"
OFFLINE = "not meaningful, because a map alone does not know the present time; Mapper.health does"
JUDGED = "not meaningful, because a map alone has no mapper; whoever made it asks Mapper.health"
MAP = "carries along: the map's own stamps and history"
ALL_CELLS = "carries along: unknown cells stay unknown"
SOLID = "carries along: only what is surely occupied; what is missing says nothing"
LEVEL = "refuses: a map whose layers are not level"
FLOOR_2D = "carries along: heights are measured as `projection.project` documents"
SILENT = "refuses: silent while the map is waiting, stale or lost"
EVENT = "carries along: the stamp of the newest frame"
OLD = "refuses: silent once what was seen is too old, by its stamp"
SOLIDS = Leaves(WORLD, SPACE, NO_FLOOR, OFFLINE, JUDGED, SOLID)
WHOLE = Leaves(WORLD, "carries along: the setting `up`", NO_FLOOR, MAP, MAP, ALL_CELLS)
GRID = Leaves("carries along: origin and axes of the grid", LEVEL, FLOOR_2D, OFFLINE, JUDGED, "uses: -1, never free")
POSE = Leaves(
    "carries along: frame names in the header", SPACE, NO_FLOOR, OLD,
    "not meaningful, because a pose is no statement of the map", "not meaningful, because a pose has no cells",
)  # fmt: skip

OUTPUTS: dict[str, Leaves] = {
    "sv.obstacle_sectors": Leaves(
        "uses: distances from the given pose of the body", LEVEL, NO_FLOOR, OFFLINE, JUDGED, "uses: ends what is free"
    ),
    "sv.ObstacleSender": Leaves(
        "uses: distances from the body's newest pose", LEVEL, NO_FLOOR, OLD, OLD, "uses: ends what is free"
    ),
    "sv.PoseSender": POSE._replace(frame="carries along: MAV_FRAME_LOCAL_FRD and MAV_FRAME_BODY_FRD"),
    "sv.check_path": Leaves(WORLD, SPACE, NO_FLOOR, MAP, JUDGED, "refuses: blocks the path"),
    "sv.frontiers": Leaves(WORLD, "carries along: the setting `up`", FLOOR_2D, OFFLINE, JUDGED, "uses: it is the goal"),
    "sv.LevelPlanner": Leaves(WORLD, "carries along: layers of the map", NO_FLOOR, OFFLINE, JUDGED, "refuses: no path"),
    "sv.Waypoints": Leaves(WORLD, "carries along: layers of the map", NO_FLOOR, OFFLINE, JUDGED, "refuses: no path"),
    "sv.DistanceField": Leaves(WORLD, SPACE, NO_FLOOR, OFFLINE, JUDGED, "carries along: as its argument says"),
    "sv.ground": Leaves(WORLD, LEVEL, "uses: it is what is found", OFFLINE, JUDGED, "carries along: UNKNOWN footing"),
    "sv.coarsen": WHOLE,
    "sv.crop": WHOLE,
    "sv.difference": Leaves(WORLD, SPACE, NO_FLOOR, OFFLINE, JUDGED, "carries along: cells known in both alone"),
    "sv.surface": SOLIDS,
    "sv.export": Leaves(
        WORLD, "carries along: as its format, below", NO_FLOOR, OFFLINE, JUDGED, "carries along: below"
    ),
    "sv.describe": WHOLE,
    "sv.write_nav2": nothing("it writes settings alone"),
    "sv.loops_picture": nothing("it draws poses alone"),
    "sv.trajectory_picture": nothing("it draws poses alone"),
    "sv.open_viewer": Leaves(WORLD, "carries along: up of the page", NO_FLOOR, OFFLINE, JUDGED, SOLID),
    "sv.LiveView": Leaves(
        WORLD, "carries along: up of the page", NO_FLOOR, EVENT, "uses: said, also in silence", SOLID
    ),
    "live.GridFile": GRID._replace(age="carries along: as health", health=SILENT),
    "live.LiveSphere": Leaves(
        "uses: seen from the body's newest pose",
        "carries along: axes of the body",
        NO_FLOOR,
        "carries along: a stamp for each cell",
        SILENT,
        "carries along: cells without a range",
    ),
    **dict.fromkeys(("format .bt", "format .ot"), WHOLE._replace(age=OFFLINE, health=JUDGED)),
    **dict.fromkeys([f"format .{name}" for name in ("ply", "pcd", "npz", "glb", "obj", "stl", "rrd")], SOLIDS),
    **dict.fromkeys([f"format .{name}" for name in ("bag", "mcap", "db3")], GRID),
    **dict.fromkeys([f"format .{name}" for name in ("pgm", "png", "yaml")], GRID),
    "topic map_mapping": GRID._replace(age=EVENT, health=SILENT),
    "topic occupied_cells": SOLIDS._replace(age=EVENT, health=SILENT),
    **dict.fromkeys(("topic octomap_binary", "topic octomap_full"), WHOLE._replace(age=EVENT, health=SILENT)),
    **dict.fromkeys(
        ("topic obstacles", "topic free_rays"),
        GRID._replace(age=OLD, health=OLD, unknown="uses: marks nothing, and ends what is free"),
    ),
    "topic /diagnostics": nothing("it has no cells and coordinates", "uses: as a value", "uses: its level"),
    **dict.fromkeys(("topic tracked_odometry", "topic /tf", "topic amcl_pose", "topic particlecloud"), POSE),
    "topic map_error": nothing("it compares two maps of one frame"),
    "topic map": nothing("it is the map that was given, or SLAM's own"),
}
"""How each output handles each property: names of `stereovox` (`sv.`), outputs of live runs, formats, ROS topics."""


def table() -> list[str]:
    """Return `OUTPUTS` as lines of Markdown; equal outputs share a line, and reasons are notes below."""
    alike: dict[Leaves, list[str]] = {}
    notes: list[str] = []
    for name, leaves in OUTPUTS.items():
        alike.setdefault(leaves, []).append(f"`{name}`")
    lines = [f"| output | {' | '.join(Leaves._fields)} |", "|" + "---|" * (len(Leaves._fields) + 1)]
    for leaves, names in alike.items():
        lines.append(f"| {', '.join(names)} | {' | '.join(_shown(cell, notes) for cell in leaves)} |")
    return [*lines, "", *(f"{number}. {note}" for number, note in enumerate(notes, 1))]


def _shown(cell: str, notes: list[str]) -> str:
    """Return a cell, or the number of its note."""
    _, because, why = cell.partition(NO_MEANING)
    if not because:
        return cell
    if why not in notes:
        notes.append(why)
    return f"- ({notes.index(why) + 1})"
