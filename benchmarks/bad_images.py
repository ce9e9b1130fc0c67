# SPDX-License-Identifier: Apache-2.0
"""Which bad images are refused, and how many good ones?

    python benchmarks/bad_images.py [SOURCE] [--voxel-size 0.05] [--max-range 5] [--frames A:B:S] [--every 5] [--seed 0]
                                    [--set key=value ...] [--json]

All good frames of SOURCE are mapped one by one. Before every N-th of them each kind of bad frame is offered in its
place, on the map as it is then, and taken back. A bad frame that passes is without effect where it changes the state
of less than 0.1 % of those sure cells it says something of, and frees no occupied cell; what the true frame does as
well does not count. Then runs: from one frame on the camera stands elsewhere than its pose says, for 3 seconds.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

import stereovox as sv
from stereovox.comparing import compared
from stereovox.config import parse_value
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, Frame, Reason, StereoFrame
from stereovox.gate import Gate, Passed
from stereovox.geometry import rotation_matrix
from stereovox.maps import State, VoxelMap, make_map
from stereovox.maps.evidence import Evidence
from stereovox.ways import full

HARMLESS = 1e-3
WARM = 10
"""Frames before the first bad one."""
SHIFTS = {name: np.eye(3)[axis] * sign for axis, pair in enumerate(("right left", "down up", "forward back"))
          for sign, name in zip((1, -1), pair.split(" "), strict=True)}  # fmt: skip
TURNS = {name: np.eye(3)[axis] * sign for axis, pair in enumerate(("pitch+ pitch-", "yaw+ yaw-", "roll+ roll-"))
         for sign, name in zip((1, -1), pair.split(" "), strict=True)}  # fmt: skip
Change = Callable[[Frame, Frame, np.random.Generator], Frame]


def metres(frame: Frame) -> np.ndarray:
    """Return the depths of a frame in metres, 0 for none."""
    depth = frame.depth.astype(np.float32) * np.float32(frame.depth_scale)
    none = ~np.isfinite(depth) | (frame.depth == 65535) if frame.depth.dtype == np.uint16 else ~np.isfinite(depth)
    return np.where(none | (depth < 0), np.float32(0), depth)


def with_depth(frame: Frame, depth: np.ndarray, reason: np.ndarray | None) -> Frame:
    return replace(frame, depth=np.ascontiguousarray(depth, np.float32), depth_scale=1.0, reason=reason)


def turned(frame: Frame, turn: Callable[[np.ndarray], np.ndarray]) -> Frame:
    reason = None if frame.reason is None else np.ascontiguousarray(turn(frame.reason))
    return replace(frame, depth=np.ascontiguousarray(turn(frame.depth)), reason=reason)


def moved(frame: AnyFrame, shift_m: np.ndarray, turn_rad: np.ndarray) -> Any:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn_rad), shift_m
    return replace(frame, T_world_sensor=np.asarray(frame.T_world_sensor, float) @ T)


def shuffled(frame: Frame, _: Frame, random: np.random.Generator) -> Frame:
    order = random.permutation(frame.depth.size)
    return turned(frame, lambda image: image.reshape(-1)[order].reshape(image.shape))


def inverted(frame: Frame, inverse: Callable[[np.ndarray, float, float], np.ndarray]) -> Frame:
    depth = metres(frame)
    seen = depth > 0
    low, high = (float(depth[seen].min()), float(depth[seen].max())) if seen.any() else (1.0, 1.0)
    return with_depth(frame, np.where(seen, inverse(np.where(seen, depth, low), low, high), 0), frame.reason)


def half_black(frame: Frame) -> Frame:
    depth, left = metres(frame), np.arange(frame.depth.shape[1]) < frame.depth.shape[1] // 2
    reason = None if frame.reason is None else np.where(left, np.uint8(Reason.UNKNOWN), frame.reason)
    return with_depth(frame, np.where(left, 0, depth), reason)


DEPTH_KINDS: dict[str, Change] = {
    "random depth": lambda f, _, r: with_depth(f, r.uniform(0.1, 6.0, f.depth.shape), None),
    "pixels shuffled": shuffled,
    "inverted, max - d": lambda f, _, r: inverted(f, lambda d, low, high: high - d),
    "inverted, 1 / d": lambda f, _, r: inverted(f, lambda d, low, high: 1 / (1 / low + 1 / high - 1 / d)),
    "half black": lambda f, _, r: half_black(f),
    "mirrored": lambda f, _, r: turned(f, lambda image: image[:, ::-1]),
    "upside down": lambda f, _, r: turned(f, lambda image: image[::-1]),
    "scale x 0.8": lambda f, _, r: replace(f, depth_scale=0.8 * f.depth_scale),
    "scale x 1.2": lambda f, _, r: replace(f, depth_scale=1.2 * f.depth_scale),
    "scale x 10": lambda f, _, r: replace(f, depth_scale=10 * f.depth_scale),
    "scale x 1000": lambda f, _, r: replace(f, depth_scale=1000 * f.depth_scale),
    "four pixels": lambda f, _, r: with_depth(
        f, np.where(np.arange(f.depth.size).reshape(f.depth.shape) % (f.depth.size // 4) == 7, 2.0, 0.0), None
    ),
}
IMAGE_KINDS: dict[str, Callable[[StereoFrame, np.random.Generator], StereoFrame]] = {
    "images black": lambda f, r: replace(f, left=f.left // 64, right=f.right // 64),
    "images saturated": lambda f, r: replace(f, left=f.left | 252, right=f.right | 252),
    "images of noise": lambda f, r: replace(f, **{s: r.integers(0, 256, f.left.shape, np.uint8) for s in ("left", "right")}),
    "eyes swapped": lambda f, r: replace(f, left=f.right, right=f.left),
    "images upside down": lambda f, r: replace(f, left=f.left[::-1].copy(), right=f.right[::-1].copy()),
}  # fmt: skip


def pose_kinds(frame: AnyFrame) -> Iterator[tuple[str, AnyFrame]]:
    nothing = np.zeros(3)
    for name, axis in SHIFTS.items():
        yield f"20 cm {name}", moved(frame, 0.2 * axis, nothing)
    for name, axis in TURNS.items():
        yield f"5 deg {name}", moved(frame, nothing, np.radians(5) * axis)


def bad_frames(frame: AnyFrame, matched: Frame, before: AnyFrame, random: np.random.Generator) -> Iterator[tuple[str, AnyFrame]]:
    """Yield each kind of bad frame in place of `frame`; matched: as depth; before: the one before."""
    for name, change in DEPTH_KINDS.items():
        yield name, change(matched, matched, random)
    if isinstance(frame, StereoFrame):
        for name, of_pair in IMAGE_KINDS.items():
            yield name, of_pair(frame, random)
    yield "frozen", replace(before, T_world_sensor=frame.T_world_sensor, stamp_ns=frame.stamp_ns)
    yield from pose_kinds(frame)


class Verdict(NamedTuple):
    """What became of a bad frame: why it was refused ("": it was not), share of sure cells it changes, cells freed."""

    refused: str
    changed: float = 0.0
    freed: int = 0

    @property
    def good(self) -> bool:
        return bool(self.refused) or (self.changed < HARMLESS and self.freed == 0)


class Run:
    """A mapper in its parts, so that frames can be offered without being taken."""

    def __init__(self, **settings: Any):
        self.config = sv.load_config(**settings)
        self.way, self.map = full(self.config), make_map(self.config)
        self.gate = Gate(self.config, self.map.history)

    def offer(self, frame: AnyFrame) -> tuple[Any, Evidence, Passed]:
        image = self.way.depth.image(self.way.depth.matched(frame))
        return (image, *compared(frame, image, self.gate, self.way.integrator, self.map))

    def add(self, frame: AnyFrame) -> str:
        try:
            image, evidence, passed = self.offer(frame)
        except FrameRefused as refused:
            return refused.reason
        self.map.look_from(image.viewpoint)
        self.map.add(evidence)
        self.map.history.frames += 1
        self.gate.took(passed)
        return ""

    def judged(self, bad: AnyFrame, true: AnyFrame) -> Verdict:
        """Return what a bad frame would do, and leave all as it was."""
        history = self.map.history
        doubts, waiting = dict(history.doubts), dict(history.waiting)
        try:
            _, evidence, _ = self.offer(bad)
            evidence = Evidence(evidence.coords.copy(), evidence.values.copy(), evidence.uniform.copy(), evidence.uniform_value)
        except FrameRefused as refused:
            return Verdict(refused.reason)
        finally:
            history.doubts, history.waiting = doubts, waiting
        return Verdict("", *self.effect(evidence, true))

    def effect(self, evidence: Evidence, true: AnyFrame) -> tuple[float, int]:
        """Return the share of sure cells that change their state, and how many occupied cells become free."""
        said = self.way.integrator.evidence(self.way.depth.image(self.way.depth.matched(true)))
        coords = np.unique(np.concatenate([evidence.coords, evidence.uniform]), axis=0)
        spoken = blocks_of(self.snapshot(None), coords) * 0 + evidence_of(evidence, coords)
        before, after, truly = (blocks_of(self.snapshot(e), coords) for e in (None, evidence, said))
        rules = self.map._rules
        free_most, occupied_least = map(int, rules.thresholds)
        known = before != rules.format.unknown
        sure = known & ((before <= (free_most + int(rules.lowest)) // 2) | (before >= -(-(occupied_least + int(rules.highest)) // 2)))
        states, now, true_now = rules.states(before), rules.states(after), rules.states(truly)
        other = (now != states) & (now != true_now)
        freed = (states == State.OCCUPIED) & (now == State.FREE) & (true_now != State.FREE)
        about = sure & (spoken != 0)
        return float((other & about).sum() / max(about.sum(), 1)), int(freed.sum())

    def snapshot(self, evidence: Evidence | None) -> VoxelMap:
        copy = self.map.snapshot()
        if evidence is not None:
            copy.add(evidence)
        return copy


def blocks_of(voxel_map: VoxelMap, coords: np.ndarray) -> np.ndarray:
    """Return the stored numbers (n, 512) of blocks (n, 3)."""
    there, cells = voxel_map._pool.get(np.ascontiguousarray(coords, np.int32))
    out = np.full((len(coords), 512), voxel_map._format.unknown, np.int32)
    place = {tuple(c): i for i, c in enumerate(coords.tolist())}
    out[[place[tuple(c)] for c in there.tolist()]] = cells
    return out


def evidence_of(evidence: Evidence, coords: np.ndarray) -> np.ndarray:
    out, place = np.zeros((len(coords), 512), np.int32), {tuple(c): i for i, c in enumerate(coords.tolist())}
    out[[place[tuple(c)] for c in evidence.coords.tolist()]] = evidence.values
    if len(evidence.uniform):
        out[[place[tuple(c)] for c in evidence.uniform.tolist()]] = evidence.uniform_value
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", nargs="?", default="sim:room")
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--max-range", type=float, default=5.0)
    parser.add_argument("--frames")
    parser.add_argument("--every", type=int, default=5)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--good", action="store_true", help="good frames only")
    wanted = parser.parse_args()
    settings = {key: parse_value(value) for key, _, value in (pair.partition("=") for pair in wanted.set)}
    settings = {"voxel_size": wanted.voxel_size, "max_range": wanted.max_range, **settings}
    source = sv.open_source(wanted.source, **({"frames": wanted.frames} if wanted.frames else {}))
    found = measured(source, settings, 0 if wanted.good else wanted.every, wanted.seed)
    if wanted.json:
        print(json.dumps(found))
        return
    print(f"good: {found['good']} frames, refused {found['refused']}")
    print(f"{'bad':20} {'frames':>6} {'refused':>8} {'harmless':>8} {'left':>6} {'changed %':>9}  reasons")
    for name, row in found["bad"].items():
        print(f"{name:20} {row['frames']:6} {row['refused']:8.3f} {row['harmless']:8.3f} {row['left']:6.3f} "
              f"{100 * row['changed']:9.2f}  {row['reasons']}")  # fmt: skip


def measured(source: Any, settings: dict[str, Any], every: int, seed: int = 0) -> dict[str, Any]:
    """Return how many good frames were refused and why, and the shares of each kind of bad ones."""
    run, random = Run(**settings), np.random.default_rng(seed)
    verdicts: dict[str, list[Verdict]] = {}
    refused: Counter[str] = Counter()
    before, n, last = None, 0, {}
    for n, frame in enumerate(source, 1):  # noqa: B007 - counted
        if every and n > WARM and n % every == 0 and before is not None and not frame.fault:
            matched = run.way.depth.matched(frame)
            for name, bad in bad_frames(frame, matched, before, random):
                verdicts.setdefault(name, []).append(run.judged(bad, frame))
        why = run.add(frame)
        if why:
            refused[why] += 1
            last[why] = n
        else:
            before = frame
    rows = {name: summary(found) for name, found in verdicts.items()}
    return {"good": n, "refused": dict(refused), "last": last, "bad": rows}


def summary(found: list[Verdict]) -> dict[str, Any]:
    passed = [one for one in found if not one.refused]
    return {
        "frames": len(found),
        "refused": np.mean([bool(one.refused) for one in found]).item(),
        "harmless": np.mean([not one.refused and one.good for one in found]).item(),
        "left": np.mean([not one.good for one in found]).item(),
        "changed": float(np.median([one.changed for one in passed])) if passed else 0.0,
        "reasons": dict(Counter(one.refused for one in found if one.refused)),
    }


if __name__ == "__main__":
    main()
