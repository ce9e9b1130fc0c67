# SPDX-License-Identifier: Apache-2.0
"""Looking round with few frames: which frame of a pair counts, and where its axes are."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.cameras.wide import Lens
from stereovox.config import load_config
from stereovox.depth.sphere import range_in, sight_of
from stereovox.depth.sphere.vehicle import vehicle_grid
from stereovox.depth.stereo.pipeline import StereoDepth
from stereovox.errors import StereovoxError
from stereovox.frame import StereoFrame
from stereovox.geometry.se3 import rotation_matrix

CAMERA = PinholeCamera(160, 120, 100.0, 100.0, 79.5, 59.5, 0.1)
UPRIGHT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Axes of a body that looks ahead (x forward, y left, z up) from those of an eye."""
CONFIG = load_config(max_range=5.0, **{"sphere.step_deg": 5.0, "stereo.disparities": 32})
PICTURE = np.kron(np.random.default_rng(1).integers(0, 255, (30, 45), np.uint8), np.ones((4, 4), np.uint8))
"""Grains of 4 pixels: rectified as a toed-in pair's, which they are not, rows disagree by 2 pixels."""


def wall(pair, stamp_ns=0, disparity=10):
    """A wall square to the pair's view, at 10 / disparity metres; the world is that of the poses' first frame."""
    left, right = PICTURE[:, :160], PICTURE[:, disparity : 160 + disparity]
    return StereoFrame(left, right, pair, pair.T_body_camera.copy(), stamp_ns, f"{pair.name} at {stamp_ns}")


def mounted(T_body_camera, name="stereo"):
    return StereoPair(CAMERA, None, T_body_camera, name=name)


@pytest.mark.parametrize("T_body_camera", [np.eye(4), UPRIGHT], ids=["optical", "vehicle"])
def test_the_camera_looks_ahead_whatever_the_axes_of_the_poses(T_body_camera):
    grid, _, _ = vehicle_grid([wall(mounted(T_body_camera))], CONFIG)
    assert range_in(grid, (1, 0, 0), 10).range_m == pytest.approx(1, abs=0.1)
    assert sight_of(grid, (0, 0, 1), 10) is None


def test_all_pairs_share_the_axes_of_the_poses():
    """Poses are those of the front eye's optical frame; the other eye looks along its x axis, to the right."""
    to_the_right = np.array([[0.0, 0, 1, 0.3], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1]])
    pairs = mounted(np.eye(4), "front"), mounted(to_the_right, "side")
    grid, _, _ = vehicle_grid([wall(pairs[0]), wall(pairs[1], disparity=5)], CONFIG)
    assert range_in(grid, (1, 0, 0), 10).range_m == pytest.approx(1, abs=0.1)
    assert range_in(grid, (0, -1, 0), 10).range_m == pytest.approx(2.3, abs=0.25)


def test_a_toed_in_pair_at_the_origin_looks_ahead_as_well():
    T = np.eye(4)
    T[:3, :3], T[0, 3] = rotation_matrix([0.02, -0.05, 0.01]), 0.1
    lens = Lens("pinhole", 160, 120, 100.0, 100.0, 79.5, 59.5)
    pair = StereoPair.from_eyes(Eyes(lens, lens, T))
    assert np.abs(pair.T_body_camera - np.eye(4)).max() > 0.01
    grid, _, _ = vehicle_grid([wall(pair)], CONFIG)
    assert sight_of(grid, (0, 0, 1), 20) is None
    assert sight_of(grid, (1, 0, 0), 20) is not None


def test_only_the_last_frame_of_a_pair_is_matched(monkeypatch):
    matched = []
    real = StereoDepth.__call__
    monkeypatch.setattr(StereoDepth, "__call__", lambda self, frame: matched.append(frame.name) or real(self, frame))
    a, b = mounted(UPRIGHT, "a"), mounted(UPRIGHT, "b")
    frames = [wall(a, 1), wall(b, 2), wall(a, 3), wall(b, 4), wall(a, 5)]
    _, now_ns, refused = vehicle_grid(iter(frames), CONFIG)
    assert sorted(matched) == ["a at 5", "b at 4"]
    assert (now_ns, refused) == (5, {})


def test_a_last_frame_that_cannot_be_used_is_counted_and_named():
    a, b = mounted(UPRIGHT, "a"), mounted(UPRIGHT, "b")
    early = replace(wall(a, 1), fault="no_pose")
    late = replace(wall(a, 3), fault="no_pose", fault_detail="a at 3: no pose")
    wrong = replace(wall(b, 4), left=np.full((3, 3), 99, np.uint8))
    told = []
    grid, now_ns, refused = vehicle_grid([early, wall(a, 2), late, wrong], CONFIG, told.append)
    assert refused == {"no_pose": 2, "bad_shape": 1}
    assert now_ns == 2, "the one before it counts"
    assert range_in(grid, (1, 0, 0), 10).range_m == pytest.approx(1, abs=0.1)
    assert [line.split(":")[0] for line in told] == ["a", "b"]
    assert "a at 3: no pose" in told[0]
    with pytest.raises(StereovoxError, match=r"no frame could be used \(b at 4"):
        vehicle_grid([wrong], CONFIG)
    with pytest.raises(StereovoxError, match="the source is empty"):
        vehicle_grid([], CONFIG)
