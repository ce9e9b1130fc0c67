# SPDX-License-Identifier: Apache-2.0
"""The two floors of IST 2019 in simulation: the drives, and their bags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stereovox.evaluate.grid_align import Rectangle
from stereovox.geometry import se2
from stereovox.opening import open_robot
from stereovox.simulate.floors.floor import TRUTH, Floor, write_bag
from stereovox.sources.robots.robot import Robot


@dataclass(frozen=True)
class Place:
    """A floor of the report, with the report's figures.

    drive: parameters of `sim:floor` for the drive whose depth images are mapped; first: of an earlier drive, with
    the lidar alone, for the reference map (empty: the same drive).
    figures: of the report: reference, map, difference. error_percent: its Eq 7; update_s: its time of an update.
    """

    name: str
    title: str
    drive: str
    first: str
    figures: tuple[str, str, str]
    error_percent: float
    update_s: float


PLACES = (
    Place(
        "corridors",
        "Corridors, after the 5th floor",
        "plan=corridors&shut=1&seed=2",
        "plan=corridors&seed=1&depth_hz=0",
        ("Fig 4", "Fig 5", "Fig 6"),
        26.2,
        0.210,
    ),
    Place(
        "testbed",
        "A hall, after the 8th floor testbed",
        "plan=testbed&seed=3",
        "",
        ("Fig 7", "Fig 8", "Fig 9"),
        30.42,
        0.320,
    ),
)


@dataclass(frozen=True)
class Extent:
    """Extent of each drive's recording: parameters of `sim:floor` for the mapped drive and for the first one."""

    drive: str = "depth_hz=2.5"
    first: str = ""


@dataclass(frozen=True, eq=False)
class Drive:
    """A drive to be recorded. first: the earlier one; the same if there is none."""

    place: Place
    floor: Floor
    first: Floor

    @classmethod
    def through(cls, place: Place, extent: Extent) -> Drive:
        """Return the drive through a place."""
        floor = Floor(f"sim:floor?{place.drive}&{extent.drive}")
        return cls(place, floor, Floor(f"sim:floor?{place.first}&{extent.first}") if place.first else floor)

    @property
    def floors(self) -> list[Floor]:
        """The one or two recordings."""
        return [self.floor] if self.first is self.floor else [self.floor, self.first]

    @property
    def closed_off(self) -> list[Rectangle]:
        """Regions behind a door that was shut later, in the frame of the first drive's start, where its map begins."""
        if not self.floor.options.shut or self.floor.behind_door is None:
            return []
        x0, y0, x1, y1 = self.floor.behind_door
        corners = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)])
        seen = se2.transform(se2.inverse(self.first.start), corners)
        (a, b), (c, d) = seen.min(axis=0).tolist(), seen.max(axis=0).tolist()
        return [(a, b, c, d)]


@dataclass(frozen=True, eq=False)
class Recording:
    """The recording to be mapped (robot), and the one for the reference map (first; may be the same).

    drive: the simulation it was recorded from, for truth; None for a user's own. megabytes: of all bags.
    """

    name: str
    robot: Robot
    first: Robot
    drive: Drive | None = None
    megabytes: float = 0.0


def messages(drive: Drive) -> int:
    """Return the number of steps of `record`."""
    return sum(len(floor.odometry) + len(floor.scans) + len(floor.frames) for floor in drive.floors)


def record(drive: Drive, folder: Path, step: Callable[[], None] = lambda: None) -> Recording:
    """Write the bags into `folder` and open them. step: called after each scan, image and pose of the odometry."""
    bags = [folder / f"{drive.place.name}_{n}.bag" for n in range(len(drive.floors))]
    for floor, bag in zip(drive.floors, bags, strict=True):
        write_bag(floor, bag, lambda done, total: step())
    robots = [open_robot(f"{bag}?truth={TRUTH}") for bag in bags]
    return Recording(drive.place.name, robots[0], robots[-1], drive, sum(bag.stat().st_size for bag in bags) / 1e6)
