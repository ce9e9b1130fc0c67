# SPDX-License-Identifier: Apache-2.0
"""Poses of clouds in other units, of other axes and mounts: what is said, and that the cure gives the right map."""

import re

import numpy as np
import pytest
from made_clouds import HALF, directions_of, room_points
from made_robot_bags import MS, START_NS, RobotBagMaker

import stereovox as sv
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.sources.poses.trajectory import write_trajectory
from stereovox.sources.rgbd.pose_files import read_poses

COUNT = 20
FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(n):
    """Return the pose of a lidar on an arc in a room, which it enters off the middle."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0, 0, 0.08 * n]), [-1 + 0.09 * n, 0.5 - 0.04 * n, 0.02 * n]
    return T


def write(folder, turn=lambda T: T, mount=None, stamp=lambda s: f"{s:.9f}", seed=0):
    """Write clouds at the poses of a body, as `turn` and `stamp` write them; mount: T_body_lidar."""
    folder.mkdir(exist_ok=True)
    lines = []
    for n in range(COUNT):
        T, seconds = pose(n), 1000 + 0.1 * n
        points = room_points(T if mount is None else T @ mount, directions_of(seed + n, 1500)).astype("<f4")
        np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(folder / f"{seconds:.6f}.bin")
        write_trajectory(folder / "one.txt", [0], turn(T)[None], "lidar")
        numbers = (folder / "one.txt").read_text().splitlines()[1].split()[1:]
        lines.append(" ".join([stamp(seconds), *numbers]))
    (folder / "one.txt").unlink()
    (folder / "poses.txt").write_text("\n".join(lines) + "\n")
    return folder


def in_millimetres(T):
    found = T.copy()
    found[:3, 3] *= 1000
    return found


def worst(source):
    """Return how far points are from the walls of the room, at most, in metres."""
    found = []
    for cloud in source:
        points = cloud.points @ cloud.T_world_sensor[:3, :3].T + cloud.T_world_sensor[:3, 3]
        found.append(np.abs(np.max(np.abs(points) / HALF, axis=1) - 1).max())
    return max(found)


def test_right_poses_give_no_note(tmp_path):
    source = sv.open_source(str(write(tmp_path / "room")))
    assert source.notes == ()
    assert worst(source) < 1e-3


@pytest.mark.parametrize(
    ("turn", "mount", "cure"),
    [
        (in_millimetres, None, "poses_scale=0.001"),
        (inverse, None, "invert=1"),
        (lambda T: T, FLIP, "mount=0,0,0,0,0,3.14159265|axes=ned"),
    ],
)
@pytest.mark.parametrize("seed", [100, 200])
def test_wrong_poses_are_reported_with_a_cure_that_works(tmp_path, turn, mount, cure, seed):
    folder = write(tmp_path / "room", turn, mount, seed=seed)
    source = sv.open_source(str(folder))
    (note,) = source.notes
    assert worst(source) > 0.1
    (option,) = re.findall(r"try (\?\S+?),? with which", note)
    assert re.fullmatch(rf"\?({cure})", option)
    cured = sv.open_source(f"{folder}{option}")
    assert cured.notes == ()
    assert worst(cured) < 1e-3


def test_poses_of_another_drive_are_reported(tmp_path):
    rng = np.random.default_rng(3)

    def anywhere(T):
        found = T.copy()
        found[:3, :3], found[:3, 3] = rotation_matrix(rng.normal(size=3)), rng.normal(size=3)
        return found

    (note,) = sv.open_source(str(write(tmp_path / "room", anywhere))).notes
    assert "check that poses belong to these clouds" in note


@pytest.mark.parametrize(
    ("stamp", "said"),
    [
        (lambda s: f"{1000 * s:.3f}", "1,000 times"),
        (lambda s: f"{1e6 * s:.0f}", "1,000,000 times"),
        (lambda s: f"{1e9 * s:.0f}", "1,000,000 times"),  # 13 digits, as dates in milliseconds have
        (lambda s: f"{s - 950:.3f}", "another clock"),
    ],
)
def test_times_of_poses_in_other_units_and_of_another_clock(tmp_path, stamp, said):
    source = sv.open_source(str(write(tmp_path / "room", stamp=stamp)))
    assert said in " ".join(source.notes)
    assert len(source.notes) == 1
    assert worst(source) < 1e-3


def test_whole_nanoseconds_since_the_start_have_one_unit(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("".join(f"{10**7 * n} {n} 0 0 0 0 0 1\n" for n in range(2000)))
    np.testing.assert_array_equal(read_poses(path).stamps_ns, 10**7 * np.arange(2000))


def test_a_longer_gap_is_bridged_on_request(tmp_path):
    folder = write(tmp_path / "room")
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(lines[:8] + lines[11:]))
    assert [cloud.fault for cloud in sv.open_source(str(folder))].count("no_pose") == 3
    assert not any(cloud.fault for cloud in sv.open_source(f"{folder}?max_gap=0.5"))


@pytest.mark.parametrize(
    ("turn", "mount", "cure"),
    [(in_millimetres, None, "poses_scale=0.001"), (inverse, None, "invert=1"), (lambda T: T, FLIP, "mount=")],
)
def test_clouds_of_a_bag_and_a_file_of_poses(tmp_path, turn, mount, cure):
    with RobotBagMaker(tmp_path / "drive.bag") as bag:
        for n in range(COUNT):
            stamp, T = START_NS + 100 * n * MS, pose(n)
            points = room_points(T if mount is None else T @ mount, directions_of(n, 1500)).astype("<f4")
            bag.add("/points", "sensor_msgs/PointCloud2", stamp, bag.cloud(stamp, points, "lidar"))
    stamps = [START_NS + 100 * n * MS for n in range(COUNT)]
    write_trajectory(tmp_path / "poses.txt", stamps, np.array([turn(pose(n)) for n in range(COUNT)]), "lidar")
    where = f"{tmp_path / 'drive.bag'}?cloud=/points&poses=poses.txt"
    source = sv.open_source(where)
    (note,) = [note for note in source.notes if "do not fit" in note]
    (option,) = re.findall(r"try \?(\S+?),? with which", note)
    assert option.startswith(cure)
    cured = sv.open_source(f"{where}&{option}")
    assert not any("do not fit" in note for note in cured.notes)
    assert worst(source) > 0.1 > worst(cured)
    assert worst(cured) < 1e-3
