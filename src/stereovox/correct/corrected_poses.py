# SPDX-License-Identifier: Apache-2.0
"""Corrected poses of a map's frames, from what another program found later: a path of better poses, or a jump of
odometry's frame in the map."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from stereovox.errors import FrameRefused, StereovoxError
from stereovox.geometry.se3 import Transform, apart, interpolate, inverse, orthonormalise
from stereovox.mapping.rebuild import FrameKey, need_frames
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.boxed_map import BoxedMap
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.sources.poses.poses import MAX_GAP_NS, Poses

SAME_NS = 500_000
"""A pose whose stamp is this close to a frame's belongs to it: some programs write milliseconds."""
SLIGHT = 0.1
"""Share of a cell: frames that would move less are left alone."""
SETTLED = 0.5
"""Share of a cell by which the view may move with odometry's frame between images once a jump is over."""
METRES_PER_RADIAN = 0.5
"""Metres of path that a radian of turn counts as."""


@dataclass(frozen=True)
class CorrectedPoses:
    """New poses for the frames of a map.

    Attributes:
        poses: T_world_sensor (4, 4) by sensor and stamp in nanoseconds, for `Mapper.correct`.
        posed: Number of frames with their own pose.
        between: Number of frames between them, which move like their neighbours.
        outside: Number of frames before the first or after the last of them; they are not moved.
    """

    poses: Mapping[FrameKey, Transform]
    posed: int
    between: int
    outside: int


class _Anchor(NamedTuple):
    """The motion of the world's poses at a time: T_new_old (4, 4), from old to corrected poses."""

    stamp_ns: int
    T_new_old: Transform


def load_with_frames(path: str | Path) -> tuple[VoxelMap, Sequence[KeptFrame]]:
    """Return a saved map and the frames it kept. Raises StereovoxError, which names the cure, if it kept none."""
    saved = load_map(path)
    if isinstance(saved, BoxedMap):
        cure = "name better poses after the recording in the fleet's list, and continue with --resume"
        raise StereovoxError(f"{path}: maps in boxes do not keep their frames; {cure}")
    return saved, need_frames(saved.kept_frames, f"{path}: the map").frames


def poses_by_path(frames: Iterable[KeptFrame], path: Poses, mounts: Mapping[str, Transform]) -> CorrectedPoses:
    """Return frame poses from a path of corrected poses, such as the key poses of a pose graph.

    A frame takes the nearest pose whose stamp is within half a millisecond of its own. If frames are sparse and poses
    dense, it is interpolated between two, each less than 0.1 s away. Poses that belong to no frame are compared with
    the body's pose by the frames around them, each less than 0.1 s away. All other frames, also those of sensors
    without a mount, move like their neighbours in time before and after, interpolated between both.


    Args:
        frames: Kept frames of a map (`VoxelMap.kept_frames`), in any order.
        path: Corrected poses of a body in the world of the map.
        mounts: T_body_sensor (4, 4) by the name of the sensor.

    Returns:
        New poses of all frames that move. Empty if no pose of the path is near a frame with a mount.

    Raises:
        FrameRefused: A frame's own pose is unusable, such as a damaged line of a file.
    """
    frames = sorted(frames, key=lambda frame: frame.stamp_ns)
    new, anchors = dict[FrameKey, Transform](), list[_Anchor]()
    for sensor, T_body_sensor in mounts.items():
        own = [frame for frame in frames if frame.sensor == sensor]
        found, more = _own_poses(own, path, T_body_sensor)
        new.update(found)
        anchors.extend(more)
    anchors.sort(key=lambda anchor: anchor.stamp_ns)
    posed = sum(_key(frame) in new for frame in frames)
    between = _between(frames, anchors, new)
    return CorrectedPoses(new | between, posed, len(between), len(frames) - posed - len(between))


def noticeable(
    frames: Iterable[KeptFrame], poses: Mapping[FrameKey, Transform], least_m: float, reach_m: float
) -> dict[FrameKey, Transform]:
    """Return the poses that noticeably move something in a frame's view.

    Args:
        frames: Kept frames of a map.
        poses: New poses, by sensor and stamp.
        least_m: Least motion in metres of something in view.
        reach_m: Largest distance in metres of it.
    """
    found = {}
    for frame in frames:
        T = poses.get(_key(frame))
        if T is not None and _moves(frame.T_world_sensor, T, reach_m) >= least_m:
            found[_key(frame)] = T
    return found


