# SPDX-License-Identifier: Apache-2.0
"""The viewer, without a browser: the page is served, and the scene holds what the map and the controls say."""

import socket
import sys
import urllib.request
from contextlib import closing

import numpy as np
import pytest

from stereovox import PinholeCamera, VoxelMap, load_config
from stereovox.errors import MissingExtra, StereovoxError
from stereovox.frame import Viewpoint
from stereovox.maps import State
from stereovox.maps.record.camera_path import LoopLines
from stereovox.view.layer import scale_of
from stereovox.viewer.cameras import first_look, up_vector
from stereovox.viewer.cells import CORNERS, FACES, brightness, linear
from stereovox.viewer.panel import MAX_PX, colour_bar, layer_colours, plain, sharp, statistics
from stereovox.viewer.viewer import open_viewer

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5, 0.05)
LOOKS_ALONG_X = np.array([[0.0, 0, 1, 0.3], [-1, 0, 0, 0.1], [0, -1, 0, 0.7], [0, 0, 0, 1]])
SIZE = 0.2


def box_map(up="z", camera=True):
    """4 x 3 x 5 cells from the origin on: the outer half along x occupied, the others free, one tentative."""
    indices = np.stack(np.meshgrid(range(4), range(3), range(5), indexing="ij"), axis=-1).reshape(-1, 3)
    log_odds = np.where(indices[:, 0] >= 2, 2.0, -1.5)
    log_odds[0] = 0.1
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=SIZE, up=up, **{"map.prior": 0.5}), indices, log_odds)
    voxel_map.viewpoint = Viewpoint(CAMERA, LOOKS_ALONG_X) if camera else None
    return voxel_map


@pytest.fixture
def shown():
    with closing(open_viewer(box_map(), port=0)) as viewer:
        yield viewer


