# SPDX-License-Identifier: Apache-2.0
"""Merge maps: exactly, by their frames, if both kept them; else by adding their evidence."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from stereovox.config import Config
from stereovox.correct.loops.closer import LoopCloser, check_one_way, ends_of
from stereovox.correct.loops.placing import placed
from stereovox.errors import StereovoxError
from stereovox.frame import Progress, no_progress
from stereovox.frame.validate import MAX_POSITION
from stereovox.geometry.se3 import Transform
from stereovox.kernels.threads import one_state
from stereovox.mapping.deadline import Levels
from stereovox.mapping.rebuild import Rebuild, as_corrected, need_frames
from stereovox.maps import VoxelMap
from stereovox.maps.record.camera_path import LoopLines
from stereovox.maps.record.kept_frames import KeptFrame, KeptFrames
from stereovox.maps.storage.storage import settings_of_frames
from stereovox.products.blocks import check_alike
from stereovox.products.edit import merge as added
from stereovox.products.edit import together
from stereovox.products.moved import rigid

OF_WORLD = {"up", "levelled_from"}
"""Settings that may differ if a transform between the worlds is given."""


@dataclass(frozen=True, eq=False)
class Joined:
    """Result of `join`.

    Attributes:
        map: The map from the frames of both; it keeps them.
        T_a_b: (4, 4) from the second map's world to the first one's, as found before both were corrected.
        found: Number of places at which it was found.
        loops: Number of loops in and between both that the corrected poses satisfy.
    """

    map: VoxelMap
    T_a_b: Transform
    found: int
    loops: int


@one_state
def join(a: VoxelMap, b: VoxelMap, progress: Progress = no_progress) -> Joined:
    """Align a second map with the first by their common view, and make one map from both.

    The trajectories of both cameras become one pose graph, in which loops are closed and overlapping submaps are
    registered to each other; then all frames are mapped at the resulting poses, in the order of their stamps. The first
    frame of `a` stays fixed.

    Args:
        a: A map that kept all its frames, whose settings the result has.
        b: Another one, made with the same settings; its world may be anywhere, with the same up direction.
        progress: Called with the number done, the total, and the current step.

    Returns:
        The map, and the transform.

    Raises:
        StereovoxError: Frames were not kept, settings differ, or the transform cannot be found with certainty.
        MissingExtra: gtsam is not installed.
    """
    check_alike(a, b, np.eye(4))
    why = why_added(a, b, np.eye(4))
    if why is not None or a.kept_frames is None or b.kept_frames is None:
        raise StereovoxError(f"the transform between maps can be found only from frames, and {why}")
    check_one_way(a.history, a.kept_frames.frames)
    check_one_way(b.history, b.kept_frames.frames)
    closers = [_closed(one, words, progress) for one, words in ((a, "first"), (b, "second"))]
    first, second = closers
    place = placed(first, second, lambda done, total: progress(done, total, "locating the second map in the first"))
    count = len(first.submaps)
    first.join(second, place.T_first_second, place.loops)
    first.finish(lambda done, total: progress(done, total, "registering places"))
    poses = [first.corrected(slice(0, count)), first.corrected(slice(count, None))]
    frames = [
        [replace(frame, T_world_sensor=found[frame.sensor, frame.stamp_ns]) for frame in kept.frames]
        for kept, found in zip((a.kept_frames, b.kept_frames), poses, strict=True)
    ]
    joined = _of_frames(a, b, *frames)
    joined.recording = as_corrected(joined.recording)
    if _follow(*frames):
        joined.history.recordings = 1
    joined.history.loops = LoopLines.between(*(ends_of(found, first.places) for found in (first.loops, first.refused)))
    return Joined(joined, place.T_first_second, len(place.loops), len(first.loops))


def _follow(a: Sequence[KeptFrame], b: Sequence[KeptFrame]) -> bool:
    """Return whether all frames of one recording precede all of the other's, so that both are one trajectory."""
    (first_a, last_a), (first_b, last_b) = (
        (min(stamps), max(stamps)) for stamps in ([frame.stamp_ns for frame in frames] for frames in (a, b))
    )
    return last_a < first_b or last_b < first_a


def _closed(one: VoxelMap, words: str, progress: Progress) -> LoopCloser:
    """Return a whole recording, its loops closed."""
    assert one.kept_frames is not None
    closer, frames = LoopCloser(one.config), one.kept_frames.frames
    for done, frame in enumerate(frames, 1):
        closer.add(frame)
        progress(done, len(frames), f"looking for loops in the {words} map")
    closer.finish()
    return closer


