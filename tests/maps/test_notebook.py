# SPDX-License-Identifier: Apache-2.0
"""What maps show of themselves in a notebook, looked at as pixels and words."""

import base64
import io
import re
from collections import Counter

import numpy as np
import pytest
from PIL import Image

import stereovox as sv
from stereovox.maps.record.camera_path import StampedPose

CLEAR, FREE, TENTATIVE, RED = (0, 0, 0, 0), (226, 224, 212, 255), (232, 163, 61, 255), (224, 69, 47, 255)
GREY, WALL = (128, 134, 145, 110), (34, 48, 74, 255)


def made_map(cells, values, **settings):
    return sv.VoxelMap.from_cells(sv.load_config(voxel_size=1.0, **{"map.prior": 0.5, **settings}), cells, values)


def picture(html):
    """Return the picture (rows, columns, 4) in a card, and what it says."""
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    image = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGBA"))
    return image, re.sub(r"<[^>]+>", " ", html)


def pixel(image, column, row, columns, rows):
    """Return the colour in the middle of a cell; row 0 is the lowest."""
    height, width = image.shape[:2]
    return tuple(image[int((rows - row - 0.5) * height / rows), int((column + 0.5) * width / columns)].tolist())


def test_a_voxel_map_is_seen_from_above():
    cells = [*((0, 0, z) for z in range(7)), (1, 0, 0), (2, 0, 0), (2, 0, 9), (3, 1, 0)]
    image, text = picture(made_map(cells, [*[3.0] * 8, 0.1, -2.0, 0.1])._repr_html_())
    high, low, free, tentative, unknown = (pixel(image, *at, 4, 2) for at in ((0, 0), (1, 0), (2, 0), (3, 1), (0, 1)))
    assert free == FREE  # something in this column is
    assert tentative == TENTATIVE
    assert unknown == CLEAR
    assert high[0] > low[0]  # yellow, violet
    assert high[2] * low[0] < low[2] * high[0]
    assert "1 free, 2 tentative, 8 occupied" in text
    assert "4.00 x 2.00 x 10.00 m" in text
    assert "dark at 0.00 m to yellow at 7.00 m" in text
    assert "path" not in text


@pytest.mark.parametrize("up", ["z", "-z", "y", "-y", "x", "-x", "+z"])
def test_it_is_turned_as_the_settings_say(up):
    axis, sign = "xyz".index(up[-1]), -1 if up.startswith("-") else 1
    across, side = np.eye(3, dtype=int)[axis - 1], np.eye(3, dtype=int)[axis]
    cells = [across, *(height * sign * side for height in range(6))]
    image, _ = picture(made_map(cells, [3.0] * 7, up=up)._repr_html_())
    assert sorted(image.shape[:2]) == [200, 400]
    colours = {tuple(colour) for colour in image.reshape(-1, 4).tolist()}
    assert any(red > 200 and blue < 120 for red, _, blue, _ in colours)  # yellow: the high cell hides the low one


def test_a_ceiling_is_left_out():
    floor = [(x, y, 0) for x in range(8) for y in range(8)]
    walls = [(0, y, z) for y in range(8) for z in range(1, 9)]
    roof = [(x, y, 9) for x in range(8) for y in range(8)]
    cells = floor + walls + roof
    image, text = picture(made_map(cells, [3.0] * len(cells))._repr_html_())
    wall, inside = (pixel(image, x, 4, 8, 8) for x in (0, 5))
    assert wall[0] > inside[0] + 50
    assert "cut open below the ceiling" in text


def test_the_path_of_the_sensor_is_drawn():
    one = made_map([(0, 0, 0), (9, 4, 0)], [-2.0, -2.0])
    for x in (1.0, 8.0):
        one.history.path.walk("", StampedPose(0, (1, 0, 0, x, 0, 1, 0, 2.5, 0, 0, 1, 0)))
    image, text = picture(one._repr_html_())
    assert pixel(image, 4, 2, 10, 5) == RED
    assert pixel(image, 9, 2, 10, 5) == CLEAR
    assert "path of the sensor" in text


def test_large_maps_are_pooled_and_lose_no_wall():
    image, _ = picture(made_map([(0, 0, 0), (5000, 0, 0), (2501, 7, 3)], [-2.0, -2.0, 3.0])._repr_html_())
    assert image.shape[1] <= 400
    assert (image[..., 3] > 0).sum() == 3
    grid = np.full((30, 9000), 0, np.int8)
    grid[3, 4444] = 100
    image, _ = picture(sv.OccupancyGrid(grid, 0.05)._repr_html_())
    assert image.shape[1] <= 400
    assert (image == WALL).all(axis=-1).sum() == 1


def test_it_stays_small_whatever_is_in_it():
    noise = np.random.default_rng(4)
    flat = np.argwhere(noise.random((400, 400)) < 0.8)
    cells = np.column_stack([flat, noise.integers(0, 200, len(flat))])
    assert len(made_map(cells, np.full(len(cells), 3.0))._repr_html_()) < 150_000


def test_floors_are_seen_as_they_are():
    cells = np.array([[0, 0, 100], [-1, 50, 0]], np.int8)
    grid = sv.OccupancyGrid(cells, 0.5)
    floor = sv.GridMap.from_occupancy(grid, sv.load_config(voxel_size=0.5))
    for one in (grid, floor):
        image, text = picture(one._repr_html_())
        assert [pixel(image, x, 0, 3, 2) for x in range(3)] == [FREE, FREE, WALL]
        assert [pixel(image, x, 1, 3, 2) for x in range(3)] == [GREY, TENTATIVE, FREE]
        assert "1.50 x 1.00 m" in text
        assert "3 free, 1 tentative, 1 occupied" in text


def test_what_is_empty_says_so_without_a_picture():
    config = sv.load_config(voxel_size=0.1)
    grid = sv.OccupancyGrid(np.full((3, 4), -1, np.int8), 0.1)
    nothing = sv.OccupancyGrid(np.zeros((0, 0), np.int8), 0.1)
    for one in (sv.Mapper(), sv.GridMapper(), sv.VoxelMap(config), sv.GridMap(config), grid, nothing):
        html = one._repr_html_()
        assert "This map is empty" in html
        assert "<img" not in html
    assert "Mapper, profile &#x27;default&#x27;" in sv.Mapper()._repr_html_()


def test_a_huge_floor_has_facts_alone():
    floor = sv.GridMap(sv.load_config(voxel_size=1.0))
    ends = np.array([[0, 0, 0], [2000, 2000, 0]], np.int32)
    floor.storage.insert(ends, np.full((2, 4096), 999, np.int16))
    assert "Too large for a quick picture" in floor._repr_html_()


def test_refusals_are_named_and_foreign_text_is_only_text():
    one = made_map([(0, 0, 0)], [3.0])
    one.history.frames = 1234
    one.history.refused = Counter(a=1000, b=4, c=3, d=2, e=1, f=1)
    one.recording = "<script>alert(1)</script>"
    html = one._repr_html_()
    assert "1,234" in html
    assert "1,011: 1,000 a, 4 b, 3 c, 2 d and 2 more reasons" in html
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_result_shows_its_map(tmp_path):
    made = sv.map_recording("sim:room?image_width=160", tmp_path / "a.svox", frames=":3", voxel_size=0.2)
    html = made._repr_html_()
    assert f"MapResult, saved in {tmp_path / 'a.svox'}" in html
    assert "<img" in html
