# SPDX-License-Identifier: Apache-2.0
"""Mounts and clocks of several cameras, and the file that gives them."""

import numpy as np
import pytest

from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.errors import SourceError, StereovoxError
from stereovox.live.rig import LiveCamera, check_cameras, mount_of, read_live

GOOD = """
poses = "udp://:5005?axes=ned"

[[camera]]
name = "front"
source = "realsense:0123"
mount = [0.1, 0, 0.05, 0, 0, 0]

[[camera]]
source = "log"
clock_offset_s = -0.25
T_body_camera = [[0, 0, -1, -0.1], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]
"""


@pytest.mark.parametrize(
    ("mount", "looks", "right"),
    [
        ([0, 0, 0, 0, 0, 0], (1, 0, 0), (0, -1, 0)),
        ([0, 0, 0, 0, 0, 90], (0, 1, 0), (1, 0, 0)),
        ([0, 0, 0, 0, 90, 0], (0, 0, -1), (0, -1, 0)),
        ([0, 0, 0, 90, 0, 0], (1, 0, 0), (0, 0, -1)),
        ([0, 0, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)], (0, 1, 0), (1, 0, 0)),
    ],
)
def test_where_a_mounted_camera_looks(mount, looks, right):
    T = mount_of(mount)
    np.testing.assert_allclose(T[:3, 2], looks, atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], right, atol=1e-12)


def test_roll_comes_first_then_pitch_then_yaw():
    T = mount_of([1, 2, 3, 0, 30, 90])
    half = np.sqrt(3) / 2
    np.testing.assert_allclose(T[:3, 2], [0, half, -0.5], atol=1e-12)  # to the left, 30 degrees down
    np.testing.assert_array_equal(T[:3, 3], [1, 2, 3])


@pytest.mark.parametrize(
    "bad", [[1, 2, 3], "x", [0, 0, 0, 0, 0, np.nan], [0] * 7, [1e9, 0, 0, 0, 0, 0], None, [[1] * 6]]
)
def test_other_mounts_are_refused(bad):
    with pytest.raises(StereovoxError, match="a mount"):
        mount_of(bad)


@pytest.mark.parametrize("bad", ["x", None, [[1, 2], [3]], np.full((4, 4), np.nan), np.diag([1, 1, -1, 1])])
def test_other_matrices_are_refused(bad):
    with pytest.raises(SourceError, match="T_body_camera must be four rows of four numbers"):
        LiveCamera("sim:room", "a", bad)


def test_a_file_of_two_cameras(tmp_path):
    (tmp_path / "log").mkdir()
    (tmp_path / "live.toml").write_text(GOOD)
    setup = read_live(tmp_path / "live.toml")
    front, back = setup.cameras
    assert setup.poses == "udp://:5005?axes=ned"
    assert (front.title, front.source, front.clock_offset_s) == ("front", "realsense:0123", 0.0)
    np.testing.assert_array_equal(front.T_body_camera[:3, 3], [0.1, 0, 0.05])
    np.testing.assert_array_equal(front.T_body_camera[:3, :3], T_BODY_OPTICAL[:3, :3])
    assert (back.title, back.clock_offset_s) == (str(tmp_path / "log"), -0.25)
    np.testing.assert_array_equal(back.T_body_camera[:3, 2], [-1, 0, 0])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no camera; write one table"),
        ("[camera]\nsource = 'a'", "holds no camera"),
        ("[[camera]]\nname = 'a'", "camera 1: source is missing"),
        ("[[camera]]\nsource = 3", "camera 1: source = 3 must be a text"),
        ("[[camera]]\nsource = 'a'\nmonut = [0]", "camera 1: unknown key 'monut'.*did you mean 'mount'"),
        ("[[camera]]\nsource = 'a'\nmount = [0]", "camera 1: a mount is x, y, z"),
        ("[[camera]]\nsource = 'a'\nclock_offset_s = 'x'", "camera 1: a: clock_offset_s = 'x' must be seconds"),
        ("[[camera]]\nsource = 'a'\nT_body_camera = [[1]]", "camera 1: a: T_body_camera must be four rows"),
        (
            "[[camera]]\nsource = 'a'\nmount = [0, 0, 0, 0, 0, 0]\nT_body_camera = [[1]]",
            "camera 1: has mount and T_body_camera; keep one",
        ),
        ("[[camera]]\nsource = 'a'\n[[camera]]\nsource = 'a'", "two cameras have one name"),
        ("pose = 'track'", "unknown key 'pose'.*did you mean 'poses'"),
        ("[[camera", "correct it"),
    ],
)
def test_mistakes_name_file_camera_and_key(text, message, tmp_path):
    (tmp_path / "live.toml").write_text(text)
    with pytest.raises(SourceError, match=message) as found:
        read_live(tmp_path / "live.toml")
    assert str(found.value).startswith(str(tmp_path / "live.toml"))


def test_there_are_not_too_many_cameras():
    with pytest.raises(SourceError, match="17 cameras; give 1 to 16"):
        check_cameras([LiveCamera(str(k)) for k in range(17)])
