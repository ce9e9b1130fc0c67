# SPDX-License-Identifier: Apache-2.0
"""The whole chain of IST 2019 on one recording: reference map, localisation in it, maps by the depth camera, scores."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import AlignedGrids, Rectangle
from stereovox.evaluate.grid_scores import GridScores, laid_on, score_laid
from stereovox.evaluate.trajectory import TrajectoryError, trajectory_error
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import localise
from stereovox.localize.slam.pipeline import SlamResult, map_scans
from stereovox.localize.track import Track
from stereovox.mapper import GridMapper
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.sources.robots.robot import Robot
from stereovox_lab.papers.ist.drives import Recording
from stereovox_lab.papers.ist.variants import Made, Makes, Variant, make

CELL = 0.02
"""Metres (II-B); the reference has cells of the same size."""
BAND = (0.1, 1.8)
HEIGHTS = {"lidar": (0.225, 0.225), "band": BAND, "above": BAND}
"""Slices of the building that maps are compared with: the lidar's view, what a robot bumps into, and the same with the
tops and undersides that a 3-D map has inside the rims (`simulate/floors/view.py`)."""
Step = Callable[[], None]


@dataclass(frozen=True, eq=False)
class Reference:
    """The map from the lidar, as read back from its files.

    way_error: of SLAM's trajectory, None without truth. seconds: SLAM's time. files: .yaml written.
    """

    grid: OccupancyGrid
    slam: SlamResult
    way_error: TrajectoryError | None
    seconds: float
    file: Path


@dataclass(frozen=True, eq=False)
class Judged:
    """One map by the depth camera and its scores.

    laid, scores: against the reference; with_door: the same with nothing excluded. of_building: against the simulated
    building itself, by the names of HEIGHTS; empty without truth.
    """

    made: Made
    laid: AlignedGrids
    scores: GridScores
    with_door: GridScores
    of_building: dict[str, GridScores]


@dataclass(frozen=True, eq=False)
class Survey:
    """All results of one recording. of_building: the reference map against the building."""

    recording: Recording
    reference: Reference
    track: Track
    way_error: TrajectoryError | None
    localised_s: float
    judged: dict[str, Judged]
    of_building: GridScores | None
    excluded: list[Rectangle]


def survey(recording: Recording, variants: Sequence[Variant], out: Path, step: Step) -> Survey:
    """Run the chain; step is called after each scan of both passes over the lidar, and after each depth image.

    Raises StereovoxError if the recording lacks scans or depth images.
    """
    _check(recording.robot)
    reference = _reference(recording, out, step)
    start = np.zeros(3) if recording.drive else reference.slam.track.pose_map_base[0]
    began = perf_counter()
    track = localise(reference.grid, recording.robot.scans, load_config("ist2019"), start, progress=lambda *_: step())
    seconds = perf_counter() - began
    makes = Makes(recording, track, _pose_world_map(reference))
    made = make(makes, variants, step)
    excluded = recording.drive.closed_off if recording.drive else []
    judged = {one.variant.name: _judge(one, reference, excluded, recording) for one in made}
    for one in made:
        write_map_server(one.grid, out / f"{recording.name}_{one.variant.file}.yaml")
    truth = recording.robot.truth
    return Survey(
        recording,
        reference,
        track,
        trajectory_error(track, truth) if truth is not None else None,
        seconds,
        judged,
        _of_building(reference.grid, recording, reference, "lidar", first=True),
        excluded,
    )


def _check(robot: Robot) -> None:
    for what, there in (("lidar scans", robot.scans), ("depth images", robot.frames)):
        if not len(there):
            raise StereovoxError(f"{robot.name}: holds no {what}; ist2019 needs a bag with both, and odometry")


def _reference(recording: Recording, out: Path, step: Step) -> Reference:
    """Make the map by SLAM, redraw it in small cells along SLAM's trajectory, write it and read it back (III)."""
    robot, began = recording.first, perf_counter()
    slam = map_scans(robot.scans, load_config("ist2019"), lambda *_: step())
    seconds = perf_counter() - began
    mapper = GridMapper(_lidar_config())
    for scan in robot.scans:
        mapper.add(slam.track.corrected(scan))
    file = out / f"{recording.name}_reference.yaml"
    write_map_server(mapper.occupancy(), file)
    error = trajectory_error(slam.track, robot.truth) if robot.truth is not None else None
    return Reference(read_map_server(file), slam, error, seconds, file)


def _lidar_config() -> Config:
    return load_config("default", voxel_size=CELL, min_range=0.02, max_range=5.6)


def _pose_world_map(reference: Reference) -> se2.Pose | None:
    """Return the pose of the reference's frame in the building, estimated from SLAM's whole trajectory."""
    return None if reference.way_error is None else reference.way_error.motion


def _judge(made: Made, reference: Reference, excluded: list[Rectangle], recording: Recording) -> Judged:
    laid = laid_on(made.grid, reference.grid, excluded, align=False)
    scores = score_laid(laid, made.grid.resolution, aligned=False)
    open_ = score_laid(replace(laid, excluded=np.zeros_like(laid.excluded)), made.grid.resolution, aligned=False)
    found = {name: _of_building(made.grid, recording, reference, name) for name in HEIGHTS}
    return Judged(made, laid, scores, open_, {name: one for name, one in found.items() if one is not None})


def _of_building(
    grid: OccupancyGrid, recording: Recording, reference: Reference, heights: str, first: bool = False
) -> GridScores | None:
    """Return the scores of a map against a slice of the simulated building; None for a user's own recording."""
    pose = _pose_world_map(reference)
    if recording.drive is None or pose is None:
        return None
    floor = recording.drive.first if first else recording.drive.floor
    truth = floor.true_grid(grid.resolution, HEIGHTS[heights], lids=heights == "above")  # in the map's own cells
    laid = laid_on(grid, truth, align=False, start=pose)
    return score_laid(laid, grid.resolution, aligned=False)
