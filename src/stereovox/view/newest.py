# SPDX-License-Identifier: Apache-2.0
"""Work that many threads ask for, and of which only the newest request counts."""

from __future__ import annotations

import threading
from collections.abc import Callable


class Newest:
    """Runs `job` for whoever calls, one at a time; of calls that wait for one that runs, one run serves all.

    A page's controls call from many threads, and a slider that is dragged faster than it is drawn.
    """

    def __init__(self, job: Callable[[], None]):
        self._job = job
        self._running, self._counting = threading.RLock(), threading.Lock()
        self._asked = self._done = 0

    def __call__(self) -> None:
        """Return when the job was begun and ended after this call."""
        with self._counting:
            self._asked += 1
            mine = self._asked
        with self._running:
            if self._done < mine:
                with self._counting:
                    self._done = self._asked
                self._job()
