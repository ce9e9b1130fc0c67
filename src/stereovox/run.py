# SPDX-License-Identifier: Apache-2.0
"""A recording, a simulation or a live camera becomes a map on disk; whatever ends the run costs its last seconds.

What `stereovox map` does, for Python: `map_recording` in one call, `MapRun` for who wants the mapper before the first
frame. `kill -9`, a full disk, Ctrl-C and SIGTERM leave a map that opens, and `resume` goes on with it as if nothing had
happened.
"""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Any, Generic, Protocol, TypeVar

from stereovox import opening
from stereovox.config import Config
from stereovox.errors import MapFileError, SourceError, StereovoxError, one_line
from stereovox.evaluate.summary import summarise
from stereovox.frame import UpdateReport
from stereovox.localize.track import Track
from stereovox.mapper import AnyMapper, Mapper
from stereovox.maps import VoxelMap, load_map
from stereovox.maps.grid_map import GridMap
from stereovox.maps.lock import only_writer_in
from stereovox.maps.store import check_target, is_map, read_manifest, remove_map, sweep
from stereovox.opening import Stream
from stereovox.safe_io import check_in_space
from stereovox.trust.history import MAX_NAME_LENGTH

SeenT = TypeVar("SeenT")
MapT = TypeVar("MapT", VoxelMap, GridMap)

CHECKPOINT_S = 10.0
REST = 25
"""Times as long as a save took must pass before the next: so saves take at most 4 % of a run."""
MAX_UNUSABLE = 100
"""Frames of a live camera that a run may refuse before the first that it does not."""


class Observer(Protocol):
    """Sees each frame that was offered to the map: a progress bar, a page, a recorder."""

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Note a frame, right after `Mapper.add` returned `report`."""
        ...


@dataclass(frozen=True)
class MapResult(Generic[MapT]):
    """What a run made.

    Attributes:
        map: The map, as saved.
        out: Where.
        reports: One for each frame of this run, in order.
        dropped: Frames that a live camera delivered and nobody took in time.
        track: Of a floor's run the robot's way in the map; None where its odometry was believed.
    """

    map: MapT
    out: Path
    reports: list[UpdateReport]
    dropped: int = 0
    track: Track | None = None

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox map --json`: frames, refusals by reason, milliseconds, cells, memory."""
        return summarise(self.map, self.reports)


