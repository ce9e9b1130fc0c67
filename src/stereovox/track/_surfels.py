# SPDX-License-Identifier: Apache-2.0
"""Kernels of tracking: patches of a depth image, surfels in a hash table, and their point-to-plane residuals.

A surfel (9,) float32 is the mean of the patches that fell into one cubic cell: 0 weight, 1-3 position less the cell's
corner in metres, 4-6 normal (its length says how well the normals agree), 7 mean variance of the patches along their
normals, 8 number of patches.
"""

import numpy as np

from stereovox.kernels._jit import cell, kernel

EMPTY = np.int64(-1)
FIELDS = 9
AGREE = np.float32(0.7)
"""Cosine of the largest angle between normals of one surface; also the least length of a surfel's mean normal."""
STEEPEST = np.float32(0.15)
"""Cosine of the steepest view of a surface that is used."""
FULL = 0.6
"""Share of a patch's pixels that must lie on its surface."""
SAME = np.float32(0.04)
"""Share of the depth by which pixels of one patch may differ."""
FOLD = np.float32(0.25)
"""Share of the depth by which neighbouring patches of one surface may differ."""


@kernel
def patches(depth_m, columns, rows, step, point):
    """Write the mean point of each patch of step x step pixels to `point` (h, w, 3), camera frame; 0: no surface.

    depth_m: (H, W) REP 117. columns (W,), rows (H, 2): rays of the camera; depth times (columns, rows) is the point.
    """
    for by in range(point.shape[0]):
        for bx in range(point.shape[1]):
            point[by, bx, 0] = point[by, bx, 1] = point[by, bx, 2] = np.float32(0)
            middle = depth_m[by * step + step // 2, bx * step + step // 2]
            if not (np.isfinite(middle) and middle > 0):
                continue
            number, inverse = 0, np.float32(0)
            across, first, second = np.float32(0), np.float32(0), np.float32(0)
            for v in range(by * step, (by + 1) * step):
                for u in range(bx * step, (bx + 1) * step):
                    z = depth_m[v, u]
                    if abs(z - middle) < SAME * middle:  # false for NaN
                        number += 1
                        inverse += np.float32(1) / z
                        across += columns[u]
                        first += rows[v, 0]
                        second += rows[v, 1]
            if number < FULL * step * step:
                continue
            z = np.float32(1) / inverse  # mean inverse depth times the mean ray: number * number / inverse / number
            point[by, bx, 0] = across * z
            point[by, bx, 1] = first * z
            point[by, bx, 2] = second * z


@kernel
def normals(point, normal):
    """Write unit normals (h, w, 3) of patches, towards the camera; 0 if neighbours are missing or it is steep."""
    height, width = point.shape[0], point.shape[1]
    for y in range(height):
        for x in range(width):
            normal[y, x, 0] = normal[y, x, 1] = normal[y, x, 2] = np.float32(0)
            if not _there(point, y, x):
                continue
            left = x - 1 if x > 0 and _there(point, y, x - 1) else x
            right = x + 1 if x + 1 < width and _there(point, y, x + 1) else x
            above = y - 1 if y > 0 and _there(point, y - 1, x) else y
            below = y + 1 if y + 1 < height and _there(point, y + 1, x) else y
            away = np.sqrt(_square(point[y, x, 0], point[y, x, 1], point[y, x, 2]))
            a0, a1, a2 = _between(point, y, left, y, right)
            b0, b1, b2 = _between(point, above, x, below, x)
            limit = np.float32(FOLD * away) ** 2
            if left == right or above == below or _square(a0, a1, a2) > limit or _square(b0, b1, b2) > limit:
                continue
            n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
            length = np.sqrt(_square(n0, n1, n2))
            towards = -(n0 * point[y, x, 0] + n1 * point[y, x, 1] + n2 * point[y, x, 2])
            if length > 0 and abs(towards) > STEEPEST * away * length:
                scale = np.float32(np.copysign(np.float32(1) / length, towards))
                normal[y, x, 0], normal[y, x, 1], normal[y, x, 2] = scale * n0, scale * n1, scale * n2


@kernel
def put(keys, surfels, size, points, directions, sigma, R, t, most):
    """Add patches to the surfels of cells of `size` metres; return how many cells are new.

    keys: (2^k,) int64, EMPTY if free. points, directions: (N, 3) float32, camera frame, all with a normal; sigma
    (N,) metres. R (3, 3), t (3,): pose. most: weight at which a surfel becomes a running mean.
    """
    mask, new = np.int64(keys.size - 1), 0
    for i in range(points.shape[0]):
        px, py, pz = _turned(R, points, i)
        px, py, pz = px + t[0], py + t[1], pz + t[2]
        nx, ny, nz = _turned(R, directions, i)
        cx, cy, cz = np.floor(px / size), np.floor(py / size), np.floor(pz / size)
        slot = _slot(keys, _key(cx, cy, cz), mask)
        if keys[slot] == EMPTY:
            keys[slot] = _key(cx, cy, cz)
            new += 1
        surfel = surfels[slot]
        variance = sigma[i] * sigma[i]
        weight = np.float32(1e-4) / variance
        surfel[0] = min(surfel[0] + weight, most)
        part = min(weight / surfel[0], np.float32(1))
        surfel[1] += part * (np.float32(px - cx * size) - surfel[1])
        surfel[2] += part * (np.float32(py - cy * size) - surfel[2])
        surfel[3] += part * (np.float32(pz - cz * size) - surfel[3])
        surfel[4] += part * (np.float32(nx) - surfel[4])
        surfel[5] += part * (np.float32(ny) - surfel[5])
        surfel[6] += part * (np.float32(nz) - surfel[6])
        surfel[7] += part * (variance - surfel[7])
        surfel[8] += np.float32(1)
    return new


@kernel
def carry(keys, surfels, new_keys, new_surfels):
    """Copy all surfels into an empty table with room for them."""
    mask = np.int64(new_keys.size - 1)
    for i in range(keys.size):
        if keys[i] != EMPTY:
            slot = _slot(new_keys, keys[i], mask)
            new_keys[slot] = keys[i]
            for field in range(FIELDS):
                new_surfels[slot, field] = surfels[i, field]


@kernel
def nearest(keys, surfels, size, points, directions, R, t, slots):
    """Write to `slots` (N,) int64 the surfel that is nearest to each patch and agrees with its normal; -1: none."""
    mask = np.int64(keys.size - 1)
    for i in range(points.shape[0]):
        px, py, pz = _turned(R, points, i)
        nx, ny, nz = _turned(R, directions, i)
        slots[i] = _nearest(keys, surfels, size, px + t[0], py + t[1], pz + t[2], nx, ny, nz, mask)


@kernel
def drop(keys, surfels, size, centre, radius):
    """Drop all surfels whose cells are `radius` metres or more from `centre` (3,) along an axis; return their number.

    Everything is float64, because this is rarely called.
    """
    dropped = 0
    for i in range(keys.size):
        while keys[i] != EMPTY and not _is_near(keys[i], size, centre, radius):  # another may have moved here
            _free(keys, surfels, i)
            dropped += 1
    return dropped


@kernel
def equations(
    keys, surfels, size, slots, points, directions, sigma, R, t, slack, reach, information, gradient, spread, ratios
):
    """Fill the normal equations of a small motion (rotation about the camera, then shift, in the map's axes).

    Residuals are distances of patches from the planes of their surfels, `slots` (N,), -1: none (Chen and Medioni 1992),
    weighted by their variance and `slack` metres, and by Geman and McClure's function of `reach` deviations.
    Each product of two normals takes one from the patch and one from the surfel. Their noise is independent, so it adds
    no information: each normal is the instrument of the other.

    information (6, 6), gradient (6,) float64. spread (10,): sums of weights, of weighted x, y, z and of xx, xy, xz, yy,
    yz, zz of the patches, seen from the camera. ratios (N,) float32: squared residuals by their variance, of the
    patches with a surfel, whose number is returned.
    """
    known = 0
    information[:], gradient[:], spread[:] = 0.0, 0.0, 0.0
    for i in range(points.shape[0]):
        slot = slots[i]
        if slot < 0:
            continue
        px, py, pz = _turned(R, points, i)
        nx, ny, nz = _turned(R, directions, i)
        surfel, key = surfels[slot], keys[slot]
        length = np.sqrt(_square(surfel[4], surfel[5], surfel[6]))
        a0, a1, a2 = np.float64(surfel[4] / length), np.float64(surfel[5] / length), np.float64(surfel[6] / length)
        dx = px + t[0] - _part(key, 42) * size - surfel[1]
        dy = py + t[1] - _part(key, 21) * size - surfel[2]
        dz = pz + t[2] - _part(key, 0) * size - surfel[3]
        off = a0 * dx + a1 * dy + a2 * dz
        variance = sigma[i] * sigma[i] + surfel[7] / min(surfel[8], np.float32(20)) + slack * slack
        ratio = off * off / variance
        ratios[known] = ratio
        known += 1
        weight = 1.0 / (variance * (1.0 + ratio / (reach * reach)) ** 2)
        seen = (py * nz - pz * ny, pz * nx - px * nz, px * ny - py * nx, nx, ny, nz)
        held = (py * a2 - pz * a1, pz * a0 - px * a2, px * a1 - py * a0, a0, a1, a2)
        _add(information, gradient, weight, seen, held, nx * dx + ny * dy + nz * dz, off)
        _add_moments(spread, weight, px, py, pz)
    for j in range(6):
        for k in range(j):
            information[j, k] = information[k, j]
    return known


@cell
def _add(information, gradient, weight, seen, held, seen_off, off):
    for j in range(6):
        gradient[j] -= 0.5 * weight * (seen[j] * off + held[j] * seen_off)
        for k in range(j, 6):
            information[j, k] += 0.5 * weight * (seen[j] * held[k] + held[j] * seen[k])


@cell
def _add_moments(spread, weight, x, y, z):
    spread[0] += weight
    spread[1] += weight * x
    spread[2] += weight * y
    spread[3] += weight * z
    spread[4] += weight * x * x
    spread[5] += weight * x * y
    spread[6] += weight * x * z
    spread[7] += weight * y * y
    spread[8] += weight * y * z
    spread[9] += weight * z * z


@cell
def _nearest(keys, surfels, size, x, y, z, nx, ny, nz, mask):
    """Return the slot of the nearest surfel with a normal that agrees, in the 8 cells nearest to a point; else -1."""
    cx, cy, cz = np.floor(x / size - 0.5), np.floor(y / size - 0.5), np.floor(z / size - 0.5)
    best, found = np.inf, np.int64(-1)
    for k in range(8):
        ix, iy, iz = cx + (k & 1), cy + ((k >> 1) & 1), cz + (k >> 2)
        slot = _slot(keys, _key(ix, iy, iz), mask)
        if keys[slot] == EMPTY:
            continue
        surfel = surfels[slot]
        length = np.sqrt(_square(surfel[4], surfel[5], surfel[6]))
        if length < AGREE or surfel[4] * nx + surfel[5] * ny + surfel[6] * nz < AGREE * length:
            continue
        dx, dy, dz = ix * size + surfel[1] - x, iy * size + surfel[2] - y, iz * size + surfel[3] - z
        away = _square(dx, dy, dz)
        if away < best:
            best, found = away, slot
    return found


@cell
def _is_near(key, size, centre, radius):
    x, y, z = _part(key, 42) * size - centre[0], _part(key, 21) * size - centre[1], _part(key, 0) * size - centre[2]
    return max(abs(x), abs(y), abs(z)) < radius


@cell
def _free(keys, surfels, slot):
    """Empty a slot; surfels that would become unreachable shift back."""
    mask = np.int64(keys.size - 1)
    hole, look = slot, (slot + 1) & mask
    while keys[look] != EMPTY:
        if (look - _home(keys[look], mask)) & mask >= (look - hole) & mask:
            keys[hole] = keys[look]
            for field in range(FIELDS):
                surfels[hole, field] = surfels[look, field]
            hole = look
        look = (look + 1) & mask
    keys[hole] = EMPTY
    for field in range(FIELDS):
        surfels[hole, field] = np.float32(0)


@cell
def _home(key, mask):
    """Return the slot at which the search for a key begins."""
    return np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & mask


@cell
def _slot(keys, key, mask):
    """Return where `key` is, or the empty slot where it belongs; the table is never full."""
    slot = _home(key, mask)
    while keys[slot] != EMPTY and keys[slot] != key:
        slot = (slot + 1) & mask
    return slot


@cell
def _key(x, y, z):
    """Return one number for a cell whose indices lie within +-2^20."""
    low = np.int64(0x1FFFFF)
    return ((np.int64(x) & low) << 42) | ((np.int64(y) & low) << 21) | (np.int64(z) & low)


@cell
def _part(key, shift):
    """Return the index of a cell along one axis, from the 21 bits that `_key` put at `shift`."""
    return ((key >> shift) & np.int64(0x1FFFFF)) - ((key >> (shift + 20) & np.int64(1)) << 21)


@cell
def _turned(R, points, i):
    x, y, z = points[i, 0], points[i, 1], points[i, 2]
    return (
        R[0, 0] * x + R[0, 1] * y + R[0, 2] * z,
        R[1, 0] * x + R[1, 1] * y + R[1, 2] * z,
        R[2, 0] * x + R[2, 1] * y + R[2, 2] * z,
    )


@cell
def _there(point, y, x):
    return point[y, x, 0] != 0 or point[y, x, 1] != 0 or point[y, x, 2] != 0


@cell
def _square(a, b, c):
    return a * a + b * b + c * c


@cell
def _between(point, v0, u0, v1, u1):
    return (
        point[v1, u1, 0] - point[v0, u0, 0],
        point[v1, u1, 1] - point[v0, u0, 1],
        point[v1, u1, 2] - point[v0, u0, 2],
    )
