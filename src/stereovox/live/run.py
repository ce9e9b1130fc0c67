# SPDX-License-Identifier: Apache-2.0
"""Map cameras that are connected now: the Python side of `stereovox live`."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any

from stereovox.errors import StereovoxError
from stereovox.live.outputs import GridFile, Latency, LiveSphere, Output
from stereovox.live.poses import open_poses
from stereovox.live.recorder import Recorder
from stereovox.live.rig import LiveCamera, read_live
from stereovox.live.stream import WAIT_S, LiveStream
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.products.floor_axes import Heights
from stereovox.runs.engine import MapOptions, Observer, Run, RunResult, takes
from stereovox.runs.pose_choice import GIVEN, TRACK
from stereovox.runs.recording import MapRun
from stereovox.runs.warm_up import warm_up
from stereovox.sources.base import Stream
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.pose_stream import PoseStream

if TYPE_CHECKING:
    from stereovox.live.autopilot import Autopilot, SendPose
    from stereovox.mavlink.link import MavlinkLink
    from stereovox.mavlink.sectors import SectorRules

Cameras = str | Path | Stream | LiveCamera | Sequence[str | Path | Stream | LiveCamera]
PosesFrom = str | PoseStream | LivePoses | None
OUTPUTS = ("grid", "heights", "sphere", "record", "view", "mavlink", "send_pose", "pose_rate_hz", "rules")
"""What `LiveRun.add_outputs` takes."""


@dataclass(frozen=True, kw_only=True)
class LiveOptions(MapOptions):
    """Options of `map_live`, in addition to `MapOptions`.

    Attributes:
        poses: `track`: the first camera is tracked by visual odometry; `given`: the poses of the images; the name of a
            stream (`t265`, `udp://:5005`, `tcp://HOST:5005`), a `PoseStream`, or a `LivePoses` that you fill. None:
            as in the `live.toml`, else given if all images have poses, else track.
        resume: Continue the map at `out`; the poses must be in its world.
        wait_s: Seconds that an image waits for its pose.
        seconds: How long to map.
    """

    poses: PosesFrom = None
    resume: bool = False
    wait_s: float = WAIT_S
    seconds: float | None = None


@dataclass(frozen=True)
class LiveResult(RunResult[VoxelMap]):
    """The result of a live run.

    Attributes:
        map: The map, as saved.
        out: The path it was saved to.
        reports: One report for each image that was offered to the map, in order.
        stopped: Whether a signal ended it (Ctrl-C, SIGTERM or SIGHUP), as is usual.
        live: Latency, images and poses by source, and outputs: the part `live` of `summary`.
        poses: `given`, `track`, or the name of the stream of poses.
        failures: Outputs that could not be written, a line each.
    """

    stopped: bool
    live: dict[str, Any]
    poses: str
    failures: Sequence[str] = ()

    def summary(self) -> dict[str, Any]:
        """Summarise the run.

        Returns:
            The numbers of `stereovox live --json`: those of `map`, and `live`; `not_written` if an output could not be
            written.
        """
        came = sum(counts["received"] for counts in self.live["cameras"].values())
        found = {**self._summary(came, "images"), "poses": self.poses, "live": self.live}
        return {**found, "not_written": list(self.failures)} if self.failures else found


class LiveRun(Run[MapRun, LiveResult]):
    """`map_live` in two steps: `with LiveRun(...) as run` opens and checks everything, `run.finish()` maps.

    Args:
        cameras: As for `map_live`, like all other arguments.

    Attributes:
        mapper: The mapper, once entered.
        stream: The images with their poses.
        sphere: The distances in all directions, if that output was added.
        page: Link to the page, if that output was added; else "".
        outputs: The outputs that were added.

    Raises:
        StereovoxError: As `map_live`, on entering.
    """

    usual_end = (KeyboardInterrupt,)
    mapper: Mapper
    stream: LiveStream

    @takes(LiveOptions)
    def __init__(self, cameras: Cameras, out: str | Path, **options: Any):
        self._options = LiveOptions.of(options)
        super().__init__(self._options.notify)
        self.out = Path(out)
        self._cameras, self._poses = _cameras(cameras, self._options.poses)
        self.outputs: list[Output] = []
        self._newest_ns: int | None = None
        self._recorder: Recorder | None = None
        self._autopilot: Autopilot | None = None
        self.sphere: LiveSphere | None = None
        self._page: list[Output] = []
        self.page = ""

    def _begin(self, stack: ExitStack) -> None:
        options, poses = self._options, self._poses
        words = (None, GIVEN, TRACK)
        self._opened = open_poses(poses) if isinstance(poses, str) and poses not in words else poses
        self.stream = LiveStream(
            self._cameras, self._opened, wait_s=options.wait_s, seconds=options.seconds, notify=self._notify
        )
        if options.resume and self.stream.tracked:
            raise StereovoxError(f"{self.out}: a tracked camera cannot be located in a saved map; begin a new one")
        alike = {name: getattr(options, name) for name in (*MapOptions.names(), "resume")}
        self._run = stack.enter_context(MapRun(self.stream, self.out, poses=GIVEN, **alike, **options.settings))
        self.mapper = self._run.mapper
        self.mapper.stamp_clock = self.stream.now_ns
        if self.stream.poses is not None:
            self.stream.poses.listen(self._pose_came)
        self.stream.config = self.mapper.config

    def add_outputs(
        self,
        *,
        grid: str | Path | None = None,
        heights: Heights | None = None,
        sphere: str | Path | bool | None = None,
        record: str | Path | None = None,
        view: int | None = None,
        mavlink: str | MavlinkLink | None = None,
        send_pose: SendPose | None = None,
        pose_rate_hz: float = 30.0,
        rules: SectorRules | None = None,
    ) -> None:
        """Add outputs.

        Args:
            grid: 2-D map to keep up to date (`.yaml`).
            heights: Lowest and highest metres above the floor that a robot occupies, for that map.
            sphere: Picture of the distances all round to draw at the end (`.png`); True: keep them without a picture.
            record: Recording to write beside (`.mcap`, `.bag` or `.db3`).
            view: Port of a page that shows the map while it grows; 0: any free port. None: no page.
            mavlink: Address of an autopilot that gets obstacle distances (`ObstacleSender`), such as
                `udpout:127.0.0.1:14540`, or a `MavlinkLink`; if poses come from it too, the same address.
            send_pose: It also gets the body's pose (`PoseSender`): `odometry`, or `vision` for
                VISION_POSITION_ESTIMATE. None: it does not.
            pose_rate_hz: Most poses a second.
            rules: How obstacle distances are made; by default `SectorRules()`.

        Raises:
            StereovoxError: One of them cannot be written, the page cannot be served, the map is not level, or the
                autopilot's address cannot be used.
        """
        if mavlink is not None:
            from stereovox.live.autopilot import Autopilot

            self._autopilot = Autopilot(
                self.mapper, self.stream, mavlink, self._opened, send_pose=send_pose, pose_rate_hz=pose_rate_hz,
                rules=rules, notify=self._notify,
            )  # fmt: skip
            self._add(self._autopilot)
        elif send_pose is not None or rules is not None:
            raise StereovoxError("send_pose, rules: there is no autopilot; give mavlink, its address")
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

    def _prepare_steps(self) -> None:
        warm_up(self.mapper.config, self.stream.tracked, clouds=self.stream.clouds)
        self._latency = Latency(lambda: self.stream.moment)

    def _steps(self) -> Iterable[MapRun]:
        return [self._run]

    def _take(self, step: MapRun) -> None:
        """Map all images: the only step of this run is itself a run, over the images of all cameras."""
        self.stream.check = self._check
        outputs = [*self._observers, *self.outputs]
        begin, cpu = perf_counter(), process_time()
        try:
            step.finish([self._latency.mapped, *outputs, self._latency.sent, *self._page])
        finally:
            self._took = perf_counter() - begin, process_time() - cpu
            with ExitStack() as ends:  # if one fails, the others still end
                for output in (*outputs, *self._page)[::-1]:
                    ends.callback(getattr(output, "close", _nothing) if output in outputs else _nothing)
                for output in (*outputs, *self._page)[::-1]:
                    ends.callback(getattr(output, "finish", _nothing))

    def _end(self) -> LiveResult:
        if not self.mapper.map.frames:
            raise StereovoxError(f"{self.stream.name}: stopped before an image could be mapped; no map is written")
        seconds, cpu = self._took
        live = {
            "seconds": round(seconds, 3),
            "cpu_share": round(cpu / seconds, 4),
            "latency_ms": self._latency.summary(),
            "dropped": self.stream.dropped,
            **self.stream.counts(),
        }
        if self._autopilot is not None:
            live.update(self._autopilot.counts())
        if self._recorder is not None:
            failed = {"failure": self._recorder.failure} if self._recorder.failure else {}
            live["recorded"] = {**self._recorder.counts, **failed}
        failures = [why for output in self.outputs if (why := getattr(output, "failure", ""))]
        reports = self._run.reports
        return LiveResult(self.mapper.map, self.out, reports, self.stopped, live, self._poses_word(), failures)

    def _pose_came(self) -> None:
        """Pass on the time and the place of the newest pose of the body."""
        assert self.stream.poses is not None
        newest = self.stream.poses.newest
        if newest is None or newest.stamp_ns == self._newest_ns:
            return
        self._newest_ns = newest.stamp_ns
        if self._autopilot is None:
            self.mapper.heard(newest.stamp_ns)
        else:
            self._autopilot.came(newest)

    def _add(self, output: Output) -> None:
        self.outputs.append(output)
        self._open.callback(output.close)

    def _poses_word(self) -> str:
        if self.stream.tracked:
            return TRACK
        return GIVEN if self.stream.poses is None else self.stream.poses.where


@takes(LiveOptions, LiveRun.add_outputs)
def map_live(cameras: Cameras, out: str | Path, *, observers: Sequence[Observer] = (), **options: Any) -> LiveResult:
    """Map one or several cameras while they run, until a signal (Ctrl-C, SIGTERM), `seconds`, or they end.

    Each image waits for its pose; if none arrives, the image is refused with the reason, and no pose is guessed. The
    map is saved at regular checkpoints and at the end, as by `map_recording`.

    Args:
        cameras: Name of a camera (`realsense:`) or recording, a `live.toml`, a `Stream`, a `LiveCamera`, or a list of
            these without a `live.toml`.
        out: Folder of the map to write.
        observers: Called after each image, before the other outputs.
        **options: Fields of `LiveOptions`, outputs as for `LiveRun.add_outputs`, and settings by name, as for `Mapper`.

    Returns:
        The map, the report of each image, and latencies.

    Raises:
        StereovoxError: One line: invalid cameras, poses, settings or outputs, all cameras failed, or not one image
            could be used. What was mapped until then is saved.
    """
    outputs = {name: options.pop(name) for name in OUTPUTS if name in options}
    with LiveRun(cameras, out, **options) as run:
        run.add_outputs(**outputs)
        return run.finish(observers)


def _cameras(cameras: Cameras, poses: PosesFrom) -> tuple[Sequence[LiveCamera], PosesFrom]:
    """Return the cameras, and the source of poses: as requested, else as in a `live.toml`."""
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
    """Stand in for a method that an observer lacks."""
