# SPDX-License-Identifier: Apache-2.0
"""A layer of cells in the viewer: a plane coloured by log-odds that sliders move through the map."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.maps import VoxelMap
from stereovox.products.slices import Layer, layer
from stereovox.view.drawn import Drawn

if TYPE_CHECKING:
    from viser import ImageHandle, ViserServer

SHARP_PX = 1024
"""Browsers blur enlarged images: a layer's longer side is sent with at least about half so many pixels."""
MOST_PX = 4096
"""Largest side of an image that every browser can draw; longer layers are thinned."""


class LayerPlane:
    """The plane, and the controls for it.

    node: the scene's image, None before it is first asked for. show: check box. across: drop-down with the axis
    that the plane stands across. at: for each axis a slider in metres, of which one is visible. scale: what a colour
    bar of log-odds needs.
    """

    def __init__(self, server: ViserServer, voxel_map: VoxelMap, drawn: Drawn):
        self.node: ImageHandle | None = None
        self.scale = log_odds_scale(voxel_map)
        self._server, self._map = server, voxel_map
        self._lock = threading.Lock()
        first = _first_place(voxel_map, drawn)
        bounds = voxel_map.bounds()
        if bounds is None:
            raise ValueError("an empty map has no layer")
        gui = server.gui
        with gui.add_folder("Layer"):
            self.show = gui.add_checkbox("show", False)
            self.across = gui.add_dropdown("across", ("x", "y", "z"), initial_value=drawn.names[2][-1])
            self.at = {name: self._slider(name, *bounds[:, axis], first[axis]) for axis, name in enumerate("xyz")}
        self.show.on_update(lambda _: self.draw())
        self.across.on_update(lambda _: self.draw())

    def draw(self) -> None:
        """Put the plane where the controls say."""
        with self._lock:  # viser calls back from many threads; the last one sees the controls' last values
            across = self.across.value
            for name, slider in self.at.items():
                slider.visible = name == across
            if self.show.value:
                self.node = add_plane(self._server, layer(self._map, across, self.at[across].value), self.scale)
            elif self.node is not None:
                self.node.visible = False

    def _slider(self, name: str, low: float, high: float, first: float) -> Any:
        """Return a slider with one step a layer: the middle of each layer between two faces of the map."""
        half = self._map.voxel_size / 2
        visible = name == self.across.value
        low, high = float(low + half), float(high - half)
        first = float(np.clip(first, low, high))
        slider = self._server.gui.add_slider(f"{name} [m]", low, high, 2 * half, first, visible=visible)
        slider.on_update(lambda _: self.draw())
        return slider


def log_odds_scale(voxel_map: VoxelMap) -> Any:
    """Return the colours of log-odds: blue where free, red where occupied, see-through where unknown."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import TwoSlopeNorm

    limits = voxel_map.config.map
    colours = colormaps["coolwarm"].with_extremes(bad=(0, 0, 0, 0))
    return ScalarMappable(TwoSlopeNorm(0.0, limits.log_odds_min, limits.log_odds_max), colours)


def add_plane(server: ViserServer, one: Layer, scale: Any) -> ImageHandle:
    """Add a layer as an image that lies in the world where its cells lie, at the middle of them."""
    from viser.transforms import SO3

    left, right, bottom, top = one.extent
    names = (*one.axes, one.across)
    middle = dict(zip(names, ((left + right) / 2, (bottom + top) / 2, one.at_m), strict=True))
    columns, rows = (np.eye(3)["xyz".index(name)] for name in one.axes)  # an image's columns run along x, rows along y
    turn = SO3.from_matrix(np.column_stack([columns, rows, np.cross(columns, rows)]))
    return server.scene.add_image(
        "/layer",
        sharp(scale.to_rgba(one.log_odds, bytes=True)),
        right - left,
        top - bottom,
        wxyz=turn.wxyz,
        position=np.array([middle[name] for name in "xyz"]),
        cast_shadow=False,
        receive_shadow=False,
    )


def sharp(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return an image (H, W, 4) with its pixels repeated, so that cells keep their edges; a too large one is thinned."""
    longer = max(image.shape[:2])
    if longer > MOST_PX:
        step = -(-longer // MOST_PX)
        return image[::step, ::step]
    times = max(1, SHARP_PX // longer)
    return image.repeat(times, axis=0).repeat(times, axis=1)


def _first_place(voxel_map: VoxelMap, drawn: Drawn) -> NDArray[np.float64]:
    """Return where the sliders begin, (3,) in metres: at the camera, or at the layer that tells most."""
    if voxel_map.viewpoint is not None:
        return voxel_map.viewpoint.T_world_camera[:3, 3]
    up = drawn.names[2]
    place = voxel_map.centers(voxel_map.cells()[0]).mean(axis=0)
    height = (drawn.layer + 0.5) * drawn.voxel_size
    place["xyz".index(up[-1])] = -height if up.startswith("-") else height
    return place
