# SPDX-License-Identifier: Apache-2.0
"""Kernel of the pattern on simulated surfaces: 3-D value noise of several sizes (Perlin 1985)."""

import numpy as np

from stereovox.kernels._jit import cell, kernel

ZERO, ONE, HALF = np.float32(0), np.float32(1), np.float32(0.5)
TWO, THREE = np.float32(2), np.float32(3)
THIRD = np.float32(1 / 3)
PER_UINT16 = np.float32(1 / 65535)


@kernel
def pattern(points, footprint, largest, octaves, out):
    """Fill `out` (N,) with brightness between -1 and 1 at points (N, 3) in metres.

    Waves are `largest` metres long, then half of that, `octaves` times, all of about equal strength. A wave is faded
    out if it is shorter than two of the `footprint` (N,) that a pixel covers there, as a lens would blur it.
    """
    for n in range(points.shape[0]):
        total, weights = ZERO, np.float32(1e-6)
        wave = largest
        for octave in range(octaves):
            seen = min(max(wave / footprint[n] - TWO, ZERO) * HALF, ONE)
            if seen > ZERO:
                scale = ONE / wave
                x, y, z = points[n, 0] * scale, points[n, 1] * scale, points[n, 2] * scale
                total += seen * _value(x, y, z, np.uint32(octave))
                weights += seen * seen
            wave *= HALF
        out[n] = min(max(total / np.sqrt(weights), -ONE), ONE)


@kernel
def even(points, seed, out):
    """Fill `out` (N,) with noise of mean 0 and variance 1 at points (N, 3), correlated over distances below one.

    A blend of random numbers varies less between them than at them; this is compensated at each point.
    """
    for n in range(points.shape[0]):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        variance = _kept(x) * _kept(y) * _kept(z) * THIRD
        out[n] = _value(x, y, z, seed) / np.sqrt(variance)


@cell
def _kept(x):
    """Return the share of the variance that blending along one axis keeps."""
    t = _smooth(x - np.floor(x))
    return t * t + (ONE - t) * (ONE - t)


@cell
def _value(x, y, z, seed):
    """Return smooth noise between -1 and 1: random numbers at integer points, blended in between."""
    fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
    i, j, k = np.int32(fx), np.int32(fy), np.int32(fz)
    a, b, c = _smooth(x - fx), _smooth(y - fy), _smooth(z - fz)
    low = _between(
        _between(_random(i, j, k, seed), _random(i + 1, j, k, seed), a),
        _between(_random(i, j + 1, k, seed), _random(i + 1, j + 1, k, seed), a),
        b,
    )
    high = _between(
        _between(_random(i, j, k + 1, seed), _random(i + 1, j, k + 1, seed), a),
        _between(_random(i, j + 1, k + 1, seed), _random(i + 1, j + 1, k + 1, seed), a),
        b,
    )
    return _between(low, high, c)


@cell
def _smooth(t):
    return t * t * (THREE - TWO * t)


@cell
def _between(a, b, t):
    return a + (b - a) * t


@cell
def _random(i, j, k, seed):
    """Return a number between -1 and 1 determined by three integers."""
    h = np.uint32(i) * np.uint32(0x8DA6B343) ^ np.uint32(j) * np.uint32(0xD8163841)
    h = h ^ np.uint32(k) * np.uint32(0xCB1AB31F) ^ (seed + np.uint32(1)) * np.uint32(0x9E3779B9)
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B)
    h = h ^ (h >> np.uint32(16))
    return np.float32(h & np.uint32(0xFFFF)) * PER_UINT16 * TWO - ONE
