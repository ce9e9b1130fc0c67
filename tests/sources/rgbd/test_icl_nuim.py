# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import numpy as np
import pytest
from made_depth import VGA, check, left_handed, posed, render, tum_line, units, write

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.rgbd.depth_unit import difference, pairs_of
from stereovox.sources.rgbd.layouts.icl_nuim import INTRINSICS, IclNuim, IclNuimScene
from stereovox.sources.rgbd.layouts.tum import TumRgbd


def icl(folder, poses="livingRoom2.gt.freiburg", places=None):
    """Images at T_world_camera (4, 4); the data set has no pose for image 0."""
    places = posed() if places is None else places
    count = len(places)
    for k, T in enumerate(places):
        write(folder / f"depth/{k}.png", units(render(T, INTRINSICS, VGA), 5000))
    (folder / "associations.txt").write_text("".join(f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in range(count)))
    (folder / poses).write_text("".join(tum_line(k, left_handed(T)) for k, T in enumerate(places) if k))
    return folder


@pytest.mark.parametrize("poses", ["livingRoom2.gt.freiburg", "groundtruth.txt"])
def test_the_left_handed_camera_is_turned_right(tmp_path, poses):
    source = open_source(icl(tmp_path / "kt2", poses))
    assert isinstance(source, IclNuim)
    check(source, posed(), 5000, INTRINSICS, missing=[0])
    assert source.unit.sure, source.unit
    (note,) = source.notes
    assert "481.2 -480 319.5 239.5" in note


@pytest.mark.parametrize("fy", [480, -480])
def test_a_file_of_the_camera_does_not_turn_it_again(tmp_path, fy):
    folder = icl(tmp_path)
    (folder / "camera-intrinsics.txt").write_text(f"481.2 {fy} 319.5 239.5")
    check(open_source(folder), posed(), 5000, INTRINSICS, missing=[0])


def test_walls_do_not_stand_twice_and_would_with_the_poses_as_they_are(tmp_path):
    """The share of points of one image that lie where the next has a surface: all that it sees, or few."""
    source = open_source(icl(tmp_path))
    folder = tmp_path / "wrong"
    folder.mkdir()
    (folder / "depth").symlink_to(tmp_path / "depth")
    (folder / "groundtruth.txt").write_text((tmp_path / "livingRoom2.gt.freiburg").read_text())
    (folder / "camera-intrinsics.txt").write_text("481.2 480 319.5 239.5")
    wrong = open_source(folder)
    assert isinstance(wrong, TumRgbd)
    assert agreeing(source) > 0.95 * seen_twice(source)
    assert agreeing(wrong) < 0.9 * seen_twice(wrong)


def agreeing(source):
    return sum(np.sum(differences < 0.03) for differences, _ in compared(source))


def seen_twice(source):
    return sum(len(differences) for differences, _ in compared(source))


def compared(source):
    for first, second in pairs_of(len(source), source.pose, source.read):
        T = inverse(second.T_world_camera) @ first.T_world_camera
        yield difference(first.depth, second.depth, source.camera, T, source.depth_scale)


def test_a_camera_that_is_turned_over_does_not_fit_where_it_nods(tmp_path):
    folder = icl(tmp_path, "groundtruth.txt", [T @ turned_down(0.15 * k) for k, T in enumerate(posed())])
    assert open_source(folder).unit.sure
    (folder / "camera-intrinsics.txt").write_text("481.2 480 319.5 239.5")
    wrong = open_source(folder)
    assert not wrong.unit.sure
    assert any("poses do not fit the images" in note for note in wrong.notes)


def turned_down(angle):
    T = np.eye(4)
    T[1:3, 1:3] = [[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]
    return T


def test_depth_along_the_rays_and_povray_cameras(tmp_path):
    fx, fy, cx, cy = INTRINSICS
    v, u = np.mgrid[:480, :640]
    longer = np.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2)
    for k, T in enumerate(posed(3)):
        np.savetxt(tmp_path / f"scene_00_{k:04d}.depth", render(T, INTRINSICS, VGA) * longer, "%.6f", newline=" ")
        left = left_handed(T)
        lines = [
            ("cam_pos", left[:3, 3]),
            ("cam_dir", 2 * left[:3, 2]),
            ("cam_up", left[:3, 1]),
            ("cam_sky", [0, 1, 0]),
        ]
        text = "".join(f"{key} = [{', '.join(map(str, vector))}]';\n" for key, vector in lines)
        (tmp_path / f"scene_00_{k:04d}.txt").write_text(text)
    source = open_source(tmp_path)
    assert isinstance(source, IclNuimScene)
    check(source, posed(3), 1e5, INTRINSICS)
    (tmp_path / "scene_00_0000.txt").write_text("cam_pos = [1, 2]';")
    (tmp_path / "scene_00_0001.depth").write_text("1 2 3")
    (tmp_path / "scene_00_0002.txt").unlink()
    faults = [frame.fault for frame in IclNuimScene(tmp_path)]
    assert faults == ["bad_pose_file", "unreadable", "no_pose"]


def test_only_images_without_poses_by_number_are_named_in_one_line(tmp_path):
    folder = icl(tmp_path)
    (folder / "livingRoom2.gt.freiburg").unlink()
    with pytest.raises(SourceError, match=r"has depth images .* but no poses; ") as refused:
        open_source(folder)
    assert len(str(refused.value)) <= 300 + len(str(folder))
