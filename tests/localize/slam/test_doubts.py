# SPDX-License-Identifier: Apache-2.0
"""Wheels slip and matching sticks: which of the two is believed, and what a finished map's self-check doubts."""

from dataclasses import replace

import numpy as np
import pytest
from made_drives import along, box, drive, ring

from stereovox.config import load_config
from stereovox.geometry import se2
from stereovox.localize.slam.graph import BENT, CONTRADICTED, SLIPPED_SCALE, MapDoubt, OdometryCheck, doubts_of, through
from stereovox.localize.slam.line_map import Cloud
from stereovox.localize.slam.pipeline import Slam, map_scans


def worst(result, truth):
    left = se2.relative(
        se2.relative(truth[0], truth), se2.relative(result.track.pose_map_base[0], result.track.pose_map_base)
    )
    return np.hypot(left[:, 0], left[:, 1]).max()


@pytest.fixture(scope="module")
def loop():
    pytest.importorskip("gtsam")
    slam = Slam(load_config())
    for scan in drive(
        ring(), along([(1, 1), (13, 1), (13, 9), (1, 9), (1, 1), (13, 1)], step=0.15), drift=(1.03, 0.01)
    ):
        slam.add(scan)
    return slam.finish()


def map_believed(truth, believed):
    """SLAM on a drive through the ring whose odometry believes other poses (N, 3) than the true ones."""
    scans = [
        replace(scan, T_world_sensor=se2.lifted(pose))
        for scan, pose in zip(drive(ring(), truth, limit=20.0), believed, strict=True)
    ]
    return map_scans(scans, load_config())


def test_a_right_map_is_not_doubted(loop):
    assert loop.closures > 0
    assert loop.doubts == []


def test_wheels_that_turn_the_wrong_way_do_not_lose_the_robot():
    """For 3 m odometry says forwards while the robot backs up, as in the log fr079: each scan is off by 0.2 m."""
    there, back = along([(1, 1), (6, 1)], step=0.1), along([(6, 1), (3, 1)], step=0.1)
    back[:, 2] = 0.0
    truth = np.vstack([there, back[1:]])
    believed = np.vstack([there, there[-1] + (there[-1] - back[1:]) * [1, 1, 0]])
    result = map_believed(truth, believed)
    assert worst(result, truth) < 0.15
    assert result.doubts == []


def test_matching_does_not_stick_in_a_long_corridor():
    """The first scan's far points lie as the beams do, and hold on to every later scan's."""
    walls = np.vstack([[(-2, -1, 40, -1), (-2, 1, 40, 1), (-2, -1, -2, 1), (40, -1, 40, 1)], box(0.5, 0.8, 0.9, 1.0)])
    truth = along([(0, 0), (12, 0)], step=0.1)
    result = map_scans(drive(walls, truth, limit=20.0), load_config())
    assert worst(result, truth) < 0.5


def bent(keyframes, at, by):
    """The keyframes with all from `at` on moved by `by` (3,) as seen from there."""
    pivot = keyframes[at].pose
    moved = se2.compose(pivot, by)
    return [
        key if i < at else replace(key, pose=se2.compose(moved, se2.relative(pivot, key.pose)))
        for i, key in enumerate(keyframes)
    ]


def test_a_map_bent_on_purpose_is_doubted(loop):
    middle = len(loop.keyframes) // 2
    doubts = doubts_of(bent(loop.keyframes, middle, [0.0, 0.0, np.radians(20)]), loop.edges)
    assert {"bent", "contradiction"} <= {doubt.kind for doubt in doubts}
    for doubt in doubts:
        assert doubt.figure > {"bent": BENT, "contradiction": CONTRADICTED}[doubt.kind]
        assert 0 <= doubt.begin_s <= doubt.end_s
        assert doubt.line().startswith(f"{doubt.kind}, ")
    assert doubts_of(bent(loop.keyframes, middle, [0.1, 0.0, 0.0]), loop.edges) == []


def test_held_steps_are_doubted_until_a_loop_joins_both_sides(loop):
    spanned = max(edge.first for edge in loop.edges) + 1
    assert any(edge.first < spanned <= edge.second for edge in loop.edges)
    held = [replace(key, slack=0.3) if i == spanned else key for i, key in enumerate(loop.keyframes)]
    assert doubts_of(held, loop.edges) == []
    lonely = [doubt.kind for doubt in doubts_of(held, [])]
    assert lonely == ["unseen"]
    # Two of them: what stands between needs a loop of its own.
    both = [replace(key, slack=0.3) if i in (spanned, spanned + 12) else key for i, key in enumerate(loop.keyframes)]
    apart = [edge for edge in loop.edges if not any(spanned <= i < spanned + 12 for i in (edge.first, edge.second))]
    assert [doubt.kind for doubt in doubts_of(both, apart)] == ["unseen", "unseen"]


def test_doubts_are_plain_numbers():
    found = MapDoubt("bent", 1.0, 2.0, 0.5, 6.0).as_dict()
    assert found == {"kind": "bent", "begin_s": 1.0, "end_s": 2.0, "figure": 0.5, "turn_deg": 6.0}


