# SPDX-License-Identifier: Apache-2.0
"""Far cells are drawn coarser: nothing is lost, near ones stay as they are, and only what changes is sent."""

from types import SimpleNamespace

import numpy as np
import pytest

from stereovox.viewer.cells import MAX_CELLS, SIDE, Chunks, coarser, levels, split

SIZE = 0.1
random = np.random.default_rng(1)
CELLS = np.unique(random.integers(-100, 150, (4000, 3)), axis=0).astype(np.int32)
COLOURS = random.integers(0, 256, (len(CELLS), 3)).astype(np.uint8)


class Scene:
    """Takes nodes as a scene does and counts what is sent."""

    def __init__(self):
        self.nodes, self.sent = {}, 0
        self.scene = SimpleNamespace(add_frame=lambda name, show_axes: SimpleNamespace(name=name))

    def draw(self, _, name, centres, colours, size):
        self.sent += len(centres)
        node = self.nodes[name] = SimpleNamespace(name=name, centres=centres, colours=colours, size=size)
        node.remove = lambda: self.nodes.pop(name)
        return node


def shown(cells, eyes, most=MAX_CELLS):
    scene = Scene()
    chunks = Chunks(scene, "/cells", SIZE, scene.draw, most)
    chunks.show(cells, COLOURS[: len(cells)], np.array(eyes, float))
    return scene, chunks


def test_chunks_hold_all_cells_with_their_colours():
    wanted = {tuple(cell): tuple(colour) for cell, colour in zip(CELLS, COLOURS, strict=True)}
    found = {}
    for place, (cells, colours) in split(CELLS, COLOURS):
        assert (cells // SIDE == place).all()
        found |= {tuple(cell): tuple(colour) for cell, colour in zip(cells, colours, strict=True)}
    assert found == wanted


@pytest.mark.parametrize("doublings", [1, 3])
def test_coarse_cells_cover_the_fine_ones_in_their_mean_colour(doublings):
    for _, (cells, colours) in split(CELLS, COLOURS):
        large, mean = coarser(cells, colours, doublings)
        members = {}
        for cell, colour in zip(cells >> doublings, colours, strict=True):
            members.setdefault(tuple(cell), []).append(colour)
        assert {tuple(cell) for cell in large} == members.keys()
        for cell, colour in zip(large, mean, strict=True):
            assert np.abs(colour - np.mean(members[tuple(cell)], axis=0)).max() <= 1


def test_near_chunks_are_finer_than_far_ones():
    places, numbers = np.array([[n, 0, 0] for n in range(40)]), np.full(40, 1000)
    doublings = levels(places, numbers, np.array([[0.0, 0, 0]]), SIZE)
    assert doublings[0] == 0
    assert (np.diff(doublings) >= 0).all()
    assert doublings[-1] > 0
    both = levels(places, numbers, np.array([[0.0, 0, 0], [40 * SIDE * SIZE, 0, 0]]), SIZE)
    assert both[-1] == 0
    scarce = levels(places, numbers, np.array([[0.0, 0, 0]]), SIZE, 5000)
    assert scarce[0] == 0
    assert (numbers / 4.0**scarce).sum() <= 5000


def test_only_what_changes_is_sent():
    scene, chunks = shown(CELLS, [[-10, -10, -10]], 1500)
    assert max(node.size for node in scene.nodes.values()) > SIZE
    before = scene.sent
    chunks.show(CELLS[::-1], COLOURS[::-1], np.array([[-10.0, -10, -10]]))
    assert scene.sent == before
    chunks.look_from(np.array([[15.0, 15, 15]]))
    near = chunks.chunks[2, 2, 2]
    assert near.sent == 0
    assert before < scene.sent < before + len(CELLS)
    assert {node.name for node in chunks.sent} == scene.nodes.keys()
    assert len(scene.nodes) == len(chunks.chunks)
    chunks.show(CELLS[:1], COLOURS[:1], np.array([[15.0, 15, 15]]))
    assert len(scene.nodes) == 1
    chunks.show(CELLS[:0], COLOURS[:0], np.array([[15.0, 15, 15]]))
    assert not scene.nodes


def test_a_small_map_is_shown_as_it_is():
    scene, _ = shown(CELLS, [[3, 3, 3]])
    centres = np.concatenate([node.centres for node in scene.nodes.values()])
    want = (CELLS + 0.5) * SIZE
    assert np.allclose(centres[np.lexsort(centres.T)], want[np.lexsort(want.T)])
