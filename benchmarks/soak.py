# SPDX-License-Identifier: Apache-2.0
"""An hour of flight: is memory constant, and is every frame in time?

    python benchmarks/soak.py [--frames 108000] [--stereo] [--deadline-ms 33] [--json] [--picture soak.png]

A loop of simulated frames is rendered once and flown back and forth as fast as frames are accepted, with stamps that
rise by 1/30 s and a start that drifts through space, so that the map's window keeps moving. `wall`: milliseconds of
`Mapper.add` by wall clock, `cpu`: the same in CPU time of all threads, which other processes disturb less. The first
minute, in which kernels are compiled and memory is allocated, is the reference for the rest.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections import Counter
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
import psutil

import stereovox as sv
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.config import parse_value
from stereovox.frame import AnyFrame
from stereovox.simulate.d435 import photograph
from stereovox.simulate.simulation import Simulation

HZ = 30
MINUTE = 60 * HZ
DRIFT_MPS = 0.05
SETTINGS = {"voxel_size": 0.1, "window.size": [12.0, 12.0, 6.0], "window.trigger": 0.5}
PERCENTILES = (50, 99, 100)


class Loop:
    """Frames in a temporary file, so that they do not count as memory; frame(i) exists for every i from 0 on."""

    def __init__(self, count: int, width: int, stereo: bool):
        self._source = Simulation(f"sim:room?image_width={width}&frames={count}")
        self._camera, self._count, self._stereo = self._source.camera, count, stereo
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - lives as long as the loop
        for i in range(count):
            for image in self._pair(i) if stereo else self._depth(i):
                self._file.write(image.tobytes())

    def frame(self, i: int) -> AnyFrame:
        """Return frame number `i` of the flight."""
        there, back = i % (2 * self._count), 2 * self._count - 1 - i % (2 * self._count)
        k, stamp_ns, name = min(there, back), i * 1_000_000_000 // HZ, f"frame {i}"
        T = self._source.pose(k).copy()
        T[0, 3] += DRIFT_MPS * i / HZ
        if self._stereo:
            left, right = self._read(k, (np.uint8, np.uint8))
            return sv.StereoFrame(left, right, sv.StereoPair(self._camera), T, stamp_ns, name)
        depth, reason = self._read(k, (np.uint16, np.uint8))
        return sv.Frame(depth, self._camera, T, stamp_ns, 0.001, reason, name)

    def _read(self, k: int, dtypes: tuple[type, type]) -> list[np.ndarray]:
        shape = self._camera.height, self._camera.width
        sizes = [np.dtype(dtype).itemsize * shape[0] * shape[1] for dtype in dtypes]
        self._file.seek(k * sum(sizes))
        parts = zip(dtypes, sizes, strict=True)
        return [np.frombuffer(self._file.read(size), dtype).reshape(shape) for dtype, size in parts]

    def _depth(self, i: int) -> list[np.ndarray]:
        frame = self._source.frame(i)
        assert frame.reason is not None
        return [frame.depth, frame.reason]

    def _pair(self, i: int) -> list[np.ndarray]:
        T = [self._source.pose(i), self._source.pose(i)]
        T[1][:3, 3] += T[1][:3, 0] * self._camera.baseline
        lens = lens_of(self._camera)
        return [photograph(self._source.scene, lens, pose, 1.0, [i, k]) for k, pose in enumerate(T)]


def main() -> None:
    wanted = arguments()
    mapper = sv.Mapper(**{**SETTINGS, "deadline_ms": wanted.deadline_ms, **dict(wanted.set)})
    print(f"rendering {wanted.loop} frames of {wanted.width} pixels across ...", file=sys.stderr)
    loop = Loop(wanted.loop, wanted.width, wanted.stereo)
    found = fly(mapper, loop, wanted.frames)
    if wanted.picture:
        draw(found, wanted.picture)
    if wanted.json:
        print(json.dumps(found))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--frames", type=int, default=108_000, help="108000: an hour at 30 Hz")
    parser.add_argument("--stereo", action="store_true", help="stereo pairs through matching, not depth images")
    parser.add_argument("--width", type=int, default=640, help="pixels across")
    parser.add_argument("--loop", type=int, default=240, help="frames that are rendered")
    parser.add_argument("--deadline-ms", type=float, help="milliseconds a frame may take")
    parser.add_argument("--set", type=setting, action="append", default=[], metavar="NAME=VALUE", help="any setting")
    parser.add_argument("--json", action="store_true", help="all figures as JSON on stdout")
    parser.add_argument("--picture", type=Path, help="PNG of memory and times by the minute")
    return parser.parse_args()


def setting(text: str) -> tuple[str, object]:
    name, _, value = text.partition("=")
    return name, parse_value(value)


def fly(mapper: sv.Mapper, loop: Loop, count: int) -> dict:
    """Add `count` frames; return the figures of every minute and of the whole, printing them on the way."""
    process = psutil.Process()
    wall, cpu = np.full(count, np.nan), np.full(count, np.nan)  # allocated and touched now, not while memory is watched
    refused, ways, minutes = Counter(), Counter(), []
    say(" minute  RSS MB   map MB   wall ms: p50    p99    max   cpu ms: p50    p99    max   refused  load")
    for i in range(count):
        frame = loop.frame(i)
        start, start_cpu = perf_counter(), process_time()
        report = mapper.add(frame)
        wall[i], cpu[i] = 1e3 * (perf_counter() - start), 1e3 * (process_time() - start_cpu)
        if report.refused:
            refused[report.refused] += 1
        else:
            ways[report.quality] += 1
        if (i + 1) % MINUTE == 0 or i + 1 == count:
            part = slice(i // MINUTE * MINUTE, i + 1)
            minutes.append(
                {
                    "minute": len(minutes) + 1,
                    "rss_bytes": process.memory_info().rss,
                    "map_bytes": mapper.map.memory_bytes,
                    "wall_ms": percentiles(wall[part]),
                    "cpu_ms": percentiles(cpu[part]),
                    "refused": refused.total(),
                    "load": os.getloadavg()[0],
                }
            )
            tell(minutes[-1])
    after = slice(MINUTE if count > MINUTE else 0, None)
    rss = np.array([minute["rss_bytes"] for minute in minutes], float)
    found = {
        "frames": count,
        "frames_refused": refused.total(),
        "refused": dict(refused),
        "ways": dict(ways),
        "rss_change_percent": 100 * (rss[-1] / rss[0] - 1),
        "rss_farthest_percent": 100 * float(np.abs(rss / rss[0] - 1).max()),
        "wall_ms": percentiles(wall[after]),
        "cpu_ms": percentiles(cpu[after]),
        "minutes": minutes,
    }
    say(f"{count} frames, {found['frames_refused']} refused {found['refused'] or ''}, ways {found['ways']}")
    change, farthest = found["rss_change_percent"], found["rss_farthest_percent"]
    say(f"RSS since the first minute: {change:+.2f} % at the end, {farthest:.2f} % at most")
    for name in ("wall", "cpu"):
        told = ", ".join(f"{key} {value:.2f}" for key, value in found[f"{name}_ms"].items())
        say(f"{name} ms a frame after the first minute: {told}")
    return found


def percentiles(milliseconds: np.ndarray) -> dict[str, float]:
    values = np.percentile(milliseconds, PERCENTILES)
    return dict(zip(("median", "p99", "max"), (round(float(value), 3) for value in values), strict=True))


def tell(minute: dict) -> None:
    times = ["{median:17.2f} {p99:6.2f} {max:6.1f}".format(**minute[name]) for name in ("wall_ms", "cpu_ms")]
    megabytes = f"{minute['rss_bytes'] / 1e6:7.1f} {minute['map_bytes'] / 1e6:8.1f}"
    say(f"{minute['minute']:7} {megabytes} {''.join(times)} {minute['refused']:9} {minute['load']:5.1f}")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def draw(found: dict, path: Path) -> None:
    """Draw memory and the slowest hundredth of the frames against the minutes of flight."""
    from stereovox.view.figures import blank, labels, png_of

    minutes = found["minutes"]
    at = [minute["minute"] for minute in minutes]
    figure = blank(7, 4.5)
    memory, times = figure.subplots(2, 1, sharex=True)
    memory.plot(at, [minute["rss_bytes"] / 1e6 for minute in minutes], color="C0")
    memory.set_ylim(0, 1.2 * max(minute["rss_bytes"] for minute in minutes) / 1e6)
    for name, colour, label in (("wall_ms", "C1", "on the clock"), ("cpu_ms", "C2", "of the processor")):
        times.plot(at, [minute[name]["p99"] for minute in minutes], color=colour, label=label)
    times.set_ylim(bottom=0)
    times.legend(frameon=False)
    memory.set_title(f"{found['frames']:,} frames, one after the other, into one map", fontsize=10)
    labels(memory, "", "memory of the process, MB")
    labels(times, "minutes of flight", "ms that 99 % of frames keep")
    path.write_bytes(png_of(figure, 120))


def lens_of(camera: PinholeCamera) -> Lens:
    return Lens("pinhole", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


if __name__ == "__main__":
    main()
