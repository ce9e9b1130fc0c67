# SPDX-License-Identifier: Apache-2.0
"""Corrections from outside: the map after a path, or a jump of odometry, is that of a new run with these poses."""

from dataclasses import replace

import numpy as np
import pytest
import wire
from made_walks import DEPTH, OPTICAL, START_NS, T_BASE_CAMERA, base_at, depth_at

from stereovox.cameras.lidar import Lidar
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.ros.inputs import CloudInput, DepthInput
from stereovox.ros.mapping import Mapping
from stereovox.ros.options import Options
from stereovox.ros.poses.corrections import JumpCorrections, PathCorrections, check_corrections
from stereovox.ros.poses.poses import PoseBuffer

PATH = "/mapPath"
SETTINGS = {
    "voxel_size": 0.1, "map.keep_frames": True, "trust.max_disagreement": 1, "trust.frozen": False,
    "trust.max_speed_mps": 1e6, "trust.max_turn_dps": 1e9,
}  # fmt: skip
FRAMES = 10
FIXED_NS = 0


def motion(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn), shift
    return T


def bent(stamp_ns):
    """A correction that grows with time."""
    seconds = (stamp_ns - START_NS) / 1e9
    return motion((0, 0, 0.1 * seconds), (0.2, -0.4 * seconds, 0.1))


def tf(stamp_ns, *edges):
    return wire.packed(wire.messages().transforms(stamp_ns, edges))


class Log:
    """What a node logs."""

    def __init__(self):
        self.said = []

    def warning(self, text, throttle_duration_sec=0.0):
        self.said.append(text)


class Robot:
    """Maps the walk of `made_walks`, whose frames a corrector sees."""

    def __init__(self, **options):
        self.options = Options(depth=(DEPTH,), corrected_path=PATH, world_frame="map", **options)
        self.mapping, self.log = Mapping(load_config(**SETTINGS)), Log()
        self.poses = PoseBuffer("map", "", 0.1)
        self.poses.on_tf(tf(FIXED_NS, ("base_link", OPTICAL, T_BASE_CAMERA)), fixed=True)
        self.corrector = PathCorrections(self.mapping, self.poses, self.options, self.log)

    def drive(self, frames=FRAMES, first=0, T_map_odom=None, sensor=DEPTH, frame_id=OPTICAL):
        for k in range(first, first + frames):
            frame = replace(depth_at(k), sensor=sensor)
            T_odom_base = base_at(frame.stamp_ns)
            place = np.eye(4) if T_map_odom is None else T_map_odom
            self.poses.on_tf(
                tf(frame.stamp_ns, ("map", "odom", place), ("odom", "base_link", T_odom_base)), fixed=False
            )
            frame = replace(frame, T_world_sensor=place @ frame.T_world_sensor)
            assert self.mapping.add(frame).refused is None
            self.corrector.seen(DepthInput(sensor), frame_id, frame, True)
        return self

    def correct(self):
        return [ended.result() for ended in self.mapping.corrections.rest()]


def path(stamps, poses, frame_id="map"):
    made = wire.messages()
    told = [
        wire.made("geometry_msgs/msg/PoseStamped", header=wire.header(stamp, ""), pose=made._pose(T))
        for stamp, T in zip(stamps, poses, strict=True)
    ]
    return wire.packed(wire.made("nav_msgs/msg/Path", header=wire.header(START_NS, frame_id), poses=told))


def check_new_run(robot, frames, atol=1e-9):
    """The map equals a new run with the present poses of its frames, and these are as expected."""
    kept, new = robot.mapping.mapper.map.kept_frames.frames, Mapping(load_config(**SETTINGS))
    assert len(kept) == len(frames)
    for one, frame in zip(kept, frames, strict=True):
        np.testing.assert_allclose(one.T_world_sensor, frame.T_world_sensor, rtol=0, atol=atol)
        assert new.add(replace(frame, T_world_sensor=one.T_world_sensor, sensor=one.sensor)).refused is None
    for mine, theirs in zip(robot.mapping.mapper.map.storage.blocks(), new.mapper.map.storage.blocks(), strict=True):
        np.testing.assert_array_equal(mine, theirs)