def pixels(viewer):
    """The layer's image, one pixel a cell again."""
    image = viewer.layer.node.image
    times = image.shape[0] // round(viewer.layer.node.render_height / SIZE)
    return image[times // 2 :: times, times // 2 :: times]


def in_world(node, x, y):
    """Where a point of an image lies, x along its columns and y along its rows, in metres from its middle."""
    w, i, j, k = node.wxyz
    turn = np.array(
        [
            [1 - 2 * (j * j + k * k), 2 * (i * j - k * w), 2 * (i * k + j * w)],
            [2 * (i * j + k * w), 1 - 2 * (i * i + k * k), 2 * (j * k - i * w)],
            [2 * (i * k - j * w), 2 * (j * k + i * w), 1 - 2 * (i * i + j * j)],
        ]
    )
    return turn @ [x, y, 0] + node.position


def test_the_page_is_served_until_it_is_closed():
    viewer = open_viewer(box_map(), port=0)
    with closing(viewer), urllib.request.urlopen(viewer.url, timeout=10) as page:
        assert b"<html" in page.read().lower()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(viewer.url, timeout=10)


def test_only_this_machine_can_look_and_nobody_can_publish(shown):
    assert shown.server.get_host() == "127.0.0.1"
    assert shown.server.request_share_url() is None


def positions(viewer, state=State.OCCUPIED):
    """Centres of the cells in a state that the scene holds, in ascending order."""
    nodes = viewer.cells.kinds[state].sent
    parts = [node.batched_positions if state is State.OCCUPIED else node.points for node in nodes]
    found = np.concatenate([np.empty((0, 3)), *parts])
    return found[np.lexsort(found.T[::-1])]


def test_occupied_cells_are_cubes_coloured_by_height(shown):
    (node,) = shown.cells.kinds[State.OCCUPIED].sent
    want = box_map().occupied()
    assert np.allclose(positions(shown), want)
    heights = node.batched_positions[:, 2]
    for height in np.unique(heights):
        assert len(np.unique(node.batched_colors[heights == height], axis=0)) == 1
    assert len(np.unique(node.batched_colors, axis=0)) == 5
    assert np.allclose(np.ptp(node.vertices, axis=0), SIZE)
    assert not any(shown.cells.kinds[state].sent for state in (State.FREE, State.TENTATIVE, State.UNKNOWN))


def test_a_cube_is_closed_and_faces_outwards():
    a, b, c = (CORNERS[FACES[:, n]].astype(float) for n in range(3))
    normal = np.cross(b - a, c - a)
    assert (np.einsum("ij,ij->i", normal, a) > 0).all()
    assert np.isclose(np.einsum("ij,ij->i", normal, a).sum() / 6, 1.0)  # the volume


def test_the_slider_leaves_out_what_is_above(shown):
    assert shown.cells.below.value == shown.cells.below.max == 1.0
    shown.cells.below.value = 0.6
    assert len(positions(shown)) == len(shown.cells.solid) == 2 * 3 * 3
    assert positions(shown)[:, 2].max() < 0.6
    shown.cells.show[State.OCCUPIED].value = False
    assert not shown.cells.kinds[State.OCCUPIED].root.visible
    shown.cells.show[State.OCCUPIED].value = True
    assert shown.cells.kinds[State.OCCUPIED].root.visible
    shown.update(box_map())
    assert shown.cells.below.value == 0.6


def test_heights_follow_up():
    with closing(open_viewer(box_map(up="-y"), port=0)) as viewer:
        assert viewer.cells.below.label == "below -y [m]"
        viewer.cells.below.value = -0.4
        assert np.allclose(positions(viewer)[:, 1], 0.5)
        assert viewer.layer.across.value == "y"


def test_other_cells_come_when_asked_for(shown):
    for state, number in ((State.FREE, 29), (State.TENTATIVE, 1)):
        shown.cells.show[state].value = True
        assert len(positions(shown, state)) == number
        shown.cells.show[state].value = False
        assert not shown.cells.kinds[state].root.visible
    assert np.allclose(positions(shown, State.FREE), box_map().free())


def test_unknown_cells_are_those_beside_free_ones(shown):
    shown.cells.below.max = shown.cells.below.value = 1.2
    shown.cells.show[State.UNKNOWN].value = True
    free, known = {tuple(c) for c in np.rint(box_map().free() / SIZE - 0.5)}, set()
    known = {tuple(c) for c in box_map().cells()[0]}
    steps = [tuple(s) for s in np.concatenate([np.eye(3), -np.eye(3)])]
    want = {tuple(np.add(cell, step)) for cell in free for step in steps} - known
    assert {tuple(c) for c in np.rint(positions(shown, State.UNKNOWN) / SIZE - 0.5)} == want


def test_colours_may_tell_the_probability_or_the_age():
    config = load_config(voxel_size=SIZE, **{"map.keep_times": True})
    indices, log_odds = [[0, 0, 0], [1, 0, 0], [2, 0, 0]], [1.0, 3.0, 3.0]
    voxel_map = VoxelMap.from_cells(config, indices, log_odds)
    times = np.zeros((1, 512), np.uint32)
    times[0, [0, 64, 128]] = 1, 200, 0
    voxel_map.storage.set_times(np.zeros((1, 3), np.int32), times, 0)
    voxel_map.viewpoint = Viewpoint(CAMERA, LOOKS_ALONG_X, 10**9)
    with closing(open_viewer(voxel_map, port=0)) as viewer:

        def colours():
            (node,) = viewer.cells.kinds[State.OCCUPIED].sent
            return node.batched_colors[np.argsort(node.batched_positions[:, 0])].astype(int)

        assert viewer.cells.colour.options == ("height", "probability", "age")
        assert len(np.unique(colours(), axis=0)) == 1
        viewer.cells.colour.value = "probability"
        assert (colours()[1] == colours()[2]).all()
        assert colours()[0].sum() > colours()[1].sum() + 50
        viewer.cells.colour.value = "age"
        assert viewer.cells.label.startswith("seconds")
        assert len(np.unique(colours(), axis=0)) == 3
        assert colours()[2].tolist() == linear(np.array([0x8A, 0x8F, 0x98], np.uint8)).tolist()


def test_another_map_takes_the_place_of_the_first(shown):
    other = VoxelMap.from_cells(box_map().config, [[9, 9, 9]], [2.0])
    shown.layer.show.value = True
    shown.update(other)
    assert np.allclose(positions(shown), other.occupied())
    assert (shown.layer.at["x"].min, shown.layer.node.position[0]) == pytest.approx((1.9, 1.9))


def test_the_layer_begins_at_the_camera_and_is_hidden(shown):
    assert shown.layer.node is None
    assert [shown.layer.at[name].value for name in "xyz"] == pytest.approx([0.3, 0.1, 0.7])
    assert [shown.layer.at[name].visible for name in "xyz"] == [False, False, True]


@pytest.mark.parametrize(("across", "columns", "rows"), [("x", 1, 2), ("y", 0, 2), ("z", 0, 1)])
def test_the_layer_lies_where_its_cells_lie(shown, across, columns, rows):
    shown.layer.across.value = across
    shown.layer.show.value = True
    assert [name for name in "xyz" if shown.layer.at[name].visible] == [across]
    voxel_map, node = box_map(), shown.layer.node
    colours = pixels(shown).astype(int)
    size = np.array([4, 3, 5])
    assert colours.shape == (size[rows], size[columns], 4)
    for row, column in np.ndindex(colours.shape[:2]):
        x = (column + 0.5) * SIZE - node.render_width / 2
        y = (row + 0.5) * SIZE - node.render_height / 2
        log_odds = voxel_map.log_odds([in_world(node, x, y)])[0]
        red, _, blue, alpha = colours[row, column]
        assert alpha == 255
        assert np.sign(red - blue) == np.sign(log_odds) or abs(log_odds) < 0.2


def test_sliders_move_and_recolour_the_layer(shown):
    shown.layer.across.value = "x"
    shown.layer.show.value = True
    before = pixels(shown)
    shown.layer.at["x"].value = 0.5
    assert shown.layer.node.position[0] == pytest.approx(0.5)
    assert (pixels(shown) != before).any(axis=-1).all()
    shown.layer.show.value = False
    assert not shown.layer.node.visible


def test_unknown_cells_of_a_layer_are_see_through():
    voxel_map = VoxelMap.from_cells(load_config(voxel_size=SIZE), [[0, 0, 0], [2, 0, 0]], [1.0, 1.0])
    with closing(open_viewer(voxel_map, port=0)) as viewer:
        viewer.layer.show.value = True
        assert pixels(viewer)[0, :, 3].tolist() == [255, 0, 255]


def test_small_layers_are_enlarged_and_large_ones_thinned():
    image = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    large = sharp(image)
    assert 512 < max(large.shape) <= 1024
    assert (large[::341, ::341] == image).all()
    assert max(sharp(np.zeros((2, MAX_PX + 1, 4), np.uint8)).shape) <= MAX_PX


def test_the_camera_stands_where_the_map_says(shown):
    nodes = {handle.name: handle for handle in shown.server.scene._handle_from_node_name.values()}
    axes, lines = nodes["/camera"], nodes["/camera/field_of_view"]
    assert np.allclose(axes.position, LOOKS_ALONG_X[:3, 3])
    assert np.allclose(in_world(axes, 1, 0) - axes.position, LOOKS_ALONG_X[:3, 0])
    assert np.allclose(in_world(axes, 0, 1) - axes.position, LOOKS_ALONG_X[:3, 1])
    assert lines.points.shape == (8, 2, 3)
    assert np.allclose(lines.points[0], [[0, 0, 0], [-0.64, -0.48, 1]])


def test_a_map_without_camera_has_none():
    with closing(open_viewer(box_map(camera=False), port=0)) as viewer:
        assert "/camera" not in viewer.server.scene._handle_from_node_name
        number = [viewer.layer.at[name].value / SIZE - 0.5 for name in "xyz"]
        assert np.allclose(number, np.round(number))


def test_an_empty_map_says_so():
    empty = VoxelMap(load_config())
    with closing(open_viewer(empty, port=0)) as viewer:
        for state in State:
            viewer.cells.show[state].value = True
        viewer.layer.show.value = True
        assert (viewer.layer.node, len(positions(viewer))) == (None, 0)
        viewer.update(box_map())
        assert len(positions(viewer)) == 30
        assert viewer.layer.node is not None
    assert statistics(empty).startswith("This map is empty")


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_the_first_look_is_from_behind_and_above(up):
    voxel_map = box_map(up)
    look_from, look_at = first_look(voxel_map, up)
    away = look_from - look_at
    assert away @ up_vector(voxel_map, up) > 0.3
    if up[-1] != "x":  # there the camera looks straight up or down
        assert away @ LOOKS_ALONG_X[:3, 2] < -0.3


def test_a_map_whose_up_lies_between_the_axes_is_shown_upright():
    tilted = VoxelMap(load_config(voxel_size=0.1, up="-y", up_direction=(0.0, -0.8, -0.6)))
    assert up_vector(tilted, "-y").tolist() == [0.0, -0.8, -0.6]
    assert up_vector(tilted, "z").tolist() == [0.0, 0.0, 1.0]  # the user said otherwise


def test_statistics_count_what_is_there():
    text = statistics(box_map())
    for line in (
        "| occupied | 30 |",
        "| free | 29 |",
        "| tentative | 1 |",
        "| cell | 0.2 m |",
        "| y | 0.00 to 0.60 m |",
    ):
        assert line in text


def test_cells_in_a_corner_are_darker():
    floor = np.argwhere(np.ones((12, 12, 1)))
    wall = np.argwhere(np.ones((1, 12, 12))) + np.array([12, 0, 0])
    cells = np.concatenate([floor, wall]).astype(np.int32)
    found = brightness(cells)
    beside, open_floor = (found[(cells == at).all(axis=1)] for at in ([11, 6, 0], [3, 6, 0]))
    assert open_floor == 1
    assert 0.5 < beside < 0.96


def test_the_legend_of_the_layer_ends_where_log_odds_end():
    scale = scale_of(box_map())
    bar = colour_bar(layer_colours(scale), "log-odds", (scale.lowest, scale.highest))
    row = bar[bar.shape[0] // 8].astype(int)
    row = row[row[:, 3] == 255][5:-5, :3]
    colours, norm = scale.colours()
    for pixel, value in ((row[0], scale.lowest), (row[-1], scale.highest)):
        assert np.abs(pixel - 255 * np.array(colours(norm(value))[:3])).max() < 8


def test_up_may_be_told():
    with closing(open_viewer(box_map(), port=0, up="-y")) as viewer:
        assert viewer.cells.below.label == "below -y [m]"
    with pytest.raises(StereovoxError, match="no axis"):
        open_viewer(box_map(), port=0, up="w")


def lines_of(viewer, kind):
    node = viewer.server.scene.get_handle_by_name(f"/loops/{kind}")
    return None if node is None else node.points


def test_loops_are_lines_that_can_be_hidden_and_go_with_the_map(shown):
    assert not shown.cameras.loops.visible
    closed, refused = [[[0, 0, 0.5], [1, 0, 0.5]], [[0, 0, 0.5], [0, 1, 0.5]]], [[[0, 0, 0], [0, 0, 1]]]
    with_loops = box_map()
    with_loops.history.loops = LoopLines.between(closed, refused)
    shown.update(with_loops)
    assert shown.cameras.loops.visible
    np.testing.assert_allclose(lines_of(shown, "closed"), closed)
    np.testing.assert_allclose(lines_of(shown, "refused"), refused)
    assert "| loops | 2 closed, 1 refused |" in statistics(with_loops)
    root = shown.server.scene.get_handle_by_name("/loops")
    assert root.visible
    shown.cameras.loops.value = False
    assert not root.visible
    shown.update(box_map())
    assert not shown.cameras.loops.visible
    assert lines_of(shown, "closed") is lines_of(shown, "refused") is None
    assert "loops" not in statistics(box_map())


def test_names_from_a_map_are_no_program_text():
    assert plain("a{b}\n<img> |x\udc80") == r"a\{b\} \<img\> \|x\?"


def test_a_taken_port_is_named_with_its_cure():
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(
            StereovoxError, match=rf"127.0.0.1:{port}: this port is in use; give another one, as 8081, or 0"
        ):
            open_viewer(box_map(), port=port)


@pytest.mark.parametrize(
    ("host", "port", "said"),
    [
        ("203.0.113.7", 0, "no address of this machine"),
        ("127.0.0.1", 70000, "port 70000 does not exist"),
        ("no such host", 0, "no address"),
    ],
)
def test_an_impossible_address_is_refused(host, port, said):
    with pytest.raises(StereovoxError, match=said):
        open_viewer(box_map(), host=host, port=port)


def test_without_viser_the_install_line_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtra, match=r"pip install 'stereovox\[viewer\]'"):
        open_viewer(box_map(), port=0)
