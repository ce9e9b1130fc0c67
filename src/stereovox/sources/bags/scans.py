# SPDX-License-Identifier: Apache-2.0
"""Topics of a ground robot in a recording: scans, or point clouds instead, and odometry."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from math import inf, isfinite
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.sources.bags.files import BagFile
from stereovox.sources.bags.robot_messages import (
    CLOUDS,
    LASER_SCAN,
    ODOMETRY,
    RANGE,
    LaserScan,
    PointCloud,
    RangeReading,
    StampedTransform,
    frame_name,
    is_motion,
    read_laser_scan,
    read_odometry,
    read_point_cloud,
    read_range,
)
from stereovox.sources.bags.tf import Edge

ScanT = TypeVar("ScanT")
SAMPLED = 5
"""Scans that are read for the notes."""
SURVEYED = 20
"""Scans, spread over a recording, in which a mark of "no echo" is sought."""
TOP, GAP, SPIKE, FEWEST = 0.998, 0.75, 0.005, 20
"""Marks of "no echo" are within 0.2 % of the largest range; this share of the beams, and so many of them at least, are
there, and not one between three quarters of that range and it."""
CONSTANT, STEPS = 0.95, 3
"""Share of these that are the same number in scans whose limits are known, although these 0.2 % hold several steps of
the ranges: the wall behind a door is seen from different places, with noise."""
MAX_ATTEMPTS = 5
"""Messages tried before a topic counts as unreadable."""


class ScanTopic:
    """Scans, clouds or ranges of one topic in order of recording.

    frame_id: frame of the first readable one, "" if unnamed.
    """

    def __init__(self, file: BagFile, topic: str, range_max: float = 0.0):
        self.path, self.topic, self.is_cloud = file.path, topic, file.types[topic] in CLOUDS
        self._file, self._range_max = file, range_max
        self._stamps, self._kind = file.stamps(topic), file.types[topic]
        self._period_s = float(np.median(np.diff(self._stamps))) * 1e-9 if len(self._stamps) > 1 else 0.0
        self.frame_id = frame_id_of(file, topic)

    def __len__(self) -> int:
        return len(self._stamps)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of the ranges, by the first scans; each is one line."""
        scans: list[LaserScan] = []
        for i in range(min(SAMPLED, len(self))):
            with suppress(FrameRefused):
                scans += [scan for scan in [self.read(i)] if isinstance(scan, LaserScan)]
        beyond = sum(scan.beyond for scan in scans)
        if not beyond:
            return self._note_of_mark()
        share = f"{100 * beyond / sum(len(scan.ranges) for scan in scans):.0f} % of the ranges of {self.topic}"
        cure = f"if they mean that nothing is there, give ?range_max={scans[0].range_max:g}"
        note = f"{self.path}: {share} are beyond its range_max and are discarded; {cure}"
        return (note, *self._note_of_mark())

    @property
    def notes_of_times(self) -> tuple[str, ...]:
        """A line if clouds are assumed to be measured at once, or their times are unusual."""
        if not self.is_cloud or not len(self):
            return ()
        try:
            message = self.read(0)
        except FrameRefused:
            return ()
        name = f"{self.path.name} {self.topic}"
        if isinstance(message, PointCloud) and message.times:
            return (f"{name}: times of its points are {message.times}; if that is wrong, add ?deskew=0",)
        if isinstance(message, PointCloud) and message.times_s is None and not message.fault:
            return (f"{name}: its points have no times, so each cloud counts as measured at once",)
        return ()

    def _note_of_mark(self) -> tuple[str, ...]:
        if not isfinite(self._mark):
            return ()
        said = f"ranges of {self.topic} from {self._mark:.4g} m on are taken as a mark of no echo and are discarded"
        return (f"{self.path}: {said}; if they are walls, give the lidar's own ?range_max=METRES",)

    @cached_property
    def _mark(self) -> float:
        """Range from which on ranges are no measurements, although the scans' own limits allow them; inf if none."""
        if self.is_cloud or self._kind == RANGE or self._range_max:
            return inf
        found = list[NDArray[np.float32]]()
        for i in {*np.linspace(0, len(self) - 1, min(SURVEYED, len(self))).astype(int).tolist()}:
            with suppress(ValueError, FrameRefused):
                found.append(read_laser_scan(self._file.read(self.topic, i)).ranges)
        ranges = np.concatenate([one[np.isfinite(one)] for one in found] or [np.empty(0, np.float32)])
        mark = spike_of(ranges)
        values, counts = np.unique(ranges, return_counts=True)
        top = counts[values >= (mark or inf)]
        if not len(top) or len(values) < 2 or np.diff(values).min() > (1 - TOP) / STEPS * values[-1]:
            return inf
        return mark if top.max() >= CONSTANT * top.sum() else inf

    def name(self, i: int) -> str:
        """Return the name of scan `i` for messages."""
        return f"{self.path} {self.topic} message {i}"

    def recorded_ns(self, i: int) -> int:
        """Return the time at which scan `i` was recorded."""
        return int(self._stamps[i])

    def taken_ns(self) -> list[int]:
        """Return the times of all readable scans, ascending."""
        found = set[int]()
        for i in range(len(self)):
            with suppress(FrameRefused, ValueError):
                found.add(self._file.read(self.topic, i).header()[0] or self.recorded_ns(i))
        return sorted(found)

    def read(self, i: int) -> LaserScan | PointCloud | RangeReading:
        """Return scan `i`, with the time of recording if it has none; raises FrameRefused `unreadable`."""
        wire = self._file.read(self.topic, i)
        try:
            if self.is_cloud:
                message = read_point_cloud(wire, self._kind, self._period_s)
            elif self._kind == RANGE:
                message = read_range(wire)
            else:
                message = _without_mark(read_laser_scan(wire, self._range_max), self._mark)
        except ValueError as error:
            raise FrameRefused("unreadable", f"{self.name(i)}: {error}; leave it out") from None
        return replace(message, stamp_ns=message.stamp_ns or self.recorded_ns(i), frame_id=frame_name(message.frame_id))


