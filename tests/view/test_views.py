# SPDX-License-Identifier: Apache-2.0
"""The views are looked at as data: what is drawn where."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.geometry.se3 import rigidity_error
from stereovox.maps import VoxelMap, load_map
from stereovox.view.drawn import UPS, field_of_view, upright, viewpoint_at
from stereovox.view.figures import PATH_COLOUR, save
from stereovox.view.layer import FROM, columns, scale_of, thinned, upright_layer
from stereovox.view.render import Occlusion, render
from stereovox.view.space import numbers
from stereovox.view.views import VIEWS, draw_view

CAMERA = PinholeCamera.from_field_of_view(100, 60, 90, 0.05)


def made_map(cell="int16"):
    """Free cells along z with a wall behind them, in Chien's frame: x right, y down, z forward."""
    config = load_config(voxel_size=0.5, up="-y", max_range=4.0, **{"map.cell": cell, "map.prior": 0.5})
    cells = {(x, y, z): -1.5 for x in (-1, 0) for y in (-1, 0) for z in range(4)}
    cells |= {(x, y, 4): 2.0 for x in range(-3, 3) for y in range(-2, 2)}
    one = VoxelMap.from_cells(config, list(cells), list(cells.values()))
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.1, 0.25
    one.viewpoint = Viewpoint(CAMERA, T, 5)
    return one


@pytest.mark.parametrize("view", VIEWS)
def test_every_view_becomes_a_picture(view, tmp_path):
    save(draw_view(made_map(), view, "a map", "-y"), tmp_path / "view.png")
    assert (tmp_path / "view.png").stat().st_size > 10_000


def test_the_layer_is_at_the_height_of_the_camera():
    figure = draw_view(made_map(), "layer", "a map", "-y")
    plan = figure.axes[0]
    assert "-y = -0.50 to 0.00 m" in plan.get_title(loc="left")
    states = np.asarray(plan.images[0].get_array())
    assert states.shape == (5, 6)
    assert states[4].tolist() == [3] * 6
    assert states[0].tolist() == [0, 0, 1, 1, 0, 0]
    wedge = [line.get_xydata() for line in plan.lines[:2]]
    np.testing.assert_allclose([line[0] for line in wedge], [[0.1, 0.25]] * 2)
    np.testing.assert_allclose([line[1] for line in wedge], [[0.1 - 1, 1.25], [0.1 + 1, 1.25]], atol=0.02)


@pytest.mark.parametrize("up", UPS)
def test_a_layer_shows_what_lies_at_its_height_and_is_never_mirrored(up):
    one = made_map()
    drawn = upright(one, None, up)
    for number in (0, -1):
        found = upright_layer(one, up, (number + 0.5) * 0.5)
        assert (found.across, found.at_m) == (up, pytest.approx((number + 0.5) * 0.5))
        assert found.axes == drawn.names[:2]
        here = drawn.cells[:, 2] == number
        left, _, bottom, _ = found.extent
        column, row = (drawn.cells[here, :2] - np.rint([left / 0.5, bottom / 0.5]).astype(int)).T
        assert (found.state[row, column] == drawn.state[here]).all()
        assert (found.state > 0).sum() == here.sum()
        assert np.isnan(found.log_odds).sum() == found.state.size - here.sum()


@pytest.mark.parametrize(("cell", "free", "occupied", "unknown"), [("int16", -1.5, 2.0, 0), ("uint8", 33, 252, 127)])
def test_values_are_coloured_as_the_map_keeps_them(cell, free, occupied, unknown):
    axis = draw_view(made_map(cell), "layer", "a map", "-y").axes[1]
    shown = np.ma.filled(np.ma.asarray(axis.images[0].get_array(), float), np.nan)
    assert np.unique(shown[~np.isnan(shown)]).tolist() == pytest.approx([free, occupied], abs=1e-3)
    colours, norm = scale_of(made_map(cell)).colours()
    assert norm(unknown) == pytest.approx(0.5)
    assert colours(norm(free))[2] > colours(norm(free))[0], "free is blue"
    assert colours(norm(occupied))[0] > colours(norm(occupied))[2], "occupied is red"


