# SPDX-License-Identifier: Apache-2.0
"""The cells of a map in the viewer: occupied ones by height and cut off at a height, the others on demand."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import State, VoxelMap
from stereovox.view.drawn import Drawn
from stereovox.view.panels import STATE_COLOURS
from stereovox.view.picture import height_colours

if TYPE_CHECKING:
    from viser import SceneNodeHandle, ViserServer

MOST_CUBES = 300_000
"""More cells than this are drawn as flat squares that face the viewer: a browser stays fluent with millions of them."""
FREE_COLOUR = "#6fa8dc"
DOT = 0.12
"""Side of the squares that stand for free and tentative cells, in cells: one can look through between them."""
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5],
        [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
        [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    np.uint32,
)  # fmt: skip
"""Two triangles a side of the cube with `CORNERS`, counter-clockwise as seen from outside."""


class Cells:
    """What the scene shows of the cells, and the controls for it.

    nodes: the scene's nodes by state, the ones not yet asked for left out. show: a check box for each state that the
    map holds. below: slider in metres along `up`; occupied cells above it are left out. scale: what a colour bar of
    the heights needs, None where no cell is occupied.
    """

    def __init__(self, server: ViserServer, voxel_map: VoxelMap, drawn: Drawn):
        self.nodes: dict[State, SceneNodeHandle] = {}
        self.show: dict[State, Any] = {}
        self.below: Any = None
        self.scale: Any = None
        self._server, self._map, self._drawn = server, voxel_map, drawn
        self._lock = threading.Lock()
        if len(drawn.occupied):
            _, self.scale = height_colours(drawn)
            self._centres = voxel_map.occupied()
            self._heights = (drawn.occupied[:, 2] + 0.5) * drawn.voxel_size
        self._controls()
        self.draw(State.OCCUPIED)

    def draw(self, state: State) -> None:
        """Show the cells of one state, or hide them, as the controls say; they are sent when first asked for."""
        with self._lock:  # viser calls back from many threads; the last one sees the controls' last values
            wanted = state in self.show and self.show[state].value
            if state is State.OCCUPIED and wanted:
                self.nodes[state] = self._draw_occupied()
            elif wanted and state not in self.nodes:
                self.nodes[state] = self._draw_dots(state)
            if state in self.nodes:
                self.nodes[state].visible = wanted

    def _controls(self) -> None:
        gui, number = self._server.gui, self._map.counts()
        with gui.add_folder("Cells"):
            for state in (State.OCCUPIED, State.TENTATIVE, State.FREE):
                if number[name := state.name.lower()]:
                    box = self.show[state] = gui.add_checkbox(name, state is State.OCCUPIED)
                    box.on_update(lambda _, state=state: self.draw(state))
            if self.scale is not None:
                self.below = self._height_slider()
                self.below.on_update(lambda _: self.draw(State.OCCUPIED))

    def _height_slider(self) -> Any:
        """Return a slider from the lowest to the highest layer; at first it leaves out a ceiling."""
        size = self._drawn.voxel_size
        low, high = (round(float(height + size / 2), 6) for height in (self._heights.min(), self._heights.max()))
        first = high if self._drawn.cut is None else round(self._drawn.cut, 6)
        return self._server.gui.add_slider(f"below {self._drawn.names[2]} [m]", low, high, size, first)

    def _draw_occupied(self) -> SceneNodeHandle:
        drawn = self._heights < self.below.value
        centres = self._centres[drawn]
        colours = self.scale.to_rgba(self._heights[drawn], bytes=True)[:, :3]
        return add_cells(self._server, "/cells/occupied", centres, colours, self._map.voxel_size)

    def _draw_dots(self, state: State) -> SceneNodeHandle:
        colour = FREE_COLOUR if state is State.FREE else STATE_COLOURS[state]
        indices, _ = self._map.cells()
        centres = self._map.centers(indices[self._drawn.state == state])
        return add_points(
            self._server, f"/cells/{state.name.lower()}", centres, rgb(colour), DOT * self._map.voxel_size
        )


def add_cells(
    server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
) -> SceneNodeHandle:
    """Add cells (N, 3) in metres in colours (N, 3) with sides of `size` metres: as cubes, or as squares where many."""
    if len(centres) > MOST_CUBES:
        return add_points(server, name, centres, colours, size)
    upright = np.tile(np.array([1, 0, 0, 0], np.float32), (len(centres), 1))
    return server.scene.add_batched_meshes_simple(
        name,
        CORNERS * size,
        FACES,
        batched_wxyzs=upright,
        batched_positions=centres.astype(np.float32),
        batched_colors=colours,
        lod="off",  # a cube with fewer triangles is no cube
        flat_shading=True,
        cast_shadow=False,
        receive_shadow=False,
    )


def add_points(
    server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
) -> SceneNodeHandle:
    """Add points (N, 3) in metres as squares of `size` metres that face the viewer; colours (N, 3) or (3,)."""
    return server.scene.add_point_cloud(
        name, centres, colours, point_size=size, point_shape="square", point_shading="flat", precision="float32"
    )


def rgb(colour: str) -> NDArray[np.uint8]:
    """Return `#rrggbb` as (3,) uint8."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)
