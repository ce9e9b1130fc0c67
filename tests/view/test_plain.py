# SPDX-License-Identifier: Apache-2.0
"""Plain pictures, looked at as pixels."""

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.frame import Viewpoint
from stereovox.maps import VoxelMap
from stereovox.view.plain import FROM, colour_depth, plan_pixels, space_pixels

OCCUPIED, FREE, UNKNOWN = (34, 48, 74), (251, 250, 245), (201, 206, 214)


def made_map(occupied, free=(), up="z"):
    config = load_config(voxel_size=1.0, up=up, **{"map.prior": 0.5})
    cells, values = [*occupied, *free], [3.0] * len(occupied) + [-1.0] * len(free)
    return VoxelMap.from_cells(config, cells, values)


def test_the_plan_shows_the_layer_of_the_camera():
    voxel_map = made_map([(0, 0, 2), (3, 0, 5)], [(1, 0, 2), (1, 1, 2)])
    T = np.eye(4)
    T[:3, 3] = 0.5, 0.5, 2.4
    voxel_map.viewpoint = Viewpoint(PinholeCamera(10, 10, 10, 10, 4.5, 4.5), T)
    image = plan_pixels(voxel_map)
    assert image.shape == (320, 640, 3)
    assert tuple(image[-1, 0]) == OCCUPIED  # rows go up, columns right
    assert tuple(image[-1, 200]) == FREE
    assert tuple(image[0, 200]) == FREE
    assert tuple(image[-1, -1]) == UNKNOWN


def test_nearer_cubes_hide_farther_ones():
    nearer = np.array([4, -7, 6])  # right before the other one, less than a third of a cell off
    assert np.linalg.norm(np.cross(nearer, FROM.toward)) < 0.3
    for order in (1, -1):
        image = space_pixels(made_map([tuple(nearer), (0, 0, 0)][::order]))
        reds = (image[..., 0] > 60) & (image[..., 2] == 0)  # the upper of the two is red
        blues = (image[..., 2] > 60) & (image[..., 0] == 0)
        assert reds.sum() > 3 * blues.sum()


def test_a_cube_shows_three_faces_and_an_empty_map_none():
    image = space_pixels(made_map([(5, -7, 3)]))
    shades = {tuple(colour) for colour in image.reshape(-1, 3).tolist()}
    assert len(shades) == 4  # white and three faces
    assert (space_pixels(made_map([], [(0, 0, 0)])) == 255).all()


def test_height_follows_the_axis_that_is_up():
    top, bottom = (0, -9, 0), (0, 9, 0)
    image = space_pixels(made_map([top, bottom], up="-y"))
    red = np.argwhere((image[..., 0] > 60) & (image[..., 2] == 0))
    blue = np.argwhere((image[..., 2] > 60) & (image[..., 0] == 0))
    assert red[:, 0].max() < blue[:, 0].min()


def test_depth_goes_from_red_to_blue_and_nothing_is_black():
    depth = np.array([[0.2, 5.0, 9.9, 12.0, np.nan, np.inf, -np.inf]], np.float32)
    near, middle, far, beyond, *none = colour_depth(depth, 10.0)[0].tolist()
    assert near[0] > 100
    assert near[2] == 0
    assert max(middle) == middle[1]
    assert far[2] > 100
    assert far[0] == 0
    assert beyond[0] == 0
    assert none == [[0, 0, 0]] * 3
