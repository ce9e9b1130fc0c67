# SPDX-License-Identifier: Apache-2.0
"""Pages and pictures of calibrations."""

from dataclasses import replace

import numpy as np
import pytest

from stereovox.calibrate.noise import NoiseAt, NoiseCalibration
from stereovox.calibrate.surface import read_wall
from stereovox.calibrate.wall import calibrate_wall
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import StereovoxError
from stereovox.frame import Frame
from stereovox.view.calibration import DPI, noise_png, wall_png
from stereovox.view.report import page
from stereovox.view.report.calibration import noise_page, wall_page, write_wall_report

CAMERA = PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.05)


def wall_calibration(model="auto"):
    bent = (1 + 0.1 * ((np.arange(80) - 39.5) / 39.5) ** 2) * np.ones((60, 1))
    walls = [read_wall([Frame(z * bent, CAMERA, np.eye(4))] * 3, "<b>office</b>", CAMERA, z) for z in (1.5, 3.0)]
    return calibrate_wall(walls, model)


def noise_calibration(subpixel=0.08):
    points = tuple(
        NoiseAt(f"wall {z}", z, 0.004 * z * z, temporal, fixed, None, 0.9, 0.8, 0.001, subpixel, 1000, 30)
        for z, temporal, fixed in ((1.0, 0.003, 0.002), (2.0, 0.015, 0.0), (4.0, None, None))
    )
    baseline = None if subpixel is None else 0.05
    return NoiseCalibration(0.0, 0.0, 0.004, subpixel, 400.0, baseline, (0.6, 0.4), points, ("a & b",))


def drawn(png):
    """The picture as numbers, to see that something is in it."""
    import io

    from matplotlib.image import imread

    return imread(io.BytesIO(png))[..., :3]


def test_the_pictures_show_something():
    one = drawn(wall_png(wall_calibration()))
    assert (one < 0.9).any(axis=2).mean() > 0.05
    for subpixel in (0.08, None):
        assert (drawn(noise_png(noise_calibration(subpixel))) < 0.9).any(axis=2).mean() > 0.01


@pytest.mark.parametrize("model", ["scale", "disparity", "scale+disparity", "thesis"])
def test_the_wall_page_has_figures_and_coefficients(model):
    found = wall_calibration(model)
    text = wall_page(found, b"picture", "my camera.toml")
    assert "&lt;b&gt;office&lt;/b&gt;" in text
    assert "<b>office</b>" not in text
    wall = found.as_dict()["walls"][0]
    assert f"{wall['before_percent']:.2f} % to {wall['after_percent']:.2f} %" in text
    assert all(f"{number:+.6g}" in text for number in found.correction.coefficients)
    assert "my camera.toml" in text
    assert "less than 10 frames" in text


def test_the_noise_page_has_figures():
    text = noise_page(noise_calibration(), b"picture", "profile.toml")
    assert all(number in text for number in ("64.00", "15.00", "90.0%", "0.004", "0.6 x 0.4 m", "a &amp; b"))


def test_a_page_needs_no_other_file_and_is_filled():
    text = page.page("T & t", "lead", page.section("H", "p", page.table(["a"], [["<x>"]])), page.code("1 < 2"))
    assert "{{" not in text
    assert "T &amp; t" in text
    assert "<td>&lt;x&gt;</td>" in text
    assert "http" not in text


def test_wide_tables_are_set_smaller_and_their_units_stay_with_the_numbers():
    assert '<div class="wide many">' in page.table(list("abcdefgh"), [])
    assert '<div class="wide">' in page.table(list("abcdefg"), [])
    assert ".many" in page.page("t", "")
    found = wall_calibration()
    assert f"<td>{found.as_dict()['walls'][0]['after_percent']:.2f}\u00a0%</td>" in wall_page(found, b"", "c.toml")


def test_walls_are_counted_in_words_that_fit():
    found = wall_calibration()
    assert "with 2 flat walls (after" in wall_page(found, b"", "c.toml")
    one = replace(found, walls=found.walls[:1])
    assert "with 1 flat wall (after" in wall_page(one, b"", "c.toml")


def test_pictures_are_no_wider_than_letters_stay_readable():
    """A page shows them 1080 pixels wide: 11 inches of letters of ten points."""
    for png in (wall_png(wall_calibration()), noise_png(noise_calibration())):
        assert drawn(png).shape[1] <= 11 * DPI


def test_a_report_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StereovoxError, match="cannot write the report"):
        write_wall_report(tmp_path / "file", wall_calibration(), "c.toml")
