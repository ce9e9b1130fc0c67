# SPDX-License-Identifier: Apache-2.0
"""Time stereovox and other libraries on the same frames, in one process."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from time import perf_counter, process_time
from typing import Any, TypeVar

import numpy as np

from stereovox.config import Config, load_config
from stereovox.depth import prepare
from stereovox.errors import ConfigError, StereovoxError
from stereovox.frame import AnyFrame, Frame, UpdateReport
from stereovox.mapper import Mapper
from stereovox_lab.bench.frames import Progress, Recording, depth_for_peers, points_of, read_frames, silent
from stereovox_lab.bench.machine import machine, on_one_processor
from stereovox_lab.bench.peers import ImagePeer, Peer, PeerClass, blamed, find_peer
from stereovox_lab.bench.results import LIBRARY
from stereovox_lab.bench.results import format_table as format_table

MIN_FRAMES = 5
"""Minimum number of frames of a peer, however long they take."""
PASSES = 3
"""stereovox maps all frames this many times, and once more after each peer, to average out machine variations."""
ENOUGH_S = 5.0
"""A variant of stereovox makes no further pass once its timed frames took this many seconds."""

BEYOND = 2.0
"""Distance, in maximum ranges, at which peers get points beyond the range: they clear up to the first."""

T = TypeVar("T")
SoFar = Callable[[dict[str, Any]], None]
"""Called with the result so far."""


@dataclass(frozen=True)
class Variant:
    """Variant of stereovox: an integrator by name and a number of threads."""

    integrator: str = "projective"
    threads: int = 1

    @property
    def library(self) -> str:
        """Name of its rows: `stereovox`, or `stereovox-ray`."""
        return LIBRARY if self.integrator == "projective" else f"{LIBRARY}-{self.integrator}"

    def config(self, voxel_size: float, max_range: float | None = None) -> Config:
        """Return the default profile's settings with this variant's; raises ConfigError."""
        more: dict[str, Any] = {} if max_range is None else {"max_range": max_range}
        return load_config(voxel_size=float(voxel_size), threads=self.threads, integrator=self.integrator, **more)


@dataclass
class _Watch:
    """Times of calls in milliseconds, and their total processor time."""

    times_ms: list[float] = field(default_factory=list)
    cpu_ms: float = 0.0

    def call(self, function: Callable[[], T]) -> T:
        """Time a call and return its result."""
        cpu, start = process_time(), perf_counter()
        result = function()
        self.times_ms.append(1e3 * (perf_counter() - start))
        self.cpu_ms += 1e3 * (process_time() - cpu)
        return result

    @property
    def share(self) -> float:
        """Number of processors the calls kept busy: less than 1 if other programs interfered."""
        return round(self.cpu_ms / max(sum(self.times_ms), 1e-6), 3)


@dataclass(frozen=True)
class _Limits:
    """When a peer may stop: after `seconds` of inserting, but not before `MIN_FRAMES` frames.

    range_m: end of rays beyond the maximum range; 0: frames have no such pixels.
    """

    seconds: float
    range_m: float = 0.0

    def reached(self, times_ms: Sequence[float]) -> bool:
        return len(times_ms) >= MIN_FRAMES and sum(times_ms) >= 1e3 * self.seconds


def bench(
    source: Iterable[AnyFrame],
    voxel_sizes: Sequence[float],
    peers: Sequence[str],
    threads: int = 1,
    max_range: float | None = None,
    frames_limit: int | None = None,
    progress: Progress | None = None,
    budget_s: float = 60.0,
    variants: Sequence[Variant] = (),
) -> dict[str, Any]:
    """Time stereovox and `peers` (names in `PEERS`, or `module:Class`) on the same frames at each voxel size in metres.

    Same pixels: those without a value and those beyond `max_range` (None: the default profile's) are left out for all,
    including ours, so no library clears space through them. Same poses: made exactly rigid once. All frames (at most
    `frames_limit`) are in memory before timing starts.

    Timed: for stereovox the `integrate_ms` of each frame that `Mapper.add` reports, after all frames went once through
    a discarded map, so that kernels are compiled; several passes, one before each peer (only one if that takes
    seconds), pooled. Its depth preparation is separate as `depth_ms_median`, the whole call as `add_ms_median`. For a
    peer its insertion alone, in one thread, after one frame into a discarded map; its points are made before. Work of a
    peer's Python binding on the points is included: a Python user pays for it, a C++ program would not.


    A peer stops after `budget_s` seconds of inserting at one voxel size, with at least 5 frames: `frames` reports the
    number done, and if that is fewer than ours, its cells and bytes cannot be compared.

    Returns `rows` of `library, voxel_size, threads, frames, integrate_ms_median, integrate_ms_p90, integrate_ms_p99,
    occupied, free, map_bytes, cpu_share` (processors kept busy while timed; a single thread that got clearly less than
    one had to wait for other programs); `variants`: rows like these of further ways to run stereovox;
    `ratio[str(voxel_size)][peer]` = peer's median / our median; and `source, image, frames, frames_refused,
    first_refusal, max_range, budget_s, machine`. Cells count as each library defines them: by its own thresholds for
    stereovox, above and below 0.5 for the others.
    Raises ConfigError for an unknown or unusable peer or bad setting, MissingExtra for a peer that is not installed,
    StereovoxError if no frame is usable or a peer fails: one line each.
    """
    variants = [Variant(threads=threads), *variants]
    configs = _configs(voxel_sizes, variants, max_range)
    kinds = find_peers(peers, configs[0][0].voxel_size)
    recording = read_frames(source, configs[0][0], frames_limit, progress or silent)
    return compare(recording, voxel_sizes, kinds, variants, max_range, progress or silent, budget_s)


def find_peers(names: Sequence[str], voxel_size: float) -> dict[str, PeerClass]:
    """Return peers by name; a missing or failing one is reported here, before a long recording is read."""
    kinds = {name: find_peer(name) for name in names}
    for name, kind in kinds.items():
        with blamed(f"peer '{name}' cannot be made", ConfigError):
            kind(voxel_size)
    return kinds


def compare(
    recording: Recording,
    voxel_sizes: Sequence[float],
    peers: dict[str, PeerClass],
    variants: Sequence[Variant],
    max_range: float | None = None,
    tell: Progress = silent,
    budget_s: float = 60.0,
    so_far: SoFar = lambda result: None,
) -> dict[str, Any]:
    """Do as `bench` with frames in memory; peers are compared with the first of `variants`.

    so_far: called with the result after each voxel size, so that a long run can be stopped.
    If the recording has pixels beyond the maximum range, they clear space up to it; the result's `far_share`
    is their share of all pixels, and peers that cannot do that are left out: `not_clearing` names them.
    """
    sizes = _configs(voxel_sizes, variants, max_range)
    clearing = recording.far_share > 0
    lacking = [name for name, kind in peers.items() if clearing and not hasattr(kind, "reach")]
    peers = {name: kind for name, kind in peers.items() if name not in lacking}
    result: dict[str, Any] = {
        "source": recording.name,
        "image": recording.size,
        "frames": len(recording.frames),
        "frames_refused": len(recording.refusals),
        "first_refusal": next(iter(recording.refusals), ""),
        "max_range": sizes[0][0].max_range,
        "far_share": round(recording.far_share, 4),
        "not_clearing": lacking,
        "budget_s": budget_s,
        "machine": machine(),
        "rows": [],
        "variants": [],
        "ratio": {},
    }
    for configs in sizes:
        flights = [
            _Flights(variant, config, recording.frames, tell) for variant, config in zip(variants, configs, strict=True)
        ]
        limits = _Limits(budget_s, configs[0].max_range if clearing else 0.0)
        theirs = _timed(flights, peers, recording.frames, configs[0], limits, tell)
        ours, *others = [flight.row() for flight in flights]
        result["rows"] += [ours, *theirs]
        result["variants"] += others
        result["ratio"][str(configs[0].voxel_size)] = {row["library"]: _ratio(row, ours) for row in theirs}
        so_far(result)
    return result


def _configs(voxel_sizes: Sequence[float], variants: Sequence[Variant], max_range: float | None) -> list[list[Config]]:
    configs = [[variant.config(size, max_range) for variant in variants] for size in dict.fromkeys(voxel_sizes)]
    if not configs:
        raise StereovoxError("no voxel size to time; give at least one in metres, for example 0.05")
    return configs


def _timed(
    flights: Sequence[_Flights],
    peers: dict[str, PeerClass],
    frames: list[Frame],
    config: Config,
    limits: _Limits,
    tell: Progress,
) -> list[dict[str, Any]]:
    """Run stereovox and each peer on the frames, taking turns; return the peers' rows."""
    for flight in flights:
        flight.fly("warming up")
    waiting, rows = list(peers.items()), []
    for _ in range(max(PASSES, len(waiting) + 1)):
        for flight in flights:
            if flight.seconds < ENOUGH_S:
                flight.fly("timing", timed=True)
        if waiting:
            name, kind = waiting.pop(0)
            with blamed(f"peer '{name}' at {config.voxel_size:g} m"):
                alone = on_one_processor if getattr(kind, "one_processor", False) else _freely
                rows.append(alone(_time_peer, name, kind, frames, config, limits, tell))
    return rows


class _Flights:
    """Passes of the frames through stereovox, each into a new map."""

    def __init__(self, variant: Variant, config: Config, frames: list[Frame], tell: Progress):
        self._variant, self._config, self._frames, self._tell = variant, config, frames, tell
        self._reports: list[UpdateReport] = []
        self._watch = _Watch()
        self._map: dict[str, Any] = {}

    @property
    def seconds(self) -> float:
        """Duration of the timed frames."""
        return sum(self._watch.times_ms) / 1e3

    def fly(self, text: str, timed: bool = False) -> None:
        """Add all frames to a new map, and record the times if `timed`."""
        mapper, threads = Mapper(self._config), self._variant.threads
        where = f"{self._variant.library}{f', {threads} threads,' * (threads > 1)} at {self._config.voxel_size:g} m"
        self._tell(0, len(self._frames), f"{where}, {text}{'' if timed else ': compiling, if need be'}")
        for i, frame in enumerate(self._frames):
            if timed:
                self._reports.append(self._watch.call(lambda frame=frame: mapper.add(frame)))
            else:
                mapper.add(frame)
            self._tell(i + 1, len(self._frames), f"{where}, {text}")
        counts = mapper.map.counts()
        self._map = {"occupied": counts["occupied"], "free": counts["free"], "map_bytes": mapper.map.memory_bytes}

    def row(self) -> dict[str, Any]:
        """Return the row of this variant."""
        row = _row(self._variant.library, self._config, self._variant.threads, [r.integrate_ms for r in self._reports])
        more = {
            "frames": len(self._frames),
            "passes": len(self._reports) // len(self._frames),
            "integrator": self._variant.integrator,
            "depth_ms_median": median([report.depth_ms for report in self._reports]),
            "add_ms_median": median(self._watch.times_ms),
            "cpu_share": self._watch.share,
        }
        return row | self._map | more


def _freely(make: Callable[..., T], *arguments: Any) -> T:
    return make(*arguments)


def _time_peer(
    name: str, kind: PeerClass, frames: list[Frame], config: Config, limits: _Limits, tell: Progress
) -> dict[str, Any]:
    insertion(_new(kind, config, limits), frames[0], config, limits.range_m)()
    peer, watch = _new(kind, config, limits), _Watch()
    for done, frame in enumerate(frames, start=1):
        watch.call(insertion(peer, frame, config, limits.range_m))
        tell(done, len(frames), f"{name} at {config.voxel_size:g} m")
        if limits.reached(watch.times_ms):
            break
    occupied, free = peer.counts()
    cells = {"occupied": int(occupied), "free": int(free)}
    more = {**cells, "map_bytes": int(peer.bytes()), "cpu_share": watch.share}
    return _row(name, config, 1, watch.times_ms) | more


def _new(kind: PeerClass, config: Config, limits: _Limits) -> Peer | ImagePeer:
    """Return an empty map, set to where rays without a surface end."""
    peer: Any = kind(config.voxel_size)
    if limits.range_m:
        peer.reach(limits.range_m)
    return peer


def insertion(peer: Any, frame: Frame, config: Config, range_m: float) -> Callable[[], None]:
    """Return the timed call that inserts a frame into a peer; its inputs are prepared here.

    range_m: end of rays set by `reach`, for pixels beyond it; 0: these have no value.
    """
    image, beyond_m = prepare(frame, config), BEYOND * range_m
    if isinstance(peer, ImagePeer):
        seen = depth_for_peers(image, beyond_m), image.camera, image.T_world_sensor
        prepared = getattr(peer, "prepared_image", None)
        return prepared(*seen) if prepared else partial(peer.insert_image, *seen)
    points = points_of(image, beyond_m)
    return peer.prepared(*points) if hasattr(peer, "prepared") else partial(peer.insert, *points)


def _row(library: str, config: Config, threads: int, times_ms: Sequence[float]) -> dict[str, Any]:
    return {
        "library": library,
        "voxel_size": config.voxel_size,
        "threads": threads,
        "frames": len(times_ms),
        "integrate_ms_median": median(times_ms),
        "integrate_ms_p90": round(float(np.percentile(times_ms, 90)), 4),
        "integrate_ms_p99": round(float(np.percentile(times_ms, 99)), 4),
    }


def median(times: Sequence[float]) -> float:
    """Return the median to four places."""
    return round(float(np.median(times)), 4)


def _ratio(peer: dict[str, Any], ours: dict[str, Any]) -> float:
    return round(peer["integrate_ms_median"] / max(ours["integrate_ms_median"], 1e-4), 3)
