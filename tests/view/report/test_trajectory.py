# SPDX-License-Identifier: Apache-2.0
"""The page and picture of a trajectory's score."""

import io

import numpy as np
import pytest
from made_trajectories import flight, shaken, timed, transforms
from matplotlib.colors import to_rgb
from matplotlib.image import imread
from scipy.spatial.transform import Rotation

import stereovox as sv
from stereovox.sources.rgbd.pose_files import ImagePoses
from stereovox.view.evaluation import PRECISION
from stereovox.view.report.trajectory import error_rows, notes, segment_rows, write_trajectory_report
from stereovox.view.trajectory import ESTIMATE, TRUTH, trajectory_png


def as_images(T):
    return ImagePoses(list(T), "poses")


@pytest.mark.parametrize("made", [timed, as_images])
def test_the_picture_has_both_trajectories_and_the_errors(made):
    png = trajectory_png(sv.score_trajectory(made(shaken(flight(), 1, metres=1.0)), made(flight())))
    image = imread(io.BytesIO(png))[..., :3]
    for colour in (TRUTH, ESTIMATE, PRECISION):
        assert (np.abs(image - to_rgb(colour)).max(axis=2) < 0.01).sum() > 200, colour


def test_a_page_without_segments_or_drift_is_written(tmp_path):
    still = np.repeat(flight(1), 20, axis=0)
    score = sv.score_trajectory(timed(shaken(still, 2)), timed(still), align=False)
    text = write_trajectory_report(tmp_path / "out", score, "<ours>", "theirs").read_text()
    assert "&lt;ours&gt; compared with theirs" in text
    assert "By distance" not in text
    assert segment_rows(score) == [("all", "0", "-", "-")]
    assert len(error_rows(score)) == 6


def test_a_rotation_that_all_poses_are_off_by_is_noted(tmp_path):
    other = flight() @ transforms(np.zeros((1, 3)), Rotation.from_euler("x", [90], degrees=True))
    score = sv.score_trajectory(timed(other), timed(flight()))
    assert "90.0 degrees of the rotation errors are the same everywhere" in notes(score)[0]
    assert notes(score)[0] in write_trajectory_report(tmp_path, score).read_text()
