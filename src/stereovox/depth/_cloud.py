# SPDX-License-Identifier: Apache-2.0
"""Kernels for clouds: select usable rays, find the nearest neighbours of some of them.

Kernel that gathers the pixels of a depth image into the beams of a scan.
"""

from __future__ import annotations

import numpy as np

from stereovox.depth.sphere._sphere import _arctan2
from stereovox.kernels._jit import cell, kernel


@kernel
def usable(points, origins, range_min, range_max, reach, ends, starts, hits):
    """Write the usable rays of points (N, 3) without gaps; return their number, and the number of finite points.

    origins: (N, 3) where each was measured from, (0, 3): all from the sensor. A point at 0, 0, 0 is no point. Output,
    (N,
    3) each and (N,): where rays end and begin, and whether at a surface: beyond `range_max` they end there without one,
    at least `reach` in front of the point, whose noise that allows for.
    """
    used = finite = 0
    moving = origins.shape[0] > 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if x == 0 and y == 0 and z == 0:
            continue
        a, b, c = (origins[i, 0], origins[i, 1], origins[i, 2]) if moving else (0.0, 0.0, 0.0)
        dx, dy, dz = x - a, y - b, z - c
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if not np.isfinite(length):
            continue
        finite += 1
        if not length >= range_min:
            continue
        far = length > range_max
        share = max(min(length - reach, range_max), 0.0) / length if far else 1.0
        ends[used, 0] = a + dx * share if far else x
        ends[used, 1] = b + dy * share if far else y
        ends[used, 2] = c + dz * share if far else z
        starts[used, 0], starts[used, 1], starts[used, 2] = a, b, c
        hits[used] = not far
        used += 1
    return used, finite


@kernel
def nearest(directions, asked, found):
    """Fill `found` (Q,) with the column of the unit vector nearest to each of `asked`, other than itself.

    directions: (3, N) float32; asked: (Q,) int64 columns of it.
    """
    x, y, z = directions[0], directions[1], directions[2]
    for q in range(asked.size):
        i = asked[q]
        a, b, c = x[i], y[i], z[i]
        least, at = np.float32(np.inf), np.int64(-1)
        for j in range(x.size):
            dx, dy, dz = x[j] - a, y[j] - b, z[j] - c
            square = dx * dx + dy * dy + dz * dz
            if square < least and j != i:
                least, at = square, j
        found[q] = at


VALID, TOO_NEAR, TOO_FAR = np.uint8(0), np.uint8(2), np.uint8(3)
ZERO, HALF, TINY, INF = np.float32(0), np.float32(0.5), np.float32(1e-12), np.float32(np.inf)


@kernel
def gather(depth_m, reason, columns, rows, edge_columns, edge_rows, turn, band, fan, beams, scratch):
    """Fill `beams` from a REP 117 depth image (height, width) and its reasons.

    columns, rows: `camera.rays()`; edge_columns (width + 1,), edge_rows (height + 1, 2): rays of the pixels' borders.
    turn: (3, 3) maps the optical frame into the scan's: forward, left, up. band, fan, beams: see scan.py.
    scratch: (9, width + 1) float32.
    """
    height, width = depth_m.shape
    before, after, hits, starts, ends = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    firsts, lasts = scratch[5, :width].view(np.int32), scratch[6, :width].view(np.int32)
    slopes, blinds = scratch[7], scratch[8]
    above = band.camera > band.high  # the steepest rays reach the band first, and they are in the lowest rows
    within = (band.camera >= band.low) & (band.camera <= band.high)
    _places(edge_columns, edge_rows[height if above else 0], turn, fan, before)
    for i in range(height):
        v = height - 1 - i if above else i
        _places(edge_columns, edge_rows[v if above else v + 1], turn, fan, after)
        _cover(before, after, fan, firsts, lasts)
        _rays(depth_m[v], reason[v], columns, rows[v], turn, band, hits, starts, ends, slopes, blinds)
        _reach(firsts, lasts, slopes, blinds, beams)
        if within:
            _add(firsts, lasts, hits, ends, beams)
        else:
            _join(firsts, lasts, hits, starts, ends, beams)
        before, after = after, before


@cell
def _places(columns, row, turn, fan, places):
    """Fill the positions in the fan of the rays of one row."""
    down, ahead = row[0], row[1]
    f0, l0 = turn[0, 1] * down + turn[0, 2] * ahead, turn[1, 1] * down + turn[1, 2] * ahead
    for u in range(columns.size):
        angle = _arctan2(turn[1, 0] * columns[u] + l0, turn[0, 0] * columns[u] + f0)
        places[u] = angle * fan.per_radian + fan.offset


