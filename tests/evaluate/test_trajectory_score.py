# SPDX-License-Identifier: Apache-2.0
"""ATE, RPE and errors by distance: against evo on the same files, against plain loops, and of known errors."""

import json
from itertools import pairwise

import numpy as np
import pytest
from made_trajectories import RATE_NS, flight, moved, shaken, timed, transforms, write_kitti, write_tum
from scipy.spatial.transform import Rotation

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.sources.rgbd.pose_files import ImagePoses


def figures(one):
    return [one.rmse, one.mean, one.median, one.max]


def at_other_times(seed, every, jitter_ns):
    """Return a truth at 10 Hz and an estimate of every `every`-th pose, late by up to `jitter_ns`, not all near."""
    random = np.random.default_rng(seed)
    true = timed(flight())
    late = random.integers(-jitter_ns, jitter_ns, len(true))
    return timed(shaken(moved() @ flight(), seed)[::every], (true.stamps_ns + late)[::every]), true


CASES = {
    "same times": lambda: (timed(shaken(moved() @ flight(), 1)), timed(flight())),
    "sparse estimate": lambda: at_other_times(2, 3, 30_000_000),
    "dense estimate": lambda: at_other_times(3, 3, 30_000_000)[::-1],
}


@pytest.mark.parametrize("scale", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_figures_are_those_of_evo_on_the_same_files(tmp_path, name, scale):
    pytest.importorskip("evo", reason="pip install 'stereovox[test]'")
    from evo.core import metrics, sync
    from evo.tools.file_interface import read_tum_trajectory_file

    estimate, truth = CASES[name]()
    write_tum(tmp_path / "estimate.tum", estimate)
    write_tum(tmp_path / "truth.tum", truth)
    found = sv.score_trajectory(tmp_path / "estimate.tum", tmp_path / "truth.tum", scale=scale)
    true, ours = sync.associate_trajectories(
        read_tum_trajectory_file(tmp_path / "truth.tum"),
        read_tum_trajectory_file(tmp_path / "estimate.tum"),
        max_diff=0.02,
    )
    ours.align(true, correct_scale=scale)
    assert len(found.pairs) == true.num_poses
    assert found.length_m == pytest.approx(true.path_length)
    for ours_found, metric, relation in (
        (found.position_m, metrics.APE, "translation_part"),
        (found.rotation_deg, metrics.APE, "rotation_angle_deg"),
        (found.per_frame.translation_m, metrics.RPE, "translation_part"),
        (found.per_frame.rotation_deg, metrics.RPE, "rotation_angle_deg"),
    ):
        peer = metric(metrics.PoseRelation[relation])
        peer.process_data((true, ours))
        theirs = [peer.get_all_statistics()[which] for which in ("rmse", "mean", "median", "max")]
        assert figures(ours_found) == pytest.approx(theirs, rel=1e-6, abs=1e-9), relation


def test_figures_of_files_without_times_are_those_of_evo(tmp_path):
    pytest.importorskip("evo", reason="pip install 'stereovox[test]'")
    from evo.core import metrics
    from evo.tools.file_interface import read_kitti_poses_file

    ours, true = write_kitti(tmp_path / "a.txt", shaken(flight(), 4)), write_kitti(tmp_path / "b.txt", flight())
    peer = metrics.APE(metrics.PoseRelation.translation_part)
    peer.process_data((read_kitti_poses_file(true), read_kitti_poses_file(ours)))
    found = sv.score_trajectory(ours, true, align=False)
    assert figures(found.position_m)[0] == pytest.approx(peer.get_all_statistics()["rmse"], rel=1e-9)
    assert (found.duration_s, found.per_second, found.pairs.stamps_ns) == (None, None, None)


def test_errors_by_distance_follow_the_rule_of_kitti_in_plain_loops():
    true, ours = flight(900, 0.5), shaken(flight(900, 0.5), 5)
    found = sv.score_trajectory(timed(ours), timed(true))
    travelled = [0.0]
    for before, after in pairwise(true):
        travelled.append(travelled[-1] + np.sqrt(((after - before)[:3, 3] ** 2).sum()))
    rows = []
    for first in range(0, len(true), 10):
        for length in (100, 200, 300, 400, 500, 600, 700, 800):
            last = next((i for i in range(first, len(true)) if travelled[i] > travelled[first] + length), None)
            if last is None:
                continue
            truly, moving = (np.linalg.inv(T[first]) @ T[last] for T in (true, ours))
            error = np.linalg.inv(moving) @ truly
            angle = np.degrees(np.arccos(np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)))
            rows.append((length, 100 * np.linalg.norm(error[:3, 3]) / length, angle / length))
    assert found.translation_percent == pytest.approx(np.mean([row[1] for row in rows]))
    assert found.rotation_deg_per_m == pytest.approx(np.mean([row[2] for row in rows]))
    assert [one.length_m for one in found.segments] == sorted({row[0] for row in rows})
    for one in found.segments:
        same = [row for row in rows if row[0] == one.length_m]
        assert one.segments == len(same)
        assert one.translation_percent == pytest.approx(np.mean([row[1] for row in same]))


