# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from matplotlib.image import imread
from matplotlib.text import Text

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.maps.record.camera_path import StampedPose
from stereovox.view.drawn import camera_path, ceiling, upright
from stereovox.view.figures import PATH_COLOUR, STATE_COLOURS, round_length
from stereovox.view.picture import picture
from stereovox.view.render import LIGHT, Direction, render
from stereovox.view.views import draw_view

CONFIG = load_config("default", voxel_size=0.1)
RED, GREEN = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])


def a_room():
    """A closed room of 40 x 20 x 20 cells with a pole, free inside, one tentative cell."""
    grid = np.full((40, 20, 20), -1.5)
    for axis in range(3):
        shell = np.moveaxis(grid, axis, 0)
        shell[0] = shell[-1] = 3.0
    grid[12, 12, :] = 3.0
    grid[20, 5, 5:15] = 0.2
    return VoxelMap.from_cells(CONFIG, np.argwhere(np.ones_like(grid)), grid.ravel())


def has_colour(image, colour, tolerance=0.02):
    rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return (np.abs(image[..., :3] - rgb).max(-1) < tolerance).sum()


def test_a_picture_shows_all_states_and_heights(tmp_path):
    picture(a_room(), tmp_path / "map.png", title="A room", trajectory=[[0.5, 0.5, 1], [3, 1, 1]])
    image = imread(tmp_path / "map.png")
    for state in (State.FREE, State.TENTATIVE, State.OCCUPIED, State.UNKNOWN):
        assert has_colour(image, STATE_COLOURS[state]) > 100, state
    assert has_colour(image, "#e0452f", 0.05) > 50, "the path"
    coloured = image[..., :3].max(-1) - image[..., :3].min(-1) > 0.25
    assert coloured.mean() > 0.05, "cells coloured by height"
    assert (image[..., :3] > 0.99).all(-1).mean() > 0.2, "a white page round them"


def seen_from(*places, sensor="camera"):
    """A room whose history says that cameras stood at these places."""
    voxel_map = a_room()
    for n, place in enumerate(places):
        pose = np.column_stack([np.eye(3), place])
        voxel_map.history.path.walk(sensor, StampedPose(n, tuple(pose.ravel().tolist())))
    return voxel_map


def lines_of(figure):
    return [line.get_xydata() for line in figure.axes[0].lines if line.get_color() == PATH_COLOUR]


def test_a_picture_shows_the_path_that_the_map_remembers():
    places = [[0.5, 0.5, 1], [2, 1, 1], [3, 1, 1]]
    figure = draw_view(seen_from(*places), "overview", "A room", "z")
    wanted = np.array(places)[:, :2]
    assert any(line.shape == (3, 2) and np.allclose(line, wanted, atol=1e-5) for line in lines_of(figure))
    assert any("camera's path, 2.6 m" in text.get_text() for text in figure.texts)
    plain = draw_view(a_room(), "overview", "A room", "z")
    assert not lines_of(plain)
    assert not any("path" in text.get_text() for text in plain.texts)


def test_a_path_breaks_where_it_leaves_the_map_and_between_cameras():
    voxel_map = seen_from([0.5, 0.5, 1], [1, 1, 1], [50, 1, 1], [2, 1, 1])
    voxel_map.history.path.walk(
        "other", StampedPose(9, tuple(np.column_stack([np.eye(3), [3, 1, 1]]).ravel().tolist()))
    )
    x = camera_path(voxel_map)[:, 0]
    np.testing.assert_array_equal(x, [0.5, 1, np.nan, 2, np.nan, 3])
    far = seen_from([50, 1, 1], [60, 1, 1])
    assert len(far.path) == 2
    assert not len(camera_path(far))


