# SPDX-License-Identifier: Apache-2.0
"""Random images, pairs, clouds and scans into mappers of all kinds: `python fuzz/frames.py --seconds 3600 --seed 1`.

What must hold: no exception, not even a warning; a refused frame leaves every bit of the map unchanged and gives the
reason in one line; no call takes longer than a second; no cell leaves its range. Violations are printed, and the exit
status is then 1. Frames are made in batches, each with new mappers and its own dice: `--seed S --batch B --frames N`
repeats the first N frames of one. Batches run in a separate process, which is killed if a call does not return.
"""

from __future__ import annotations

import argparse
import json
import sys
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from heapq import nlargest
from itertools import product
from time import perf_counter, process_time
from typing import Any
from zlib import crc32

import numpy as np

from mapper_kinds import KINDS, Kind
from random_cameras import RARE
from random_frames import DTYPES, Maker
from stereovox.errors import ConfigError
from stereovox.frame import Cloud, Frame, Scan, StereoFrame

SEEN = Frame, Scan, StereoFrame, Cloud
SLOW_S = 1.0
SLOWEST = 5
"""Number of slowest calls kept."""
BATCH = 20_000
RENEWED = 200
"""Calls after which a map is restarted, so that not all of them are large."""
UNFIT = "(settings do not fit the camera)"
"""How a ConfigError is counted: it is raised, because it would repeat with every frame."""
WARM = 5000
"""Frames at the start that are not timed, while kernels are compiled. Later compilation is a slow call."""
Told = Callable[[str], None]


@dataclass
class Tally:
    """The results so far.

    slowest: (milliseconds, frame, what) of calls, the lesser of wall time and processor time, because other programs
    use both. A call is slow if it takes over SLOW_S. bad: one line for each frame after which an invariant was
    violated. hung: one for each call that did not return.
    """

    frames: Counter[str] = field(default_factory=Counter)
    taken: Counter[str] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)
    slowest: list[tuple[float, str, str]] = field(default_factory=list)
    slow: int = 0
    changed_by_refused: int = 0
    bad: list[str] = field(default_factory=list)
    hung: list[str] = field(default_factory=list)

    def took(self, seconds: float, place: str, what: str) -> None:
        """Record the time of a call."""
        self.slow += seconds > SLOW_S
        if len(self.slowest) < SLOWEST or 1e3 * seconds > self.slowest[-1][0]:
            self.slowest = nlargest(SLOWEST, [*self.slowest, (round(1e3 * seconds, 1), place, what)])

    def join(self, other: Tally) -> None:
        """Add another tally."""
        for mine, theirs in ((self.frames, other.frames), (self.taken, other.taken), (self.refused, other.refused)):
            mine.update(theirs)
        self.slowest = nlargest(SLOWEST, self.slowest + other.slowest)
        self.slow += other.slow
        self.changed_by_refused += other.changed_by_refused
        self.bad += other.bad
        self.hung += other.hung

    @property
    def failed(self) -> bool:
        """Whether an invariant was violated."""
        return bool(self.bad or self.hung or self.slow or self.changed_by_refused)

    def as_dict(self) -> dict[str, Any]:
        """Return it for JSON."""
        return {
            "frames": sum(self.frames.values()),
            "taken": sum(self.taken.values()),
            "refused": sum(self.refused.values()),
            "crashes": len(self.bad),
            "hangs": len(self.hung),
            "over_1_s": self.slow,
            "changed_by_a_refused_frame": self.changed_by_refused,
            "slowest": [{"ms": ms, "place": place, "call": what} for ms, place, what in self.slowest],
            "by_kind": dict(self.frames.most_common()),
            "taken_by": dict(self.taken.most_common()),
            "by_reason": dict(self.refused.most_common()),
            "bad": self.bad[:1000],
            "hung": self.hung[:1000],
        }