def moved(frames=FRAMES):
    return [
        replace(one, T_world_sensor=bent(one.stamp_ns) @ one.T_world_sensor) for one in map(depth_at, range(frames))
    ]


def test_a_path_of_the_camera_moves_its_frames():
    robot, wanted = Robot().drive(), moved()
    robot.corrector.on_path(path([f.stamp_ns for f in wanted], [f.T_world_sensor for f in wanted]))
    (report,) = robot.correct()
    assert (report.moved, robot.log.said) == (FRAMES, [])
    check_new_run(robot, wanted)


@pytest.mark.parametrize("frame", ["base_link", "/base_link"])
def test_a_path_of_the_robot_moves_its_camera_and_frames_between_its_poses(frame):
    robot, wanted = Robot(path_frame=frame).drive(), moved()
    D = motion((0, 0, 0.05), (0.3, -0.2, 0))
    stamps = [wanted[0].stamp_ns, wanted[4].stamp_ns, wanted[7].stamp_ns]
    robot.corrector.on_path(path(stamps, [D @ base_at(stamp) for stamp in stamps]))
    (report,) = robot.correct()
    assert report.moved == 8
    check_new_run(robot, [
        replace(one, T_world_sensor=(D if k < 8 else np.eye(4)) @ one.T_world_sensor)
        for k, one in enumerate(map(depth_at, range(FRAMES)))
    ])  # fmt: skip


def test_a_path_that_says_the_same_again_moves_nothing():
    """RTAB-Map sends its whole path with each new pose, with small changes."""
    robot, wanted = Robot().drive(), moved()
    for shake in (0.0, 0.004):
        stamps = [frame.stamp_ns for frame in wanted]
        poses = [frame.T_world_sensor @ motion(shift=(shake, 0, 0)) for frame in wanted]
        robot.corrector.on_path(path(stamps, poses))
        (report,) = robot.correct()
        assert report.moved == (0 if shake else FRAMES)
    check_new_run(robot, wanted)


def test_frames_that_come_after_a_path_stay_until_the_next_one():
    robot, wanted = Robot().drive(), moved(FRAMES + 4)
    robot.corrector.on_path(path([f.stamp_ns for f in wanted[:FRAMES]], [f.T_world_sensor for f in wanted[:FRAMES]]))
    robot.drive(4, first=FRAMES)  # while the correction may be at work
    robot.correct()
    check_new_run(robot, [*wanted[:FRAMES], *map(depth_at, range(FRAMES, FRAMES + 4))])
    robot.corrector.on_path(path([f.stamp_ns for f in wanted], [f.T_world_sensor for f in wanted]))
    assert [report.moved for report in robot.correct()] == [4]
    check_new_run(robot, wanted)


def test_a_newer_path_replaces_the_one_that_waits():
    robot, wanted = Robot().drive(), moved()
    stamps = [frame.stamp_ns for frame in wanted]
    for shift in (0.5, 1.0, 1.5, 2.0):
        robot.corrector.on_path(path(stamps, [motion(shift=(0, shift, 0)) @ f.T_world_sensor for f in wanted]))
    assert 1 <= len(robot.correct()) <= 3  # the first runs at once
    check_new_run(robot, [replace(f, T_world_sensor=motion(shift=(0, 2, 0)) @ f.T_world_sensor) for f in wanted])


