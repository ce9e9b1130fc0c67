# SPDX-License-Identifier: Apache-2.0
"""A map on a local page: cells, one layer, the camera, the optical axis, and what the map holds."""

from __future__ import annotations

import threading
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stereovox.maps import VoxelMap
from stereovox.view.address import HERE, PORT, find_address, url_of
from stereovox.view.drawn import upright
from stereovox.view.guard import Guard, checked_token, new_token
from stereovox.view.serve import serve, stop
from stereovox.view.viewer_camera import add_camera, as_tuple, first_look, up_vector
from stereovox.view.viewer_cells import Cells
from stereovox.view.viewer_layer import LayerPlane
from stereovox.view.viewer_panel import axis_chart, colour_bar, plain, statistics

if TYPE_CHECKING:
    from viser import ViserServer


@dataclass(frozen=True, eq=False)
class Viewer:
    """A running page; url leads to it.

    cells and layer (None for an empty map) hold what is in the scene and its controls.
    """

    url: str
    server: ViserServer
    cells: Cells
    layer: LayerPlane | None

    def wait(self) -> None:
        """Do nothing until Ctrl-C, which raises KeyboardInterrupt as ever."""
        threading.Event().wait()

    def close(self) -> None:
        """Take the page down."""
        stop(self.server)


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
    drawn = upright(voxel_map, None, up or voxel_map.config.up)
    address = find_address(host, port)
    token = checked_token(token) if token is not None else None if address.is_private else new_token()
    server = serve(name.encode("utf-8", "replace").decode(), address, Guard(host, token))
    _dress(server)
    server.scene.set_up_direction(as_tuple(up_vector(drawn.names[2])))
    look_from, look_at = first_look(voxel_map, drawn)
    server.initial_camera.position, server.initial_camera.look_at = as_tuple(look_from), as_tuple(look_at)
    cells = Cells(server, voxel_map, drawn)
    plane = LayerPlane(server, voxel_map, drawn) if len(drawn.cells) else None
    _legend(server, cells, plane, drawn.names[2])
    if voxel_map.viewpoint is not None:
        add_camera(server, voxel_map.viewpoint, voxel_map.config.max_range)
        with server.gui.add_folder("Optical axis"):
            server.gui.add_image(axis_chart(voxel_map), format="png")
    with server.gui.add_folder("Map"):
        server.gui.add_markdown(f"**{plain(name)}**\n\n{statistics(voxel_map)}")
    return Viewer(url_of(host, server.get_port(), token), server, cells, plane)


def _dress(server: Any) -> None:
    server.request_share_url = lambda *_, **__: None  # else any page in the browser could ask it to publish the map
    server.scene.configure_environment_map(hdri=None)  # its reflections make all heights look alike
    server.scene.add_light_ambient("/light", intensity=1.5)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")


def _legend(server: ViserServer, cells: Cells, plane: LayerPlane | None, up: str) -> None:
    with server.gui.add_folder("Legend"):
        if cells.scale is not None:
            server.gui.add_image(colour_bar(cells.scale, f"height of occupied cells {up} [m]"), format="png")
        if plane is not None:
            label, ends = f"in the layer: {plane.scale.label}", (plane.scale.lowest, plane.scale.highest)
            server.gui.add_image(colour_bar(plane.colours, label, ends), format="png")
