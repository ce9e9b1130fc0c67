# SPDX-License-Identifier: Apache-2.0
"""Stereo calibration: rendered boards give back the lenses that rendered them; real ones agree within half a pixel."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_boards import BOARD, fisheye_eyes, pinhole_eyes, poses, seen, write_boards

from stereovox.calibrate.stereo import (
    Board,
    BoardPair,
    calibrate_stereo,
    check_model,
    epipolar_errors,
    field_of_view,
    find_corners,
    image_pairs,
    read_boards,
    same_order,
    unmatched,
)
from stereovox.calibrate.stereo_fit import fit_stereo
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import inverse, rotation_vector, transform_points
from stereovox.view.report.calibration import write_stereo_report

REAL = Path(__file__).resolve().parents[3] / "shared/data/chessboard_stereo"


def exact(eyes, boards, noise=0.0):
    """Corners as the lenses see them, without images."""
    rng = np.random.default_rng(4)
    pairs = []
    for k, T in enumerate(boards):
        left = eyes.left.project(transform_points(T, BOARD.points()))
        right = eyes.right.project(transform_points(inverse(eyes.T_left_right) @ T, BOARD.points()))
        assert np.isfinite(left).all()
        assert np.isfinite(right).all()
        left, right = (corners + noise * rng.normal(size=corners.shape) for corners in (left, right))
        pairs.append(BoardPair(f"pair{k}", Path("l"), Path("r"), left, right, (320, 240)))
    return pairs


def apart(found, true):
    """Metres and radians between two places of the right eye."""
    T = inverse(true.T_left_right) @ found.T_left_right
    return np.linalg.norm(T[:3, 3]), np.linalg.norm(rotation_vector(T[:3, :3]))


def largest_miss(found, true):
    """Pixels by which two lenses differ where the boards were."""
    v, u = np.mgrid[20:220:9j, 20:300:11j]
    rays = true.directions(np.column_stack([u.ravel(), v.ravel()]))
    return np.abs(found.project(rays) - true.project(rays)).max()


@pytest.mark.parametrize(("eyes", "near", "spread"), [(pinhole_eyes(), 0.45, 0.25), (fisheye_eyes(), 0.22, 0.8)])
def test_exact_corners_give_back_the_lenses(eyes, near, spread):
    pairs = exact(eyes, poses(near, spread))
    left, right = [pair.left for pair in pairs], [pair.right for pair in pairs]
    fit = fit_stereo(eyes.left.model, (320, 240), BOARD.points(), left, right)
    assert max(apart(fit.eyes, eyes)) < 1e-4
    assert largest_miss(fit.eyes.left, eyes.left) < 0.01
    assert largest_miss(fit.eyes.right, eyes.right) < 0.01
    for found, true in zip(fit.T_left_board, poses(near, spread), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-4)


def test_rendered_boards_give_back_pinhole_lenses(tmp_path):
    eyes = pinhole_eyes()
    found = calibrate_stereo(read_boards(write_boards(tmp_path / "b", eyes, poses(0.5, 0.16)), BOARD), BOARD)
    told = found.as_dict()
    assert told["used"] == 6
    assert told["rms_px"] < 0.2
    assert told["epipolar_px"] < 0.2
    assert told["unseen_px"] < 0.25
    metres, radians = apart(found.eyes, eyes)
    assert metres < 1e-3
    assert np.degrees(radians) < 0.3
    assert told["baseline_m"] == pytest.approx(eyes.baseline, rel=0.01)
    assert largest_miss(found.eyes.left, eyes.left) < 1.5
    for lens, fields in zip((eyes.left, eyes.right), told["field_of_view_deg"], strict=True):
        np.testing.assert_allclose(fields, field_of_view(lens), rtol=0.03)
    page = write_stereo_report(tmp_path / "r", found, "rig.toml").read_text()
    assert f"{told['rms_px']:.3f} px" in page
    assert "data:image/png;base64," in page
    assert cv2.imread(str(tmp_path / "r/stereo.png")).std() > 10


def test_rendered_boards_give_back_fisheyes(tmp_path):
    eyes = fisheye_eyes()
    pairs = read_boards(write_boards(tmp_path, eyes, poses(0.24, 0.7)), BOARD)
    found = calibrate_stereo(pairs, BOARD, "fisheye")
    assert len(found.used) == 6
    assert found.overall("rms_px") < 0.25
    assert found.overall("epipolar_px") < 0.25
    metres, radians = apart(found.eyes, eyes)
    assert metres < 2e-3
    assert np.degrees(radians) < 0.5
    assert found.eyes.left.fx == pytest.approx(115, rel=0.02)


def test_a_pair_that_does_not_belong_is_named_and_dropped():
    eyes = pinhole_eyes()
    pairs = exact(eyes, poses(0.45, 0.25), noise=0.05)
    pairs[3].right = pairs[3].right + np.linspace(0, 6, 35)[:, None]
    blind = BoardPair("blind", Path("l"), Path("r"), why="no board")
    found = calibrate_stereo([*pairs, blind], BOARD)
    assert [pair.name for pair in found.pairs if pair.why] == ["pair3", "blind"]
    assert "px RMS" in pairs[3].why
    assert max(apart(found.eyes, eyes)) < 3e-3
    assert found.overall("rms_px") < 0.1
    told = {pair["name"]: pair for pair in found.as_dict()["pairs"]}
    assert told["pair3"]["used"] is False
    assert told["blind"]["rms_px"] is None


def test_the_epipolar_error_is_what_was_put_in():
    eyes = pinhole_eyes()
    pair = exact(eyes, poses(0.45, 0.1))[0]
    assert np.abs(epipolar_errors(eyes, pair.left, pair.right)).max() < 1e-7
    assert np.abs(epipolar_errors(eyes, pair.left + np.array([0, 0.5]), pair.right)).mean() == pytest.approx(
        0.5, rel=0.1
    )


def test_corners_are_found_in_the_order_of_the_board():
    lens, T = pinhole_eyes().left, poses(0.5, 0.16)[1]
    true = lens.project(transform_points(T, BOARD.points()))
    found = find_corners(seen(lens, T), BOARD)
    found = same_order(found, true)
    assert np.abs(found - true).max() < 0.5
    assert np.abs(found - true).mean() < 0.15
    np.testing.assert_array_equal(same_order(found[::-1], true), found)
    assert find_corners(np.full((60, 80), 200, np.uint8), BOARD) is None


@pytest.mark.parametrize(
    ("left", "right", "name"),
    [
        ("left01.png", "right01.png", "01"),
        ("imageL0.png", "imageR0.png", "image0"),
        ("cam_l_7.jpg", "cam_r_7.jpg", "cam__7"),
        ("Left-3.bmp", "Right-3.bmp", "-3"),
        ("left/a.png", "right/a.png", "a"),
    ],
)
def test_files_that_belong_together(tmp_path, left, right, name):
    for file in (left, right):
        (tmp_path / file).parent.mkdir(exist_ok=True)
        (tmp_path / file).touch()
    assert image_pairs(tmp_path) == [(name, tmp_path / left, tmp_path / right)]


def test_images_without_a_partner_are_named(tmp_path):
    for name in ("left01.png", "right01.png", "left02.png", "right10.png", "notes.txt", "board.png"):
        (tmp_path / name).touch()
    assert unmatched(tmp_path) == ["left02.png", "right10.png"]


def test_images_that_cannot_be_used_say_why(tmp_path):
    blank = np.full((60, 80), 200, np.uint8)
    for name in ("left0", "right0", "left2", "right2"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), blank)
    cv2.imwrite(str(tmp_path / "right2.png"), blank[:50])
    for name in ("left1", "right1"):
        (tmp_path / f"{name}.png").write_bytes(b"no picture")
    pairs = read_boards(tmp_path, BOARD)
    assert [pair.why for pair in pairs] == [
        "no board of 7x5 inner corners in left0.png and right0.png",
        "left1.png cannot be read as an image",
        "left 80x60 pixels, right 80x50",
    ]
    with pytest.raises(StereovoxError, match=r"only 0 pairs .*left1\.png cannot be read") as caught:
        calibrate_stereo(pairs, BOARD)
    assert "\n" not in str(caught.value)


def test_mistakes_of_a_user(tmp_path):
    with pytest.raises(StereovoxError, match="no such folder"):
        image_pairs(tmp_path / "no")
    with pytest.raises(StereovoxError, match="holds no pair"):
        image_pairs(tmp_path)
    with pytest.raises(StereovoxError, match="count inner corners"):
        Board(2, 9, 0.1)
    with pytest.raises(StereovoxError, match="--lens omni"):
        check_model("omni")


@pytest.mark.skipif(not REAL.is_dir(), reason="needs ../shared/data/chessboard_stereo")
def test_the_real_pairs_agree_within_half_a_pixel():
    board = Board(9, 6, 0.025)
    told = calibrate_stereo(read_boards(REAL, board), board).as_dict()
    assert told["used"] == 6
    assert told["rms_px"] < 0.2
    assert told["epipolar_px"] < 0.2
    assert told["unseen_px"] < 0.4