@one_state
def merge(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> VoxelMap:
    """Merge two maps.

    If both kept all their frames (`map.keep_frames`) the result is bit for bit the map of one run over both, in the
    order of their stamps, with the poses of `b` brought into the frame of `a`; it keeps the frames of both. A frame in
    both, as from overlapping parts of a recording, counts once, with its pose in `a`. Otherwise (`why_added` gives the
    reason) their evidence adds up: see `edit.merge`. Cells that had reached their limits may then differ from those
    of one run.


    Args:
        a: A map, whose settings the result has.
        b: Another map.
        T_a_b: (4, 4), maps the world frame of `b` into that of `a`; None if they are the same.

    Returns:
        An unbounded map.

    Raises:
        StereovoxError: The cell sizes differ, T_a_b is not a rigid motion, or there is none and the maps' `up` differs.
        MapFileError: Kept frames of a loaded map are gone from the disk.
    """
    check_alike(a, b, T_a_b)
    if why_added(a, b, T_a_b) is not None:
        return added(a, b, T_a_b)
    return _by_frames(a, b, np.eye(4) if T_a_b is None else rigid(T_a_b))


def why_added(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> str | None:
    """Return why two maps are merged by adding evidence, which is not exact; None if by their frames.

    Args:
        a: A map.
        b: Another map.
        T_a_b: As for `merge`.

    Returns:
        A phrase for people: `a map did not keep its frames`.
    """
    for one in (a, b):
        if one.kept_frames is None or not len(one.kept_frames):
            return "a map did not keep its frames"
        if not one.kept_frames.are_all(one.frames):
            return "a map kept only some of its frames"
        if one.config.window.size is not None or one.config.max_memory is not None:
            return "a map was made within bounds (window, max_memory)"
    differing = _differing(a.config, b.config, set() if T_a_b is None else OF_WORLD)
    return None if differing is None else f"they were made with different settings ({differing})"


def frames_in_both(a: VoxelMap, b: VoxelMap) -> int:
    """Return the number of kept frames common to two maps; `merge` counts them once.

    Raises StereovoxError if a map did not keep its frames.
    """
    ours, theirs = ({_identity(frame) for frame in need_frames(one.kept_frames, "a map").frames} for one in (a, b))
    return len(ours & theirs)


def _differing(a: Config, b: Config, ignored: set[str]) -> str | None:
    """Return the name of a setting by which two maps would map a frame differently."""
    names = [name for name in ("map", *settings_of_frames(a)) if name not in ignored]
    a = a.model_copy(update={"map": a.map.model_copy(update={"frames_budget": b.map.frames_budget})})
    return next((name for name in names if getattr(a, name) != getattr(b, name)), None)


def _by_frames(a: VoxelMap, b: VoxelMap, T_a_b: Transform) -> VoxelMap:
    """Return the map from the frames of both."""
    assert a.kept_frames is not None
    assert b.kept_frames is not None
    theirs = b.kept_frames.frames
    if not np.array_equal(T_a_b, np.eye(4)):
        theirs = [replace(frame, T_world_sensor=T_a_b @ frame.T_world_sensor) for frame in theirs]
        if np.abs([frame.T_world_sensor for frame in theirs]).max() >= MAX_POSITION:
            raise StereovoxError(f"the transform takes frames {MAX_POSITION:g} m away or farther; give it in metres")
    return _of_frames(a, b, a.kept_frames.frames, theirs)


def _of_frames(a: VoxelMap, b: VoxelMap, ours: Sequence[KeptFrame], theirs: Sequence[KeptFrame]) -> VoxelMap:
    """Return the map from the frames of both, at the given poses; common frames are taken once, from the first."""
    known = set(map(_identity, ours))
    twice = [frame for frame in theirs if _identity(frame) in known]
    theirs = [frame for frame in theirs if _identity(frame) not in known]
    frames = [replace(frame, number=n) for n, frame in enumerate(_in_order(ours, theirs))]
    merged = VoxelMap(a.config)
    merged.history = together(a.history, b.history)
    merged.history.frames = len(frames)
    merged.history.quality -= Counter(frame.quality for frame in twice)
    merged.storage.kept = KeptFrames(a.config.map.frames_budget, frames)
    rebuild = Rebuild(merged.storage, Levels(a.config), {}, whole=True)
    rebuild.catch_up()
    rebuild.finish()
    return merged


def _identity(frame: KeptFrame) -> tuple[str, int, str]:
    """Return what identifies a frame in two maps of one recording, whatever its pose."""
    return frame.sensor, frame.stamp_ns, frame.packed.digest


def _in_order(a: Sequence[KeptFrame], b: Sequence[KeptFrame]) -> list[KeptFrame]:
    """Return the frames of both maps by their stamps, each map's in the order in which it added them."""
    result: list[KeptFrame] = []
    left, right = deque(a), deque(b)
    while left and right:
        result.append((left if left[0].stamp_ns <= right[0].stamp_ns else right).popleft())
    return [*result, *left, *right]
