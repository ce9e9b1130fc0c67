# SPDX-License-Identifier: Apache-2.0
"""Viewer of a map on a local page: cells, one layer, cameras, distance measurement, statistics."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.products.floor_axes import upright_axes
from stereovox.view.drawn import checked_up
from stereovox.viewer.cameras import Cameras, as_tuple, first_look, up_vector
from stereovox.viewer.cells import MAX_CELLS, Cells
from stereovox.viewer.panel import LayerPlane, Measure, axis_chart, colour_bar, plain, statistics
from stereovox.viewer.serve import HERE, PORT, Guard, checked_token, find_address, new_token, serve, stop, url_of

if TYPE_CHECKING:
    from viser import ClientHandle, ViserServer

GROWTH, SHIFT, MOVED = 1.2, 0.1, 0.01
"""A viewpoint follows a map that grew by this factor, or whose centre shifted by this share of the distance, unless the
user moved it by more than the last share."""


AMBIENT = 1.1
LIGHTS = ((-0.35, -0.6, 1.0, 2.2), (0.8, 0.35, 0.25, 0.7))
"""Right, away and up components of the lights' directions, and their intensity."""
PEEK = """<style>
@media (max-width: 36em) {
  div[style*="position: fixed"][style*="width: 20em"] { width: 100% !important; max-height: 11em !important; }
  div[style*="position: fixed"][style*="width: 20em"]:is(:hover, :focus-within) { max-height: 60% !important; }
  div[style*="position: fixed"] div[style*="width: 20em"] { width: 100% !important; }
}
</style>"""
"""On a phone, where the controls cover the map, they show little more than the colour bar until touched."""


WIDE_ENOUGH = 0.8
"""Width over height of a page that shows a whole map from the usual distance."""
BEFORE = (3.0, 3.0, 3.0)
"""Camera position of a page before it receives the initial viewpoint."""
NARROW_PX = 480
"""Narrower maps have no room for the controls next to them."""


class Viewer:
    """A running page, made by `open_viewer`.

    Attributes:
        url: Link to the page.
        server: The viser server behind it.
        cells: Cells in the scene and their controls.
        layer: Plane of one layer and its controls.
        cameras: Cameras in the scene and their controls.
        measure: Distance measurement.
        dark: Check box of the dark theme.
    """

    def __init__(self, url: str, server: ViserServer, voxel_map: VoxelMap, name: str, up: str, most_cells: int):
        self.url, self.server = url, server
        self._name, self._map, self._up = name, voxel_map, up
        _dress(server)
        server.scene.set_up_direction(as_tuple(up_vector(voxel_map, up)))
        _light(server, up)
        self._eye, self._middle, self._distance = np.zeros(3), np.zeros(3), 0.0
        self.follow()
        server.on_client_connect(self._welcome)
        self.cells = Cells(server, voxel_map, up, most_cells)
        self._legend = _Legend(server)
        self.layer = LayerPlane(server, voxel_map, up)
        self.cameras = Cameras(server, voxel_map)
        self.measure = Measure(server, self.cells, voxel_map.voxel_size)
        with server.gui.add_folder("Map"):
            self._statistics = server.gui.add_markdown("")
            self.dark = server.gui.add_checkbox("dark page", False)
        self.dark.on_update(lambda _: _theme(server, self.dark.value))
        for control in (self.cells.colour, self.layer.show):
            control.on_update(lambda _: self._explain())
        self._show_statistics()
        if voxel_map.viewpoint is not None:
            with server.gui.add_folder("Optical axis", expand_by_default=False):
                server.gui.add_image(axis_chart(voxel_map), format="png")

    def update(self, voxel_map: VoxelMap) -> None:
        """Show another map with the same settings.

        Args:
            voxel_map: The map, which must no longer change: pass a copy of a growing one.
        """
        self._map = voxel_map
        for part in (self.cells, self.layer, self.cameras):
            part.update(voxel_map)
        self._show_statistics()

    def wait(self) -> None:
        """Block until Ctrl-C.

        Raises:
            KeyboardInterrupt: Ctrl-C.
        """
        threading.Event().wait()

    def close(self) -> None:
        """Close the page."""
        stop(self.server)

    def follow(self) -> None:
        """Move the viewpoints to show the whole map after it has grown, except those that users have moved."""
        look_from, look_at = first_look(self._map, self._up)
        distance = float(np.linalg.norm(look_from - look_at))
        moved = float(np.linalg.norm(look_at - self._middle))
        if distance < GROWTH * self._distance and moved < SHIFT * self._distance:
            return
        cameras = [client.camera for client in self.server.get_clients().values()]
        if self._distance:
            near = MOVED * self._distance
            cameras = [one for one in cameras if np.linalg.norm(one.position - self._stand(one.aspect)) < near]
        self._eye, self._middle, self._distance = look_from, look_at, distance
        self.server.initial_camera.position, self.server.initial_camera.look_at = as_tuple(look_from), as_tuple(look_at)
        for camera in cameras:
            camera.position, camera.look_at = as_tuple(self._stand(camera.aspect)), as_tuple(look_at)

    def _stand(self, aspect: float) -> NDArray[np.float64]:
        """Return the viewpoint (3,) in metres for a page of this width over height: narrow ones are farther off."""
        return self._middle + (self._eye - self._middle) * max(1.0, WIDE_ENOUGH / max(aspect, 0.1))

    def _welcome(self, client: ClientHandle) -> None:
        """Show a new visitor with a small screen the whole map, with the controls folded away."""
        camera = client.camera
        if camera.image_width < NARROW_PX:
            client.gui.main_panel.minimize()
        new = min(np.linalg.norm(camera.position - place) for place in (self._eye, BEFORE)) < MOVED * self._distance
        if new and camera.aspect < WIDE_ENOUGH:
            camera.position, camera.look_at = as_tuple(self._stand(camera.aspect)), as_tuple(self._middle)

    def _show_statistics(self) -> None:
        self._statistics.content = f"**{plain(self._name)}**\n\n{statistics(self._map)}"
        self._explain()

    def _explain(self) -> None:
        self._legend.explain(self.cells, self.layer)


