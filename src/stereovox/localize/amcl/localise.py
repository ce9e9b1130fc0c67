# SPDX-License-Identifier: Apache-2.0
"""Adaptive Monte Carlo localisation: the pose of a robot in a known map (Fox 2003; Thrun, Burgard and Fox 2005, ch. 8).

Our own implementation, because nav2's AMCL is a ROS 2 node, not a library.
"""

from __future__ import annotations

from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.config import Config
from stereovox.depth.quality import check_scan
from stereovox.errors import ConfigError, FrameRefused, MapFileError, SourceError
from stereovox.frame import Scan, name_of
from stereovox.frame.validate import validate_scan
from stereovox.geometry import se2
from stereovox.localize.amcl.particles import MODELS, Clusters, Recovery, draw, mean_pose, moved, spread, turn_go_turn
from stereovox.localize.track import Beams, Track, beams_of
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.maps.voxel_map import State

LATE = 3
"""Consecutive late scans, in order among themselves, before deciding which stamps are wrong."""
MAX_AT_START = 1_000_000
"""Initial particles if the robot may be anywhere."""
SETTLED_SHARE, SETTLED_M = 0.95, 0.3
"""The robot is localised once this share of the weight is in one cluster of this standard deviation in metres."""


def localise(
    grid: OccupancyGrid,
    scans: Iterable[Scan],
    config: Config,
    start: ArrayLike | None = None,
    seed: int = 0,
    progress: Callable[[int], object] | None = None,
) -> Track:
    """Return a robot's track through a map; untrusted scans are left out and counted in `Track.refused`.

    start, seed: as in `Localiser`; progress: called with the number of scans done. While the particles disagree, the
    track follows the odometry, with the drift interpolated between the certain poses before and after; before the first
    certain pose it has that one's drift. Scans that later ones show to have a wrong stamp (`Clock`) are removed from
    the track and counted too. Raises what `Localiser` raises, and SourceError if no scan can be trusted.
    """
    localiser, way, first_refusal = Localiser(grid, config, start, seed), _TrackBuilder(), ""
    for done, scan in enumerate(scans, 1):
        try:
            way.add(scan.stamp_ns, localiser.add(scan))
        except FrameRefused as refusal:
            first_refusal = first_refusal or str(refusal)
        if progress:
            progress(done)
    if not way.stamps_ns:
        said = f"every one was refused, the first: {first_refusal}" if first_refusal else "there are none"
        raise SourceError(f"no scan to localise by: {said}")
    return way.track(dict(localiser.refused), first_refusal)


