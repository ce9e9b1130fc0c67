# SPDX-License-Identifier: Apache-2.0
"""Cameras in the viewer: the last one, their path, closed loops, and the initial viewpoint of the page."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.frame import Viewpoint
from stereovox.maps import State, VoxelMap
from stereovox.maps.record.camera_path import LoopLines
from stereovox.products.floor_axes import upright_axes
from stereovox.view.drawn import UPS, checked_up, field_of_view
from stereovox.view.figures import PATH_COLOUR
from stereovox.view.loops import CLOSED, REFUSED
from stereovox.view.space import ABOVE_DEG, BEHIND_DEG
from stereovox.viewer.cells import rgb

if TYPE_CHECKING:
    from viser import FrameHandle, ViserServer

AXES_M = 0.3
FAR = 0.8
"""Initial distance of the viewpoint from the centre of the map, in diagonals of the map."""
FRUSTUM_M = 0.15
"""Depth of the small fields of view along the path."""
MAX_FRUSTA = 60
FRUSTA_COLOUR = "#2a78c2"
LOOPS_HINT = "lines between places that were recognised as one (green), or look alike but were rejected (red)"


class Cameras:
    """The last camera, the path of all cameras, fields of view along it, loops, and their check boxes.

    The box of loops exists if the map has some.
    """

    def __init__(self, server: ViserServer, voxel_map: VoxelMap):
        self._server, self._map = server, voxel_map
        self._roots = {
            name: server.scene.add_frame(f"/{name}", show_axes=False) for name in ("path", "frusta", "loops")
        }
        with server.gui.add_folder("Camera"):
            self.last = server.gui.add_checkbox("last view", True)
            self.path = server.gui.add_checkbox("path", True)
            self.frusta = server.gui.add_checkbox("views along the path", False)
            self.loops = server.gui.add_checkbox("loops", True, hint=LOOPS_HINT)
        for box in (self.last, self.path, self.frusta, self.loops):
            box.on_update(lambda _: self._draw())
        self._drawn: FrameHandle | None = None
        self.update(voxel_map)

    def update(self, voxel_map: VoxelMap) -> None:
        """Show the cameras of another map, which must no longer change."""
        self._map = voxel_map
        viewpoint = voxel_map.viewpoint
        if viewpoint is not None:
            self._drawn = add_camera(self._server, viewpoint, voxel_map.config.max_range)
        add_path(self._server, voxel_map)
        self.loops.visible = voxel_map.history.loops is not None
        add_loops(self._server, voxel_map)
        self._draw()

    def _draw(self) -> None:
        if self._drawn is not None:
            self._drawn.visible = self.last.value
        self._roots["path"].visible, self._roots["frusta"].visible = self.path.value, self.frusta.value
        self._roots["loops"].visible = self.loops.value
        if self.frusta.value:
            add_frusta(self._server, self._map)


def add_camera(server: ViserServer, viewpoint: Viewpoint, reach_m: float) -> FrameHandle:
    """Add the camera's axes, its field of view (Chien 2020, Fig 4.7) and its optical axis up to `reach_m` metres."""
    from viser.transforms import SO3

    T = viewpoint.T_world_camera
    axes = server.scene.add_frame(
        "/camera", axes_length=AXES_M, axes_radius=AXES_M / 30, wxyz=SO3.from_matrix(T[:3, :3]).wxyz, position=T[:3, 3]
    )
    local = field_of_view(viewpoint._replace(T_world_camera=np.eye(4)))
    red = rgb(PATH_COLOUR)
    server.scene.add_line_segments("/camera/field_of_view", local, red, thickness=3, thickness_units="screen")
    axis = np.array([[[0, 0, 0], [0, 0, reach_m]]], float)
    server.scene.add_line_segments("/camera/optical_axis", axis, red, thickness=1, thickness_units="screen")
    return axes


