# SPDX-License-Identifier: Apache-2.0
"""Twenty minutes along an aisle that never returns: are memory and time per frame constant?

    python benchmarks/track_long.py [--minutes 20] [--stereo] [--width 160] [--speed 0.5] [--json]

A camera walks through ever new scenery (random pilasters, boxes, beams) at 15 Hz, with the errors of a D435 whose
pixels were averaged to this size, or as a pair of grey images (--stereo --width 320), and is tracked; there is no loop.
Figures by the minute: resident memory, CPU time of `Tracker.add` in milliseconds a frame, lost frames, and the position
error, by the path so far. The second minute is the reference for the last: in the first, kernels are compiled and
tables grow.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from time import process_time

import numpy as np
import psutil
from numpy.typing import NDArray

import stereovox as sv
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.geometry.se3 import Transform, inverse, look_at
from stereovox.simulate.d435 import D435, HFOV_DEG, photograph
from stereovox.simulate.scene import Scene, Solid, box

HZ = 15
MINUTE = 60 * HZ
SECTION_M, AROUND = 10.0, 2
"""Length of a section of the aisle, and how many are built ahead of and behind the camera's own."""
HALF_M, HIGH_M, THICK_M = 1.6, 2.7, 0.3
"""Half the aisle's width, its height, and the thickness of its walls."""
EYE_M = 1.3
MAX_RANGE_M = 6.0


@lru_cache(maxsize=2 * AROUND + 2)
def section(number: int) -> list[Solid]:
    """Return the solids of one section of the aisle, randomised by its number."""
    random = np.random.default_rng([7, number + AROUND])
    start, end = number * SECTION_M, (number + 1) * SECTION_M
    solids = [
        box("wall", f"left {number}", (start, HALF_M, 0), (end, HALF_M + THICK_M, HIGH_M)),
        box("wall", f"right {number}", (start, -HALF_M - THICK_M, 0), (end, -HALF_M, HIGH_M)),
        box("floor", f"floor {number}", (start, -HALF_M, -THICK_M), (end, HALF_M, 0)),
        box("ceiling", f"ceiling {number}", (start, -HALF_M, HIGH_M), (end, HALF_M, HIGH_M + THICK_M)),
    ]
    for k in range(20):
        side, x, wide, deep = random.choice((-1, 1)), random.uniform(start, end), *random.uniform(0.15, 0.5, 2)
        low, high = sorted((side * HALF_M, side * (HALF_M - deep)))
        solids.append(box("pilaster", f"pilaster {number} {k}", (x, low, 0), (x + wide, high, HIGH_M)))
    for k in range(14):
        side, x, y = random.choice((-1, 1)), random.uniform(start, end), random.uniform(0.8, 1.3)
        half, high = random.uniform(0.1, 0.35, 2), random.uniform(0.2, 1.4)
        low_corner, high_corner = (x - half[0], side * y - half[1], 0), (x + half[0], side * y + half[1], high)
        solids.append(box("box", f"box {number} {k}", low_corner, high_corner, turn=random.uniform(0, np.pi)))
    x = random.uniform(start, end)
    solids.append(box("beam", f"beam {number}", (x, -HALF_M, HIGH_M - 0.4), (x + 0.3, HALF_M, HIGH_M)))
    return solids


@lru_cache(maxsize=1)
def scenery(number: int) -> Scene:
    """Return the scenery visible from a section, with walls at both ends."""
    first, last = (number - AROUND) * SECTION_M, (number + AROUND + 1) * SECTION_M
    ends = [box("end", f"end {x:g}", (x, -2, 0), (x + THICK_M, 2, HIGH_M)) for x in (first, last)]
    around = range(number - AROUND, number + AROUND + 1)
    return Scene([*ends, *(solid for k in around for solid in section(k))])


def pose(seconds: float, speed: float) -> Transform:
    """Return T_world_camera of the walk: ahead, a little to both sides, looking around."""
    x = speed * seconds
    eye = np.array([x, 0.25 * np.sin(0.6 * seconds), EYE_M + 0.05 * np.sin(1.1 * seconds)])
    yaw = 0.3 * np.sin(0.35 * seconds)
    return look_at(eye, eye + np.array([np.cos(yaw), np.sin(yaw), -0.2]))