class Localiser:
    """Tracks a robot through a map by its scans and odometry.

    start: (3,) x, y, yaw of the robot at the first scan, accurate to `amcl.start_std`; None: anywhere. seed: of all
    random numbers; the same scans then give the same estimates. refused: refused scans by reason; `not_in_order`
    includes those that later scans show to be wrong. Raises MapFileError for a map without free or occupied cells,
    ConfigError for an invalid start.
    """

    def __init__(self, grid: OccupancyGrid, config: Config, start: ArrayLike | None = None, seed: int = 0):
        self.config, self._checks = config.amcl, config
        self.refused: Counter[str] = Counter()
        self._clock = Clock()
        self._rng = np.random.default_rng(seed)
        self._floor = FreeFloor(grid)
        self._sensor = MODELS[self.config.model](grid, self.config)
        self._recovery = Recovery(self.config)
        self._particles = self._first(None if start is None else checked_start(start))
        self._weights = np.full(len(self._particles), 1 / len(self._particles))
        self._pose_odom_base: se2.Pose | None = None
        self._updates = 0
        self._pose_map_odom, self._covariance, self._settled = np.zeros(3), np.zeros((3, 3)), False

    def add(self, scan: Scan) -> Estimate:
        """Estimate the robot's pose after one more scan.

        Raises FrameRefused, and changes only the counts, if the scan cannot be trusted (`validate_scan`,
        `check_scan`, `beams_of`) or is not later than the one before (`Clock`).
        """
        start = perf_counter()
        try:
            scan = validate_scan(scan, self._checks.pose_rigidity_tolerance)
            check_scan(scan, self._checks)
            beams = beams_of(scan, self.config.max_range)
            wrong = self._clock.accept(scan)
        except FrameRefused as refusal:
            self.refused[refusal.reason] += 1
            raise
        if wrong:
            self.refused["not_in_order"] += wrong
        pose_odom_base = scan.pose_world_base
        if due := self._far_enough(pose_odom_base):
            self._update(pose_odom_base, beams)
        pose = se2.compose(self._pose_map_odom, pose_odom_base)
        ms = 1e3 * (perf_counter() - start)
        return Estimate(pose, self._covariance, self._pose_map_odom, self._particles, due, self._settled, ms)

    def _first(self, start: se2.Pose | None) -> se2.Pose:
        most = self.config.particles_max
        if start is None:
            return self._floor.anywhere(max(min(most * self.config.candidates, MAX_AT_START), most), self._rng)
        return near(start, self.config.start_std, most, self._rng)

    def _far_enough(self, pose_odom_base: se2.Pose) -> bool:
        if self._pose_odom_base is None:
            return True
        step = se2.relative(self._pose_odom_base, pose_odom_base)
        return bool(np.hypot(*step[:2]) >= self.config.update_min_d or abs(step[2]) >= self.config.update_min_a)

    def _update(self, pose_odom_base: se2.Pose, beams: Beams) -> None:
        if self._pose_odom_base is not None:
            motion = turn_go_turn(self._pose_odom_base, pose_odom_base)
            self._particles = moved(self._particles, motion, self.config, self._rng)
        self._pose_odom_base = pose_odom_base
        self._updates += 1
        chosen = beams.some(self.config.max_beams, self._sensor.hits_only)
        self._weigh(chosen)
        clusters = Clusters(self._particles, self.config)
        self._estimate(clusters, pose_odom_base)
        if self._updates % self.config.resample_interval == 0 or len(self._particles) > self.config.particles_max:
            self._resample(clusters, chosen)

    def _weigh(self, beams: Beams) -> None:
        if not len(beams.ranges):
            return
        log_likelihood = self._sensor.log_likelihood(self._particles, beams).astype(float)
        self._recovery.observe(
            log_likelihood, self._weights, len(beams.ranges)
        )  # all: skipping would hide that it is lost
        fitting = self._fitting(beams)
        if fitting is not beams:
            log_likelihood = self._sensor.log_likelihood(self._particles, fitting).astype(float)
        self._weights = _times(self._weights, log_likelihood * self.config.trust)

    def _fitting(self, beams: Beams) -> Beams:
        """Return the beams that fit for enough particles, or all of them (`amcl.beam_skip`)."""
        if not (self.config.beam_skip and self._settled):
            return beams
        lost = self._sensor.agreeing(self._particles, beams) < self.config.beam_skip_share
        return beams.only(~lost) if 0 < lost.mean() <= self.config.beam_skip_most else beams

    def _estimate(self, clusters: Clusters, pose_odom_base: se2.Pose) -> None:
        inside, share = clusters.heaviest(self._weights)
        particles, weights = self._particles[inside], self._weights[inside]
        pose = mean_pose(particles, weights)
        wide = np.sqrt(np.trace(spread(particles, weights, pose)[:2, :2]))
        self._settled = bool(share >= SETTLED_SHARE and wide <= SETTLED_M)
        self._covariance = spread(self._particles, self._weights, pose)
        self._pose_map_odom = se2.compose(pose, se2.inverse(pose_odom_base))

    def _resample(self, clusters: Clusters, beams: Beams) -> None:
        share, bins = self._recovery.strangers, clusters.bins
        strangers, likely = np.empty((0, 3)), None
        if share > 0:
            strangers, likely = self._strangers(share, beams)
            bins = Clusters(np.concatenate([self._particles, strangers]), self.config).bins
        kept, taken = draw(self._weights, bins, self.config, self._rng.random(), share, likely)
        self._particles = np.concatenate([self._particles[kept], strangers[taken]])
        self._weights = np.full(len(self._particles), 1 / len(self._particles))

    def _strangers(self, share: float, beams: Beams) -> tuple[se2.Pose, NDArray[np.float64]]:
        """Return poses from anywhere, and their likelihoods from the scan alone (Lenser and Veloso 2000)."""
        tried = self.config.candidates
        count = int(np.clip(np.ceil(share * len(self._particles)), 50, 5000)) * tried
        poses = self._floor.anywhere(count, self._rng)
        weights = np.full(count, 1 / count)
        if tried > 1 and len(beams.ranges):
            log_likelihood = self._sensor.log_likelihood(poses, beams).astype(float)
            weights = _times(weights, log_likelihood * self.config.trust)
        return poses, weights


@dataclass(frozen=True, eq=False)
class Estimate:
    """The robot's pose after a scan, as ROS's amcl reports it.

    pose_map_base: (3,) float64, the mean of the heaviest cluster of particles, moved by the odometry since.
    covariance: (3, 3) float64, mean squared deviation of all clusters' particles from it (metres, radians).
    pose_map_odom: (3,) float64, the transform from odometry to map.
    particles: (N, 3) float64, equally likely poses in the map, as of the last update.
    moved: whether the scan was compared with the map: the first one is, then each after enough motion.
    settled: whether nearly all particles agree; False while the robot may be in several places.
    ms: milliseconds spent on the scan.
    """

    pose_map_base: se2.Pose
    covariance: NDArray[np.float64]
    pose_map_odom: se2.Pose
    particles: se2.Pose
    moved: bool
    settled: bool
    ms: float


