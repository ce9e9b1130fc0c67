# SPDX-License-Identifier: Apache-2.0
"""An autopilot's poses as a stream for live cameras: `mavlink:udpin:0.0.0.0:14540`."""

from __future__ import annotations

from functools import cached_property

from stereovox.errors import SourceError, StereovoxError
from stereovox.frame.wall_clock import epoch_ns
from stereovox.geometry.se3 import Transform
from stereovox.mavlink.link import MavlinkLink
from stereovox.mavlink.poses import PoseReceiver
from stereovox.sources.poses.pose_stream import T_OPTICAL_BODY, PoseStream

PREFIX = "mavlink:"


class MavlinkPoses(PoseStream):
    """ODOMETRY, or LOCAL_POSITION_NED with attitudes, of an autopilot, synchronised by TIMESYNC.

    where: `mavlink:` and an address of `MavlinkLink`. Stamps are nanoseconds since 1970 by this machine's clock, which
    cameras also use. World x north, y west, z up; body x forward, y left, z up. See `PoseReceiver`.

    Attributes:
        url: The address.
    """

    def __init__(self, where: str):
        super().__init__(where)
        self.url = where.removeprefix(PREFIX)
        self._receiver: PoseReceiver | None = None

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` names an autopilot."""
        return where.startswith(PREFIX)

    @cached_property
    def link(self) -> MavlinkLink:
        """The connection, opened on first use; obstacle distances may use it too."""
        try:
            return MavlinkLink(self.url, clock=epoch_ns, tell=self._note)
        except StereovoxError as error:
            raise SourceError(str(error)) from None

    def start(self) -> None:
        """Start listening."""
        self._receiver = PoseReceiver(self.link, self, tell=self._note)
        super().start()

    def stop(self) -> None:
        """Stop listening."""
        super().stop()
        if self._receiver is not None:
            self._receiver.close()
            self.counts.update(self._receiver.passed_over)
            self._receiver = None
        if "link" in vars(self):
            self.link.close()

    def add(self, stamp_ns: int, T_world_body: Transform) -> None:
        """Add a pose of the body in optical axes."""
        self.poses.add(stamp_ns, T_world_body @ T_OPTICAL_BODY)

    def _receive(self) -> None:
        self._stopped.wait()

    def _note(self, line: str) -> None:
        self.trouble = line
