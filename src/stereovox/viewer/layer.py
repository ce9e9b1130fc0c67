# SPDX-License-Identifier: Apache-2.0
"""One layer of cells in the viewer: a plane coloured by log-odds, moved through the map by sliders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.kernels.threads import Newest
from stereovox.maps import State, VoxelMap
from stereovox.products.floor_axes import Layer, layer
from stereovox.view.drawn import stood_up
from stereovox.view.layer import Scale, scale_of

if TYPE_CHECKING:
    from viser import ImageHandle, ViserServer

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
