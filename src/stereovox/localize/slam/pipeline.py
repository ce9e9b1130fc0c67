# SPDX-License-Identifier: Apache-2.0
"""Simultaneous localisation and mapping from a 2-D lidar: the role of gmapping in IST 2019, by matching and a pose
graph.

Each scan is registered to the lines of the last keyframes (correlative search as Olson 2009, then point to line).
Submaps are registered to earlier ones by branch and bound (Hess et al. 2016); closures that agree enter a pose graph
(gtsam). At the end all keyframes are matched with all others that saw the same walls.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Sized
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.depth.quality import checked_scan
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Progress, Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import Edge, PoseGraph
from stereovox.integrate.beams import make_beams
from stereovox.localize.slam.front_end import Follower
from stereovox.localize.slam.graph import Keyframe, MapDoubt, doubts_of, in_map, patch_edges, step_edges
from stereovox.localize.slam.loops import LoopFinder
from stereovox.localize.track import Track
from stereovox.maps.grid_map import GridMap
from stereovox.maps.occupancy import OccupancyGrid

MIN_LATE_SCANS = 3
"""Consecutive late scans, in order among themselves, before deciding which stamps are wrong."""
CLOSURE_WEIGHT, PATCH_WEIGHT = 0.02, 0.1
"""Factors on a match's information: its points are not independent, nor is the map exact."""
SCANS_PER_KEYFRAME = 2.25
"""Scans that a keyframe counts as in the map: it represents its neighbours, and one suffices to know a cell."""
MAX_CELLS = 40_000
"""Cells on a side of the finished map."""
MIN_JUMP, MIN_JUMP_TURN = 0.05, 0.01
"""Metres and radians by which a closure must be off for the graph to be solved again online."""


def map_scans(scans: Iterable[Scan], config: Config, progress: Progress | None = None) -> SlamResult:
    """Return the track and the map of scans in time order, whose poses are the odometry's.

    progress: called with scans done, scans in all (0: unknown) and the current activity.
    """
    slam, total = Slam(config), len(scans) if isinstance(scans, Sized) else 0
    for done, scan in enumerate(scans, 1):
        slam.add(scan)
        if progress:
            progress(done, total, "matching scans")
    return slam.finish(progress)


class Slam:
    """SLAM over scans in time order, with the odometry as pose; the map's frame is the odometry's at the first scan.

    refused: refused scans by reason; they change nothing. `not_in_order`: scans not later than the one before, and
    scans whose stamp most later ones prove wrong; the latter are only left out of the track.
    """

    def __init__(self, config: Config):
        self.refused: dict[str, int] = {}
        self._first = ""
        self._config = config
        self._follower = Follower(config.slam)
        self._loops = LoopFinder(config.slam, self._follower.keyframes)
        self._builder = TrackBuilder()
        self._map = KeyframeMap(config)

    def grid(self) -> OccupancyGrid | None:
        """Return the map so far; None before the first keyframe. Later loops may change all of it."""
        return self._map.grid(self.keyframes) if self.keyframes else None

    @property
    def pose(self) -> se2.Pose:
        """The robot's pose at the last scan, (3,) pose_map_base."""
        return self._follower.pose

    @property
    def keyframes(self) -> list[Keyframe]:
        """The scans that the map is built from, with their current poses."""
        return self._follower.keyframes

    def add(self, scan: Scan) -> se2.Pose:
        """Process the next scan; return its current (3,) pose_map_base. Later loops may move it."""
        try:
            scan = checked_scan(scan, self._config)
        except FrameRefused as refused:
            self._refuse(refused.reason)
            self._first = self._first or f", first: {refused}"
            return self.pose
        wrong = self._builder.room(scan.stamp_ns)
        self._refuse("not_in_order", 1 if wrong is None else wrong)
        if wrong is None:
            return self.pose
        is_key = self._follower.add(scan)
        self._builder.add(scan, self.pose, self.keyframes)
        if is_key and any(_off(self.keyframes, edge) for edge in self._loops.update()):
            self._solve(self._loops.edges, CLOSURE_WEIGHT)
        return self.pose

    def finish(self, progress: Progress | None = None) -> SlamResult:
        """Return the track and the map, after a last search for loops and a last refinement.

        Raises StereovoxError if no scan could be used, MissingExtra if loops were found and gtsam is missing.
        """
        if not self.keyframes:
            counted = ", ".join(f"{number} x {reason}" for reason, number in self.refused.items())
            raise StereovoxError(
                f"not one of the scans could be used: {counted or 'none has enough hits'}{self._first}"
            )
        self._loops.update(end=True)
        self._solve(self._loops.edges, CLOSURE_WEIGHT)
        rounds = self._config.slam.refine_rounds if self._loops.edges else 0
        for done in range(rounds):
            if progress:
                progress(done, rounds, "polishing the map")
            self._solve(list(patch_edges(self.keyframes, self._config.slam)), PATCH_WEIGHT)
        track = self._builder.track(self.keyframes)
        doubts = doubts_of(self.keyframes, self._loops.edges)
        return SlamResult(
            track, self._map.grid(self.keyframes), self.keyframes, self._loops.edges, self.refused, doubts
        )

    def _refuse(self, reason: str, count: int = 1) -> None:
        if count:
            self.refused[reason] = self.refused.get(reason, 0) + count

    def _solve(self, edges: list[Edge], weight: float) -> None:
        if not edges:
            return
        last = self.keyframes[-1].pose
        weighted = [replace(edge, information=weight * edge.information) for edge in edges]
        graph = PoseGraph(self._poses(), step_edges(self.keyframes), weighted)
        for keyframe, pose in zip(self.keyframes, graph.poses, strict=True):
            keyframe.pose = pose
        self._follower.moved(last)

    def _poses(self) -> NDArray[np.float64]:
        return np.array([keyframe.pose for keyframe in self.keyframes])


