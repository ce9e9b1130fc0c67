# SPDX-License-Identifier: Apache-2.0
"""How fast is stereovox beside other libraries? The same frames through all of them, in one process."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import Config, load_config
from stereovox.depth import DepthPath, prepare
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.evaluate.peers import Peer, find_peer
from stereovox.frame import AnyFrame, Frame, Reason
from stereovox.mapper import Mapper

OURS = "stereovox"
MIN_FRAMES = 5
"""A peer does so many frames however long they take."""

Progress = Callable[[int, int, str], None]
"""Called with frames done, frames in all (0: not known), and what is being done."""


@dataclass(frozen=True)
class _Limits:
    """When a peer may stop: after `seconds` of inserting, but not before `MIN_FRAMES` frames."""

    seconds: float

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
) -> dict[str, Any]:
    """Time stereovox and `peers` (names in `PEERS`) on the same frames at each voxel size in metres.

    Same pixels: those without a value and those beyond `max_range` (None: the default profile's) are left out for all,
    ours included, so nobody clears space through them. Same poses: made exactly rigid once. All frames (at most
    `frames_limit`) are in memory before the clock starts.

    Timed: for stereovox the `integrate_ms` of each frame, after all frames went once through a map that is thrown away,
    so that kernels are compiled; its depth preparation stands apart as `depth_ms_median`. For a peer its insertion
    alone, in one thread, after one frame into a map that is thrown away; its points are made before. What a peer's
    Python binding does with the points is part of it: a Python user pays that, a C++ program would not.

    A peer stops after `budget_s` seconds of inserting at one voxel size, with at least 5 frames: `frames` tells how
    many it did, and if that is fewer than ours, its cells and bytes cannot be compared.

    Returns `rows` of `library, voxel_size, threads, frames, integrate_ms_median, integrate_ms_p90, occupied, free,
    map_bytes`; `ratio[str(voxel_size)][peer]` = peer's median / our median; and `source, image, frames,
    frames_refused, first_refusal, max_range, budget_s`. Cells count as each library defines them: occupied above
    p = 0.7 and free below 0.3 for stereovox, above and below 0.5 for OctoMap.
    Raises ConfigError for an unknown peer or bad setting, MissingExtra for a peer that is not installed,
    StereovoxError when no frame can be used: one line each.
    """
    tell = progress or (lambda done, total, text: None)
    configs = _configs(voxel_sizes, threads, max_range)
    kinds = {name: find_peer(name) for name in peers}
    for kind in kinds.values():
        kind(configs[0].voxel_size)  # a library that is missing shows before a long recording is read
    frames, refused = _load(source, configs[0], frames_limit, tell)
    rows: list[dict[str, Any]] = []
    ratio: dict[str, dict[str, float]] = {}
    for config in configs:
        ours = _time_ours(frames, config, tell)
        theirs = [_time_peer(name, kind, frames, config, _Limits(budget_s), tell) for name, kind in kinds.items()]
        rows += [ours, *theirs]
        ratio[str(config.voxel_size)] = {row["library"]: _ratio(row, ours) for row in theirs}
    camera = frames[0].camera
    return {
        "source": getattr(source, "name", "frames"),
        "image": f"{camera.width}x{camera.height}",
        "frames": len(frames),
        "frames_refused": len(refused),
        "first_refusal": next(iter(refused), ""),
        "max_range": configs[0].max_range,
        "budget_s": budget_s,
        "rows": rows,
        "ratio": ratio,
    }


def _configs(voxel_sizes: Sequence[float], threads: int, max_range: float | None) -> list[Config]:
    more: dict[str, Any] = {} if max_range is None else {"max_range": max_range}
    configs = [load_config(voxel_size=float(size), threads=threads, **more) for size in dict.fromkeys(voxel_sizes)]
    if not configs:
        raise StereovoxError("no voxel size to time; give at least one in metres, for example 0.05")
    return configs


def _load(
    source: Iterable[AnyFrame], config: Config, limit: int | None, tell: Progress
) -> tuple[list[Frame], list[str]]:
    """Return the frames that can be used, only the pixels in them that count, and why others were refused."""
    total = operator.length_hint(source)
    total = total if limit is None else min(total, limit)
    frames: list[Frame] = []
    refusals: list[str] = []
    path = DepthPath(config)
    for done, frame in enumerate(islice(source, limit), start=1):
        try:
            frames.append(_only_valid_pixels(path.matched(frame), config))
        except FrameRefused as refused:
            refusals.append(str(refused))
        tell(done, total, "reading frames")
    if not frames:
        why = next(iter(refusals), "the source is empty")
        raise StereovoxError(f"{getattr(source, 'name', 'frames')}: not one frame can be used ({why})")
    return frames, refusals


def _only_valid_pixels(frame: Frame, config: Config) -> Frame:
    """Return the frame in its own units, all that has no value up to the maximum range set to 0."""
    image = prepare(frame, config)
    valid = image.reason == Reason.VALID
    if not valid.any():
        raise FrameRefused("no_valid_depth", f"{frame.name or 'a frame'}: no depth up to {config.max_range:g} m")
    depth = np.where(valid, frame.depth, 0).astype(frame.depth.dtype)
    return replace(frame, depth=depth, reason=None, T_world_sensor=image.T_world_sensor)


def _points(frame: Frame, config: Config) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the frame's points (N, 3) in the world and the camera's position (3,)."""
    image = prepare(frame, config)
    T = image.T_world_sensor
    v, u = np.nonzero(image.reason == Reason.VALID)
    columns, rows = frame.camera.rays()
    points = np.column_stack([columns[u], rows[v]]) * image.depth_m[v, u, None].astype(float)
    return np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3]), T[:3, 3].copy()


def _time_ours(frames: list[Frame], config: Config, tell: Progress) -> dict[str, Any]:
    for text in ("warming up", "timing"):
        mapper, reports = Mapper(config), []
        for i, frame in enumerate(frames):
            reports.append(mapper.add(frame))
            tell(i + 1, len(frames), f"{OURS} at {config.voxel_size:g} m, {text}")
    counts = mapper.map.counts()
    row = _row(OURS, config, config.threads, [report.integrate_ms for report in reports])
    row |= {"occupied": counts["occupied"], "free": counts["free"], "map_bytes": mapper.map.memory_bytes}
    return row | {"depth_ms_median": _median([report.depth_ms for report in reports])}


def _time_peer(
    name: str, kind: type[Peer], frames: list[Frame], config: Config, limits: _Limits, tell: Progress
) -> dict[str, Any]:
    kind(config.voxel_size).insert(*_points(frames[0], config))
    peer, times_ms = kind(config.voxel_size), []
    for frame in frames:
        points, origin = _points(frame, config)
        start = perf_counter()
        peer.insert(points, origin)
        times_ms.append(1e3 * (perf_counter() - start))
        tell(len(times_ms), len(frames), f"{name} at {config.voxel_size:g} m")
        if limits.reached(times_ms):
            break
    occupied, free = peer.counts()
    return _row(name, config, 1, times_ms) | {"occupied": occupied, "free": free, "map_bytes": peer.bytes()}


def _row(library: str, config: Config, threads: int, times_ms: Sequence[float]) -> dict[str, Any]:
    return {
        "library": library,
        "voxel_size": config.voxel_size,
        "threads": threads,
        "frames": len(times_ms),
        "integrate_ms_median": _median(times_ms),
        "integrate_ms_p90": round(float(np.percentile(times_ms, 90)), 4),
    }


def _median(times_ms: Sequence[float]) -> float:
    return round(float(np.median(times_ms)), 4)


def _ratio(peer: dict[str, Any], ours: dict[str, Any]) -> float:
    return round(peer["integrate_ms_median"] / max(ours["integrate_ms_median"], 1e-4), 3)


def format_table(result: dict[str, Any]) -> str:
    """Return the result of `bench` as plain text: a block of lines for each voxel size, stereovox first."""
    head = ("voxel", "library", "threads", "frames", "ms/frame", "p90", "stereovox is", "occupied", "free", "map MB")
    lines = [head, *(_cells(row, result["ratio"]) for row in result["rows"])]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = [_title(result), ""]
    for line in lines:
        if line[1] == OURS:
            text.append("")
        aligned = [
            cell.ljust(w) if i < 2 else cell.rjust(w) for i, (cell, w) in enumerate(zip(line, widths, strict=True))
        ]
        text.append("  ".join(aligned).rstrip())
    return "\n".join([*text, "", *_notes(result)])


def _title(result: dict[str, Any]) -> str:
    return f"{result['source']}: {result['frames']} frames of {result['image']}, depth up to {result['max_range']:g} m"


def _cells(row: dict[str, Any], ratio: dict[str, dict[str, float]]) -> tuple[str, ...]:
    times = ratio[str(row["voxel_size"])].get(row["library"])
    ours = row["library"] == OURS
    return (
        f"{row['voxel_size']:g} m" if ours else "",
        row["library"],
        str(row["threads"]),
        str(row["frames"]),
        f"{row['integrate_ms_median']:.2f}",
        f"{row['integrate_ms_p90']:.2f}",
        "" if times is None else _faster(times),
        f"{row['occupied']:,}",
        f"{row['free']:,}",
        f"{row['map_bytes'] / 1e6:.1f}",
    )


def _faster(times: float) -> str:
    """Return a ratio in words, from our side."""
    if times < 1:
        return f"{1 / max(times, 1e-3):.1f} x slower"
    return f"{times:.0f} x faster" if times >= 10 else f"{times:.1f} x faster"


def _notes(result: dict[str, Any]) -> list[str]:
    notes = [
        "ms/frame: median time of the call that takes a frame in; making depth images or points is not part of it.",
        "Cells as each library defines them: occupied above p = 0.7, free below 0.3; for OctoMap above, below 0.5.",
    ]
    if result["frames_refused"]:
        notes.append(f"{result['frames_refused']} frames were refused, first: {result['first_refusal']}")
    for row in result["rows"]:
        if row["frames"] < result["frames"]:
            done = f"{row['frames']} of {result['frames']} frames"
            which = f"{row['library']} at {row['voxel_size']:g} m"
            notes.append(f"{which} stopped at its time limit after {done}: do not compare its cells and MB.")
    return notes
