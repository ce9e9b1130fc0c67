# SPDX-License-Identifier: Apache-2.0
"""Read a saved map without stereovox, by a Zarr library: python examples/read_by_zarr.py"""

import json
from pathlib import Path

import numpy as np
import zarr

import stereovox as sv

sv.VoxelMap.from_cells(sv.load_config(voxel_size=0.1), [[-1, 0, 9]], [2.0]).save("one.svox")  # something to read

folder = Path("one.svox")
manifest = json.loads((folder / "manifest.json").read_text())
group = zarr.open_group(folder / manifest["data"], mode="r")
coords, cells = group["coords"][:], group["cells"][:]
block, column = np.nonzero(cells)
indices = coords[block] * 8 + np.stack([column >> 6, column >> 3 & 7, column & 7], axis=1)
log_odds = cells[block, column] / 1000
centres = (indices + 0.5) * manifest["config"]["voxel_size"]
print(indices, log_odds, centres)
