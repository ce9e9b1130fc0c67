# SPDX-License-Identifier: Apache-2.0
"""The engine of all runs: over a recording, a floor, a trajectory, live cameras, or the ROS node.

    with MapRun(source, out, **options) as run:   # opens and checks everything; nobody else may write to `out` now
        result = run.finish(observers)            # step by step, then saves and returns the result

A step maps one frame, calls the observers, and saves the map if that is due (`Checkpoints`). A signal ends the run
after a step; a source that fails also ends it. Both times the map is saved first. Each kind of run defines its steps
and its result: `recording.py`, `floor.py`, `trajectory.py`, `live/run.py`, `ros/run.py`.
"""

from __future__ import annotations

import signal
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass, field, fields
from inspect import signature
from math import inf, isfinite
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, Generic, Protocol, Self, TypeVar

from stereovox.config import Config
from stereovox.errors import MapFileError, SourceError, StereovoxError
from stereovox.evaluate.metrics import mostly_lost, summarise
from stereovox.frame import UpdateReport
from stereovox.mapper import AnyMapper
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap

CHECKPOINT_S = 10.0
REST = 25
"""Least pause between two saves, in durations of a save: saves take at most 4 % of a run."""
SURVEYED = 10
"""Frames of a recording that are read in advance, to suggest settings."""

AnyCallable = TypeVar("AnyCallable", bound=Callable[..., Any])
MapT = TypeVar("MapT", VoxelMap, GridMap)
ResultT = TypeVar("ResultT")
StepT = TypeVar("StepT")


def silent(line: str) -> None:
    """Discard a line."""


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """Options of every run.

    Attributes:
        profile: Profile name, TOML file or Config; None: `default`, or that of the map to continue.
        notify: Called with each line that a user should see: assumptions about the source, the frame to resume at.
        settings: Settings by name, as for `Mapper`; given as keyword arguments among the options.
    """

    profile: str | Path | Config | None = None
    notify: Callable[[str], None] = silent
    settings: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def names(cls) -> list[str]:
        """Return the names of all options but `settings`."""
        return [one.name for one in fields(cls) if one.name != "settings"]

    @classmethod
    def of(cls, given: Mapping[str, Any]) -> Self:
        """Return the options among keyword arguments; all others are settings."""
        own = {name: given[name] for name in cls.names() if name in given}
        return cls(**own, settings={name: value for name, value in given.items() if name not in own})


@dataclass(frozen=True, kw_only=True)
class MapOptions(RunOptions):
    """Options of every run that makes a map, in addition to `RunOptions`.

    Attributes:
        checkpoint_s: Seconds between two saves; 0: save only at the end.
    """

    checkpoint_s: float = CHECKPOINT_S


def takes(*kinds: Callable[..., Any]) -> Callable[[AnyCallable], AnyCallable]:
    """Add the keyword arguments of `kinds` to the signature of a function that passes `**options` on to them.

    `help` and notebooks show it.
    """

    def shown(function: AnyCallable) -> AnyCallable:
        own = signature(function)
        *first, rest = own.parameters.values()
        passed = [one for kind in kinds for one in signature(kind).parameters.values() if one.kind == one.KEYWORD_ONLY]
        passed = [one for one in passed if one.name != "settings"]
        function.__signature__ = own.replace(parameters=[*first, *passed, rest])  # pyrefly: ignore[missing-attribute]
        return function

    return shown