class _Legend:
    """Colour bars for the scene."""

    def __init__(self, server: ViserServer):
        blank = np.full((1, 1, 3), 255, np.uint8)
        with server.gui.add_folder("Legend", order=0.2):
            self._cells, self._slice = (server.gui.add_image(blank, format="png", visible=False) for _ in range(2))
        self._explained: Any = None

    def explain(self, cells: Cells, plane: LayerPlane) -> None:
        """Update the colour bars of the cells, and of the layer if it is shown."""
        limits = None if cells.scale is None else (cells.scale.norm.vmin, cells.scale.norm.vmax)
        self._slice.visible = plane.show.value
        if self._explained is None:
            ends = plane.scale.lowest, plane.scale.highest
            self._slice.image = colour_bar(plane.colours, f"in the slice: {plane.scale.label}", ends)
        if limits is not None and self._explained != (cells.label, limits):
            self._cells.image, self._cells.visible = colour_bar(cells.scale, cells.label), True
        self._explained = cells.label, limits


def open_viewer(
    voxel_map: VoxelMap,
    name: str = "map",
    host: str = HERE,
    port: int = PORT,
    up: str | None = None,
    token: str | None = None,
    most_cells: int = MAX_CELLS,
) -> Viewer:
    """Serve a page that shows a map, until it is closed. Visitors cannot change or share the map.

    Args:
        voxel_map: The map, which must not change while it is shown.
        name: Heading of the page.
        host: Name or address to serve at; by default only this machine can reach it.
        port: Port of the page; 0: any free one.
        up: The map's axis that points up (`z`, `-y`, ...); None: from its settings.
        token: Secret that a browser must send once, 16 to 128 letters, digits, - or _; it is part of `Viewer.url`.
            None: a random one if other machines can reach `host`, else none.
        most_cells: Approximate number of cells of each kind drawn at once; beyond it, far ones are drawn coarser.
            Choose fewer for browsers without a GPU.

    Returns:
        The running page.

    Raises:
        MissingExtra: viser is not installed.
        StereovoxError: Invalid `up`, `token` or `most_cells`, or an unusable address.
    """
    if most_cells < 1:
        raise StereovoxError(f"{most_cells} cells at once: give a number above 0, 250000 for most browsers")
    up, voxel_map = checked_up(up or voxel_map.config.up), voxel_map.overview()
    address = find_address(host, port)
    token = checked_token(token) if token is not None else None if address.is_private else new_token()
    server = serve(name.encode("utf-8", "replace").decode(), address, Guard(host, token))
    return Viewer(url_of(host, server.get_port(), token), server, voxel_map, name, up, most_cells)


def _dress(server: Any) -> None:
    server.request_share_url = lambda *_, **__: None  # else any page in the browser could ask it to publish the map
    server.scene.configure_environment_map(hdri=None)  # its reflections hide height colours
    server.gui.main_panel.dock_right()  # next to the map, not over it
    server.gui.add_html(PEEK)
    _theme(server, False)


def _light(server: ViserServer, up: str) -> None:
    """Light the sides of cells differently, so that shapes show; the lights of the page itself bleach colours."""
    server.scene.configure_default_lights(False)
    server.scene.add_light_ambient("/light/ambient", intensity=AMBIENT)
    right, away, upwards = upright_axes(up)
    for n, (x, y, z, intensity) in enumerate(LIGHTS):
        place = x * right + y * away + z * upwards
        server.scene.add_light_directional(f"/light/{n}", intensity=intensity, position=as_tuple(place))


def _theme(server: ViserServer, dark: bool) -> None:
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", dark_mode=dark)