class Tried:
    """A mapper with the state of its map after the last call."""

    def __init__(self, kind: Kind):
        self.kind = kind
        self._callers = ThreadPoolExecutor(kind.callers)
        self._begin()

    def add(self, things: Sequence[Any], tally: Tally, place: str, timed: bool = True) -> None:
        """Offer one thing from each caller and record the results in `tally`.

        Raises AssertionError if an invariant is violated.
        """
        before, known = self._digest, self._offered_so_far
        start, busy_start = perf_counter(), process_time()
        answers = self._answers(things)
        seconds = min(perf_counter() - start, process_time() - busy_start) / len(things)
        if timed:
            tally.took(seconds, place, f"{self.kind.name}: {' | '.join(map(described, things))}")
        self._digest = digest(self.mapper.map)
        for reason, detail in answers:
            if reason:
                tally.refused[reason] += 1
                check(bool(detail) and "\n" not in detail, f"what is said is not one line: {detail!r}")
            else:
                tally.taken[self.kind.name] += 1
        if all(reason for reason, _ in answers):
            tally.changed_by_refused += self._digest != before
            check(self._digest == before, f"a refused frame ({answers[0][0]}) changed the map")
        counted, expected = self._offered_so_far - known, sum(reason != UNFIT for reason, _ in answers)
        check(counted == expected, f"{counted} frames were counted, not {expected}")
        self._left -= 1
        if not self._left:
            self.renew()

    def renew(self) -> None:
        """Start with an empty map."""
        self.close()
        self._begin()

    def close(self) -> None:
        """Release the map's files on disk."""
        if hasattr(self.mapper.map, "close"):
            self.mapper.map.close()

    @property
    def _offered_so_far(self) -> int:
        return self.mapper.map.frames + self.mapper.map.frames_refused

    def _answers(self, things: Sequence[Any]) -> list[tuple[str | None, str]]:
        if len(things) == 1:
            return [self._answer(self.mapper, things[0])]
        running = [self._callers.submit(self._answer, self.mapper, thing) for thing in things]
        self.mapper.map.state(np.zeros((4, 3))) if not self.kind.grid else None
        self.mapper.health()
        return [future.result() for future in running]

    def _answer(self, mapper: Any, thing: Any) -> tuple[str | None, str]:
        try:
            report = mapper.add(thing)
        except ConfigError as error:
            return UNFIT, str(error)
        return report.refused, report.detail

    def _begin(self) -> None:
        self.mapper, self._left = self.kind.make(), RENEWED
        self._digest = digest(self.mapper.map)


def check(holds: bool, otherwise: str) -> None:
    """Raise AssertionError with `otherwise` unless `holds`."""
    if not holds:
        raise AssertionError(otherwise)


def digest(voxel_map: Any) -> tuple[Any, ...]:
    """Return a digest of a map in a few numbers; raises AssertionError if a cell is out of range."""
    coords, cells = voxel_map.storage.tiles() if hasattr(voxel_map.storage, "tiles") else voxel_map.storage.blocks()
    limits, format = voxel_map.config.map, voxel_map.storage.cell_format
    lowest, highest = format.stored(np.array([limits.log_odds_min, limits.log_odds_max])).tolist()
    if cells.size:
        least, most = int(cells.min()), int(cells.max())
        check(min(lowest, format.unknown) <= least and most <= max(highest, format.unknown), "a cell is out of range")
    viewpoint = getattr(voxel_map, "viewpoint", None)
    seen = None if viewpoint is None else (viewpoint.T_world_camera.tobytes(), viewpoint.stamp_ns)
    window = getattr(voxel_map, "window", None)
    cells_there = len(coords), crc32(np.ascontiguousarray(coords)), crc32(np.ascontiguousarray(cells))
    return *cells_there, voxel_map.frames, seen, None if window is None else window.tobytes()


def described(thing: Any) -> str:
    """Return a short description of the offered thing."""
    with suppress(AttributeError, KeyError):
        names = {Frame: "depth", StereoFrame: "left", Cloud: "points", Scan: "ranges"}
        image = getattr(thing, names[type(thing)])
        by = thing.camera if isinstance(thing, Frame) else thing.pair.camera if isinstance(thing, StereoFrame) else ""
        return f"{type(thing).__name__} {image.dtype}{list(image.shape)} {by}"[:400]
    return type(thing).__name__