def test_errors_by_second_in_plain_loops():
    true, ours = flight(), shaken(flight(), 6)
    stamps = np.arange(300) * RATE_NS + np.random.default_rng(6).integers(0, 20_000_000, 300)
    stamps[150:] += 3_000_000_000  # a gap: nothing lies a second after the poses before it
    found = sv.score_trajectory(timed(ours, stamps), timed(true, stamps)).per_second
    errors = []
    for i, stamp in enumerate(stamps):
        j = int(np.argmin(np.abs(stamps - stamp - 10**9)))
        if abs(int(stamps[j] - stamp) - 10**9) <= 10**8 and stamp + 10**9 <= stamps[-1]:
            truly, moving = (np.linalg.inv(T[i]) @ T[j] for T in (true, ours))
            errors.append(np.linalg.norm((np.linalg.inv(truly) @ moving)[:3, 3]))
    assert found is not None
    assert (found.pairs, found.translation_m.rmse) == (len(errors), pytest.approx(np.sqrt(np.mean(np.square(errors)))))
    assert len(errors) < 290


@pytest.mark.parametrize("factor", [1.0, 2.5])
def test_the_truth_in_another_frame_and_scale_has_no_error(factor):
    other = moved() @ flight()
    other[:, :3, 3] *= factor
    found = sv.score_trajectory(timed(other), timed(flight()), scale=factor != 1)
    assert found.scale == pytest.approx(1 / factor)
    worst = [found.position_m.max, found.rotation_deg.max, found.per_frame.translation_m.max, found.drift_percent]
    assert worst == pytest.approx([0] * 4, abs=1e-6)
    assert found.aligned_positions() == pytest.approx(flight()[:, :3, 3], abs=1e-9)
    assert json.loads(json.dumps(found.as_dict(), allow_nan=False))["poses"] == 300


def test_the_alignment_beats_all_near_it():
    ours, true = shaken(moved() @ flight(), 7), flight()
    found = sv.score_trajectory(timed(ours), timed(true))
    for k in range(6):
        for sign in (-1e-3, 1e-3):
            step = np.eye(6)[k] * sign
            nudge = transforms(step[None, :3], Rotation.from_rotvec(step[None, 3:]))[0]
            near = found.T_truth_world @ nudge @ ours
            assert found.position_m.rmse < np.sqrt(((near - true)[:, :3, 3] ** 2).sum(axis=1).mean())


def test_errors_in_one_frame_count_where_nothing_is_aligned():
    off = flight()
    off[:, :3, 3] += (0.3, -0.4, 0.0)
    found = sv.score_trajectory(timed(off), timed(flight()), align=False)
    assert figures(found.position_m) == pytest.approx([0.5] * 4)
    assert np.array_equal(found.T_truth_world, np.eye(4))
    assert not found.as_dict()["aligned"]


def straight(metres=60.0, step=0.125, factor=1.0, turn=0.0):
    """Return poses along x, too long by `factor`, whose heading drifts by `turn` radians a metre without moving off."""
    along = np.arange(0, metres + step / 2, step)
    headings = Rotation.from_rotvec(np.outer(turn * along, [0, 0, 1]))
    return transforms(np.column_stack([factor * along, 0 * along, 0 * along]), headings)


