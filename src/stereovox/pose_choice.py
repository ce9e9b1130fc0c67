# SPDX-License-Identifier: Apache-2.0
"""Which poses a run uses: those that a recording has, or tracked ones."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stereovox import opening
from stereovox.errors import NoPoses, StereovoxError, did_you_mean
from stereovox.sources.base import Stream
from stereovox.track.stream import POSE_FAULTS

GIVEN, TRACK = "given", "track"
CHOICES = (GIVEN, TRACK)
LOOKED_AT = 10
"""Frames, spread over a recording, of which one must have a pose, or it has none."""


class Choice(NamedTuple):
    """A source, and whether its poses are to be tracked; `why` says so, for a note, where nobody chose it."""

    source: Stream
    tracked: bool
    why: str = ""


def choose_poses(source: str | Path | Stream, frames: str | None, poses: str | None) -> Choice:
    """Open a source for the poses that were chosen.

    Args:
        source: As for `open_stream`, or a stream that is open.
        frames: Python slice that selects frames of what is opened here.
        poses: `given`: those of the recording. `track`: from the images; those of the recording are not read. None:
            given where there are any, else tracked.

    Raises:
        StereovoxError: As `open_stream`; an unknown choice; `given` where there are none.
    """
    if poses not in (None, *CHOICES):
        raise StereovoxError(f"poses '{poses}' is unknown{did_you_mean(str(poses), CHOICES)}; give given or track")
    if not isinstance(source, str | Path):
        missing = "" if poses == GIVEN else _missing(source)
        return Choice(source, poses == TRACK or bool(missing), missing if poses is None else "")
    if poses == TRACK:
        return Choice(opening.open_images(source, frames), True)
    try:
        found = opening.open_stream(source, frames)
    except NoPoses as error:
        missing = str(error)
        if poses == GIVEN:
            raise
    else:
        missing = "" if poses == GIVEN else _missing(found)
        if not missing or found.length is None:  # a live camera is opened once
            return Choice(found, bool(missing), missing)
    return Choice(opening.open_images(source, frames), True, missing)


def _missing(source: Stream) -> str:
    """Return why a source has no poses, empty where it has some."""
    read = getattr(source, "frame", None)
    if read is None or not source.length:
        return "" if getattr(source, "posed", True) else f"{source.name}: no poses; add ?pose=fixed if the camera stands still"
    why = ""
    for i in np.unique(np.linspace(0, source.length - 1, min(LOOKED_AT, source.length)).astype(int)).tolist():
        frame = read(i)
        if frame.fault is None and np.isfinite(frame.T_world_sensor).all():
            return ""
        if frame.fault is not None and frame.fault not in POSE_FAULTS:
            continue
        why = why or frame.fault_detail or f"{source.name}: has no poses"
    return why
