# SPDX-License-Identifier: Apache-2.0
"""A map on a local page: cells, one layer, the cameras, measuring, and what the map holds."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.maps import VoxelMap
from stereovox.view.drawn import checked_up
from stereovox.viewer.cameras import Cameras, as_tuple, first_look, up_vector
from stereovox.viewer.cells import Cells
from stereovox.viewer.chunks import MAX_CELLS
from stereovox.viewer.layer import LayerPlane
from stereovox.viewer.measure import Measure
from stereovox.viewer.panel import axis_chart, colour_bar, plain, statistics
from stereovox.viewer.serve import HERE, PORT, Guard, checked_token, find_address, new_token, serve, stop, url_of

if TYPE_CHECKING:
    from viser import ViserServer

GROWN, ASIDE, MOVED = 1.2, 0.1, 0.01
"""The page looks anew at a map that grew by so much, or whose middle went aside by such a share of the distance, if a
looker moved by less than the last."""


class Viewer:
    """A running page; url leads to it.

    cells, layer, cameras and measure hold what is in the scene and its controls; dark: the check box of the theme.
    """

    def __init__(self, url: str, server: ViserServer, voxel_map: VoxelMap, name: str, up: str, most_cells: int):
        self.url, self.server = url, server
        self._name, self._map, self._up = name, voxel_map, up
        _dress(server)
        server.scene.set_up_direction(as_tuple(up_vector(up)))
        self._eye, self._middle, self._away = np.zeros(3), np.zeros(3), 0.0
        self.follow()
        self.cells = Cells(server, voxel_map, up, most_cells)
        self._legend = _Legend(server)
        self.layer = LayerPlane(server, voxel_map, up)
        self.cameras = Cameras(server, voxel_map)
        self.measure = Measure(server, self.cells, voxel_map.voxel_size)
        with server.gui.add_folder("Map"):
            self._told = server.gui.add_markdown("")
            self.dark = server.gui.add_checkbox("dark page", False)
        self.dark.on_update(lambda _: _theme(server, self.dark.value))
        for control in (self.cells.colour, self.layer.show):
            control.on_update(lambda _: self._explain())
        self._tell()
        if voxel_map.viewpoint is not None:
            with server.gui.add_folder("Optical axis", expand_by_default=False):
                server.gui.add_image(axis_chart(voxel_map), format="png")

    def take(self, voxel_map: VoxelMap) -> None:
        """Show another map with the same settings, which nobody changes from now on: a copy of one that grows."""
        self._map = voxel_map
        for part in (self.cells, self.layer, self.cameras):
            part.take(voxel_map)
        self._tell()

    def wait(self) -> None:
        """Do nothing until Ctrl-C, which raises KeyboardInterrupt as ever."""
        threading.Event().wait()

    def close(self) -> None:
        """Take the page down."""
        stop(self.server)

    def follow(self) -> None:
        """Let those who look see the whole map when it has grown, unless they went to look from elsewhere."""
        look_from, look_at = first_look(self._map, self._up)
        away = float(np.linalg.norm(look_from - look_at))
        moved = float(np.linalg.norm(look_at - self._middle))
        if away < GROWN * self._away and moved < ASIDE * self._away:
            return
        cameras = [client.camera for client in self.server.get_clients().values()]
        if self._away:
            cameras = [one for one in cameras if np.linalg.norm(one.position - self._eye) < MOVED * self._away]
        self._eye, self._middle, self._away = look_from, look_at, away
        for camera in (self.server.initial_camera, *cameras):
            camera.position, camera.look_at = as_tuple(look_from), as_tuple(look_at)

    def _tell(self) -> None:
        self._told.content = f"**{plain(self._name)}**\n\n{statistics(self._map)}"
        self._explain()

    def _explain(self) -> None:
        self._legend.explain(self.cells, self.layer)


class _Legend:
    """Colour bars for what is in the scene."""

    def __init__(self, server: ViserServer):
        blank = np.full((1, 1, 3), 255, np.uint8)
        with server.gui.add_folder("Legend"):
            self._cells, self._slice = (server.gui.add_image(blank, format="png", visible=False) for _ in range(2))
        self._said: Any = None

    def explain(self, cells: Cells, plane: LayerPlane) -> None:
        """Put up the bars of the cells' colours, and of the layer where it is shown."""
        limits = None if cells.scale is None else (cells.scale.norm.vmin, cells.scale.norm.vmax)
        self._slice.visible = plane.show.value
        if self._said is None:
            ends = plane.scale.lowest, plane.scale.highest
            self._slice.image = colour_bar(plane.colours, f"in the slice: {plane.scale.label}", ends)
        if limits is not None and self._said != (cells.label, limits):
            self._cells.image, self._cells.visible = colour_bar(cells.scale, cells.label), True
        self._said = cells.label, limits


def open_viewer(
    voxel_map: VoxelMap,
    name: str = "map",
    host: str = HERE,
    port: int = PORT,
    up: str | None = None,
    token: str | None = None,
    most_cells: int = MAX_CELLS,
) -> Viewer:
    """Serve a page of a map, under the heading `name`, until it is closed; port 0 takes any free one.

    up: the map's axis that points up (`z`, `-y`, ...); by default as its settings say.
    token: what a browser must show once, 16 to 128 letters, digits, - or _; `url` holds it. Where others reach `host`
    one is made if none is given; else whoever sits at this machine can look. Nobody can change or share the map.
    most_cells: of each kind, about, that are drawn at once; where a map has more, far ones are drawn coarser. Fewer are
    for browsers without a graphics card.
    Raises MissingExtra without viser, and StereovoxError for an `up` that is no axis, for a short token, for no cells
    at all, and where the address cannot be used.
    """
    if most_cells < 1:
        raise StereovoxError(f"{most_cells} cells at once: give a number above 0, 250000 for most browsers")
    up = checked_up(up or voxel_map.config.up)
    address = find_address(host, port)
    token = checked_token(token) if token is not None else None if address.is_private else new_token()
    server = serve(name.encode("utf-8", "replace").decode(), address, Guard(host, token))
    return Viewer(url_of(host, server.get_port(), token), server, voxel_map, name, up, most_cells)


def _dress(server: Any) -> None:
    server.request_share_url = lambda *_, **__: None  # else any page in the browser could ask it to publish the map
    server.scene.configure_environment_map(hdri=None)  # its reflections make all heights look alike
    server.scene.add_light_ambient("/light", intensity=1.5)
    _theme(server, False)


def _theme(server: ViserServer, dark: bool) -> None:
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", dark_mode=dark)
