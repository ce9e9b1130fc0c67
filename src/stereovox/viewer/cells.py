# SPDX-License-Identifier: Apache-2.0
"""Cells of a map in the viewer: occupied ones in colour up to a height, the others on demand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.evaluate.truth import keys, position
from stereovox.kernels.threads import Newest
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import floor_axes
from stereovox.view.drawn import stood_up
from stereovox.view.figures import STATE_COLOURS
from stereovox.view.layer import COLOURS
from stereovox.view.picture import height_scale
from stereovox.view.render import Occlusion
from stereovox.viewer.chunks import MAX_CELLS, Chunks, Draws

if TYPE_CHECKING:
    from viser import SceneNodeHandle, ViserServer

HEIGHT, PROBABILITY, AGE = "height", "probability", "age"
AGES = "plasma_r"
TIMELESS = "#8a8f98"
"""Colour of cells without a time."""
BESIDE = np.concatenate([np.eye(3, dtype=np.int32), -np.eye(3, dtype=np.int32)])
FREE_COLOUR, UNKNOWN_COLOUR = "#6fa8dc", "#9b7fc4"
DOT = 0.12
"""Side of the squares that show cells that are not occupied, in cells: small, so that they do not block the view."""
RADII = ((2, 0.4), (4, 1.0))
"""Radii and weights of the ambient occlusion of a cell."""
MAX_SHADED = 400_000
"""Most cells whose ambient occlusion is worth the wait: seconds, once per map."""
GAMMA = 2.2
LABELS = {
    State.OCCUPIED: "occupied",
    State.TENTATIVE: "tentative",
    State.FREE: "free",
    State.UNKNOWN: "unknown next to free",
}
COLOUR_LABELS = {HEIGHT: "height of occupied cells {} [m]", PROBABILITY: "probability", AGE: "seconds since last seen"}
CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32) - 0.5
FACES = np.array(
    [
        [0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5],
        [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
        [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3],
    ],
    np.uint32,
)  # fmt: skip
"""Two triangles per side of the cube with `CORNERS`, counter-clockwise as seen from outside."""


def unknown_shell(voxel_map: VoxelMap) -> NDArray[np.int32]:
    """Return indices (N, 3) of the unknown cells that share a face with a free cell."""
    free = voxel_map.cells_in(State.FREE)
    known = np.sort(keys(np.concatenate([free, *map(voxel_map.cells_in, (State.TENTATIVE, State.OCCUPIED))])))
    shell = [np.empty((0, 3), np.int32)]
    for step in BESIDE:
        beside = free + step
        shell.append(beside[position(keys(beside), known) < 0])
    cells = np.concatenate(shell)
    return cells[np.unique(keys(cells), return_index=True)[1]]


def values_of(voxel_map: VoxelMap, cells: NDArray[np.int32], colour: str, up: str) -> NDArray[np.float64]:
    """Return the values (N,) that colour cells (N, 3): height in metres along `up`, probability, or age in seconds."""
    if colour == HEIGHT:
        return heights(voxel_map, cells, up)
    centres = voxel_map.centers(cells)
    found = voxel_map.probability(centres) if colour == PROBABILITY else voxel_map.age(centres)
    return np.asarray(found, float)


def heights(voxel_map: VoxelMap, cells: NDArray[np.int32], up: str) -> NDArray[np.float64]:
    """Return the height (N,) in metres along `up` of the centres of cells (N, 3)."""
    _, _, axis, sign = floor_axes(up)
    return sign * (cells[:, axis].astype(np.float64) + 0.5) * voxel_map.voxel_size


def colours_of(values: NDArray[np.floating], colour: str, voxel_size: float) -> Any:
    """Return a matplotlib mappable for the result of `values_of`."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    known = values[np.isfinite(values)]
    if colour == HEIGHT:
        return height_scale(known, voxel_size)
    if colour == PROBABILITY:
        return ScalarMappable(Normalize(0, 1), LinearSegmentedColormap.from_list(PROBABILITY, COLOURS))
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return ScalarMappable(Normalize(low, max(high, low + 1e-3)), colormaps[AGES].with_extremes(bad=TIMELESS))


