# SPDX-License-Identifier: Apache-2.0
"""Places as they are written on a command line."""

from __future__ import annotations

import math
from argparse import ArgumentTypeError


def point(text: str) -> tuple[float, float, float]:
    """Return three numbers in metres from X,Y,Z; raises ArgumentTypeError for anything else."""
    try:
        x, y, z = map(float, text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not math.isfinite(x + y + z):
        raise ArgumentTypeError(f"'{text}' is no point; give X,Y,Z in metres")
    return x, y, z