def test_the_landscape_leaves_out_only_what_nobody_can_see():
    heights = np.random.default_rng(1).integers(1, 9, (7, 9))
    every = np.array([[x, y, z] for y in range(7) for x in range(9) for z in range(heights[y, x])])
    some = columns(heights)
    assert set(map(tuple, some.tolist())) < set(map(tuple, every.tolist()))
    paint = np.random.default_rng(2).uniform(size=(7, 9, 3))
    pictures = [
        render(cells, paint[cells[:, 1], cells[:, 0]], 1.0, FROM, 300, 300, Occlusion(cells, ()))
        for cells in (some, every)
    ]
    np.testing.assert_array_equal(pictures[0].image, pictures[1].image)


def test_a_thinned_landscape_keeps_what_is_furthest_from_unknown():
    values = np.full((3, 400), np.nan)
    values[0, 3], values[2, 4], values[1, 399] = -1.0, 2.0, 0.5
    few, step = thinned(values, 0.0)
    assert step == 3
    assert few.shape == (1, 134)
    assert {n: float(few[0, n]) for n in np.flatnonzero(~np.isnan(few[0]))} == {1: 2.0, 133: 0.5}


@pytest.mark.parametrize(("cell", "free", "wall"), [("int16", -1.5, 2.0), ("uint8", 33, 252)])
def test_the_axis_shows_what_the_axis_crosses(cell, free, wall):
    stairs = draw_view(made_map(cell), "axis", "a map", "-y").axes[0].patches[0].get_data()
    np.testing.assert_allclose(stairs.edges[:6], [0, 0.25, 0.75, 1.25, 1.75, 2.25], atol=1e-6)
    np.testing.assert_allclose(stairs.values[:5], [free] * 4 + [wall], atol=1e-3)


def test_the_field_of_view_is_a_pyramid_of_one_metre():
    viewpoint = made_map().viewpoint
    lines = field_of_view(viewpoint)
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], [viewpoint.T_world_camera[:3, 3]] * 4)
    np.testing.assert_allclose(lines[:4, 1, 2], 1.25)
    assert lines[:4, 1, 0].tolist() == pytest.approx([-0.9, 1.1, 1.1, -0.9], abs=0.02)


def test_the_axis_tells_where_the_first_occupied_cells_are():
    title = draw_view(made_map(), "axis", "a map", "-y").axes[0].get_title(loc="left")
    assert "first occupied from 1.75 to 2.25 m" in title
    away = viewpoint_at(made_map(), (0.1, 0.1, 0.25), (0.1, 0.1, -9), "-y")
    title = draw_view(made_map(), "axis", "a map", "-y", viewpoint=away).axes[0].get_title(loc="left")
    assert "no cell is occupied" in title


def test_the_camera_may_be_told():
    one = made_map()
    told = viewpoint_at(one, (1, 2, 3), (1, 2, 7), "-y")
    assert told.camera == CAMERA
    np.testing.assert_allclose(told.T_world_camera[:3, 3], [1, 2, 3])
    np.testing.assert_allclose(told.T_world_camera[:3, :3], np.eye(3), atol=1e-12)
    down = viewpoint_at(one, (1, 2, 3), (1, 5, 3), "-y").T_world_camera
    np.testing.assert_allclose(down[:3, 2], [0, 1, 0], atol=1e-12)
    assert rigidity_error(down) < 1e-9
    assert viewpoint_at(one, None, None, "-y") is one.viewpoint
    one.viewpoint = None
    assert viewpoint_at(one, (1, 2, 3), (1, 2, 7), "-y").camera.width == 848
    assert viewpoint_at(one, None, None, "-y") is None
    with pytest.raises(StereovoxError, match="needs both"):
        viewpoint_at(one, (1, 2, 3), None, "-y")
    with pytest.raises(StereovoxError, match="same point"):
        viewpoint_at(one, (1, 2, 3), (1, 2, 3), "-y")


