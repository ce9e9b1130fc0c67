# SPDX-License-Identifier: Apache-2.0
"""Random frames, scans and stereo pairs into mappers of all kinds: `python fuzz/frames.py --frames 1000000`.

What must hold: no exception; a refused frame leaves every bit of the map as it was and says why in one line; no call
takes longer than a second; no cell leaves its range. What does not is printed, and the exit status is then 1.
"""

from __future__ import annotations

import argparse
import json
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter, process_time
from typing import Any
from zlib import crc32

import numpy as np

import stereovox as sv
from random_frames import Maker
from stereovox.errors import ConfigError
from stereovox.frame import Frame, Scan, StereoFrame
from stereovox.grid_mapper import GridMapper

SEEN = Frame, Scan, StereoFrame
SLOW_S = 1.0
SELDOM = 0.1
"""Share of the frames that a map with tiles on the disk gets: looking at all of it is slow."""
RENEWED = 200
"""Frames after which a map is begun anew, lest all of them be large."""
UNFIT = "(settings do not fit the camera)"
"""What a ConfigError counts as: it is raised, for it would come with every frame."""
WARM = 3000
"""Frames that are made and not timed: kernels are compiled meanwhile."""
ANYWHERE = {"trust.ordered": False, "trust.max_speed_mps": 1e12, "trust.max_turn_dps": 1e12, "trust.settle_s": 0}
"""Else nearly all frames were refused for jumps."""
SMALL = {"voxel_size": 0.25, "max_range": 4.0, "stereo.disparities": 16, **ANYWHERE}
WINDOW = {"window.size": (12, 12, 6), "window.trigger": 1}
VOXELS: dict[str, dict[str, Any]] = {
    "projective": {},
    "projective, two threads, as a sensor tells": {"threads": 2, "depth.far": "infinite", "map.cell": "int8"},
    "projective, window, downsampled": {**WINDOW, "depth.downsample": 2},
    "projective, window on disk": {**WINDOW, "window.outside": "keep"},
    "projective, fixed window, sphere": {**WINDOW, "window.centre": (0, 0, 0), "sphere.step_deg": 5},
    "projective, flat cells, stamps in order": {"steps": (0.25, 0.25, 0.1), "trust.ordered": True, "trust.settle_s": 1},
    "ray, every": {"integrator": "ray", "map.cell": "uint8"},
    "ray, once, valenti": {"integrator": "ray", "ray.update": "once", "depth.far": "measured"},
    "line": {"integrator": "line", "map.cell": "int8"},
}
GRIDS: dict[str, dict[str, Any]] = {
    "grid, exact, once": {"grid.thickness": 0.3},
    "grid, bresenham, every": {"grid.traversal": "bresenham", "grid.update": "every", "scan.method": "rows"},
}


@dataclass
class Tally:
    """What was seen.

    longest_ms, busiest_ms: of one call, by the clock and by the processor, which other programs use too. A call is
    slow where both are over SLOW_S. bad: one line for each frame after which something did not hold.
    """

    frames: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    longest_ms: float = 0.0
    busiest_ms: float = 0.0
    slow: int = 0
    changed_by_refused: int = 0
    bad: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        refused = sum(self.refused.values())
        return {
            "frames": sum(self.frames.values()),
            "taken": sum(self.frames.values()) - refused - len(self.bad),
            "refused": refused,
            "crashes": len(self.bad),
            "over_1_s": self.slow,
            "changed_by_a_refused_frame": self.changed_by_refused,
            "longest_ms": round(self.longest_ms, 1),
            "busiest_ms": round(self.busiest_ms, 1),
            "by_kind": dict(self.frames.most_common()),
            "by_reason": dict(self.refused.most_common()),
            "bad": self.bad[:20],
        }


class Tried:
    """A mapper with the state of its map after the last frame."""

    def __init__(self, make: Callable[[], Any]):
        self._make = make
        self._begin()

    def add(self, thing: Any, tally: Tally, timed: bool) -> None:
        """Offer one thing and note in `tally` what it did; raises AssertionError where something does not hold."""
        before, told = self._digest, self.mapper.map.frames + self.mapper.map.frames_refused
        start, busy_start = perf_counter(), process_time()
        reason, detail = self._offered(thing)
        took, busy = perf_counter() - start, process_time() - busy_start
        if timed:
            tally.longest_ms = max(tally.longest_ms, 1e3 * took)
            tally.busiest_ms = max(tally.busiest_ms, 1e3 * busy)
            tally.slow += min(took, busy) > SLOW_S
        self._digest = digest(self.mapper.map)
        if reason:
            tally.refused[reason] += 1
            check(bool(detail) and "\n" not in detail, f"what is said is not one line: {detail!r}")
            tally.changed_by_refused += self._digest != before
            check(self._digest == before, f"a refused frame ({reason}) changed the map")
        counted = self.mapper.map.frames + self.mapper.map.frames_refused - told
        check(counted == (reason != UNFIT), f"a frame was counted {counted} times")
        self._left -= 1
        if not self._left:
            self.renew()

    def _offered(self, thing: Any) -> tuple[str | None, str]:
        try:
            report = self.mapper.add(thing)
        except ConfigError as error:
            return UNFIT, str(error)
        return report.refused, report.detail

    def renew(self) -> None:
        """Begin with an empty map."""
        if hasattr(self.mapper.map, "close"):
            self.mapper.map.close()
        self._begin()

    def _begin(self) -> None:
        self.mapper, self._left = self._make(), RENEWED
        self._digest = digest(self.mapper.map)


