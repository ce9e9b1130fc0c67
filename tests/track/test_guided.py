# SPDX-License-Identifier: Apache-2.0
"""Poses that frames bring, corrected by what the images show."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from made_unposed import room

from stereovox.config import load_config
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.track.stream import LOST, GuidedTracker, follow
from stereovox.track.tracker import Tracker

NOWHERE = np.full((4, 4), np.nan)


def shaken(count, metres=0.02, degrees=0.5):
    """The room with poses that are off, each by itself."""
    rng = np.random.default_rng(1)
    for frame in room(count):
        off = np.eye(4)
        off[:3, :3] = rotation_matrix(rng.normal(0, np.radians(degrees), 3))
        off[:3, 3] = rng.normal(0, metres, 3)
        yield replace(frame, T_world_sensor=frame.T_world_sensor @ off)


def guided(frames):
    return [frame for frame, _ in follow(frames, GuidedTracker(load_config()))]


def faults(frames):
    return [frame.fault for frame in frames]


def step_errors(frames):
    """Metres (N - 1,) by which the motion from each frame to the next is off."""
    poses, true = [frame.T_world_sensor for frame in frames], [frame.T_world_sensor for frame in room(len(frames))]
    steps = [[inverse(a) @ b for a, b in pairwise(T)] for T in (poses, true)]
    return np.linalg.norm((np.array(steps[0]) - np.array(steps[1]))[:, :3, 3], axis=1)


def test_shaky_poses_become_steady():
    frames = list(shaken(16))
    found = guided(frames)
    assert faults(found) == [None] * 16
    np.testing.assert_allclose(found[0].T_world_sensor, frames[0].T_world_sensor, atol=1e-9)
    assert np.median(step_errors(found)) < 0.4 * np.median(step_errors(frames))


def test_where_all_in_view_is_new_the_given_motion_is_believed():
    frames = [*room(50)[:4], *room(50)[46:]]
    alone = [frame for frame, _ in follow(frames, Tracker())]
    assert faults(alone)[4:] == [LOST] * 4
    found = guided(frames)
    assert faults(found) == [None] * 8
    assert np.linalg.norm((found[4].T_world_sensor - frames[4].T_world_sensor)[:3, 3]) < 0.05


def test_frames_without_a_pose_are_tracked_by_their_images():
    frames = [replace(f, T_world_sensor=NOWHERE, fault="no_pose") if k in (3, 4) else f for k, f in enumerate(room(8))]
    found = guided(frames)
    assert faults(found) == [None] * 8
    for frame, true in zip(found, room(8), strict=True):
        assert np.linalg.norm((frame.T_world_sensor - true.T_world_sensor)[:3, 3]) < 0.02


@pytest.mark.parametrize("bad", [NOWHERE, np.diag([2.0, 1, 1, 1])])
def test_the_world_is_that_of_the_first_pose(bad):
    frames = [replace(frame, T_world_sensor=bad) if k < 2 else frame for k, frame in enumerate(room(6))]
    found = guided(frames)
    assert faults(found) == [LOST, LOST, None, None, None, None]
    assert "no frame so far has a pose" in found[0].fault_detail
    np.testing.assert_allclose(found[2].T_world_sensor, room(6)[2].T_world_sensor, atol=1e-9)


def test_an_image_that_cannot_be_used_leaves_no_gap_in_the_motion():
    dark = [replace(f, depth=0 * f.depth) if k in (4, 5, 6) else f for k, f in enumerate(room(12))]
    found = guided(dark)
    assert faults(found) == [None] * 4 + [LOST] * 3 + [None] * 5
    assert np.linalg.norm((found[7].T_world_sensor - room(12)[7].T_world_sensor)[:3, 3]) < 0.02


def test_covariances_turn_with_the_world():
    turn = np.eye(4)
    turn[:3, :3] = rotation_matrix([0.0, 0.0, np.pi / 2])
    turned = [replace(frame, T_world_sensor=turn @ frame.T_world_sensor) for frame in room(4)]
    here, there = ([t.covariance for _, t in follow(f, GuidedTracker(load_config()))] for f in (room(4), turned))
    R = np.kron(np.eye(2), turn[:3, :3])
    np.testing.assert_allclose(there[3], R @ here[3] @ R.T, rtol=1e-3, atol=1e-12)
    assert not np.allclose(there[3], here[3], rtol=1e-2, atol=0)