def add_path(server: ViserServer, voxel_map: VoxelMap) -> None:
    """Add a line along the path of each sensor; remove paths that the map no longer has."""
    lines = [np.stack([line[:-1], line[1:]], axis=1) for line in voxel_map.history.path.lines()]
    _add_lines(server, "/path/line", np.concatenate([np.empty((0, 2, 3)), *lines]), PATH_COLOUR)


def add_loops(server: ViserServer, voxel_map: VoxelMap) -> None:
    """Add lines between the places of closed and of refused loops; remove lines that the map no longer has."""
    loops = voxel_map.history.loops or LoopLines()
    for name, lines, colour in (("closed", loops.closed, CLOSED), ("refused", loops.refused, REFUSED)):
        _add_lines(server, f"/loops/{name}", lines.ends, colour)


def add_frusta(server: ViserServer, voxel_map: VoxelMap) -> None:
    """Add small fields of view along the path, all with the optics of the last camera."""
    stops, viewpoint = voxel_map.history.path.until(), voxel_map.viewpoint
    if viewpoint is None or not stops:
        return _remove(server, "/frusta/views")
    some = stops[:: -(-len(stops) // MAX_FRUSTA)]
    lines = [field_of_view(viewpoint._replace(T_world_camera=pose), FRUSTUM_M) for _, pose in some]
    server.scene.add_line_segments(
        "/frusta/views", np.concatenate(lines), rgb(FRUSTA_COLOUR), thickness=1.5, thickness_units="screen"
    )


def _add_lines(server: ViserServer, name: str, segments: NDArray[np.float64], colour: str) -> None:
    """Add line segments (N, 2, 3), or remove them if there are none."""
    if len(segments):
        server.scene.add_line_segments(name, segments, rgb(colour), thickness=3, thickness_units="screen")
    else:
        _remove(server, name)


def _remove(server: ViserServer, name: str) -> None:
    node = server.scene.get_handle_by_name(name)
    if node is not None:
        node.remove()


def first_look(voxel_map: VoxelMap, up: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the initial viewpoint of the page and its target: (3,) each in metres.

    It looks from behind and above the depth camera at the centre of camera and occupied cells, or of all cells
    if none is occupied; a few far outliers are ignored.
    """
    cells = voxel_map.cells_in(State.OCCUPIED)
    centres = voxel_map.centers(cells if len(cells) else voxel_map.cells()[0])
    if not len(centres):
        return np.array([3.0, 3.0, 3.0]), np.zeros(3)
    low, high = np.percentile(centres, [0.5, 99.5], axis=0)
    upwards = up_vector(voxel_map, up)
    back = -np.eye(3)[UPS[up][1]]
    if voxel_map.viewpoint is not None:
        T = voxel_map.viewpoint.T_world_camera
        low, high, behind = np.minimum(low, T[:3, 3]), np.maximum(high, T[:3, 3]), -T[:3, 2]
        level = behind - (behind @ upwards) * upwards
        back = level / np.linalg.norm(level) if np.linalg.norm(level) > 0.1 else back  # it may look straight down
    aside, above = np.radians(BEHIND_DEG), np.radians(ABOVE_DEG)
    level = np.cos(aside) * back + np.sin(aside) * np.cross(upwards, back)
    look_at = (low + high) / 2
    distance = max(FAR * float(np.linalg.norm(high - low)), 1.0)
    return look_at + distance * (np.cos(above) * level + np.sin(above) * upwards), look_at


def up_vector(voxel_map: VoxelMap, up: str) -> NDArray[np.float64]:
    """Return the unit vector (3,) that points up: the map's own if it is nearest to the axis `up`, else the axis."""
    config = voxel_map.config
    if config.up_direction is not None and checked_up(config.up) == up:
        return np.array(config.up_direction)
    return upright_axes(up)[2]


def as_tuple(vector: ArrayLike) -> tuple[float, float, float]:
    """Return a vector (3,) as three floats."""
    x, y, z = (float(value) for value in np.asarray(vector))
    return x, y, z