def test_a_path_without_the_stamps_of_its_images_does_not_replace_one_with_them():
    """RTAB-Map gives all poses the time of the message, except when its map is requested."""
    robot, wanted = Robot().drive(), moved()
    stamps, poses = [frame.stamp_ns for frame in wanted], [frame.T_world_sensor for frame in wanted]
    robot.corrector.on_path(path(stamps, [motion(shift=(1, 0, 0)) @ T for T in poses]))  # runs at once
    robot.corrector.on_path(path(stamps, poses))
    robot.corrector.on_path(path(stamps[-1:] * FRAMES, poses))
    assert "several of its poses have the same stamp" in robot.log.said[-1]
    assert len(robot.correct()) == 2
    check_new_run(robot, wanted)


def test_a_cloud_is_moved_with_its_own_mount():
    robot = Robot(path_frame="base_link")
    T_base_lidar = motion((0, 0, 0.3), (0.2, 0, 0.6))
    robot.poses.on_tf(tf(FIXED_NS, ("base_link", "lidar", T_base_lidar)), fixed=True)
    lidar = CloudInput("/points", Lidar())
    turns = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    points = np.column_stack([2 * np.cos(turns), 2 * np.sin(turns), np.linspace(-0.4, 0.4, 400)])
    stamps, frames = [START_NS + k * 10**8 for k in range(3)], []
    for stamp in stamps:
        place = ("map", "base_link", base_at(stamp))
        robot.poses.on_tf(tf(stamp, place), fixed=False)
        seen = points * (1 + 0.001 * len(frames))  # no two clouds are alike
        frames.append(lidar.frame(wire.cloud(seen, stamp, "lidar"), robot.poses.pose))
        assert robot.mapping.add(frames[-1]).refused is None
        robot.corrector.seen(lidar, "lidar", frames[-1], True)
    robot.corrector.on_path(path(stamps, [bent(stamp + 10**9) @ base_at(stamp) for stamp in stamps]))
    assert [report.moved for report in robot.correct()] == [3]
    check_new_run(robot, [replace(f, T_world_sensor=bent(f.stamp_ns + 10**9) @ f.T_world_sensor) for f in frames])


def test_paths_that_are_of_no_use_are_told_and_change_nothing():
    robot = Robot(path_frame="wheel")
    robot.corrector.on_path(path([START_NS], [np.eye(4)]))  # before the first frame: nothing to do yet
    assert robot.log.said == []
    robot.drive()
    stamps, poses = [START_NS], [motion(shift=(1, 0, 0))]
    robot.corrector.on_path(path(stamps, poses))
    assert "no fixed transform from wheel to a sensor" in robot.log.said[-1]
    robot.poses.on_tf(tf(START_NS, ("base_link", "wheel", np.eye(4))), fixed=False)
    robot.corrector.on_path(path(stamps, poses))
    assert "no fixed transform from wheel to a sensor" in robot.log.said[-1]  # it turns
    robot.corrector.on_path(path(stamps, poses, "odom"))
    assert "it is in frame odom, but the map in map; give --world-frame odom" in robot.log.said[-1]
    robot.corrector.on_path(b"\0\1\0\0\5")
    assert f"the path on {PATH} is not used" in robot.log.said[-1]
    assert robot.correct() == []
    check_new_run(robot, list(map(depth_at, range(FRAMES))))


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (path([17], [np.eye(4)]), r"/mapPath: none of its poses, from 0\.000 to 0\.000 s, has the stamp of a frame"),
        (path([START_NS + k for k in range(3)], [np.eye(4)] * 3)[:-9], "/mapPath is not used: 56 bytes are announced"),
        (path([START_NS, START_NS + 1, START_NS], [np.eye(4)] * 3), "/mapPath is not used: several of its poses"),
        (path([], []), None),
        (path([START_NS], [np.diag([np.nan, 1, 1, 1])]), None),
    ],
)
def test_paths_without_a_pose_of_a_frame_are_errors_and_without_any_are_nothing(data, said):
    robot = Robot().drive(3)
    robot.corrector.on_path(data)
    (ended,) = robot.mapping.corrections.rest()
    if said is None:
        assert ended.result().moved == 0
    else:
        with pytest.raises(StereovoxError, match=said) as error:
            ended.result()
        assert "\n" not in str(error.value)
    check_new_run(robot, list(map(depth_at, range(3))))


