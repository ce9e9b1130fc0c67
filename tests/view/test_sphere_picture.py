# SPDX-License-Identifier: Apache-2.0
"""The panorama shows each direction where one expects it."""

import numpy as np
import pytest

from stereovox.config import SphereConfig
from stereovox.depth.sphere import SphereLayout, empty, gather
from stereovox.errors import StereovoxError
from stereovox.frame import Reason
from stereovox.view.sphere import FREE, TOO_NEAR, UNKNOWN, draw_sphere, panorama, sphere_picture

LAYOUT = SphereLayout.of(10)


def drawn(grid):
    """The panorama's colours (polars, azimuths, 3) as they stand in the figure, and the figure's words."""
    figure = draw_sphere(grid, "Title")
    image = next(image for image in figure.axes[0].images if image.get_label() == "panorama")
    return image.get_array(), image.get_extent(), " ".join(text.get_text() for text in figure.texts)


def rgb(text):
    return [int(text[i : i + 2], 16) / 255 for i in (1, 3, 5)]


def place(azimuth_deg, elevation_deg):
    """Row and column of a direction: left of the picture is left of the vehicle, up is up."""
    return int((90 - elevation_deg) // 10), int((180 - azimuth_deg) // 10)


@pytest.mark.parametrize(
    ("direction", "azimuth", "elevation"),
    [((1, 0.05, 0.05), 3, 3), ((0.05, 1, 0.05), 87, 3), ((0.05, -1, 0.05), -87, 3), ((-1, 0.05, 0.05), 177, 3),
     ((1, 0.05, 1), 3, 45), ((1, 0.05, -5), 3, -79)],
)  # fmt: skip
def test_each_direction_has_its_place(direction, azimuth, elevation):
    grid = gather([direction], 0, SphereConfig(step_deg=10))
    ranges, reason = panorama(grid)
    assert ranges.shape == (18, 36)
    assert np.argwhere(reason == Reason.VALID).tolist() == [list(place(azimuth, elevation))]
    assert ranges[place(azimuth, elevation)] == pytest.approx(np.linalg.norm(direction), rel=1e-5)
    image, extent, _ = drawn(grid)
    assert extent == [180, -180, -90, 90]
    assert np.argwhere(~np.isclose(image, rgb(UNKNOWN)).all(axis=-1)).tolist() == [list(place(azimuth, elevation))]


def test_colours_tell_near_far_free_and_unknown():
    grid = empty(LAYOUT)
    grid.stamp_ns[:5] = 2_000_000_000
    grid.stamp_ns[0] = 500_000_000
    grid.range_m[0], grid.reason[0] = 1.0, Reason.VALID
    grid.range_m[1], grid.reason[1] = 9.0, Reason.VALID
    grid.range_m[2], grid.reason[2] = 20.0, Reason.TOO_FAR
    grid.range_m[3], grid.reason[3] = 0.0, Reason.TOO_NEAR
    image, _, words = drawn(grid)
    near, far, free, close, unknown = (image[9, 35 - i] for i in (0, 1, 2, 3, 10))
    assert near[0] > near[2]  # red
    assert far[2] > far[0]  # blue
    np.testing.assert_allclose(free, rgb(FREE))
    np.testing.assert_allclose(close, rgb(TOO_NEAR))
    np.testing.assert_allclose(unknown, rgb(UNKNOWN))
    for fact in ("Title", "cells of 10°", "14 % of all directions", "nearest surface 1.00 m", "oldest 1.5 s"):
        assert fact in words


def test_part_of_a_sphere_stands_in_the_whole():
    part = SphereLayout.of(10, (60, 100), (170, 200))
    grid = gather(3 * part.directions().reshape(-1, 3), 0, SphereConfig(step_deg=10), part)
    _, reason = panorama(grid)
    rows, columns = np.nonzero(reason == Reason.VALID)
    assert sorted(set(rows.tolist())) == [6, 7, 8, 9]
    assert sorted(set(columns.tolist())) == [0, 34, 35]


def test_an_empty_grid_says_so(tmp_path):
    sphere_picture(empty(LAYOUT), tmp_path / "none.png")
    assert (tmp_path / "none.png").stat().st_size > 10_000
    assert "nothing is known" in drawn(empty(LAYOUT))[2]
    with pytest.raises(StereovoxError, match=r"\.png"):
        sphere_picture(empty(LAYOUT), tmp_path / "none.jpg")
