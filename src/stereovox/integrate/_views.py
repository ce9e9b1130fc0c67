# SPDX-License-Identifier: Apache-2.0
"""Kernel that sets up the view of a camera at its pose; in float64, once a frame."""

import numpy as np

from stereovox._jit import kernel


@kernel
def aim(T_world_camera, cell, side, intrinsics, size, rim, centres, block, rotation, forward, position, sides, steps):
    """Fill block, rotation, forward, position, sides and steps of a `View` for the pose (4, 4).

    cell: (3,) sides of a cell in metres; where they differ, the world is stretched to make cells cubes of `side`.
    intrinsics: fx, fy, cx, cy. size: (2,) width, height. rim: (2,) pixels times depth. centres: (3, 512) of the cells
    of a block, in cells. block: (3,) int32, that the camera stands in, of 8 cells a side.
    """
    for a in range(3):
        block[a] = np.int32(np.floor(T_world_camera[a, 3] / (8 * cell[a])))
        stretch = side / cell[a]
        position[a] = stretch * (T_world_camera[a, 3] - 8 * cell[a] * block[a])
        for b in range(3):
            rotation[b, a] = T_world_camera[a, b] / stretch
            forward[b, a] = T_world_camera[a, b] * stretch
    for s in range(4):  # seen: fx x + (cx + 0.5) z + rim >= 0, and the like for the other three sides
        axis, sign = s >> 1, 1.0 - 2.0 * (s & 1)
        focal, centre = intrinsics[axis], intrinsics[2 + axis]
        room = centre + 0.5 if sign > 0 else size[axis] - 0.5 - centre
        unit_box = 0.0
        for a in range(3):
            stretch = side / cell[a]
            normal = (sign * focal * T_world_camera[a, axis] + room * T_world_camera[a, 2]) / stretch
            sides[s, a] = normal
            unit_box += abs(normal)
        sides[s, 3] = unit_box
        sides[s, 4] = rim[axis] + 1e-3 * max(focal, abs(room))
    for row in range(3):
        focal = intrinsics[row] if row < 2 else 1.0
        x = np.float32(T_world_camera[0, row] * cell[0] * focal)
        y = np.float32(T_world_camera[1, row] * cell[1] * focal)
        z = np.float32(T_world_camera[2, row] * cell[2] * focal)
        for c in range(512):
            steps[row, c] = x * centres[0, c] + y * centres[1, c] + z * centres[2, c]
