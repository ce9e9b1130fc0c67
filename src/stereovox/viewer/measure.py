# SPDX-License-Identifier: Apache-2.0
"""Distance measurement in the viewer: two clicks on cells, a line between them, and its length."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.viewer.cells import Cells, rgb

if TYPE_CHECKING:
    from viser import ViserServer

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
