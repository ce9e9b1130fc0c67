# SPDX-License-Identifier: Apache-2.0
"""A tree of frames over a whole recording: where one frame stood in another at a time (what tf does in ROS).

Frames are named as tf2 does it, without a slash in front. Every frame has one parent; what connects two frames is the
way up to their common ancestor and down again.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from stereovox.errors import FrameRefused, did_you_mean
from stereovox.geometry import Transform, from_quaternion, inverse
from stereovox.sources.bag_robot_messages import frame_name, is_motion
from stereovox.sources.tf_edge import Edge, Limits

Way = tuple[tuple[Edge, ...], tuple[Edge, ...]]
"""Edges from a target up to the common ancestor, and from a source up to it."""


class Tf:
    """Transforms between frames, looked up at a time of the recording.

    where: what they came from, for messages. limits: how far apart transforms may be, and how long the last one holds.
    unreadable: how many messages of transforms could not be read.

    Where several parents of one frame are named, one with a fixed transform counts, else the one that is named most
    often, else the first; `notes` tells. Transforms that are none (see `is_motion`), or that put a frame into itself,
    are left out, as tf2 does it.
    """

    edge: ClassVar[type[Edge]] = Edge
    """What a frame's places in its parent are kept in."""

    def __init__(self, where: str = "tf", limits: Limits | None = None):
        self.where, self.limits, self.unreadable = where, limits or Limits(), 0
        self._parents: dict[str, dict[str, Edge]] = {}
        self._ways: dict[tuple[str, str], Way] = {}
        self._left_out = 0

    def add(self, parent: str, child: str, stamp_ns: int, numbers: Iterable[float], fixed: bool = False) -> None:
        """Take in where `child` stood in `parent` at a time, or always: tx ty tz in metres, quaternion qx qy qz qw.

        In any order. Of several with one time the first counts, of several fixed ones the last.
        """
        row, parent, child = tuple(map(float, numbers)), frame_name(parent), frame_name(child)
        if not (parent and child and parent != child and is_motion(row)):
            self._left_out += 1
        elif fixed:
            self.add_fixed(parent, child, from_quaternion(row[:3], row[3:]))
        else:
            self._edge(parent, child).add(stamp_ns, row)

    def add_fixed(self, parent: str, child: str, T_parent_child: Transform) -> None:
        """Take in where `child` always stands in `parent`, (4, 4)."""
        self._edge(parent, child).fix(T_parent_child)

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of all frames, sorted."""
        return tuple(sorted({*self._parents, *(parent for edges in self._parents.values() for parent in edges)}))

    @property
    def notes(self) -> tuple[str, ...]:
        """What had to be decided or left out, one line each."""
        torn = {child: self._up(child) for child, edges in sorted(self._parents.items()) if len(edges) > 1}
        notes = [
            f"{self.where}: {child} has several parents ({', '.join(self._parents[child])}); {edge.parent} counts"
            for child, edge in torn.items()
            if edge
        ]
        if self._left_out:
            notes.append(f"{self.where}: {self._left_out} transforms are none and were left out")
        if self.unreadable:
            notes.append(f"{self.where}: {self.unreadable} messages cannot be read and were left out")
        return tuple(notes)

    def lookup(self, target: str, source: str, stamp_ns: int) -> Transform:
        """Return T_target_source (4, 4) at a time in int64 nanoseconds.

        Raises FrameRefused `no_pose`, one line: an unknown frame, frames that nothing connects or that go round in a
        loop, a gap in time (see `Edge.at`).
        """
        up, down = self._way(frame_name(target), frame_name(source))
        return inverse(self._along(up, stamp_ns)) @ self._along(down, stamp_ns)

    def off_ns(self, target: str, source: str, stamp_ns: int) -> int:
        """Return how far `lookup` extrapolates; raises FrameRefused as it does for frames that nothing connects."""
        up, down = self._way(frame_name(target), frame_name(source))
        return max((edge.off_ns(int(stamp_ns)) for edge in (*up, *down)), default=0)

    def connected(self, target: str, source: str) -> bool:
        """Tell whether both frames are there and some way connects them."""
        try:
            self._way(frame_name(target), frame_name(source))
        except FrameRefused:
            return False
        return True

    def moving(self, target: str, source: str) -> bool:
        """Tell whether one frame was seen to move in the other; raises FrameRefused where nothing connects them."""
        return any(edge.moves for part in self._way(frame_name(target), frame_name(source)) for edge in part)

    def root(self, frame: str) -> str:
        """Return the frame that has no parent, above `frame`; raises FrameRefused for an unknown frame and a loop."""
        chain = self._chain(frame_name(frame))
        return chain[-1].parent if chain else frame_name(frame)

    def _edge(self, parent: str, child: str) -> Edge:
        self._ways.clear()
        parent, child = frame_name(parent), frame_name(child)
        edges = self._parents.setdefault(child, {})
        if parent not in edges:
            edges[parent] = self.edge(parent, child)
        return edges[parent]

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
                raise FrameRefused("no_pose", f"{self.where}: frames go round in a loop: {loop}; correct their parents")
            seen.append(edge.parent)
        return tuple(chain)

    def _way(self, target: str, source: str) -> Way:
        if (target, source) not in self._ways:
            up, down = self._chain(target), self._chain(source)
            roots = [chain[-1].parent if chain else frame for chain, frame in ((up, target), (down, source))]
            if roots[0] != roots[1]:
                parts = " and ".join(
                    f"{frame} (root {root})" for frame, root in zip((target, source), roots, strict=True)
                )
                raise FrameRefused("no_pose", f"{self.where}: nothing connects {parts}; record what joins them")
            while up and down and up[-1] is down[-1]:
                up, down = up[:-1], down[:-1]
            self._ways[target, source] = up, down
        return self._ways[target, source]

    def _along(self, edges: tuple[Edge, ...], stamp_ns: int) -> Transform:
        """Return T_ancestor_frame of the edges from a frame up to its ancestor."""
        T = np.eye(4)
        for edge in edges:
            T = edge.at(int(stamp_ns), self.limits, self.where) @ T
        return T
