# SPDX-License-Identifier: Apache-2.0
"""Corrupt good frames in many ways: which does a mapper refuse, and what effect do the others have?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, DepthImage, Frame, Reason, StereoFrame
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mapping.comparison import Comparison
from stereovox.mapping.deadline import full_quality
from stereovox.mapping.gate import Gate, GateResult
from stereovox.maps import State, VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.blocks import CELLS, SIDE

HARMLESS = 1e-3
"""Share of certain cells with evidence whose state a harmless frame may change."""
SURE = 2.0
"""Absolute log-odds of a certain cell."""
WARM = 10
"""Good frames before the first bad one."""
SHIFT_M, TURN_DEG = 0.2, 5.0
SIDES = (("right", "left"), ("down", "up"), ("forward", "back"))
"""Names of both directions along the optical frame's axes x, y and z."""


class Verdict(NamedTuple):
    """Outcome of a bad frame.

    refused: the reason ("" if accepted). changed: share of certain cells with evidence whose state it would change
    differently from the true frame; freed: occupied cells that it, but not the true frame, would free.
    """

    refused: str
    changed: float = 0.0
    freed: int = 0

    @property
    def harmless(self) -> bool:
        """Whether it was accepted, and has no effect."""
        return not self.refused and self.changed < HARMLESS and self.freed == 0


class Trial:
    """A mapper in its parts, to which frames can be offered without being added. settings: of the mapper."""

    def __init__(self, **settings: Any):
        self.config = load_config(**settings)
        self.quality, self.map = full_quality(self.config), make_map(self.config)
        self._gate = Gate(self.config, self.map.history)
        self._comparison = Comparison(self.config, self._gate)

    def add(self, frame: AnyFrame) -> str:
        """Add a frame to the map; return why it was refused, or ""."""
        try:
            image, evidence, passed = self._offer(frame)
        except FrameRefused as refused:
            return refused.reason
        self.map.storage.set_viewpoint(image.viewpoint)
        self.map.add(evidence)
        self.map.history.frames += 1
        self._gate.accept(passed)
        return ""

    def judge(self, bad: AnyFrame, true: AnyFrame) -> Verdict:
        """Return the effect of a bad frame instead of the true one, and leave all unchanged."""
        history = self.map.history
        doubts, waiting = dict(history.doubts), dict(history.waiting)
        try:
            evidence = _kept(self._offer(bad)[1])
        except FrameRefused as refused:
            return Verdict(refused.reason)
        finally:
            history.doubts, history.waiting = doubts, waiting
        return self._effect(evidence, self.quality.integrator.evidence(self._image(true)))

    def _offer(self, frame: AnyFrame) -> tuple[DepthImage, Evidence, GateResult]:
        image = self._image(frame)
        passed = self._gate.check(frame, image)
        evidence = self.quality.integrator.evidence(image)
        return image, evidence, self._comparison.check(frame, image, evidence, passed, self.map)

    def _image(self, frame: AnyFrame) -> DepthImage:
        return self.quality.depth.image(self.quality.depth.matched(frame))

    def _effect(self, bad: Evidence, true: Evidence) -> Verdict:
        coords = np.concatenate([bad.coords, bad.uniform])
        points = self.map.centers(_cells_of(coords))
        said = np.concatenate([bad.values.ravel(), np.repeat(bad.uniform_values, CELLS)])
        points = points[said != 0]
        before, after, truly = self.map, self._with(bad), self._with(true)
        sure = np.abs(before.log_odds(points)) >= SURE
        was, now, should = (one.state(points) for one in (before, after, truly))
        changed = sure & (now != was) & (now != should)
        freed = (was == State.OCCUPIED) & (now == State.FREE) & (should != State.FREE)
        return Verdict("", float(changed.sum() / max(sure.sum(), 1)), int(freed.sum()))

    def _with(self, evidence: Evidence) -> VoxelMap:
        """Return a copy of the map with `evidence` added."""
        copy = self.map.snapshot()
        copy.add(evidence)
        return copy


def trial(source: Iterable[AnyFrame], every: int, seed: int = 0, **settings: Any) -> dict[str, Any]:
    """Map the frames of `source`, and before every N-th of them offer each kind of bad frame instead.

    every: 0 for none. Returns `frames`, `refused` {reason: n} of the good ones, and `bad` {kind: `summary`}.
    """
    tried, random = Trial(**settings), np.random.default_rng(seed)
    verdicts: dict[str, list[Verdict]] = {}
    refused: Counter[str] = Counter()
    before, frames = None, 0
    for frame in source:
        frames += 1
        if every and frames > WARM and frames % every == 0 and before is not None and not frame.fault:
            with suppress(FrameRefused):  # the good frame itself is refused
                matched = tried.quality.depth.matched(frame)
                for kind, bad in bad_frames(frame, matched, before, random):
                    verdicts.setdefault(kind, []).append(tried.judge(bad, frame))
        why = tried.add(frame)
        refused.update([why] if why else [])
        before = before if why else frame
    return {
        "frames": frames,
        "refused": dict(refused),
        "bad": {kind: summary(found) for kind, found in verdicts.items()},
    }


def summary(found: list[Verdict]) -> dict[str, Any]:
    """Return the number of verdicts, and the shares of refused, harmless and other frames."""
    passed = [one for one in found if not one.refused]
    refused, harmless = 1 - len(passed) / len(found), sum(one.harmless for one in passed) / len(found)
    return {
        "frames": len(found),
        "refused": refused,
        "harmless": harmless,
        "left": 1 - refused - harmless,
        "changed": float(np.median([one.changed for one in passed])) if passed else 0.0,
        "reasons": dict(Counter(one.refused for one in found if one.refused)),
    }


