# SPDX-License-Identifier: Apache-2.0
"""Cost estimate of a fleet's run, from a few frames of each recording; nothing is written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np

from stereovox.config import Config, load_config
from stereovox.errors import StereovoxError
from stereovox.fleet.fleet import box_side, settings_for
from stereovox.fleet.recordings import COPY, POSES, Recording, Recordings, boxes_with, local, recordings_of, why_not
from stereovox.mapper import Mapper
from stereovox.maps.storage.boxes import BoxLayout
from stereovox.opening import open_source
from stereovox.sources.poses.trajectory import Trajectory

LOOKED_AT = 24
"""Frames sampled from a recording, evenly chosen; the very first compiles and does not count."""


@dataclass(frozen=True)
class FleetPlan:
    """Approximate cost of a run.

    Attributes:
        recordings: Number of readable recordings.
        frames: Number of their frames.
        box_m: Side of a box in metres.
        boxes: Number of boxes that the sampled frames see, a lower bound.
        overlap: Average number of boxes per frame.
        bytes: Bytes of the depth images kept for adding and correcting recordings later.
        core_hours: Hours of a core like one of this machine.
        unreadable: Recordings with unreadable data or poses, and why.
    """

    recordings: int
    frames: int
    box_m: float
    boxes: int
    overlap: float
    bytes: int
    core_hours: float
    unreadable: tuple[str, ...] = ()

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox fleet --plan --json`."""
        doubts = {"doubts": list(self.unreadable)} if self.unreadable else {}
        return {**asdict(self), "frames_read": round(self.frames * self.overlap), **doubts}


def plan_fleet(
    recordings: Recordings,
    *,
    profile: str | Path | Config | None = None,
    box_m: float | None = None,
    progress: Callable[[int, int, str], object] = lambda done, total, doing: None,
    **overrides: Any,
) -> FleetPlan:
    """Estimate what `map_fleet` will cost.

    Args:
        recordings: As for `map_fleet`; recordings in object stores are copied, one at a time, to be inspected.
        profile: As for `map_fleet`.
        box_m: As for `map_fleet`.
        progress: Called with recordings done, the total, and the current activity.
        **overrides: Settings by name.

    Returns:
        The estimate.

    Raises:
        StereovoxError: No recording can be read.
    """
    listed = recordings_of(recordings)
    config, _ = settings_for(listed, profile, overrides)
    layout = BoxLayout(config, box_side(box_m, config))
    frames = stored = 0
    seconds, seen, unreadable = 0.0, [], []
    for n, one in enumerate(listed, 1):
        with TemporaryDirectory(prefix="stereovox-") as folder:
            try:
                length, rows, each_s, each_bytes = _looked_at(one, layout, Path(folder))
            except Exception as error:
                unreadable.append(f"{one.where}: {why_not(one, error, Path(folder))}")
                continue
            finally:
                progress(n, len(listed), "inspecting recordings")
        frames, stored, seconds = frames + length, stored + length * each_bytes, seconds + length * each_s
        seen.append((one.where, rows, length))
    if not seen:
        raise StereovoxError(f"no recording can be read ({unreadable[0]})")
    boxes = {tuple(box) for _, rows, _ in seen for box in rows[:, 1:].tolist()}
    overlap = sum(length * len(rows) / max(len(np.unique(rows[:, 0])), 1) for _, rows, length in seen) / frames
    hours = seconds * (1 + overlap) / 3600
    side_m = float(layout.metres.max())
    return FleetPlan(len(seen), frames, side_m, len(boxes), overlap, round(stored), hours, tuple(unreadable))


def _looked_at(recording: Recording, layout: BoxLayout, folder: Path) -> tuple[int, np.ndarray, float, float]:
    """Return the number of frames, boxes that a sample sees (as `boxes_seen`), and seconds and bytes per frame."""
    if recording.poses is not None:
        Trajectory(Path(local(recording.poses, folder / POSES)))  # raises if the run could not read it
    source = open_source(local(recording.where, folder / COPY))
    step = max(1, len(source) // LOOKED_AT)
    mapper = Mapper(load_config(layout.config, **{"map.keep_frames": True, "trust.max_disagreement": 1}))
    times, seen = [], []
    mapper.map.listeners.append(lambda evidence: seen.append(boxes_with(layout, evidence)))
    for i in range(0, len(source), step):
        started = perf_counter()
        mapper.add(source.frame(i))
        times.append(perf_counter() - started)
    kept = mapper.map.kept_frames
    if kept is None or not len(kept):
        raise StereovoxError("none of the sampled frames can be used")
    rows = np.concatenate([np.insert(boxes, 0, n, axis=1) for n, boxes in enumerate(seen)])
    return len(source), rows, float(np.median(times)), kept.bytes / len(kept)