@pytest.mark.parametrize(
    ("metres", "degrees", "words"),
    [(0.04, 8.0, "by 8 degrees;"), (0.5, 2.0, "by 0.5 m;"), (0.5, 8.0, "by 0.5 m and 8 degrees;")],
)
def test_what_was_bent_is_told_in_what_is_too_much(metres, degrees, words):
    assert words in MapDoubt("bent", 1.0, 2.0, metres, degrees).line()


def blinded(scans, blind):
    """The scans, of which those of a slice see nothing."""
    return [
        replace(scan, ranges=np.full_like(scan.ranges, np.inf)) if i in range(len(scans))[blind] else scan
        for i, scan in enumerate(scans)
    ]


@pytest.mark.parametrize(("count", "doubted"), [(3, []), (60, ["lost"])])
def test_a_step_made_blindly_has_the_slack_of_odometry_and_is_told_as_lost(count, doubted):
    scans = drive(ring(), along([(1, 1), (13, 1)]), drift=(1.03, 0.0))
    result = map_scans(blinded(scans, slice(30, 30 + count)), load_config())
    far = int(np.argmax([np.hypot(*key.step[:2]) for key in result.keyframes]))
    slack = [key.slack for key in result.keyframes]
    assert slack[far] > 0.01 * 0.1 * count
    assert sum(slack) == slack[far]
    assert [doubt.kind for doubt in result.doubts] == doubted
    for doubt in result.doubts:
        assert "odometry alone led on" in doubt.line()
        assert "contradict" not in doubt.line()


def test_the_odometry_s_slack_is_what_the_drive_has_shown():
    """A drive whose odometry is 6 % too long has more of it than one whose is right; standing adds none."""
    step, drifts = np.array([0.1, 0.0, 0.0]), []
    for factor in (1.0, 1.06):
        check, pose = OdometryCheck(), np.zeros(3)
        for i in range(400):
            before, pose = pose, se2.compose(pose, step)
            check.add(np.array([0.1 * factor * i, 0.0, 0.0]), before, pose)
        drifts.append(check.drift(step)[0])
        assert check.drift(np.zeros(3)) == (0.0, 0.0)
    assert drifts[0] < 0.001
    assert drifts[1] == pytest.approx(0.006, rel=0.2)


@pytest.mark.parametrize("step", [0.2, 0.5, 2.0])
def test_a_step_straight_back_that_odometry_counts_as_forwards_is_found(step):
    """Farther than the search around the odometry's place reaches; the whole way would be 6 m off."""
    there, after = along([(1, 1), (6, 1)]), along([(6, 1), (9, 1)])
    back = np.array([(6 - step * i, 1.0, 0.0) for i in range(1, round(3 / step) + 1)])
    after = after + (back[-1] - after[0])
    truth = np.vstack([there, back, after[1:]])
    wrong = there[-1] + (there[-1] - back) * [1, 1, 0]
    believed = np.vstack([there, wrong, after[1:] + (wrong[-1] - back[-1])])
    result = map_believed(truth, believed)
    assert worst(result, truth) < 0.1
    assert result.doubts == []


def test_steps_that_agree_are_no_contradiction_and_far_ones_are():
    check, pose = OdometryCheck(), np.zeros(3)
    for i in range(30):
        assert check.add(np.array([0.1 * i, 0, 0]), pose, se2.compose(pose, [0.1, 0.0, 0.0])) is None
    found = [check.add(np.array([2.9 + 0.1 * i, 0, 0]), pose, pose) for i in range(1, 6)]
    since = next(moment for moment in found if moment is not None)
    assert found[:2] == [None, None]  # 0.2 m may be a clock
    assert check.by_odometry(since, pose)[0] > 0.25
    check.settle(SLIPPED_SCALE)
    assert check.scale == SLIPPED_SCALE


def test_beams_that_pass_through_points_are_counted():
    angles = np.radians(np.arange(-90, 91))
    wall = 4 * np.column_stack([np.cos(angles), np.sin(angles)])
    seen = Cloud(wall.astype(np.float32), (wall / -4).astype(np.float32))
    ahead = np.array(
        [[2.0, 0.0], [3.9, 0.0], [6.0, 0.0], [-2.0, 0.0]]
    )  # seen through, the wall, behind it, not looked at
    assert through(seen, ahead) == (1, 2)


@pytest.mark.parametrize("step", [0.1, 1.2, 5.0])
def test_odometry_that_matching_does_not_follow_is_noticed_whatever_the_step(step):
    """Steps longer than the way over which both are compared are compared by themselves."""
    check, still, found = OdometryCheck(), np.zeros(3), []
    for i in range(12):
        found.append(check.add(np.array([step * i, 0, 0]), still, still))
    assert any(since is not None for since in found)
    agreeing, there = OdometryCheck(), [np.array([step * i, 0, 0]) for i in range(12)]
    assert all(agreeing.add(there[i], there[max(i - 1, 0)], there[i]) is None for i in range(12))
