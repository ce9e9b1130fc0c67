# SPDX-License-Identifier: Apache-2.0
"""Panels of the viewer: statistics, colour bars, log-odds along the optical axis, distance measurement, and layers."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.kernels.threads import Newest
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import Layer, layer
from stereovox.view.drawn import stood_up
from stereovox.view.layer import Scale, draw_profile, scale_of
from stereovox.viewer.cells import Cells, rgb

if TYPE_CHECKING:
    from viser import ImageHandle, ViserServer


WIDTH_IN, DPI = 4.8, 180
"""Width of the panel's pictures in inches, relative to text size, and pixels per inch."""

BOTH = "#7d8695"
"""A grey that is legible on white and on black."""


def statistics(voxel_map: VoxelMap) -> str:
    """Describe the contents of a map as Markdown."""
    counts, bounds = voxel_map.counts(), voxel_map.bounds()
    rows = {state: f"{counts[state]:,}" for state in ("occupied", "free", "tentative")}
    rows["cell"] = f"{voxel_map.voxel_size:g} m"
    for axis, name in enumerate("xyz" if bounds is not None else ""):
        low, high = bounds[:, axis] if bounds is not None else (0, 0)
        rows[name] = f"{low:.2f} to {high:.2f} m"
    rows["frames"] = f"{voxel_map.frames:,} ({voxel_map.frames_refused:,} refused)"
    if (loops := voxel_map.history.loops) is not None:
        rows["loops"] = f"{loops.closed.number:,} closed, {loops.refused.number:,} refused"
    rows["memory"] = f"{voxel_map.memory_bytes / 1e6:,.1f} MB"
    rows["profile"] = plain(voxel_map.config.profile)
    if voxel_map.recording:
        rows["recording"] = plain(voxel_map.recording)
    lines = ["| | |", "|:--|:--|", *(f"| {name} | {value} |" for name, value in rows.items())]
    return "\n".join(lines if bounds is not None else ["This map is empty: no cell is known yet.", "", *lines])


def plain(text: str) -> str:
    """Escape text so that Markdown shows it literally.

    The page would execute `{...}` and `<...>`, and a map may be from someone else.
    """
    text = " ".join(text.encode("utf-8", "replace").decode().split())
    return re.sub(r"([!-/:-@\[-`{-~])", r"\\\1", text)


def colour_bar(scale: Any, label: str, limits: tuple[float, float] | None = None) -> NDArray[np.uint8]:
    """Return a picture (H, W, 4) of a colour bar for a matplotlib mappable, legible on light and dark pages.

    limits: its ends.
    """
    figure = _figure(0.8, "none")
    bar = figure.colorbar(scale, cax=figure.add_subplot(), orientation="horizontal")
    if limits is not None:
        bar.ax.set_xlim(limits)
    bar.set_label(label, color=BOTH)
    bar.ax.tick_params(colors=BOTH)
    bar.outline.set_visible(False)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba()).copy()


def axis_chart(voxel_map: VoxelMap) -> NDArray[np.uint8]:
    """Return a picture (H, W, 3) of the log-odds along the optical axis (Chien 2020, Fig 4.6).

    Raises StereovoxError if the map has no camera.
    """
    figure = _figure(2.9)
    axis = figure.add_subplot()
    draw_profile(axis, voxel_map)
    axis.set_title("", loc="left")  # a panel has no room for it
    axis.set_xlabel("distance from the camera [m]")
    if axis.get_legend() is not None:
        axis.get_legend().remove()
    return _pixels(figure)


def _figure(height: float, page: str = "white") -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure((WIDTH_IN, height), dpi=DPI, facecolor=page, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Any) -> NDArray[np.uint8]:
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3].copy()


COLOUR = "#d6117f"
HOW = "Tick, then click two cells."
FIRST = "Click the other cell."


