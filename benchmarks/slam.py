# SPDX-License-Identifier: Apache-2.0
"""SLAM on a recorded log: errors against known relations, times, loops, and a picture of the map.

python benchmarks/slam.py LOG [--relations FILE] [--picture map.png] [setting=value ...]   e.g. slam.refine_rounds=0
"""

import argparse
import time

import numpy as np

from stereovox.config import load_config, parse_value
from stereovox.evaluate.trajectory import score_relations
from stereovox.formats.map_server import write_map_server
from stereovox.localize.slam.line_map import cloud_of
from stereovox.localize.slam.loops import ClosureSearch
from stereovox.localize.slam.pipeline import Slam, SlamResult, map_scans
from stereovox.localize.track import Track
from stereovox.opening import open_robot


def main() -> None:
    """Run and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log")
    parser.add_argument("--relations")
    parser.add_argument("--picture", default="slam.png")
    parser.add_argument("settings", nargs="*")
    arguments = parser.parse_args()
    config = load_config(**{s.partition("=")[0]: parse_value(s.partition("=")[2]) for s in arguments.settings})
    start = time.perf_counter()
    robot = open_robot(arguments.log)
    scans = list(robot.scans)
    read = time.perf_counter() - start
    live, each, result, finish = timed(config, scans)
    recorded = 1e-9 * (result.track.stamps_ns[-1] - result.track.stamps_ns[0])
    print(f"log        {robot.name}: {len(scans)} scans, {recorded:.0f} s; read in {read:.1f} s")
    print("times are the processor's: one thread, whatever else the machine does")
    print(
        f"on the way {sum(each):.1f} s: a scan {1e3 * np.median(each):.2f} ms (median), {1e3 * max(each):.0f} ms (most)"
    )
    print(f"at the end {finish:.1f} s; together {recorded / (sum(each) + finish):.0f} x real time")
    print(f"keyframes  {len(result.keyframes)}, loops closed {result.closures}, refused {result.refused or 0}")
    rows, columns = result.grid.cells.shape
    print(f"map        {columns} x {rows} cells, {np.sum(result.grid.cells > 65)} of them occupied")
    if arguments.relations:
        odometry = [scan.pose_world_base for scan in scans]
        for name, poses in (("odometry", odometry), ("on the way", live), ("at the end", result.track.pose_map_base)):
            stamps = [s.stamp_ns for s in scans] if len(poses) == len(scans) else result.track.stamps_ns
            track = Track(np.array(stamps), np.array(poses), np.array(poses))
            print(f"{name:10s} {score_relations(track, arguments.relations).line()}")
    write_map_server(result.grid, arguments.picture)


def timed(config, scans) -> tuple[list, list[float], SlamResult, float]:
    """Online poses, processor seconds of each scan, the result, processor seconds of the end."""
    import gtsam  # noqa: F401 - once in a process, half a second

    map_scans(scans[:3], config)  # compiles
    search, cloud = ClosureSearch(config.slam), cloud_of(scans[0], 20.0)
    search.set_target(cloud)
    search.match(cloud, np.zeros(3), 0.3, 0.1)
    slam, live, each = Slam(config), [], []
    for scan in scans:
        start = time.process_time()
        live.append(slam.add(scan))
        each.append(time.process_time() - start)
    start = time.process_time()
    result = slam.finish()
    return live, each, result, time.process_time() - start


if __name__ == "__main__":
    main()
