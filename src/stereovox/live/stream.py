# SPDX-License-Identifier: Apache-2.0
"""The frames of several live cameras in one stream, each with its pose, its sensor's name and the clock of the poses.

A thread for each camera puts its images into queues; an image leaves them once its pose is there, or will not come.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Condition, Event, Thread
from time import monotonic, monotonic_ns
from typing import Any, NamedTuple

import numpy as np

from stereovox.calibrate.live_clock import CameraClock
from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.frame import FORWARD, AnyFrame, Frame, Rays, name_of
from stereovox.frame.stamp_clock import epoch_ns
from stereovox.geometry.se3 import Transform, covariance_at, inverse
from stereovox.live.rig import LiveCamera, check_cameras
from stereovox.opening import open_camera, open_images
from stereovox.runs.pose_choice import GIVEN, HOW, TRACK, has_poses
from stereovox.runs.survey import level_pose
from stereovox.sources.base import Stream, closing, stream_of
from stereovox.sources.imu import Imu
from stereovox.sources.latest import STOPPING_S, Arrival, Latest, Waiting
from stereovox.sources.paced import Paced
from stereovox.sources.poses.clock_watch import Delays, Heard
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.pose_stream import T_OPTICAL_BODY, PoseStream
from stereovox.track.stream import follow
from stereovox.track.tracker import POSE_FAULTS, Tracked, Tracker

WAIT_S, LATE_S, QUEUE, UNTRACKED = 0.3, 0.25, 40, 2
"""Seconds that an image waits for its pose, and that one with a pose waits for a busy map before it yields to newer
ones; most images that wait, per camera and for tracking."""
TICK_S, SOON_S = 0.1, 0.01
"""Seconds after which a stream without news wakes up, and after which waiting images are checked again."""
REMIND_S = 5.0
"""Seconds without any pose, with bad lines, or without an image of a camera, until the user is informed."""
HOST_CLOCK_NS = 60_000_000_000
"""Stamps that are at most this old by the clock of this machine are taken to be by that clock."""
REMEMBERED = 300
"""Most arrivals remembered per camera."""


class Moment(NamedTuple):
    """When an image was taken, by its stamp (None: by another clock than this machine's), and when it arrived.

    taken_ns: since the epoch. arrived_ns: monotonic.
    """

    camera: str
    taken_ns: int | None
    arrived_ns: int


@dataclass(eq=False)
class _Feed:
    """One camera and what became of its images. offset_ns: subtracted from its stamps. ended: it delivers no more.

    heard_ns: when its last image arrived, or it was started; monotonic. told: the last problem that was reported to the
    user. clock: watches its clock, if poses do not come with the images.
    """

    camera: LiveCamera
    stream: Stream
    offset_ns: int
    tracked: bool = False
    received: int = 0
    before_first_pose: int = 0
    ended: bool = False
    failure: str = ""
    heard_ns: int = 0
    told: str = ""
    host_clock: bool | None = None
    latest: Latest[AnyFrame] | None = None
    clock: CameraClock | None = None

    def __post_init__(self) -> None:
        self.moments: OrderedDict[int, Moment] = OrderedDict()

    @property
    def ahead_ns(self) -> int:
        """How far its stamps are ahead of the poses', as far as is known."""
        return self.offset_ns - (self.clock.shift_ns if self.clock else 0)

    @property
    def name(self) -> str:
        return self.camera.title


class _Image(NamedTuple):
    """A waiting image, and what was known about its stamp when it arrived."""

    feed: _Feed
    frame: AnyFrame
    heard: Heard


class LiveStream(Stream):
    """Images of several cameras with their poses, in time order as far as they have arrived.

    Iterating starts cameras and poses, and stops them. Cameras that are recordings end; the stream ends with the last
    one. A camera that fails does not end the others.

    Args:
        cameras: The cameras.
        poses: `given`: those of the images; `track`: the first camera is tracked by visual odometry, and the others
            move with it; or a stream of poses of the body, or a buffer that you fill. None: given if all images have
            poses, else track.
        wait_s: Seconds that an image waits for its pose.
        seconds: Duration; None: until the cameras end.
        notify: Called with each line that a user should see.

    Attributes:
        poses: The poses of the body; None with `given`.
        config: Settings, for tracking.
        check: Called repeatedly, even while no image arrives; an exception in it ends the iteration.
        on_start: Called once cameras and poses have been started.
        on_given: Called with each image of the first camera in its thread, if images bring their poses; None: nothing.
        moment: When the image that was yielded last was taken and arrived.
        mounts: T_body_camera (4, 4) by the name of the camera, which is the `sensor` of its images.
        tracked: Whether the first camera is tracked.
        clouds: Whether one of them is a lidar.
        imu_use: How tracking used an IMU, in words.
    """

    def __init__(
        self,
        cameras: Sequence[LiveCamera],
        poses: str | PoseStream | LivePoses | None = None,
        *,
        wait_s: float = WAIT_S,
        seconds: float | None = None,
        notify: Callable[[str], None] = lambda line: None,
    ):
        if not 0 <= wait_s <= 60 or (seconds is not None and not seconds > 0):
            raise StereovoxError(f"wait_s {wait_s:g}, seconds {seconds}: give wait_s 0 to 60, and seconds above 0")
        self.config = load_config("default")
        self.check: Callable[[], object] = lambda: None
        self.on_start: Callable[[], object] = lambda: None
        self.on_given: Callable[[AnyFrame], object] | None = None
        self._notify, self._seconds = notify, seconds
        self._feeds = [_feed(camera) for camera in check_cameras(cameras)]
        if poses is None:
            poses = GIVEN if all(feed.stream.posed for feed in self._feeds) else TRACK
        self.tracked = poses == TRACK
        self.clouds = any(feed.stream.camera == FORWARD for feed in self._feeds)
        self._stream = poses if isinstance(poses, PoseStream) else None
        self.poses: LivePoses | None = None
        if poses == TRACK:
            self.poses, self._feeds[0].tracked = LivePoses(f"{self._feeds[0].name}, tracked"), True
        elif isinstance(poses, PoseStream | LivePoses):
            self.poses = poses.poses if isinstance(poses, PoseStream) else poses
        elif poses != GIVEN:
            raise StereovoxError(f"poses '{poses}' is no stream of poses; open it, or give {TRACK} or {GIVEN}")
        self.name, self.camera = ", ".join(feed.name for feed in self._feeds), self._feeds[0].stream.camera
        self.name += f", {HOW[TRACK]}" if self.tracked else ""
        self.notes = tuple(note for feed in self._feeds for note in feed.stream.notes)
        self.moment = Moment("", None, 0)
        self.mounts = {feed.name: feed.camera.T_body_camera for feed in self._feeds}
        self._waiting: Waiting[_Image] = Waiting(QUEUE, round(1e9 * wait_s), round(1e9 * LATE_S), monotonic_ns)
        self._change, self._stopped = Condition(), Event()
        self._remind = 0.0
        self.imu_use = ""
        if self.poses is not None:
            self.poses.listen(self._wake)
            self._delays = Delays() if self.tracked else self.poses.delays  # of the images that poses are tracked by

    @property
    def dropped(self) -> int:
        """Images that were not consumed in time."""
        tracked = sum(feed.latest.dropped for feed in self._feeds if feed.latest is not None)
        return self._waiting.dropped.total() + tracked

    def imus(self) -> dict[str, Imu]:
        """Return the IMUs of the cameras that have one, by the name of the camera."""
        found = {feed.name: feed.stream.imu() for feed in self._feeds}
        return {name: imu for name, imu in found.items() if imu is not None}

    def counts(self) -> dict[str, Any]:
        """Return what became of images, by camera `received`, `dropped`, `before_first_pose`; and counts of poses.

        For a recording or simulation also how many were `late`: it could not be read or drawn at its pace.
        """
        cameras = {
            feed.name: {
                "received": feed.received,
                "dropped": self._waiting.dropped[feed.name] + (feed.latest.dropped if feed.latest else 0),
                "before_first_pose": feed.before_first_pose,
                **({"late": feed.stream.late} if isinstance(feed.stream, Paced) and feed.stream.late else {}),
                **({"clock_found_s": -feed.clock.shift_ns / 1e9} if feed.clock and feed.clock.shift_ns else {}),
                **({"failure": feed.failure} if feed.failure else {}),
            }
            for feed in self._feeds
        }
        if self.poses is None:
            return {"cameras": cameras}
        more = dict(self._stream.counts) if self._stream is not None else {}
        return {"cameras": cameras, "poses": {"added": self.poses.added, **dict(self.poses.counts), **more}}

    def now_ns(self) -> int | None:
        """Return the present time by the clock of the poses and of the frames' stamps; None if no camera shares it."""
        offsets = [feed.offset_ns for feed in self._feeds if feed.host_clock]
        return epoch_ns() - min(offsets) if offsets else None

    def mount(self, frame: AnyFrame) -> Transform:
        """Return T_body_sensor (4, 4) for the sensor of a frame of this stream; of rays, from their own axes."""
        mount = self.mounts[frame.sensor]
        return mount @ T_OPTICAL_BODY if isinstance(frame, Rays) else mount

    @property
    def why_none(self) -> str:
        """Why no image has become a frame, in words."""
        early = sum(feed.before_first_pose for feed in self._feeds)
        if self.poses is None or not early:
            return "no image arrived"
        return f"{early} images arrived, but no pose: {self.poses.where}"

    def __iter__(self) -> Iterator[AnyFrame]:
        end = monotonic() + (self._seconds or float("inf"))
        self._remind = monotonic() + REMIND_S
        with ExitStack() as stack:
            stack.callback(self._stopped.set)
            if self._stream is not None:
                self._stream.start()
                stack.callback(self._stream.stop)
            for feed in self._feeds:
                feed.heard_ns = monotonic_ns()
                if self.poses is not None and not feed.tracked:
                    feed.clock = self._clock_of(feed, self.poses)
                    stack.callback(feed.clock.close)
                thread = Thread(target=self._run, args=(feed,), name=f"stereovox-{feed.name}", daemon=True)
                thread.start()
                stack.callback(thread.join, STOPPING_S)
            self.on_start()
            stack.callback(self._stopped.set)  # called first, so that all threads stop at once
            yield from self._merged(end)

    def _merged(self, end: float) -> Iterator[AnyFrame]:
        left = True
        while left and monotonic() < end:
            arrival, left = self._next()
            self.check()
            self._report_trouble()
            frame = None if arrival is None else self._framed(arrival)
            if frame is not None:
                yield frame
        failures = [feed.failure for feed in self._feeds if feed.failure]
        if failures and len(failures) == len(self._feeds):
            raise SourceError(failures[0])

    def _next(self) -> tuple[Arrival[_Image] | None, bool]:
        """Return an image whose pose is there or will not arrive, if any, and whether more images may come."""
        with self._change:
            arrival = self._waiting.pop(self._ready)
            if arrival is not None:
                return arrival, True
            if not len(self._waiting) and all(feed.ended for feed in self._feeds):
                return None, False
            self._change.wait(SOON_S if len(self._waiting) else TICK_S)
            return self._waiting.pop(self._ready), True

    def _ready(self, arrival: Arrival[_Image]) -> bool:
        feed, frame, heard = arrival.content
        if self.poses is None or feed.tracked or (frame.fault and frame.fault not in POSE_FAULTS):
            return True
        if heard.is_open:
            return False
        return self.poses.is_final(arrival.stamp_ns)

    def _clock_of(self, feed: _Feed, poses: LivePoses) -> CameraClock:
        given_s, mount = feed.camera.clock_offset_s, feed.camera.T_body_camera

        def cure(_: object, ahead_s: float) -> str:
            return f"restart with --clock-offset (clock_offset_s) {given_s + ahead_s:.3f}"

        return CameraClock(feed.name, poses, self._delays, mount, self.config, self._notify, cure)

    def _framed(self, arrival: Arrival[_Image]) -> AnyFrame | None:
        """Return an image with its pose, or with a fault that says why the pose is missing; None before any pose."""
        feed, image, heard = arrival.content
        frame = replace(image, sensor=feed.name, stamp_ns=arrival.stamp_ns)
        self.moment = feed.moments.pop(image.stamp_ns, Moment(feed.name, None, arrival.arrived_ns))
        if self.poses is None or feed.tracked or (frame.fault and frame.fault not in POSE_FAULTS):
            return frame
        if not self.poses.added:
            feed.before_first_pose += 1
            return None
        try:
            if feed.clock is not None:
                feed.clock.check(frame, heard, monotonic_ns())
            T_world_body = self.poses.at(frame.stamp_ns)
        except FrameRefused as refused:
            detail = f"{name_of(frame)}: {refused}"
            nowhere = np.full((4, 4), np.nan)
            return replace(frame, T_world_sensor=nowhere, fault=refused.reason, fault_detail=detail)
        T_world_sensor = T_world_body @ self.mount(frame)
        return replace(frame, T_world_sensor=T_world_sensor, fault=None, fault_detail="", pose_off_ns=0)

    def _run(self, feed: _Feed) -> None:
        """Put a camera's images into its queue until it ends or the stream stops."""
        try:
            with closing(self._tracked(feed) if feed.tracked else self._noted(feed)) as images:
                for image in images:
                    stamp_ns = image.stamp_ns - feed.ahead_ns
                    heard = feed.clock.heard(stamp_ns, monotonic_ns()) if feed.clock is not None else Heard()
                    with self._change:
                        self._waiting.put(feed.name, stamp_ns, "", _Image(feed, image, heard))
                        self._change.notify()
                    if self._stopped.is_set():
                        break
        except StereovoxError as error:
            feed.failure = str(error)
        except Exception as error:  # a camera that breaks must be reported, not vanish with its thread
            feed.failure = f"{feed.name}: {type(error).__name__}: {error}"
        finally:
            feed.ended = True
            if feed.tracked and self.poses is not None:
                self.poses.end(feed.failure or "the tracked camera ended")
            self._wake()

    def _noted(self, feed: _Feed) -> Iterator[AnyFrame]:
        """Yield a camera's images, and record when they arrive."""
        with closing(feed.stream) as images:
            for image in images:
                arrived_ns, now_ns = monotonic_ns(), epoch_ns()
                if feed.host_clock is None:
                    feed.host_clock = 0 <= now_ns - image.stamp_ns <= HOST_CLOCK_NS
                feed.received, feed.heard_ns = feed.received + 1, arrived_ns
                if feed.tracked:
                    self._delays.heard(image.stamp_ns - feed.offset_ns, arrived_ns)
                feed.moments[image.stamp_ns] = Moment(
                    feed.name, image.stamp_ns if feed.host_clock else None, arrived_ns
                )
                while len(feed.moments) > REMEMBERED:
                    feed.moments.popitem(last=False)
                if self.poses is None and self.on_given is not None and feed is self._feeds[0]:
                    self.on_given(replace(image, sensor=feed.name))
                yield image
                if self._stopped.is_set():
                    return

    def _tracked(self, feed: _Feed) -> Iterator[AnyFrame]:
        """Yield a camera's images with tracked poses, which become those of the body."""
        poses = self.poses
        assert poses is not None
        tracker = _LateTracker(self.config, feed.stream)
        feed.latest = Latest(_announced(self._noted(feed), tracker.expect), UNTRACKED)
        T_camera_body = inverse(feed.camera.T_body_camera)
        for image, tracked in follow(feed.latest, tracker):
            if tracked.lost:
                T, covariance = np.full((4, 4), np.nan), None
            else:
                T = tracked.T_world_sensor @ T_camera_body
                covariance = covariance_at(tracked.covariance, T[:3, 3] - tracked.T_world_sensor[:3, 3])
            if not tracked.lost or poses.added:
                quality = round(100 * tracked.inlier_share)
                poses.add(image.stamp_ns - feed.offset_ns, T, covariance=covariance, quality=quality)
            self.imu_use = tracker.imu_use
            yield image

    def _wake(self) -> None:
        with self._change:
            self._change.notify()

    def _report_trouble(self) -> None:
        """Report problems to the user: of cameras, at once; of poses, now and then."""
        for feed in self._feeds:
            said = self._trouble(feed)
            if said and said != feed.told:
                self._notify(f"{said}; the other cameras continue" if len(self._feeds) > 1 else said)
            feed.told = said
        now = monotonic()
        if now < self._remind or self.poses is None:
            return
        self._remind = now + REMIND_S
        trouble = self._stream.trouble if self._stream is not None else ""
        if not self.poses.added:
            self._notify(f"{trouble or f'{self.poses.where}: no pose has arrived yet'}; images wait for the first one")
        elif trouble and self._stream is not None:
            self._stream.trouble = ""
            self._notify(trouble)

    def _trouble(self, feed: _Feed) -> str:
        """Return why a camera delivers nothing; "" if it does, has ended, or was the last one: that is raised."""
        if feed.ended:
            return "" if all(one.failure for one in self._feeds) else feed.failure
        silent = monotonic_ns() - feed.heard_ns > 1e9 * REMIND_S
        return f"{feed.name}: no image has arrived for {REMIND_S:g} s; is it still connected?" if silent else ""


class _LateTracker:
    """A tracker that is made with the first image, which shows the up direction."""

    def __init__(self, config: Config, stream: Stream):
        self._config, self._stream = config, stream
        self._tracker: Tracker | None = None

    def add(self, frame: AnyFrame, /) -> Tracked:
        """Return the pose of a frame."""
        if self._tracker is None:
            start = level_pose(frame if isinstance(frame, Frame) else None, self._config)
            self._tracker = Tracker(self._config, start=start, imu=self._stream.imu())
        return self._tracker.add(frame)

    def expect(self, frame: AnyFrame, /) -> None:
        """Begin to prepare a frame, as `Tracker.expect`."""
        if self._tracker is not None:
            self._tracker.expect(frame)

    @property
    def imu_use(self) -> str:
        """How the IMU was used, in words."""
        return self._tracker.imu_use if self._tracker else ""


def _announced(images: Iterable[AnyFrame], expect: Callable[[AnyFrame], None]) -> Iterator[AnyFrame]:
    """Yield images, each after `expect` was called with it: in the camera's thread, ahead of its turn."""
    for image in images:
        expect(image)
        yield image


def _feed(camera: LiveCamera) -> _Feed:
    stream = _opened(camera.source) if isinstance(camera.source, str | Path) else stream_of(camera.source)
    return _Feed(camera, stream, round(1e9 * camera.clock_offset_s))


def _opened(where: str | Path) -> Stream:
    """Open a camera; a recording without a pose for any image counts as one without poses, whatever its layout."""
    stream = open_camera(where)
    if not isinstance(stream, Paced) or not stream.posed or has_poses(stream.source):
        return stream
    images = Paced(open_images(where))
    images.posed = False
    return images
