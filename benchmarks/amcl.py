# SPDX-License-Identifier: Apache-2.0
"""Monte Carlo localisation in a building of many similar offices: global, tracking, and after a kidnapping.

    python benchmarks/amcl.py [RUNS] [SETTING=VALUE ...]            for example: 100 amcl.model=beam
    python benchmarks/amcl.py floor [RUNS] [SETTING=VALUE ...]      on sim:floor?plan=corridors instead

Each run (seeds 0, 1, ...) drives its own path of 40 m through corridors and offices with a lidar of 240 degrees and
5.6 m (noise 1 cm, 2 % of the beams lost, 5 % blocked by objects missing in the map) and an odometer that is off by a
few per cent. `found`: within 0.2 m of the truth over the last 5 m of the path. `way to`: metres until it stayed so.
`rms`: error once found. Kidnapped: after 20 m of tracking the robot is moved elsewhere, unnoticed.
Times are processor times, for scans that were compared with the map.
"""

from __future__ import annotations

import ast
import sys
from itertools import pairwise
from time import thread_time

import numpy as np

from stereovox.config import Config, load_config
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.localize.amcl.localise import Localiser
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.simulate.floors.floor import Floor
from stereovox.simulate.floors.plan import FloorPlan, block
from stereovox.simulate.floors.view import cast

REACH, WAY, STEP, TURN = 5.6, 40.0, 0.1, 0.25
ANGLES = np.radians(np.arange(-120, 120.1, 1.44))
"""A quarter of the beams of a lidar with 0.36 degrees between them: sixty are used."""
MOUNT = (0.1, 0.0, 0.0)
NEAR = 0.2


CORRIDORS = 5.9, 12.9
CROSSINGS = 9.8, 27.1
OFFICES = [(4.263 * n + 0.113, side) for side in (0, 1) for n in range(7)]


def building() -> FloorPlan:
    """Return a floor of 30 by 18 m: two corridors, two crossings, 14 offices of which 11 are furnished the same."""
    free = [(0, 5.01, 30.02, 6.81), (0, 12.02, 30.02, 13.83), (9.01, 6.81, 10.62, 12.02), (26.03, 6.81, 28.21, 12.02)]
    things = [block("things", "copier", (12.03, 13.24, 12.72, 13.83), (0, 1))]
    for n, (x, side) in enumerate(OFFICES):
        low, door, desk = ((0.36, 4.86, 0.36), (13.98, 13.83, 18.02))[side]
        free += [(x, low, x + 4, low + 4.5), (x + 0.5, door, x + 1.4, door + 0.15)]
        things.append(block("things", "desk", (x + 1.6, desk, x + 3.2, desk + 0.45), (0, 1)))
        if n in (2, 5, 10):
            things.append(block("things", "cabinet", (x + 3.4, low + 1, x + 4, low + 2.2), (0, 1)))
    return FloorPlan(free, things)


def into(office: tuple[float, int]) -> list[tuple[float, float]]:
    """Return the waypoints from the corridor to the middle of an office."""
    x, side = office
    inner, middle = ((4.2, 2.8), (14.6, 15.9))[side]
    return [(x + 0.95, CORRIDORS[side]), (x + 0.95, inner), (x + 2.6, middle)]


def between(a: tuple[float, int], b: tuple[float, int]) -> list[tuple[float, float]]:
    """Return the waypoints from one office to another."""
    cross = min(CROSSINGS, key=lambda x: abs(x - a[0]) + abs(x - b[0]))
    over = [] if a[1] == b[1] else [(cross, CORRIDORS[a[1]]), (cross, CORRIDORS[b[1]])]
    return [*into(a)[::-1], *over, *into(b)]


