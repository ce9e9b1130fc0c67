# SPDX-License-Identifier: Apache-2.0
"""Recordings and cameras whose poses are tracked: the frames of a source with the poses of a `Tracker`."""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import replace
from itertools import islice
from typing import Protocol, TypeVar

import numpy as np

from stereovox.errors import SourceError
from stereovox.frame import AnyFrame, name_of
from stereovox.kernels.threads import expecting
from stereovox.sources.base import Stream, closing
from stereovox.track.fit import LOST, deviations
from stereovox.track.tracker import POSE_FAULTS, Tracked

FrameT = TypeVar("FrameT", bound=AnyFrame)
CURE = "move slower, or back to what was seen before"


class AnyTracker(Protocol):
    """Finds the pose of each frame in turn: `Tracker`, `GuidedTracker`."""

    def add(self, frame: AnyFrame, /) -> Tracked:
        """Return the pose of a frame."""
        ...

    def expect(self, frame: AnyFrame, /) -> None:
        """Start to prepare a frame before the earlier ones have been added."""
        ...


class TrackedStream(Stream):
    """The frames of a recording or camera with tracked poses; frames have a fault while tracking is lost.

    The first image is held back until the next one fits it, and then has the start pose. Lost frames have the fault
    `tracking_lost` and pose NaN. Tracking is deterministic: each iteration starts afresh and finds the same poses.

    Args:
        source: The frames.
        make: Returns a new tracker.
        how: How poses are found, for the name.
        skip: Frames at the start that are tracked but not delivered.

    Attributes:
        name: The source's name plus `, tracked`: its map is not in the world of its own poses.
    """

    def __init__(self, source: Stream, make: Callable[[], AnyTracker], how: str = "tracked", skip: int = 0):
        self.name, self.camera, self.notes = f"{source.name}, {how}", source.camera, tuple(source.notes)
        self._source, self._make, self._how, self._skip = source, make, how, skip

    @property
    def length(self) -> int | None:
        """Number of frames; None for a live camera."""
        return None if self._source.length is None else self._source.length - self._skip

    @property
    def dropped(self) -> int:
        """Frames that a live camera delivered but that were not consumed in time."""
        return self._source.dropped

    def after(self, count: int) -> Stream:
        """Return the frames from number `count` on; earlier ones are tracked again to know the camera's pose.

        Raises:
            SourceError: There are too few, or this is a live camera, whose past images are gone.
        """
        if self.length is None:
            raise SourceError(f"{self.name}: a live camera does not know where it is in an older map; begin a new one")
        if count >= self.length:
            raise SourceError(f"{self.name}: has no more than {self.length} frames; skip fewer than {count}")
        return TrackedStream(self._source, self._make, self._how, self._skip + count)

    def __iter__(self) -> Iterator[AnyFrame]:
        tracker = self._make()
        frames = self._source if self.length is None else expecting(tracker.expect, self._source)
        with closing(follow(frames, tracker)) as found:
            yield from (frame for frame, _ in islice(found, self._skip, None))


def follow(frames: Iterable[AnyFrame], tracker: AnyTracker) -> Generator[tuple[AnyFrame, Tracked]]:
    """Yield each frame with its tracked pose or a fault, and the tracker's report.

    The image that the tracker begins with is yielded once the next one is tracked or lost.

    Args:
        frames: The frames, in the order they were taken; frames with a faulty image are passed on unchanged, and are
            lost.
        tracker: Finds the poses.
    """
    waiting: tuple[AnyFrame, Tracked] | None = None
    with closing(frames) as images:
        for frame in images:
            tracked = _track(frame, tracker)
            if waiting is not None:
                yield _begun(*waiting, why=tracked.lost)
            waiting = (frame, tracked) if tracked.begins else None
            if waiting is None:
                yield posed(frame, tracked), tracked
        if waiting is not None:
            yield _begun(*waiting, why=waiting[1].lost)


def posed(frame: FrameT, tracked: Tracked) -> FrameT:
    """Return a frame with the pose that was tracked, or with the fault `tracking_lost`; unchanged if faulty."""
    if _is_faulty(frame):
        return frame
    if not tracked.lost:
        sigma = deviations(tracked.covariance)
        T = tracked.T_world_sensor
        return replace(frame, T_world_sensor=T, pose_off_ns=0, pose_sigma=sigma, fault=None, fault_detail="")
    name = name_of(frame)
    detail = f"{tracked.lost if name in tracked.lost else f'{name}: {tracked.lost}'}; {CURE}"
    return replace(frame, T_world_sensor=np.full((4, 4), np.nan), pose_off_ns=0, fault=LOST, fault_detail=detail)


def _track(frame: AnyFrame, tracker: AnyTracker) -> Tracked:
    if _is_faulty(frame):
        return Tracked(np.full((4, 4), np.nan), np.full((6, 6), np.inf), frame.fault_detail or str(frame.fault))
    return tracker.add(frame)


def _begun(frame: AnyFrame, tracked: Tracked, why: str) -> tuple[AnyFrame, Tracked]:
    """Return the image that the map began with, with the start pose, or lost because the next one is (`why`)."""
    found = replace(tracked, lost=why) if why else replace(tracked, covariance=np.zeros((6, 6)), lost="", begins=False)
    return posed(frame, found), found


def _is_faulty(frame: AnyFrame) -> bool:
    """Return whether the image itself cannot be used."""
    return frame.fault is not None and frame.fault not in POSE_FAULTS