def brightness(cells: NDArray[np.int32]) -> NDArray[np.float32]:
    """Return the brightness (N,) of cells (N, 3), less in corners and gaps; 1 if there are very many cells."""
    return Occlusion(cells, RADII).mean() if len(cells) <= MAX_SHADED else np.ones(len(cells), np.float32)


class Cells:
    """The cells in the scene and their controls.

    kinds: the cells in the scene by state. show: a check box for each state. colour: drop-down of the colouring of
    occupied cells. below: slider in metres along `up`; cells above it are hidden. solid: occupied cells (N, 3) shown
    now. scale: mappable for a colour bar, None if no cell is occupied. most: approximate number of cells of one kind in
    the scene at once.
    """

    def __init__(self, server: ViserServer, voxel_map: VoxelMap, up: str, max_cells: int = MAX_CELLS):
        self._server, self._up, self._map = server, up, voxel_map
        self._found: dict[State, NDArray[np.int32]] = {}
        self.solid = np.empty((0, 3), np.int32)
        self._shaded = self.solid, np.empty(0, np.float32)
        self.scale: Any = None
        size = voxel_map.voxel_size
        self.kinds = {
            state: Chunks(server, f"/cells/{state.name.lower()}", size, _draws_of(state), max_cells) for state in LABELS
        }
        self.draw, self._look = Newest(self._draw), Newest(self._come_closer)
        self._controls()
        self.update(voxel_map)
        self._watch_viewpoints()

    @property
    def label(self) -> str:
        """Meaning of the colours of occupied cells."""
        return COLOUR_LABELS[self.colour.value].format(self._up)

    def update(self, voxel_map: VoxelMap) -> None:
        """Show another map with cells of the same size, which must no longer change."""
        found = {State.OCCUPIED: voxel_map.cells_in(State.OCCUPIED)}
        self._map = voxel_map
        self._found = found
        self._fit_slider()
        self.draw()

    def _controls(self) -> None:
        gui = self._server.gui
        with gui.add_folder("Cells"):
            self.show = {state: gui.add_checkbox(label, state is State.OCCUPIED) for state, label in LABELS.items()}
            colours = (HEIGHT, PROBABILITY, *([AGE] if self._map.config.map.keep_times else []))
            self.colour = gui.add_dropdown("colour", colours)
            self.below = gui.add_slider(f"below {self._up} [m]", 0.0, 1.0, self._map.voxel_size, 1.0)
        self._touched = self._fitting = False
        for control in (*self.show.values(), self.colour):
            control.on_update(lambda _: self.draw())
        self.below.on_update(self._cut)

    def _cut(self, _: Any) -> None:
        if not self._fitting:
            self._touched = True  # the cut is kept when the map grows
            self.draw()

    def _fit_slider(self) -> None:
        """Set the slider's range from the lowest to the highest layer; initially it hides a ceiling."""
        cells, size = self._found[State.OCCUPIED], self._map.voxel_size
        if not len(cells):
            return
        drawn = stood_up(cells, np.full(len(cells), State.OCCUPIED, np.uint8), size, self._up)
        layers = drawn.cells[:, 2]
        low, high = (round(float(layer + 1) * size, 6) for layer in (layers.min(), layers.max()))
        first = high if drawn.cut is None else round(drawn.cut, 6)
        self.below.max = max(high, low + size)  # before the minimum: a slider refuses crossed ends
        self.below.min = low
        if not self._touched:
            self._fitting = True
            self.below.value = first
            self._fitting = False

    def _draw(self) -> None:
        for state, box in self.show.items():
            self.kinds[state].root.visible = box.value
            if box.value:
                self._show_occupied() if state is State.OCCUPIED else self._show_dots(state)

    def _show_occupied(self) -> None:
        cells, voxel_map = self._found[State.OCCUPIED], self._map
        values = values_of(voxel_map, cells, self.colour.value, self._up)
        self.scale = colours_of(values, self.colour.value, voxel_map.voxel_size) if len(cells) else None
        shown = heights(voxel_map, cells, self._up) < self.below.value
        self.solid = cells[shown]
        colours = np.empty((0, 3), np.uint8)
        if self.scale is not None:
            colours = self.scale.to_rgba(np.ma.masked_invalid(values[shown]), bytes=True)[:, :3]
            colours = (colours * self._shades(cells)[shown, None]).astype(np.uint8)
        self.kinds[State.OCCUPIED].show(self.solid, colours, self._eyes())

    def _shades(self, cells: NDArray[np.int32]) -> NDArray[np.float32]:
        """Return the brightness (N,) of the map's occupied cells, computed once: hidden cells still cast shade."""
        shaded, shades = self._shaded
        if shaded is not cells:
            shades = brightness(cells)
            self._shaded = cells, shades
        return shades

    def _show_dots(self, state: State) -> None:
        found = self._found  # read before the map, which `update` sets first: no dots of an older map are kept
        if state not in found:
            find = unknown_shell if state is State.UNKNOWN else lambda one: one.cells_in(state)
            found[state] = find(self._map)
        cells = found[state]
        cells = cells[heights(self._map, cells, self._up) < self.below.value]
        colour = {State.FREE: FREE_COLOUR, State.UNKNOWN: UNKNOWN_COLOUR}.get(state, STATE_COLOURS[state])
        self.kinds[state].show(cells, np.tile(rgb(colour), (len(cells), 1)), self._eyes())

    def _eyes(self) -> NDArray[np.float64]:
        """Return the viewpoints of all connected browsers, (n, 3) in metres; the initial one if there is none."""
        eyes = [client.camera.position for client in self._server.get_clients().values()]
        return np.array(eyes or [self._server.initial_camera.position], float).reshape(-1, 3)

    def _watch_viewpoints(self) -> None:
        @self._server.on_client_connect
        def _(client: Any) -> None:
            client.camera.on_update(lambda _: self._look())
            self._look()

    def _come_closer(self) -> None:
        for state, kind in self.kinds.items():
            if self.show[state].value:
                kind.look_from(self._eyes())


