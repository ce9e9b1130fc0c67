# SPDX-License-Identifier: Apache-2.0
"""Kernels for rays from one point at triangles: LANES neighbouring rays traverse a tree of boxes together.

Operations that decide about a hit are rounded as in NumPy, so that simulations are the same on every processor.
"""

import numpy as np

from stereovox.kernels._jit import cell, exact_cell, kernel

LANES = 32
"""Rays traversed together. In an image they are neighbours, and mostly meet the same boxes."""
ZERO, ONE = np.float32(0), np.float32(1)
FAR = np.float32(np.inf)
WIDER = np.float32(1 + 1e-6)
"""Tolerance on the exit of a ray from a box, so that rounding does not lose a surface in its side."""
SLOWEST = np.float32(1e-30)
"""Replaces a direction's component of 0, to allow division."""
NO_TRIANGLE = np.int32(-1)
ROOT = np.int32(1)


@kernel
def look(triangles, origin, sides, planes):
    """Fill in the properties of triangles (M, 3, 3) with corners A, B, C, seen from `origin` (3,), all float64.

    sides: (M, 9) float64, the products B x C, C x A and A x B. A ray along d passes inside the triangle if its
    products with all three have one sign: these are the volumes of Pluecker's coordinates, and triangles that share a
    side agree on it. planes: (M, 4) float64, the normal (B - A) x (C - A), and its product with A.
    """
    for m in range(triangles.shape[0]):
        for axis in range(3):
            q, r = (axis + 1) % 3, (axis + 2) % 3
            aq, ar = triangles[m, 0, q] - origin[q], triangles[m, 0, r] - origin[r]
            bq, br = triangles[m, 1, q] - origin[q], triangles[m, 1, r] - origin[r]
            cq, cr = triangles[m, 2, q] - origin[q], triangles[m, 2, r] - origin[r]
            sides[m, axis] = _minor(bq, br, cq, cr)
            sides[m, 3 + axis] = _minor(cq, cr, aq, ar)
            sides[m, 6 + axis] = _minor(aq, ar, bq, br)
            b, c, a = triangles[m, 1], triangles[m, 2], triangles[m, 0]
            planes[m, axis] = _minor(b[q] - a[q], b[r] - a[r], c[q] - a[q], c[r] - a[r])
        x, y, z = triangles[m, 0, 0] - origin[0], triangles[m, 0, 1] - origin[1], triangles[m, 0, 2] - origin[2]
        planes[m, 3] = _dot(planes[m, 0], planes[m, 1], planes[m, 2], x, y, z)


@kernel
def nearest(directions, boxes, starts, sides, planes, rays, found, waiting, share, triangle):
    """Fill in the distance to the first triangle in units of each of `directions` (N, 3) float32, and its number.

    boxes: (nodes, 6) float32, the lowest and the highest corner seen from the origin; the children of node i are 2 i
    and 2 i + 1, the first is 1. starts: (leaves + 1,) int32, the first triangle of each leaf. sides, planes: of `look`.
    rays: (7, LANES) float32, found: (LANES,) int32, waiting: (64,) int32, scratch.
    share: (N,) float32, inf without any; triangle: (N,) int32, -1 without any; of several equally far, the first.
    """
    leaves = np.int32(starts.shape[0] - 1)
    for first in range(0, directions.shape[0], LANES):
        count = min(LANES, directions.shape[0] - first)
        _start(directions, first, count, rays, found)
        waiting[0] = ROOT
        left = 1
        while left > 0:
            left -= 1
            node = waiting[left]
            if not _any_enters(boxes, node, rays):
                continue
            if node >= leaves:
                for m in range(starts[node - leaves], starts[node - leaves + 1]):
                    _meet(sides, planes, m, rays, found)
            else:
                near, far = _by_distance(boxes, np.int32(2 * node), rays)
                waiting[left] = far
                waiting[left + 1] = near
                left += 2
        for k in range(count):
            share[first + k] = rays[6, k]
            triangle[first + k] = found[k]


@cell
def _start(directions, first, count, rays, found):
    """Set up directions, their inverses and empty results; the last ray fills missing lanes."""
    for k in range(LANES):
        n = first + min(k, count - 1)
        for axis in range(3):
            along = directions[n, axis]
            rays[axis, k] = along
            rays[3 + axis, k] = ONE / (along if abs(along) > SLOWEST else SLOWEST)
        rays[6, k] = FAR
        found[k] = NO_TRIANGLE


@cell
def _any_enters(boxes, node, rays):
    """Return whether any ray enters the box before its nearest surface so far (Kay and Kajiya 1986)."""
    x0, y0, z0 = boxes[node, 0], boxes[node, 1], boxes[node, 2]
    x1, y1, z1 = boxes[node, 3], boxes[node, 4], boxes[node, 5]
    entered = np.int32(0)
    for k in range(LANES):
        a, b = x0 * rays[3, k], x1 * rays[3, k]
        c, d = y0 * rays[4, k], y1 * rays[4, k]
        e, f = z0 * rays[5, k], z1 * rays[5, k]
        comes = max(max(min(a, b), min(c, d)), max(min(e, f), ZERO))
        goes = min(min(max(a, b), max(c, d)), min(max(e, f), rays[6, k])) * WIDER
        entered |= np.int32(comes <= goes)
    return entered != 0


@cell
def _by_distance(boxes, child, rays):
    """Return two children, first the one whose centre is nearer along the first ray."""
    ahead = ZERO
    for axis in range(3):
        mine = boxes[child, axis] + boxes[child, 3 + axis]
        other = boxes[child + 1, axis] + boxes[child + 1, 3 + axis]
        ahead += (other - mine) * rays[axis, 0]
    if ahead >= ZERO:
        return child, np.int32(child + 1)
    return np.int32(child + 1), child


@cell
def _meet(sides, planes, m, rays, found):
    """Intersect all rays with triangle `m`."""
    ax, ay, az = sides[m, 0], sides[m, 1], sides[m, 2]
    bx, by, bz = sides[m, 3], sides[m, 4], sides[m, 5]
    cx, cy, cz = sides[m, 6], sides[m, 7], sides[m, 8]
    nx, ny, nz, product = planes[m, 0], planes[m, 1], planes[m, 2], np.float32(planes[m, 3])
    number = np.int32(m)
    for k in range(LANES):
        x, y, z = rays[0, k], rays[1, k], rays[2, k]
        a, b, c = _dot(ax, ay, az, x, y, z), _dot(bx, by, bz, x, y, z), _dot(cx, cy, cz, x, y, z)
        within = (min(min(a, b), c) >= 0) | (max(max(a, b), c) <= 0)
        share = _ratio(product, np.float32(_dot(nx, ny, nz, x, y, z)))
        nearer = (share < rays[6, k]) | ((share == rays[6, k]) & (number < found[k]))
        met = within & nearer & (share > ZERO)
        rays[6, k] = share if met else rays[6, k]
        found[k] = number if met else found[k]


@exact_cell
def _minor(aq, ar, bq, br):
    """Antisymmetric exactly: swapping the two negates it."""
    return aq * br - ar * bq


@exact_cell
def _dot(ax, ay, az, x, y, z):
    return ax * x + ay * y + az * z


@exact_cell
def _ratio(a, b):
    return a / b