def test_cells_hide_lines_behind_them():
    rendering = render(np.array([[0, 0, 0], [4, 0, 0]]), np.ones((2, 3)), 1.0, FROM, 200, 200)
    middle = np.array([[0.5, 0.5, 0.5], [2.5, 0.5, 0.5]])
    points = np.concatenate([middle - 3 * FROM.toward, middle + 3 * FROM.toward, [[99, 0, 0]]])
    hidden = rendering.hidden(FROM.flat(points), points @ FROM.toward, 1.0)
    assert hidden.tolist() == [True, False, False, False, False]


def test_the_whole_field_of_view_is_in_the_picture_in_space():
    axis = draw_view(made_map(), "space", "a map", "-y").axes[0]
    red = np.concatenate([line.get_xydata() for line in axis.lines if line.get_color() == PATH_COLOUR])
    (left, right), (bottom, top) = axis.get_xlim(), axis.get_ylim()
    red = red[~np.isnan(red).any(axis=1)]
    assert ((red > [left, bottom]) & (red < [right, top])).all()
    assert axis.get_aspect() == 1


def test_what_cells_hide_of_the_field_of_view_is_dashed():
    behind = viewpoint_at(made_map(), (0, 0, 3.4), (0, 0, 9.0), "-y")
    axis = draw_view(made_map(), "space", "a map", "-y", viewpoint=behind).axes[0]
    styles = {True: 0, False: 0}
    for line in axis.lines:
        if line.get_color() == PATH_COLOUR and line.get_marker() == "None":
            styles[line.get_linestyle() == "--"] += int(np.isfinite(line.get_xydata()).all(axis=1).sum())
    assert styles[True] > 100, "behind the wall"
    assert styles[True] + styles[False] == 8 * 300, "each point of a line is drawn once"
    assert "dashed behind cells" in axis.get_title(loc="left")


def test_edges_bear_round_numbers_that_do_not_crowd():
    assert numbers("z", -0.3, 2.5)[1].tolist() == pytest.approx([0, 0.5, 1, 1.5, 2, 2.5])
    assert numbers("z", -0.9, 3.4, 4.0)[1].tolist() == pytest.approx([0, 2])


def test_a_map_without_camera_says_so():
    one = made_map()
    one.viewpoint = None
    draw_view(one, "space", "a map", "-y")
    draw_view(one, "layer", "a map", "-y")
    with pytest.raises(StereovoxError, match=r"has no camera pose.*--eye=X,Y,Z --toward=X,Y,Z"):
        draw_view(one, "axis", "a map", "-y")
    with pytest.raises(StereovoxError, match="did you mean 'layer'"):
        draw_view(one, "layers", "a map", "-y")


def test_a_saved_map_remembers_its_camera(tmp_path):
    one = made_map()
    one.save(tmp_path / "map")
    again = load_map(tmp_path / "map").viewpoint
    assert again.camera == CAMERA
    assert again.stamp_ns == 5
    np.testing.assert_array_equal(again.T_world_camera, one.viewpoint.T_world_camera)


def test_a_picture_gives_the_numbers_of_the_map_itself(monkeypatch):
    """A map that is turned upright for the picture has other cells; the heading counts those of `info`."""
    turned, itself = (VoxelMap.from_cells(load_config(), [[k, 0, 0] for k in range(n)], [3.0] * n) for n in (9, 5))
    for name in ("overview", "space", "layer"):
        texts = [text.get_text() for text in draw_view(turned, name, "a map", "z", counted=itself).texts]
        assert any("5 occupied" in text for text in texts)
        assert not any("9 occupied" in text for text in texts)
