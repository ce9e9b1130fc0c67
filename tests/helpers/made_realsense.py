# SPDX-License-Identifier: Apache-2.0
"""A RealSense camera that is not there: pyrealsense2's software device, fed by the test."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

WIDTH, HEIGHT, FPS = 32, 24, 30
UNIT = 0.0005
START_QUARTERS = 4 * 1_700_000_000_123 + 1


def depth(k: int) -> np.ndarray:
    image = 2000 + 10 * k + np.arange(WIDTH * HEIGHT, dtype=np.uint16).reshape(HEIGHT, WIDTH)
    image[0, 0] = 0
    return image.astype(np.uint16)


def picture(k: int) -> np.ndarray:
    """The grey picture (HEIGHT, WIDTH) that comes with depth image `k`."""
    return ((7 * k + np.arange(WIDTH * HEIGHT)) % 251).astype(np.uint8).reshape(HEIGHT, WIDTH)


def stamp_ns(k: int) -> int:
    """Whole quarters of a millisecond, which a float of milliseconds can tell exactly."""
    return (START_QUARTERS + 133 * k) * 250_000


def intrinsics(rs: Any, width: int, height: int) -> Any:
    made = rs.intrinsics()
    made.width, made.height, made.fx, made.fy = width, height, width * 0.75, width * 0.8
    made.ppx, made.ppy, made.model, made.coeffs = (width - 1) / 2, height / 2, rs.distortion.brown_conrady, [0.0] * 5
    return made


class SoftwareCamera:
    """A software device with a depth sensor, two infrared streams 5 cm apart, an emitter and laser power.

    `depth_modes`: (width, height, fps) of every depth profile; the first is the one that frames are made for.
    """

    def __init__(self, rs: Any, serial: str = "042", *, baseline: bool = True, depth_modes=((WIDTH, HEIGHT, FPS),)):
        self._rs, self.serial = rs, serial
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software D435")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self.colour: Any = None
        self.sensor = self.device.add_sensor("Stereo Module")
        profiles = [self._add(rs.stream.depth, 0, mode, rs.format.z16, 2) for mode in depth_modes]
        self.profile = profiles[0]
        eyes = [self._add(rs.stream.infrared, k, (WIDTH, HEIGHT, FPS), rs.format.y8, 1) for k in (1, 2)]
        apart = rs.extrinsics()
        apart.rotation, apart.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [-0.05, 0, 0]
        if baseline:
            eyes[0].register_extrinsics_to(eyes[1], apart)
        self.sensor.add_read_only_option(rs.option.depth_units, UNIT)
        for option, largest in ((rs.option.emitter_enabled, 1), (rs.option.laser_power, 360)):
            limits = rs.option_range()
            limits.min, limits.max, limits.step, limits.default = 0, largest, 1, 1
            self.sensor.add_option(option, limits, True)

    def _add(
        self, kind: Any, index: int, mode: tuple[int, int, int], form: Any, bpp: int, sensor: Any = None,
        coefficients: list[float] | None = None,
    ) -> Any:  # fmt: skip
        stream = self._rs.video_stream()
        stream.type, stream.index, stream.fmt, stream.bpp = kind, index, form, bpp
        stream.width, stream.height, stream.fps = mode
        stream.uid = 100 * index + hash(mode) % 97 + 1000 * int(kind)
        stream.intrinsics = intrinsics(self._rs, *mode[:2])
        if coefficients is not None:
            lens = stream.intrinsics
            lens.coeffs = coefficients
            stream.intrinsics = lens
        return (sensor or self.sensor).add_video_stream(stream)

    def add_pictures(self, form: Any, late_ns: int = 0, coefficients: list[float] | None = None) -> None:
        """Add a colour camera 15 mm to the right of the depth camera, whose pictures are `late_ns` behind it."""
        rs = self._rs
        self.colour = self.device.add_sensor("RGB Camera")
        self.colour_form, self.late_ns = form, late_ns
        self.colour_profile = self._add(
            rs.stream.color, 0, (WIDTH, HEIGHT, FPS), form, 3 if form == rs.format.rgb8 else 2, self.colour,
            [*(coefficients or []), *[0.0] * 5][:5],
        )  # fmt: skip
        beside = rs.extrinsics()
        beside.rotation, beside.translation = [1, 0, 0, 0, 1, 0, 0, 0, 1], [0.015, 0, 0]
        self.colour_profile.register_extrinsics_to(self.profile, beside)

    def _send_picture(self, k: int) -> None:
        rs, grey = self._rs, picture(k)
        frame = rs.software_video_frame()
        if self.colour_form == rs.format.rgb8:
            frame.pixels, frame.stride, frame.bpp = np.stack([grey] * 3, axis=-1).copy(), 3 * WIDTH, 3
        else:
            packed = np.stack([grey, np.full_like(grey, 128)], axis=-1)  # chroma of grey
            frame.pixels, frame.stride, frame.bpp = packed.copy(), 2 * WIDTH, 2
        frame.timestamp, frame.domain = (stamp_ns(k) + self.late_ns) / 1e6, rs.timestamp_domain.hardware_clock
        frame.frame_number = k
        frame.profile = self.colour_profile.as_video_stream_profile()
        self.colour.on_video_frame(frame)

    def query_devices(self) -> list[Any]:
        """This camera as if it were all of `rs.context()`, whose list leaves software devices out."""
        return [self.device]

    def send(self, k: int) -> None:
        """Let the sensors take depth image and picture `k`."""
        if self.colour is not None:
            self._send_picture(k)
        frame = self._rs.software_video_frame()
        frame.pixels, frame.stride, frame.bpp = depth(k), 2 * WIDTH, 2
        frame.timestamp, frame.domain = stamp_ns(k) / 1e6, self._rs.timestamp_domain.hardware_clock
        frame.frame_number, frame.depth_units = k, UNIT
        frame.profile = self.profile.as_video_stream_profile()
        self.sensor.on_video_frame(frame)

    @contextmanager
    def sending(self) -> Iterator[None]:
        """Send frames 0, 1, 2 ... from another thread, as a camera does, until the block ends."""
        ended = threading.Event()
        thread = threading.Thread(target=self._send_all, args=(ended.is_set, lambda: ended.wait(0.002)))
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _send_all(self, ended: Callable[[], bool], pause: Callable[[], object]) -> None:
        k = 0
        while not ended():
            try:
                self.send(k)
                k += 1
            except RuntimeError:
                pass  # not started yet, or stopped
            pause()


def record(rs: Any, path: Path, count: int) -> Path:
    """Let pyrealsense2 record `count` frames of a software camera into a `.db3`."""
    camera = SoftwareCamera(rs)
    camera.sensor.add_read_only_option(rs.option.stereo_baseline, 50.0)
    recorder = rs.recorder(str(path), camera.device)
    sensor = recorder.query_sensors()[0]
    profile = next(p for p in sensor.get_stream_profiles() if p.stream_type() == rs.stream.depth)
    queue = rs.frame_queue(count)
    sensor.open(profile)
    sensor.start(queue)
    for k in range(count):
        camera.send(k)
        arrived, _ = queue.try_wait_for_frame(5000)  # one after the other: nothing is dropped
        assert arrived
    sensor.stop()
    sensor.close()
    return path
