# SPDX-License-Identifier: Apache-2.0
"""The views are looked at as data: what is drawn where."""

import numpy as np
import pytest

from stereovox.cameras import PinholeCamera
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap, load_map
from stereovox.view.figures import save
from stereovox.view.space import field_of_view
from stereovox.view.views import VIEWS, draw_view

CAMERA = PinholeCamera.from_field_of_view(100, 60, 90, 0.05)


def made_map(cell="int16"):
    """Free cells along z with a wall behind them, in Chien's frame: x right, y down, z forward."""
    config = load_config(voxel_size=0.5, up="-y", max_range=4.0, **{"map.cell": cell})
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
    assert "y = 0.25" in plan.get_title(loc="left")
    states = np.asarray(plan.images[0].get_array())
    assert states.shape == (5, 6)
    assert states[4].tolist() == [3] * 6
    assert states[0].tolist() == [0, 0, 1, 1, 0, 0]
    wedge = [line.get_xydata() for line in plan.lines[:2]]
    np.testing.assert_allclose([line[0] for line in wedge], [[0.1, 0.25]] * 2)
    np.testing.assert_allclose([line[1] for line in wedge], [[0.1 - 1, 1.25], [0.1 + 1, 1.25]], atol=0.02)


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


def test_a_map_without_camera_says_so():
    one = made_map()
    one.viewpoint = None
    draw_view(one, "space", "a map", "-y")
    draw_view(one, "layer", "a map", "-y", at_m=0.2)
    for view in ("layer", "axis"):
        with pytest.raises(StereovoxError, match="does not know where its camera stood"):
            draw_view(one, view, "a map", "-y")
    with pytest.raises(StereovoxError, match="did you mean 'layer'"):
        draw_view(one, "layers", "a map", "-y")


def test_a_saved_map_remembers_its_camera(tmp_path):
    one = made_map()
    one.save(tmp_path / "map")
    again = load_map(tmp_path / "map").viewpoint
    assert again.camera == CAMERA
    assert again.stamp_ns == 5
    np.testing.assert_array_equal(again.T_world_camera, one.viewpoint.T_world_camera)