def test_a_known_drift_gives_its_per_cent():
    found = sv.score_trajectory(timed(straight(factor=1.02)), timed(straight()), segments_m=[8, 31.99])
    assert found.drift_percent == pytest.approx(2)
    assert [one.translation_percent for one in found.segments] == pytest.approx([2 * 8.125 / 8, 2 * 32 / 31.99])
    assert found.per_frame.translation_m.max == pytest.approx(0.02 * 0.125)
    assert found.per_second is not None
    assert found.per_second.translation_m.mean == pytest.approx(0.02 * 1.25)


def test_a_known_turn_gives_its_degrees_per_metre():
    found = sv.score_trajectory(timed(straight(turn=0.01)), timed(straight()), segments_m=[15.99])
    assert found.rotation_deg_per_m == pytest.approx(np.degrees(0.01) * 16 / 15.99)


def test_rotations_decide_what_a_straight_trajectory_leaves_open():
    found = sv.score_trajectory(timed(moved() @ straight()), timed(straight()))
    assert found.rotation_deg.max == pytest.approx(0, abs=1e-5)
    assert found.position_m.max == pytest.approx(0, abs=1e-6)


def test_the_alignment_never_mirrors():
    mirrored = flight()
    mirrored[:, 2, 3] *= -1
    found = sv.score_trajectory(timed(mirrored), timed(flight()))
    assert np.linalg.det(found.T_truth_world[:3, :3]) == pytest.approx(1)
    assert found.position_m.rmse > 0.1


def test_other_axes_of_the_body_are_told_as_what_the_rotations_have_in_common():
    other = flight() @ transforms(np.zeros((1, 3)), Rotation.from_euler("x", [90], degrees=True))
    assert sv.score_trajectory(timed(other), timed(flight())).rotation_offset_deg == pytest.approx(90)
    assert sv.score_trajectory(timed(shaken(flight(), 8)), timed(flight())).rotation_offset_deg < 1


@pytest.mark.parametrize(("number", "lengths"), [(90, [1, 2, 5, 10, 20, 50]), (150, [100])])
def test_short_trajectories_have_short_segments(number, lengths):
    true = straight(metres=number)
    assert [one.length_m for one in sv.score_trajectory(timed(true), timed(true)).segments] == lengths


def test_segments_that_do_not_fit_are_left_out():
    found = sv.score_trajectory(timed(straight()), timed(straight()), segments_m=[1000])
    assert (found.segments, found.translation_percent, found.rotation_deg_per_m) == ((), None, None)


def test_coverage_is_the_share_of_the_truth_s_time_that_has_poses():
    true = timed(flight())  # 29.9 s
    half = timed(flight()[:150])
    found = sv.score_trajectory(half, true)
    assert (len(found.pairs), found.pairs.coverage) == (150, pytest.approx(14.9 / 29.9))
    some = np.r_[0:100, 200:300]  # a gap of 10.1 s
    found = sv.score_trajectory(timed(flight()[some], some * RATE_NS), true)
    assert found.pairs.coverage == pytest.approx((29.9 - 10.1) / 29.9)
    rare = sv.score_trajectory(timed(flight()[::8], np.arange(300)[::8] * RATE_NS), true)
    assert rare.pairs.coverage == pytest.approx(29.6 / 29.9)


@pytest.mark.parametrize(("every", "seconds"), [(20, 28.0), (50, 25.0)])
def test_keyframes_seconds_apart_cover_what_lies_between_them(every, seconds):
    """One pose every 2 or 5 s against a truth at 10 Hz; and the reverse: such a truth, whose span is known wholly."""
    true, few = timed(flight()), timed(flight()[::every], np.arange(300)[::every] * RATE_NS)
    assert sv.score_trajectory(few, true).pairs.coverage == pytest.approx(seconds / 29.9)
    assert sv.score_trajectory(true, few).pairs.coverage == pytest.approx(1)


def test_a_keyframe_trajectory_that_gave_up_does_not_cover_the_gap():
    some = np.r_[0:100:20, 240:300:20]  # 8 s and 4 s of poses every 2 s, and 16 s of nothing
    found = sv.score_trajectory(timed(flight()[some], some * RATE_NS), timed(flight()))
    assert found.pairs.coverage == pytest.approx((8 + 4) / 29.9)


