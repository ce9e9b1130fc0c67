# SPDX-License-Identifier: Apache-2.0
"""Which bad scans does a 2-D grid take in, how soon a changed world, and how many good scans are refused?

    python benchmarks/bad_scans.py SOURCE [SOURCE ...] [--voxel-size 0.05] [--starts 6] [--last 1 4 20] [--young S]
                                   [--only good|faults|changes|cost|first] [--set key=value ...] [--json]

SOURCE: a CARMEN log or bag, whose poses are corrected by SLAM first (kept in --tracks FOLDER, where that is given), or
`sim:floor?plan=corridors&seed=1`, at its true poses. All scans are mapped one by one (good). Then a mapper goes on with
that grid (--young: with one of the S seconds before) from several places, and after 3 s its scans are bad for the
longest of --last: how many are accepted, and how many surely occupied cells are freed, which are not by good scans?
Changes are of simulated floors only: furniture is moved, gone or come, a door is shut or open, people stand and walk.
First: new grids begin with a good or a bad scan, and good ones follow: at which of these is the first taken out?
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

import stereovox as sv
from stereovox.cli.options import add_settings, overrides
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.robot_track import slam_robot
from stereovox.localize.track import Track
from stereovox.maps.grid_map import GridMap
from stereovox.opening import open_robot
from stereovox.simulate.floors.floor import Floor
from stereovox.simulate.floors.plan import FloorPlan, block, post
from stereovox.simulate.floors.view import cast

BEFORE_S, AFTER_S = 3.0, 2.0
GOOD = 12
"""Good scans after the first of a grid."""
SURE = 2.1
"""Log-odds of a cell that is surely occupied."""
Fault = Callable[[Sequence[Scan], int, int, np.random.Generator], Scan]
"""Makes a scan bad: all good scans, its number, that of the first bad one, random numbers."""


def scans_of(source: str, tracks: Path | None) -> list[Scan]:
    """Return the scans of a source at good poses."""
    if source.startswith("sim:floor"):
        return at_truth(Floor(f"{source}{'&' if '?' in source else '?'}image_width=16"))
    robot = open_robot(source)
    kept = tracks / f"{Path(source).name}.npz" if tracks else None
    if kept is not None and kept.exists():
        track = Track(**np.load(kept))
    else:
        track = slam_robot(robot, sv.load_config()).track
        if kept is not None:
            parts = {name: getattr(track, name) for name in ("stamps_ns", "pose_map_base", "pose_map_odom")}
            np.savez(kept, **parts)
    return [track.corrected(scan) for scan in robot.scans]


def at_truth(floor: Floor) -> list[Scan]:
    return [replace(s, T_world_sensor=floor.truth.at(s.stamp_ns) @ floor.T_base_lidar) for s in floor.scans]


def ranges(change: Callable[..., Any]) -> Fault:
    """Return a fault of ranges: `change(ranges, random)`."""
    return lambda scans, i, first, random: _with(scans[i], change(scans[i].ranges, random))


def turned(degrees: float) -> Fault:
    turn = se2.lifted([0, 0, np.radians(degrees)])
    return lambda scans, i, first, random: replace(scans[i], T_world_sensor=scans[i].T_world_sensor @ turn)


def shifted(x: float, y: float) -> Fault:
    def shift(scans: Sequence[Scan], i: int, first: int, random: np.random.Generator) -> Scan:
        T = scans[i].T_world_sensor.copy()
        T[:2, 3] += x, y
        return replace(scans[i], T_world_sensor=T)

    return shift


def of(pick: Callable[[Sequence[Scan], int, int], int], noise_m: float = 0.0) -> Fault:
    """Return a fault that gives the ranges of another scan, by number, with noise."""
    return lambda scans, i, first, random: _with(
        scans[i], scans[pick(scans, i, first)].ranges + noise_m * random.standard_normal(scans[i].ranges.shape)
    )


def late(seconds: float) -> Fault:
    """Return a fault that gives a scan the pose of so many seconds before."""

    def earlier(scans: Sequence[Scan], i: int, first: int, random: np.random.Generator) -> Scan:
        n = i
        while n > 0 and scans[i].stamp_ns - scans[n].stamp_ns < seconds * 1e9:
            n -= 1
        return replace(scans[i], T_world_sensor=scans[n].T_world_sensor)

    return earlier


def _with(scan: Scan, values: Any) -> Scan:
    return replace(scan, ranges=np.asarray(values, np.float32), clear=None, clear_from=None)


def _ring(metres: float, share: float = 1.0) -> Fault:
    return ranges(
        lambda seen, random: np.where(
            np.arange(len(seen)) < share * len(seen), metres + 0.01 * random.standard_normal(len(seen)), seen
        )
    )


def _random(seen: Any, random: np.random.Generator, smooth: int) -> Any:
    """Return ranges at random, alike over so many beams: noise of single beams is refused by the scan alone."""
    steps = random.uniform(0.5, 5, -(-len(seen) // smooth))
    return np.repeat(steps, smooth)[: len(seen)] + 0.01 * random.standard_normal(len(seen))


FAULTS: dict[str, Fault] = {
    "millimetres": ranges(lambda seen, _: 1000 * seen),
    **{f"x {k:g}": ranges(lambda seen, _, k=k: k * seen) for k in (0.5, 0.8, 1.2, 2)},
    "mirrored": ranges(lambda seen, _: seen[::-1].copy()),
    **{f"turned by {deg} deg": turned(deg) for deg in (8, 30, 90, 180)},
    "ring at 1 m": _ring(1.0),
    "ring at 3 m": _ring(3.0),
    "half at 0.3 m": _ring(0.3, 0.5),
    "half dead": ranges(lambda seen, _: np.where(np.arange(len(seen)) < len(seen) // 2, np.nan, seen)),
    "frozen": of(lambda scans, i, first: first),
    "frozen, with noise": of(lambda scans, i, first: first, 0.01),
    "of another place": of(lambda scans, i, first: (i + len(scans) // 2) % len(scans)),
    "random": lambda scans, i, first, _: _with(
        scans[i], _random(scans[i].ranges, np.random.default_rng(first), 8)
    ),
    "random, changing": ranges(lambda seen, random: _random(seen, random, 8)),
    "pose 0.3 m off": shifted(0.2, 0.2),
    "pose 2 m off": shifted(1.5, 1.3),
    "range + 0.3 m": ranges(lambda seen, _: seen + np.float32(0.3)),
    "range + 2 m": ranges(lambda seen, _: seen + np.float32(2)),
    "pose 0.5 s late": late(0.5),
    "pose 2 s late": late(2.0),
}  # fmt: skip
HARMLESS = {"half dead", "half at 0.3 m"}
"""Kinds that mark or leave out, and clear nothing behind a wall."""


class Ground:
    """Scans at good poses, the grid made of all of them, and mappers that go on with it."""

    def __init__(self, scans: Sequence[Scan], **settings: Any):
        self.scans, self.settings = scans, settings
        self.mapper = sv.GridMapper(**settings)
        self.reasons = [self.mapper.add(scan).refused for scan in scans]

    def refused(self) -> dict[str, int]:
        return dict(Counter(why for why in self.reasons if why))

    def grid(self, numbers: range | None) -> GridMap:
        """Return a copy of the grid, or a new one of these scans."""
        if numbers is not None:
            mapper = sv.GridMapper(**{**self.settings, "trust.max_disagreement": 1})
            for i in numbers:
                mapper.add(self.scans[i])
            return mapper.map
        copy = GridMap(self.mapper.config)
        copy.storage.insert(*self.mapper.map.storage.tiles())
        return copy

    def number_at(self, begin: int, seconds: float) -> int:
        """Return the number of the scan so many seconds after (or before) that of number `begin`."""
        stamps = np.array([scan.stamp_ns for scan in self.scans])
        return int(np.searchsorted(stamps, self.scans[begin].stamp_ns + round(1e9 * seconds)))

    def starts(self, count: int, seconds: float) -> list[int]:
        """Return where trials begin, spread over the drive."""
        end = self.number_at(len(self.scans) - 1, -(seconds + BEFORE_S + AFTER_S + 0.5))
        first = self.number_at(0, 4.0)
        return np.linspace(first, max(end, first), count).astype(int).tolist()

    def fault(self, kind: str, start: int, seconds: Sequence[float], young_s: float | None) -> dict[str, Any]:
        """Return what becomes of scans that are bad for the longest of `seconds`."""
        first = self.number_at(start, BEFORE_S)
        ends = [self.number_at(first, s) for s in seconds]
        last = self.number_at(ends[-1] - 1, AFTER_S)
        young = None if young_s is None else range(self.number_at(start, -young_s), start)
        mapper, control = (sv.GridMapper(**self.settings, resume=self.grid(young)) for _ in range(2))
        if young_s is None:
            mapper.map.history = self._usual(mapper)
        for i in range(start, first):
            mapper.add(self.scans[i])
            control.add(self.scans[i])
        indices, log_odds = mapper.map.cells()
        walls = (indices[log_odds >= SURE] + 0.5) * mapper.map.voxel_size
        random = np.random.default_rng([first, 7])
        accepted, freed, taken, reasons, late_ones = [], [], 0, Counter[str](), 0
        for i in range(first, last):
            bad = i < ends[-1]
            seen = FAULTS[kind](self.scans, i, first, random) if bad else self.scans[i]
            refused = mapper.add(seen).refused
            control.add(self.scans[i])
            taken += bad and refused is None
            reasons.update([refused] if refused and bad else [])
            late_ones += not bad and refused is not None
            while len(freed) < len(ends) and i + 1 >= ends[len(freed)]:
                accepted.append(taken)
                gone = (mapper.map.log_odds(walls) < -0.85) & (control.map.log_odds(walls) >= -0.85)
                freed.append(int(gone.sum()))
        return {
            "walls": len(walls), "bad": ends[-1] - first, "accepted": accepted, "freed": freed,
            "reasons": dict(reasons), "late": late_ones,
        }  # fmt: skip

    def _usual(self, mapper: sv.GridMapper) -> Any:
        mapper.map.history.usual.update(self.mapper.map.history.usual)
        return mapper.map.history


def _moved(plan: FloorPlan, random: np.random.Generator) -> FloorPlan:
    """Return a plan whose pieces of furniture stand 0.5 to 1.2 m elsewhere, each with all its parts."""
    by: dict[str, Any] = {}
    for one in plan.obstacles:
        angle, far = random.uniform(0, 2 * np.pi), random.uniform(0.5, 1.2)
        by.setdefault(one.name.partition(":")[0], far * np.array([np.cos(angle), np.sin(angle)]))
    shifted = [replace(one, corners=one.corners + by[one.name.partition(":")[0]]) for one in plan.obstacles]
    return replace(plan, obstacles=shifted)


def _boxes(floor: Floor, random: np.random.Generator) -> FloorPlan:
    """Return the plan with boxes next to the path, every 3 s of the drive."""
    new = []
    for n, T in enumerate(floor.truth.T_world_body[150::150]):
        x, y, yaw = se2.flattened(T)
        side, (a, b) = random.choice([-1, 1]) * random.uniform(0.7, 1.0), random.uniform(0.1, 0.3, 2)
        x, y = x - side * np.sin(yaw), y + side * np.cos(yaw)
        new.append(block("boxes", f"box {n}", (x - a, y - b, x + a, y + b), (0, 1), random.uniform(0, 90)))
    return replace(floor.plan, obstacles=[*floor.plan.obstacles, *new])


def changed(source: str, kind: str, seed: int) -> list[Scan]:
    """Return the scans of a second round, after the first, on a floor that has changed."""
    random = np.random.default_rng([31, seed])
    floor = Floor(f"{source}{'&' if '?' in source else '?'}image_width=16")
    plan = {
        "furniture moved": lambda: _moved(floor.plan, random),
        "furniture gone": lambda: replace(floor.plan, obstacles=()),
        "boxes came": lambda: _boxes(floor, random),
        "doors shut": lambda: replace(floor.plan, obstacles=[*floor.plan.obstacles, *_leaves(floor.plan)]),
        "walls open": lambda: replace(floor.plan, free=[*floor.plan.free, *_gaps(floor.plan)]),
    }.get(kind, lambda: floor.plan)()
    floor.__dict__["layout"] = replace(floor.layout, plan=plan)
    scans = at_truth(floor)
    if kind.startswith("person"):
        scans = [_with_person(floor, scan, n, kind) for n, scan in enumerate(scans)]
    later = scans[-1].stamp_ns - scans[0].stamp_ns + 10**9
    return [replace(scan, stamp_ns=scan.stamp_ns + later) for scan in scans]


def _with_person(floor: Floor, scan: Scan, n: int, kind: str) -> Scan:
    """Return a scan with a person before the robot: one that goes to and fro, or stands at each place for 10 s."""
    stamp_ns = scan.stamp_ns - (scan.stamp_ns - floor.truth.stamps_ns[0]) % (10 * 10**9)
    walks = kind == "person walking"
    T = floor.truth.at(scan.stamp_ns if walks else stamp_ns)
    x, y = se2.transform(se2.flattened(T), [[1.5, 0.9 * np.sin(0.12 * n) if walks else 0.6]])[0]
    outline = post("people", "person", (x, y), 0.4, 1.7).outline
    sensor = se2.flattened(scan.T_world_sensor)
    found = cast(outline, sensor[:2], sensor[2] + scan.angles, 5.6)
    return _with(scan, np.where(found < scan.ranges, found, scan.ranges))


def _leaves(plan: FloorPlan) -> list[Any]:
    """Return a shut leaf in each opening of 0.9 m and in each gap between rooms."""
    leaves = []
    for x0, y0, x1, y1 in plan.free:
        if min(x1 - x0, y1 - y0) < 0.2 and max(x1 - x0, y1 - y0) < 1.3:
            leaves.append(block("doors", f"leaf {len(leaves)}", (x0, y0, x1, y1), (0, 2)))
    return leaves


def _gaps(plan: FloorPlan) -> list[Any]:
    """Return openings of 1.2 m in the outer walls, with a room of 2 m behind."""
    gaps = []
    for x0, y0, x1, _ in plan.free:
        if x1 - x0 > 5:
            x = x0 + 0.37 * (x1 - x0)
            gaps.append((x, y0 - 0.2, x + 1.2, y0))
            gaps.append((x - 1, y0 - 2.2, x + 2, y0 - 0.2))
    return gaps


CHANGES = (
    "nothing", "furniture moved", "furniture gone", "boxes came", "doors shut", "walls open", "person standing",
    "person walking",
)  # fmt: skip


def change(ground: Ground, scans: Sequence[Scan]) -> dict[str, Any]:
    """Return what becomes of a changed world: scans refused, the longest time of refusals, and what was taken over.

    taken: share of the known cells that a mapper without the comparison has free instead of occupied, or the other way
    round, which are so in this grid as well.
    """
    mapper = sv.GridMapper(**ground.settings, resume=ground.grid(None))
    mapper.map.history = ground._usual(mapper)
    control = sv.GridMapper(**{**ground.settings, "trust.max_disagreement": 1}, resume=ground.grid(None))
    before = ground.grid(None)
    reasons, since, longest = Counter[str](), None, 0
    for scan in scans:
        refused = mapper.add(scan).refused
        control.add(scan)
        reasons.update([refused] if refused else [])
        since = (since or scan.stamp_ns) if refused else None
        longest = max(longest, scan.stamp_ns - since if since else 0)
    indices, _ = before.cells()
    points = (indices + 0.5) * before.voxel_size
    was, ours, theirs = (one.state(points) for one in (before, mapper.map, control.map))
    other = np.isin(was, (1, 3)) & np.isin(theirs, (1, 3)) & (was != theirs)
    return {
        "scans": len(scans), "refused": dict(reasons), "longest_s": longest / 1e9, "cells": int(other.sum()),
        "taken": float((ours == theirs)[other].mean()) if other.any() else 1.0,
    }  # fmt: skip


def cost(scans: Sequence[Scan], **settings: Any) -> float:
    """Return by which share a mapper takes longer with the comparison than without, by turns in one process."""
    with_, without = (sv.GridMapper(**settings, **{"trust.max_disagreement": at}) for at in (0.15, 1))
    spent = {with_: 0.0, without: 0.0}
    for n, scan in enumerate(scans):
        for mapper in (with_, without) if n % 2 else (without, with_):
            begun = process_time()
            mapper.add(scan)
            spent[mapper] += (process_time() - begun) if n >= 20 else 0
    return spent[with_] / spent[without] - 1


def first_scans(scans: Sequence[Scan], kind: str, starts: int, **settings: Any) -> dict[str, int]:
    """Return what became of the first scan of new grids, which a fault, or none (`good`), has made."""
    found = Counter[str]()
    for start in np.linspace(5, len(scans) - GOOD - 1, starts).astype(int).tolist():
        random, mapper = np.random.default_rng([start, 7]), sv.GridMapper(**settings)
        began = max(start - 40, 0) if kind.startswith("frozen") else start
        seen = scans[start] if kind == "good" else FAULTS[kind](scans, start, began, random)
        refused, out, confirmed = mapper.add(seen).refused, 0, 0
        for n in range(1, GOOD + 1):
            out += bool(mapper.add(scans[start + n]).taken_out)
            confirmed = confirmed or n * (not mapper.map.history.is_provisional)
        ends = "" if confirmed == 1 else f", confirmed by {confirmed or 'none'}"
        found["refused" if refused else f"taken out{ends}" if out else f"kept{ends}"] += 1
    return dict(found)


def rows(wanted: argparse.Namespace) -> Iterator[dict[str, Any]]:
    settings = {"voxel_size": wanted.voxel_size, "max_range": wanted.max_range, **overrides(wanted)}
    for source in wanted.source:
        scans = scans_of(source, wanted.tracks)
        if wanted.only == "cost":
            yield {"source": source, "cost": cost(scans, **settings)}
            continue
        if wanted.only == "first":
            for kind in wanted.kinds or ("good", *FAULTS):
                found = first_scans(scans, kind, wanted.starts, **settings)
                yield {"source": source, "first": kind, **found}
            continue
        ground = Ground(scans, **settings)
        yield {"source": source, "good": len(scans), "refused": ground.refused()}
        if wanted.only in (None, "faults"):
            for kind in FAULTS if not wanted.kinds else wanted.kinds:
                found = [
                    ground.fault(kind, start, wanted.last, wanted.young)
                    for start in ground.starts(wanted.starts, max(wanted.last))
                ]
                yield {"source": source, "fault": kind, "trials": found, **_summed(found)}
        if wanted.only in (None, "changes") and source.startswith("sim:floor"):
            for kind in CHANGES if not wanted.kinds else wanted.kinds:
                yield {"source": source, "change": kind, **change(ground, changed(source, kind, wanted.seed))}


def _summed(found: Sequence[dict[str, Any]]) -> dict[str, Any]:
    return {
        "accepted": np.sum([one["accepted"] for one in found], axis=0).tolist(),
        "bad": sum(one["bad"] for one in found),
        "freed": np.sum([one["freed"] for one in found], axis=0).tolist(),
        "walls": sum(one["walls"] for one in found),
        "late": sum(one["late"] for one in found),
        "reasons": dict(sum((Counter(one["reasons"]) for one in found), Counter())),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", nargs="+")
    parser.add_argument("--voxel-size", type=float, default=0.05)
    parser.add_argument("--max-range", type=float, default=30.0)
    parser.add_argument("--starts", type=int, default=6)
    parser.add_argument("--last", type=float, nargs="+", default=[1, 4, 20])
    parser.add_argument("--young", type=float)
    parser.add_argument("--only", choices=["good", "faults", "changes", "cost", "first"])
    parser.add_argument("--kinds", nargs="*", help="only these faults or changes")
    parser.add_argument("--seed", type=int, default=0, help="of the changes")
    parser.add_argument("--tracks", type=Path, help="folder that keeps what SLAM finds")
    add_settings(parser, "trust.max_disagreement=1")
    parser.add_argument("--json", action="store_true")
    wanted = parser.parse_args()
    found = []
    for row in rows(wanted):
        found.append(row)
        if not wanted.json:
            print("  ".join(f"{k} {v}" for k, v in row.items() if k not in ("source", "trials")), flush=True)
    if wanted.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
