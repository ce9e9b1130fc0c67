# SPDX-License-Identifier: Apache-2.0
"""Pictures and the page of floors' maps."""

import io
from dataclasses import replace

import numpy as np
import pytest
from made_floors import FREE, WALL, changed, random_floor, room
from made_pages import Balanced
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from stereovox.errors import StereovoxError
from stereovox.evaluate.grid_align import aligned_grids
from stereovox.evaluate.grid_scores import Difference, differences, laid_on, score_laid, wrong
from stereovox.geometry import se2
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.view.figures import PATH_COLOUR, STATE_COLOURS
from stereovox.view.grid import (
    BOTH_FREE,
    BOTH_OCCUPIED,
    BOTH_UNKNOWN,
    KINDS,
    binary_png,
    classes,
    difference_png,
    draw_grid,
    picture_grid,
    pooled,
    side_by_side_png,
    trimmed,
)
from stereovox.view.report.grid import write_grid_report


def colours_at(figure, axis, points):
    """The colours (N, 3) of a rendered figure at points of a panel, in metres."""
    figure.set_dpi(40)
    figure.canvas.draw()
    x, y = axis.transData.transform(points).astype(int).T
    image = np.asarray(figure.canvas.buffer_rgba())
    return image[image.shape[0] - 1 - y, x, :3] / 255


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (-3.0, 7.0, 0.6)])
def test_cells_are_drawn_where_they_lie(origin):
    grid = random_floor(3, side=1.0, origin=origin)
    figure = draw_grid(grid, "A floor")
    axis = figure.axes[0]
    wanted = [to_rgb(STATE_COLOURS[State(int(state))]) for state in grid.states.ravel()]
    rows, columns = np.divmod(np.arange(grid.cells.size), grid.cells.shape[1])
    np.testing.assert_allclose(colours_at(figure, axis, grid.centres(rows, columns)), wanted, atol=0.01)
    assert len(set(wanted)) == 4


def test_the_way_is_drawn_in_the_map_s_frame_and_what_is_known_fills_the_picture():
    grid = changed(random_floor(1), np.full((9, 12), -1))
    grid.cells[4:6, 3:9] = FREE
    way = np.array([[2.0, 2.2, 0.1], [4.0, 2.6, 0.2]])
    axis = draw_grid(grid, "A floor", way).axes[0]
    lines = [line for line in axis.lines if line.get_color() == PATH_COLOUR]
    np.testing.assert_allclose(lines[0].get_xydata(), way[:, :2])
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    assert left < 1.5 < 4.5 < right < 5.5
    assert 1 < bottom < 2 < 3 < top < 4
    trim = trimmed(grid)
    assert trim.cells.shape == (2, 6)
    np.testing.assert_allclose(trim.centres([0], [0]), grid.centres([4], [3]))


def test_a_thin_wall_is_not_lost_in_a_small_picture():
    cells = np.full((50, 70), State.FREE, np.uint8)
    cells[31, :] = State.OCCUPIED
    cells[:10] = State.UNKNOWN
    small = pooled(cells, list(State), 8)
    assert small.shape == (7, 9)
    assert (small[3] == State.OCCUPIED).all()
    assert (small[0] == State.UNKNOWN).all()
    assert (small[1] == State.FREE).all(), "what is known comes before what is not"
    assert (pooled(cells, list(State), 1) == cells).all()


def test_the_binary_image_has_a_pixel_for_each_cell_with_north_up():
    laid = aligned_grids(random_floor(2), random_floor(1), exclude=[(0, 0, 1, 1)])
    image = imread(io.BytesIO(binary_png(laid)))[..., 0]
    assert (image[::-1] == wrong(differences(laid))).all()
    assert 0 < image.mean() < 1
    assert not image[-2:, :2].any(), "an excluded region is black"


def test_each_kind_of_cell_has_a_colour_of_its_own():
    laid = aligned_grids(random_floor(2, (30, 40)), random_floor(1, (30, 40)), exclude=[(0, 0, 3, 3)])
    found = classes(laid)
    assert set(np.unique(found)) == set(KINDS)
    assert len({colour for _, colour in KINDS.values()}) == len(KINDS)
    same = differences(laid) == Difference.SAME
    states = laid.reference.states
    assert (found[same & (states == State.OCCUPIED)] == BOTH_OCCUPIED).all()
    assert (found[same & (states == State.FREE)] == BOTH_FREE).all()
    assert (found[same & (states == State.UNKNOWN)] == BOTH_UNKNOWN).all()
    drawn = imread(io.BytesIO(difference_png(laid)))[..., :3]
    for name, colour in KINDS.values():
        assert (np.abs(drawn - to_rgb(colour)).max(axis=2) < 0.01).sum() > 20, name


@pytest.mark.parametrize("shape", [(20, 90), (60, 40)])
def test_maps_of_any_shape_are_shown_side_by_side(shape):
    laid = aligned_grids(random_floor(2, shape), random_floor(1, shape))
    drawn = imread(io.BytesIO(side_by_side_png(laid)))[..., :3]
    for colour in ("white", "black", STATE_COLOURS[State.OCCUPIED], STATE_COLOURS[State.UNKNOWN]):
        assert (np.abs(drawn - to_rgb(colour)).max(axis=2) < 0.01).sum() > 20, colour


def test_the_page_holds_the_figures_and_is_well_formed(tmp_path):
    reference = room()
    cells = reference.cells.copy()
    cells[:, :44] = -1
    cells[30:33, 80:100] = WALL
    laid = laid_on(changed(reference, cells), reference, [(0, 0, 1, 4)], align=False)
    scores = score_laid(laid, 0.05, False)
    file = write_grid_report(tmp_path / "new", scores, laid, "a <b>.yaml", "reference.yaml")
    text = file.read_text()
    checked = Balanced()
    checked.feed(text)
    assert checked.open == []
    for shown in (f"{scores.eq7_percent:.1f} %", f"{scores.errors.missed:,}", "a &lt;b&gt;.yaml", "60"):
        assert shown in text
    assert imread(tmp_path / "new/difference.png").shape[:2] == laid.reference.cells.shape
    (tmp_path / "file").write_text("")
    with pytest.raises(StereovoxError, match="cannot write the report"):
        write_grid_report(tmp_path / "file", scores, laid)


def test_pictures_of_nothing_and_of_little(tmp_path):
    empty = changed(room(), np.full((80, 120), -1))
    picture_grid(empty, tmp_path / "empty.png")
    assert "empty" in draw_grid(empty, "x").texts[0].get_text()
    one = OccupancyGrid(np.array([[WALL]], np.int8), 0.05, tuple(se2.inverse((1, 2, 3))))
    picture_grid(one, tmp_path / "one.png", title="one cell", track=np.zeros((0, 3)))
    long = replace(room(), cells=np.zeros((3, 3000), np.int8))
    picture_grid(long, tmp_path / "long.png", track=[[0, 0]])
    assert (tmp_path / "long.png").stat().st_size > 5000
    with pytest.raises(StereovoxError, match=r"\.png"):
        picture_grid(one, tmp_path / "one.jpg")
