# SPDX-License-Identifier: Apache-2.0
"""Flights past random evidence, for tests of whole maps: what a camera would see, without one."""

import itertools
from typing import NamedTuple

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.frame import Viewpoint
from stereovox.maps.cells.evidence import Evidence

CAMERA = PinholeCamera.from_field_of_view(64, 48, 90)
AROUND = np.array(list(itertools.product(range(-2, 3), repeat=3)))


class Moment(NamedTuple):
    """Where the camera stands, and what it says there."""

    viewpoint: Viewpoint
    evidence: Evidence


def at(position, stamp_ns=0):
    T = np.eye(4)
    T[:3, 3] = position
    return Viewpoint(CAMERA, T, stamp_ns)


def evidence_about(random, position, side_m=0.8, blocks=16):
    """Random values in blocks about a place, some of them all zero, and some blocks that are wholly free."""
    picked = random.permutation(np.floor(np.asarray(position) / side_m).astype(int) + AROUND)[:blocks].astype(np.int32)
    half = blocks // 2
    values = random.integers(-2500, 2500, (half, 512)).astype(np.int16)
    values[(random.random(values.shape) < 0.6) | (np.abs(values) < 40)] = 0  # what is left counts in every format
    values[0] = 0
    return Evidence(picked[:half].copy(), values, picked[half:].copy(), int(random.choice([-300, -9000])))


def flight(seed, frames, step_m=0.4, step_s=0.3, blocks=16):
    """A way out and back, with uneven steps of time."""
    random = np.random.default_rng(seed)
    stamps = np.cumsum(random.integers(1, int(2e9 * step_s), frames)) + 5_000_000_000
    for i, stamp_ns in enumerate(stamps.tolist()):
        place = (step_m * min(i, frames - i), 0.1 * i, 0.0)
        yield Moment(at(place, stamp_ns), evidence_about(random, place, blocks=blocks))


def fly(one, moments):
    for viewpoint, evidence in moments:
        one.storage.check_room(evidence)
        one.storage.set_viewpoint(viewpoint)
        one.add(evidence)
        one.frames += 1
    return one


def blocks_and_times(one):
    """All that a map says of its cells."""
    parts = zip(*(one.storage.timed() if one.config.map.keep_times else one.storage.slabs()), strict=True)
    return [np.concatenate(part) for part in parts]


def assert_same(one, other):
    assert one.frames == other.frames
    for a, b in zip(blocks_and_times(one), blocks_and_times(other), strict=True):
        np.testing.assert_array_equal(a, b)
