# SPDX-License-Identifier: Apache-2.0
"""The drive of the simulated robot, written as a bag and read back."""

from __future__ import annotations

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_robot
from stereovox.simulate.floors.floor import Floor, write_bag

pytest.importorskip("rosbags", reason="needs the extra 'bags'")


@pytest.mark.parametrize("ending", [".bag", ".mcap"])
def test_what_is_read_from_the_bag_is_what_was_driven(ending, tmp_path):
    floor, told = Floor("sim:floor?seconds=2&depth_hz=2&image_width=80"), []
    write_bag(floor, tmp_path / f"floor{ending}", lambda *step: told.append(step))
    assert told[-1][0] == told[-1][1] == len(told) == 21 + len(floor.scans) + len(floor.frames)
    robot = open_robot(tmp_path / f"floor{ending}")
    assert (len(robot.scans), len(robot.frames)) == (len(floor.scans), len(floor.frames)) == (20, 4)
    for read, made in zip(robot.scans, floor.scans, strict=True):
        np.testing.assert_allclose(read.ranges, made.ranges)
        np.testing.assert_allclose(read.angles, made.angles, atol=1e-4)
        np.testing.assert_allclose(read.T_world_sensor, made.T_world_sensor, atol=1e-9)
        np.testing.assert_allclose(read.T_base_sensor, made.T_base_sensor, atol=1e-9)
        assert (read.stamp_ns, read.range_max) == (made.stamp_ns, pytest.approx(5.6))
    assert robot.truth is None
    truth = open_robot(f"{tmp_path / f'floor{ending}'}?truth=/ground_truth").truth
    for stamp in floor.odometry.stamps_ns:
        np.testing.assert_allclose(truth.at(stamp), floor.truth.at(stamp), atol=1e-9)
    for read, made in zip(robot.frames, floor.frames, strict=True):
        np.testing.assert_array_equal(read.depth, made.depth)
        np.testing.assert_allclose(read.T_world_sensor, made.T_world_sensor, atol=1e-9)
        assert (read.stamp_ns, read.depth_scale) == (made.stamp_ns, made.depth_scale)
        assert read.camera.fx == pytest.approx(made.camera.fx)
        assert (read.camera.width, read.camera.height) == (80, 60)


def test_only_a_simulated_robot_is_written(tmp_path):
    class Other:
        name = "aces.clf"

    with pytest.raises(SourceError, match=r"aces\.clf: .* sim:floor"):
        write_bag(Other(), tmp_path / "a.bag")
    assert not list(tmp_path.iterdir())
