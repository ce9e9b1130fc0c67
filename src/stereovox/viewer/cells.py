# SPDX-License-Identifier: Apache-2.0
"""Cells of a map in the viewer: occupied ones in colour up to a height, the others on demand.

Level of detail: cells of one kind in the viewer, full size near a viewpoint and coarser far away.

A browser draws several hundred thousand cubes smoothly, and a map may have millions of cells. They are split into
chunks; each is sent with cells of 1, 2, 4 ... times the side, as coarse as is barely visible, and coarser if there are
still too many. Only changes are sent.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Protocol

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

if TYPE_CHECKING:
    from viser import SceneNodeHandle, ViserServer


CHUNK_BITS = 6
SIDE = 1 << CHUNK_BITS
"""Cells along a side of a chunk."""
COARSEST = 4
"""Largest number of doublings of a cell's side."""
MAX_CELLS = 250_000
"""Default for the approximate number of cells of one kind that are sent at once."""
ANGLE = 0.002
"""A cell that appears smaller than this angle in radians, about two pixels, may be drawn coarser."""
WIDER = 1.25
HALF = 1 << 20
"""Indices of cells are between -HALF and HALF."""
Key = tuple[int, int, int]


class Draws(Protocol):
    """Adds cells to a scene: centres (N, 3) in metres, colours (N, 3) uint8, side in metres."""

    def __call__(
        self, server: ViserServer, name: str, centres: NDArray[np.floating], colours: NDArray[np.uint8], size: float
    ) -> SceneNodeHandle:
        """Return the node, which replaces one with the same name."""
        ...


class Chunk:
    """Cells of one chunk: indices (N, 3) int32, colours (N, 3) uint8; sent: number of doublings as sent, or None."""

    def __init__(self, cells: NDArray[np.int32], colours: NDArray[np.uint8]):
        self.cells, self.colours = cells, colours
        self.sent: int | None = None
        self.node: SceneNodeHandle | None = None

    def is_like(self, other: Chunk) -> bool:
        """Return whether both are equal."""
        return np.array_equal(self.cells, other.cells) and np.array_equal(self.colours, other.colours)


class Chunks:
    """All cells of one kind. name: of the scene node, below which each chunk has its own.

    size: side of a cell in metres. most: approximate number of cells sent at once. chunks: by place, in chunks from the
    origin.
    """

    def __init__(self, server: ViserServer, name: str, size: float, draws: Draws, max_cells: int = MAX_CELLS):
        self.chunks: dict[Key, Chunk] = {}
        self._server, self._name, self._size, self._draws, self._max_cells = server, name, size, draws, max_cells
        self.root = server.scene.add_frame(name, show_axes=False)

    @property
    def sent(self) -> list[SceneNodeHandle]:
        """The nodes in the scene."""
        return [chunk.node for chunk in self.chunks.values() if chunk.node is not None]

    def show(self, cells: NDArray[np.int32], colours: NDArray[np.uint8], eyes: NDArray[np.floating]) -> None:
        """Show only these cells (N, 3) in colours (N, 3), to viewpoints at `eyes` (n, 3) in metres."""
        now = {key: Chunk(*parts) for key, parts in split(cells, colours)}
        for key, chunk in self.chunks.items():
            if key not in now:
                _remove(chunk)
            elif chunk.is_like(now[key]):
                now[key] = chunk
            else:
                now[key].node = chunk.node
        self.chunks = now
        self.look_from(eyes)

    def look_from(self, eyes: NDArray[np.floating]) -> None:
        """Send what viewpoints at `eyes` (n, 3) additionally need."""
        keys = list(self.chunks)
        numbers = np.array([len(self.chunks[key].cells) for key in keys])
        found = levels(np.array(keys), numbers, eyes, self._size, self._max_cells)
        for key, doublings in zip(keys, found.tolist(), strict=True):
            chunk = self.chunks[key]
            if chunk.sent != doublings:
                self._send(key, chunk, doublings)

    def _send(self, key: Key, chunk: Chunk, doublings: int) -> None:
        cells, colours = coarser(chunk.cells, chunk.colours, doublings)
        size = self._size * (1 << doublings)
        before, name = chunk.node, f"{self._name}/{'_'.join(map(str, key))}_{doublings}"
        chunk.node = self._draws(self._server, name, (cells + 0.5) * size, colours, size)
        chunk.sent = doublings
        if before is not None and before.name != name:
            before.remove()


def split(
    cells: NDArray[np.int32], colours: NDArray[np.uint8]
) -> Iterator[tuple[Key, tuple[NDArray[np.int32], NDArray[np.uint8]]]]:
    """Yield each chunk's index, with its cells (n, 3) and their colours (n, 3) in a fixed order."""
    if not len(cells):
        return
    (px, py, pz), (x, y, z) = ((cells + HALF) >> CHUNK_BITS).astype(np.int64).T, (cells & (SIDE - 1)).T
    order = np.argsort((((((px << 15 | py) << 15 | pz) << CHUNK_BITS | x) << CHUNK_BITS | y) << CHUNK_BITS) | z)
    cells, colours = cells[order], colours[order]
    places = cells >> CHUNK_BITS
    starts = np.flatnonzero((np.diff(places, axis=0) != 0).any(axis=1)) + 1
    for part, tint in zip(np.split(cells, starts), np.split(colours, starts), strict=True):
        x, y, z = (int(n) for n in part[0] >> CHUNK_BITS)
        yield (x, y, z), (part, tint)


def coarser(
    cells: NDArray[np.int32], colours: NDArray[np.uint8], doublings: int
) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Return the cells of a chunk in cells of 2^doublings times the side, in the mean colour of their parts."""
    if not doublings:
        return cells, colours
    bits = CHUNK_BITS - doublings
    large = cells >> doublings
    x, y, z = (large & ((1 << bits) - 1)).T
    place = (x << 2 * bits) | (y << bits) | z
    number = np.bincount(place, minlength=1 << 3 * bits)
    found, first = np.unique(place, return_index=True)
    sums = (np.bincount(place, weights=channel, minlength=1 << 3 * bits)[found] for channel in colours.T)
    return large[first], np.stack([total / number[found] for total in sums], axis=1).astype(np.uint8)


def levels(
    places: NDArray[np.integer],
    numbers: NDArray[np.integer],
    eyes: NDArray[np.floating],
    size: float,
    max_cells: int = MAX_CELLS,
) -> NDArray[np.int64]:
    """Return the number of doublings (n,) of cells in chunks at `places` (n, 3) with `numbers` (n,) cells.

    eyes: (m, 3) in metres; each chunk is as fine as the nearest needs. Each doubling leaves about a quarter of a
    surface's cells; the finest levels within `max_cells` are chosen.
    """
    if not len(places):
        return np.zeros(0, np.int64)
    low, high = places * SIDE * size, (places + 1) * SIDE * size
    beyond = np.maximum(np.maximum(low - eyes[:, None], eyes[:, None] - high), 0)  # from each eye to each box
    nearest = np.linalg.norm(beyond, axis=2).min(axis=0)
    angle = ANGLE
    while True:
        doublings = np.log2(np.maximum(nearest * angle / size, 1)).astype(np.int64).clip(0, COARSEST)
        if (numbers / 4.0**doublings).sum() <= max_cells or (doublings == COARSEST)[nearest > 0].all():
            return doublings
        angle *= WIDER


def _remove(chunk: Chunk) -> None:
    if chunk.node is not None:
        chunk.node.remove()
        chunk.node = None


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