def drive(start: tuple[float, int], length: float, rng: np.random.Generator) -> np.ndarray:
    """Return true poses (N, 3) from office to office: straight segments in steps of STEP, turns in place by TURN."""
    poses, done, here = [], 0.0, start
    heading = rng.uniform(-np.pi, np.pi)
    while done < length:
        goal = OFFICES[rng.integers(len(OFFICES))]
        if goal == here:
            continue
        stops = between(here, goal)
        for a, b in pairwise(stops):
            way, towards = np.hypot(b[0] - a[0], b[1] - a[1]), np.arctan2(b[1] - a[1], b[0] - a[0])
            if way < 1e-6:
                continue
            turn = float(se2.wrapped(towards - heading))
            poses += [(*a, heading + turn * share) for share in np.linspace(0, 1, int(abs(turn) / TURN) + 2)[:-1]]
            shares = np.linspace(0, 1, int(way / STEP) + 1)[:, None]
            poses += [(*place, towards) for place in np.asarray(a) + shares * np.subtract(b, a)]
            heading, done = towards, done + way
        here = goal
    poses = np.array(poses)
    return poses[way_of(poses) <= length]


def way_of(poses: np.ndarray) -> np.ndarray:
    """Return the distance travelled at each of (N, 3) poses."""
    return np.concatenate([[0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])


def odometry(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return odometry from true poses: scale errors of 2 % (distance) and 3 % (turn), noise, drift."""
    wheel, gyro, drift = rng.normal(0, (0.02, 0.03, np.radians(0.3)))
    steps = se2.relative(poses[:-1], poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1])[:, None]
    noise = rng.standard_normal(steps.shape) * np.hypot([0.01, 0.01, 0.015] * np.sqrt(way), 0.03 * np.abs(steps))
    steps = steps * [1 + wheel, 1 + wheel, 1 + gyro] + noise
    steps[:, 2:] += drift * way
    found = [np.array([3.0, -2.0, 1.0])]
    for step in steps:
        found.append(se2.compose(found[-1], step))
    return np.array(found)


def scan(walls: np.ndarray, pose: np.ndarray, odom: np.ndarray, stamp_ns: int, rng: np.random.Generator) -> Scan:
    """Return the lidar scan from a true pose, with the odometer's pose."""
    x, y, yaw = se2.compose(pose, MOUNT)
    ranges = cast(walls, (x, y), ANGLES + yaw, REACH)
    ranges = ranges + rng.normal(0, 0.01, len(ranges))
    blocked = rng.random(len(ranges)) < 0.05
    ranges[blocked] *= rng.uniform(0.2, 1, blocked.sum())
    ranges[rng.random(len(ranges)) < 0.02] = np.nan
    T = se2.lifted(MOUNT)
    step = ANGLES[1] - ANGLES[0]
    return Scan(ranges.astype(np.float32), ANGLES[0], step, 0.02, REACH, se2.lifted(odom) @ T, T, stamp_ns=stamp_ns)


def run(seed: int, plan: FloorPlan, grid: OccupancyGrid, config: Config, kidnap: bool) -> dict:
    """Return the figures of one drive."""
    rng = np.random.default_rng(seed)
    walls = plan.outline(0.2, 0.4)
    poses = drive(OFFICES[rng.integers(len(OFFICES))], WAY, rng)
    poses = poses[rng.integers(60) :]
    odom = odometry(poses, rng)
    if kidnap:
        half = int(np.searchsorted(way_of(poses), WAY / 2))
        elsewhere = drive(OFFICES[rng.integers(len(OFFICES))], WAY, rng)
        poses = np.concatenate([poses[:half], elsewhere])
        odom = np.concatenate([odom[:half], se2.compose(odom[half], se2.relative(elsewhere[0], elsewhere))])
    localiser = Localiser(grid, config, poses[0] if kidnap else None, seed)
    scans = [scan(walls, pose, at, n * 10**8, rng) for n, (pose, at) in enumerate(zip(poses, odom, strict=True))]
    return followed(localiser, scans, poses, len(poses) - half if kidnap else None)


def judged(errors: np.ndarray, poses: np.ndarray, spent: list, settled: np.ndarray) -> dict:
    """Return the figures of one drive, from the last `len(poses)` of its errors (metres)."""
    before, errors = errors[: -len(poses)], errors[-len(poses) :]
    wrong = np.flatnonzero(errors > NEAR)
    since = int(wrong[-1]) + 1 if len(wrong) else 0
    way = way_of(poses)
    found = since < len(way) and way[since] <= way[-1] - 5
    kept = np.concatenate([before, errors[since:]])
    false_sure = (settled[-len(poses) :] & (errors > 0.5)).mean()
    return {"found": found, "way": way[min(since, len(way) - 1)], "square": (kept**2).mean(), "spent": spent,
            "sure": false_sure}  # fmt: skip


def on_floor(runs: int, config: Config) -> None:
    """Localise on the simulated floor after IST 2019: from its start, and globally from points along its path."""
    floor = Floor("sim:floor?plan=corridors")
    scans = list(floor.scans[::2])
    poses = np.array([se2.flattened(floor.truth.at(scan.stamp_ns)) for scan in scans])
    grid = floor.true_grid(0.05)
    report("from its start", [followed(Localiser(grid, config, poses[0]), scans, poses, len(poses))])
    first = [int(len(scans) * 0.7 * n / runs) for n in range(runs)]
    results = [
        followed(Localiser(grid, config, seed=n), scans[i : i + 600], poses[i : i + 600]) for n, i in enumerate(first)
    ]
    report("from anywhere", results)


def followed(localiser: Localiser, scans: list[Scan], poses: np.ndarray, since: int | None = None) -> dict:
    """Return the figures for scans from (N, 3) true poses, judged by the last `since` of them (all)."""
    errors, spent, settled = [], [], []
    for scan, pose in zip(scans, poses, strict=True):
        start = thread_time()
        estimate = localiser.add(scan)
        if estimate.moved:
            spent.append((len(estimate.particles), 1e3 * (thread_time() - start)))
        errors.append(np.hypot(*(estimate.pose_map_base - pose)[:2]))
        settled.append(estimate.settled)
    return judged(np.array(errors), poses[-(since or len(poses)) :], spent, np.array(settled))


def main(arguments: list[str]) -> None:
    floor = arguments[:1] == ["floor"]
    arguments = arguments[floor:]
    runs = int(arguments.pop(0)) if arguments and arguments[0].isdigit() else 100
    config = load_config(**dict(map(setting, arguments)))
    if floor:
        return on_floor(runs, config)
    plan = building()
    grid = plan.truth(0.05, (1.0, 5.9), (0.2, 0.4))
    for kidnap in (False, True):
        results = []
        for seed in range(runs):
            results.append(run(seed, plan, grid, config, kidnap))
            if sys.stderr.isatty():
                print(f"\r{seed + 1}/{runs}", end="", file=sys.stderr)
        report("kidnapped" if kidnap else "from anywhere", results)
    return None


def setting(word: str) -> tuple[str, object]:
    """Return name and value of `name=value`."""
    name, _, value = word.partition("=")
    try:
        return name, ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return name, value


def report(name: str, results: list[dict]) -> None:
    found = [result for result in results if result["found"]]
    ways = np.array([result["way"] for result in found] or [np.nan])
    rms = np.sqrt(np.mean([result["square"] for result in found])) if found else np.nan
    count, ms = np.concatenate([result["spent"] for result in results]).T
    lost = [n for n, result in enumerate(results) if not result["found"]]
    wrong = 100 * np.mean([result["sure"] for result in results])
    print(f"{name}: found {len(found)} of {len(results)} (not: seeds {lost})")
    print(f"  way to: median {np.median(ways):.1f} m, 90 % {np.quantile(ways, 0.9):.1f} m, last {ways.max():.1f} m")
    print(f"  rms once found {100 * rms:.1f} cm; sure but wrong: {wrong:.1f} % of scans")
    few = count <= 2000
    for words, of in (("2000 particles or fewer", few), ("more", ~few)):
        if of.any():
            middle, tail = np.median(ms[of]), np.quantile(ms[of], 0.99)
            print(
                f"  {words}: {of.sum()} updates, {np.median(count[of]):.0f} particles, {middle:.2f} ms, p99 {tail:.2f}"
            )
    print(flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
