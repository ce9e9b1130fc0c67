# SPDX-License-Identifier: Apache-2.0
"""The chain of IST 2019 online: a bag of sim:floor is played to the node in real time, against the same bag offline.

Makes the reference map by SLAM of a first drive, writes the second drive as a bag, maps it offline (`stereovox grid`)
and by the node (`stereovox ros2`), and compares Eq 7. With --slam the lidar's first drive is also played, and the
node makes the reference itself.

    python benchmarks/ist_online.py                  # the whole drive through the corridors, some 3 minutes
    python benchmarks/ist_online.py --seconds 40 --slam

Target: Eq 7 of the node within 1 point of offline.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import psutil

from stereovox.config import load_config
from stereovox.evaluate.grid_scores import score_grids
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.localize.robot_track import slam_robot
from stereovox.opening import open_robot
from stereovox.runs.floor import map_floor
from stereovox.simulate.floors.floor import Floor, write_bag

ROOT = Path(__file__).resolve().parent.parent
PLAYER = ROOT / "tests/helpers/play.py"
DEPTH, SCAN = "/camera/depth/image_raw", "/scan"
TARGET = 1.0
"""Points of Eq 7."""


def prepared(folder: Path, seconds: float, plan: str) -> tuple[Path, Path, Path]:
    """Return the bag of the mapped drive, the bag of the first one, and the latter's reference map by SLAM."""
    ends = f"&seconds={seconds:g}" if seconds else ""
    first, drive = (f"sim:floor?plan={plan}&seed={seed}{ends}&depth_hz={hz}" for seed, hz in ((1, 0), (2, 5)))
    bags = folder / "first.mcap", folder / "drive.mcap"
    for where, bag in zip((first, drive), bags, strict=True):
        write_bag(Floor(where), bag)
    reference = folder / "reference.yaml"
    write_map_server(slam_robot(open_robot(bags[0]), load_config("ist2019")).grid, reference)
    return bags[1], bags[0], reference


def offline(bag: Path, reference: Path, out: Path) -> float:
    """Return Eq 7 of the map that `map_floor` makes."""
    map_floor(bag, out, profile="ist2019", poses=reference, use="depth", start=(0.0, 0.0, 0.0))
    return score_grids(read_map_server(out), read_map_server(reference), align=False).eq7_percent


def online(bag: Path, topics: list[str], rate: float, *options: str) -> dict[str, Any]:
    """Play a bag to the node; return its report, and its share of a core."""
    command = [sys.executable, "-m", "stereovox", "ros2", "--profile", "ist2019", "--json", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as node:
        process, began = psutil.Process(node.pid), time.monotonic()
        played = subprocess.run([sys.executable, str(PLAYER), str(bag), str(rate), "no", *topics], timeout=600)
        share = sum(process.cpu_times()[:2]) / (time.monotonic() - began)
        node.send_signal(signal.SIGTERM)
        if played.returncode:
            node.kill()
            sys.exit("the bag could not be played to the node")
        told = json.loads(node.communicate()[0].splitlines()[-1])
    return {**told, "cpu_share": share}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=0.0, help="of the drive (0: all of it)")
    parser.add_argument("--plan", default="corridors", choices=("corridors", "testbed"))
    parser.add_argument("--rate", type=float, default=1.0, help="times as fast as recorded")
    parser.add_argument("--slam", action="store_true", help="play the first drive, too, and make the reference live")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    os.environ.setdefault("FASTDDS_DEFAULT_PROFILES_FILE", str(ROOT / "examples/ros2/large_images.xml"))
    with TemporaryDirectory() as name:
        folder = Path(name)
        bag, first, reference = prepared(folder, arguments.seconds, arguments.plan)
        found: dict[str, Any] = {}
        if arguments.slam:
            live = folder / "live.yaml"
            told = online(first, [SCAN], arguments.rate, "--poses", "slam", "--lidar", SCAN, "--slam-out", str(live))
            grids = read_map_server(live), read_map_server(reference)
            found["slam"] = {**told["slam"], **told["localisation"], "cpu_share": told["cpu_share"]}
            found["slam"]["eq7_against_offline_slam"] = score_grids(*grids, align=False).eq7_percent
        eq7 = offline(bag, reference, folder / "offline.yaml")
        options = "--poses", str(reference), "--lidar", SCAN, "--depth", DEPTH, "--start", "0,0,0"
        told = online(bag, [DEPTH, SCAN], arguments.rate, *options, "--out", str(folder / "online.yaml"))
    error = told["error"]
    found |= {
        "eq7_offline": eq7, "eq7_online": error["eq7_percent"], "points_apart": abs(error["eq7_percent"] - eq7),
        "target": TARGET, "frames": told["frames"], "refused": told["refused"], "dropped": told["dropped"],
        "localisation": told["localisation"], "frame_ms": told["frame_ms"], "cpu_share": told["cpu_share"],
    }  # fmt: skip
    print(json.dumps(found) if arguments.json else "\n".join(f"{key:14} {value}" for key, value in found.items()))
    sys.exit(found["points_apart"] > TARGET)


if __name__ == "__main__":
    main()
