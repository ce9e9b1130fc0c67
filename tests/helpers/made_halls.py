"""Small maps and poses in them."""

import numpy as np

from stereovox import VoxelMap, load_config

CELL = 0.1


def hall(occupied=(), unknown=(), tentative=(), size=6.0, height=1.5, up="z", doubt=-1.5):
    """A map, free within `size` metres of the origin and `height` up and down, but for boxes (low, high) in metres.

    doubt: log-odds of tentative cells.
    """
    config = load_config(voxel_size=CELL, up=up) if up != "z" else load_config(voxel_size=CELL)
    reach = np.array([size, size, size])
    upright = "xyz".index(up[-1])
    reach[upright] = height
    n = np.rint(reach / CELL).astype(int)
    cells = np.indices(2 * n).reshape(3, -1).T - n
    odds, keep = np.full(len(cells), -3.0), np.ones(len(cells), bool)
    centres = (cells + 0.5) * CELL
    for boxes, value in ((occupied, 3.0), (tentative, doubt), (unknown, None)):
        for low, high in boxes:
            inside = ((centres > low) & (centres < high)).all(axis=1)
            if value is None:
                keep &= ~inside
            else:
                odds[inside] = value
    return VoxelMap.from_cells(config, cells[keep], odds[keep])


def looking(yaw_deg, at=(0.0, 0.0, 0.0)):
    """T_world_body of a level body in a world with z up; yaw to the left of x. Optical axes."""
    yaw = np.radians(yaw_deg)
    T = np.eye(4)
    forward = np.array([np.cos(yaw), np.sin(yaw), 0])
    down = np.array([0, 0, -1.0])
    T[:3, :3] = np.column_stack([np.cross(down, forward), down, forward])
    T[:3, 3] = at
    return T