def spike_of(ranges: NDArray[np.floating]) -> float:
    """Return the range from which on ranges (N,), all finite, are only a mark of "no echo"; 0 if none are."""
    largest = float(ranges.max(initial=0.0))
    top, below = int((ranges >= TOP * largest).sum()), int((ranges >= GAP * largest).sum())
    return TOP * largest if top == below >= max(SPIKE * len(ranges), FEWEST) else 0.0


def _without_mark(scan: LaserScan, mark: float) -> LaserScan:
    if not isfinite(mark):
        return scan
    return replace(scan, ranges=np.where(np.isfinite(scan.ranges) & (scan.ranges >= mark), np.nan, scan.ranges))


class ScanTopics:
    """One or several topics of one kind, in order of recording.

    topics: their names. frame_id: frame of the first, frame_ids: of each, "" if unnamed.
    """

    def __init__(self, file: BagFile, topics: list[str], range_max: float = 0.0):
        self.topics, self._topics = topics, [ScanTopic(file, topic, range_max) for topic in topics]
        self.is_cloud, self.frame_ids = self._topics[0].is_cloud, [one.frame_id for one in self._topics]
        self.frame_id = self.frame_ids[0]
        self._order = sorted(
            (one.recorded_ns(i), number, i) for number, one in enumerate(self._topics) for i in range(len(one))
        )

    def __len__(self) -> int:
        return len(self._order)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of their ranges and times; each is one line."""
        return tuple(note for one in self._topics for note in (*one.notes, *one.notes_of_times))

    def name(self, i: int) -> str:
        """Return the name of scan `i` for messages."""
        return self._at(i, ScanTopic.name)

    def recorded_ns(self, i: int) -> int:
        """Return the time at which scan `i` was recorded."""
        return self._order[i][0]

    def taken_ns(self) -> list[int]:
        """Return the times of all readable scans, ascending."""
        return sorted({stamp_ns for one in self._topics for stamp_ns in one.taken_ns()})

    def topic_of(self, i: int) -> str:
        """Return the topic of scan `i`."""
        return self.topics[self._order[i][1]]

    def read(self, i: int) -> LaserScan | PointCloud | RangeReading:
        """Return scan `i` as `ScanTopic.read` does."""
        return self._at(i, ScanTopic.read)

    def _at(self, i: int, of: Callable[[ScanTopic, int], ScanT]) -> ScanT:
        _, number, k = self._order[i]
        return of(self._topics[number], k)


def find_scans(
    file: BagFile, topic: str = "", range_max: float = 0.0, depth_frame: str = ""
) -> tuple[ScanTopic | None, tuple[str, ...]]:
    """Return the scans of `topic`, else of the topic with most scans, else with most clouds, and notes.

    depth_frame: frame of the depth images; clouds in it are made from them and are ignored. None: no scans.
    Raises SourceError if the named topic does not exist or has no scans.
    """
    if topic:
        check_topic(file, topic, (LASER_SCAN, *CLOUDS), "scan")
        return ScanTopic(file, topic, range_max), ()
    found = _topics_of_type(file, LASER_SCAN)
    if not found:
        clouds = _topics_of_type(file, *CLOUDS)
        found = [name for name in clouds if not depth_frame or frame_id_of(file, name) != frame_name(depth_frame)]
    if not found:
        return None, ()
    best, note = busiest_topic(file, found), ()
    if len(found) > 1:
        others = ", ".join(name for name in found if name != best)
        note = (f"{file.path}: scans of {best}, which has the most; there are {others} too: add ?scan=/topic for them",)
    return ScanTopic(file, best, range_max), note


def check_topic(file: BagFile, topic: str, kinds: Iterable[str], option: str) -> None:
    """Raise SourceError if there is no such topic, or its messages are of another kind."""
    if topic not in file.types:
        raise SourceError(f"{file.path}: no topic {topic} with messages{did_you_mean(topic, file.types)}")
    if file.types[topic] not in (kinds := tuple(kinds)):
        raise SourceError(f"{file.path}: {topic} holds {file.types[topic]}; ?{option}= needs {' or '.join(kinds)}")


def busiest_topic(file: BagFile, topics: list[str]) -> str:
    """Return the topic with the most messages, the first if several are equal."""
    return max(topics, key=lambda topic: len(file.stamps(topic)))


def frame_id_of(file: BagFile, topic: str) -> str:
    """Return the frame in the header of the first readable message of a topic, "" if missing."""
    for i in range(min(MAX_ATTEMPTS, len(file.stamps(topic)))):
        try:
            return frame_name(file.read(topic, i).header()[1])
        except (FrameRefused, ValueError):
            continue
    return ""


def odometry_topic(file: BagFile, given: str = "", other: str = "") -> tuple[str, tuple[str, ...]]:
    """Return the topic with the robot's odometry, "" if missing, and notes.

    given: preferred unless ""; other: a topic to ignore. Of several, the one with the most messages is used. Raises
    SourceError if the given one does not exist or is not odometry.
    """
    if given:
        check_topic(file, given, (ODOMETRY,), "odom")
        return given, ()
    found = sorted(topic for topic, kind in file.types.items() if kind == ODOMETRY and topic != other)
    if not found:
        return "", ()
    best = busiest_topic(file, found)
    others = ", ".join(topic for topic in found if topic != best)
    note = f"odometry of {best}, which has the most; there is {others} too: add ?odom=/topic or ?truth=/topic for it"
    return best, (f"{file.path}: {note}",) if others else ()


def first_odometry(file: BagFile, topic: str) -> StampedTransform | None:
    """Return the first readable message, None if none of the first few is."""
    for i in range(min(MAX_ATTEMPTS, len(file.stamps(topic)))):
        try:
            return read_odometry(file.read(topic, i))
        except (FrameRefused, ValueError):
            continue
    return None


def odometry_edge(file: BagFile, topic: str, parent: str, child: str) -> Edge:
    """Return the poses of a topic as transforms of `child` in `parent`; unreadable messages and invalid poses leave
    gaps.

    Raises SourceError if no pose can be read.
    """
    edge, recorded = Edge(parent, child, topic), file.stamps(topic)
    for i in range(len(recorded)):
        try:
            message = read_odometry(file.read(topic, i))
        except (FrameRefused, ValueError):
            continue
        if is_motion(message.numbers):
            edge.add(message.stamp_ns or int(recorded[i]), message.numbers)
    if not edge.count:
        raise SourceError(f"{file.path}: {topic}: no pose can be read; name another with ?odom=/topic")
    return edge


def _topics_of_type(file: BagFile, *kinds: str) -> list[str]:
    return sorted(topic for topic, known in file.types.items() if known in kinds)
