# SPDX-License-Identifier: Apache-2.0
"""What a depth image tells of cells again: cell by cell and pixel by pixel, no code shared."""

import numpy as np


def looked(depth, camera, T, size, max_range, margin, cells):
    """Return the names of `cells` (of tuples) by one image: `end`, `free`, or nothing."""
    R, origin = T[:3, :3], T[:3, 3]
    ends = set()
    for v in range(camera.height):
        for u in range(camera.width):
            z = depth[v, u]
            ray = np.array([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0])
            if 0 < z < np.inf and z * np.linalg.norm(ray) <= max_range:
                ends.add(tuple(np.floor((R @ (z * ray) + origin) / size).astype(int).tolist()))
    found = {}
    for cell in cells:
        x, y, z = R.T @ ((np.array(cell) + 0.5) * size - origin)
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        if cell in ends:
            found[cell] = "end"
        elif z > 0 and -0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5:
            there = depth[round(float(v)), round(float(u))]
            if np.hypot(np.hypot(x, y), z) <= max_range and z < there * (1 - margin[1]) - margin[0] * size:
                found[cell] = "free"
    return found
