# SPDX-License-Identifier: Apache-2.0
"""Map cameras that are connected now: the Python side of `stereovox live`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from types import TracebackType
from typing import TYPE_CHECKING, Any

from stereovox.config import Config
from stereovox.errors import StereovoxError
from stereovox.evaluate.summary import mostly_lost, summarise
from stereovox.frame import UpdateReport
from stereovox.geometry.se3 import inverse, orthonormalise
from stereovox.live.latency import Latency
from stereovox.live.outputs import GridFile, LiveSphere, Output
from stereovox.live.poses import open_poses
from stereovox.live.recorder import Recorder
from stereovox.live.rig import LiveCamera, read_live
from stereovox.live.stream import WAIT_S, LiveStream
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.products.floor.floor_axes import Heights
from stereovox.runs.pose_choice import GIVEN, TRACK
from stereovox.runs.recording import CHECKPOINT_S, MapRun, Observer, interrupt_between_steps
from stereovox.runs.warm_up import warm_up
from stereovox.sources.base import Stream
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.pose_stream import T_OPTICAL_BODY, PoseStream

if TYPE_CHECKING:
    from stereovox.mavlink.sending import ObstacleSender

Cameras = str | Path | Stream | LiveCamera | Sequence[str | Path | Stream | LiveCamera]
PosesFrom = str | PoseStream | LivePoses | None


@dataclass(frozen=True)
class LiveResult:
    """What became of a live run.

    Attributes:
        map: The map, as saved.
        out: Where it was saved.
        reports: One report for each image that was offered to the map, in order.
        stopped: Whether a signal ended it (Ctrl-C, SIGTERM or SIGHUP), as is usual.
        live: Latency, images and poses by where they came from, and outputs: the part `live` of `summary`.
        poses: `given`, `track`, or the name of the stream of poses.
        failures: What was to be written next to the map and is not, a line each.
    """

    map: VoxelMap
    out: Path
    reports: list[UpdateReport]
    stopped: bool
    live: dict[str, Any]
    poses: str
    failures: Sequence[str] = ()

    def summary(self) -> dict[str, Any]:
        """Summarise the run.

        Returns:
            The numbers of `stereovox live --json`: those of `map`, and `live`; `not_written` if something was to be
            and is not.
        """
        found = {**summarise(self.map, self.reports), "poses": self.poses, "live": self.live}
        came = sum(counts["received"] for counts in self.live["cameras"].values())
        if doubts := mostly_lost(found["frames"], came, "images"):
            found["doubts"] = doubts
        return {**found, "not_written": list(self.failures)} if self.failures else found


def map_live(
    cameras: Cameras,
    out: str | Path,
    *,
    poses: PosesFrom = None,
    profile: str | Path | Config | None = None,
    resume: bool = False,
    wait_s: float = WAIT_S,
    seconds: float | None = None,
    grid: str | Path | None = None,
    heights: Heights | None = None,
    sphere: str | Path | None = None,
    record: str | Path | None = None,
    view: int | None = None,
    mavlink: str | None = None,
    checkpoint_s: float = CHECKPOINT_S,
    observers: Sequence[Observer] = (),
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> LiveResult:
    """Map one or several cameras while they run, until a signal (Ctrl-C, SIGTERM), `seconds`, or they end.

    Each image waits for its pose; one whose pose does not come is refused with the reason, and no pose is guessed. The
    map is saved at regular checkpoints and at the end, as by `map_recording`.

    Args:
        cameras: Name of a camera (`realsense:`) or recording, a `live.toml`, a `Stream`, a `LiveCamera`, or several of
            these but a `live.toml`.
        out: Folder of the map to write.
        poses: `track`: the first camera is tracked by its own images; `given`: those that images come with; a name of a
            stream (`t265`, `udp://:5005`, `tcp://HOST:5005`), a `PoseStream`, or a `LivePoses` that you fill. None:
            as the `live.toml` says, else given where all images have poses, else track.
        profile: Profile name, TOML file or Config; None: `default`, or with `resume` the map's own settings.
        resume: Continue the map at `out`; the poses must be in its world.
        wait_s: Seconds that an image waits for its pose.
        seconds: How long to map.
        grid: 2-D map to keep up to date (`.yaml`).
        heights: Lowest and highest metres above the floor that a robot occupies, for that map.
        sphere: Picture of the distances all round to draw at the end (`.png`).
        record: Recording to write beside (`.mcap`, `.bag` or `.db3`).
        view: Port of a page that shows the map while it grows; 0: any free port. None: no page.
        mavlink: Address of an autopilot that gets obstacle distances (`ObstacleSender`), such as
            `udpout:127.0.0.1:14540`; where poses come from it too, the same address.
        checkpoint_s: Seconds between two saves; 0: save only at the end.
        observers: Called after each image, before the other outputs.
        notify: Called with each line that a user should see.
        **overrides: Settings by name, as for `Mapper`.

    Returns:
        The map, the report of each image, and how long they took.

    Raises:
        StereovoxError: One line: invalid cameras, poses, settings or outputs, all cameras failed, or not one image
            could be used. What was mapped until then is saved.
    """
    given: dict[str, Any] = {"poses": poses, "profile": profile, "resume": resume, "wait_s": wait_s}
    given |= {"seconds": seconds, "checkpoint_s": checkpoint_s, "notify": notify}
    with LiveRun(cameras, out, **given, **overrides) as run:
        run.add_outputs(grid=grid, heights=heights, sphere=sphere, record=record, view=view, mavlink=mavlink)
        return run.finish(observers)


class LiveRun:
    """`map_live` in two steps: `with LiveRun(...) as run` opens and checks everything, `run.finish()` maps.

    Args:
        cameras: As for `map_live`, like all other arguments.

    Attributes:
        mapper: The mapper, once entered.
        stream: The images with their poses.
        sphere: The distances all round, if that output was added.
        page: Link to the page, if that output was added; else "".
        outputs: The outputs that were added.

    Raises:
        StereovoxError: As `map_live`, on entering.
    """

    mapper: Mapper
    stream: LiveStream

    def __init__(
        self,
        cameras: Cameras,
        out: str | Path,
        *,
        poses: PosesFrom = None,
        profile: str | Path | Config | None = None,
        resume: bool = False,
        wait_s: float = WAIT_S,
        seconds: float | None = None,
        checkpoint_s: float = CHECKPOINT_S,
        notify: Callable[[str], None] = lambda line: None,
        **overrides: Any,
    ):
        self.out = Path(out)
        self._cameras, self._poses = _cameras(cameras, poses)
        self._live = {"wait_s": wait_s, "seconds": seconds, "notify": notify}
        self._map = {"profile": profile, "resume": resume, "checkpoint_s": checkpoint_s, **overrides}
        self._notify, self._resume = notify, resume
        self._open = ExitStack()
        self.outputs: list[Output] = []
        self._newest_ns: int | None = None
        self._recorder: Recorder | None = None
        self._sender: ObstacleSender | None = None
        self.sphere: LiveSphere | None = None
        self._page: list[Output] = []
        self.page = ""

    def __enter__(self) -> LiveRun:
        poses = self._poses
        words = (None, GIVEN, TRACK)
        opened = open_poses(poses) if isinstance(poses, str) and poses not in words else poses
        self._opened = opened
        self.stream = LiveStream(self._cameras, opened, **self._live)
        if self._resume and self.stream.tracked:
            raise StereovoxError(f"{self.out}: a tracked camera does not know where in it it is; begin a new map")
        with ExitStack() as stack:
            self._run = stack.enter_context(
                MapRun(self.stream, self.out, poses=GIVEN, notify=self._notify, **self._map)
            )
            self.mapper = self._run.mapper
            self.mapper.stamp_clock = self.stream.now_ns
            if self.stream.poses is not None:
                self.stream.poses.listen(self._pose_came)
            self.stream.config = self.mapper.config
            self._open = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._open.close()

    def add_outputs(
        self,
        *,
        grid: str | Path | None = None,
        heights: Heights | None = None,
        sphere: str | Path | bool | None = None,
        record: str | Path | None = None,
        view: int | None = None,
        mavlink: str | None = None,
    ) -> None:
        """Add outputs, as the arguments of `map_live` of the same names.

        Args:
            grid: As there, like the others.
            sphere: True: keep the distances without drawing a picture.

        Raises:
            StereovoxError: One of them cannot be written, the page cannot be served, the map is not level, or the
                autopilot's address cannot be used.
        """
        if mavlink is not None:
            self._sender = self._obstacle_sender(mavlink)
            self._add(_ToldOfFrames(self._sender, self.stream))
        if sphere:
            picture = None if sphere is True else sphere
            self.sphere = LiveSphere(self.mapper.config, self.stream.mounts, picture, self.mapper, self.stream.poses)
            self._add(self.sphere)
        if grid is not None:
            self._add(GridFile(self.mapper, grid, heights, notify=self._notify))
        if record is not None:
            self._recorder = Recorder(record, self.stream.mounts, self.stream.imus(), self._notify)
            self._add(self._recorder)
        if view is not None:
            from stereovox.viewer.live import LiveView

            page = LiveView(self.mapper, self.out.stem, port=view)
            self._open.callback(page.close)
            self._page.append(page)
            self.page = page.url

    def finish(self, observers: Sequence[Observer] = ()) -> LiveResult:
        """Map until a signal, the time or the cameras end it, and save the map.

        Args:
            observers: Called after each image, before the outputs. Those that have them are called `finish` and `close`
                at the end, as the outputs are.

        Returns:
            The map and the report of each image.

        Raises:
            StereovoxError: All cameras failed, the disk is full, or not one image could be used.
        """
        warm_up(self.mapper.config, self.stream.tracked, clouds=self.stream.clouds)
        reports, latency = _Reports(), Latency(lambda: self.stream.moment)
        begin, cpu = perf_counter(), process_time()
        stopped, outputs = False, [*observers, *self.outputs]
        chain = [reports, latency.mapped, *outputs, latency.sent, *self._page]
        with interrupt_between_steps() as check:  # a second signal, as `timeout` sends it, does not cut the saving
            self.stream.check = check
            try:
                self._run.finish(chain)
            except KeyboardInterrupt:
                stopped = True
            finally:
                seconds, cpu = perf_counter() - begin, process_time() - cpu
                with ExitStack() as ends:  # one that fails does not keep the others from their end
                    for output in (*outputs, *self._page)[::-1]:
                        ends.callback(getattr(output, "close", _nothing) if output in outputs else _nothing)
                    for output in (*outputs, *self._page)[::-1]:
                        ends.callback(getattr(output, "finish", _nothing))
        failures = [why for output in self.outputs if (why := getattr(output, "failure", ""))]
        if not self.mapper.map.frames:
            raise StereovoxError(f"{self.stream.name}: stopped before an image could be mapped, no map is written")
        live = {
            "seconds": round(seconds, 3),
            "cpu_share": round(cpu / seconds, 4),
            "latency_ms": latency.summary(),
            "dropped": self.stream.dropped,
            **self.stream.counts(),
        }
        if self._sender is not None:
            live["obstacle_distances"] = self._sender.sent
        if self._recorder is not None:
            failed = {"failure": self._recorder.failure} if self._recorder.failure else {}
            live["recorded"] = {**self._recorder.counts, **failed}
        return LiveResult(self.mapper.map, self.out, reports.reports, stopped, live, self._poses_word(), failures)

    def _obstacle_sender(self, url: str) -> ObstacleSender:
        """Return what tells an autopilot of obstacles, over the connection that brings its poses if it is the same."""
        from stereovox.mavlink.sending import ObstacleSender
        from stereovox.mavlink.stream import MavlinkPoses

        poses = self._opened
        if isinstance(poses, MavlinkPoses) and poses.url == url:
            self._open.callback(poses.stop)
            url_or_link = poses.link
        else:
            url_or_link = url
        return ObstacleSender(self.mapper, url_or_link, tell=self._notify)

    def _pose_came(self) -> None:
        """Say what time it is by the newest pose, and where the body is."""
        assert self.stream.poses is not None
        newest = self.stream.poses.newest
        if newest is None or newest[0] == self._newest_ns:
            return
        self._newest_ns = newest[0]
        if self._sender is None:
            self.mapper.heard(newest[0])
        else:
            self._sender.pose(newest[0], newest[1] @ inverse(T_OPTICAL_BODY))

    def _add(self, output: Output) -> None:
        self.outputs.append(output)
        self._open.callback(output.close)

    def _poses_word(self) -> str:
        if self.stream.tracked:
            return TRACK
        return GIVEN if self.stream.poses is None else self.stream.poses.where


class _ToldOfFrames:
    """An output that tells an autopilot's sender what the map took in, and where the body was."""

    def __init__(self, sender: ObstacleSender, stream: LiveStream):
        self._sender, self._stream = sender, stream
        self.finish, self.close = sender.finish, sender.close

    def after(self, frame: Any, report: UpdateReport) -> None:
        if report.refused:
            return
        T_world_body = frame.T_world_sensor @ inverse(T_OPTICAL_BODY @ self._stream.mount(frame))
        self._sender.at(orthonormalise(T_world_body), frame.sensor, stamp_ns=frame.stamp_ns)


class _Reports:
    """An observer that keeps all reports."""

    def __init__(self) -> None:
        self.reports: list[UpdateReport] = []

    def after(self, frame: Any, report: UpdateReport) -> None:
        self.reports.append(report)


def _cameras(cameras: Cameras, poses: PosesFrom) -> tuple[Sequence[LiveCamera], PosesFrom]:
    """Return the cameras, and where poses come from: as was asked for, else as a `live.toml` says."""
    if isinstance(cameras, LiveCamera):
        return [cameras], poses
    if isinstance(cameras, str | Path):
        if Path(cameras).suffix != ".toml":
            return [LiveCamera(cameras)], poses
        setup = read_live(cameras)
        return setup.cameras, poses or setup.poses or None
    if isinstance(cameras, Sequence):
        return [one if isinstance(one, LiveCamera) else LiveCamera(one) for one in cameras], poses
    return [LiveCamera(cameras)], poses


def _nothing() -> None:
    """Stand in for what an observer does not have."""
