# SPDX-License-Identifier: Apache-2.0
"""Loop closure: loops found, wrong loops, and trajectory error before and after.

    python benchmarks/loops.py offices --seeds 0:50 [--drift 0.02] [--visits 10] [--width 212]
    python benchmarks/loops.py ring --seeds 0:10 [--drift 0.01] [--width 212]
    python benchmarks/loops.py racks --seeds 0:10 [--drift 0.02] [--width 96] [--set loops.drift=0.05]
    python benchmarks/loops.py apartment --seeds 0:5 [--drift 0.01] [--width 424]
    python benchmarks/loops.py RECORDING          # the camera is tracked; its own poses are taken for the truth

Simulated walks with drifting poses, each seed with its own walk and drift; every second frame. A loop is wrong if it is
off by more than 0.5 m. A place is revisited if the camera was within 0.7 m and 40 degrees of it, 5 m of path earlier:
which share of these has a loop? The seam: error of the relative pose of two such frames.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stereovox as sv
from stereovox.config import load_config, parse_value
from stereovox.correct.loops.closer import Loop, LoopCloser
from stereovox.correct.loops.drift import difference
from stereovox.evaluate.trajectory_score import score_trajectory
from stereovox.geometry.se3 import inverse
from stereovox.maps.record.kept_frames import KeptFrame
from stereovox.simulate.simulation import Simulation
from stereovox.sources.poses.poses import Poses

SCENES = {
    "offices": "sim:offices?walk={seed}&",
    "ring": "sim:loop?plan={seed}&",
    "racks": "sim:racks?walk={seed}&",
    "apartment": "sim:apartment?camera=d435&",
}
WRONG_M = 0.5
NEAR_M, NEAR_RAD, AFTER_M = 0.7, np.radians(40), 5.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what")
    parser.add_argument("--seeds", default="0:5")
    parser.add_argument("--drift", type=float, default=0.01)
    parser.add_argument("--width", type=int, default=0)
    parser.add_argument("--visits", type=int, default=10)
    parser.add_argument("--every", type=int, default=2)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    more = {key: parse_value(value) for key, _, value in (one.partition("=") for one in given.set)}
    if given.what not in SCENES:
        return recording(given.what, more)
    totals = []
    for seed in range(*map(int, given.seeds.split(":"))):
        location = f"{SCENES[given.what].format(seed=seed)}seed={seed}&drift={given.drift}"
        location += f"&image_width={given.width}" if given.width else ""
        location += f"&visits={given.visits}" if given.what == "offices" else ""
        totals.append(walk(location, given.every, more))
    loops, wrong, again, found = np.sum([total[:4] for total in totals], axis=0)
    seams = np.concatenate([total[4] for total in totals])
    print(f"all {len(totals)}: {loops} loops, {wrong} wrong; {found} of {again} places seen again have one")
    print(f"seam: {in_mm(seams)}")


def walk(location: str, every: int, settings: dict[str, Any]) -> tuple[int, int, int, int, NDArray[np.float64]]:
    """Close the loops of one walk and print the results."""
    simulation = Simulation(location)
    mapper = sv.Mapper(voxel_size=0.1, threads=2, **{"map.keep_frames": True})
    for i in range(0, len(simulation), every):
        mapper.add(simulation.frame(i))
    frames = mapper.map.kept_frames.frames
    closer, seconds = closed(frames, load_config(mapper.config, **settings))
    truth = [simulation.true_pose(round(one.stamp_ns / simulation.period_ns)) for one in closer.submaps]
    wrong = sum(error(loop, truth) > WRONG_M for loop in closer.loops)
    ends = {loop.second for loop in closer.loops}
    again = [k for k in range(len(truth)) if any(True for _ in seen_before(k, truth, closer))]
    exact = [simulation.true_pose(round(one.stamp_ns / simulation.period_ns)) for one in frames]
    new = closer.corrected()
    before, after = [one.T_world_sensor for one in frames], [new[one.sensor, one.stamp_ns] for one in frames]
    seams = seam(exact, after, closer)
    stamps = np.array([one.stamp_ns for one in frames])
    scores = [ate(stamps, poses, exact) for poses in (before, after)]
    print(
        f"{location}: {len(frames)} frames, {len(truth)} submaps, {len(closer.loops)} loops, {wrong} wrong, "
        f"{len(closer.refused)} refused; {len(ends & set(again))} of {len(again)} places seen again; "
        f"ATE {scores[0]:.3f} to {scores[1]:.3f} m; seam {in_mm(seams)}; {seconds:.0f} s",
        flush=True,
    )
    return len(closer.loops), wrong, len(again), len(ends & set(again)), seams


def closed(frames: Sequence[KeptFrame], config: sv.Config) -> tuple[LoopCloser, float]:
    """Return the loop closer of frames, and its time."""
    start, closer = perf_counter(), LoopCloser(config)
    for frame in frames:
        closer.add(frame)
    closer.finish()
    return closer, perf_counter() - start


def error(loop: Loop, truth: Sequence[NDArray[np.float64]]) -> float:
    """Return the error of a loop in metres."""
    exact = inverse(truth[loop.first]) @ truth[loop.second]
    return float(np.linalg.norm(difference(exact, loop.match.T_earlier_later)[3:]))


def seen_before(k: int, truth: Sequence[NDArray[np.float64]], closer: LoopCloser) -> Iterable[int]:
    """Yield earlier submaps taken from the same place and direction as submap k."""
    for i in range(k):
        if closer.submaps[k].travelled - closer.submaps[i].travelled > AFTER_M:
            moved = difference(truth[i], truth[k])
            if np.linalg.norm(moved[3:]) < NEAR_M and np.linalg.norm(moved[:3]) < NEAR_RAD:
                yield i


def seam(
    exact: Sequence[NDArray[np.float64]], poses: Sequence[NDArray[np.float64]], closer: LoopCloser
) -> NDArray[np.float64]:
    """Return the errors in metres of relative poses of frames taken at one place on two visits."""
    where = np.array(exact)[:, :3, 3]
    way = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(where, axis=0), axis=1))])
    found = []
    for k in range(0, len(exact), 3):
        near = np.flatnonzero((way < way[k] - 10) & (np.linalg.norm(where - where[k], axis=1) < 0.4))
        for i in near[:3]:
            real = inverse(exact[i]) @ exact[k]
            if np.linalg.norm(difference(exact[i], exact[k])[:3]) < NEAR_RAD:
                found.append(np.linalg.norm((inverse(poses[i]) @ poses[k])[:3, 3] - real[:3, 3]))
    return np.array(found)


def in_mm(seams: NDArray[np.float64]) -> str:
    """Describe the errors of relative poses."""
    if not len(seams):
        return "never there again"
    median, nearly_all, most = 1e3 * np.quantile(seams, [0.5, 0.95, 1])
    return f"median {median:.1f}, 95 % {nearly_all:.1f}, most {most:.1f} mm"


def ate(stamps: NDArray[np.int64], poses: Sequence[Any], exact: Sequence[Any]) -> float:
    """Return the root of the mean square of the distances, after alignment of the trajectories."""
    score = score_trajectory(Poses(stamps, np.array(poses)), Poses(stamps, np.array(exact)))
    return float(np.sqrt(np.mean(np.square(score.position_errors_m))))


def recording(source: str, settings: dict[str, Any]) -> None:
    """Track a recording, close its loops, and compare with its own poses."""
    truth = {frame.stamp_ns: frame.T_world_sensor for frame in sv.open_source(source)}
    with tempfile.TemporaryDirectory() as folder:
        made = sv.map_recording(
            source, Path(folder) / "map.svox", poses="track", threads=2, **{"map.keep_frames": True}
        )
        frames = made.map.kept_frames.frames
        closer, seconds = closed(frames, load_config(made.map.config, **settings))
        new, stamps = closer.corrected(), np.array([one.stamp_ns for one in frames])
        exact = [truth[one.stamp_ns] for one in frames]
        for words, poses in (("tracked", [one.T_world_sensor for one in frames]),
                             ("closed", [new[one.sensor, one.stamp_ns] for one in frames])):  # fmt: skip
            print(f"{words}: ATE {ate(stamps, poses, exact):.4f} m")
        print(f"{len(frames)} frames, {len(closer.submaps)} submaps, {len(closer.loops)} loops, {seconds:.1f} s")


if __name__ == "__main__":
    main()
