# SPDX-License-Identifier: Apache-2.0
"""Recordings and cameras whose poses are tracked: the frames of a source with the poses of a `Tracker`.

Tracking gaps: spans of frames without a pose. The frames' own poses, corrected by tracking.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from itertools import islice
from typing import Any, Protocol, TypeVar

import numpy as np

from stereovox.config import Config
from stereovox.errors import SourceError
from stereovox.frame import AnyFrame, UpdateReport, name_of
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error
from stereovox.kernels.threads import expecting
from stereovox.sources.base import Stream, closing
from stereovox.track.fit import LOST, RIGID, deviations
from stereovox.track.tracker import POSE_FAULTS, Tracked, Tracker


@dataclass(frozen=True)
class TrackingGap:
    """Consecutive frames without a pose.

    Attributes:
        first: Index of the first frame, from 0.
        last: Index of the last frame.
        begin_ns: Time of the first frame in nanoseconds.
        end_ns: Time of the last frame.
        why: Why the first frame was lost, in words.
    """

    first: int
    last: int
    begin_ns: int
    end_ns: int
    why: str

    def __len__(self) -> int:
        return self.last - self.first + 1

    def line(self) -> str:
        """Return one line for a user."""
        if self.first == self.last:
            return f"lost in frame {self.first}: {self.why}"
        seconds = (self.end_ns - self.begin_ns) / 1e9
        return f"lost from frame {self.first} to {self.last} ({seconds:.1f} s): {self.why}"

    def as_dict(self) -> dict[str, Any]:
        """Return the span for JSON."""
        return asdict(self)


class LostSpans:
    """Collects the tracking gaps of a run, frame by frame; can observe a mapping run.

    Args:
        number: Index of the first frame.

    Attributes:
        spans: The spans so far.
        frames: Number of frames so far.
    """

    def __init__(self, number: int = 0):
        self.spans: list[TrackingGap] = []
        self.frames, self._number = 0, number

    @property
    def lost(self) -> int:
        """Number of frames that were lost so far."""
        return sum(map(len, self.spans))

    def add(self, stamp_ns: int, why: str) -> None:
        """Record the next frame; `why` is empty if it was tracked."""
        number = self._number + self.frames
        self.frames += 1
        if not why:
            return
        if self.spans and self.spans[-1].last == number - 1:
            self.spans[-1] = replace(self.spans[-1], last=number, end_ns=stamp_ns)
        else:
            self.spans.append(TrackingGap(number, number, stamp_ns, stamp_ns, why))

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Record a frame that was offered to the map; a frame with a fault was not tracked."""
        self.add(frame.stamp_ns, report.detail if frame.fault else "")


NO_START = "no frame so far has a pose of its own, at which the map could begin"


class GuidedTracker:
    """A tracker that predicts motion from the frames' own poses and corrects it by registration to known surfaces.

    Its world starts as the world of the frames' own poses and departs from it as they drift. A frame without a pose
    is tracked by its image alone.

    Args:
        config: Settings by which depth is prepared, as for the map.

    Attributes:
        prior_only_frames: Frames placed by their own motion alone, because nothing known was in view.
    """

    def __init__(self, config: Config):
        self.prior_only_frames = 0
        self._config, self._tracker = config, Tracker(config)
        self._T_world_tracker: Transform | None = None
        self._own: Transform | None = None  # own pose of the last frame the tracker used
        self._at = np.full((4, 4), np.nan)

    def add(self, frame: AnyFrame) -> Tracked:
        """Return the pose of a frame, as `Tracker.add`.

        Args:
            frame: Depth image or stereo pair, with its own pose; a pose that is not rigid counts as missing.
        """
        own = _own_pose(frame)
        if own is None and self._T_world_tracker is None:
            return Tracked(self._at, np.full((6, 6), np.inf), NO_START)
        known = None if own is None or self._own is None else inverse(self._own) @ own
        tracked = self._tracker.add(frame, known)
        if not np.array_equal(tracked.T_world_sensor, self._at):  # else its image was unusable
            self._at, self._own = tracked.T_world_sensor, own
            if own is None and self._T_world_tracker is not None and not tracked.lost:
                self._own = self._T_world_tracker @ tracked.T_world_sensor
        self.prior_only_frames += tracked.believed
        if tracked.begins:
            self._begin(own)
        if self._T_world_tracker is None:
            return replace(tracked, lost=NO_START)
        return tracked.moved(self._T_world_tracker)

    def expect(self, frame: AnyFrame) -> None:
        """Start to prepare the next frame, as `Tracker.expect`."""
        self._tracker.expect(frame)

    def picture_use(self) -> str:
        """Return how the color images were used so far, in words; "" if there are none."""
        return self._tracker.picture_use()

    def _begin(self, own: Transform | None) -> None:
        """Place the tracker's world by the own pose of the image that its map began with."""
        self._own = own
        self._T_world_tracker = None if own is None else own @ inverse(self._at)
        if own is None:
            self._tracker, self._at = Tracker(self._config), np.full((4, 4), np.nan)


def _own_pose(frame: AnyFrame) -> Transform | None:
    T = frame.T_world_sensor
    return orthonormalise(np.asarray(T, float)) if T is not None and rigidity_error(T) < RIGID else None


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
