# SPDX-License-Identifier: Apache-2.0
"""Which poses a run uses: the recording's own, or tracked ones."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from stereovox import opening
from stereovox.config import Config, load_config
from stereovox.config.robot import TrustConfig
from stereovox.errors import NoPoses, StereovoxError, did_you_mean, shortened
from stereovox.sources.base import Source, Stream, stream_of
from stereovox.track.tracker import POSE_FAULTS

GIVEN, TRACK, BOTH = "given", "track", "both"
CHOICES = (GIVEN, TRACK, BOTH)
HOW = {TRACK: "tracked", BOTH: "corrected"}
"""Suffix of a recording's name by the poses used, unless they are its own."""
NOT_COMPARED = "scans are not compared with the map, since {why}; set trust.max_disagreement=0.2 to compare them"
MAX_WHY = 150
"""Longest reason that a message repeats."""
INSPECTED = 10
"""Frames, spread over a recording, that are inspected; if none has a pose, the recording counts as having none."""


class Choice(NamedTuple):
    """A source, and the poses to use: one of `CHOICES`; `why` it is `track`, if nobody chose that."""

    source: Stream
    poses: str
    why: str = ""


def uncompared(config: Config) -> Config:
    """Return settings for scans whose poses drift, or jump when a loop is closed: nothing is compared.

    Unchanged if the user has set `trust.max_disagreement`.
    """
    if config.trust.max_disagreement != TrustConfig.model_fields["max_disagreement"].default:
        return config
    return load_config(config, **{"trust.max_disagreement": 1})


def choose_poses(source: str | Path | Stream, frames: str | None, poses: str | None) -> Choice:
    """Open a source, and choose which poses to use.

    Args:
        source: As for `open_stream`, or an open stream.
        frames: Python slice that selects frames, if the source is opened here.
        poses: `given`: the recording's own. `track`: from the images; the recording's are not read. `both`: the
            recording's, corrected by the images. None: given if there are any, else tracked.

    Raises:
        StereovoxError: As `open_stream`; an unknown choice; `given` or `both` for a source without poses.
    """
    if poses not in (None, *CHOICES):
        raise StereovoxError(
            f"poses '{poses}' is unknown{did_you_mean(str(poses), CHOICES)}; give given, track or both"
        )
    if not isinstance(source, str | Path):
        return _choice(stream_of(source), poses)
    if poses == TRACK:
        return Choice(opening.open_images(source, frames), TRACK)
    try:
        chosen = _choice(opening.open_stream(source, frames), poses)
    except NoPoses as error:
        if poses is not None:
            raise
        return Choice(opening.open_images(source, frames), TRACK, str(error))
    if chosen.poses == TRACK and poses is None and "poses=" in str(source).partition("?")[2]:
        raise StereovoxError(f"{chosen.why}; correct ?poses=, or give --poses track")  # named, and yet not used
    if chosen.poses != TRACK or chosen.source.length is None:  # a live camera is opened once
        return chosen
    return chosen._replace(source=opening.open_images(source, frames))


def has_poses(source: Stream) -> bool:
    """Return whether an open source has poses: whether any of the inspected frames does."""
    return not _missing(source)


def poses_of(recording: str) -> str:
    """Return the poses with which a map was made (one of `CHOICES`), by the name of its recording."""
    return next((poses for poses, how in HOW.items() if recording.endswith(f", {how}")), GIVEN)


def _choice(source: Stream, poses: str | None) -> Choice:
    """Return the poses to use for an open source; raises NoPoses for `both` if it has none."""
    if poses in (GIVEN, TRACK):
        return Choice(source, poses)
    missing = _missing(source)
    if missing and poses == BOTH:
        raise NoPoses(f"{missing}; give track instead")
    return Choice(source, TRACK, missing) if missing else Choice(source, poses or GIVEN)


def _missing(source: Stream) -> str:
    """Return why a source has no poses, empty if it has some."""
    if not isinstance(source, Source) or not len(source):
        return "" if source.posed else f"{source.name}: no poses; add ?pose=fixed if the camera stands still"
    faults = list[str]()
    for i in np.unique(np.linspace(0, len(source) - 1, min(INSPECTED, len(source))).astype(int)).tolist():
        frame = source.frame(i)
        if frame.fault is None and np.isfinite(frame.T_world_sensor).all():
            return ""
        if frame.fault is None or frame.fault in POSE_FAULTS:
            faults.append("" if frame.fault is None else frame.fault_detail)
    if not faults:
        return ""
    why = shortened(faults[len(faults) // 2], MAX_WHY)
    return f"{source.name}: none of the frames inspected has a pose{f' ({why})' if why else ''}"