def test_poses_without_a_partner_are_counted():
    true, stamps = timed(flight()), np.arange(300) * RATE_NS
    stamps[::2] += 21_000_000
    found = sv.score_trajectory(timed(flight(), stamps), true)
    assert (len(found.pairs), found.as_dict()["without_truth"]) == (150, 150)
    assert len(sv.score_trajectory(timed(flight(), stamps), true, max_difference_s=0.022).pairs) == 300


@pytest.mark.parametrize("swapped", [False, True])
def test_each_pose_of_the_sparser_trajectory_has_one_partner(swapped):
    sparse, dense = timed(flight()[::20], np.arange(15) * 20 * RATE_NS), timed(flight())
    ours, true = (dense, sparse) if swapped else (sparse, dense)
    found = sv.score_trajectory(ours, true, max_difference_s=1.0)
    assert (len(found.pairs), found.as_dict()["without_truth"]) == (15, 285 if swapped else 0)
    assert found.position_m.max == pytest.approx(0, abs=1e-9)


def test_images_pair_by_their_numbers():
    T = flight(20)
    ours = ImagePoses(list(T[5:15]), "ours", list(range(5, 15)))
    found = sv.score_trajectory(ours, ImagePoses(list(T), "truth", list(range(20))))
    assert (len(found.pairs), found.pairs.coverage) == (10, 0.5)
    assert found.position_m.max == pytest.approx(0, abs=1e-9)


def still():
    return timed(np.repeat(flight(1), 50, axis=0))


def with_one(number):
    T = flight()
    T[7, 0, 3] = number
    return ImagePoses(list(T), "ours")


REFUSED = {
    "no overlap": (lambda: timed(flight(), np.arange(300) + 10**15), {}, "0 poses have one of poses no more than 0.02"),
    "two poses": (lambda: timed(flight(2)), {}, r"2 poses have .*\(3 are needed\)"),
    "one pose": (lambda: timed(flight(1)), {}, r"1 poses have .*\(3 are needed\)"),
    "standing still": (still, {}, "stands still"),
    "scale alone": (lambda: timed(flight()), {"align": False, "scale": True}, "scale=True"),
    "no difference": (lambda: timed(flight()), {"max_difference_s": float("nan")}, "give seconds above 0"),
    "a segment of nothing": (lambda: timed(flight()), {"segments_m": [1, 0]}, "give lengths in metres above 0"),
    "a difference without times": (
        lambda: ImagePoses(list(flight()), "ours"),
        {"truth": ImagePoses(list(flight()), "true"), "max_difference_s": 0.02},
        "ours: has no times, poses pair by number or line",
    ),
    "only one with times": (lambda: ImagePoses(list(flight()), "ours"), {}, "ours: has no times"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_scored_is_refused_in_one_line(name):
    make, options, words = REFUSED[name]
    with pytest.raises(StereovoxError, match=words):
        sv.score_trajectory(make(), **{"truth": timed(flight()), **options})


def test_a_truth_that_stands_still_has_no_drift():
    found = sv.score_trajectory(timed(shaken(np.repeat(flight(1), 50, axis=0), 9)), still(), align=False)
    assert (found.drift_percent, found.length_m) == (None, 0)
    assert found.position_m.rmse == pytest.approx(0.05 * np.sqrt(3), rel=0.2)


def test_poses_of_no_use_are_named(tmp_path):
    for number in (np.nan, np.inf, 1e200):
        with pytest.raises(StereovoxError, match="ours: pose 8 is not rigid, holds NaN"):
            sv.score_trajectory(with_one(number), ImagePoses(list(flight()), "truth"))
    with pytest.raises(StereovoxError, match=r"300 poses, truth 299; without times each needs its partner"):
        sv.score_trajectory(ImagePoses(list(flight()), "ours"), ImagePoses(list(flight(299)), "truth"))
    path = write_tum(tmp_path / "a.tum", timed(flight()))
    path.write_text(path.read_text().replace("0.200000000 ", "0.200000000 nan ", 1))
    with pytest.raises(StereovoxError, match=r"a.tum:3: needs 'stamp tx ty tz qx qy qz qw'"):
        sv.score_trajectory(path, timed(flight()))