class Clock:
    """Ascending stamps of the scans so far, with recovery from wrong ones.

    A single stamp in the future would make all later scans late. So if more consecutive scans are late than there are
    accepted scans after their stamps, the accepted ones had the wrong stamps (as in `slam.pipeline.TrackBuilder`).
    """

    def __init__(self):
        self._stamps_ns = array("q")
        self._late, self._late_ns = 0, 0

    def accept(self, scan: Scan) -> int:
        """Advance to the time of a scan; return how many of the last scans prove to have a wrong stamp.

        Raises FrameRefused with the reason `not_in_order` if the scan is not later than the one before.
        """
        ahead = len(self._stamps_ns) - bisect_left(self._stamps_ns, scan.stamp_ns)
        if ahead:
            self._count_late(scan, ahead)
            del self._stamps_ns[-ahead:]
        self._stamps_ns.append(scan.stamp_ns)
        self._late = 0
        return ahead

    def _count_late(self, scan: Scan, ahead: int) -> None:
        self._late = self._late + 1 if self._late and scan.stamp_ns > self._late_ns else 1
        self._late_ns = scan.stamp_ns
        if self._late <= max(ahead, LATE):
            said = f"at {scan.stamp_ns} ns, is not later than the scan before it at {self._stamps_ns[-1]} ns"
            raise FrameRefused("not_in_order", f"{name_of(scan)}: {said}; give scans in order of time")


class FreeFloor:
    """The free cells of a map. Raises MapFileError if no cell is free, or none occupied."""

    def __init__(self, grid: OccupancyGrid):
        states = grid.states
        self.grid = grid
        self._free = np.flatnonzero(states == State.FREE).astype(np.uint32)
        for state, count in (("free", len(self._free)), ("occupied", int((states == State.OCCUPIED).sum()))):
            if not count:
                raise MapFileError(f"the map has no {state} cell: no robot can be localised in it; give a finished map")

    def anywhere(self, count: int, rng: np.random.Generator) -> se2.Pose:
        """Draw (count, 3) poses uniformly over all free cells and directions."""
        chosen = self._free[rng.integers(len(self._free), size=count)]
        rows, columns = np.divmod(chosen, np.uint32(self.grid.cells.shape[1]))
        local = (np.column_stack([columns, rows]) + rng.random((count, 2))) * self.grid.resolution
        turns = rng.uniform(-np.pi, np.pi, count)
        return np.column_stack([se2.transform(self.grid.origin, local), turns])


def near(start: se2.Pose, std: ArrayLike, count: int, rng: np.random.Generator) -> se2.Pose:
    """Draw (count, 3) poses normally distributed around a (3,) pose; std: (3,) metres, metres, radians."""
    poses = start + rng.standard_normal((count, 3)) * np.asarray(std)
    poses[:, 2] = se2.wrapped(poses[:, 2])
    return poses


def checked_start(start: ArrayLike) -> NDArray[np.float64]:
    """Validate a start pose and return it as (3,) float64. Raises ConfigError."""
    try:
        pose = np.asarray(start, float)
    except (TypeError, ValueError):
        pose = np.empty(0)
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ConfigError(f"start {start!r}: give three finite numbers x, y, yaw (metres, metres, radians), or none")
    return pose


class _TrackBuilder:
    """Collects the estimates without their particles, which would not fit in memory over hours."""

    def __init__(self):
        self.stamps_ns: list[int] = []
        self._base: list[se2.Pose] = []
        self._odom: list[se2.Pose] = []
        self._sure: list[bool] = []

    def add(self, stamp_ns: int, estimate: Estimate) -> None:
        """Append an estimate; earlier entries with this stamp or a later one are removed (`Clock`)."""
        while self.stamps_ns and self.stamps_ns[-1] >= stamp_ns:
            for kept in (self.stamps_ns, self._base, self._odom, self._sure):
                kept.pop()
        self.stamps_ns.append(stamp_ns)
        self._base.append(estimate.pose_map_base)
        self._odom.append(estimate.pose_map_odom)
        self._sure.append(estimate.settled)

    def track(self, refused: dict[str, int], first_refusal: str) -> Track:
        """Return the track from the certain poses alone; between them the odometry's drift is interpolated."""
        stamps_ns, base, odom = np.array(self.stamps_ns, np.int64), np.array(self._base), np.array(self._odom)
        sure = np.array(self._sure)
        if sure.any() and not sure.all():
            known = Track(stamps_ns[sure], base[sure], odom[sure])
            drift = np.array([known.correction(stamp_ns) for stamp_ns in self.stamps_ns])
            base, odom = se2.compose(drift, se2.compose(se2.inverse(odom), base)), drift
        return Track(stamps_ns, base, odom, refused, first_refusal)


def _times(weights: NDArray[np.float64], log_factors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the weights times the exponentials of log factors, normalized to sum 1."""
    weights = weights * np.exp(log_factors - log_factors.max())
    return weights / weights.sum()