class OdometryJumps:
    """Detects that another program moved odometry's frame in the map, and corrects frames accordingly.

    A jump shows the final error of a camera's pose, but not how it grew. It is spread over the path since the last
    jump: a frame halfway is moved half as far. This is an approximation; a path of corrected poses (`poses_by_path`) is
    exact. Later frames already have the new transform.

    Args:
        cell: Size of a cell in metres: smaller motions in view are no jump yet; they add up.
        reach_m: Range of the cameras in metres.
    """

    def __init__(self, cell: float, reach_m: float):
        self._cell, self._reach_m = cell, reach_m
        self.forget()

    def forget(self) -> None:
        """Forget all frames: another map begins."""
        self._frames = list[_Driven]()
        self._last, self._way = dict[str, Transform](), dict[str, float]()
        self._start: Transform | None = None
        self._before = np.eye(4)

    def add(
        self, sensor: str, stamp_ns: int, T_map_odom: Transform, T_odom_sensor: Transform, *, in_map: bool = True
    ) -> dict[FrameKey, Transform]:
        """Record a frame.

        Args:
            sensor: Its sensor.
            stamp_ns: Its time in nanoseconds.
            T_map_odom: (4, 4), odometry's frame in the map at that time.
            T_odom_sensor: (4, 4), the sensor's pose by odometry.
            in_map: Whether the frame is in the map; a refused one may still show a jump.

        Returns:
            Poses (4, 4) for `Mapper.correct`, by sensor and stamp, if a jump has just ended; else nothing.
        """
        if self._start is None:
            self._start = self._before = T_map_odom
        here = T_map_odom @ T_odom_sensor
        step, jump = (_moves(T @ T_odom_sensor, here, self._reach_m) for T in (self._before, self._start))
        self._before = T_map_odom
        way = self._way.get(sensor, 0.0) + _way(self._last.get(sensor, T_odom_sensor), T_odom_sensor)
        self._last[sensor], self._way[sensor] = T_odom_sensor, way
        if in_map:
            self._frames.append(_Driven((sensor, stamp_ns), T_map_odom, T_odom_sensor, way))
        if step > SETTLED * self._cell or jump <= self._cell:
            return {}
        count = len(self._frames)
        while count and self._moved(self._frames[count - 1], T_map_odom) < SLIGHT * self._cell:
            count -= 1  # it already has the new transform
        before, after = self._frames[:count], self._frames[count:]
        found, ways = self._spread(before, self._start, T_map_odom)
        self._frames = [frame._replace(way=frame.way - ways.get(frame.key[0], 0.0)) for frame in after]
        self._way = {name: way - ways.get(name, 0.0) for name, way in self._way.items()}
        self._start = T_map_odom
        return found

    def _spread(
        self, frames: Sequence[_Driven], start: Transform, end: Transform
    ) -> tuple[dict[FrameKey, Transform], dict[str, float]]:
        """Return new poses of frames, with odometry's frame from `start` to `end`, and the path length by sensor."""
        found, ways = dict[FrameKey, Transform](), {frame.key[0]: frame.way for frame in frames}
        for frame in frames:
            whole = ways[frame.key[0]]
            places = start @ frame.T_odom_sensor, end @ frame.T_odom_sensor
            T = interpolate(*places, frame.way / whole if whole else 1.0)
            if _moves(frame.T_map_odom @ frame.T_odom_sensor, T, self._reach_m) >= SLIGHT * self._cell:
                found[frame.key] = T
        return found, ways

    def _moved(self, frame: _Driven, T_map_odom: Transform) -> float:
        here, there = frame.T_map_odom @ frame.T_odom_sensor, T_map_odom @ frame.T_odom_sensor
        return _moves(here, there, self._reach_m)


class _Driven(NamedTuple):
    """A frame as mapped, and its sensor's path in metres since the last jump."""

    key: tuple[str, int]
    T_map_odom: Transform
    T_odom_sensor: Transform
    way: float


def _key(frame: KeptFrame) -> FrameKey:
    return frame.sensor, frame.stamp_ns