class Walk:
    """Images of the walk. camera: its left eye."""

    def __init__(self, width: int, speed: float, stereo: bool):
        self.camera = PinholeCamera.from_field_of_view(width, width * 3 // 4, HFOV_DEG, baseline=0.05)
        if stereo:
            self.camera = replace(self.camera, baseline=0.12)
        self.sensor = D435(self.camera, subpixel=0.08 * (width / 848) ** 2)
        self._speed, self._pair = speed, sv.StereoPair(self.camera) if stereo else None
        x, y = self.camera.ray_slopes()
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1)
        self._rays = rays.reshape(-1, 3)

    def frames(self, count: int) -> Iterator[sv.Frame | sv.StereoFrame]:
        """Yield images with their true poses."""
        for i in range(count):
            T = pose(i / HZ, self._speed)
            scene, stamp_ns = scenery(int(T[0, 3] // SECTION_M)), i * 1_000_000_000 // HZ
            if self._pair is None:
                depth, reason = self.sensor.measure(self._cast(scene, T), [1, i])
                yield sv.Frame(depth, self.camera, T, stamp_ns, 0.001, reason, f"frame {i}")
            else:
                left, right = (self._photograph(scene, T, eye, i) for eye in (0, 1))
                yield sv.StereoFrame(left, right, self._pair, T, stamp_ns, f"frame {i}")

    def _cast(self, scene: Scene, T: Transform) -> NDArray[np.float32]:
        rays = self._rays @ T[:3, :3].T.astype(np.float32)
        return scene.cast(T[:3, 3], rays).reshape(self.camera.height, self.camera.width)

    def _photograph(self, scene: Scene, T: Transform, eye: int, i: int) -> NDArray[np.uint8]:
        camera, there = self.camera, T.copy()
        there[:3, 3] += eye * (camera.baseline or 0.0) * T[:3, 0]
        lens = Lens("pinhole", camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
        return photograph(scene, lens, there, 1.0, [i, eye])


def track(walk: Walk, count: int) -> dict:
    """Track `count` frames; return the figures of every minute, printing them on the way."""
    tracker = sv.Tracker(max_range=MAX_RANGE_M, **{"noise.subpixel": walk.sensor.subpixel})
    process, minutes = psutil.Process(), []
    cpu, lost = np.full(count, np.nan), np.zeros(count, bool)  # touched now, not while memory is watched
    first, travelled, before, off = None, 0.0, None, np.nan
    say("minute  RSS MB   cpu ms: p50    p99    max   lost   metres   off m   load")
    for i, frame in enumerate(walk.frames(count)):
        start = process_time()
        tracked = tracker.add(frame)
        cpu[i], lost[i] = 1e3 * (process_time() - start), bool(tracked.lost)
        true = frame.T_world_sensor
        travelled += 0.0 if before is None else float(np.linalg.norm(true[:3, 3] - before))
        before = true[:3, 3]
        if not tracked.lost:
            first = first or (true, tracked.T_world_sensor)
            laid = first[0] @ inverse(first[1]) @ tracked.T_world_sensor
            off = float(np.linalg.norm(laid[:3, 3] - true[:3, 3]))
        if (i + 1) % MINUTE == 0 or i + 1 == count:
            part = slice(i // MINUTE * MINUTE, i + 1)
            minutes.append(
                {
                    "minute": len(minutes) + 1,
                    "rss_bytes": process.memory_info().rss,
                    "cpu_ms": np.percentile(cpu[part], (50, 99, 100)).round(2).tolist(),
                    "lost": int(lost[part].sum()),
                    "travelled_m": travelled,
                    "off_m": off,
                    "load": os.getloadavg()[0],
                }
            )
            print_minute(minutes[-1])
    return {"frames": count, "lost": int(lost.sum()), "minutes": minutes, **flatness(minutes)}


def flatness(minutes: list[dict]) -> dict[str, float]:
    """Return the change in per cent of memory and time from the second minute to the last."""
    if len(minutes) <= 2:
        return {}
    second, last = minutes[1], minutes[-1]
    return {
        "rss_change_percent": 100 * (last["rss_bytes"] / second["rss_bytes"] - 1),
        "cpu_change_percent": 100 * (last["cpu_ms"][0] / second["cpu_ms"][0] - 1),
    }


def print_minute(minute: dict) -> None:
    times = "{:15.2f} {:6.2f} {:6.1f}".format(*minute["cpu_ms"])
    place, load = f"{minute['travelled_m']:8.1f} {minute['off_m']:7.2f}", f"{minute['load']:6.1f}"
    say(f"{minute['minute']:6} {minute['rss_bytes'] / 1e6:7.1f} {times} {minute['lost']:6} {place} {load}")


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--stereo", action="store_true", help="pairs of grey images, not depth images")
    parser.add_argument("--width", type=int, default=160, help="pixels across; pairs want 320")
    parser.add_argument("--speed", type=float, default=0.5, help="metres a second")
    parser.add_argument("--json", action="store_true", help="all figures as JSON on stdout")
    wanted = parser.parse_args()
    found = track(Walk(wanted.width, wanted.speed, wanted.stereo), round(wanted.minutes * MINUTE))
    say(f"{found['frames']} frames, {found['lost']} lost")
    if "rss_change_percent" in found:
        memory, time = found["rss_change_percent"], found["cpu_change_percent"]
        say(f"from the second minute to the last: memory {memory:+.1f} %, time a frame {time:+.1f} %")
    if wanted.json:
        print(json.dumps(found))


if __name__ == "__main__":
    main()
