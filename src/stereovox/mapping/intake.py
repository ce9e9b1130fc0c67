# SPDX-License-Identifier: Apache-2.0
"""What every mapper does around its map: accept frames one at a time, gate them, count refusals, monitor health."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType

from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, AnyImage, Range, Scan, UpdateReport
from stereovox.frame.stamp_clock import StampsBy, epoch_ns
from stereovox.kernels.threads import MapLock
from stereovox.mapping.gate import Gate, GateResult
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap
from stereovox.maps.record.health import FULL, Health, HealthMonitor
from stereovox.maps.record.history import TRIES


class Intake:
    """Entrance for frames of one map: one frame at a time.

    A refused frame (FrameRefused) is counted in the map's history and changes nothing else.

    is_new: whether the map begins with these frames; it is then provisional until two of them agree.

    Attributes:
        gate: Compares each frame with earlier ones; its memory is the map's history.
        monitor: Records when each frame was taken, when it arrived, and what became of it.
    """

    def __init__(
        self,
        config: Config,
        target: VoxelMap | GridMap,
        clock: Callable[[], int],
        stamps_by: StampsBy,
        is_new: bool,
    ):
        if is_new and config.trust.max_disagreement < 1:
            target.history.unconfirmed = TRIES
        self.gate = Gate(config, target.history)
        self.monitor = HealthMonitor(config, clock, stamps_by, epoch_ns)
        self._map, self._adding = target, MapLock()

    def offer(self, frame: AnyFrame | Scan) -> PendingFrame:
        """Return a frame that arrives now; use it in a `with` block around the integration.

        Raises:
            StereovoxError: This thread holds the map's lock.
        """
        arrived_ns = self.monitor.now()
        self._map.lock.refuse_holder()
        return PendingFrame(self, frame, arrived_ns)

    @property
    def is_provisional(self) -> bool:
        """Whether no two frames of the map have agreed yet."""
        return self._map.history.is_provisional

    def closed(self) -> AbstractContextManager[object]:
        """Return a context that lets no frame in while it is entered."""
        return self._adding


class Aged:
    """The queries of a mapper about its map's age, answered by its `_intake`."""

    _intake: Intake

    def health(self, now_ns: int | None = None) -> Health:
        """Return how current the map is.

        Args:
            now_ns: Nanoseconds by `clock`; None for now.

        Returns:
            State, age and recent refusals of the map.
        """
        intake = self._intake
        return intake.monitor.health(now_ns, intake.is_provisional)

    @property
    def stamp_clock(self) -> StampsBy:
        """The clock of the frames' stamps, by which `health` knows how late they are; it may be set at any time.

        A function: returns the present time by that clock in nanoseconds, None while it is unknown. "live": stamps
        advance in real time, by a clock of this machine, which is recognised, or by another clock, whose least delay
        seen so far counts as zero. "replay": stamps are from a recording, played at any speed; ages count from the
        newest stamp. None: a clock of this machine if one is recognised, else as "replay", until an `ObstacleSender`
        makes it "live". Setting it raises ConfigError for anything else.
        """
        return self._intake.monitor.stamps.by

    @stamp_clock.setter
    def stamp_clock(self, clock: StampsBy) -> None:
        self._intake.monitor.stamps.by = clock

    def heard(self, stamp_ns: int, source: str = "poses") -> None:
        """Record that a stamped message, such as a pose, arrived now: anything stamped earlier is at least as old.

        Args:
            stamp_ns: Its time in nanoseconds, by the clock of the frames' stamps.
            source: Its origin.
        """
        monitor = self._intake.monitor
        monitor.stamps.heard(f"{source} alone", int(stamp_ns), monitor.now())

    def now_ns(self) -> int:
        """Return nanoseconds by the mapper's `clock`, which never goes back."""
        return self._intake.monitor.now()

    def age_ns(self, stamp_ns: int, came_ns: int) -> int:
        """Return the age of something with this stamp that arrived at `came_ns` by `now_ns`, at least its time here."""
        now_ns = self.now_ns()
        return max(self._intake.monitor.stamps.age_ns(stamp_ns, now_ns), now_ns - came_ns)


class PendingFrame:
    """A frame that is being added. While it is entered, others wait; a FrameRefused inside the block ends there.

    Attributes:
        report: What became of the frame: set by the mapper, or on exit if the frame was refused.
    """

    __slots__ = ("_arrived_ns", "_frame", "_intake", "report")
    report: UpdateReport

    def __init__(self, intake: Intake, frame: AnyFrame | Scan, arrived_ns: int):
        self._intake, self._frame, self._arrived_ns = intake, frame, arrived_ns

    def __enter__(self) -> PendingFrame:
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

    def check(self, image: AnyImage | Scan | Range) -> GateResult:
        """Check the frame, the source of `image`, and return what `accept` needs. Raises as `Gate.check`."""
        intake = self._intake
        with intake._map.lock:
            return intake.gate.check(self._frame, image)

    def accept(self, passed: GateResult, quality: str = FULL) -> None:
        """Record that the frame was integrated; call it under the same hold of the map's lock."""
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
