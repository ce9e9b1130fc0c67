# SPDX-License-Identifier: Apache-2.0
"""Merge maps: by their frames where both kept them, exactly; else by adding up their evidence."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from stereovox.config import Config
from stereovox.deadline import Levels
from stereovox.maps import VoxelMap
from stereovox.maps.kept_frames import KeptFrame, KeptFrames
from stereovox.maps.storage import settings_of_frames
from stereovox.products.merge import merge as added
from stereovox.products.merge import together
from stereovox.products.moved import rigid
from stereovox.products.side_by_side import check_alike
from stereovox.rebuild import Rebuild
from stereovox.se3 import Transform
from stereovox.threads import one_state

OF_WORLD = {"up", "up_direction", "levelled_from"}
"""Settings that may differ where a transform says how the worlds lie."""


@one_state
def merge(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> VoxelMap:
    """Merge two maps.

    Where both kept all their frames (`map.keep_frames`) the result is bit for bit the map of one run over both, in the
    order of their stamps, with the poses of `b` brought into the frame of `a`; it keeps the frames of both. Where they
    cannot be merged so (`why_added` says why), their evidence adds up: see `products.merge`. Cells that had reached
    their limits may then differ from those of one run.

    Args:
        a: A map, whose settings the result has.
        b: Another map.
        T_a_b: (4, 4), maps the world frame of `b` into that of `a`; None where they are the same.

    Returns:
        An unbounded map.

    Raises:
        StereovoxError: The cell sizes differ, T_a_b is not a rigid motion, or there is none and the maps' `up` differs.
        MapFileError: Kept frames of a map that was loaded are gone from the disk.
    """
    check_alike(a, b, T_a_b)
    if why_added(a, b, T_a_b) is not None:
        return added(a, b, T_a_b)
    return _by_frames(a, b, np.eye(4) if T_a_b is None else rigid(T_a_b))


def why_added(a: VoxelMap, b: VoxelMap, T_a_b: ArrayLike | None = None) -> str | None:
    """Return why two maps are merged by adding up, which is not exact; None where they are merged by their frames.

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


def _differing(a: Config, b: Config, ignored: set[str]) -> str | None:
    """Return the name of a setting by which two maps would take in a frame differently."""
    names = [name for name in ("map", *settings_of_frames(a)) if name not in ignored]
    a = a.model_copy(update={"map": a.map.model_copy(update={"frames_budget": b.map.frames_budget})})
    return next((name for name in names if getattr(a, name) != getattr(b, name)), None)


def _by_frames(a: VoxelMap, b: VoxelMap, T_a_b: Transform) -> VoxelMap:
    """Return the map of the frames of both."""
    assert a.kept_frames is not None
    assert b.kept_frames is not None
    theirs = b.kept_frames.frames
    if not np.array_equal(T_a_b, np.eye(4)):
        theirs = [replace(frame, T_world_sensor=T_a_b @ frame.T_world_sensor) for frame in theirs]
    frames = [replace(frame, number=n) for n, frame in enumerate(_in_order(a.kept_frames.frames, theirs))]
    merged = VoxelMap(a.config)
    merged.history = together(a.history, b.history)
    merged.storage.kept = KeptFrames(a.config.map.frames_budget, frames)
    rebuild = Rebuild(merged.storage, Levels(a.config), {}, whole=True)
    rebuild.catch_up()
    rebuild.finish()
    return merged


def _in_order(a: Sequence[KeptFrame], b: Sequence[KeptFrame]) -> list[KeptFrame]:
    """Return the frames of both maps by their stamps, those of each in the order in which it took them in."""
    result: list[KeptFrame] = []
    left, right = deque(a), deque(b)
    while left and right:
        result.append((left if left[0].stamp_ns <= right[0].stamp_ns else right).popleft())
    return [*result, *left, *right]
