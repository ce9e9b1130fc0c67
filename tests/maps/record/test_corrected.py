# SPDX-License-Identifier: Apache-2.0
"""A map's memory of its sensors moves with their last frames."""

import numpy as np

from stereovox.geometry.se3 import rotation_matrix
from stereovox.maps.record.camera_path import LoopLines, StampedPose
from stereovox.maps.record.corrected import correct_history, matrix_of
from stereovox.maps.record.history import DisagreementSpell, History, ImageFingerprint, Streak


def seen(stamp_ns, x, turn=0.0):
    T = np.eye(4)
    T[:3, :3], T[0, 3] = rotation_matrix([0, 0, turn]), x
    return StampedPose(stamp_ns, tuple(T.ravel().tolist()[:12]))


def history_of(left, right):
    return History(
        frames=4,
        trusted={"left": left, "right": right},
        waiting={"left": Streak("pose_jump", 5, seen(6, 9.0)), "right": Streak("pose_jump", 5, seen(6, 9.0))},
        looks={"left": ImageFingerprint(7, seen(0, 0.5).pose), "right": ImageFingerprint(8, seen(0, 0.5).pose)},
        doubts={"left": DisagreementSpell(1, 2), "right": DisagreementSpell(1, 2)},
        glances={"left": (), "right": ()},
    )


def test_a_sensor_that_moved_is_remembered_where_it_is_now():
    before = [("left", seen(1, 0.0)), ("right", seen(1, 1.0)), ("left", seen(2, 0.3)), ("right", seen(2, 1.3))]
    after = [*before[:2], ("left", seen(2, 2.3, 0.5)), before[3]]
    history = history_of(before[2][1], before[3][1])
    history.loops = LoopLines()
    correct_history(history, before, after)
    assert history.loops is None
    assert history.trusted == {"left": after[2][1], "right": before[3][1]}
    assert list(history.waiting) == list(history.doubts) == list(history.glances) == ["right"]
    moved = matrix_of(after[2][1]) @ np.linalg.inv(matrix_of(before[2][1])) @ matrix_of(seen(0, 0.5))
    assert np.allclose(matrix_of(StampedPose(0, history.looks["left"].pose)), moved)
    assert history.looks["right"] == ImageFingerprint(8, seen(0, 0.5).pose)
    assert np.allclose(history.path.poses("left")[:, 0, 3], [0.0, 2.3])
    assert np.allclose(history.path.poses("right")[:, 0, 3], [1.0, 1.3])


def test_a_frame_that_was_not_kept_moves_as_the_last_one_that_was():
    """With a budget the last trusted frame may not be among those that are kept."""
    before, after = [("left", seen(1, 0.0))], [("left", seen(1, 2.0))]
    history = history_of(seen(3, 0.4), seen(3, 0.4))
    correct_history(history, before, after)
    assert history.trusted["left"].stamp_ns == 3
    assert np.allclose(matrix_of(history.trusted["left"])[:3, 3], [2.4, 0, 0])
    assert history.trusted["right"] == seen(3, 0.4)


def test_sensors_that_are_not_trusted_stay_unknown():
    history = History()
    correct_history(history, [("left", seen(1, 0.0))], [("left", seen(1, 2.0))])
    assert history.trusted == {}
