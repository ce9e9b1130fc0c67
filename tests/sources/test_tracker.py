# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import math

import numpy as np
import pytest

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import rigidity_error, rotation_matrix
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.tracker import angles, jumps, on_clock, read_tracker

H = math.sqrt(0.5)
MS = 1_000_000
FORWARD = {"opengl": "0 0 -2", "optical": "0 0 2", "ros": "2 0 0"}
"""Two metres ahead, in each set of axes."""
UP = {"opengl": "0 0.5 0", "optical": "0 -0.5 0", "ros": "0 0 0.5"}
LEFT_TURN = {"opengl": f"0 {H} 0 {H}", "optical": f"0 {-H} 0 {H}", "ros": f"0 0 {H} {H}"}
"""A quarter turn to the left, about the axis that points up."""


def track(tmp_path, text, **options):
    (tmp_path / "tracker.txt").write_text(text)
    return read_tracker(tmp_path / "tracker.txt", **options)


@pytest.mark.parametrize("axes", ["opengl", "optical", "ros"])
def test_all_axes_tell_the_same_motion(tmp_path, axes):
    text = f"0 {FORWARD[axes]} 0 0 0 1\n0.05 {UP[axes]} {LEFT_TURN[axes]}\n"
    ahead, turned = track(tmp_path, text, axes=axes, world="optical").T_world_body
    np.testing.assert_allclose(ahead, [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2], [0, 0, 0, 1]], atol=1e-12)
    np.testing.assert_allclose(turned[:3, 3], [0, -0.5, 0], atol=1e-12)
    np.testing.assert_allclose(turned[:3, 2], [-1, 0, 0], atol=1e-12)  # looks left
    np.testing.assert_allclose(turned[:3, 1], [0, 1, 0], atol=1e-12)  # its down is still down


@pytest.mark.parametrize("axes", ["opengl", "optical", "ros"])
def test_in_a_world_with_z_up_the_body_keeps_its_optical_axes(tmp_path, axes):
    text = f"0 {FORWARD[axes]} 0 0 0 1\n0.05 {UP[axes]} {LEFT_TURN[axes]}\n"
    ahead, turned = track(tmp_path, text, axes=axes, world="up").T_world_body
    np.testing.assert_allclose(ahead[:3, 3], [2, 0, 0], atol=1e-12)
    np.testing.assert_allclose(ahead[:3, :3], np.transpose([[0, -1, 0], [0, 0, -1], [1, 0, 0]]), atol=1e-12)
    np.testing.assert_allclose(turned[:3, 3], [0, 0, 0.5], atol=1e-12)
    np.testing.assert_allclose(turned[:3, 2], [0, 1, 0], atol=1e-12)  # looks along y, which is left
    np.testing.assert_allclose(turned[:3, 1], [0, 0, -1], atol=1e-12)


def test_the_world_of_the_file_can_be_kept(tmp_path):
    (T,) = track(tmp_path, "0 1 2 3 0 0 0 1", axes="opengl", world="file").T_world_body
    np.testing.assert_array_equal(T, [[1, 0, 0, 1], [0, -1, 0, 2], [0, 0, -1, 3], [0, 0, 0, 1]])


def test_chien_2020_conversion_is_the_product_with_his_diagonal(tmp_path):
    quaternion = np.array([0.1, -0.2, 0.3, 0.9])
    poses = track(tmp_path, f"0 1 2 3 {' '.join(map(str, quaternion))}", axes="opengl", world="optical")
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    axis = np.array([x, y, z]) / np.linalg.norm([x, y, z])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(axis * 2 * np.arccos(w)), (1, 2, 3)
    C = np.diag([1, -1, -1, 1])
    np.testing.assert_allclose(poses.T_world_body[0], C @ T @ C, atol=1e-12)
    assert rigidity_error(poses.T_world_body[0]) < 1e-12


def test_confidence_is_read_where_every_line_has_one(tmp_path):
    text = "0 0 0 0 0 0 0 1 3\n0.05 0 0 0 0 0 0 1 1\n"
    assert track(tmp_path, text).confidence.tolist() == [3, 1]
    assert track(tmp_path, text.replace(" 3\n", "\n").replace(" 1 1", " 1")).confidence is None


@pytest.mark.parametrize("bad", ["0 0 0 0 0 0 1", "0 0 0 0 0 0 1 4", "0 0 0 0 0 0 1 -1", "0 0 0 0 0 0 1 high"])
def test_a_line_of_no_use_is_refused_when_it_is_needed(tmp_path, bad):
    good = "0 0 0 0 0 0 1 3"
    poses = track(tmp_path, f"0 {good}\n0.05 {bad}\n0.10 {good}\n0.15 {good}\n")
    assert poses.at(120 * MS) is not None
    with pytest.raises(FrameRefused, match=r"tracker\.txt:2: ") as caught:
        poses.at(70 * MS)
    assert caught.value.reason == "bad_pose_file"


@pytest.mark.parametrize(("key", "word"), [("axes", "openGL"), ("world", "down")])
def test_unknown_axes_are_named(tmp_path, key, word):
    with pytest.raises(SourceError, match=f"{key} = '{word}'"):
        track(tmp_path, "0 0 0 0 0 0 0 1", **{key: word})


def test_no_file_is_one_line(tmp_path):
    with pytest.raises(SourceError, match=r"tracker\.txt"):
        read_tracker(tmp_path / "tracker.txt")


def test_another_clock_shifts_and_stretches(tmp_path):
    poses = track(tmp_path, "100 0 0 0 0 0 0 1\n110 x 0 0 0 0 0 1\n")
    moved = on_clock(poses, -7.25, rate=1.001)
    assert moved.stamps_ns.tolist() == [92_750_000_000, 102_760_000_000]
    with pytest.raises(FrameRefused, match=r"tracker\.txt:2: "):  # what is wrong there goes along
        moved.at(102_760_000_000)


def poses_at(positions, degrees, step_ms=5):
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    T[:, 0, 3] = positions
    T[:, :3, :3] = [rotation_matrix([0, 0, math.radians(d)]) for d in degrees]
    return Poses(np.arange(len(positions)) * step_ms * MS, T)


def test_a_jump_is_what_no_vehicle_can_do():
    still = [0.0] * 4
    assert jumps(poses_at([0, 0.01, 0.5, 0.51], still), 10, 720).tolist() == [[1, 2]]
    assert jumps(poses_at([0, 0.04, 0.08, 0.12], still), 10, 720).tolist() == []
    assert jumps(poses_at(still, [0, 3, 6, 12]), 10, 720).tolist() == [[2, 3]]


def test_two_stamps_that_almost_coincide_are_no_jump():
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 0.002
    assert jumps(Poses([0, 1000], T), 10, 720).tolist() == []
    T[1, 0, 3] = 0.02
    assert jumps(Poses([0, 1000], T), 10, 720).tolist() == [[0, 1]]


def test_a_jump_is_seen_across_poses_that_cannot_be_used():
    poses = poses_at([0, 0.01, np.nan, 0.5, np.nan, np.nan, 0.51], [0.0] * 7)
    assert jumps(poses, 10, 720).tolist() == [[1, 3]]
    assert jumps(poses_at([np.nan] * 3, [0.0] * 3), 10, 720).shape == (0, 2)


@pytest.mark.parametrize("degrees", [1e-7, 0.01, 30, 179.99])
def test_angles_are_exact_however_small(degrees):
    R = rotation_matrix(np.radians(degrees) * np.array([0.6, 0.0, 0.8]))
    assert np.degrees(angles(R[None]))[0] == pytest.approx(degrees, rel=1e-6)
