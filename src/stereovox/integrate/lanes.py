# SPDX-License-Identifier: Apache-2.0
"""Scratch memory of rays that are walked side by side, one lane a ray, so that wide registers can be used."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LANES = 32
"""Neighbouring pixels of a row that are walked in step."""

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
    x: Floats  # present cell: whole numbers, as floats because they meet floats only
    y: Floats
    z: Floats
    step_x: Floats  # -1 or 1
    step_y: Floats
    step_z: Floats
    per_x: Floats  # depth one cell takes along each axis; for line drawing, cells one metre of depth takes
    per_y: Floats
    per_z: Floats
    hit: Keys  # key of the cell that holds the measured point, -1 without one
    key: Keys  # key of the cell that is given evidence in this step
    gain: Ints  # and the evidence


def make_lanes(wide: bool) -> Lanes:
    """Return scratch with keys of 64 bits (`wide`) or 32 bits, which serve cells within 2^9 of the camera."""
    types = {"Floats": np.float32, "Ints": np.int32, "Keys": np.int64 if wide else np.int32}
    kinds = {name: getattr(kind, "__forward_arg__", kind) for name, kind in Lanes.__annotations__.items()}
    arrays: dict[str, Any] = {name: np.zeros(LANES, types[kind]) for name, kind in kinds.items()}
    return Lanes(**arrays)
