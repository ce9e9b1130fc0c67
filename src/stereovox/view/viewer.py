# SPDX-License-Identifier: Apache-2.0
"""A map on a local page: cells, one layer, the cameras, measuring, and what the map holds."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any

from stereovox.maps import VoxelMap
from stereovox.view.address import HERE, PORT, find_address, url_of
from stereovox.view.drawn import checked_up
from stereovox.view.guard import Guard, checked_token, new_token
from stereovox.view.serve import serve, stop
from stereovox.view.viewer_camera import Cameras, as_tuple, first_look, up_vector
from stereovox.view.viewer_cells import Cells
from stereovox.view.viewer_layer import LayerPlane
from stereovox.view.viewer_measure import Measure
from stereovox.view.viewer_panel import axis_chart, colour_bar, plain, statistics

if TYPE_CHECKING:
    from viser import ViserServer


class Viewer:
    """A running page; url leads to it.

    cells, layer, cameras and measure hold what is in the scene and its controls; dark: the check box of the theme.
    """

    def __init__(self, url: str, server: ViserServer, voxel_map: VoxelMap, name: str, up: str):
        self.url, self.server = url, server
        self._name, self._map, self._up = name, voxel_map, up
        _dress(server)
        server.scene.set_up_direction(as_tuple(up_vector(up)))
        look_from, look_at = first_look(voxel_map, up)
        server.initial_camera.position, server.initial_camera.look_at = as_tuple(look_from), as_tuple(look_at)
        self.cells = Cells(server, voxel_map, up, look_from)
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

    def _tell(self) -> None:
        self._told.content = f"**{plain(self._name)}**\n\n{statistics(self._map)}"
        self._explain()

    def _explain(self) -> None:
        self._legend.explain(self.cells, self.layer)


class _Legend:
    """Colour bars for what is in the scene."""

    def __init__(self, server: ViserServer):
        self._server, self._said = server, ()
        self._folder = server.gui.add_folder("Legend")
        self._bars: list[Any] = []

    def explain(self, cells: Cells, plane: LayerPlane) -> None:
        """Put up the bars of the cells' colours, and of the layer where it is shown."""
        limits = None if cells.scale is None else (cells.scale.norm.vmin, cells.scale.norm.vmax)
        said = cells.label, limits, plane.show.value
        if said == self._said:
            return
        for bar in self._bars:
            bar.remove()
        images = [] if limits is None else [colour_bar(cells.scale, cells.label)]
        if plane.show.value:
            ends = plane.scale.lowest, plane.scale.highest
            images.append(colour_bar(plane.colours, f"in the slice: {plane.scale.label}", ends))
        with self._folder:
            self._bars = [self._server.gui.add_image(image, format="png") for image in images]
        self._said = said


def open_viewer(
    voxel_map: VoxelMap,
    name: str = "map",
    host: str = HERE,
    port: int = PORT,
    up: str | None = None,
    token: str | None = None,
) -> Viewer:
    """Serve a page of a map, under the heading `name`, until it is closed; port 0 takes any free one.

    up: the map's axis that points up (`z`, `-y`, ...); by default as its settings say.
    token: what a browser must show once, 16 to 128 letters, digits, - or _; `url` holds it. Where others reach `host`
    one is made if none is given; else whoever sits at this machine can look. Nobody can change or share the map.
    Raises MissingExtra without viser, and StereovoxError for an `up` that is no axis, for a short token, and where the
    address cannot be used.
    """
    up = checked_up(up or voxel_map.config.up)
    address = find_address(host, port)
    token = checked_token(token) if token is not None else None if address.is_private else new_token()
    server = serve(name.encode("utf-8", "replace").decode(), address, Guard(host, token))
    return Viewer(url_of(host, server.get_port(), token), server, voxel_map, name, up)


def _dress(server: Any) -> None:
    server.request_share_url = lambda *_, **__: None  # else any page in the browser could ask it to publish the map
    server.scene.configure_environment_map(hdri=None)  # its reflections make all heights look alike
    server.scene.add_light_ambient("/light", intensity=1.5)
    _theme(server, False)


def _theme(server: ViserServer, dark: bool) -> None:
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium", dark_mode=dark)
