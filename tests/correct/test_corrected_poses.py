# SPDX-License-Identifier: Apache-2.0
"""Where frames belong by a path of better poses, and by jumps of odometry in the map."""

from dataclasses import replace

import numpy as np
import pytest
from made_threads import frames_of

import stereovox as sv
from stereovox.correct.corrected_poses import noticeable
from stereovox.errors import FrameRefused
from stereovox.geometry.se3 import interpolate, inverse, rotation_matrix

SETTINGS = {
    "voxel_size": 0.1, "map.keep_frames": True, "trust.max_disagreement": 1, "trust.frozen": False,
    "trust.max_speed_mps": 1e6, "trust.max_turn_dps": 1e9,
}  # fmt: skip
MS = 1_000_000


def frames(each=16, sensor=0, apart_ms=30):
    some = [frame for frame in frames_of(sensor, each) if not frame.fault]
    return [replace(frame, stamp_ns=10**12 + n * apart_ms * MS) for n, frame in enumerate(some)]


def mapped(some):
    mapper = sv.Mapper("default", **SETTINGS)
    for frame in some:
        assert mapper.add(frame).refused is None
    return mapper


def motion(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(turn), shift
    return T


def pose_at(some, stamp_ns):
    """Where the camera was between two frames."""
    after = next(n for n, frame in enumerate(some) if frame.stamp_ns >= stamp_ns)
    one, other = some[after - 1], some[after]
    share = (stamp_ns - one.stamp_ns) / (other.stamp_ns - one.stamp_ns)
    return interpolate(one.T_world_sensor, other.T_world_sensor, share)


D = motion((0.01, -0.02, 0.03), (0.3, -0.2, 0.1))
"""A correction of everything."""


def test_poses_between_the_stamps_of_frames_move_all_frames_between_them():
    """A lidar's SLAM knows nothing of the camera's stamps."""
    some = frames()
    kept = mapped(some).map.kept_frames.frames
    stamps = [some[1].stamp_ns + 10 * MS, some[8].stamp_ns + 3 * MS, some[-2].stamp_ns + 20 * MS]
    path = sv.Poses(stamps, [D @ pose_at(some, stamp) for stamp in stamps])
    found = sv.poses_by_path(kept, path, {"camera 0": np.eye(4)})
    assert (found.posed, found.between, found.outside) == (0, len(some) - 3, 3)
    for frame in some[2:-1]:
        np.testing.assert_allclose(found.poses["camera 0", frame.stamp_ns], D @ frame.T_world_sensor, rtol=0, atol=1e-9)


def test_where_frames_come_rarely_poses_are_interpolated_at_their_stamps():
    """Kept frames may be half a second apart; their own motion says nothing about the path between them."""
    some = frames(each=6, apart_ms=500)
    kept = mapped(some).map.kept_frames.frames
    stamps = range(some[0].stamp_ns - 30 * MS, some[-1].stamp_ns, 20 * MS)
    path = sv.Poses(stamps, [motion((0, 0, 1e-9 * (s - stamps[0])), (s / 1e9 - 1000, 0, 0)) for s in stamps])
    found = sv.poses_by_path(kept, path, {"camera 0": np.eye(4)})
    assert (found.posed, found.between, found.outside) == (len(some) - 1, 0, 1)
    for frame in some[:-1]:
        np.testing.assert_allclose(found.poses["camera 0", frame.stamp_ns], path.at(frame.stamp_ns))


def test_of_two_poses_within_half_a_millisecond_of_a_frame_the_other_moves_nothing():
    some = frames()
    kept = mapped(some).map.kept_frames.frames
    stamps = [some[2].stamp_ns, some[2].stamp_ns + MS // 3, some[6].stamp_ns]
    far = motion((0, 0, 0), (5.0, 0, 0))
    poses = [T @ frame.T_world_sensor for T, frame in zip((D, far, D), (some[2], some[2], some[6]), strict=True)]
    found = sv.poses_by_path(kept, sv.Poses(stamps, poses), {"camera 0": np.eye(4)})
    assert len(found.poses) == 5
    for frame in some[2:7]:
        np.testing.assert_allclose(found.poses["camera 0", frame.stamp_ns], D @ frame.T_world_sensor, rtol=0, atol=1e-9)


def test_poses_of_a_body_move_what_is_mounted_on_it_and_others_as_these():
    T_body_camera = motion((0.1, 0.2, -0.3), (0.2, 0.0, 0.5))
    both = sorted(
        frames(8) + [replace(f, stamp_ns=f.stamp_ns + 7 * MS) for f in frames(8, 1)], key=lambda f: f.stamp_ns
    )
    kept = mapped(both).map.kept_frames.frames
    of_one = [frame for frame in both if frame.sensor == "camera 0"]
    path = sv.Poses(
        [frame.stamp_ns + MS // 3 for frame in of_one],
        [D @ frame.T_world_sensor @ inverse(T_body_camera) for frame in of_one],
    )
    found = sv.poses_by_path(kept, path, {"camera 0": T_body_camera})
    assert (found.posed, found.between, found.outside) == (len(of_one), len(both) - len(of_one) - 1, 1)
    for frame in both[:-1]:
        wanted = D @ frame.T_world_sensor
        np.testing.assert_allclose(found.poses[frame.sensor, frame.stamp_ns], wanted, rtol=0, atol=1e-9)


def test_a_pose_that_cannot_be_used_is_refused_where_it_is_a_frames_own_and_left_out_elsewhere():
    some = frames(each=6)
    kept, nan = mapped(some).map.kept_frames.frames, np.full((4, 4), np.nan)
    with pytest.raises(FrameRefused, match="cannot be used"):
        sv.poses_by_path(kept, sv.Poses([some[1].stamp_ns], [nan]), {"camera 0": np.eye(4)})
    none = sv.poses_by_path(kept, sv.Poses([some[1].stamp_ns + 5 * MS], [nan]), {"camera 0": np.eye(4)})
    assert (none.poses, none.outside) == ({}, len(some))


def test_only_what_moves_noticeably_is_asked_for():
    some = frames(each=6)
    kept = mapped(some).map.kept_frames.frames
    shifts = motion(shift=(0.0009, 0, 0)), motion((0, 0, 0.0004)), motion((0, 0, 0.0006)), motion(shift=(0.0011, 0, 0))
    poses = {
        (frame.sensor, frame.stamp_ns): frame.T_world_sensor @ shift for frame, shift in zip(some, shifts, strict=False)
    }
    found = noticeable(kept, poses, least_m=0.001, reach_m=2.0)
    assert set(found) == {(frame.sensor, frame.stamp_ns) for frame in some[2:4]}


class Drive:
    """A camera that is driven straight on, 0.1 m a frame, and by its odometry has gone where `odom` says."""

    def __init__(self, cell=0.1, reach_m=0.0):
        self.jumps, self.n = sv.OdometryJumps(cell, reach_m), 0

    def go(self, T_map_odom, steps=1, way=0.1, in_map=True):
        for _ in range(steps):
            self.n += 1
            self.place = getattr(self, "place", 0.0) + way
            T_odom_sensor = motion(shift=(self.place, 0, 0))
            found = self.jumps.add("camera", self.n, T_map_odom, T_odom_sensor, in_map=in_map)
        return found


def test_a_jump_is_spread_over_the_way_since_the_last_one():
    drive, jump = Drive(), motion(shift=(0, 0.8, 0))
    assert drive.go(np.eye(4), 4) == {}
    assert drive.go(np.eye(4), 5, way=0.0) == {}  # it stands, and time alone is no way
    assert drive.go(np.eye(4), 3) == {}
    assert drive.go(jump) == {}  # which may not be all of it
    found = drive.go(jump)
    shares = {stamp: T[1, 3] / 0.8 for (_, stamp), T in found.items()}
    way = dict(zip(range(1, 13), [0, 1, 2, 3, 3, 3, 3, 3, 3, 4, 5, 6], strict=True))
    assert shares == {n: pytest.approx(way[n] / 6) for n in range(2, 13)}  # those with the new transform stay
    for (_, stamp), T in found.items():
        assert T[0, 3] == pytest.approx(0.1 * (way[stamp] + 1))


def test_the_next_jump_moves_only_what_came_after_the_last():
    drive, first, second = Drive(), motion(shift=(0, 0.8, 0)), motion(shift=(0, 0.8, -0.4))
    drive.go(np.eye(4), 5)
    drive.go(first, 2)  # frames 6 and 7
    assert drive.go(first, 5) == {}
    drive.go(second)
    found = drive.go(second)
    assert {stamp for _, stamp in found} == set(range(6, 13))
    assert all(T[1, 3] == pytest.approx(0.8) and -0.4001 < T[2, 3] < 0 for T in found.values())


def test_images_in_the_middle_of_a_jump_are_moved_to_its_end():
    """tf interpolates between the last transform before a jump and the first after it."""
    drive, jump = Drive(), motion(shift=(0, 0.8, 0))
    drive.go(np.eye(4), 4)
    assert drive.go(interpolate(np.eye(4), jump, 0.5)) == {}
    assert drive.go(jump) == {}
    found = drive.go(jump)
    assert {stamp: T[1, 3] for (_, stamp), T in found.items()} == {
        n: pytest.approx(0.8 * (n - 1) / 4) for n in range(2, 6)
    }


def test_small_moves_add_up_to_a_jump_and_turns_count_by_what_is_seen():
    drive = Drive()
    for n in range(10):
        assert drive.go(motion(shift=(0, 0.011 * n, 0))) == {}
    assert drive.go(motion(shift=(0, 0.011 * 10, 0)))
    for reach_m, jumped in ((0.5, False), (5.0, True)):
        turned = Drive(reach_m=reach_m)
        turned.go(np.eye(4), 3, way=0.01)
        turned.go(motion((0, 0, 0.03)), way=0.0)
        assert bool(turned.go(motion((0, 0, 0.03)), way=0.0)) == jumped


def test_a_robot_that_stands_is_moved_as_a_whole_and_refused_frames_show_a_jump_too():
    drive, jump = Drive(), motion(shift=(0, 0.8, 0))
    drive.go(np.eye(4), 3, way=0.0)
    assert drive.go(jump, way=0.0, in_map=False) == {}
    found = drive.go(jump, way=0.0, in_map=False)
    assert {key[1]: T[1, 3] for key, T in found.items()} == {n: pytest.approx(0.8) for n in (1, 2, 3)}


def test_after_another_map_has_begun_nothing_is_remembered():
    drive, jump = Drive(), motion(shift=(0, 0.8, 0))
    drive.go(np.eye(4), 3)
    drive.jumps.forget()
    assert drive.go(jump, 3) == {}


def test_a_map_is_corrected_by_a_jump():
    """Odometry drifts evenly along the way: then all frames come back to where they were taken."""
    true, drifted, way = frames(each=24), [], 0.0
    for before, frame in zip([true[0], *true], true, strict=False):
        way += float(np.linalg.norm(frame.T_world_sensor[:3, 3] - before.T_world_sensor[:3, 3]))
        drifted.append(replace(frame, T_world_sensor=motion(shift=(0, 0.5 * way, 0)) @ frame.T_world_sensor))
    mapper, jumps = mapped(drifted), sv.OdometryJumps(0.1, 5.0)
    for frame in drifted:
        assert not jumps.add(frame.sensor, frame.stamp_ns, np.eye(4), frame.T_world_sensor)
    there, back = drifted[-1].T_world_sensor, motion(shift=(0, -0.5 * way, 0))
    poses = jumps.add("camera 0", drifted[-1].stamp_ns + 30 * MS, back, there, in_map=False)
    poses = poses or jumps.add("camera 0", drifted[-1].stamp_ns + 60 * MS, back, there, in_map=False)
    mapper.correct(poses)
    off = [
        np.linalg.norm(kept.T_world_sensor[:3, 3] - frame.T_world_sensor[:3, 3])
        for kept, frame in zip(mapper.map.kept_frames.frames, true, strict=True)
    ]
    assert max(off) < 0.15 * 0.5 * way  # turns count as way, too
    assert off[-1] < 1e-9