def test_a_path_behind_cells_is_pale():
    figure = draw_view(seen_from([1, 1, -0.1], [3, 1, -0.1]), "overview", "A room", "z")  # below the floor
    strong = [line for line in figure.axes[0].lines if line.get_color() == PATH_COLOUR and not line.get_alpha()]
    assert all(np.isnan(line.get_xydata()).all() or len(line.get_xydata()) == 1 for line in strong)
    assert any(line.get_alpha() for line in figure.axes[0].lines if line.get_color() == PATH_COLOUR)


@pytest.mark.parametrize("log_odds", [None, -1.5])
def test_maps_without_anything_to_draw_say_so(tmp_path, log_odds):
    cells = np.zeros((0, 3), int) if log_odds is None else [[0, 0, 0], [1, 0, 0]]
    picture(VoxelMap.from_cells(CONFIG, cells, np.full(len(cells), log_odds or 0.0)), tmp_path / "map.png")
    image = imread(tmp_path / "map.png")
    assert (image[..., :3].min(-1) < 0.6).sum() > 200


def test_one_single_cell_can_be_drawn(tmp_path):
    picture(VoxelMap.from_cells(CONFIG, [[3, -4, 5]], [3.0]), tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 5000


def test_user_mistakes_are_one_line(tmp_path):
    with pytest.raises(StereovoxError, match=r"map\.jpg.*\.png"):
        picture(a_room(), tmp_path / "map.jpg")
    with pytest.raises(StereovoxError, match="cannot be written"):
        picture(VoxelMap.from_cells(CONFIG, np.zeros((0, 3)), []), tmp_path / "no" / "map.png")
    with pytest.raises(StereovoxError, match="up 'w'"):
        picture(a_room(), tmp_path / "map.png", up="w")


def test_the_ceiling_is_cut_away_and_a_landscape_is_not():
    room = upright(a_room(), None, "z")
    assert 12 < ceiling(room.occupied) <= 19
    assert room.below_ceiling[:, 2].max() < 19
    hill = np.array([[x, y, z] for x in range(20) for y in range(20) for z in range(10 - max(x, y) // 2)])
    assert ceiling(hill) == 10


def cave(slope):
    """A tunnel 30 cells wide and 20 high that climbs to a level hall, closed all round."""
    ground = np.concatenate([np.arange(0, 200) * slope, np.full(120, 200 * slope)]).astype(int)
    return np.array([
        [x, y, low + z] for x, low in enumerate(ground) for y in range(30) for z in range(21)
        if y in (0, 29) or z in (0, 20)
    ])  # fmt: skip


def test_the_ground_of_a_sloping_cave_is_not_cut_off_as_a_ceiling():
    """Cut at one height, the picture of a real cave lacked 63 % of the cells."""
    drawn = upright(VoxelMap.from_cells(CONFIG, cave(0.3), [3.0] * len(cave(0.3))), None, "z")
    assert drawn.cut is None
    level = upright(VoxelMap.from_cells(CONFIG, cave(0.0), [3.0] * len(cave(0.0))), None, "z")
    assert level.cut == pytest.approx(1.9)
    assert level.below_ceiling[:, 2].max() == 18


def test_reflections_far_below_make_no_ceiling_of_a_street():
    road = np.array([[x, y, -x // 100] for x in range(200) for y in range(30)])
    fronts = np.array([[x, y, z] for x in range(200) for y in (0, 29) for z in range(1, 10)])
    below = np.array([[0, 0, z] for z in range(-60, -2, 2)])
    street = np.concatenate([below, road, fronts])
    assert ceiling(street) == 10
    drawn = upright(VoxelMap.from_cells(CONFIG, street, [3.0] * len(street)), None, "z")
    assert drawn.cut is None
    assert 0 < drawn.layer < 10


def test_the_slice_is_no_floor_or_ceiling():
    assert 0 < upright(a_room(), None, "z").layer < 19


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_any_axis_can_point_up_and_nothing_is_mirrored(up):
    cells = np.array([[0, 0, 0], [5, 0, 0], [0, 7, 0], [0, 0, 9]])
    voxel_map = VoxelMap.from_cells(CONFIG, cells, [3.0] * 4)
    drawn = upright(voxel_map, voxel_map.centers(cells), up)
    turned = drawn.path[1:] - drawn.path[0]
    assert np.linalg.det(turned) > 0
    axis = "xyz".index(up[-1])
    assert turned[axis, 2] == pytest.approx([0.5, 0.7, 0.9][axis] * (-1 if up.startswith("-") else 1))
    assert sorted(map(tuple, np.floor(drawn.path / 0.1 + 1e-9).astype(int))) == sorted(map(tuple, drawn.cells))


def test_nearer_cells_hide_farther_ones():
    cells, colours = np.array([[0, 0, 0], [0, 0, 5]]), np.stack([RED, GREEN])
    from_above = render(cells, colours, 0.1, Direction.of(-90, 90), 40, 40).image
    np.testing.assert_allclose(from_above[5, 5], [0, LIGHT["top"], 0, 1], atol=0.02)
    from_below = render(cells, colours, 0.1, Direction.of(-90, -90), 40, 40).image
    np.testing.assert_allclose(from_below[5, 5, :2], [LIGHT["top"], 0], atol=0.02)


def test_a_view_shows_the_sides_that_look_at_the_viewer():
    seen = render(np.zeros((1, 3), int), RED[None], 1.0, Direction.of(0, 0), 30, 30).image
    np.testing.assert_allclose(seen[5, 5], [LIGHT["x"], 0, 0, 1], atol=0.02)
    oblique = render(np.zeros((1, 3), int), RED[None], 1.0, Direction.of(30, 35), 60, 60).image
    shades = oblique[oblique[..., 3] == 1][:, 0]
    assert all(np.isclose(shades, LIGHT[name], atol=0.02).sum() > 5 for name in ("top", "x", "y"))


def test_top_view_keeps_x_right_and_y_up_without_gaps():
    cells = np.array([[x, y, 0] for x in range(30) for y in range(12)])
    colours = np.where((cells[:, :1] > 14) & (cells[:, 1:2] > 5), GREEN, RED)
    rendering = render(cells, colours, 0.05, Direction.of(-90, 90), 333, 333)
    assert rendering.extent == pytest.approx((0, 1.5, 0, 0.6))
    image = rendering.image
    assert (image[..., 3] == 1).all()
    assert (image[20, -20, :2] == [0, 1]).all()
    assert all((image[row, column, :2] == [1, 0]).all() for row, column in ((20, 20), (-20, 20), (-20, -20)))


@pytest.mark.parametrize(("length", "rounded"), [(0.037, 0.02), (1.0, 1.0), (7.3, 5.0), (26, 20)])
def test_scale_bars_have_round_lengths(length, rounded):
    assert round_length(length) == pytest.approx(rounded)


@pytest.mark.parametrize("view", ["overview", "layer"])
@pytest.mark.parametrize(("shape", "beside"), [((6, 60, 20), False), ((40, 20, 20), True)])
def test_the_legend_leaves_the_title_of_a_narrow_map_alone(view, shape, beside):
    grid = np.full(shape, -1.5)
    grid[0] = grid[-1] = 3.0
    voxel_map = VoxelMap.from_cells(CONFIG, np.argwhere(np.ones_like(grid)), grid.ravel())
    figure = draw_view(voxel_map, view, "Narrow", "z")
    figure.draw_without_rendering()
    (axis,) = (axis for axis in figure.axes if axis.get_legend())
    legend = axis.get_legend().get_window_extent()
    titles = [child for one in figure.axes for child in one.get_children() if isinstance(child, Text)]
    assert not any(title.get_text() and legend.overlaps(title.get_window_extent()) for title in titles)
    assert [text.get_text() for text in axis.get_legend().get_texts()] == ["unknown", "free", "tentative", "occupied"]
    assert (legend.y0 > axis.get_window_extent().y1 - 2) == beside
