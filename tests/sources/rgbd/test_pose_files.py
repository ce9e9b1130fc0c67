# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import numpy as np
import pytest
from made_depth import matrix_line, posed, tum_line
from scipy.spatial.transform import Rotation

from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.pose_files import (
    ImagePoses,
    image_numbers,
    in_optical_axes,
    number_in,
    read_pose,
    read_poses,
)

ROWS = ["".join(" ".join(map(str, row)) + "\n" for row in T) for T in posed()]
LOG = "".join(f"{k} {k} {k + 1}\n{rows}" for k, rows in enumerate(ROWS))
FORMS = {
    "12 numbers": "".join(matrix_line(T, 3) for T in posed()),
    "16 numbers": "# world from camera\n" + "".join(map(matrix_line, posed())),
    "commas and a heading": "a,b,c\n" + "".join(matrix_line(T).replace(" ", ",") for T in posed()),
    "7 numbers": "".join(tum_line("", T) for T in posed()),
    "4x4 below each other": "\n".join(ROWS),
    "3x4 below each other": "".join("\n".join(row.splitlines()[:3]) + "\n" for row in ROWS),
    "log": LOG,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_one_pose_for_each_image(tmp_path, form):
    (tmp_path / "p.txt").write_text(FORMS[form])
    found = read_poses(tmp_path / "p.txt")
    assert isinstance(found, ImagePoses)
    assert len(found) == 4
    for i, T in enumerate(posed()):
        np.testing.assert_allclose(found.at(i), T, atol=1e-9)


def test_tum_lines_have_times(tmp_path):
    (tmp_path / "p.txt").write_text("".join(tum_line(k / 2, T) for k, T in enumerate(posed())))
    found = read_poses(tmp_path / "p.txt")
    assert isinstance(found, Poses)
    np.testing.assert_allclose(found.at(1_500_000_000), posed()[3], atol=1e-9)


@pytest.mark.parametrize("shape", [(4, 4), (16,), (3, 4), (12,)])
def test_arrays(tmp_path, shape):
    rows = 3 if np.prod(shape) == 12 else 4
    np.save(tmp_path / "p.npy", np.stack([T[:rows].reshape(shape) for T in posed()]))
    np.testing.assert_allclose(read_poses(tmp_path / "p.npy").at(2), posed()[2])
    (tmp_path / "p.npy").write_bytes((tmp_path / "p.npy").read_bytes()[:100])
    with pytest.raises(SourceError, match="not an array of poses"):
        read_poses(tmp_path / "p.npy")


def test_open3ds_json_is_world_to_camera_and_column_by_column(tmp_path):
    cameras = [{"extrinsic": np.linalg.inv(T).T.ravel().tolist()} for T in posed()]
    (tmp_path / "p.json").write_text(json.dumps({"parameters": cameras}))
    np.testing.assert_allclose(read_poses(tmp_path / "p.json").at(3), posed()[3], atol=1e-9)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"parameters": 3}', '{"parameters": [{"extrinsic": [1, 2]}]}', "1"])
def test_other_json_is_refused(tmp_path, text):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(SourceError, match=r"p\.json: not "):
        read_poses(tmp_path / "p.json")


def test_a_folder_is_read_by_the_numbers_in_names(tmp_path):
    for k, T in zip([30, 4, 100, 7], posed(), strict=True):
        np.savetxt(tmp_path / f"{k}.txt", T)
    (tmp_path / "8.txt").write_text("1 2 3")
    found = read_poses(tmp_path)
    assert isinstance(found, ImagePoses)
    assert found.numbers == [4, 7, 8, 30, 100]
    chosen = found.of([100, 5, 8, 30])
    np.testing.assert_allclose(chosen.at(0), posed()[2])
    np.testing.assert_allclose(chosen.at(3), posed()[0])
    assert reason(chosen, 1) == "no_pose"
    assert reason(chosen, 2) == "bad_pose_file"
    with pytest.raises(SourceError, match="holds no usable pose"):
        found.of([1, 2])


def reason(poses, i):
    with pytest.raises(FrameRefused) as refused:
        poses.at(i)
    return refused.value.reason


def test_poses_beyond_the_end_and_quaternions_of_no_length(tmp_path):
    (tmp_path / "p.txt").write_text("0 0 0 0 0 0 1\n1 0 0 0 0 0 0\n")
    found = read_poses(tmp_path / "p.txt")
    assert reason(found, 1) == "bad_pose_file"
    assert reason(found, 2) == reason(found, -1) == "no_pose"


@pytest.mark.parametrize("word", ["nan", "-inf"])
def test_poses_that_are_no_numbers_are_handed_on(tmp_path, word):
    (tmp_path / "p.txt").write_text(matrix_line(np.eye(4)) + f"{word} " * 16 + "\n")
    assert not np.isfinite(read_poses(tmp_path / "p.txt").at(1)).any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no form of poses"),
        ("\n# nothing\n", "no form of poses"),
        ("1 2 3\n", "3 numbers"),
        ("1 2 3 4\n1 2 3 4\n", "4 numbers"),
        ("1 2\n1 2 3 4 5 6 7 8\n", "2, 8 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\nx\n", "p.txt:2: "),
        ("0 0 0 0 0 0 0\n", "quaternion of length zero"),
    ],
)
def test_what_is_wrong_is_named_in_a_short_line(tmp_path, text, words):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(SourceError, match=words) as refused:
        read_poses(tmp_path / "p.txt")
    assert str(tmp_path / "p.txt") in str(refused.value)
    assert len(str(refused.value).replace(str(tmp_path), "")) <= 300


def test_files_and_folders_that_are_not_there(tmp_path):
    for path in (tmp_path / "none.txt", tmp_path / "none.npy", tmp_path / "none.json", tmp_path):
        with pytest.raises(SourceError, match=str(path)):
            read_poses(path)
    with pytest.raises(FrameRefused) as refused:
        read_pose(tmp_path / "1.txt")
    assert refused.value.reason == "no_pose"


@pytest.mark.parametrize(
    ("stamps", "numbers"), [("0 1 5", [0, 1, 5]), ("0.5 1 5", None), ("1305031102 1305031103", None)]
)
def test_whole_small_stamps_are_numbers_of_images(tmp_path, stamps, numbers):
    (tmp_path / "p.txt").write_text("".join(tum_line(stamp, np.eye(4)) for stamp in stamps.split()))
    assert image_numbers(read_poses(tmp_path / "p.txt")) == numbers


@pytest.mark.parametrize(("axes", "forward"), [("optical", (0, 0, 1)), ("opengl", (0, 0, -1)), ("ros", (1, 0, 0))])
@pytest.mark.parametrize("inverted", [False, True])
def test_axes_and_inversion(axes, forward, inverted):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), (1, 2, 3)
    found = in_optical_axes(np.linalg.inv(T) if inverted else T, axes, inverted)
    np.testing.assert_allclose(found[:3, 2], T[:3, :3] @ forward, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), 1)


def test_the_last_number_of_a_name_counts():
    assert sorted(["frame10.png", "frame9.png", "cam1_2.png", "x.png"], key=number_in) == [
        "x.png", "cam1_2.png", "frame9.png", "frame10.png",
    ]  # fmt: skip
