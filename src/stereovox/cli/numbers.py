# SPDX-License-Identifier: Apache-2.0
"""Options whose value is several numbers: places, boxes, heights, transforms."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

from stereovox.errors import StereovoxError

if TYPE_CHECKING:
    from stereovox.geometry import Transform

LARGEST_FILE = 10_000
"""Bytes of a file that holds a transform."""


def numbers_of(option: str, text: str, names: str) -> list[float]:
    """Return as many numbers as there are `names` ("X,Y,Z"); raises StereovoxError that names the option."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != len(names.split(",")) or any(map(math.isnan, numbers)):
        raise StereovoxError(f"{option} {text}: write {names}, numbers in metres with commas and no blanks")
    return numbers


def transform_of(text: str) -> Transform:
    """Return the transform that `--transform` names: seven numbers, or a file with them or with a 4x4 matrix.

    Raises StereovoxError: one line that names the value or file and the cure.
    """
    import numpy as np

    from stereovox.geometry import from_quaternion
    from stereovox.products.moved import rigid
    from stereovox.untrusted import read_text

    where = f"--transform {text}"
    try:
        words = text if "," in text else read_text(Path(text), LARGEST_FILE)
        numbers = np.array([float(word) for word in words.replace(",", " ").split()])
    except (OSError, UnicodeError, ValueError):
        numbers = np.array([])
    if numbers.size == 7 and np.isfinite(numbers).all() and numbers[3:].any():
        return from_quaternion(numbers[:3], numbers[3:])
    if numbers.size != 16 or not np.isfinite(numbers).all():
        raise StereovoxError(f"{where}: write tx,ty,tz,qx,qy,qz,qw, or name a file with these or with a 4x4 matrix")
    try:
        return rigid(numbers.reshape(4, 4))
    except StereovoxError as error:
        raise StereovoxError(f"{where}: {error}") from None


def heights_of(text: str | None) -> tuple[float, float] | None:
    """Return what --heights says; raises StereovoxError where that is not LO:HI."""
    if text is None:
        return None
    low, _, high = text.partition(":")
    try:
        heights = float(low), float(high)
    except ValueError:
        raise StereovoxError(f"--heights {text}: write LO:HI in metres, for example --heights 0.1:1.8") from None
    if not heights[0] < heights[1]:
        raise StereovoxError(f"--heights {text}: the second must be higher than the first")
    return heights
