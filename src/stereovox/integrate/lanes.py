# SPDX-License-Identifier: Apache-2.0
"""Scratch memory of rays that are walked side by side, one lane a ray, so that wide registers can be used."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.integrate._lanes import LANES, MEMORY_BITS

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]
Keys = NDArray[np.signedinteger]


class Lanes(NamedTuple):
    """One number a lane. Depths are along the optical axis, in metres; places in cells from the camera's block."""

    depth: Floats  # measured depth, NO_RETURN for nothing up to the maximum range
    end: Floats  # depth at which the ray ends, negative for a lane without a ray
    entered: Floats  # depth at which the ray entered its present cell (or the depth of the sample)
    row: Ints  # row of the sensor table
    columns: Floats  # table columns a metre
    x: Floats  # the face at which the ray leaves its cell along x: whole numbers, as floats because they meet floats
    y: Floats
    z: Floats
    per_x: Floats  # depth one cell takes along each axis; for line drawing, cells one metre of depth takes
    per_y: Floats
    per_z: Floats
    hit: Keys  # key of the cell that holds the measured point, -1 without one
    cell: Keys  # key of the cell the ray goes into next
    key: Keys  # key of the cell that is given evidence in this step
    gain: Ints  # and the evidence
    last: Ints  # whether the next lane says something else
    run_key: Keys  # what neighbouring lanes say together, run by run
    run_gain: Ints


class Memory(NamedTuple):
    """Blocks found lately, so that most need no search in the hash: (2^MEMORY_BITS,) each."""

    block: NDArray[np.int64]  # key of its first cell, -1 for none
    place: NDArray[np.int64]  # its place in the pool


def make_lanes(wide: bool) -> Lanes:
    """Return scratch with keys of 64 bits (`wide`) or 32 bits, which serve cells within 2^9 of the camera."""
    types = {"Floats": np.float32, "Ints": np.int32, "Keys": np.int64 if wide else np.int32}
    kinds = {name: getattr(kind, "__forward_arg__", kind) for name, kind in Lanes.__annotations__.items()}
    arrays: dict[str, Any] = {name: np.full(LANES + 1, -2, types[kind]) for name, kind in kinds.items()}
    return Lanes(**arrays)


def make_memory() -> Memory:
    """Return an empty memory of blocks."""
    return Memory(*(np.full(1 << MEMORY_BITS, -1, np.int64) for _ in range(2)))