class Measure:
    """Clicked cells and the distance between them.

    on: check box. picked: centres (3,) in metres of one or two cells. text: element of the page.
    """

    def __init__(self, server: ViserServer, cells: Cells, size: float):
        self._server, self._cells, self._size = server, cells, size
        self.picked: list[NDArray[np.floating]] = []
        with server.gui.add_folder("Measure"):
            self.on = server.gui.add_checkbox("measure", False)
            self.text = server.gui.add_markdown(HOW)
        self.on.on_update(lambda _: self._switch())

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> None:
        """Pick the cell under a click, if there is one; a third click starts again."""
        cell = first_hit(self._cells.solid, self._size, origin, direction)
        if cell is None:
            return
        self.picked = [*(self.picked if len(self.picked) < 2 else []), (cell + 0.5) * self._size]
        self._draw()

    def _switch(self) -> None:
        if self.on.value:
            self._server.scene.on_click()(self._clicked)
        else:
            self._server.scene.remove_click_callback(self._clicked)
        self.picked = []
        self._draw()

    def _clicked(self, event: Any) -> None:
        self.pick(event.ray_origin, event.ray_direction)

    def _draw(self) -> None:
        scene, points = self._server.scene, self.picked
        root = scene.add_frame("/measure", show_axes=False)  # removes its children
        for n, point in enumerate(points):
            scene.add_icosphere(f"{root.name}/{n}", self._size / 2, tuple(rgb(COLOUR).tolist()), position=point)
        self.text.content = FIRST if points else HOW
        if len(points) == 2:
            scene.add_line_segments("/measure/line", np.array([points]), rgb(COLOUR), thickness=4,
                                    thickness_units="screen")  # fmt: skip
            metres = float(np.linalg.norm(points[1] - points[0]))
            scene.add_label("/measure/label", f"{metres:.2f} m", position=np.mean(points, axis=0))
            self.text.content = format_distance(points)


def format_distance(points: list[NDArray[np.floating]]) -> str:
    """Format the distance of two points (3,) in metres as Markdown."""
    step = points[1] - points[0]
    along = ", ".join(f"{name} {value:+.2f}" for name, value in zip("xyz", step, strict=True))
    return f"**{np.linalg.norm(step):.2f} m** from centre to centre ({along})"


