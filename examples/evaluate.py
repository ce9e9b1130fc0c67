# SPDX-License-Identifier: Apache-2.0
"""Compare a map with the truth."""

import stereovox as sv
from stereovox.evaluate.scores import score

config = sv.load_config(voxel_size=0.5, **{"map.prior": 0.5})
cells = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0]]
truth = sv.VoxelMap.from_cells(config, cells, [-2, -2, 3, -2, 3])  # surfaces in cells 2 and 4
ours = sv.VoxelMap.from_cells(config, cells[:4], [-1.5, 2, -0.5, -1.5])  # one cell off, and cell 4 never observed

found = score(ours, truth, threshold=0.7, tolerance=1)
print(found.precision, found.recall)  # 0.0 0.0
print(found.tolerance_precision, found.tolerance_recall)  # 1.0 0.5
print(found.observed.tolerance_recall)  # 1.0: cell 4 does not count
print(found.as_dict())
assert (found.tp, found.fp, found.tn, found.fn) == (0, 1, 2, 2)
assert (found.tolerance_precision, found.tolerance_recall) == (1.0, 0.5)