class KeyframeMap:
    """The floor map of keyframes. New ones are added to it; it is rebuilt once earlier ones have moved."""

    def __init__(self, config: Config):
        self._settings = config.slam
        evidence = {f"grid.{name}": _repeated(getattr(config.grid, name)) for name in ("p_occupied", "p_free")}
        size, reach = self._settings.voxel_size, self._settings.max_range
        self._config = load_config(config, voxel_size=size, max_range=reach, **evidence)
        self._beams = make_beams(self._config)
        self._map, self._drawn = GridMap(self._config), np.empty((0, 3))

    def grid(self, keyframes: list[Keyframe]) -> OccupancyGrid:
        """Return the map of all keyframes at their current poses. Raises StereovoxError if it is too wide."""
        poses, drawn = np.array([keyframe.pose for keyframe in keyframes]), len(self._drawn)
        _check_extent(poses, self._settings.voxel_size)
        if not np.array_equal(poses[:drawn], self._drawn):
            self._map, drawn = GridMap(self._config), 0
        for scan in map(in_map, keyframes[drawn:]):
            if not self._settings.clear_far:
                scan = replace(scan, ranges=np.where(np.isposinf(scan.ranges), np.float32(np.nan), scan.ranges))
            self._map.add(self._beams.evidence(scan, self._map.origin))
        self._drawn = poses
        return self._map.occupancy()


@dataclass(frozen=True, eq=False)
class SlamResult:
    """A robot's track and its map.

    track: the pose of every scan that was not refused. grid: the map, built from the keyframes. keyframes: with their
    final poses. closures: number of loops closed. edges: these loops, between keyframes. refused: refused scans by
    reason.
    doubts: objections of the scans to the map; empty if the self-check found nothing.
    """

    track: Track
    grid: OccupancyGrid
    keyframes: list[Keyframe]
    edges: list[Edge]
    refused: dict[str, int]
    doubts: list[MapDoubt]

    @property
    def closures(self) -> int:
        """Number of pairs of submaps found to show one place."""
        return len(self.edges)


@dataclass(frozen=True, eq=False)
class Step:
    """A scan: the robot's pose by odometry (3,), and its pose (3,) relative to keyframe `keyframe`."""

    stamp_ns: int
    odometry: se2.Pose
    keyframe: int
    since: se2.Pose


class TrackBuilder:
    """The steps so far, with ascending stamps."""

    def __init__(self) -> None:
        self._steps: list[Step] = []
        self._started = False
        self._late, self._late_ns, self._against = 0, 0, 0

    def room(self, stamp_ns: int) -> int | None:
        """Make room for a scan at `stamp_ns`; return how many earlier ones were dropped, None if it is itself too
        late.

        A single stamp in the future would make all later scans late. So if more consecutive scans are late than there
        were steps after the first of them, those steps have the wrong stamps and are dropped.
        """
        ahead = len(self._steps) - bisect_left(self._steps, stamp_ns, key=lambda step: step.stamp_ns)
        if not ahead:
            self._late = 0
            return 0
        if not self._late or stamp_ns <= self._late_ns:
            self._late, self._against = 0, ahead
        self._late, self._late_ns = self._late + 1, stamp_ns
        if self._late <= max(self._against, MIN_LATE_SCANS):
            return None
        del self._steps[-ahead:]
        self._late = 0
        return ahead

    def add(self, scan: Scan, pose: se2.Pose, keyframes: list[Keyframe]) -> None:
        """Append a scan accepted by `room`, and the pose (3,) of the robot.

        Steps before the first keyframe are stored relative to it.
        """
        if keyframes and not self._started:
            self._started = True
            self._steps = [replace(s, since=se2.relative(keyframes[0].pose, s.since)) for s in self._steps]
        since = se2.relative(keyframes[-1].pose, pose) if keyframes else pose
        self._steps.append(Step(scan.stamp_ns, scan.pose_world_base, max(len(keyframes) - 1, 0), since))

    def track(self, keyframes: list[Keyframe]) -> Track:
        """Return the track, with the keyframes at their current poses."""
        anchors = np.array([keyframes[step.keyframe].pose for step in self._steps])
        poses = se2.compose(anchors, np.array([step.since for step in self._steps]))
        corrections = se2.compose(poses, se2.inverse(np.array([step.odometry for step in self._steps])))
        return Track(np.array([step.stamp_ns for step in self._steps], np.int64), poses, corrections)


def _repeated(p: float) -> float:
    """Return the probability a keyframe gives a cell for which one scan gives `p`."""
    odds = (p / (1 - p)) ** SCANS_PER_KEYFRAME
    return odds / (1 + odds)


def _check_extent(poses: se2.Pose, cell: float) -> None:
    span = float(np.ptp(poses[:, :2], axis=0).max())
    if span > MAX_CELLS * cell:
        raise StereovoxError(
            f"the robot's trajectory spans {span:.0f} m, more than {MAX_CELLS} cells of {cell:g} m; does its odometry "
            "jump? Else set slam.voxel_size larger"
        )


def _off(keyframes: list[Keyframe], edge: Edge) -> bool:
    left = se2.relative(edge.motion, se2.relative(keyframes[edge.first].pose, keyframes[edge.second].pose))
    return bool(np.hypot(left[0], left[1]) > MIN_JUMP or abs(left[2]) > MIN_JUMP_TURN)