def first_hit(
    cells: NDArray[np.int32], size: float, origin: ArrayLike, direction: ArrayLike
) -> NDArray[np.int32] | None:
    """Return the first of the cells (N, 3) with sides of `size` metres that a ray hits, (3,); None if it hits none.

    origin, direction: (3,) in metres, world frame.
    """
    start, towards = np.asarray(origin, float), np.asarray(direction, float)
    towards = towards / np.linalg.norm(towards)
    low = cells * np.float32(size) - start.astype(np.float32)
    middle = low + np.float32(size / 2)
    ahead = middle @ towards.astype(np.float32)
    near = np.flatnonzero((np.einsum("ij,ij->i", middle, middle) - ahead**2 <= size**2) & (ahead > 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = np.stack([low[near], low[near] + size]) / towards
    enters, leaves = np.fmin(*faces).max(axis=1), np.fmax(*faces).min(axis=1)
    hit = near[(enters <= leaves) & (leaves > 0)]
    return cells[hit[np.argmin(ahead[hit])]] if len(hit) else None


SHARP_PX = 1024
"""Browsers blur enlarged images: a layer's longer side is sent with at least about half this many pixels."""
MAX_PX = 4096
"""Largest image side that every browser can draw; longer layers are thinned."""


class LayerPlane:
    """The plane and its controls.

    node: the scene's image, None before it is first shown. show: check box. across: drop-down of the axis that the
    plane is perpendicular to. at: for each axis a slider in metres, of which one is visible. scale, colours: the
    displayed numbers, and the mappable for their colour bar.
    """

    def __init__(self, server: ViserServer, voxel_map: VoxelMap, up: str):
        self.node: ImageHandle | None = None
        self.scale = scale_of(voxel_map)
        self.colours = layer_colours(self.scale)
        self._server, self._map, self._up, self._placed = server, voxel_map, up, False
        self.draw = Newest(self._draw)
        gui, size = server.gui, voxel_map.voxel_size
        with gui.add_folder("Slice plane"):
            self.show = gui.add_checkbox("show", False)
            self.across = gui.add_dropdown("across", ("x", "y", "z"), initial_value=up[-1])
            self.at = {name: gui.add_slider(f"{name} [m]", 0.0, 1.0, size, 0.0) for name in "xyz"}
        self.update(voxel_map)
        for control in (self.show, self.across, *self.at.values()):
            control.on_update(lambda _: self.draw())

    def update(self, voxel_map: VoxelMap) -> None:
        """Show another map with cells of the same size, which must no longer change."""
        self._map, bounds = voxel_map, voxel_map.bounds()
        if bounds is not None:
            for axis, slider in enumerate(self.at.values()):
                self._fit(slider, bounds[:, axis])
            if not self._placed:
                self._place(_first_place(voxel_map, self._up))
        self.draw()

    def _draw(self) -> None:
        """Move the plane according to the controls."""
        across = self.across.value
        for name, slider in self.at.items():
            slider.visible = name == across
        if self.show.value and self._placed:
            one = layer(self._map, across, self.at[across].value)
            image = self.colours.to_rgba(self.scale.shown(one.log_odds), bytes=True)
            self.node = add_plane(self._server, one, image)
        elif self.node is not None:
            self.node.visible = False

    def _fit(self, slider: Any, bounds: NDArray[np.float64]) -> None:
        """Set a slider's range from the centre of the lowest layer to the highest one's, one step per layer."""
        size = self._map.voxel_size
        low, high = (round(float(face), 6) for face in (bounds[0] + size / 2, bounds[1] - size / 2))
        slider.max = max(high, low + size)
        slider.min = low

    def _place(self, first: NDArray[np.float64]) -> None:
        size = self._map.voxel_size
        for slider, place in zip(self.at.values(), first, strict=True):
            steps = round((np.clip(place, slider.min, slider.max) - slider.min) / size)
            slider.value = round(slider.min + steps * size, 6)
        self._placed = True


def layer_colours(scale: Scale) -> Any:
    """Return matplotlib's colours of a scale's numbers; unknown cells are transparent."""
    from matplotlib.cm import ScalarMappable

    colours, norm = scale.colours()
    return ScalarMappable(norm, colours.with_extremes(bad=(0, 0, 0, 0)))


def add_plane(server: ViserServer, one: Layer, image: NDArray[np.uint8]) -> ImageHandle:
    """Add an image (rows, columns, 4) of a layer at its place in the world, at the centre of the cells."""
    from viser.transforms import SO3

    left, right, bottom, top = one.extent
    names = (*one.axes, one.across)
    middle = dict(zip(names, ((left + right) / 2, (bottom + top) / 2, one.at_m), strict=True))
    columns, rows = (np.eye(3)["xyz".index(name)] for name in one.axes)  # an image's columns run along x, rows along y
    turn = SO3.from_matrix(np.column_stack([columns, rows, np.cross(columns, rows)]))
    return server.scene.add_image(
        "/layer",
        sharp(image),
        right - left,
        top - bottom,
        wxyz=turn.wxyz,
        position=np.array([middle[name] for name in "xyz"]),
        cast_shadow=False,
        receive_shadow=False,
    )


def sharp(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W, 4) with its pixels repeated, so that cells stay sharp; too large ones are thinned."""
    longer = max(image.shape[:2])
    if longer > MAX_PX:
        step = -(-longer // MAX_PX)
        return image[::step, ::step]
    times = max(1, SHARP_PX // longer)
    return image.repeat(times, axis=0).repeat(times, axis=1)


def _first_place(voxel_map: VoxelMap, up: str) -> NDArray[np.float64]:
    """Return the initial values of the sliders, (3,) in metres: at the camera, or at the most informative layer."""
    if voxel_map.viewpoint is not None:
        return voxel_map.viewpoint.T_world_camera[:3, 3]
    cells = voxel_map.cells_in(State.OCCUPIED)
    cells = cells if len(cells) else voxel_map.cells()[0]
    drawn = stood_up(cells, np.full(len(cells), State.OCCUPIED, np.uint8), voxel_map.voxel_size, up)
    place = voxel_map.centers(cells.mean(axis=0)[None] - 0.5)[0]
    height = (drawn.layer + 0.5) * drawn.voxel_size
    place["xyz".index(up[-1])] = -height if up.startswith("-") else height
    return place
