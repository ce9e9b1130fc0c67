# SPDX-License-Identifier: Apache-2.0
"""Record depth images and poses while they are mapped, so that they can be mapped again."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from queue import Empty, Full, Queue
from threading import Event, Thread
from time import monotonic
from typing import Any

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import Frame, UpdateReport
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.imu import Imu

WORLD, BODY = "odom", "base_link"
"""Frames of the recording, as REP 105 names them: poses may drift."""
WAITING = 60
"""Most images that wait to be written; further ones are skipped and counted."""
LOOK_S, SYNC_S = 0.2, 5.0
"""Seconds between checks for the end, and between syncs, after which written data survive a loss of power."""
ENDINGS = (".mcap", ".bag", ".db3")


class Recorder:
    """Writes images, poses of the body and mounts to a bag, in a thread of its own; an output of a live run.

    Topics: `/NAME/depth/image_rect_raw` and its `camera_info`, `/tf` (odom to base_link at the time of each image with
    a pose), `/tf_static` (mounts), `/NAME/color/image_raw` with its `camera_info` if color images are taken too, and
    `/NAME/imu` of a camera that has one. Depth is in whole millimetres, or in float metres if the source's is. Images
    that the map refused are recorded too.

    Args:
        file: `.mcap`, `.bag` or `.db3`; it appears, complete, at the end. An `.mcap` grows in
            `FILE.mcap.XXXXXX.unfinished/`, where it can be read after a kill or a full disk.
        mounts: T_body_camera (4, 4) by the name of the sensor.
        imus: IMUs by the name of the sensor.
        notify: Called with a line if something cannot be recorded.

    Attributes:
        counts: `images` that are recorded, `skipped` because too many waited, `unsuitable`: not whole depth images.
        failure: Why the recording is not at `file`, and where its first part is; "" while there is no problem.

    Raises:
        StereovoxError: The file has another ending, or cannot be written.
    """

    def __init__(
        self,
        file: str | Path,
        mounts: Mapping[str, Transform],
        imus: Mapping[str, Imu] | None = None,
        notify: Callable[[str], None] = lambda line: None,
    ):
        if Path(file).suffix.lower() not in ENDINGS:
            raise StereovoxError(f"{file}: end the name of a recording in {' or '.join(ENDINGS)}")
        if len({topic(name) for name in mounts}) < len(mounts):
            raise StereovoxError(f"{file}: cameras {', '.join(mounts)} share a topic; name them by letters and digits")
        self.file, self.counts, self.failure = Path(file), Counter[str](), ""
        self._mounts, self._imus, self._notify = mounts, imus or {}, notify
        self._heard: dict[str, int] = {}
        self._pictured: set[str] = set()
        self._queue: Queue[Frame] = Queue(WAITING)
        self._ended = Event()
        self._bag = BagWriter(file)
        self._bag.__enter__()
        self._thread = Thread(target=self._run, name="stereovox-recorder", daemon=True)
        self._thread.start()

    def after(self, frame: Any, report: UpdateReport) -> None:
        """Queue an image for writing."""
        if not isinstance(frame, Frame) or not frame.depth.size or not isinstance(frame.camera, PinholeCamera):
            self.counts["unsuitable"] += 1
            return
        try:
            self._queue.put_nowait(frame)
        except Full:
            self.counts["skipped"] += 1

    def finish(self) -> None:
        """Write all waiting images, and complete the recording."""
        self.close()

    def close(self) -> None:
        """Write all waiting images, and complete the recording."""
        self._ended.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            for name, T_body_camera in self._mounts.items():
                self._bag.fixed(BODY, optical(name), T_body_camera)
            due_s = monotonic() + SYNC_S
            while True:
                try:
                    self._write(self._queue.get(timeout=LOOK_S))
                except Empty:
                    if self._ended.is_set():
                        break
                if monotonic() > due_s:
                    self._bag.sync()
                    due_s = monotonic() + SYNC_S
            if self.counts["images"]:
                self._bag.complete()
            else:
                self._bag.__exit__(StereovoxError, None, None)  # nothing to keep
                self.failure = f"{self.file}: no suitable image arrived; nothing is recorded"
        except Exception as error:  # whatever it is, the user is notified, and nobody waits for this thread
            why = error if isinstance(error, StereovoxError) else f"{self.file}: {type(error).__name__}: {error}"
            self.failure = f"{why}; {self._left()}"
            self._notify(f"{self.failure}; mapping continues")
            self._drain()

    def _left(self) -> str:
        """Keep the rest of a recording that ended early, and return a phrase that names it."""
        left = self._bag.leave() if self.counts["images"] else ""
        if not left:
            self._bag.__exit__(StereovoxError, None, None)
        return f"the part recorded before is in {left}" if left else "nothing is recorded"

    def _write(self, frame: Frame) -> None:
        name, stamp_ns = frame.sensor, frame.stamp_ns
        T = np.asarray(frame.T_world_sensor, float)
        if np.isfinite(T).all():
            self._bag.transform(stamp_ns, WORLD, BODY, T @ inverse(self._mounts[name]))
        self._bag.depth(frame, f"/{topic(name)}/depth/image_rect_raw", optical(name))
        self._write_photo(name, frame)
        self._write_imu(name, stamp_ns)
        self.counts["images"] += 1

    def _write_photo(self, name: str, frame: Frame) -> None:
        if frame.photo is None:
            return
        T = np.asarray(frame.photo.T_sensor_camera, float)
        beside = optical(name) if np.array_equal(T, np.eye(4)) else f"{topic(name)}_color_optical_frame"
        with suppress(FrameRefused):  # an unreadable picture is skipped
            self._bag.photo(frame, f"/{topic(name)}/color/image_raw", beside)
            if beside != optical(name) and name not in self._pictured:
                self._bag.fixed(optical(name), beside, T)
                self._pictured.add(name)

    def _write_imu(self, name: str, stamp_ns: int) -> None:
        imu = self._imus.get(name)
        if imu is None:
            return
        since = self._heard.get(name, stamp_ns - 1_000_000_000)
        readings = imu.between(since, stamp_ns)
        new = readings.stamps_ns > since
        if name not in self._heard:
            T_camera_imu = np.asarray(readings.T_sensor_imu)
            self._bag.fixed(optical(name), f"{topic(name)}_imu", T_camera_imu)
        for when, rate, force in zip(
            readings.stamps_ns[new].tolist(), readings.angular_rate[new], readings.specific_force[new], strict=True
        ):
            felt = force if np.isfinite(force).all() else None
            self._bag.imu(when, rate, felt, f"/{topic(name)}/imu", f"{topic(name)}_imu")
            self._heard[name] = when

    def _drain(self) -> None:
        while not (self._ended.is_set() and self._queue.empty()):
            try:
                self._queue.get(timeout=LOOK_S)
                self.counts["skipped"] += 1
            except Empty:
                continue


def topic(name: str) -> str:
    """Return a sensor's name as part of a topic: letters, digits and underscores."""
    word = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_") or "camera"
    return word if word[0].isalpha() else f"camera_{word}"


def optical(name: str) -> str:
    """Return the name of a sensor's optical frame."""
    return f"{topic(name)}_depth_optical_frame"
