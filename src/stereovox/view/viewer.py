# SPDX-License-Identifier: Apache-2.0
"""A map on a local page: cells, one layer, the camera, the optical axis, and what the map holds."""

from __future__ import annotations

import errno
import io
import socket
import threading
from contextlib import redirect_stdout
from dataclasses import dataclass
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.maps import VoxelMap
from stereovox.view.drawn import upright
from stereovox.view.viewer_camera import add_camera, as_tuple, first_look, up_vector
from stereovox.view.viewer_cells import Cells
from stereovox.view.viewer_layer import LayerPlane
from stereovox.view.viewer_panel import axis_chart, colour_bar, plain, statistics

if TYPE_CHECKING:
    from viser import ViserServer

HERE, PORT = "127.0.0.1", 8080


@dataclass(frozen=True, eq=False)
class Viewer:
    """A running page. cells and layer (None for an empty map) hold what is in the scene and its controls."""

    url: str
    server: ViserServer
    cells: Cells
    layer: LayerPlane | None

    def wait(self) -> None:
        """Do nothing until Ctrl-C, which raises KeyboardInterrupt as ever."""
        threading.Event().wait()

    def close(self) -> None:
        """Take the page down."""
        with redirect_stdout(io.StringIO()):  # viser says goodbye there
            self.server.stop()


def open_viewer(
    voxel_map: VoxelMap, name: str = "map", host: str = HERE, port: int = PORT, up: str | None = None
) -> Viewer:
    """Serve a page of a map, under the heading `name`, until it is closed; port 0 takes any free one.

    up: the map's axis that points up (`z`, `-y`, ...); by default as its settings say.
    Whoever reaches `host` can look, but nobody can change or share the map. Raises MissingExtra without viser, and
    StereovoxError for an `up` that is no axis and where the address cannot be used.
    """
    drawn = upright(voxel_map, None, up or voxel_map.config.up)
    server = _serve(name.encode("utf-8", "replace").decode(), host, port)
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
    return Viewer(url_of(host, server.get_port()), server, cells, plane)


def url_of(host: str, port: int) -> str:
    """Return the address of a page; one that is served to everybody is found at localhost."""
    host = "localhost" if host in ("0.0.0.0", "::") else host
    return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"


def is_private(host: str) -> bool:
    """Tell whether only this machine can reach `host`."""
    try:
        return all(ip_address(one[4][0]).is_loopback for one in socket.getaddrinfo(host, None))
    except OSError:
        return False


def check_address(host: str, port: int) -> None:
    """Raise StereovoxError where no page can be served at an address; viser would take another or wait for ever."""
    if not 0 <= port <= 65535:
        raise StereovoxError(f"port {port} does not exist; give one from 0 to 65535")
    place = f"{host}:{port}"
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will
            probe.bind(address)
    except OSError as error:
        cures = {
            errno.EADDRINUSE: "in use; give another one (--port 8081), or --port 0 for any that is free",
            errno.EACCES: "reserved; give one above 1023",
        }
        if error.errno in cures:
            raise StereovoxError(f"{place}: this port is {cures[error.errno]}") from None
        why = error.strerror or error
        raise StereovoxError(f"{place}: no address of this machine ({why}); leave --host out to serve {HERE}") from None


def _serve(name: str, host: str, port: int) -> ViserServer:
    try:
        import viser
    except ImportError:
        raise MissingExtra("viser", "viewer") from None
    check_address(host, port)
    with redirect_stdout(io.StringIO()):  # viser introduces itself there
        server: Any = viser.ViserServer(host=host, port=port, label=name, verbose=False)
    server.request_share_url = lambda *_, **__: None  # else any page in the browser could ask it to publish the map
    server.scene.configure_environment_map(hdri=None)  # its reflections make all heights look alike
    server.scene.add_light_ambient("/light", intensity=1.5)
    server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="medium")
    if port and server.get_port() != port:  # somebody took it in the meantime
        server.stop()
        raise StereovoxError(f"{host}:{port}: this port is in use; give another one (--port {port + 1})")
    return server


def _legend(server: ViserServer, cells: Cells, plane: LayerPlane | None, up: str) -> None:
    with server.gui.add_folder("Legend"):
        if cells.scale is not None:
            server.gui.add_image(colour_bar(cells.scale, f"height of occupied cells {up} [m]"), format="png")
        if plane is not None:
            label, ends = f"in the layer: {plane.scale.label}", (plane.scale.lowest, plane.scale.highest)
            server.gui.add_image(colour_bar(plane.colours, label, ends), format="png")
