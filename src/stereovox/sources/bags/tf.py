# SPDX-License-Identifier: Apache-2.0
"""The tree of coordinate frames over a whole recording (ROS's tf): transforms between frames at a time.

Frames are named as in tf2, without a leading slash. Every frame has one parent; two frames are connected through their
common ancestor.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.geometry.se3 import Transform, from_quaternion, interpolate, inverse
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.robot_messages import TF_TYPES, frame_name, is_motion, read_transforms
from stereovox.sources.poses.poses import seconds_from_ns

STILL = 1e-9
WORLDS = ("map", "odom")
"""Frames used as the world; the first that exists (REP 105)."""


@dataclass(frozen=True)
class Limits:
    """Limits on the time between transforms and a query.

    max_gap_s: longest bridged time between two transforms. extrapolate_s: how long the last transform holds
    after its time, and the first before it; a robot at 1 m/s is 0.1 m off after 0.1 s.
    """

    max_gap_s: float = 0.5
    extrapolate_s: float = 0.1


class Edge:
    """The pose of frame `child` in frame `parent`: at the times of its transforms and between them, or always (fixed).

    A frame that has the same transform in all messages, at least two, counts as a fixed one that is sent repeatedly:
    any gap is bridged, and the ends hold for `max_gap_s`.
    """

    def __init__(self, parent: str, child: str, name: str = ""):
        self.parent, self.child, self._name = parent, child, name or f"{parent} -> {child}"
        self._fixed: Transform | None = None
        self._stamps, self._rows = array("q"), array("d")  # a list of tuples would take five times the memory
        self._sorted: tuple[NDArray[np.int64], NDArray[np.float64]] | None = None
        self._still = False

    @property
    def fixed(self) -> bool:
        """Whether the transform is the same at all times."""
        return self._fixed is not None

    @property
    def count(self) -> int:
        """Number of transforms, 1 if fixed."""
        return 1 if self.fixed else len(self._stamps)

    @property
    def moves(self) -> bool:
        """Whether the child moved in its parent."""
        if not self.fixed:
            self._in_order()
        return not (self.fixed or self._still)

    def add(self, stamp_ns: int, numbers: Iterable[float]) -> None:
        """Add tx ty tz qx qy qz qw at a time; of several at one time, the first counts."""
        self._stamps.append(stamp_ns)
        self._rows.extend(numbers)
        self._sorted = None

    def fix(self, T_parent_child: Transform) -> None:
        """Set the constant pose of the child."""
        self._fixed = np.array(T_parent_child, float)

    def at(self, stamp_ns: int, limits: Limits, where: str) -> Transform:
        """Return T_parent_child at a time: straight line in position, constant turn rate in rotation.

        Raises FrameRefused `no_pose`, with the edge and the gap, if the limits do not allow it.
        """
        if self._fixed is not None:
            return self._fixed
        stamps, rows = self._in_order()
        after = int(np.searchsorted(stamps, stamp_ns))
        if after < len(stamps) and stamps[after] == stamp_ns:
            return _motion(rows[after])
        if after in (0, len(stamps)):
            return self._held(stamp_ns, max(after - 1, 0), limits, where)
        start, end = int(stamps[after - 1]), int(stamps[after])
        if end - start > limits.max_gap_s * 1e9 and not self._still:
            message = f"has no transform for {_seconds(end - start)} after {seconds_from_ns(start)} s"
            raise FrameRefused(
                "no_pose",
                f"{where}: {self} {message} (at most {limits.max_gap_s:g} s is bridged); record it more often",
            )
        return interpolate(_motion(rows[after - 1]), _motion(rows[after]), (stamp_ns - start) / (end - start))

    def off_ns(self, stamp_ns: int) -> int:
        """Return the distance of a time from the range of the transforms; 0 if the frame is fixed."""
        if self._fixed is not None:
            return 0
        stamps, _ = self._in_order()
        return 0 if self._still else max(int(stamps[0]) - stamp_ns, stamp_ns - int(stamps[-1]), 0)

    def __str__(self) -> str:
        return self._name

    def _held(self, stamp_ns: int, nearest: int, limits: Limits, where: str) -> Transform:
        stamps, rows = self._in_order()
        away = abs(stamp_ns - int(stamps[nearest]))
        limit_s = max(limits.max_gap_s, limits.extrapolate_s) if self._still else limits.extrapolate_s
        if away > limit_s * 1e9:
            side = "begins after" if stamp_ns < stamps[nearest] else "ends before"
            message = f"{side} {seconds_from_ns(stamp_ns)} s, {_seconds(away)} away (at most {limit_s:g} s)"
            raise FrameRefused("no_pose", f"{where}: {self} {message}; leave that part of the recording out")
        return _motion(rows[nearest])

    def _in_order(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        if self._sorted is None:
            stamps, first = np.unique(np.array(self._stamps, np.int64), return_index=True)
            rows = np.array(self._rows, float).reshape(-1, 7)[first]
            self._sorted = stamps, rows
            self._still = self._is_still(rows)
        return self._sorted

    def _is_still(self, rows: NDArray[np.float64]) -> bool:
        return len(rows) > 1 and bool(np.abs(rows - rows[0]).max() <= STILL)


class Tf:
    """Transforms between frames, looked up at a time of the recording.

    where: their origin, for messages. limits: how far apart transforms may be, and how long the last one holds.
    unreadable: number of unreadable messages of transforms.

    If a frame has several parents, one with a fixed transform counts, else the most frequent, else the first;
    `notes` report it. Invalid transforms (see `is_motion`), and transforms to the same frame, are skipped, as in tf2.
    """

    def __init__(self, where: str = "tf", limits: Limits | None = None):
        self.where, self.limits, self.unreadable = where, limits or Limits(), 0
        self._parents: dict[str, dict[str, Edge]] = {}
        self._paths: dict[tuple[str, str], EdgePath] = {}
        self._skipped = 0

    def add(self, parent: str, child: str, stamp_ns: int, numbers: Iterable[float], fixed: bool = False) -> None:
        """Add the pose of `child` in `parent` at a time, or at all times: tx ty tz in metres, quaternion qx qy qz qw.

        In any order. Of several at one time, the first counts; of several fixed ones, the last.
        """
        row, parent, child = tuple(map(float, numbers)), frame_name(parent), frame_name(child)
        if not (parent and child and parent != child and is_motion(row)):
            self._skipped += 1
        elif fixed:
            self.add_fixed(parent, child, from_quaternion(row[:3], row[3:]))
        else:
            self._edge(parent, child).add(stamp_ns, row)

    def add_fixed(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """Add the constant pose of `child` in `parent`, (4, 4)."""
        self._edge(parent, child).fix(T_parent_child)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({*self._parents, *(parent for edges in self._parents.values() for parent in edges)}))

    @property
    def notes(self) -> tuple[str, ...]:
        """Choices made and messages skipped, one line each."""
        torn = {child: self._up(child) for child, edges in sorted(self._parents.items()) if len(edges) > 1}
        notes = [
            f"{self.where}: {child} has several parents ({', '.join(self._parents[child])}); {edge.parent} is used"
            for child, edge in torn.items()
            if edge
        ]
        if self._skipped:
            notes.append(f"{self.where}: {self._skipped} transforms are invalid and were left out")
        if self.unreadable:
            notes.append(f"{self.where}: {self.unreadable} messages cannot be read and were left out")
        return tuple(notes)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return T_target_source (4, 4) at a time in int64 nanoseconds.

        Raises FrameRefused `no_pose`: an unknown frame, frames that are not connected or form a loop, a gap in time
        (see `Edge.at`).
        """
        up, down = self._path(frame_name(target), frame_name(source))
        return inverse(self._along(up, stamp_ns)) @ self._along(down, stamp_ns)

    def off_ns(self, target: str, source: str, stamp_ns: int) -> int:
        """Return how far `lookup` extrapolates; raises FrameRefused as it does for unconnected frames."""
        up, down = self._path(frame_name(target), frame_name(source))
        return max((edge.off_ns(int(stamp_ns)) for edge in (*up, *down)), default=0)

    def connected(self, target: str, source: str) -> bool:
        """Return whether both frames exist and are connected."""
        try:
            self._path(frame_name(target), frame_name(source))
        except FrameRefused:
            return False
        return True

    def moving(self, target: str, source: str) -> bool:
        """Return whether one frame moved in the other; raises FrameRefused if they are not connected."""
        return any(edge.moves for part in self._path(frame_name(target), frame_name(source)) for edge in part)

    def root(self, frame: str) -> str:
        """Return the root of the tree above `frame`; raises FrameRefused for an unknown frame and a loop."""
        chain = self._chain(frame_name(frame))
        return chain[-1].parent if chain else frame_name(frame)

    def parent(self, frame: str) -> str:
        """Return the frame above `frame`, "" at a root and for an unknown frame."""
        edge = self._up(frame_name(frame))
        return edge.parent if edge else ""

    def _edge(self, parent: str, child: str) -> Edge:
        self._paths.clear()
        parent, child = frame_name(parent), frame_name(child)
        edges = self._parents.setdefault(child, {})
        if parent not in edges:
            edges[parent] = self._new_edge(parent, child)
        return edges[parent]

    def _new_edge(self, parent: str, child: str) -> Edge:
        return Edge(parent, child)

    def _up(self, frame: str) -> Edge | None:
        """Return the edge from a frame to its parent, None at a root."""
        edges = self._parents.get(frame)
        return max(edges.values(), key=lambda edge: (edge.fixed, edge.count)) if edges else None

    def _chain(self, frame: str) -> tuple[Edge, ...]:
        """Return the edges from a frame up to its root."""
        if frame not in (known := self.frames):
            raise FrameRefused("no_pose", f"{self.where}: no frame '{frame}' in it{did_you_mean(frame, known)}")
        chain, seen = [], [frame]
        while edge := self._up(seen[-1]):
            chain.append(edge)
            if edge.parent in seen:
                loop = " -> ".join([*seen[seen.index(edge.parent) :], edge.parent])
                raise FrameRefused("no_pose", f"{self.where}: frames form a loop: {loop}; correct their parents")
            seen.append(edge.parent)
        return tuple(chain)

    def _path(self, target: str, source: str) -> EdgePath:
        found = self._paths.get((target, source))
        if found is None:
            up, down = self._chain(target), self._chain(source)
            roots = [chain[-1].parent if chain else frame for chain, frame in ((up, target), (down, source))]
            if roots[0] != roots[1]:
                parts = " and ".join(
                    f"{frame} (root {root})" for frame, root in zip((target, source), roots, strict=True)
                )
                raise FrameRefused(
                    "no_pose", f"{self.where}: nothing connects {parts}; record the transforms between them"
                )
            while up and down and up[-1] is down[-1]:
                up, down = up[:-1], down[:-1]
            self._paths[target, source] = found = up, down
        return found

    def _along(self, edges: tuple[Edge, ...], stamp_ns: int) -> Transform:
        """Return T_ancestor_frame of the edges from a frame up to its ancestor."""
        T = np.eye(4)
        for edge in edges:
            T = edge.at(int(stamp_ns), self.limits, self.where) @ T
        return T


