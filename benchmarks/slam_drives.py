# SPDX-License-Identifier: Apache-2.0
"""SLAM on simulated drives that go wrong: slipping wheels, people, glass, identical corridors. Is a wrong map doubted?

python benchmarks/slam_drives.py 0:50 [--verbose] [setting=value ...]

A map is wrong if a pose of its track, after the best rigid fit to the true one, is off by more than 0.5 m.
"""

import argparse
import time
from itertools import pairwise

import numpy as np

from stereovox.config import load_config, parse_value
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.slam.pipeline import map_scans
from stereovox.opening import parse_slice
from stereovox.simulate.floors.drive import STEP_NS, Odometry, Stop, drive
from stereovox.simulate.floors.plan import FloorPlan
from stereovox.simulate.floors.view import cast

WRONG_M = 0.5
EVERY = 10
"""Poses of the drive per scan: 0.2 s."""
SPEED = 0.5


def main() -> None:
    """Drive, map, and print a line for each drive and the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("seeds")
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("settings", nargs="*")
    arguments = parser.parse_args()
    config = load_config(**{s.partition("=")[0]: parse_value(s.partition("=")[2]) for s in arguments.settings})
    counted: dict[tuple[bool, bool], int] = {}
    start = time.process_time()
    for seed in range(10_000)[parse_slice(arguments.seeds)]:
        scans, truth, what = slipping_drive(seed)
        result = map_scans(scans, config)
        error, doubts = worst_m(result.track.pose_map_base, truth), result.doubts
        case = error > WRONG_M, bool(doubts)
        counted[case] = counted.get(case, 0) + 1
        kinds = ", ".join(f"{doubt.kind} {doubt.figure:.2f}" for doubt in doubts)
        print(f"{seed:5d} {what:70s} {error:6.2f} m  {'WRONG' if case[0] else 'right'}  {kinds}", flush=True)
        if arguments.verbose:
            print(*(f"      {doubt.line()}" for doubt in doubts), sep="\n")
    print(f"{time.process_time() - start:.0f} s of CPU time")
    for wrong in (False, True):
        silent, warned = (counted.get((wrong, doubted), 0) for doubted in (False, True))
        print(f"{'wrong' if wrong else 'right'}: {silent} silent, {warned} warned")


def worst_m(found: se2.Pose, truth: se2.Pose) -> float:
    """Return the largest distance in metres between two tracks (N, 3) after the best rigid fit."""
    a, b = (poses[:, :2] - poses[:, :2].mean(0) for poses in (found, truth))
    turn = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    return float(np.linalg.norm(se2.transform((0, 0, turn), a) - b, axis=1).max())


def slipping_drive(seed: int) -> tuple[list[Scan], se2.Pose, str]:
    """Return the scans of a drive, the true poses (N, 3) at them, and the faults in words."""
    random = np.random.default_rng([seed, 2718])
    free, stops, plan = corridors(random)
    poses = drive([Stop(*stop) for stop in stops], SPEED)
    believed, slips = slipped(poses, random)
    solid, glass = panes(FloorPlan(free).walls, random)
    people = int(random.integers(0, 5))
    walkers = [walker(stops, len(poses), random) for _ in range(people)]
    beams, limit = (181, np.pi) if random.random() < 0.5 else (241, np.radians(240)), float(random.choice([8.0, 20.0]))
    scans, true = [], poses[::EVERY]
    for i in range(0, len(poses), EVERY):
        angles = np.linspace(-beams[1] / 2, beams[1] / 2, beams[0])
        there = np.vstack([solid, *(_ring(walk[i]) for walk in walkers if _apart(walk[i], poses[i]) > 0.6)])
        aim = poses[i, 2] + angles
        ranges = cast(there, poses[i, :2], aim, limit)
        if len(glass):
            seen = random.random(len(angles)) < 0.1
            ranges = np.where(seen, np.minimum(ranges, cast(glass, poses[i, :2], aim, limit)), ranges)
        ranges = (ranges + 0.01 * random.standard_normal(len(ranges))).astype(np.float32)
        step = float(angles[1] - angles[0])
        stamp = (i + 1) * STEP_NS
        scans.append(Scan(ranges, float(angles[0]), step, 0.02, limit, se2.lifted(believed[i]), stamp_ns=stamp))
    what = f"{plan}, {limit:.0f} m, {people} people, {len(glass)} panes, slips: {slips}"
    return scans, true, what


def corridors(random: np.random.Generator) -> tuple[list, list[tuple[float, float]], str]:
    """Return free rectangles, stops and a name: a ring, a dead end or a branching corridor, with identical doors."""
    width, length, depth = random.uniform(1.6, 2.6), random.uniform(14, 28), random.uniform(8, 16)
    plan = str(random.choice(["ring", "dead end", "branch"]))
    half = width / 2
    free = [(-1.0, -half, length, half)]
    stops = [(0.0, 0.0), (length - 1.2, 0.0)]
    if plan == "ring":
        free += [
            (length - width, -half, length, depth),
            (-1.0, depth - width, length, depth),
            (-1.0, 0, width - 1, depth),
        ]
        x0, x1, y1 = half - 1.0, length - half, depth - half
        stops = [(x0 + 1, 0.0), (x1, 0.0), (x1, y1), (x0, y1), (x0, 0.0), (x1, 0.0), (x1, y1)]
    elif plan == "branch":
        x = length * random.uniform(0.35, 0.65)
        free.append((x - half, 0.0, x + half, depth))
        stops = [(0, 0), (length - 1.2, 0), (x, 0), (x, depth - 1.2), (x, 0), (0.2, 0)]
    else:
        stops += [(0.5, 0.0)] if random.random() < 0.7 else []
    pitch = random.uniform(2.5, 4.0)
    for x in np.arange(1.5, length - 2.5, pitch):  # identical doors, some of them open rooms
        free.append((x, -half - 0.12, x + 0.9, -half + 0.1))
        if random.random() < 0.25:
            free += [(x, -half - 0.3, x + 0.9, -half), (x - 0.8, -half - random.uniform(2, 3), x + 1.4, -half - 0.25)]
    return free, stops, plan


def slipped(poses: se2.Pose, random: np.random.Generator) -> tuple[se2.Pose, str]:
    """Return the wheels' poses (N, 3): drift, and up to four slips of 0.6 to 3 s."""
    step = se2.relative(poses[:-1], poses[1:])
    words = []
    for _ in range(int(random.integers(0, 5))):
        first, count = int(random.integers(len(step) // 10, len(step) - 160)), int(random.uniform(30, 150))
        part = slice(first, first + count)
        if random.random() < 0.5:
            factor = random.uniform(-1, 3)  # wheels that spin, or are pushed
            lost = abs(factor - 1) * float(np.hypot(*step[part, :2].T).sum())
            step[part, :2] *= factor
            words.append(f"{lost:.1f} m")
        else:
            turn = np.radians(random.uniform(5, 40)) * random.choice([-1, 1])
            step[part, 2] += turn / count
            words.append(f"{np.degrees(abs(turn)):.0f} deg")
    chain = [poses[0]]
    for one in step:
        chain.append(se2.compose(chain[-1], one))
    return Odometry().measured(np.array(chain), int(random.integers(2**31))), ", ".join(words) or "none"


def panes(walls: np.ndarray, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return walls and panes of glass (N, 4) each: half of the drives have some."""
    share = random.uniform(0.1, 0.4) if random.random() < 0.5 else 0.0
    pieces = []
    for wall in walls:
        start, end = wall[:2], wall[2:]
        cuts = np.linspace(0, 1, int(np.linalg.norm(end - start) / 2) + 2)
        pieces += [(*(start + a * (end - start)), *(start + b * (end - start))) for a, b in pairwise(cuts)]
    made = np.array(pieces)
    glass = (random.random(len(made)) < share) & (np.hypot(*(made[:, 2:] - made[:, :2]).T) > 0.8)
    return made[~glass], made[glass]


def walker(stops: list, count: int, random: np.random.Generator) -> se2.Pose:
    """Return a person's position at each step (count, 2): back and forth along the stops, next to the robot's line."""
    path = drive([Stop(*stop) for stop in stops], random.uniform(0.6, 1.3))[:, :2]
    path = np.vstack([path, path[::-1]]) + random.uniform(-0.5, 0.5, 2)
    return path[(int(random.integers(len(path))) + np.arange(count)) % len(path)]


def _apart(person: np.ndarray, pose: se2.Pose) -> float:
    """Metres between a person and the robot: they do not walk through it, but step aside."""
    return float(np.hypot(*(person - pose[:2])))


def _ring(middle: np.ndarray) -> np.ndarray:
    angles = np.arange(7) * np.pi / 3
    corners = middle + 0.2 * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.hstack([corners[:-1], corners[1:]])


if __name__ == "__main__":
    main()
