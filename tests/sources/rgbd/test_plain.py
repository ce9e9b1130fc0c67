# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_depth import K, camera_text, check, matrix_line, posed, render, tum_line, units, write

from stereovox.errors import SourceError
from stereovox.opening import open_images, open_source
from stereovox.sources.rgbd.plain import DepthAndPoses


def images(folder, name="depth/{}.png", numbers=range(4), per_metre=1000):
    for number, T in zip(numbers, posed(), strict=True):
        write(folder / name.format(number), units(render(T), per_metre))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    return folder


def test_scannet_as_sensreader_exports_it(tmp_path):
    numbers = [0, 20, 100, 40]
    folder = images(tmp_path, numbers=sorted(numbers))
    (folder / "camera-intrinsics.txt").unlink()
    lost = [np.full((4, 4), -np.inf)] * 2
    for number, T in zip([*sorted(numbers), 7, 1], [*posed(), *lost], strict=True):
        (folder / "pose").mkdir(exist_ok=True)
        np.savetxt(folder / f"pose/{number}.txt", T)
    for name, f in (("depth", K[0]), ("color", 1000.0)):
        (folder / "intrinsic").mkdir(exist_ok=True)
        matrix = np.eye(4)
        matrix[0, 0], matrix[1, 1], matrix[:2, 2] = f, K[1], K[2:]
        np.savetxt(folder / f"intrinsic/intrinsic_{name}.txt", matrix)
    source = open_source(folder)
    assert isinstance(source, DepthAndPoses)
    check(source, posed(), 1000)
    assert (source.unit.sure, source.notes) == (True, ())
    np.savetxt(folder / "pose/20.txt", lost[0])
    assert not np.isfinite(open_source(folder).frame(1).T_world_sensor).any()  # which the gate refuses


@pytest.mark.parametrize("per_metre", [1000, 5000, 256, 4000, 10000])
def test_the_unit_is_found_by_the_images(tmp_path, per_metre):
    folder = images(tmp_path, per_metre=per_metre)
    (folder / "poses.txt").write_text("".join(map(matrix_line, posed())))
    source = open_source(folder)
    check(source, posed(), per_metre)
    assert source.unit.sure
    assert bool(source.notes) == (per_metre != 1000)


FORMS = {
    "poses.txt": "".join(matrix_line(T, 3) for T in posed()),
    "trajectory.txt": "".join(tum_line(k, T) for k, T in enumerate(posed())),
    "my_poses.txt": "".join(tum_line("", T) for T in posed()),
    "traj.txt": "".join(tum_line(1e9 + k, T) for k, T in enumerate(posed())),
    "pose.txt": "\n\n".join("\n".join(map(str, T)).replace("[", " ").replace("]", " ") for T in posed()),
}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("place", ["depth/{}.png", "depth_{}.png", "depths/frame{}.depth.png", "results/depth{}.png"])
def test_one_file_of_poses_in_any_form(tmp_path, name, place):
    folder = images(tmp_path, place)
    (folder / name).write_text(FORMS[name])
    check(open_source(folder), posed(), 1000)


def test_poses_by_number_may_leave_out_images(tmp_path):
    folder = images(tmp_path)
    (folder / "poses.txt").write_text("".join(tum_line(k, T) for k, T in enumerate(posed()) if k != 2))
    check(open_source(folder), posed(), 1000, missing=[2])


def test_counted_from_one_they_are_in_order(tmp_path):
    folder = images(tmp_path)
    (folder / "poses.txt").write_text("".join(tum_line(k + 1, T) for k, T in enumerate(posed())))
    check(open_source(folder), posed(), 1000)


def test_a_file_for_each_beside_the_images(tmp_path):
    folder = images(tmp_path, "{:06d}-depth.png")
    for k, T in enumerate(posed()):
        np.savetxt(folder / f"{k:06d}-pose.txt", T)
    check(open_source(folder), posed(), 1000)


def test_too_few_poses_are_named(tmp_path):
    folder = images(tmp_path)
    (folder / "poses.txt").write_text("".join(map(matrix_line, posed(3))))
    with pytest.raises(SourceError, match="3 poses for 4 images"):
        open_source(folder)


def test_a_file_that_is_none_of_poses_does_not_hide_the_right_one(tmp_path):
    folder = images(tmp_path)
    (folder / "poses.txt").write_text("see trajectory.txt\n")
    (folder / "trajectory.txt").write_text("".join(map(matrix_line, posed())))
    source = open_source(folder)
    check(source, posed(), 1000)
    assert "trajectory.txt" in source.notes[0]


def test_without_a_camera_the_cure_is_named(tmp_path):
    folder = images(tmp_path)
    (folder / "poses.txt").write_text("".join(map(matrix_line, posed())))
    (folder / "camera-intrinsics.txt").unlink()
    with pytest.raises(SourceError, match=r"\?camera=FILE"):
        open_source(folder)
    (tmp_path / "mine.txt").write_text(" ".join(map(str, K)))
    check(open_source(f"{folder}?camera=mine.txt"), posed(), 1000)


def test_images_alone(tmp_path):
    folder = images(tmp_path, "depth_{}.png")
    frames = list(open_images(folder))
    assert [frame.fault for frame in frames] == [None] * 4
    assert np.isnan(frames[0].T_world_sensor).all()