class Observer(Protocol):
    """Observer of a run, called for each frame: a progress bar, a live page, a recorder."""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Process a frame right after the mapper returned its report, whether it was mapped or refused.

        Args:
            frame: The `Frame`, `StereoFrame` or `Scan` that was offered.
            report: The report of the mapper's `add`.
        """
        ...


@dataclass(frozen=True)
class RunResult(Generic[MapT]):
    """The result of every run that makes a map.

    Attributes:
        map: The map, as saved.
        out: The path it was saved to.
        reports: One report for each frame of this run, in order.
    """

    map: MapT
    out: Path
    reports: list[UpdateReport]

    def _repr_html_(self) -> str:
        """Return the map's picture and facts, for notebooks."""
        return self.map._repr_html_(f"{type(self).__name__}, saved in {self.out}")

    def _summary(self, came: int, what: str, doubts: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
        """Summarise the run, with a doubt if most of the `what` (frames) that arrived are not in the map."""
        found = summarise(self.map, self.reports)
        if all_doubts := [*doubts, *mostly_lost(found["frames"], came, what)]:
            found["doubts"] = all_doubts
        return found


class Run(ABC, Generic[StepT, ResultT]):
    """One run in two steps: entering opens and checks everything, `finish` does the work.

    Attributes:
        stopped: Whether a signal ended it, if that is the usual end.
    """

    usual_end: tuple[type[BaseException], ...] = ()
    """Exceptions that end the run normally: a signal, if the steps never end by themselves."""
    _checkpoints: Checkpoints

    def __init__(self, notify: Callable[[str], None] = silent):
        self._notify, self._open = notify, ExitStack()
        self._observers: Sequence[Observer] = ()
        self._check: Callable[[], None] = lambda: None
        self.stopped = False

    def __enter__(self) -> Self:
        with ExitStack() as stack:  # a failure leaves nothing open
            self._begin(stack)
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def finish(self, observers: Sequence[Observer] = ()) -> ResultT:
        """Take all steps, and save the result.

        Args:
            observers: Called after each frame.

        Returns:
            The result of the run.

        Raises:
            StereovoxError: The source failed, the disk is full, or not one frame could be used.
            KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, raised between two frames after saving.
        """
        self._observers, self.stopped = observers, False
        self._prepare_steps()
        with interrupt_between_steps() as self._check, self._around():
            steps = self._steps()
            try:
                for step in steps:
                    self._go(step)
            except self.usual_end:
                self.stopped = True
            except (KeyboardInterrupt, SourceError):
                if self._kept:
                    self._checkpoints.save(self._kept)
                    self._notify(self._stopped_line())
                raise
            return self._end()  # a second signal, as `timeout` sends it, does not interrupt the save

    def _go(self, step: StepT) -> None:
        """Take one step; then a signal may end the run, or the map is saved if that is due."""
        self._take(step)
        self._check()
        self._save_if_due()

    def _save_if_due(self) -> None:
        if self._kept:
            self._checkpoints.after(self._kept)

    @abstractmethod
    def _begin(self, stack: ExitStack) -> None:
        """Open and check everything, make `_checkpoints`; `stack` is closed when the run ends, or cannot begin."""

    def _prepare_steps(self) -> None:
        """Do the work before the steps, which a signal may cut short."""

    def _around(self) -> AbstractContextManager[Any]:
        """Return a context that lasts from before the first step until all is saved."""
        return nullcontext()

    @abstractmethod
    def _steps(self) -> Iterable[StepT]:
        """Return the steps, in order."""

    @abstractmethod
    def _take(self, step: StepT) -> None:
        """Do one step, and call the observers."""

    @property
    def _kept(self) -> int:
        """Number of frames that a save would hold; 0 if there is nothing to save."""
        return 0

    def _stopped_line(self) -> str:
        """Return the line that reports a stopped run, once it is saved."""
        return ""

    @abstractmethod
    def _end(self) -> ResultT:
        """Save and return the result; raises StereovoxError if there is none."""


class MapperRun(Run[StepT, ResultT]):
    """A run whose steps are frames that a mapper adds to its map.

    Attributes:
        mapper: The mapper, once entered.
        reports: The report of each frame so far.
    """

    mapper: Any  # a `Mapper` or a `GridMapper`, by the kind of run

    def __init__(self, notify: Callable[[str], None] = silent):
        super().__init__(notify)
        self.reports: list[UpdateReport] = []

    def _take(self, step: StepT) -> None:
        try:
            report = self.mapper.add(step)
        except MapFileError as error:  # no room for a tile; in memory, the map is whole up to this frame
            self._checkpoints.save(frames_offered(self.mapper))
            raise MapFileError(f"{error}; {self._checkpoints.saved_so_far()}") from None
        self.reports.append(report)
        for one in self._observers:
            one.after(step, report)

    @property
    def _kept(self) -> int:
        """Number of frames offered to the map; 0 while all were refused: it must not replace an older map."""
        return frames_offered(self.mapper) if self.mapper.map.frames else 0

    def _first_refusal(self) -> str:
        """Return why the first refused frame was refused, "" if all were accepted."""
        return next((report.detail for report in self.reports if report.refused), "")


def frames_offered(mapper: AnyMapper[Any]) -> int:
    """Return the number of frames offered to a mapper's map, refused ones included."""
    return mapper.map.frames + mapper.map.frames_refused


class Checkpoints:
    """Saves a map between frames when a checkpoint is due.

    save: writes the map atomically. out: its path, for messages. seconds: between two saves; 0: save only at the end.
    clock: returns seconds. Raises StereovoxError for negative or infinite seconds.
    """

    def __init__(self, save: Callable[[], None], out: object, seconds: float, clock: Callable[[], float] = monotonic):
        if not (isfinite(seconds) and seconds >= 0):
            raise StereovoxError(f"checkpoint_s {seconds:g}: give seconds, or 0 for none")
        self._save, self._out, self._clock = save, out, clock
        self._seconds = seconds or inf
        self._due = clock() + self._seconds
        self._saved = 0

    def after(self, frames: int) -> None:
        """Save if a checkpoint is due. frames: number of frames offered so far."""
        start = self._clock()
        if start >= self._due:
            self.save(frames)
            done = self._clock()
            self._due = done + max(self._seconds, REST * (done - start))

    def save(self, frames: int) -> None:
        """Save now. Raises MapFileError if that fails: one line that also says what was saved before."""
        try:
            self._save()
        except MapFileError as error:
            raise MapFileError(f"{error}; {self.saved_so_far()}") from None
        self._saved = frames

    def saved_so_far(self) -> str:
        """Describe how much of the run is saved."""
        if not self._saved:
            return "nothing of this run is saved"
        return f"{self._out} holds this run up to frame {self._saved}"


@contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Defer signals: yield a function that raises KeyboardInterrupt if one has arrived, so that no step is cut in half.

    Handles Ctrl-C (a second one acts at once), SIGTERM (`kill`, systemd, docker stop) and SIGHUP (the terminal
    closed), which may arrive several times: `timeout` sends two. The exception holds the signal's number.
    """
    received: list[int] = []

    def remember(number: int, _: object) -> None:
        received.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check() -> None:
        if received:
            raise KeyboardInterrupt(received[0])

    with ExitStack() as stack:
        for number in _default_signals():
            stack.callback(signal.signal, number, signal.signal(number, remember))
        yield check


@contextmanager
def ended_in_order() -> Iterator[None]:
    """Let SIGTERM and SIGHUP end the block as Ctrl-C does: the first raises KeyboardInterrupt, which holds its number.

    Later signals, or another Ctrl-C, do not disturb the cleanup.
    """
    before = {number: signal.getsignal(number) for number in _default_signals()}

    def end(number: int, _: object) -> None:
        for one in before:
            signal.signal(one, signal.SIG_IGN)
        raise KeyboardInterrupt(number)

    try:
        for one in before:
            signal.signal(one, end)
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def _default_signals() -> list[int]:
    """Return the signals with default handling: notebooks, servers, nohup and background jobs set their own.

    Empty outside the main thread, which alone may handle signals.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    return [number for number, handler in usual.items() if signal.getsignal(number) == handler]
