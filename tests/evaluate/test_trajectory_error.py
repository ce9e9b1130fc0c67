# SPDX-License-Identifier: Apache-2.0
"""ATE and RPE of ways whose error is known."""

import json

import numpy as np
import pytest

from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory import best_motion, trajectory_error
from stereovox.geometry import se2
from stereovox.localize.track import Track
from stereovox.sources.poses.poses import Poses

STAMPS = np.arange(101) * 50_000_000 + 7
ALONG = np.linspace(0, 10, 101)
TRUE = np.column_stack([ALONG, np.sin(ALONG), np.arctan(np.cos(ALONG))])


def truth(stamps=STAMPS, poses=TRUE):
    return Poses(stamps, [se2.lifted(pose) for pose in poses])


def track(poses, stamps=STAMPS):
    return Track(stamps, np.asarray(poses), np.zeros((len(stamps), 3)))


def test_the_true_way_has_no_error_in_any_frame():
    moved = se2.compose((3.0, -8.0, 2.1), TRUE)
    found = trajectory_error(track(moved), truth())
    assert [found.position_rms_m, found.position_max_m, found.yaw_rms_deg] == pytest.approx([0] * 3, abs=1e-5)
    assert found.step_rms_m == pytest.approx(0, abs=1e-9)
    assert found.motion == pytest.approx(se2.inverse((3.0, -8.0, 2.1)))
    assert json.dumps(found.as_dict(), allow_nan=False)


def test_errors_in_the_map_s_own_frame_count_where_it_is_not_aligned():
    found = trajectory_error(track(TRUE + np.array([0.3, -0.4, np.radians(2)])), truth(), align=False)
    numbers = (found.position_rms_m, found.position_median_m, found.position_p95_m, found.position_max_m)
    assert numbers == pytest.approx([0.5] * 4)
    assert (found.yaw_rms_deg, found.yaw_max_deg) == pytest.approx((2, 2))
    assert found.motion.tolist() == [0, 0, 0]


def test_position_and_steps_against_plain_loops():
    random = np.random.default_rng(1)
    ours = TRUE + random.normal(0, [0.05, 0.05, 0.02], TRUE.shape)
    found = trajectory_error(track(ours), truth(), align=False, step_m=2.0)
    squares = [(a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 for a, b in zip(ours, TRUE, strict=True)]
    assert found.position_rms_m == pytest.approx(np.sqrt(np.mean(squares)))
    errors = []
    for i in range(len(TRUE)):
        way, j = 0.0, i
        while way < 2.0 - 1e-9 and j + 1 < len(TRUE):
            way += np.hypot(*(TRUE[j + 1] - TRUE[j])[:2])
            j += 1
        if way >= 2.0 - 1e-9:
            T = [np.linalg.inv(se2.lifted(p[i])) @ se2.lifted(p[j]) for p in (TRUE, ours)]
            errors.append(np.linalg.norm((np.linalg.inv(T[0]) @ T[1])[:2, 3]))
    assert found.step_rms_m == pytest.approx(np.sqrt(np.mean(np.square(errors))))


def test_the_best_motion_beats_all_near_it():
    random = np.random.default_rng(2)
    here = random.normal(0, [3, 3, 1], (40, 3))
    there = se2.compose((1.0, 2.0, -0.7), here) + random.normal(0, [0.3, 0.3, 0.01], here.shape)
    best = best_motion(here, there)

    def cost(pose):  # positions, and points 0.3 m ahead of them
        moved = se2.compose(pose, here)
        ahead = [np.column_stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])]) for poses in (moved, there)]
        return ((moved - there)[:, :2] ** 2).sum() + 0.3**2 * ((ahead[0] - ahead[1]) ** 2).sum()

    for step in np.concatenate([np.eye(3), -np.eye(3)]) * 1e-4:
        assert cost(best) < cost(best + step)


def test_on_a_long_way_headings_hardly_matter():
    random = np.random.default_rng(3)
    wrong = TRUE + random.normal(0, [0.05, 0.05, 0.01], TRUE.shape)
    wrong[:, 2] = 0  # the truth of a tracker without a heading
    assert se2.wrapped(best_motion(wrong, TRUE)[2]) == pytest.approx(0, abs=0.005)
    turned = TRUE + random.normal(0, [0.05, 0.05, 0.01], TRUE.shape) + [0, 0, 0.1]  # mounted askew
    assert best_motion(turned, TRUE)[2] == pytest.approx(0, abs=0.005)


@pytest.mark.parametrize("shaken", [0.0, 1e-9, 0.002])
def test_a_robot_that_only_turns_is_laid_on_the_truth_by_its_headings(shaken):
    random = np.random.default_rng(4)
    turning = np.column_stack([np.zeros((101, 2)), np.linspace(-9, 9, 101)])
    ours = se2.compose((4.0, 1.0, 2.0), turning) + random.normal(0, [shaken, shaken, 0.01], turning.shape)
    found = trajectory_error(track(ours), truth(poses=turning))
    assert found.motion[2] == pytest.approx(-2.0, abs=0.01)
    assert found.yaw_rms_deg == pytest.approx(np.degrees(0.01), rel=0.3)
    assert found.position_rms_m == pytest.approx(shaken * np.sqrt(2), abs=1e-9, rel=0.2)


def test_one_pose_is_laid_on_another():
    assert best_motion([[1.0, 2.0, 0.5]], [[0.0, 0.0, -0.5]]) == pytest.approx(
        se2.compose((0, 0, -0.5), se2.inverse((1.0, 2.0, 0.5)))
    )


def test_poses_without_truth_are_left_out_and_counted():
    found = trajectory_error(track(TRUE), truth(STAMPS[:50], TRUE[:50]))
    assert (found.poses, found.without_truth) == (50, 51)
    with pytest.raises(StereovoxError, match="truth of the same recording"):
        trajectory_error(track(TRUE, STAMPS + 10**12), truth())


def test_a_way_shorter_than_a_step_has_no_step_error():
    found = trajectory_error(track(TRUE[:3], STAMPS[:3]), truth())
    assert found.step_rms_m is None
    still = trajectory_error(track(TRUE[:1], STAMPS[:1]), truth())
    assert still.position_rms_m == pytest.approx(0)
