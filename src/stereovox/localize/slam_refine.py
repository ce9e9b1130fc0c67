# SPDX-License-Identifier: Apache-2.0
"""The last polish: every keyframe is laid onto the maps of all others that saw the same walls, whenever that was."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stereovox import planar
from stereovox.config_robot import SlamConfig
from stereovox.localize.line_map import LineMap, joined
from stereovox.localize.slam_keyframe import Edge, Keyframe, in_second_frame, without_weak

PATCH = 4
"""Keyframes before and after a patch's middle that belong to it: few enough to be rigid."""
STRIDE = 3
"""Keyframes from one patch's middle to the next."""
WEAK = 0.1
"""Share of information below which a direction is a corridor's."""
MOST_OTHERS = 120
"""Keyframes that are laid onto a patch: a robot may pass the same place all day."""
LEAST_SHARE = 0.4
"""Share of a keyframe's points that must lie on a patch's lines."""


def patch_edges(keyframes: list[Keyframe], config: SlamConfig) -> Iterator[Edge]:
    """Yield what each keyframe says of where it stands to each patch of other keyframes nearby.

    A patch is a short run of keyframes, taken as rigid; edges go from its middle to the keyframe. They start from the
    keyframes' present poses, so these must be right to a decimetre or two.
    """
    places = np.array([keyframe.pose for keyframe in keyframes])
    patch = LineMap(config.voxel_size)
    for middle in range(0, len(keyframes), STRIDE):
        first, last = max(middle - PATCH, 0), min(middle + PATCH + 1, len(keyframes))
        others = _others(places, middle, first, last, config)
        if not len(others):
            continue
        pose = places[middle]
        patch.build(joined([k.cloud.moved(planar.relative(pose, k.pose)) for k in keyframes[first:last]]))
        guesses = planar.relative(pose, places[others])
        for other, guess in zip(others.tolist(), guesses, strict=True):
            edge = _edge(patch, keyframes, (middle, other), guess, config)
            if edge is not None:
                yield edge


def _others(places: planar.Pose, middle: int, first: int, last: int, config: SlamConfig) -> NDArray[np.int64]:
    far = np.hypot(*(places[:, :2] - places[middle, :2]).T)
    near = np.nonzero(far < config.refine_distance)[0]
    near = near[(near < first) | (near >= last)]
    return near[:: len(near) // MOST_OTHERS + 1]


def _edge(
    patch: LineMap, keyframes: list[Keyframe], pair: tuple[int, int], guess: planar.Pose, config: SlamConfig
) -> Edge | None:
    cloud = keyframes[pair[1]].cloud
    match = patch.refine(cloud, guess, 2 * config.sigma, iterations=6)
    match = patch.refine(cloud, match.pose, config.sigma, iterations=8)
    moved = match.pose - guess
    if match.share < LEAST_SHARE or moved[0] ** 2 + moved[1] ** 2 > 0.1 or abs(moved[2]) > 0.1:
        return None
    information = without_weak(in_second_frame(match.information, float(match.pose[2])), WEAK)
    return Edge(*pair, match.pose, information, match.share)
