# SPDX-License-Identifier: Apache-2.0
"""Loop closure in space: finds revisited places, and corrects the trajectory so that they coincide.

The trajectory is cut into submaps, which are taken as rigid. Each is registered to earlier ones that may show the same
place, wherever the poses allow; a match at one place only that agrees with another finding enters a pose graph. At the
end all overlapping submaps are registered to each other.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.config import Config
from stereovox.correct.loops.drift import GATE, Drift, Odometry, PathLength, Positions, difference, squared
from stereovox.correct.loops.search import SAME_M, SAME_RAD, Repeats, Search
from stereovox.correct.loops.submaps import FLOOR, Match, Shape, Shapes, Submap, is_long, matched
from stereovox.errors import StereovoxError
from stereovox.geometry.pose_graph import HELD, Edge, PoseGraph, Position, Upright, information, need_gtsam
from stereovox.geometry.se3 import Transform, interpolate, inverse, orthonormalise, rotation_between
from stereovox.maps.record.history import History
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.products.floor_axes import up_of

LEAST_WAY_M = 3.0
"""Least path in metres between two visits that form a loop."""
VIEW_M = 3.0
"""Largest distance in metres between the middles of two submaps that overlap well."""
TRIED = 6
"""Number of nearest earlier submaps that a new one is registered to."""
NEIGHBOURS = 10
"""Number of nearest earlier submaps that each is registered to at the end."""
REACH = 4.75
"""Deviations, not squared, within which a place is searched, to find others that look the same."""
RIVALS = 7.1
"""Deviations, half again as many, within which no other place may look the same: poses may be worse than stated.
"""
WIDEST = np.array([8.0, 8.0, 2.0]), 0.7
"""Largest search, in metres across and up, and radians."""
NARROW_M, NARROW_RAD = 0.35, 0.2
"""Reach within which registration needs no search."""
TURNS = 2
"""Iterations of aligning positions with the trajectory and correcting it by them."""
FLOATING = 100.0
"""Freedom of the first submap, in metres and radians, while positions hold the trajectory; undone afterwards."""
WITNESS_M = 15.0
"""Metres of path within which two findings can confirm each other."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Two submaps that may show one place.

    Attributes:
        first: Index of the earlier one.
        second: Index of the later one.
        match: Registration of the later one to the earlier one.
        off_m: Metres by which the poses were off.
        off_rad: Radians by which the poses were off.
        why: Why it was refused, in words; "" if it was not.
    """

    first: int
    second: int
    match: Match
    off_m: float
    off_rad: float
    why: str = ""

    @property
    def edge(self) -> Edge:
        """Return the loop as a pose-graph edge."""
        return Edge(self.first, self.second, self.match.T_earlier_later, information(self.match.covariance))


class LoopCloser:
    """Finds and closes the loops of a map's frames, added one by one.

    Args:
        config: The map's settings.
        odometry: A second odometry, if there is one.

    Attributes:
        submaps: The submaps so far, with their current poses.
        loops: The accepted loops.
        refused: Places that look the same but were rejected.
        shapes: Surfaces of submaps; None if there are too few.
        R_level_map: (3, 3) turns the map so that z points up.
        repeats: Where a submap's surroundings repeat a short distance away.

    Raises:
        MissingExtra: gtsam is not installed.
    """

    def __init__(self, config: Config, odometry: Odometry | None = None):
        need_gtsam()
        self._odometry = odometry
        self.submaps: list[Submap] = []
        self.loops: list[Loop] = []
        self.refused: list[Loop] = []
        self.shapes, self._drift = Shapes(config), Drift.of(config.loops)
        self._up, self._upright_deg = up_of(config), config.loops.upright_deg
        self.R_level_map = rotation_between(self._up, [0, 0, 1])
        self.repeats = Repeats(self.shapes, self.R_level_map)
        self._steps, self._overlaps, self._uprights = list[Edge](), list[Edge](), list[Upright]()
        self._waiting: list[Loop] = []  # waiting for another one that agrees
        self._frames, self._poses = list[KeptFrame](), list[Transform]()  # of the next submap
        self._ways, self._way = list[tuple[float, float]](), PathLength()

    @property
    def places(self) -> NDArray[np.float64]:
        """Return the current positions of the submaps' anchors: (S, 3) metres."""
        return np.array([submap.T_map_anchor[:3, 3] for submap in self.submaps])

    def add(self, frame: KeptFrame) -> bool:
        """Add the next frame, with its original pose; return whether loops were found."""
        pose, found = orthonormalise(frame.T_world_sensor), False
        own = [T for one, T in zip(self._frames, self._poses, strict=True) if one.sensor == frame.sensor]
        if is_long(own, pose):
            found = self._complete()
        self._frames.append(frame)
        self._poses.append(pose)
        self._ways.append(self._way.add(frame.sensor, pose))
        return found

    def finish(
        self, progress: Callable[[int, int], object] = lambda done, total: None, positions: Positions | None = None
    ) -> None:
        """Complete the last submap, and register all overlapping ones to each other.

        Args:
            progress: Called with the number of submaps done, and the total.
            positions: Drift-free positions of the camera, to hold its trajectory.

        Raises:
            StereovoxError: `positions` are too few, or too close to each other.
        """
        if self._frames:
            self._complete()
        self.refused += [replace(loop, why="nothing else confirms it") for loop in self._waiting]
        self._waiting = []
        if self.loops:
            self._overlaps = self._found_overlaps(progress)
            self._solve()
        if positions is not None:
            self._hold(positions)

    def join(self, other: LoopCloser, T_map_other: Transform, loops: Sequence[Loop]) -> None:
        """Add another recording to this one's graph. Both are finished; call `finish` again.

        Args:
            other: All of the other recording.
            T_map_other: (4, 4), maps its world into this one.
            loops: Shared places: `first` is an index of this recording's submaps, `second` of the other's.
        """
        count = len(self.submaps)
        for submap in other.submaps:
            submap.T_map_anchor = T_map_other @ submap.T_map_anchor
        self.submaps += other.submaps
        self._steps += [replace(edge, first=edge.first + count, second=edge.second + count) for edge in other._steps]
        self._uprights += [replace(one, pose=one.pose + count) for one in other._uprights]
        own = [replace(loop, first=loop.first + count, second=loop.second + count) for loop in other.loops]
        self.loops += [*own, *(replace(loop, second=loop.second + count) for loop in loops)]
        refused = (replace(loop, first=loop.first + count, second=loop.second + count) for loop in other.refused)
        self.refused += refused
        self._solve()

    def corrected(self, part: slice = slice(None)) -> dict[tuple[str, int], Transform]:
        """Return T_world_sensor (4, 4) of all frames, corrected, by sensor and stamp.

        Frames between two anchors move like these, interpolated in time; at the ends like the nearest anchor.

        Args:
            part: The submaps of one recording, if another one was joined.
        """
        submaps = sorted(self.submaps[part], key=lambda submap: submap.stamp_ns)
        stamps = [submap.stamp_ns for submap in submaps]
        found: dict[tuple[str, int], Transform] = {}
        for submap in submaps:
            for frame, pose in zip(submap.frames, submap.T_odom_frames, strict=True):
                after = int(np.searchsorted(stamps, frame.stamp_ns))
                one, other = max(after - 1, 0), min(after, len(stamps) - 1)
                span = max(stamps[other] - stamps[one], 1)
                share = min(max((frame.stamp_ns - stamps[one]) / span, 0.0), 1.0)
                first, second = (submaps[i].bend @ pose for i in (one, other))
                found[frame.sensor, frame.stamp_ns] = interpolate(first, second, share)
        return found

    def _complete(self) -> bool:
        """Make a submap of the frames since the last one; return whether it closes loops."""
        middle = len(self._frames) // 2
        submap = Submap(self._frames, self._poses, self._poses[middle], *self._ways[middle])
        self._frames, self._poses, self._ways = [], [], []
        if self.submaps:
            self._follow(self.submaps[-1], submap)
        if self._upright_deg is not None:
            up = submap.T_odom_anchor[:3, :3].T @ self._up
            self._uprights.append(Upright(len(self.submaps), up, float(np.radians(self._upright_deg))))
        self.submaps.append(submap)
        shape = self.shapes[submap]
        if shape is None:
            return False
        submap.centre = shape.points.mean(axis=0).astype(float)
        self.repeats.look(self.submaps)
        before = len(self.loops)
        self._find(shape)
        return len(self.loops) > before

    def _follow(self, last: Submap, submap: Submap) -> None:
        """Place a submap after the last one, by its poses."""
        motion = inverse(last.T_odom_anchor) @ submap.T_odom_anchor
        metres, radians = submap.travelled - last.travelled, submap.turned - last.turned
        ends = last.frames[last.anchor], submap.frames[submap.anchor]
        variances = np.sum([np.repeat(frame.pose_sigma, 3) ** 2 for frame in ends], axis=0)
        covariance = self._drift.covariance(metres, radians) + np.diag(variances)
        if self._odometry is not None:
            stamps_ns = last.stamp_ns, submap.stamp_ns
            motion, covariance = self._odometry.joined(stamps_ns, motion, covariance, (metres, radians))
        number = len(self.submaps)
        self._steps.append(Edge(number - 1, number, motion, information(covariance)))
        submap.T_map_anchor = last.T_map_anchor @ motion

    def _hold(self, positions: Positions) -> None:
        """Hold the trajectory at positions, whose world is aligned with the map; the first submap stays fixed."""
        found = positions.at(np.array([submap.stamp_ns for submap in self.submaps], np.int64))
        sigma = np.full(3, positions.sigma_m)
        for _ in range(TURNS):
            places = positions.in_map(found, self.places, self.R_level_map)
            start = self.submaps[0].T_map_anchor
            self._solve([Position(n, place, sigma) for n, place in enumerate(places) if np.isfinite(place).all()])
            T_map_turned = start @ inverse(self.submaps[0].T_map_anchor)
            for submap in self.submaps:
                submap.T_map_anchor = T_map_turned @ submap.T_map_anchor
        positions.compare(positions.in_map(found, self.places, self.R_level_map), self.places)

    def _graph(self, positions: Sequence[Position] = ()) -> PoseGraph:
        poses = np.array([submap.T_map_anchor for submap in self.submaps])
        loops = [*(loop.edge for loop in self.loops), *self._overlaps]
        held = FLOATING if positions else HELD
        return PoseGraph(poses, self._steps, loops, [*self._uprights, *positions], self._up, held)

    def _solve(self, positions: Sequence[Position] = ()) -> PoseGraph:
        graph = self._graph(positions)
        for submap, pose in zip(self.submaps, graph.poses, strict=True):
            submap.T_map_anchor = pose
        return graph

    def _find(self, shape: Shape) -> None:
        """Find earlier submaps that overlap the latest one."""
        last = len(self.submaps) - 1
        near = self._near(last)
        if not near:
            return
        covariances = self._graph().covariances(near, last)
        loops = [
            self._loop(first, last, shape, covariance) for first, covariance in zip(near, covariances, strict=True)
        ]
        found = [loop for loop in loops if loop is not None]
        self.refused += [loop for loop in found if loop.why]
        for loop in found:
            if not loop.why:
                self._judge(loop)

    def _near(self, number: int) -> list[int]:
        """Return the earlier submaps that may overlap one, the nearest first."""
        way = self.submaps[number].travelled
        within = VIEW_M + REACH * self._drift.shift_m(way)
        away = self._away(number)
        old = [i for i in np.argsort(away) if way - self.submaps[i].travelled > LEAST_WAY_M and away[i] < within]
        return [int(i) for i in old[:TRIED]]

    def _away(self, number: int) -> NDArray[np.float64]:
        """Return the distances in metres from a submap's middle to each earlier one's."""
        middles = np.array([submap.middle for submap in self.submaps[: number + 1]])
        return np.linalg.norm(middles[:-1] - middles[-1], axis=1)

    def _loop(self, first: int, second: int, later: Shape, covariance: NDArray[np.float64]) -> Loop | None:
        """Return the registration of a submap to an earlier one, within what the poses allow; None if it fails.

        covariance: (6, 6) of its pose relative to the earlier one.
        """
        earlier, guess = self.shapes[self.submaps[first]], self._expected(first, second)
        if earlier is None:
            return None
        matches = [matched(earlier, later, start) for start in self._starts(first, earlier, later, guess, covariance)]
        good = [match for match in matches if match is not None and match.held]
        if not good:
            return None
        best = max(good, key=lambda match: match.shared)
        moved = difference(guess, best.T_earlier_later)
        off_rad, off_m = float(np.linalg.norm(moved[:3])), float(np.linalg.norm(moved[3:]))
        why = ""
        if any(_is_elsewhere(best, match) for match in good):
            why = "another place within reach looks the same"
        elif squared(moved, covariance + best.covariance) > GATE:
            why = f"the poses cannot be off by {off_m:.2f} m and {np.degrees(off_rad):.1f} degrees (loops.drift)"
        elif (shift_m := self._rival_m(first, second, moved, covariance + best.covariance)) is not None:
            why = f"it looks the same {shift_m:.2f} m away, which the poses cannot tell apart"
        return Loop(first, second, best, off_m, off_rad, why)

    def _rival_m(
        self, first: int, second: int, moved: NDArray[np.float64], covariance: NDArray[np.float64]
    ) -> float | None:
        """Return the distance of another possible place of a submap, if the surroundings repeat; else None.

        moved: (6,) its motion from the expected pose; covariance: (6, 6) of that.
        """
        one, other = self.submaps[first], self.submaps[second]
        shifts = self.repeats.shifts([one.middle, other.middle]) @ other.T_map_anchor[:3, :3]
        for shift in (*shifts, *-shifts):
            if squared(np.concatenate([moved[:3], moved[3:] + shift]), covariance) < RIVALS**2:
                return float(np.linalg.norm(shift))
        return None

    def _expected(self, first: int, second: int) -> Transform:
        return inverse(self.submaps[first].T_map_anchor) @ self.submaps[second].T_map_anchor

    def _starts(
        self, first: int, earlier: Shape, later: Shape, guess: Transform, covariance: NDArray[np.float64]
    ) -> Sequence[Transform]:
        """Return the poses T_earlier_later (4, 4) from which registration starts."""
        turn, shift = (
            REACH * float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (covariance[:3, :3], covariance[3:, 3:])
        )
        if shift < NARROW_M and turn < NARROW_RAD:
            return [guess]
        search = Search(earlier.points, earlier.views, self.R_level_map @ self.submaps[first].T_map_anchor[:3, :3])
        return search.places(later, guess, np.minimum(shift, WIDEST[0]), min(turn, WIDEST[1]))

    def _judge(self, found: Loop) -> None:
        """Accept a loop, and those it confirms, once one of another submap agrees with it."""
        known = (*self._waiting, *self.loops)
        witnesses = [other for other in known if other.second != found.second and self._agree(found, other)]
        if not witnesses:
            self._waiting.append(found)
            return
        self.loops += [loop for loop in (*witnesses, found) if loop not in self.loops]
        self._waiting = [loop for loop in self._waiting if loop not in self.loops]
        self._solve()

    def _agree(self, a: Loop, b: Loop) -> bool:
        """Return whether two loops imply the same drift, by the poses between them."""
        pairs = [(self.submaps[a.first], self.submaps[b.first]), (self.submaps[b.second], self.submaps[a.second])]
        metres = sum(abs(one.travelled - other.travelled) for one, other in pairs)
        if metres > WITNESS_M:
            return False
        over, back = (inverse(one.T_odom_anchor) @ other.T_odom_anchor for one, other in pairs)
        moved = difference(a.match.T_earlier_later, over @ b.match.T_earlier_later @ back)
        covariance = self._drift.covariance(metres) + 2 * FLOOR
        lever = float(np.linalg.norm(over[:3, 3]) + np.linalg.norm(back[:3, 3]))
        covariance[3:, 3:] += lever**2 * covariance[:3, :3]
        return squared(moved, covariance) < GATE

    def _found_overlaps(self, progress: Callable[[int, int], object]) -> list[Edge]:
        """Register all overlapping submaps to each other; return the edges."""
        graph, known = self._solve(), {(loop.first, loop.second) for loop in self.loops}
        edges: list[Edge] = []
        for second in range(1, len(self.submaps)):
            progress(second, len(self.submaps) - 1)
            away = self._away(second)
            near = [int(i) for i in np.argsort(away)[:NEIGHBOURS] if away[i] < VIEW_M and (i, second) not in known]
            later = self.shapes[self.submaps[second]] if near else None
            if later is not None:
                covariances = graph.covariances(near, second)
                found = (self._overlap(i, second, later, one) for i, one in zip(near, covariances, strict=True))
                edges += [edge for edge in found if edge is not None]
        return edges

    def _overlap(self, first: int, second: int, later: Shape, covariance: NDArray[np.float64]) -> Edge | None:
        """Return the registration of a submap to an earlier one, near the expected pose."""
        earlier, guess = self.shapes[self.submaps[first]], self._expected(first, second)
        if earlier is None:
            return None
        match = matched(earlier, later, guess)
        if match is None:
            return None
        moved = difference(guess, match.T_earlier_later)
        if squared(moved, covariance + match.covariance) > GATE:
            return None
        return Edge(first, second, match.T_earlier_later, information(match.covariance))


