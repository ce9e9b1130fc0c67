# SPDX-License-Identifier: Apache-2.0
"""Tracking gaps: spans of frames without a pose."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from stereovox.frame import AnyFrame, UpdateReport


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
