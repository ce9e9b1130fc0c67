# SPDX-License-Identifier: Apache-2.0
"""Every command line that `info` prints works, for recordings and files of all kinds."""

import json
import shlex

import numpy as np
import pytest
from made_clouds import pose as lidar_pose
from made_clouds import room_points
from made_doors import write_faulty
from made_halls import hall
from made_robot_bags import MS, START_NS, RobotBagMaker, planar_numbers
from made_street import raw, sharpen
from made_unposed import unposed
from made_walks import write_walk

from stereovox.cli import main
from stereovox.formats.map_server import write_map_server
from stereovox.maps.occupancy import OccupancyGrid

PLACEHOLDERS = {"RECORDING", "ROBOT", "FILE", "IMAGES", "MAP"}
"""Words that stand for files of the user's."""


def write_drive(path, with_tf=True):
    """Write scans, clouds and a sonar's ranges of a robot in a room; returns what there is to open."""
    with RobotBagMaker(path) as bag:
        for k in range(-5, 60):
            stamp = START_NS + 10 * k * MS
            if with_tf:
                bag.tf(stamp, "odom", "base_link", planar_numbers(0.01 * k, 0, 0))
        for name in ("laser", "lidar", "sonar"):
            bag.tf(START_NS, "base_link", name, planar_numbers(0.1, 0, 0), "/tf_static")
        for n in range(5):
            stamp = START_NS + 100 * n * MS
            T = lidar_pose(0.1 + 0.1 * n)
            flat = np.linspace(-3, 3, 400)
            beams = np.column_stack([np.cos(flat), np.sin(flat), 0 * flat + 1e-9])
            ranges = np.linalg.norm(room_points(T, beams), axis=1)
            scan = bag.scan(stamp, ranges, angle_min=-3.0, angle_increment=6 / 399, range_max=30.0)
            bag.add("/scan", "sensor_msgs/LaserScan", stamp, scan)
            rays = np.random.default_rng(n).normal(size=(3000, 3))
            cloud = room_points(T, rays / np.linalg.norm(rays, axis=1, keepdims=True))
            bag.add("/points", "sensor_msgs/PointCloud2", stamp, bag.cloud(stamp, cloud))
            head = bag.header(stamp, "sonar")
            heard = bag.make("sensor_msgs/Range", header=head, radiation_type=0, field_of_view=0.3, min_range=0.1,
                             max_range=9.0, range=float(ranges[200]))  # fmt: skip
            bag.add("/sonar", "sensor_msgs/Range", stamp, heard)
    return bag.path


def write_map(path):
    hall(size=2.0, occupied=[((0.9, -2, -1), (1.1, 0, 1))]).save(path)
    return path


def write_grid(path):
    write_map_server(OccupancyGrid(np.array([[0, 0, 100], [0, -1, 100]] * 3, np.int8), 0.1), path)
    return path


SAMPLES = {
    "a folder of depth images with poses": lambda folder: unposed(folder, poses=True),
    "a folder without poses": unposed,
    "clouds": lambda folder: write_faulty(folder / "hall", "cloud"),
    "TUM": lambda folder: write_faulty(folder / "hall", "nothing"),
    "KITTI": lambda folder: raw(folder, 3),
    "a bag with depth and /tf": lambda folder: write_walk(folder / "walk.mcap"),
    "a bag with odometry": lambda folder: write_walk(folder / "walk.mcap", odometry=True),
    "a robot's bag": lambda folder: write_drive(folder / "drive.bag"),
    "a robot's db3 without odometry": lambda folder: write_drive(folder / "drive.db3", with_tf=False),
    "a simulation": lambda folder: "sim:room?image_width=64",
    "a map": lambda folder: write_map(folder / "a.svox"),
    "a grid": lambda folder: write_grid(folder / "a.yaml"),
}


def lines_of(path, capsys):
    """Return the words of all lines that `info` prints for a path."""
    assert main(["info", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    found = [shlex.split(line) for line in told["commands"]]
    assert found, told
    return found


@pytest.mark.parametrize("name", SAMPLES)
def test_every_line_works(name, tmp_path, monkeypatch, capsys):
    (tmp_path / "made").mkdir()
    monkeypatch.chdir(tmp_path)
    sharpen(monkeypatch)
    sample = SAMPLES[name](tmp_path / "made")
    for program, command, *words in lines_of(sample, capsys):
        assert program == "stereovox"
        if PLACEHOLDERS & {part for word in words for part in word.replace("=", "?").split("?")} or command == "view":
            continue
        assert main([command, *words]) == 0, (command, words, capsys.readouterr().err)
        capsys.readouterr()
