# SPDX-License-Identifier: Apache-2.0
"""Recorded rigs: all pairs in order of time, with the poses of their cameras."""

import numpy as np
import pytest
from made_recordings import write_png
from made_rigs import CAMERA, FORWARD, picture, poses_text, recorded, rig

from stereovox.depth.stereo.pipeline import rectified
from stereovox.errors import SourceError
from stereovox.frame import StereoFrame
from stereovox.opening import open_source
from stereovox.sources.rigs.rig_file import Rig, RigPair, write_rig


def test_frames_of_all_pairs_come_in_order_of_time(tmp_path):
    source = open_source(recorded(tmp_path))
    frames = list(source)
    assert all(isinstance(frame, StereoFrame) for frame in frames)
    order = [(frame.stamp_ns // 1_000_000, frame.pair.name) for frame in frames]
    assert order == [(100, "front"), (100, "side"), (150, "side"), (200, "front")]
    assert not any(frame.fault for frame in frames)
    np.testing.assert_array_equal(frames[3].left, picture(2, (32, 24)))
    np.testing.assert_array_equal(frames[3].right, picture(3, (32, 24)))
    assert frames[0].pair is frames[3].pair, "one and the same pair, so that its maps are made once"
    assert source.camera == CAMERA


def test_the_pose_is_that_of_the_rectified_left_eye(tmp_path):
    front, side, *_ = open_source(recorded(tmp_path))
    T = np.eye(4)
    T[:3, 3] = 0.1, 2, 3
    np.testing.assert_allclose(front.T_world_sensor, T @ FORWARD, atol=1e-9)
    np.testing.assert_allclose(side.T_world_sensor, T @ side.pair.T_body_camera, atol=1e-9)
    assert np.abs(side.pair.T_body_camera[:3, :3] - np.eye(3)).max() > 1e-3, "the eyes are toed in"
    assert rectified(side).left.shape == (40, 60)


def test_frames_that_cannot_be_used_have_a_fault(tmp_path):
    folder = recorded(tmp_path)
    (folder / "poses.txt").write_text(poses_text(50_000_000, 120_000_000))
    (folder / "front/right/100000000.png").unlink()
    write_png(folder / "side/left/100000000.png", picture(0, (30, 36)))
    frames = list(open_source(folder))
    assert [frame.fault for frame in frames] == ["missing_file", "bad_shape", "no_pose", "no_pose"]
    assert "100000000.png: 30x36 pixels, rig.toml has 48x36; correct width and height there" in frames[1].fault_detail
    assert "front/right/100000000.png" in frames[0].fault_detail
    assert "side/left/150000000.png" in frames[2].fault_detail
    assert frames[2].left.shape == (0, 0)
    assert np.isnan(frames[2].T_world_sensor).all()


def test_one_rectified_folder_with_an_index(tmp_path):
    write_rig(tmp_path / "rig.toml", Rig((RigPair(left="left", right="right", index="times.txt", camera=CAMERA),)))
    for name in ("b", "a"):
        write_png(tmp_path / "left" / f"{name}.png", picture(1, (32, 24)))
        write_png(tmp_path / "right" / f"{name}.png", picture(2, (32, 24)))
    (tmp_path / "times.txt").write_text("# stamp left right\n0.2 b.png\n0.1 a.png b.png\n")
    (tmp_path / "poses.txt").write_text(poses_text(100_000_000, 190_000_000, 200_000_000))
    frames = list(open_source(tmp_path))
    assert [frame.stamp_ns for frame in frames] == [100_000_000, 200_000_000]
    assert [frame.fault for frame in frames] == [None, None]
    assert frames[0].name.endswith("a.png")


def test_what_cannot_be_opened(tmp_path):
    folder = recorded(tmp_path / "rig")
    (folder / "front/left/noon.png").write_bytes(b"")
    with pytest.raises(SourceError, match="not a time in nanoseconds"):
        open_source(folder)
    (folder / "front/left/noon.png").unlink()
    (folder / "poses.txt").unlink()
    with pytest.raises(
        SourceError, match=r"poses\.txt: no such file of poses; write it, or set poses = in .*rig\.toml"
    ):
        open_source(folder)
    write_rig(folder / "rig.toml", Rig((RigPair("other", camera=CAMERA),)))
    with pytest.raises(SourceError, match="other"):
        open_source(folder)
    (folder / "empty").mkdir()
    write_rig(folder / "rig.toml", Rig((RigPair("front", right="fornt", camera=CAMERA),)))
    with pytest.raises(SourceError, match=r"fornt: no such folder; put the right images .* right = in .*rig\.toml"):
        open_source(folder)
    write_rig(folder / "rig.toml", Rig((RigPair("e", left="empty", right="empty", camera=CAMERA),)))
    with pytest.raises(SourceError, match="holds no PNG"):
        open_source(folder)
    write_rig(folder / "rig.toml", Rig((RigPair("front", camera=CAMERA, mask="no.png"), rig().pairs[1])))
    with pytest.raises(SourceError, match=r"rig\.toml: pair 'front'.*no\.png"):
        open_source(folder)
    (folder / "list.txt").write_text("0.1 a b c\n")
    write_rig(folder / "rig.toml", Rig((RigPair("front", index="list.txt", camera=CAMERA),)))
    with pytest.raises(SourceError, match=r"list\.txt:1: needs"):
        open_source(folder)


def test_numbers_are_no_times(tmp_path):
    write_rig(tmp_path / "rig.toml", Rig((RigPair(left="left", right="right", camera=CAMERA),)))
    (tmp_path / "poses.txt").write_text(poses_text(0, 10_000_000))
    for side in ("left", "right"):
        write_png(tmp_path / side / "0000000007.png", picture(1, (32, 24)))
    assert len(open_source(tmp_path)) == 1, "one image may be taken at any time"
    write_png(tmp_path / "left" / "0000000008.png", picture(1, (32, 24)))
    with pytest.raises(
        SourceError, match=r"left: .*millisecond .*; name them by time in ns, give an index file, or add .fps="
    ) as caught:
        open_source(tmp_path)
    assert "\n" not in str(caught.value)
    (tmp_path / "left" / "0000000008.png").rename(tmp_path / "left" / "0001000007.png")
    assert [frame.stamp_ns for frame in open_source(tmp_path)] == [7, 1_000_007]


def numbered(folder):
    """Three images named by numbers, and their pair."""
    write_rig(folder / "rig.toml", Rig((RigPair(left="left", right="right", camera=CAMERA, T_body_left=FORWARD),)))
    for name in ("0007", "0008", "0010"):
        write_png(folder / "left" / f"{name}.png", picture(1, (32, 24)))
        write_png(folder / "right" / f"{name}.png", picture(2, (32, 24)))
    return folder


def test_numbered_images_have_times_by_fps_and_poses_of_any_form(tmp_path):
    folder = numbered(tmp_path)
    T = [np.eye(4) for _ in range(3)]
    for i in range(3):
        T[i][:3, 3] = i, 2, 3
    (folder / "kitti.txt").write_text("".join(" ".join(f"{n:g}" for n in one[:3].ravel()) + "\n" for one in T))
    text = "".join(
        f"{i} {i} {i + 1}\n" + "\n".join(" ".join(map(str, row)) for row in one) + "\n" for i, one in enumerate(T)
    )
    (folder / "trajectory.log").write_text(text)
    for name in ("kitti.txt", "trajectory.log"):
        frames = list(open_source(f"{folder}?fps=20&poses={name}"))
        assert [frame.stamp_ns for frame in frames] == [350_000_000, 400_000_000, 500_000_000]
        for frame, one in zip(frames, T, strict=True):
            np.testing.assert_allclose(frame.T_world_sensor, one @ FORWARD, atol=1e-9)
    eye = open_source(f"{folder}?fps=20&poses=kitti.txt&axes=opengl").frame(1)
    np.testing.assert_allclose(eye.T_world_sensor, T[1] @ np.diag([1.0, -1, -1, 1]), atol=1e-9)
    inverted = open_source(f"{folder}?fps=20&poses=kitti.txt&axes=optical&invert=1").frame(1)
    np.testing.assert_allclose(inverted.T_world_sensor[:3, 3], [-1, -2, -3], atol=1e-9)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("fps=-2", "fps=-2 must be positive"),
        ("axes=opengel", "axes=opengel is unknown.*opengl"),
        ("fps=10&poses=none.txt", "none.txt: no such file, nor in"),
        ("fps=10&poses=two.txt", "two.txt: holds 2 poses for 3 images; give one for each"),
        ("fps=10&poses=late.txt", "late.txt: poses from 9.* to 9.*, images from 0.7.*: no time in common"),
        ("speed=10", "unknown parameter 'speed'"),
    ],
)
def test_options_that_cannot_be_used(tmp_path, options, said):
    folder = numbered(tmp_path)
    (folder / "two.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 2)
    (folder / "late.txt").write_text("900 1 2 3 0 0 0 1\n901 1 2 3 0 0 0 1\n")
    with pytest.raises(SourceError, match=said) as caught:
        open_source(f"{folder}?{options}")
    assert len(str(caught.value).replace(str(tmp_path), "")) < 250


def test_images_of_both_eyes_without_a_rig_file(tmp_path):
    (numbered(tmp_path) / "rig.toml").unlink()
    with pytest.raises(
        SourceError, match=r"has left images \(3\), right images \(3\) but no rig.toml; write it with: "
    ):
        open_source(tmp_path)
