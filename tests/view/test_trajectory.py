# SPDX-License-Identifier: Apache-2.0
"""Pictures of trajectories: both ways, if there is no pose, errors by length."""

import io

import numpy as np
import pytest
from made_trajectories import flight, shaken, timed
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.evaluate.trajectory_score import travelled_m
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.pose_files import ImagePoses
from stereovox.view.figures import png_of
from stereovox.view.trajectory import LOST, score_figure, trajectory_png, way_figure

TRUE = flight()
FOUND = shaken(TRUE, 1, metres=0.3)
KEPT = np.r_[20:100, 140:300]
"""Poses that an estimate has: none of the first two seconds, none of four later."""


def with_gaps():
    found = timed(FOUND)
    return sv.score_trajectory(Poses(found.stamps_ns[KEPT], FOUND[KEPT]), timed(TRUE))


def without_gaps():
    return sv.score_trajectory(timed(FOUND), timed(TRUE))


def share_of(image: bytes, colour: str) -> float:
    return float((np.abs(imread(io.BytesIO(image))[..., :3] - to_rgb(colour)).max(axis=2) < 0.01).mean())


def test_the_truth_is_red_where_there_is_no_pose():
    above = score_figure(with_gaps()).axes[0]
    red = [line.get_xydata() for line in above.lines if line.get_color() == LOST]
    expected = [TRUE[0:21, :2, 3], TRUE[99:141, :2, 3]]
    assert len(red) == len(expected)
    for mine, theirs in zip(red, expected, strict=True):
        np.testing.assert_allclose(mine, theirs)
    assert share_of(trajectory_png(with_gaps()), LOST) > 5e-4 > share_of(trajectory_png(without_gaps()), LOST)


def test_lines_of_the_estimate_are_broken_there_and_charts_are_marked():
    for score, breaks in ((with_gaps(), 1), (without_gaps(), 0)):
        figure = score_figure(score)
        above, height, errors, *_ = figure.axes
        assert np.isnan(above.lines[1].get_ydata()).sum() == breaks
        assert np.isnan(height.lines[1].get_ydata()).sum() == breaks
        assert [len(axis.patches) for axis in (height, errors)] == [breaks, breaks]
    (marked,) = score_figure(with_gaps()).axes[1].patches
    travelled = travelled_m(TRUE[KEPT])
    assert marked.get_x() == pytest.approx(travelled[79])
    assert marked.get_width() == pytest.approx(travelled[80] - travelled[79])


def test_a_frame_that_is_left_out_now_and_then_is_no_gap():
    found = timed(FOUND)
    some = np.delete(np.arange(300), [50, 120, 121])
    score = sv.score_trajectory(Poses(found.stamps_ns[some], FOUND[some]), timed(TRUE))
    assert not score.pairs.truth_missed.any()


def test_poses_without_times_have_none_where_a_number_is_missing():
    numbers = np.delete(np.arange(300), [7, 8])
    ours = ImagePoses(list(FOUND[numbers]), "ours", numbers=numbers.tolist())
    score = sv.score_trajectory(ours, ImagePoses(list(TRUE), "truth", numbers=list(range(300))))
    assert np.flatnonzero(score.pairs.truth_missed).tolist() == [7, 8]
    assert len([line for line in score_figure(score).axes[0].lines if line.get_color() == LOST]) == 1


def test_errors_by_length_are_those_of_the_score():
    score = without_gaps()
    shift, turn = [axis for axis in score_figure(score).axes if "by length" in axis.get_title(loc="left")]
    assert [bar.get_height() for bar in shift.patches] == [one.translation_percent for one in score.segments]
    assert [bar.get_height() for bar in turn.patches] == [one.rotation_deg_per_m for one in score.segments]
    names = [text.get_text() for text in shift.get_xticklabels()]
    assert names == [f"{one.length_m:g} m\n{one.segments:,} x" for one in score.segments]


def test_errors_along_the_way_are_those_of_the_score():
    score = without_gaps()
    errors = score_figure(score).axes[2].lines[0]
    np.testing.assert_allclose(errors.get_xdata(), travelled_m(TRUE))
    np.testing.assert_allclose(errors.get_ydata(), score.position_errors_m)


def test_a_truth_that_stands_still_is_drawn_too():
    still = np.repeat(flight(1), 20, axis=0)
    figure = score_figure(sv.score_trajectory(timed(shaken(still, 2)), timed(still), align=False))
    np.testing.assert_array_equal(figure.axes[2].lines[0].get_xdata(), np.arange(20))


def test_one_call_writes_the_picture(tmp_path):
    sv.trajectory_picture(without_gaps(), tmp_path / "way.png")
    assert (tmp_path / "way.png").read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(StereovoxError, match=r"\.gif.*\.png"):
        sv.trajectory_picture(without_gaps(), tmp_path / "way.gif")


def test_a_way_without_truth_is_dotted_where_the_camera_was_lost():
    tracked = np.isin(np.arange(300), KEPT)
    figure = way_figure(np.where(tracked[:, None], TRUE[:, :3, 3], np.nan), tracked, "kitchen, tracked")
    above, height = figure.axes
    assert above.get_title(loc="left") == "kitchen, tracked"
    (lost,) = [line.get_xydata() for line in above.lines if line.get_color() == LOST]
    np.testing.assert_allclose(lost, TRUE[[99, 140], :2, 3])
    assert len(height.patches) == 1
    assert share_of(png_of(figure, 100), LOST) > 1e-5
