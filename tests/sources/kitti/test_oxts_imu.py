# SPDX-License-Identifier: Apache-2.0
"""Angular rates and accelerations of KITTI's oxts packets."""

import made_kitti as made
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_images, open_source


def drive(folder, count=3):
    """A drive whose packets have their own number in each place, at times of their own."""
    found = made.raw(folder, count)
    for n in range(count):
        words = (found / f"oxts/data/{n:010d}.txt").read_text().split()
        words[6:23] = [str(100 * n + k) for k in range(6, 23)]
        (found / f"oxts/data/{n:010d}.txt").write_text(" ".join(words))
    times = "".join(f"2011-09-26 13:02:25.{n}00000000\n" for n in range(count))
    (found / "oxts/timestamps.txt").write_text(times)
    return found


def test_rates_forces_times_and_mount(tmp_path):
    source = open_images(drive(tmp_path))
    found = source.imu()
    assert np.diff(found.stamps_ns).tolist() == [100_000_000] * 2
    assert np.datetime64(int(found.stamps_ns[1]), "ns") == np.datetime64("2011-09-26T13:02:25.1")
    np.testing.assert_array_equal(found.angular_rate[1], [117, 118, 119])  # wx wy wz, not wf wl wu
    np.testing.assert_array_equal(found.specific_force[2], [211, 212, 213])
    T_cam0_imu = made.R_RECT @ made.T_CAM_VELO @ made.T_VELO_IMU
    np.testing.assert_allclose(found.T_sensor_imu[:3, :3], T_cam0_imu[:3, :3], atol=1e-6)


def test_the_axes_are_those_by_which_poses_turn(tmp_path):
    """The mount takes the vehicle's turns into the camera's: R_cam_imu R_imu(n)^T R_imu(n+1) R_imu_cam."""
    source = open_source(drive(tmp_path))
    T = source.imu().T_sensor_imu
    turned = inverse(source.viewpoint(0).T_world_camera) @ source.viewpoint(1).T_world_camera
    expected = T @ inverse(made.imu_pose(0)) @ made.imu_pose(1) @ inverse(T)
    np.testing.assert_allclose(turned[:3, :3], expected[:3, :3], atol=1e-6)


def test_packets_that_are_missing_or_short_are_left_out(tmp_path):
    folder = drive(tmp_path, 4)
    (folder / "oxts/data/0000000001.txt").unlink()
    (folder / "oxts/data/0000000002.txt").write_text("49 8 110 0 0 0")
    np.testing.assert_array_equal(open_images(folder).imu().angular_rate[:, 0], [17, 317])


def test_where_there_is_none(tmp_path):
    folder = drive(tmp_path)
    assert open_images(f"{folder}?imu=off").imu() is None
    with pytest.raises(SourceError, match="imu=1 must be off"):
        open_images(f"{folder}?imu=1")
    (folder / "../calib_imu_to_velo.txt").unlink()
    assert open_images(folder).imu() is None
    assert open_images(made.raw(tmp_path / "b")).imu() is None
