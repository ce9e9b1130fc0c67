# SPDX-License-Identifier: Apache-2.0
"""Maps of one drive from its depth images, in several variants at once, because reading images costs most."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from stereovox.config import Config, load_config
from stereovox.evaluate.metrics import summarise
from stereovox.frame import Frame, UpdateReport
from stereovox.geometry import se2
from stereovox.localize.track import Track
from stereovox.mapper import GridMapper, Mapper
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.products.projection import project
from stereovox_lab.papers.ist.drives import Recording

REACH = 5.0
"""Metres (III-C)."""
AMCL, ODOMETRY, TRUTH = "amcl", "odometry", "truth"
THEIRS, OURS, MIDDLE, SPACE = "ist2019", "default", "default, middle row", "default, 3-D"
SMALL = {"voxel_size": 0.02, "max_range": REACH}


@dataclass(frozen=True)
class Variant:
    """A variant of the map. poses: their source; space: a 3-D map first, then projected onto the floor."""

    name: str
    file: str
    what: str
    profile: str = "default"
    settings: dict[str, Any] = field(default_factory=dict)
    poses: str = AMCL
    space: bool = False

    @property
    def config(self) -> Config:
        """All settings."""
        return load_config(self.profile, **self.settings)


VARIANTS = (
    Variant(THEIRS, "ist2019", "as the report: middle row, Bresenham, every beam, thickness alpha", "ist2019"),
    Variant(OURS, "default", "all obstacles from 0.1 to 1.8 m over the floor, once a scan", settings=SMALL),
    Variant(MIDDLE, "default_row", "the middle row, once a scan", settings={**SMALL, "scan.method": "rows"}),
    Variant(SPACE, "default_3d", "a 3-D map in cells of 0.05 m, seen from above",
            settings={"voxel_size": 0.05, "max_range": REACH}, space=True),
    Variant("ist2019, odometry", "ist2019_odometry", "without localisation", "ist2019", poses=ODOMETRY),
    Variant("ist2019, true poses", "ist2019_true", "poses without error", "ist2019", poses=TRUTH),
    Variant("default, true poses", "default_row_true", "the middle row, once a scan, poses without error",
            settings={**SMALL, "scan.method": "rows"}, poses=TRUTH),
)  # fmt: skip
"""The first is the report's, the others ours; the last ones show the effect of the poses."""


@dataclass(frozen=True, eq=False)
class Made:
    """A map. figures: frames, refusals and milliseconds, see `summarise`."""

    variant: Variant
    grid: OccupancyGrid
    figures: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Makes:
    """Inputs of the maps: images, the trajectory found, and the map frame's pose in the true world."""

    recording: Recording
    track: Track
    pose_world_map: se2.Pose | None

    def can(self, variant: Variant) -> bool:
        """Return whether the poses that a variant needs are known."""
        return variant.poses != TRUTH or (self.pose_world_map is not None and self.recording.drive is not None)

    def placed(self, frame: Frame, poses: str) -> Frame:
        """Return an image with its pose in the map."""
        if poses == ODOMETRY:
            return frame
        if poses == AMCL:
            return self.track.corrected(frame)
        assert self.recording.drive is not None
        assert self.pose_world_map is not None
        floor = self.recording.drive.floor
        T_map_world = se2.lifted(se2.inverse(self.pose_world_map))
        return replace(frame, T_world_sensor=T_map_world @ floor.truth.at(frame.stamp_ns) @ floor.T_base_camera)


def make(makes: Makes, variants: Sequence[Variant], step: Callable[[], None]) -> list[Made]:
    """Return the maps; step is called after each image."""
    able = [variant for variant in variants if makes.can(variant)]
    mappers = [Mapper(one.config) if one.space else GridMapper(one.config) for one in able]
    reports: list[list[UpdateReport]] = [[] for _ in able]
    for frame in makes.recording.robot.frames:
        for variant, mapper, told in zip(able, mappers, reports, strict=True):
            told.append(mapper.add(makes.placed(frame, variant.poses)))
        step()
    return [
        Made(variant, _grid(mapper, variant), summarise(mapper.map, told))
        for variant, mapper, told in zip(able, mappers, reports, strict=True)
    ]


def _grid(mapper: Mapper | GridMapper, variant: Variant) -> OccupancyGrid:
    if isinstance(mapper, GridMapper):
        return mapper.occupancy()
    return project(mapper.map, variant.config.scan.heights, floor=0.0)
