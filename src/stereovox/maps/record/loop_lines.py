# SPDX-License-Identifier: Apache-2.0
"""The closed loops of a map as lines between places, for drawing; saved with the map."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.geometry.se3 import Transform, transform_points
from stereovox.maps.record.camera_path import FARTHEST

MAX_LINES = 8192
"""Most lines kept of each kind; if there are more, an even selection is kept."""
ENDS = 6
"""Numbers per line."""
KEPT_AS = "<f4"


@dataclass(frozen=True)
class Lines:
    """Lines between pairs of places.

    Attributes:
        number: How many there are.
        packed: The ends of at most `MAX_LINES` of them, as `ends` returns them; bytes, since maps are copied often.
    """

    number: int = 0
    packed: bytes = b""

    @classmethod
    def between(cls, ends: ArrayLike) -> Lines:
        """Return the lines with these ends (N, 2, 3) in metres, world frame."""
        all_ends = np.asarray(ends, KEPT_AS).reshape(-1, ENDS)
        some = np.unique(np.linspace(0, len(all_ends) - 1, min(len(all_ends), MAX_LINES)).astype(int))
        return cls(len(all_ends), all_ends[some].tobytes())

    @property
    def ends(self) -> NDArray[np.float64]:
        """Return the ends (N, 2, 3) in metres, world frame."""
        return np.frombuffer(self.packed, KEPT_AS).reshape(-1, 2, 3).astype(float)

    def moved(self, T: Transform) -> Lines:
        """Return the lines transformed by T (4, 4)."""
        return Lines(self.number, Lines.between(transform_points(T, self.ends)).packed)

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, which `loaded` reads."""
        return {"number": self.number, "ends": base64.b64encode(self.packed).decode("ascii")}

    @classmethod
    def loaded(cls, saved: Any) -> Lines:
        """Return saved lines. Raises KeyError, TypeError or ValueError if the values cannot be lines."""
        number, text = saved["number"], saved["ends"]
        if not isinstance(text, str) or len(text) > 8 * ENDS * MAX_LINES:
            raise ValueError("loops: not packed numbers")
        lines = cls(number, base64.b64decode(text, validate=True))
        ends = np.frombuffer(lines.packed, KEPT_AS)
        if len(ends) % ENDS or not (np.abs(ends) <= FARTHEST).all():  # False for NaN
            raise ValueError("loops: invalid places")
        if type(number) is not int or min(number, MAX_LINES) != len(ends) // ENDS:
            raise ValueError(f"loops: {number} instead of {len(ends) // ENDS} lines")
        return lines


@dataclass(frozen=True)
class LoopLines:
    """The record of loop closure in a map.

    Attributes:
        closed: Lines between the two places of each closed loop.
        refused: Lines between places that look the same but were rejected as loops.
    """

    closed: Lines = Lines()
    refused: Lines = Lines()

    @classmethod
    def between(cls, closed: ArrayLike, refused: ArrayLike) -> LoopLines:
        """Return lines with these ends (N, 2, 3) in metres, world frame."""
        return cls(Lines.between(closed), Lines.between(refused))

    def moved(self, T: Transform) -> LoopLines:
        """Return the lines transformed by T (4, 4)."""
        return LoopLines(self.closed.moved(T), self.refused.moved(T))

    def counts(self) -> dict[str, int]:
        """Return the number of lines of each kind."""
        return {"closed": self.closed.number, "refused": self.refused.number}

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, which `loaded` reads."""
        return {"closed": self.closed.saved(), "refused": self.refused.saved()}

    @classmethod
    def loaded(cls, saved: Any) -> LoopLines:
        """Return saved lines. Raises KeyError, TypeError or ValueError if the values cannot be lines."""
        return cls(Lines.loaded(saved["closed"]), Lines.loaded(saved["refused"]))
