# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from made_recordings import SIZE, depth_image, png_bytes, write_png

from stereovox.errors import FrameRefused
from stereovox.sources.photos import PICTURE_KINDS, common_size, png_size, read_picture_png
from stereovox.sources.rgbd.depth_files import read_depth


@pytest.fixture
def good(tmp_path):
    path = tmp_path / "good.png"
    write_png(path, depth_image(3))
    return path


def refusal(path, size=SIZE):
    with pytest.raises(FrameRefused) as caught:
        read_depth(path, size)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    return caught.value.reason


def test_a_good_image_comes_back_value_by_value(good):
    image = read_depth(good, SIZE)
    assert image.dtype == np.uint16
    np.testing.assert_array_equal(image, depth_image(3))
    assert png_size(good) == SIZE


@pytest.mark.parametrize("keep", [0, 7, 20, 33, 45, -13, -12, -1])
def test_an_image_cut_off_anywhere_is_refused(good, keep, capfd):
    good.write_bytes(good.read_bytes()[:keep])
    assert refusal(good) == "unreadable"
    assert capfd.readouterr() == ("", "")


def test_any_flipped_byte_is_refused_and_the_terminal_stays_clean(good, capfd):
    whole = good.read_bytes()
    for at in range(len(whole)):
        good.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        assert refusal(good) == "unreadable"
    assert capfd.readouterr() == ("", "")


def test_bytes_after_the_end_mark_do_no_harm(good):
    good.write_bytes(good.read_bytes() + b"rest")
    np.testing.assert_array_equal(read_depth(good, SIZE), depth_image(3))


def test_a_file_of_more_bytes_than_an_image_needs_is_not_read(good):
    os.truncate(good, 300 << 20)  # a hole in the disk, and else 300 MB of memory
    assert refusal(good) == "unreadable"
    assert png_size(good) == SIZE


def test_a_missing_file_and_a_folder_are_missing(tmp_path):
    assert refusal(tmp_path / "none.png") == "missing_file"
    assert refusal(tmp_path) == "missing_file"
    assert refusal(tmp_path / ("x" * 5000)) == "missing_file"


@pytest.mark.parametrize("content", [b"", b"depth", b"\xff\xd8\xff\xe0JFIF" * 20])
def test_what_is_no_png_is_unreadable(tmp_path, content):
    path = tmp_path / "no.png"
    path.write_bytes(content)
    assert refusal(path) == "unreadable"


@pytest.mark.parametrize(
    "image", [np.ones((12, 16), np.uint8), np.ones((12, 16, 3), np.uint16), np.ones((12, 16, 4), np.uint8)]
)
def test_other_pixel_types_are_refused(tmp_path, image):
    path = tmp_path / "type.png"
    write_png(path, image)
    assert refusal(path) == "bad_dtype"


def test_another_size_is_refused_before_decoding(good, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    assert refusal(good, (SIZE[0] + 1, SIZE[1])) == "bad_shape"


@pytest.mark.parametrize("size", [(60_000, 60_000), (2**31 - 1, 2**31 - 1), (0, 12), (16, 0)])
def test_a_header_with_an_absurd_size_is_refused_before_decoding(tmp_path, size, monkeypatch):
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    path = tmp_path / "lie.png"
    path.write_bytes(png_bytes(*size, rows=b"\0"))
    assert refusal(path, size) == "unreadable"


def test_too_few_rows_under_right_check_sums_are_refused(tmp_path):
    path = tmp_path / "short.png"
    path.write_bytes(png_bytes(*SIZE, rows=b"\0\1"))
    assert refusal(path) == "unreadable"


def test_the_common_size_is_that_of_most_readable_images(tmp_path):
    paths = [tmp_path / f"{n}.png" for n in range(6)]
    assert common_size(paths) is None
    paths[0].write_bytes(b"broken")
    write_png(paths[1], depth_image(0, (20, 10)))
    for path in paths[2:5]:
        write_png(path, depth_image(0))
    assert common_size(paths) == SIZE


def test_pictures_come_back_value_by_value_in_grey_or_rgb(tmp_path):
    path = tmp_path / "p.png"
    grey = np.arange(SIZE[0] * SIZE[1], dtype=np.uint8).reshape(SIZE[1], SIZE[0])
    write_png(path, grey)
    np.testing.assert_array_equal(read_picture_png(path, SIZE), grey)
    rgb = np.stack([grey, grey[::-1], 255 - grey], axis=2)
    write_png(path, rgb[..., ::-1])  # OpenCV writes BGR
    found = read_picture_png(path, SIZE)
    np.testing.assert_array_equal(found, rgb)
    assert found.dtype == np.uint8
    assert png_size(path, PICTURE_KINDS) == SIZE
    assert common_size([path], kinds=PICTURE_KINDS) == SIZE


def test_a_picture_is_no_depth_and_depth_no_picture(tmp_path, good):
    path = tmp_path / "p.png"
    write_png(path, np.ones((SIZE[1], SIZE[0]), np.uint8))
    assert refusal(path) == "bad_dtype"
    with pytest.raises(FrameRefused, match="16-bit grey image; pictures must be 8-bit grey or RGB"):
        read_picture_png(good, SIZE)
    write_png(path, np.ones((SIZE[1], SIZE[0], 4), np.uint8))
    with pytest.raises(FrameRefused, match="8-bit colour image"):
        read_picture_png(path, SIZE)


def test_a_picture_that_is_cut_off_is_refused(tmp_path):
    path = tmp_path / "p.png"
    write_png(path, np.random.default_rng(0).integers(0, 256, (SIZE[1], SIZE[0], 3), np.uint8))
    path.write_bytes(path.read_bytes()[:-15])
    with pytest.raises(FrameRefused, match="cut off or damaged"):
        read_picture_png(path, SIZE)
