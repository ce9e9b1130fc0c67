# SPDX-License-Identifier: Apache-2.0
"""What every mapper does around its map: take frames one at a time, gate them, count refusals, monitor health."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, AnyImage, Scan, UpdateReport
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap
from stereovox.threads import MapLock
from stereovox.trust.gate import Gate, Passed
from stereovox.trust.health import FULL, HealthMonitor


class Intake:
    """Entrance for frames of one map: one frame at a time.

    A refused frame (FrameRefused) is counted in the map's history and changes nothing else.

    Attributes:
        gate: Compares each frame with those before it; its memory is the map's history.
        monitor: Records when each frame arrived and what became of it.
    """

    def __init__(self, config: Config, target: VoxelMap | GridMap, clock: Callable[[], int]):
        self.gate, self.monitor = Gate(config, target.history), HealthMonitor(config, clock)
        self._map, self._adding = target, MapLock()

    def offer(self, frame: AnyFrame | Scan) -> Offer:
        """Return a frame that arrives now; enter it with `with` while the map takes it in.

        Raises:
            StereovoxError: This thread holds the map's lock.
        """
        arrived_ns = self.monitor.now()
        self._map.lock.refuse_holder()
        return Offer(self, frame, arrived_ns)

    def closed(self) -> AbstractContextManager[object]:
        """Return what lets no frame in while it is entered."""
        return self._adding


class Offer:
    """A frame on its way into the map. While it is entered, others wait; a FrameRefused inside the block ends there.

    Attributes:
        report: What became of the frame: set by the mapper, or on exit where the frame was refused.
    """

    __slots__ = ("_arrived_ns", "_frame", "_intake", "report")
    report: UpdateReport

    def __init__(self, intake: Intake, frame: AnyFrame | Scan, arrived_ns: int):
        self._intake, self._frame, self._arrived_ns = intake, frame, arrived_ns

    def __enter__(self) -> Offer:
        self._intake._adding.acquire()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> bool:
        try:
            if not isinstance(error, FrameRefused):
                return False
            self._refuse(error)
            return True
        finally:
            self._intake._adding.release()

    def check(self, image: AnyImage | Scan) -> Passed:
        """Check the frame, of which `image` was made, and return what `accept` needs. Raises as `Gate.check`."""
        intake = self._intake
        with intake._map.lock:
            return intake.gate.check(self._frame, image)

    def accept(self, passed: Passed, quality: str = FULL) -> None:
        """Record that the map took the frame in; call it under the same hold of the map's lock."""
        intake, history = self._intake, self._intake._map.history
        history.offered(self._frame)
        history.frames += 1
        intake.gate.accept(passed)
        intake.monitor.accept(self._arrived_ns, passed.sensor, passed.seen.stamp_ns, quality)

    def _refuse(self, refused: FrameRefused) -> None:
        intake = self._intake
        with intake._map.lock:
            intake._map.history.offered(self._frame)
            intake._map.history.refuse(refused.reason)
        intake.monitor.refuse(self._arrived_ns, refused.reason)
        self.report = UpdateReport(refused=refused.reason, detail=str(refused))