def _own_poses(
    frames: Sequence[KeptFrame], path: Poses, T_body_sensor: Transform
) -> tuple[dict[FrameKey, Transform], list[_Anchor]]:
    """Return the poses of one sensor's frames, in order of time, in a path, and the sensor's motions by it."""
    new, anchors, used = dict[FrameKey, Transform](), list[_Anchor](), set[int]()
    stamps = path.stamps_ns.tolist()
    for frame in frames:
        k = _nearest(stamps, frame.stamp_ns)
        if abs(stamps[k] - frame.stamp_ns) <= SAME_NS:
            used.add(k)
            new[_key(frame)] = path.at(stamps[k]) @ T_body_sensor
    for k in set(range(len(stamps))) - used:
        T_old = _where(frames, stamps[k])
        if T_old is not None and np.isfinite(path.T_world_body[k]).all():
            used.add(k)
            anchors.append(_anchor(stamps[k], T_old, path.T_world_body[k] @ T_body_sensor))
    for frame in frames:
        if _key(frame) not in new and not _beside(stamps, frame.stamp_ns) & used:
            try:
                new[_key(frame)] = path.at(frame.stamp_ns) @ T_body_sensor
            except FrameRefused:
                continue
    own = [frame for frame in frames if _key(frame) in new]
    return new, [*anchors, *(_anchor(one.stamp_ns, one.T_world_sensor, new[_key(one)]) for one in own)]


def _anchor(stamp_ns: int, T_old: Transform, T_new: Transform) -> _Anchor:
    return _Anchor(stamp_ns, T_new @ inverse(orthonormalise(T_old)))


def _between(
    frames: Sequence[KeptFrame], anchors: Sequence[_Anchor], new: Mapping[FrameKey, Transform]
) -> dict[FrameKey, Transform]:
    """Return poses of frames without a new one between two of the anchors, which are in order of time."""
    stamps, found = [anchor.stamp_ns for anchor in anchors], dict[FrameKey, Transform]()
    for frame in frames:
        after = bisect_left(stamps, frame.stamp_ns)
        outside = after == len(stamps) or (after == 0 and stamps[0] != frame.stamp_ns)
        if _key(frame) not in new and not outside:
            found[_key(frame)] = _as_both_move(frame, anchors[max(after - 1, 0)], anchors[after])
    return found


def _as_both_move(frame: KeptFrame, before: _Anchor, after: _Anchor) -> Transform:
    """Return a frame's pose between two anchors, with their motions interpolated in time."""
    start, end = before.stamp_ns, after.stamp_ns
    share = (frame.stamp_ns - start) / (end - start) if end > start else 0.0
    return interpolate(before.T_new_old @ frame.T_world_sensor, after.T_new_old @ frame.T_world_sensor, share)


def _nearest(stamps_ns: Sequence[int], stamp_ns: int) -> int:
    """Return the index of the nearest of ascending stamps."""
    return min(_beside(stamps_ns, stamp_ns), key=lambda k: abs(stamps_ns[k] - stamp_ns))


def _beside(stamps_ns: Sequence[int], stamp_ns: int) -> set[int]:
    """Return the indices of the ascending stamps before and after a time, one at the ends."""
    after = bisect_left(stamps_ns, stamp_ns)
    return {max(after - 1, 0), min(after, len(stamps_ns) - 1)}


def _where(frames: Sequence[KeptFrame], stamp_ns: int) -> Transform | None:
    """Return a sensor's pose at a time between two of its frames, in order; None if one is 0.1 s or more away, or so
    near that another, nearer pose belongs to it.
    """
    after = bisect_left(frames, stamp_ns, key=lambda frame: frame.stamp_ns)
    if after in (0, len(frames)):
        return None
    one, other = frames[after - 1], frames[after]
    gaps = stamp_ns - one.stamp_ns, other.stamp_ns - stamp_ns
    if max(gaps) >= MAX_GAP_NS or min(gaps) <= SAME_NS:
        return None
    share = (stamp_ns - one.stamp_ns) / (other.stamp_ns - one.stamp_ns)
    return interpolate(one.T_world_sensor, other.T_world_sensor, share)


def _moves(one: Transform, other: Transform, reach_m: float) -> float:
    """Return the largest motion in metres of a point at `reach_m` when the sensor moves between two poses."""
    shift, turn = _apart(one, other)
    return shift + turn * reach_m


def _way(one: Transform, other: Transform) -> float:
    shift, turn = _apart(one, other)
    return shift + METRES_PER_RADIAN * turn


def _apart(one: Transform, other: Transform) -> tuple[float, float]:
    return apart(tuple(one.ravel().tolist()[:12]), tuple(other.ravel().tolist()[:12]))
