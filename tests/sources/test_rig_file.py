# SPDX-License-Identifier: Apache-2.0
"""Rig files: written and read back, masks, and one line for each mistake."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from made_recordings import write_png
from made_rigs import CAMERA, FORWARD, cylinder, eyes, rig

from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.errors import SourceError
from stereovox.sources.rigs.rig_file import Rig, RigPair, Virtual, read_rig, write_rig

MINIMAL = """
[[pair]]
[pair.camera]
width = 32
height = 24
fx = 30.0
fy = 30.5
cx = 15.5
cy = 11.5
baseline = 0.1
"""
EYED = """
[[pair]]
name = "front"
T_left_right = [[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
[pair.left_lens]
model = "pinhole"
width = 64
height = 48
fx = 50.0
fy = 50.0
cx = 31.5
cy = 23.5
[pair.right_lens]
model = "pinhole"
width = 64
height = 48
fx = 50.0
fy = 50.0
cx = 31.5
cy = 23.5
distortion = [-0.1, 0.01, 0.0, 0.0]
"""


def same(a, b):
    assert (a.name, a.left, a.right, a.index, a.mask) == (b.name, b.left, b.right, b.index, b.mask)
    assert (a.camera, a.virtual, a.mask_rectangles) == (b.camera, b.virtual, b.mask_rectangles)
    np.testing.assert_allclose(a.T_body_left, b.T_body_left, atol=1e-12)
    assert (a.eyes is None) == (b.eyes is None)
    if a.eyes and b.eyes:
        assert (a.eyes.left, a.eyes.right) == (b.eyes.left, b.eyes.right)
        np.testing.assert_allclose(a.eyes.T_left_right, b.eyes.T_left_right, atol=1e-12)


def test_a_rig_comes_back_as_it_was_written(tmp_path):
    written = Rig(
        (
            *rig().pairs,
            RigPair("round", "a b/l", "a b/r", "list.txt", cylinder(), mask="m.png", mask_rectangles=((1, 2, 3, 4),)),
            RigPair("plain", eyes=eyes(), T_body_left=FORWARD, virtual=Virtual("cylindrical", hfov_deg=120)),
        ),
        poses="path/to poses.txt",
    )
    write_rig(tmp_path / "rig.toml", written, ("made by a test", "twice"))
    read = read_rig(tmp_path / "rig.toml")
    assert read.poses == written.poses
    assert len(read.pairs) == 4
    for a, b in zip(read.pairs, written.pairs, strict=True):
        same(a, b)
    assert (tmp_path / "rig.toml").read_text().startswith("# made by a test\n# twice\n")


def test_a_lens_with_few_coefficients_is_written_with_zeros(tmp_path):
    few = [replace(lens, distortion=lens.distortion[:2]) for lens in (eyes().left, eyes().right)]
    write_rig(tmp_path / "rig.toml", Rig((RigPair("a", eyes=Eyes(*few, eyes().T_left_right)),)))
    left = read_rig(tmp_path / "rig.toml").pairs[0].eyes.left
    assert left.distortion == (*eyes().left.distortion[:2], 0, 0)


def test_little_is_needed(tmp_path):
    (tmp_path / "rig.toml").write_text(MINIMAL)
    read = read_rig(tmp_path / "rig.toml")
    assert read.poses == "poses.txt"
    (pair,) = read.stereo_pairs(tmp_path)
    assert pair.camera == CAMERA
    assert pair.eyes is None
    assert pair.valid is None
    np.testing.assert_array_equal(pair.T_body_camera, np.eye(4))


def test_eyes_become_a_pair_with_the_virtual_camera(tmp_path):
    (tmp_path / "rig.toml").write_text(EYED + "[pair.virtual]\nmodel = 'spherical'\nsize = [30, 20]\nhfov_deg = 60\n")
    (pair,) = read_rig(tmp_path / "rig.toml").stereo_pairs(tmp_path)
    expected = StereoPair.from_eyes(pair.eyes, "spherical", size=(30, 20), hfov_deg=60).camera
    assert asdict(pair.camera) == asdict(expected)
    assert pair.camera.baseline == pytest.approx(0.1)
    assert pair.eyes.right.distortion == (-0.1, 0.01, 0, 0)


def test_masks_are_rectangles_and_what_is_not_white(tmp_path):
    image = np.full((24, 32), 255, np.uint8)
    image[:5] = 0
    image[5] = 100
    write_png(tmp_path / "mask.png", image)
    masked = RigPair("a", camera=CAMERA, mask="mask.png", mask_rectangles=((2, 10, 6, 12), (31, 23, 32, 24)))
    expected = np.ones((24, 32), bool)
    expected[:6] = expected[10:12, 2:6] = expected[23, 31] = False
    np.testing.assert_array_equal(masked.stereo_pair(tmp_path).valid, expected)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "holds no pair"),
        ("[[pairs]]\n", "unknown key 'pairs' .did you mean 'pair'"),
        ("[[pair]]\n", r"pair 1 .'stereo'.: left_lens is missing"),
        (MINIMAL + MINIMAL, "two pairs have one name"),
        (MINIMAL.replace("fx = 30.0", "fx = 'x'"), "fx = 'x' must be a number"),
        (MINIMAL.replace("fx = 30.0", ""), "fx is missing"),
        (MINIMAL.replace("baseline = 0.1", ""), "baseline is missing"),
        (MINIMAL.replace("32", "32.5"), "width = 32.5 must be a whole number"),
        (MINIMAL + "model = 'sphere'", "did you mean 'spherical'"),
        (MINIMAL + "step_u = 1.0", "unknown key 'camera.step_u'"),
        (MINIMAL + "[pair.virtual]\n", "keep one"),
        (MINIMAL.replace("[pair.camera]", "mask_rectangles = [[1, 2, 3]]\n[pair.camera]"), "mask_rectangles"),
        (MINIMAL.replace("[pair.camera]", "T_body_left = [[1]]\n[pair.camera]"), "T_body_left must be four rows"),
        (EYED.replace("0.1],", "-0.1],"), "exchange the eyes"),
        (EYED.replace('"pinhole"', '"omni"'), "left_lens: lens: unknown model 'omni'"),
        (
            EYED.replace("-0.1, 0.01, 0.0", "-0.1, 0.01"),
            "right_lens: distortion must have 0, 4, 5 or 8 numbers .* not 3",
        ),
        (EYED + "k1 = 3", "unknown key 'right_lens.k1'"),
        (EYED + "[pair.virtual]\nsize = 3", r"virtual.size = 3 must be \[width, height\]"),
        ("[[pair]", "correct it"),
    ],
)
def test_each_mistake_is_one_line(tmp_path, text, said):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        read_rig(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("pair", "said"),
    [
        (RigPair("a", camera=CAMERA, mask="gone.png"), "no such file"),
        (RigPair("a", camera=CAMERA, mask="small.png"), "3x2 pixels"),
        (RigPair("a", camera=CAMERA, mask_rectangles=((0, 0, 33, 5),)), "mask rectangle"),
        (RigPair("a", eyes=eyes(), virtual=Virtual("sperical")), "did you mean 'spherical'"),
        (RigPair("a", eyes=eyes(), virtual=Virtual("spherical", hfov_deg=190.0)), "88"),
        (RigPair("a"), "neither"),
    ],
)
def test_what_makes_no_pair(tmp_path, pair, said):
    write_png(tmp_path / "small.png", np.zeros((2, 3), np.uint8))
    with pytest.raises(SourceError, match=said) as caught:
        pair.stereo_pair(tmp_path)
    assert str(caught.value).startswith("pair 'a': ")
    assert "\n" not in str(caught.value)


def test_a_folder_that_is_not_there_is_no_traceback(tmp_path):
    with pytest.raises(SourceError, match="cannot be written"):
        write_rig(tmp_path / "no" / "rig.toml", rig())
    with pytest.raises(SourceError, match="No such file"):
        read_rig(tmp_path / "rig.toml")


def test_the_file_in_the_documentation_is_one(tmp_path):
    page = (Path(__file__).resolve().parents[2] / "docs/rigs.md").read_text()
    (tmp_path / "rig.toml").write_text(page.split("```toml\n")[1].split("```")[0])
    (pair,) = read_rig(tmp_path / "rig.toml").stereo_pairs(tmp_path)
    assert (pair.camera.width, pair.camera.height) == (600, 480)
    assert pair.valid.mean() == pytest.approx(440 / 480)