def check_one_way(history: History, frames: Sequence[KeptFrame]) -> None:
    """Raise StereovoxError if a map's frames are not one trajectory, so that no loops can be searched."""
    if history.recordings > 1:
        raise StereovoxError(
            f"the map was merged of {history.recordings} recordings, which are not a single trajectory; close the "
            "loops of each, and merge them with --find, more than two only if each was recorded after the other"
        )
    times = Counter((frame.sensor, frame.stamp_ns) for frame in frames)
    (sensor, stamp_ns), most = times.most_common(1)[0]
    if most > 1:
        raise StereovoxError(
            f"{most} frames of {sensor} have the stamp {stamp_ns}; loop closure needs frames with distinct stamps"
        )
    lidar = next((frame for frame in frames if isinstance(frame.camera, Lidar)), None)
    if lidar is not None:
        raise StereovoxError(
            f"{lidar.name or lidar.sensor}: loops are searched in depth images, and this is a cloud; correct poses of "
            "clouds with poses from another program (stereovox remap)"
        )


def ends_of(loops: Sequence[Loop], places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the two places (N, 2, 3) of N loops, the earlier one first, of all places (S, 3)."""
    return places[np.reshape([(loop.first, loop.second) for loop in loops], (-1, 2)).astype(np.int64)]


def _is_elsewhere(one: Match, other: Match) -> bool:
    """Return whether two matches are of two places."""
    moved = difference(one.T_earlier_later, other.T_earlier_later)
    return bool(np.linalg.norm(moved[3:]) > SAME_M or np.linalg.norm(moved[:3]) > SAME_RAD)
