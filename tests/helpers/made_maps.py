# SPDX-License-Identifier: Apache-2.0
"""Tiny maps of random cells, and maps as plain tables."""

import numpy as np

from stereovox import VoxelMap, load_config

KINDS = {
    "int16": {},
    "int8": {"map.cell": "int8"},
    "uint8": {"map.cell": "uint8"},
    "uneven": {"steps": [0.1, 0.2, 0.05]},
    "up -y": {"up": "-y"},
    "wide": {"map.log_odds_min": -30.0, "map.log_odds_max": 30.0},
}


def random_map(seed=0, kind="int16", number=1500, low=-11, high=13, **more):
    """A map whose cells cross blocks on both sides of zero; some blocks are free throughout."""
    random = np.random.default_rng(seed)
    config = load_config(**{"voxel_size": 0.1, **KINDS[kind], **more})
    indices = np.unique(random.integers(low, high, (number, 3)), axis=0)
    log_odds = random.choice([-4, -2.5, -1.2, -0.2, 0.3, 1.2, 3.5], len(indices))
    free = np.argwhere(np.ones((8, 8, 8))) + np.array([8, 0, 0])
    return VoxelMap.from_cells(config, np.concatenate([indices, free]), np.append(log_odds, np.full(len(free), -30)))


def table(voxel_map):
    """{cell: log-odds} of all that is known."""
    return dict(zip(map(tuple, (c := voxel_map.cells())[0].tolist()), c[1].tolist(), strict=True))


def states(voxel_map):
    """{cell: state} of all that is known."""
    cells, _ = voxel_map.cells()
    return dict(zip(map(tuple, cells.tolist()), voxel_map.state(voxel_map.centers(cells)).tolist(), strict=True))
