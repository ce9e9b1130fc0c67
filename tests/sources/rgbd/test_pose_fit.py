# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_depth import camera_text, check, left_handed, matrix_line, posed, render, units, write

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.poses.tracker import AXES


def in_axes(T, axes):
    C = np.eye(4)
    C[:3, :3] = AXES[axes]
    return T @ C


def scaled(T, factor):
    T = T.copy()
    T[:3, 3] *= factor
    return T


def recording(folder, poses, true=None, per_metre=1000):
    for k, T in enumerate(true or posed(6)):
        write(folder / f"depth/{k}.png", units(render(T), per_metre))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    (folder / "poses.txt").write_text("".join(map(matrix_line, poses)))
    return folder


def fit_notes(source):
    return [note for note in source.notes if "poses do not fit" in note or "poses are all equal" in note]


WRONG = {
    "invert=1": inverse,
    "axes=opengl": lambda T: in_axes(T, "opengl"),
    "axes=ros": lambda T: in_axes(T, "ros"),
    "invert=1&axes=opengl": lambda T: inverse(in_axes(T, "opengl")),
    "poses_scale=0.001": lambda T: scaled(T, 1000),
    "poses_scale=0.01": lambda T: scaled(T, 100),
    "invert=1&poses_scale=0.001": lambda T: scaled(inverse(T), 1000),
}


@pytest.mark.parametrize("options", WRONG)
@pytest.mark.parametrize("per_metre", [1000, 5000])
def test_poses_that_do_not_fit_are_named_with_the_options_that_cure_them(tmp_path, options, per_metre):
    folder = recording(tmp_path, [WRONG[options](T) for T in posed(6)], per_metre=per_metre)
    (note,) = fit_notes(open_source(folder))
    found = note.partition("; try ?")[2].partition(",")[0]
    assert set(found.split("&")) - {f"depth_scale={per_metre}"} == set(options.split("&"))
    assert len(note) < 200
    cured = open_source(f"{folder}?{options}")
    check(cured, posed(6), per_metre)
    assert (cured.unit.sure, fit_notes(cured)) == (True, [])


def test_options_that_are_wrong_are_named_as_well(tmp_path):
    folder = recording(tmp_path, posed(6))
    assert fit_notes(open_source(folder)) == []
    for options, cure in (("invert=1", "invert=0"), ("axes=ros", "axes=optical"), ("poses_scale=100", "poses_scale=1")):
        (note,) = fit_notes(open_source(f"{folder}?{options}"))
        assert f"try ?{cure}, with which" in note


def test_a_depth_scale_that_is_given_is_checked(tmp_path):
    folder = recording(tmp_path, posed(6))
    assert fit_notes(open_source(f"{folder}?depth_scale=1000")) == []
    (note,) = fit_notes(open_source(f"{folder}?depth_scale=5000"))
    assert "depth_scale=1000" in note


def test_poses_of_another_recording_have_no_cure(tmp_path):
    others = [scaled(T, [-1, 4, 1]) for T in posed(6)[::-1]]
    (note,) = fit_notes(open_source(recording(tmp_path, others)))
    assert "check that poses, camera and depth unit belong to these images" in note


def test_poses_that_stand_still_while_images_change(tmp_path):
    far = posed(12)[::5]
    (note,) = fit_notes(open_source(recording(tmp_path / "moves", [np.eye(4)] * len(far), far)))
    assert "poses are all equal, but the images change" in note
    still = [posed()[0]] * 4
    assert fit_notes(open_source(recording(tmp_path / "stands", still, still))) == []


def test_millimetres_everywhere_are_not_taken_for_metres(tmp_path):
    folder = recording(tmp_path, [scaled(T, 1000) for T in posed(6)])
    assert open_source(folder).unit.scale == 0.001  # in metres they would agree just as well
    for k, T in enumerate(posed(6)):
        write(folder / f"depth/{k}.tiff", 1000 * render(T))
        (folder / f"depth/{k}.png").unlink()
    (note,) = (note for note in open_source(folder).notes if "depth is assumed to be" in note)
    assert "beyond" in note
    assert "?depth_scale=1000&poses_scale=0.001" in note
    check(open_source(f"{folder}?depth_scale=1000&poses_scale=0.001"), posed(6), 1e6)


@pytest.mark.parametrize("text", ["0", "-1", "nan", "inf", "x"])
def test_a_scale_of_no_use_is_one_line(tmp_path, text):
    with pytest.raises(SourceError, match="poses_scale"):
        open_source(f"{recording(tmp_path, posed(6))}?poses_scale={text}")


def test_poses_of_a_left_handed_world_need_a_negative_fy(tmp_path):
    nodding = [T @ turned_down(0.15 * k) for k, T in enumerate(posed(6))]
    folder = recording(tmp_path, [left_handed(T) for T in nodding], nodding)
    (note,) = fit_notes(open_source(folder))
    assert "fy below 0" in note
    (folder / "camera-intrinsics.txt").write_text(camera_text((52.0, -51.0, 31.0, 24.0)))
    source = open_source(folder)
    check(source, nodding, 1000)
    assert (source.unit.sure, fit_notes(source)) == (True, [])


def turned_down(angle):
    T = np.eye(4)
    T[1:3, 1:3] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return T
