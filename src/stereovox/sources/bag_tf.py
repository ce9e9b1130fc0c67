# SPDX-License-Identifier: Apache-2.0
"""The tree of frames in a recording: /tf and /tf_static."""

from __future__ import annotations

from dataclasses import dataclass

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry import Transform
from stereovox.sources.bag_files import BagFile
from stereovox.sources.bag_robot_messages import TF_TYPES, frame_name, read_transforms
from stereovox.sources.tf import Tf
from stereovox.sources.tf_edge import Limits

WORLDS = ("map", "odom")
"""Frames taken for the world, the first that is there: REP 105."""


def tf_topics(file: BagFile) -> list[str]:
    """Return `/tf` and `/tf_static`, or where there is neither those of a namespace (`/robot/tf`)."""
    found = sorted(topic for topic, kind in file.types.items() if kind in TF_TYPES)
    return [topic for topic in found if topic in ("/tf", "/tf_static")] or found


def read_tf(file: BagFile, limits: Limits | None = None) -> Tf | None:
    """Return the transforms of a recording, None where it has no topic of them.

    What stands in a topic named `tf_static` counts at all times. Messages that cannot be read are left out: what they
    would have told is then a gap.
    """
    topics = tf_topics(file)
    if not topics:
        return None
    tf = Tf(f"{file.path} /tf", limits)
    for topic in topics:
        fixed = topic.endswith("tf_static")
        for i in range(len(file.stamps(topic))):
            try:
                told = read_transforms(file.read(topic, i))
            except (FrameRefused, ValueError):
                tf.unreadable += 1
                continue
            for one in told:
                tf.add(one.parent, one.child, one.stamp_ns, one.numbers, fixed)
    return tf


@dataclass(frozen=True)
class TfPoses:
    """Poses of frame `body` in frame `world`, looked up in the tree when they are asked for."""

    tf: Tf
    world: str
    body: str

    @property
    def where(self) -> str:
        """What the poses came from, for messages."""
        return f"{self.tf.where} ({self.world} -> {self.body})"

    def at(self, stamp_ns: int) -> Transform:
        """Return T_world_body at a time; raises FrameRefused `no_pose` (see `Tf.lookup`)."""
        return self.tf.lookup(self.world, self.body, stamp_ns)

    def off_ns(self, stamp_ns: int) -> int:
        """Return how far the pose at a time is extrapolated."""
        return self.tf.off_ns(self.world, self.body, stamp_ns)


def tf_poses(tf: Tf, body: str, world: str = "") -> TfPoses | str:
    """Return the poses of frame `body` in `world`, or in one line why there are none.

    world: "" for `map`, else `odom`, where it is connected with `body`, else the root of its tree if it moved there.
    Raises SourceError where a `world` that is given is not connected with `body`.
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
    return f"{tf.where}: tells how {body} is mounted on {name}, not where that was"
