# SPDX-License-Identifier: Apache-2.0
"""What every mapper does around its map: frames one at a time, the gate, refusals, health."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, DepthImage, Scan, UpdateReport
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap
from stereovox.threads import MapLock
from stereovox.trust.gate import Gate, Passed
from stereovox.trust.health import FULL, Watch


class Intake:
    """The way of frames into one map, one frame at a time.

    A frame that is refused (FrameRefused) is counted in the map's history and changes nothing else.

    Attributes:
        gate: Compares each frame with those before it; what it remembers is in the map's history.
        watch: Notes what became of each frame, and when it arrived.
    """

    def __init__(self, config: Config, its_map: VoxelMap | GridMap, clock: Callable[[], int]):
        self.gate, self.watch = Gate(config, its_map.history), Watch(config, clock)
        self._map, self._adding = its_map, MapLock()

    def offer(self, frame: AnyFrame | Scan) -> Offer:
        """Return a frame that arrives now, to be entered by `with` while the map takes it in.

        Raises:
            StereovoxError: This thread holds the map's lock.
        """
        arrived_ns = self.watch.now()
        self._map.lock.refuse_holder()
        return Offer(self, frame, arrived_ns)


class Offer:
    """One frame on its way into the map; while it is entered, others wait. A FrameRefused ends with it.

    Attributes:
        report: What became of the frame: set by the mapper, or here where the frame was refused.
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

    def check(self, image: DepthImage | Scan) -> Passed:
        """Return what `took` is to remember of the frame, of which `image` was made. Raises as `Gate.check`."""
        intake = self._intake
        with intake._map.lock:
            return intake.gate.check(self._frame, image)

    def took(self, passed: Passed, way: str = FULL) -> None:
        """Note that the map took the frame in; called while the map's lock is still held for that."""
        intake, history = self._intake, self._intake._map.history
        history.offered(self._frame)
        history.frames += 1
        intake.gate.took(passed)
        intake.watch.took(self._arrived_ns, passed.sensor, passed.seen.stamp_ns, way)

    def _refuse(self, refused: FrameRefused) -> None:
        intake = self._intake
        with intake._map.lock:
            intake._map.history.offered(self._frame)
            intake._map.history.refuse(refused.reason)
        intake.watch.refused(self._arrived_ns, refused.reason)
        self.report = UpdateReport(refused=refused.reason, detail=str(refused))