def bad_frames(
    frame: AnyFrame, matched: Frame, before: AnyFrame, random: np.random.Generator
) -> Iterator[tuple[str, AnyFrame]]:
    """Yield each kind of bad frame for `frame`; matched: its depth image; before: the frame before it."""
    yield from _bad_depths(matched, random)
    if isinstance(frame, StereoFrame):
        yield from _bad_pairs(frame, random)
    yield "frozen", replace(before, T_world_sensor=frame.T_world_sensor, stamp_ns=frame.stamp_ns)
    nothing = np.zeros(3)
    for axis, sides in zip(np.eye(3), SIDES, strict=True):
        for sign, side in zip((1, -1), sides, strict=True):
            yield f"{100 * SHIFT_M:g} cm {side}", displaced(frame, sign * SHIFT_M * axis, nothing)
    for axis, name in zip(np.eye(3), "xyz", strict=True):
        for sign in (1, -1):
            turn = sign * np.radians(TURN_DEG) * axis
            yield f"{sign * TURN_DEG:+g} deg about {name}", displaced(frame, nothing, turn)


def displaced(frame: Any, shift_m: NDArray[np.float64], turn_rad: NDArray[np.float64]) -> Any:
    """Return a frame whose pose is off by a shift (3,) and a rotation vector (3,) in the optical frame."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn_rad), shift_m
    return replace(frame, T_world_sensor=np.asarray(frame.T_world_sensor, float) @ T)


def metres(frame: Frame) -> NDArray[np.float32]:
    """Return the depths (height, width) of a frame in metres, 0 if none."""
    depth = frame.depth.astype(np.float32) * np.float32(frame.depth_scale)
    none = ~(np.isfinite(depth) & (depth > 0))
    if frame.depth.dtype == np.uint16:
        none |= frame.depth == 65535
    return np.where(none, np.float32(0), depth)


def _bad_depths(frame: Frame, random: np.random.Generator) -> Iterator[tuple[str, Frame]]:
    depth = metres(frame)
    seen, shape = depth > 0, depth.shape
    low, high = (float(depth[seen].min()), float(depth[seen].max())) if seen.any() else (1.0, 1.0)
    safe = np.where(seen, depth, np.float32(low))
    order = random.permutation(depth.size)
    left = np.arange(shape[1]) < shape[1] // 2
    four = np.zeros(shape, np.float32)
    four.flat[random.choice(depth.size, 4, replace=False)] = 2.0
    yield "random depth", _of(frame, random.uniform(0.1, 6.0, shape), None)
    yield "pixels shuffled", _turned(frame, lambda image: image.reshape(-1)[order].reshape(shape))
    yield "inverted, max - d", _of(frame, np.where(seen, high - depth, 0), frame.reason)
    yield "inverted, 1 / d", _of(frame, np.where(seen, 1 / (1 / low + 1 / high - 1 / safe), 0), frame.reason)
    reason = None if frame.reason is None else np.where(left, np.uint8(Reason.UNKNOWN), frame.reason)
    yield "half black", _of(frame, np.where(left, 0, depth), reason)
    yield "mirrored", _turned(frame, lambda image: image[:, ::-1])
    yield "upside down", _turned(frame, lambda image: image[::-1])
    for times in (0.8, 1.2, 10, 1000):
        yield f"depth x {times:g}", replace(frame, depth_scale=times * frame.depth_scale)
    yield "four pixels", _of(frame, four, None)


def _bad_pairs(frame: StereoFrame, random: np.random.Generator) -> Iterator[tuple[str, StereoFrame]]:
    noise = random.integers(0, 256, (2, *frame.left.shape), np.uint8)
    yield "images black", _each(frame, lambda image: image // 64)
    yield "images saturated", _each(frame, lambda image: image | 252)
    yield "images of noise", replace(frame, left=noise[0], right=noise[1])
    yield "eyes swapped", replace(frame, left=frame.right, right=frame.left)
    yield "images upside down", _each(frame, lambda image: np.ascontiguousarray(image[::-1]))


def _each(frame: StereoFrame, change: Callable[[NDArray[np.uint8]], NDArray[Any]]) -> StereoFrame:
    return replace(frame, left=change(frame.left), right=change(frame.right))


def _of(frame: Frame, depth_m: NDArray[np.floating], reason: NDArray[np.uint8] | None) -> Frame:
    return replace(frame, depth=np.ascontiguousarray(depth_m, np.float32), depth_scale=1.0, reason=reason)


def _turned(frame: Frame, turn: Callable[[NDArray[Any]], NDArray[Any]]) -> Frame:
    reason = None if frame.reason is None else np.ascontiguousarray(turn(frame.reason))
    return replace(frame, depth=np.ascontiguousarray(turn(frame.depth)), reason=reason)


def _kept(evidence: Evidence) -> Evidence:
    """Return evidence that survives the next integration."""
    return Evidence(
        evidence.coords.copy(), evidence.values.copy(), evidence.uniform.copy(), evidence.uniform_values.copy()
    )


def _cells_of(coords: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the indices (512 n, 3) of the cells of blocks (n, 3)."""
    column = np.arange(CELLS)
    within = np.stack([column >> 6, (column >> 3) & 7, column & 7], axis=1)
    return (coords[:, None].astype(np.int64) * SIDE + within).reshape(-1, 3)
