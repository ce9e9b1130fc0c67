# SPDX-License-Identifier: Apache-2.0
"""Photographs of simulated scenes for stereo matching: surfaces with a pattern and light, seen through a lens."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lenses import Lens
from stereovox.geometry.se3 import Transform
from stereovox.simulate import _texture
from stereovox.simulate.scene import Scene

WAVE, OCTAVES = 0.4, 7
"""Longest wave of the pattern in metres, and how often it is halved: down to 6 mm."""
CONTRAST = 0.5
"""Default relative change of a surface's brightness by the pattern."""
LIGHT = np.array([0.36, 0.48, 0.8], np.float32)
"""Direction of the light."""
SKY = 205.0
"""Grey value outside the scene."""
STEEPEST = 0.1
"""Cosine below which grazing surfaces are not blurred further."""


def photograph(
    scene: Scene, lens: Lens, T_world_lens: Transform, noise: float, seed: list[int], contrast: float = CONTRAST
) -> NDArray[np.uint8]:
    """Return the grey image (height, width) uint8 of a scene through a lens; black outside the lens's view.

    T_world_lens: (4, 4) of its optical frame. noise: standard deviation in grey levels; same seed, same image.
    contrast: relative change of a surface's brightness by the pattern.
    The pattern is fixed to the surfaces, so two lenses see the same one. It is blurred as by pixels.
    """
    rays = _rays(lens)
    seen = np.isfinite(rays[:, 2])
    directions = rays[seen] @ T_world_lens[:3, :3].T.astype(np.float32)
    grey = np.zeros(len(rays), np.float32)
    grey[seen] = _shade(scene, np.asarray(T_world_lens[:3, 3], np.float32), directions, 1 / lens.fx, contrast)
    if noise:
        grey += np.float32(noise) * np.random.default_rng(seed).standard_normal(grey.shape, np.float32)
    return np.clip(np.rint(np.where(seen, grey, 0)), 0, 255).astype(np.uint8).reshape(lens.height, lens.width)


@lru_cache(maxsize=16)
def _rays(lens: Lens) -> NDArray[np.float32]:
    v, u = np.mgrid[: lens.height, : lens.width]
    return lens.directions(np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32)


def _shade(
    scene: Scene, eye: NDArray[np.float32], directions: NDArray[np.float32], pixel: float, contrast: float
) -> NDArray[np.float32]:
    """Return the grey (N,) float32 at the hits of unit directions (N, 3) from `eye`; pixel: its width in radians."""
    distance, normals, triangles = scene.hits(eye, directions)
    there = triangles >= 0
    grey = np.full(len(directions), SKY, np.float32)
    points = eye + directions[there] * distance[there, None]
    cosine = np.abs(np.einsum("ij,ij->i", directions[there], normals[there]))
    footprint = distance[there] * np.float32(pixel) / np.maximum(cosine, STEEPEST)
    pattern = np.empty(len(points), np.float32)
    _texture.pattern(points, footprint.astype(np.float32), np.float32(WAVE), OCTAVES, pattern)
    light = 0.55 + 0.45 * np.abs(normals[there] @ LIGHT)
    grey[there] = _albedo(scene)[triangles[there]] * light * (1 + np.float32(contrast) * pattern)
    return grey


@lru_cache(maxsize=4)
def _albedo(scene: Scene) -> NDArray[np.float32]:
    """Return the grey (M,) of each triangle in full light: each solid has its own."""
    greys = np.random.default_rng(0).uniform(90, 165, len(scene.solids)).astype(np.float32)
    return np.repeat(greys, [len(solid.triangles) for solid in scene.solids])
