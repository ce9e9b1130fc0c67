# SPDX-License-Identifier: Apache-2.0
"""A robot's odometry from a topic of nav_msgs/Odometry."""

from __future__ import annotations

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.bag_files import BagFile
from stereovox.sources.bag_robot_messages import ODOMETRY, StampedTransform, is_motion, read_odometry
from stereovox.sources.bag_scans import check_topic, most
from stereovox.sources.tf_edge import Edge

LOOKS = 5


def odometry_topic(file: BagFile, given: str = "", other: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the topic with the robot's odometry, "" where there is none, and notes.

    given: counts, where it is not ""; other: a topic that is not meant. Of several the one with most messages counts.
    Raises SourceError where the given one does not exist or is none.
    """
    if given:
        check_topic(file, given, (ODOMETRY,), "odom")
        return given, ()
    found = sorted(topic for topic, kind in file.types.items() if kind == ODOMETRY and topic != other)
    if not found:
        return "", ()
    best = most(file, found)
    others = ", ".join(topic for topic in found if topic != best)
    said = f"odometry of {best}, which has most; there is {others} too: say ?odom=/topic or ?truth=/topic for it"
    return best, (f"{file.path}: {said}",) if others else ()


def first_odometry(file: BagFile, topic: str) -> StampedTransform | None:
    """Return the first readable message, None where none of the first few is."""
    for i in range(min(LOOKS, len(file.stamps(topic)))):
        try:
            return read_odometry(file.read(topic, i))
        except (FrameRefused, ValueError):
            continue
    return None


def odometry_edge(file: BagFile, topic: str, parent: str, child: str) -> Edge:
    """Return the poses of a topic as transforms of `child` in `parent`; what cannot be read or is no pose is a gap.

    Raises SourceError where not one pose can be read.
    """
    edge, recorded = Edge(parent, child, topic), file.stamps(topic)
    for i in range(len(recorded)):
        try:
            told = read_odometry(file.read(topic, i))
        except (FrameRefused, ValueError):
            continue
        if is_motion(told.numbers):
            edge.add(told.stamp_ns or int(recorded[i]), told.numbers)
    if not edge.count:
        raise SourceError(f"{file.path}: {topic}: not one pose can be read; name another with ?odom=/topic")
    return edge