def test_another_map_does_not_wait_for_corrections_of_the_last():
    robot, wanted = Robot().drive(), moved()
    for _ in range(2):
        robot.corrector.on_path(path([f.stamp_ns for f in wanted], [f.T_world_sensor for f in wanted]))
    robot.mapping.reset()
    assert robot.correct() == []
    robot.corrector.on_path(path([f.stamp_ns for f in wanted], [f.T_world_sensor for f in wanted]))
    assert [report.moved for report in robot.correct()] == [0]
    robot.mapping.close()


def jumping(robot):
    robot.corrector = JumpCorrections(robot.mapping, robot.poses, "odom", robot.log)
    return robot


def test_a_jump_of_odometry_is_spread_over_the_way():
    jump = motion(shift=(0.0, 0.6, 0.0))
    robot = jumping(Robot()).drive()
    assert robot.correct() == []
    robot.drive(2, first=FRAMES, T_map_odom=jump)
    (report,) = robot.correct()
    assert report.moved == FRAMES - 1
    kept = robot.mapping.mapper.map.kept_frames.frames
    off = [one.T_world_sensor[1, 3] - depth_at(k).T_world_sensor[1, 3] for k, one in enumerate(kept)]
    assert off[0] == pytest.approx(0)
    assert off[-3:] == pytest.approx([0.6, 0.6, 0.6])
    assert (np.diff(off[:-2]) > 0.05).all()
    check_new_run(robot, [replace(depth_at(k), T_world_sensor=one.T_world_sensor) for k, one in enumerate(kept)])
    robot.drive(3, first=FRAMES + 2, T_map_odom=jump)
    assert robot.correct() == []


def test_jumps_are_not_noticed_where_odometry_is_not_known_and_that_is_told():
    robot = Robot()
    robot.corrector = JumpCorrections(robot.mapping, robot.poses, "wheels", robot.log)
    robot.drive(1)
    assert "jumps cannot be detected: " in robot.log.said[-1]
    assert "'wheels'" in robot.log.said[-1]
    robot.poses.world = "odom"
    robot.corrector = JumpCorrections(robot.mapping, robot.poses, "odom", robot.log)
    robot.corrector.seen(DepthInput(DEPTH), OPTICAL, depth_at(0), True)
    assert "the map is in odom itself" in robot.log.said[-1]


def test_odometry_as_it_was_is_what_counts_after_a_reset():
    robot = jumping(Robot()).drive(4)
    robot.mapping.reset()
    robot.corrector.forget()
    robot.drive(3, first=4, T_map_odom=motion(shift=(0.0, 0.6, 0.0)))
    assert robot.correct() == []


@pytest.mark.parametrize(
    ("options", "settings", "said"),
    [
        ({"corrected_path": PATH}, {}, "--corrected-path /mapPath: .*map.keep_frames=true"),
        ({"correct_jumps": True}, {}, "--correct-jumps: .*map.keep_frames=true"),
        ({"corrected_path": PATH, "correct_jumps": True}, {"map.keep_frames": True}, "give the path alone"),
        ({"corrected_path": PATH, "poses": "track"}, {"map.keep_frames": True}, "--poses track"),
        ({"correct_jumps": True, "world_frame": "/odom"}, {"map.keep_frames": True}, "--world-frame map"),
    ],
)
def test_corrections_that_cannot_be_are_refused_at_the_start(options, settings, said):
    with pytest.raises(StereovoxError, match=said):
        check_corrections(Options(depth=(DEPTH,), **options), load_config(**settings))
    check_corrections(Options(depth=(DEPTH,)), load_config(**settings))
    for fine in ({"corrected_path": PATH}, {"correct_jumps": True, "world_frame": "map"}):
        check_corrections(Options(depth=(DEPTH,), **fine), load_config(**{"map.keep_frames": True}))