def map_recording(
    source: str | Path | Stream,
    out: str | Path,
    *,
    profile: str | Path | Config | None = None,
    resume: bool = False,
    frames: str | None = None,
    camera: str | Path | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    observers: Sequence[Observer] = (),
    tell: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> MapResult[VoxelMap]:
    """Make the map of a recording, a simulation or a live camera, and save it while it is made.

    Args:
        source: As for `open_source`, a live camera (`realsense:`), or a stream of your own.
        out: Folder of the map to write. An older map there is replaced with the first save, and stays whole until then.
        profile: Profile name, TOML file or Config; None: `default`, or with `resume` the map's own settings.
        resume: Go on with the map at `out`; as many frames of the source are skipped as it has seen.
        frames: Only these frames, as a Python slice: `"::4"`.
        camera: Camera file that replaces the recording's own.
        checkpoint_s: Seconds from one save to the next; 0: only at the end.
        observers: What is to see each frame.
        tell: Takes lines that a user should see: what had to be assumed, where the run goes on.
        **overrides: Settings by name, as for `Mapper`.

    Returns:
        The map and what became of each frame.

    Raises:
        StereovoxError: One line, where source, settings or place are wrong, another run writes there, the disk is full
            or not one frame could be used.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP, between two frames; what is there is saved.
    """
    settings = {"profile": profile, "resume": resume, "frames": frames, "camera": camera, "checkpoint_s": checkpoint_s}
    with MapRun(source, out, **settings, tell=tell, **overrides) as run:
        return run.finish(observers)


class MapRun:
    """`map_recording` in two steps: entered, it has its `mapper` and `source`; `finish` maps what is `left`.

    While it is open nobody else can write at `out`. Arguments as of `map_recording`.

    source: the stream of frames. Raises StereovoxError, when it is entered, for what can be known to be wrong by then.
    """

    mapper: Mapper
    source: Stream

    def __init__(
        self,
        source: str | Path | Stream,
        out: str | Path,
        *,
        profile: str | Path | Config | None = None,
        resume: bool = False,
        frames: str | None = None,
        camera: str | Path | None = None,
        checkpoint_s: float = CHECKPOINT_S,
        tell: Callable[[str], None] = lambda line: None,
        **overrides: Any,
    ):
        self.out = Path(out)
        self._where, self._frames, self._camera = source, frames, camera
        self._profile, self._resume, self._overrides = profile, resume, overrides
        self._tell, self._open = tell, ExitStack()
        self._checkpoint_s = checkpoint_s

    def __enter__(self) -> MapRun:
        with ExitStack() as stack:
            check_in_space(self.out)
            check_target(self.out)
            if self._resume and not is_map(self.out):
                raise StereovoxError(f"{self.out}: no map to go on with; start it without resume")
            stack.enter_context(only_writer_in(self.out))
            sweep(self.out)
            self.source = self._opened()
            self.mapper = self._mapper()
            stack.callback(self.mapper.map.close)
            self._checkpoints = Checkpoints(lambda: self.mapper.map.save(self.out), self.out, self._checkpoint_s)
            self._check_recording()
            for note in self.source.notes:
                self._tell(f"note: {note}")
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def finish(self, observers: Sequence[Observer] = ()) -> MapResult[VoxelMap]:
        """Add all frames that the map does not hold yet, and save it. Raises as `map_recording`."""
        with interrupt_between_steps() as check, _there_at_once(self.mapper.map, self.out):
            reports = self._add_all(check, observers)
            if not self.mapper.map.frames:
                raise StereovoxError(
                    f"{self.source.name}: not one frame could be used, no map is written ({_first_refusal(reports)})"
                )
            self._checkpoints.save(seen_by(self.mapper))
        return MapResult(self.mapper.map, self.out, reports, self.source.dropped)

    @property
    def left(self) -> int | None:
        """How many frames are not in the map yet; None for a live camera."""
        length = self.source.length
        return None if length is None else max(length - seen_by(self.mapper), 0)

    def _opened(self) -> Stream:
        source = self._where
        if isinstance(source, str | Path):
            source = opening.open_stream(str(source), self._frames)
        if self._camera is None:
            return source
        from stereovox.sources.camera_file import with_camera

        return with_camera(source, str(self._camera))

    def _mapper(self) -> Mapper:
        saved = load_map(self.out) if self._resume else None
        settings = self._profile
        if settings is None:
            settings = saved.config if saved else "default"
        tiles = self.out.parent / f".{self.out.name}-tiles"  # beside the map, not in a temporary folder in memory
        return Mapper(settings, resume=saved, tiles=tiles, **self._overrides)

    def _check_recording(self) -> None:
        """Frames are counted, not recognised: going on with another recording would skip its first ones."""
        made_of = self.mapper.map.recording
        if made_of and made_of != self.source.name:
            raise StereovoxError(
                f"{self.out}: was made of '{made_of}', not of '{self.source.name}'; go on with that, or start "
                "anew without resume"
            )
        self.mapper.map.recording = self.source.name

    def _add_all(self, check: Callable[[], None], observers: Sequence[Observer]) -> list[UpdateReport]:
        done, length = seen_by(self.mapper), self.source.length
        if done:
            if length is not None and done > length:
                raise StereovoxError(
                    f"{self.out}: holds {done} frames, more than the {length} of {self.source.name}; choose "
                    "the same frames as before"
                )
            self._check_last(done)
            if done == length:  # whoever starts a run again after a kill need not know that it was complete
                self._tell(f"{self.out} already holds all {done} frames of {self.source.name}")
                return []
            self._tell(f"going on after frame {done}")
        watching = (*observers, *([] if length is not None else [_Patience(self, done)]))
        stopped = "stopped after {} frames; they are saved in " + f"{self.out}, go on there with resume (--resume)"
        frames = self.source.after(done) if done else self.source
        return add_all(self.mapper, frames, self._checkpoints, check, watching, lambda n: self._tell(stopped.format(n)))

    def _check_last(self, done: int) -> None:
        """Frames are skipped by their number: under other frames some would be missed, and others counted twice."""
        last = self.mapper.map.history.last_frame
        if self.source.length is None or last is None:  # a live camera; a map from before this was saved
            return
        there = next(iter(self.source.after(done - 1)))
        if (one_line(there.name[:MAX_NAME_LENGTH]), there.stamp_ns) != last:
            raise StereovoxError(
                f"{self.out}: its frame {done} was '{last[0]}', here it is '{there.name}'; choose frames as "
                "before, or start anew without resume"
            )


def add_all(
    mapper: AnyMapper[SeenT],
    frames: Iterable[SeenT],
    checkpoints: Checkpoints,
    check: Callable[[], None],
    observers: Sequence[Observer],
    stopped: Callable[[int], None],
) -> list[UpdateReport]:
    """Add all frames to a map in space or of a floor, saving between them; return what became of each.

    check: raises KeyboardInterrupt where it is enough (`interrupt_between_steps`). stopped: called with the number of
    frames where it was, or the source failed, and what is there is saved; the error goes on.
    """
    reports: list[UpdateReport] = []
    try:
        for frame in frames:
            reports.append(_added(mapper, frame, checkpoints))
            for one in observers:
                one.after(frame, reports[-1])
            check()
            if mapper.map.frames:  # an empty map must not take the place of an older one
                checkpoints.after(seen_by(mapper))
    except (KeyboardInterrupt, SourceError):
        if mapper.map.frames:
            checkpoints.save(seen_by(mapper))
            stopped(len(reports))
        raise
    return reports


def seen_by(mapper: AnyMapper[Any]) -> int:
    """Return how many frames a mapper's map was offered."""
    return mapper.map.frames + mapper.map.frames_refused


def _added(mapper: AnyMapper[SeenT], frame: SeenT, checkpoints: Checkpoints) -> UpdateReport:
    try:
        return mapper.add(frame)
    except MapFileError as error:  # no room for a tile; up to this frame the map is whole in memory
        checkpoints.save(seen_by(mapper))
        raise MapFileError(f"{error}; {checkpoints.left()}") from None


class _Patience:
    """Ends a run whose live camera delivers nothing that can be used: it would be refused for ever."""

    def __init__(self, run: MapRun, done: int):
        self._run, self._done, self._first, self._refused = run, done, "", 0

    def after(self, frame: Any, report: UpdateReport) -> None:
        if self._refused < 0 or not report.refused:
            self._refused = -1  # one could be used
            return
        self._first, self._refused = self._first or report.detail, self._refused + 1
        if self._refused == MAX_UNUSABLE:
            left = f"{self._run.out} stays as it is" if self._done else "no map is written"
            raise StereovoxError(
                f"{self._run.source.name}: not one of {MAX_UNUSABLE} frames could be used, {left} ({self._first})"
            )


@contextmanager
def _there_at_once(voxel_map: VoxelMap, out: Path) -> Iterator[None]:
    """Save a map that is new before its first frame: one that is killed is there; remove it if it stays empty."""
    new = not is_map(out)
    if new:
        voxel_map.save(out)
    try:
        yield
    finally:
        if new and is_map(out) and not read_manifest(out)["frames"]:
            remove_map(out)


def _first_refusal(reports: list[UpdateReport]) -> str:
    return next((report.detail for report in reports if report.refused), "the source is empty")


class Checkpoints:
    """Saves a map between its frames, when it is time.

    save: writes the map, all or nothing. out: where, for messages. seconds: from one save to the next; 0: none before
    the end. clock: seconds now. Raises StereovoxError for seconds that cannot be.
    """

    def __init__(self, save: Callable[[], None], out: object, seconds: float, clock: Callable[[], float] = monotonic):
        if not (isfinite(seconds) and seconds >= 0):
            raise StereovoxError(f"a checkpoint every {seconds:g} s cannot be; give seconds, or 0 for none")
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


@contextmanager
def interrupt_between_steps() -> Iterator[Callable[[], None]]:
    """Give a function that raises KeyboardInterrupt if the run was told to stop: a step is never cut in half by it.

    By Ctrl-C, of which a second one is obeyed at once, by SIGTERM (`kill`, systemd, docker stop) or by SIGHUP (the
    terminal is gone), which may come several times: `timeout` sends two. The exception holds the signal's number.
    """
    told: list[int] = []

    def remember(number: int, _: object) -> None:
        told.append(number)
        if number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.default_int_handler)

    def check() -> None:
        if told:
            raise KeyboardInterrupt(told[0])

    with ExitStack() as stack:
        for number in _stops() if threading.current_thread() is threading.main_thread() else ():
            stack.callback(signal.signal, number, signal.signal(number, remember))
        yield check


def _stops() -> list[int]:
    """Return the signals that nobody handles or ignores: notebooks, servers, nohup, jobs in the background do."""
    usual = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    if hasattr(signal, "SIGHUP"):
        usual[signal.SIGHUP] = signal.SIG_DFL
    return [number for number, handler in usual.items() if signal.getsignal(number) == handler]
