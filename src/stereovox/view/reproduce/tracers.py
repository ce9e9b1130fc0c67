# SPDX-License-Identifier: Apache-2.0
"""Which cells the two ray tracers update (Chien 2020, Fig 3.10)."""

from __future__ import annotations

import numpy as np

from stereovox.evaluate.cells import indices
from stereovox.evaluate.reproduce.tracers import Comparison
from stereovox.view.panels import measured, title
from stereovox.view.reproduce.shared import figure_of, png


def tracers_png(found: Comparison, size: float) -> bytes:
    """Return which cells of one frame, in the layer at the camera's height, are updated by both tracers or one."""
    from matplotlib.patches import Patch

    figure = figure_of(5.2)
    axis = figure.add_subplot()
    height = int(np.floor(found.eye[1] / size))
    layers = {name: indices(cells)[indices(cells)[:, 1] == height][:, [0, 2]] for name, cells in found.updated.items()}
    low = np.min([cells.min(0) for cells in layers.values()], axis=0)
    shape = np.max([cells.max(0) for cells in layers.values()], axis=0) - low + 1
    image = np.zeros(shape, int)
    for bit, cells in zip((1, 2), layers.values(), strict=True):
        image[tuple((cells - low).T)] |= bit
    colours = np.array([[255, 255, 255], [209, 96, 61], [35, 97, 140], [216, 221, 229]], np.uint8)
    extent = np.stack([low, low + shape]).T.ravel() * size
    axis.imshow(colours[image.T], origin="lower", extent=tuple(extent), interpolation="nearest")
    names = ("both", "only voxel traversal", "only line drawing")
    patches = [Patch(fc=colours[n] / 255, ec="#888", label=name) for n, name in zip((3, 1, 2), names, strict=True)]
    axis.legend(handles=patches, frameon=False, loc="upper left", bbox_to_anchor=(1, 1))
    title(axis, "Cells that one frame updates, layer at the camera's height, 8x8")
    measured(axis, ("x", "z", "y"))
    return png(figure)
