# SPDX-License-Identifier: Apache-2.0
"""Dark pictures: the page, letters and states change, heights and the path do not."""

import numpy as np
import pytest
from matplotlib.colors import to_hex, to_rgb
from matplotlib.image import imread

from stereovox.config import load_config
from stereovox.maps import State, VoxelMap
from stereovox.view.figures import COLOURS, PAGE, PATH_COLOUR, STATE_COLOURS, darken, save
from stereovox.view.views import VIEWS, draw_view


def made_map():
    grid = np.full((30, 20, 10), -4.0)
    grid[0] = grid[-1] = grid[:, :, 0] = 3.0
    grid[20, 5, 3:8] = 0.2
    return VoxelMap.from_cells(load_config(voxel_size=0.1), np.argwhere(np.ones_like(grid)), grid.ravel())


def share(image, colour):
    return (np.abs(image[..., :3] - to_rgb(colour)).max(axis=-1) < 0.02).mean()


def test_the_page_and_the_states_are_dark_and_occupied_cells_the_brightest(tmp_path):
    figure = draw_view(made_map(), "overview", "A map", "z")
    darken(figure)
    save(figure, tmp_path / "dark.png")
    image = imread(tmp_path / "dark.png")
    assert share(image, PAGE) > 0.3
    assert share(image, "#ffffff") < 0.01
    for state in (State.FREE, State.OCCUPIED):
        assert share(image, COLOURS[STATE_COLOURS[state]]) > 0.005, state
        assert share(image, STATE_COLOURS[state]) < 0.001, state
    assert sum(to_rgb(COLOURS[STATE_COLOURS[State.OCCUPIED]])) > sum(to_rgb(COLOURS[STATE_COLOURS[State.FREE]])) + 1


@pytest.mark.parametrize("view", [view for view in VIEWS if view != "axis"])
def test_all_letters_of_a_view_stand_out(view):
    figure = draw_view(made_map(), view, "A map", "z")
    darken(figure)
    letters = [one for one in figure.findobj() if hasattr(one, "get_fontsize") and getattr(one, "get_text", str)()]
    assert len(letters) > 10
    assert all(np.mean(to_rgb(one.get_color())) > 0.5 for one in letters if to_hex(one.get_color()) != PATH_COLOUR)
