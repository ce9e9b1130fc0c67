# SPDX-License-Identifier: Apache-2.0
"""Whether scans come in order of time, though a single stamp may be wrong."""

from __future__ import annotations

from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.integrate.scan_check import name_of

LATE_IN_A_ROW = 10
"""So many scans that come too late, each later than the one before, and the stamp before them was the wrong one."""


class Clock:
    """Refuses scans that are not later than the last one, until so many in a row agree that the clock was set back.

    set_back: how often that was found, and a scan taken in whose stamp is not later than that of the one before.
    """

    def __init__(self):
        self.set_back = 0
        self._last_ns: int | None = None
        self._late_ns: int | None = None
        self._late = 0

    def take(self, scan: Scan) -> None:
        """Go on to the stamp of a scan. Raises FrameRefused with the reason `not_in_order` where it does not rise."""
        if self._last_ns is not None and scan.stamp_ns <= self._last_ns:
            self._take_late(scan, self._last_ns)
        self._last_ns, self._late_ns, self._late = scan.stamp_ns, None, 0

    def _take_late(self, scan: Scan, last_ns: int) -> None:
        rises = self._late_ns is None or scan.stamp_ns > self._late_ns
        self._late_ns, self._late = scan.stamp_ns, self._late + 1 if rises else 1
        if self._late <= LATE_IN_A_ROW:
            said = f"at {scan.stamp_ns} ns, is not later than the scan before it at {last_ns} ns"
            raise FrameRefused("not_in_order", f"{name_of(scan)}: {said}; give scans in order of time")
        self.set_back += 1
