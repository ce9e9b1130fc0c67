"""A live camera on a vehicle: poses come from its autopilot, and it is told of obstacles, over one connection."""

import numpy as np
import pytest
from autopilot import flown
from made_live import Clouds, Images, Sender

from stereovox import StereovoxError
from stereovox.geometry.se3 import rotation_vector
from stereovox.live.poses import open_poses
from stereovox.live.rig import LiveCamera, mount_of
from stereovox.live.run import map_live
from stereovox.mavlink.poses import MavlinkPoses
from stereovox.sources.poses.live_poses import LivePoses

SMALL = {"voxel_size": 0.1, "max_range": 4.0}


class Keeper:
    def __init__(self):
        self.frames = []

    def after(self, frame, report):
        if report.refused is None:
            self.frames.append(frame)


@pytest.mark.parametrize("shared", [True, False])
def test_images_get_the_autopilots_poses_and_it_hears_of_the_wall(start_autopilot, tmp_path, shared):
    autopilot, keeper = start_autopilot(poses="odometry"), Keeper()
    other = autopilot if shared else start_autopilot()
    T_body_camera = mount_of([0.1, 0, 0, 0, 0, 0])
    done = map_live(
        LiveCamera(Images(count=60, period_s=0.03), "front", T_body_camera), tmp_path / "map",
        poses=f"mavlink:{autopilot.url}", mavlink=other.url, observers=[keeper], **SMALL,
    )  # fmt: skip
    assert len(keeper.frames) > 10
    assert done.live["obstacle_distances"] > 0
    message = other.wait_for("OBSTACLE_DISTANCE")[0]
    assert message["frame"] == 12  # of the body, and nothing is said to be free beyond the wall 2 m before it
    assert max(message["distances"][:2]) < 225
    ends = keeper.frames[0], keeper.frames[-1]
    first, last = (frame.T_world_sensor @ np.linalg.inv(T_body_camera) for frame in ends)
    seconds = 1e-9 * (keeper.frames[-1].stamp_ns - keeper.frames[0].stamp_ns)
    # it flies on a circle of 2 m about the origin with 1 rad/s, 1.5 m high, and turns right with 0.5 rad/s
    for T in (first, last):
        assert np.hypot(*T[:2, 3]) == pytest.approx(2, abs=0.01)
        assert T[2, 3] == pytest.approx(1.5, abs=0.01)
    angles = [np.arctan2(T[1, 3], T[0, 3]) for T in (first, last)]
    assert (angles[0] - angles[1]) % (2 * np.pi) == pytest.approx(seconds % (2 * np.pi), abs=0.02)  # y is west
    _, _, _, roll, pitch, _ = flown(0)
    for T in (first, last):
        assert np.arcsin(-T[2, 0]) == pytest.approx(-pitch, abs=0.01)
        assert np.arctan2(T[2, 1], T[2, 2]) == pytest.approx(roll, abs=0.01)
    turned = rotation_vector(first[:3, :3] @ last[:3, :3].T)
    assert np.linalg.norm(turned) == pytest.approx(0.5 * seconds, abs=0.02)


def told_of(autopilot, source, tmp_path, delay_s=0.0, **more):
    """Map while an autopilot is told of obstacles and the body stands still; poses come `delay_s` late."""
    poses = LivePoses()
    with Sender(lambda stamp_ns, _: poses.add(stamp_ns - round(1e9 * delay_s), np.eye(4))):
        return map_live(
            LiveCamera(source, "one"), tmp_path / "map", poses=poses, mavlink=autopilot.url, **SMALL, **more
        )


def test_it_hears_of_the_wall_before_a_lidar(start_autopilot, tmp_path):
    autopilot = start_autopilot()
    done = told_of(autopilot, Clouds(count=30), tmp_path)
    assert done.live["obstacle_distances"] > 0
    autopilot.wait_for("OBSTACLE_DISTANCE", lambda told: 280 < told["distances"][0] < 306)


def test_nothing_is_sent_by_images_that_waited_long_for_their_pose(start_autopilot, tmp_path):
    done = told_of(start_autopilot(), Images(count=20, period_s=0.05), tmp_path, delay_s=0.8, wait_s=3.0)
    assert done.map.frames > 5
    assert done.live["obstacle_distances"] == 0


def test_a_stream_is_known_by_its_name_and_says_what_is_wrong():
    assert isinstance(open_poses("mavlink:udpin:127.0.0.1:0"), MavlinkPoses)
    with pytest.raises(StereovoxError, match="nonsense"):
        open_poses("mavlink:nonsense").start()


def test_a_stream_that_was_never_started_ends():
    stream = MavlinkPoses("mavlink:udpin:127.0.0.1:0")
    stream.stop()
    assert stream.link is not None
    stream.stop()
    assert stream.link._closed.is_set()


def test_an_autopilot_that_says_nothing_gives_no_pose(start_autopilot, tmp_path):
    autopilot = start_autopilot(poses="none")
    with pytest.raises(StereovoxError, match=r"not one|no map is written"):
        map_live(Images(count=10), tmp_path / "map", poses=f"mavlink:{autopilot.url}", wait_s=0.1, seconds=3, **SMALL)