def thing_for(grid: bool, maker: Maker, chance: float) -> Any:
    """Return a frame or a scan that suits the mapper, and occasionally one that does not."""
    if chance < 0.02:
        return maker.nonsense() if chance < 0.01 else maker.scan()
    return maker.scan() if grid and chance < 0.7 else maker.frame()


def run(
    frames: int,
    seed: int | Sequence[int],
    timed_from: int = WARM,
    kinds: Sequence[Kind] = KINDS,
    odd_cameras: bool = True,
    alive: Callable[[int], bool] = lambda number: True,
) -> Tally:
    """Offer `frames` things to mappers in turn and return the results; a warning counts as an exception.

    seed: one number, or one of a run and one of a batch. alive: called before each call with the number of frames so
    far; returns whether to continue.
    """
    maker, rng, tally, number = Maker(seed, odd_cameras), np.random.default_rng(seed), Tally(), 0
    tried, shares = [Tried(kind) for kind in kinds], np.array([kind.share for kind in kinds])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", PendingDeprecationWarning)  # NumPy's, for each matrix
        while number < frames and alive(number):
            one, place = tried[rng.choice(len(tried), p=shares / shares.sum())], f"{seed}, frame {number}"
            try:
                things = [thing_for(one.kind.grid, maker, rng.random()) for _ in range(one.kind.callers)]
                number += len(things)
                tally.frames.update(type(thing).__name__ if isinstance(thing, SEEN) else "nonsense" for thing in things)
                one.add(things, tally, place, number >= timed_from)
            except Exception as error:
                tally.bad.append(f"{place}, {one.kind.name}: {what_happened(error)}")
                one.renew()
    for one in tried:
        one.close()
    return tally


def warm_up(seed: Any, kinds: Sequence[Kind], odd_cameras: bool, alive: Callable[[int], bool]) -> None:
    """Compile the kernels: with ordinary frames, and with some of every kind that need rare kernels."""
    for kind in kinds:
        mapper = kind.make()
        for camera, dtype in product(RARE, DTYPES if odd_cameras else ()):
            alive(0)
            depth = np.full((camera.height, camera.width), 2000 if dtype == "u2" else 2.0, dtype)
            with suppress(ConfigError):
                mapper.add(Frame(depth, camera, np.eye(4), depth_scale=0.001 if dtype == "u2" else 1.0))
    run(WARM, seed, WARM, kinds, odd_cameras, alive)


def what_happened(error: Exception) -> str:
    """Return an exception and its place in one line."""
    place = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__} {str(error)[:200]!r} ({place.filename}:{place.lineno})"


def without(words: Iterable[str]) -> tuple[list[Kind], bool]:
    """Return the kinds whose names contain none of the words, and whether odd cameras are drawn."""
    kinds = [kind for kind in KINDS if not any(word in kind.name for word in words)]
    return kinds, "odd cameras" not in set(words)


def main() -> int:
    """Run by the command line; return the exit status."""
    from watched import Watched

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, help="100,000 where no --seconds are given")
    parser.add_argument("--seconds", type=float)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--batch", type=int, help="only this one, in this process")
    left_out = "leave out kinds of mappers whose names hold it, or 'odd cameras'; repeatable"
    parser.add_argument("--without", action="append", default=[], metavar="WORD", help=left_out)
    parser.add_argument("--json", action="store_true", help="print one JSON object on stdout")
    arguments = parser.parse_args()
    start = perf_counter()
    most = arguments.frames or (100_000 if arguments.seconds is None else sys.maxsize)
    if arguments.batch is not None:
        kinds, odd = without(arguments.without)
        tally, memory = run(most, [arguments.seed, arguments.batch], 0, kinds, odd), {}
    else:
        watched = Watched(arguments.seed, arguments.without, lambda line: print(line, file=sys.stderr, flush=True))
        tally, memory = watched.run(most, arguments.seconds or float("inf")), watched.memory
    seconds = perf_counter() - start
    result = {**tally.as_dict(), **memory, "seconds": round(seconds), "seed": arguments.seed}
    result["frames_per_s"] = round(result["frames"] / seconds)
    print(json.dumps(result) if arguments.json else "\n".join(f"{name}: {value}" for name, value in result.items()))
    return int(tally.failed)


if __name__ == "__main__":
    sys.exit(main())