def add_cubes(
    server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
) -> SceneNodeHandle:
    """Add cells (N, 3) in metres in colours (N, 3) as cubes with sides of `size` metres."""
    return server.scene.add_batched_meshes_simple(
        name,
        CORNERS * size,
        FACES,
        batched_wxyzs=np.tile(np.array([1, 0, 0, 0], np.float32), (len(centres), 1)),
        batched_positions=centres.astype(np.float32),
        batched_colors=linear(colours),
        lod="off",  # a cube with fewer triangles is no cube
        flat_shading=True,
        cast_shadow=False,
        receive_shadow=False,
    )


def linear(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return sRGB colours (N, 3) as shares of light: the page expects these for batched meshes, and bleaches others."""
    return np.rint(255 * (colours / 255) ** GAMMA).astype(np.uint8)


def add_points(
    server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
) -> SceneNodeHandle:
    """Add points (N, 3) in metres as squares of `size` metres that face the viewer; colours (N, 3) or (3,)."""
    return server.scene.add_point_cloud(
        name, centres, colours, point_size=size, point_shape="square", point_shading="flat", precision="float32"
    )


def _dots(
    server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
) -> SceneNodeHandle:
    return add_points(server, name, centres, colours, DOT * size)


def _draws_of(state: State) -> Draws:
    return add_cubes if state is State.OCCUPIED else _dots


def rgb(colour: str) -> NDArray[np.uint8]:
    """Return `#rrggbb` as (3,) uint8."""
    return np.frombuffer(bytes.fromhex(colour.removeprefix("#")), np.uint8)
