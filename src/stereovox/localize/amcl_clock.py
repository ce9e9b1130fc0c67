# SPDX-License-Identifier: Apache-2.0
"""Whether scans come in order of time, though a few stamps may be wrong."""

from __future__ import annotations

from array import array
from bisect import bisect_left

from stereovox.errors import FrameRefused
from stereovox.frame import Scan, name_of

LATE = 3
"""Scans in a row that are too late, and in order among themselves, before it is asked who is right."""


class Clock:
    """The stamps of the scans so far, rising.

    A lone stamp in the future would make all later scans too late. So once more scans in a row are late than there are
    scans that they would have to come before, it is those before that had the wrong stamps (as `slam_way.Way`).
    """

    def __init__(self):
        self._stamps_ns = array("q")
        self._late, self._late_ns = 0, 0

    def take(self, scan: Scan) -> int:
        """Go on to the time of a scan; return how many of the last scans turn out to have had a wrong stamp.

        Raises FrameRefused with the reason `not_in_order` where the scan is not later than the one before.
        """
        ahead = len(self._stamps_ns) - bisect_left(self._stamps_ns, scan.stamp_ns)
        if ahead:
            self._count_late(scan, ahead)
            del self._stamps_ns[-ahead:]
        self._stamps_ns.append(scan.stamp_ns)
        self._late = 0
        return ahead

    def _count_late(self, scan: Scan, ahead: int) -> None:
        self._late = self._late + 1 if self._late and scan.stamp_ns > self._late_ns else 1
        self._late_ns = scan.stamp_ns
        if self._late <= max(ahead, LATE):
            said = f"at {scan.stamp_ns} ns, is not later than the scan before it at {self._stamps_ns[-1]} ns"
            raise FrameRefused("not_in_order", f"{name_of(scan)}: {said}; give scans in order of time")