def check(holds: bool, otherwise: str) -> None:
    """Raise AssertionError with `otherwise` where something does not hold."""
    if not holds:
        raise AssertionError(otherwise)


def digest(voxel_map: Any) -> tuple[Any, ...]:
    """Return what a map is, in a few numbers; raises AssertionError where a cell is out of range."""
    coords, cells = voxel_map.tiles() if hasattr(voxel_map, "tiles") else voxel_map.blocks()
    limits, format = voxel_map.config.map, voxel_map.cell_format
    lowest, highest = format.stored(np.array([limits.log_odds_min, limits.log_odds_max])).tolist()
    if cells.size:
        least, most = int(cells.min()), int(cells.max())
        check(min(lowest, format.unknown) <= least and most <= max(highest, format.unknown), "a cell is out of range")
    viewpoint = getattr(voxel_map, "viewpoint", None)
    seen = None if viewpoint is None else (viewpoint.T_world_camera.tobytes(), viewpoint.stamp_ns)
    window = getattr(voxel_map, "window", None)
    cells_there = len(coords), crc32(np.ascontiguousarray(coords)), crc32(np.ascontiguousarray(cells))
    return *cells_there, voxel_map.frames, seen, None if window is None else window.tobytes()


def thing_for(grid: bool, maker: Maker, chance: float) -> Any:
    """Return a frame or a scan, whatever suits the mapper, and now and then what does not."""
    if chance < 0.02:
        return maker.nonsense() if chance < 0.01 else maker.scan()
    return maker.scan() if grid and chance < 0.7 else maker.frame()


def all_mappers() -> tuple[list[Tried], list[float]]:
    """Return one mapper of each kind, and which share of the frames each gets."""
    tried = [Tried(lambda s=s: sv.Mapper("default", **{**SMALL, **s})) for s in VOXELS.values()]
    tried += [Tried(lambda s=s: GridMapper("default", **{**SMALL, **s})) for s in GRIDS.values()]
    weights = np.array([SELDOM if "window.outside" in s else 1.0 for s in (*VOXELS.values(), *GRIDS.values())])
    return tried, (weights / weights.sum()).tolist()


def run(frames: int, seed: int, timed_from: int = WARM, told: Callable[[str], None] = lambda line: None) -> Tally:
    """Offer so many things to mappers in turn and return what was seen; a warning counts as an exception."""
    maker, rng, tally = Maker(seed), np.random.default_rng(seed + 1), Tally()
    tried, shares = all_mappers()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for number in range(frames):
            one = tried[rng.choice(len(tried), p=shares)]
            thing = thing_for(isinstance(one.mapper, GridMapper), maker, rng.random())
            tally.frames[type(thing).__name__ if isinstance(thing, SEEN) else "nonsense"] += 1
            try:
                one.add(thing, tally, number >= timed_from)
            except Exception as error:
                tally.bad.append(f"frame {number}: {what_happened(error)}")
                told(tally.bad[-1])
                one.renew()
            if number % 10_000 == 9_999:
                told(f"{number + 1} frames, {len(tally.bad)} crashes, {tally.slow} slow, {tally.longest_ms:.0f} ms")
    for one in tried:
        one.renew()
    return tally


def what_happened(error: Exception) -> str:
    """Return an exception and its place in one line."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} {str(error)[:200]!r} ({place.filename}:{place.lineno})"


def main() -> int:
    """Run as the command line says; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    arguments = parser.parse_args()
    start = perf_counter()
    tally = run(arguments.frames, arguments.seed, told=lambda line: print(line, file=sys.stderr, flush=True))
    result = {**tally.as_dict(), "seconds": round(perf_counter() - start), "seed": arguments.seed}
    print(json.dumps(result) if arguments.json else "\n".join(f"{name}: {value}" for name, value in result.items()))
    return int(bool(tally.bad or tally.slow or tally.changed_by_refused))


if __name__ == "__main__":
    sys.exit(main())