@cell
def _cover(before, after, fan, firsts, lasts):
    """Fill the first and last beam of each pixel: those whose centre it covers, else the one that contains its own."""
    for u in range(firsts.size):
        low = min(min(before[u], before[u + 1]), min(after[u], after[u + 1]))
        high = max(max(before[u], before[u + 1]), max(after[u], after[u + 1]))
        first, last = np.ceil(low), np.floor(high)
        middle = np.floor(HALF * (low + high) + HALF)
        none = first > last
        first, last = middle if none else first, middle if none else last
        firsts[u] = np.int32(min(max(first, ZERO), fan.last))
        lasts[u] = np.int32(min(max(last, ZERO), fan.last))


@cell
def _rays(depth, reason, columns, row, turn, band, hits, starts, ends, slopes, blinds):
    """Fill the hit of each ray of a row and the start and end of its free part in the band, in metres along the floor.

    Also its slope (rise per metre along the floor), and the distance up to which it measures nothing.

    The hit is -inf if something too near may be in the band, inf if there is none. The floor right in front
    of the camera is too near as well, but no obstacle: rays that would meet it there are ignored. Rays that are
    ignored,
    too steep or point backwards are free up to 0.
    """
    down, ahead = row[0], row[1]
    f0, l0 = turn[0, 1] * down + turn[0, 2] * ahead, turn[1, 1] * down + turn[1, 2] * ahead
    z0 = turn[2, 1] * down + turn[2, 2] * ahead
    for u in range(columns.size):
        forward, left, z = turn[0, 0] * columns[u] + f0, turn[1, 0] * columns[u] + l0, turn[2, 0] * columns[u] + z0
        floor_m = np.sqrt(forward * forward + left * left)
        counts = (forward > ZERO) & (abs(z) < band.steepest * floor_m)
        rise = z if abs(z) > TINY else TINY
        a, b = (band.low - band.camera) / rise, (band.high - band.camera) / rise
        enter, leave = max(min(a, b), ZERO), max(a, b)
        why = reason[u]
        seen = depth[u] if why == VALID else (band.far if why == TOO_FAR else ZERO)
        level = band.camera + seen * z
        inside = (why == VALID) & (level >= band.low) & (level <= band.high) & (seen * floor_m <= band.range_max)
        floor = (why == TOO_NEAR) & (band.camera < -z * band.floor)
        near = (why == TOO_NEAR) & (enter <= leave) & (enter < band.near) & (not floor)
        hit = seen * floor_m if inside & counts else INF
        hits[u] = -INF if near & counts else hit
        starts[u] = enter * floor_m
        ends[u] = min(min(seen, leave) * floor_m, band.range_max) if counts else ZERO
        slopes[u] = z / floor_m if counts else INF
        unmeasured = max(band.near, band.camera / max(-z, TINY) if floor else ZERO)
        blinds[u] = unmeasured * floor_m if counts else ZERO


@cell
def _reach(firsts, lasts, slopes, blinds, beams):
    """Add the directions of the rays of a row, whatever they hit."""
    for u in range(firsts.size):
        for b in range(firsts[u], lasts[u] + 1):
            beams.lowest[b] = min(beams.lowest[b], slopes[u])
            beams.unmeasured[b] = max(beams.unmeasured[b], blinds[u])


@cell
def _add(firsts, lasts, hits, ends, beams):
    """Add the rays of a row that start inside the band."""
    for u in range(firsts.size):
        b = firsts[u]
        beams.hit[b] = min(beams.hit[b], hits[u])
        beams.end[b] = max(beams.end[b], ends[u])
        for more in range(b + 1, lasts[u] + 1):
            beams.hit[more] = min(beams.hit[more], hits[u])
            beams.end[more] = max(beams.end[more], ends[u])


@cell
def _join(firsts, lasts, hits, starts, ends, beams):
    """Add the rays of a row that enter the band farther on; a gap between two rays is unseen."""
    for u in range(firsts.size):
        for b in range(firsts[u], lasts[u] + 1):
            beams.hit[b] = min(beams.hit[b], hits[u])
            start, end = starts[u], ends[u]
            first = beams.end[b] == ZERO
            if (end > start) & (first | ((start <= beams.end[b]) & (end >= beams.start[b]))):
                beams.start[b] = start if first else min(beams.start[b], start)
                beams.end[b] = max(beams.end[b], end)