EdgePath = tuple[tuple[Edge, ...], tuple[Edge, ...]]
"""Edges from a target up to the common ancestor, and from a source up to it."""


def tf_topics(file: BagFile) -> list[str]:
    """Return `/tf` and `/tf_static`, or without these the topics of a namespace (`/robot/tf`)."""
    found = sorted(topic for topic, kind in file.types.items() if kind in TF_TYPES)
    return [topic for topic in found if topic in ("/tf", "/tf_static")] or found


def read_tf(file: BagFile, limits: Limits | None = None) -> Tf | None:
    """Return the transforms of a recording, None if it has no such topic.

    Transforms of a topic named `tf_static` are valid at all times. Unreadable messages are skipped and leave gaps.
    """
    topics = tf_topics(file)
    if not topics:
        return None
    tf = Tf(f"{file.path} /tf", limits)
    for topic in topics:
        fixed = topic.endswith("tf_static")
        for i in range(len(file.stamps(topic))):
            try:
                message = read_transforms(file.read(topic, i))
            except (FrameRefused, ValueError):
                tf.unreadable += 1
                continue
            for one in message:
                tf.add(one.parent, one.child, one.stamp_ns, one.numbers, fixed)
    return tf


@dataclass(frozen=True)
class TfPoses:
    """Poses of frame `body` in frame `world`, looked up on demand.

    edge: poses of a frame of the tree in `world`, which is then not in the tree (odometry); None: all is in the tree.
    """

    tf: Tf
    world: str
    body: str
    edge: Edge | None = None

    @property
    def where(self) -> str:
        """Origin of the poses, for messages."""
        return f"{self.tf.where} ({self.world} -> {self.body})"

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_body at a time; raises FrameRefused `no_pose` (see `Tf.lookup`)."""
        if self.edge is None:
            return self.tf.lookup(self.world, self.body, stamp_ns)
        T_world_child = self.edge.at(int(stamp_ns), self.tf.limits, self.tf.where)
        return T_world_child @ self.tf.lookup(self.edge.child, self.body, stamp_ns)

    def of(self, frame: str) -> TfPoses:
        """Return the poses of another frame in the same world."""
        return replace(self, body=frame_name(frame))

    def off_ns(self, stamp_ns: int) -> int:
        """Return how far the pose at a time is extrapolated."""
        if self.edge is None:
            return self.tf.off_ns(self.world, self.body, stamp_ns)
        return max(self.edge.off_ns(int(stamp_ns)), self.tf.off_ns(self.edge.child, self.body, stamp_ns))


def tf_poses(tf: Tf, body: str, world: str = "") -> TfPoses | str:
    """Return the poses of frame `body` in `world`, or the reason, in one line, why there are none.

    world: "" for `map`, else `odom`, if it is connected with `body`, else the root of its tree if it moved there.
    Raises SourceError if a given `world` is not connected with `body`.
    """
    body, world = frame_name(body), frame_name(world)
    try:
        tf.moving(world or tf.root(body), body)
        name = world or next((name for name in WORLDS if tf.connected(name, body)), tf.root(body))
        if name in (world, *WORLDS) or tf.moving(name, body):
            return TfPoses(tf, name, body)
    except FrameRefused as refused:
        if world:
            raise SourceError(f"{refused}; correct ?world_frame={world}") from None
        return str(refused)
    return f"{tf.where}: has the mount of {body} on {name}, but not where that was"


def _motion(numbers: NDArray[np.float64]) -> Transform:
    return from_quaternion(numbers[:3], numbers[3:])


def _seconds(ns: int) -> str:
    return f"{ns / 1e9:.3f} s"
