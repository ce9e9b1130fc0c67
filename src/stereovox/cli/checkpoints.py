# SPDX-License-Identifier: Apache-2.0
"""Save a map while it is being made, so that whatever ends the run costs no more than its last seconds."""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from math import inf, isfinite
from time import monotonic

from stereovox.errors import MapFileError, StereovoxError

SECONDS = 10.0
REST = 25
"""Times as long as a save took must pass before the next: so saves take at most 4 % of a run."""


def add_checkpoint(parser: ArgumentParser) -> None:
    """Declare the option."""
    parser.add_argument(
        "--checkpoint",
        type=float,
        default=SECONDS,
        metavar="SECONDS",
        help=f"save the map as often while it is made ({SECONDS:g}; 0: only at the end), in 4 %% of the time at most",
    )


class Checkpoints:
    """Saves a map between its frames, when it is time.

    save: writes the map, all or nothing. out: where, for messages. seconds: from one save to the next; 0: none before
    the end. clock: seconds now. Raises StereovoxError for seconds that cannot be.
    """

    def __init__(self, save: Callable[[], None], out: object, seconds: float, clock: Callable[[], float] = monotonic):
        if not (isfinite(seconds) and seconds >= 0):
            raise StereovoxError(f"--checkpoint {seconds:g}: give seconds, or 0 for none")
        self._save, self._out, self._clock = save, out, clock
        self._seconds = seconds or inf
        self._due = clock() + self._seconds
        self._saved = 0

    def after(self, frames: int) -> None:
        """Save if it is time. frames: how many are in the map."""
        start = self._clock()
        if start >= self._due:
            self.save(frames)
            done = self._clock()
            self._due = done + max(self._seconds, REST * (done - start))

    def save(self, frames: int) -> None:
        """Save now. Raises MapFileError, one line, where that fails; it also says what was saved before."""
        try:
            self._save()
        except MapFileError as error:
            raise MapFileError(f"{error}; {self.left()}") from None
        self._saved = frames

    def left(self) -> str:
        """Return what of the run is saved."""
        if not self._saved:
            return "nothing of this run is saved"
        return f"{self._out} holds this run up to frame {self._saved}"
