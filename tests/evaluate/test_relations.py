# SPDX-License-Identifier: Apache-2.0
"""Relations against numbers worked out by hand."""

from math import pi, sqrt

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.evaluate.trajectory import read_relations, relation_errors, score_relations
from stereovox.geometry import se2
from stereovox.localize.track import Track

STAMPS = np.array([0, 1, 2, 3], np.int64) * 10**9
POSES = np.array([[0, 0, 0], [1, 0, pi / 2], [1, 2, pi / 2], [0, 2, pi]], float)
"""Motions: 1 ahead, turning left; 2 ahead; 1 to the left, turning left."""


def written(tmp_path, *lines):
    path = tmp_path / "a.relations"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_true_relations_leave_no_error(tmp_path):
    path = written(
        tmp_path, f"0 1 1 0 0 0 0 {pi / 2}", "1.0 2.0 2 0 0 0 0 0", f"2 3 0 1 0 0 0 {pi / 2}", f"0 3 0 2 0 0 0 {pi}"
    )
    errors = relation_errors(read_relations(path), STAMPS, POSES)
    assert np.allclose(errors.metres, 0, atol=1e-12)
    assert np.allclose(errors.radians, 0, atol=1e-12)


def test_errors_are_those_worked_out_by_hand(tmp_path):
    path = written(
        tmp_path, "# a comment", f"0 1 1.3 0.4 9 9 9 {pi / 2 - 0.1}", "", "1 2 2 0 0 0 0 0.2", f"0 3 0 2 0 0 0 {-pi}"
    )
    errors = relation_errors(read_relations(path), STAMPS, POSES)
    assert np.allclose(errors.metres, [0.5, 0, 0])
    assert np.allclose(errors.radians, [0.1, 0.2, 0], atol=1e-12)
    rows = errors.rows()
    assert rows["absolute_m"] == pytest.approx((0.5 / 3, sqrt(2) * 0.5 / 3))
    assert rows["squared_m2"] == pytest.approx((0.25 / 3, sqrt(2) * 0.25 / 3))
    assert rows["absolute_deg"][0] == pytest.approx(np.degrees(0.1))
    assert rows["squared_deg2"][0] == pytest.approx(np.degrees(0.1) ** 2 / 3 + np.degrees(0.2) ** 2 / 3)
    assert errors.line() == "3 relations: off by 0.1667 +- 0.2357 m and 5.7296 +- 4.6782 degrees"
    assert errors.as_dict()["absolute_m"] == {"mean": pytest.approx(1 / 6), "std": pytest.approx(sqrt(2) / 6)}


def test_the_frame_of_the_map_does_not_matter(tmp_path):
    relations = read_relations(written(tmp_path, "0 1 1.3 0.4 0 0 0 1", "1 3 2 1 0 0 0 1", "2 0 1 1 0 0 0 2"))
    here = relation_errors(relations, STAMPS, POSES)
    there = relation_errors(relations, STAMPS, se2.compose([100.0, -40.0, 2.5], POSES))
    assert np.allclose(here.metres, there.metres)
    assert np.allclose(here.radians, there.radians)


def test_the_pose_nearest_in_time_counts(tmp_path):
    relations = read_relations(
        written(tmp_path, "0.04 1.96 1 2 0 0 0 1.5707963", "0.4 2 1 2 0 0 0 0", "0 9 0 0 0 0 0 0")
    )
    errors = relation_errors(relations, STAMPS, POSES)
    assert errors.missed == 2
    assert np.allclose(errors.metres, [0.0])
    assert "2 more have no pose" in errors.line()
    assert relation_errors(relations, STAMPS, POSES, tolerance_s=0.41).missed == 1
    assert len(relation_errors(relations, [2 * 10**9], POSES[2:3], tolerance_s=10).metres) == 3


def test_a_track_is_scored(tmp_path):
    errors = score_relations(Track(STAMPS, POSES, POSES), written(tmp_path, "1.0 2.0 2.5 0 0 0 0 0"))
    assert errors.metres == pytest.approx([0.5])


def test_stamps_are_exact(tmp_path):
    relations = read_relations(written(tmp_path, "1134864629.895182 1134864630.105182001 0 0 0 0 0 0"))
    assert relations.stamps_ns.tolist() == [[1134864629895182000, 1134864630105182001]]


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (("0 1 1 0 0 0 0",), "line 1 is not a relation"),
        (("0 1 1 0 0 0 0 0", "0 1 1 0 0 0 0 x"), "line 2 is not a relation"),
        (("0 1 nan 0 0 0 0 0",), "line 1 is not a relation"),
        (("0 1e99 1 0 0 0 0 0",), "line 1 is not a relation"),
        (("0 inf 1 0 0 0 0 0",), "line 1 is not a relation"),
        (("# nothing",), "holds no relation"),
    ],
)
def test_files_that_make_no_sense_are_one_line(tmp_path, lines, complaint):
    with pytest.raises(SourceError, match=complaint) as error:
        read_relations(written(tmp_path, *lines))
    assert "\n" not in str(error.value)


def test_a_missing_file_and_another_recording_are_one_line(tmp_path):
    with pytest.raises(SourceError, match="no such file"):
        read_relations(tmp_path / "none.relations")
    relations = read_relations(written(tmp_path, "50 51 0 0 0 0 0 0"))
    with pytest.raises(SourceError, match="one recording"):
        relation_errors(relations, STAMPS, POSES)
