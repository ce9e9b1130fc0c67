# SPDX-License-Identifier: Apache-2.0
"""A connected RealSense depth camera (D400 series), read live; for recorded files see `bags.recording`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import count
from typing import Any, NoReturn, TypeVar

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import MissingExtra, SourceError, StereovoxError
from stereovox.frame import Frame
from stereovox.sources import parameters
from stereovox.sources.base import Stream
from stereovox.sources.imu import LiveImu
from stereovox.sources.realsense.realsense_sensor import (
    FIRST_IMAGES,
    FIRST_S,
    find_motion,
    find_photos,
    ns_from_ms,
    stopped,
)

T = TypeVar("T")

PREFIX = "realsense:"
WAITING = 2
"""Frames kept while the map is busy; older ones are dropped, so that the map never lags behind the camera."""
PATIENCE_MS = 5000
PREFERRED = (848, 480, 30)
"""Width, height, frames a second: the D435's most accurate mode, used by Chien 2020."""


@dataclass(frozen=True)
class Options:
    """Options after the name, as in `realsense:?width=848&height=480&fps=30`; 0 or -1: the camera's own.

    width, height: pixels. fps: frames a second. emitter: 0 off, 1 on. laser_power: milliwatts (D435: 0 to 360).
    baseline: metres between the two infrared cameras, if the camera does not report it. pose: `fixed` for a camera
    at rest; every pose is then the identity. imu: `off` to leave gyroscope and accelerometer out. photo: `off` to leave
    the colour camera out.
    """

    width: int = 0
    height: int = 0
    fps: int = 0
    emitter: int = -1
    laser_power: float = -1.0
    baseline: float = 0.0
    pose: str = ""
    imu: str = ""
    photo: str = ""

    def __post_init__(self) -> None:
        if self.pose not in ("", "fixed"):
            raise SourceError(f"pose={self.pose} must be fixed")
        for key in ("imu", "photo"):
            if getattr(self, key) not in ("", "off"):
                raise SourceError(f"{key}={getattr(self, key)} must be off, or left out")
        for key in ("width", "height", "fps", "baseline", "emitter", "laser_power"):
            unset = key in ("emitter", "laser_power") and getattr(self, key) == -1
            if getattr(self, key) < 0 and not unset:
                raise SourceError(f"{key}={getattr(self, key):g} must be a positive number")


class RealSense(Stream):
    """Depth images of a connected camera, from now until the consumer stops: it has no length and no frame(i).

    location: `realsense:` or, if several are connected, `realsense:SERIAL`; `Options` may follow.
    context: lists the devices; pyrealsense2's own unless a test replaces it.
    Invalid pixels are 0, whatever the reason: all are UNKNOWN and clear nothing.
    Time: the frame's, in the clock domain of the camera. Camera, unit and baseline come from the device. Without
    `pose=fixed` every frame has the fault `no_pose`, but keeps its depth: a camera does not know its pose,
    and pyrealsense2 2.55 and later no longer supports the T265.
    Raises MissingExtra without pyrealsense2; SourceError if no camera or not the right one is connected,
    for unsupported modes and settings, and during capture if no frame arrives for 5 s.
    """

    layout = "a connected RealSense camera (realsense: or realsense:SERIAL)"

    def __init__(self, location: str, context: Any = None):
        self._rs = library()
        serial, self.options = _parse(location)
        location = location.removesuffix(":")  # start of messages
        try:
            self._device = _device(self._rs, context or self._rs.context(), location, serial)
            self._sensor = _depth_sensor(self._device, location)
            self._profile = _profile(self._rs, self._sensor, self.options, location)
            _apply(self._rs, self._sensor, self.options, location)
            baseline = self.options.baseline or _baseline(self._rs, self._sensor)
            self.camera, self.notes = _camera(self._profile, baseline, location)
        except RuntimeError as error:
            _failed(location, error)
        self.name = PREFIX + _serial(self._rs, self._device)
        self.posed = self.options.pose == "fixed"
        self._motion = self._beside("IMU", self.options.imu, partial(find_motion, name=self.name))
        self._photos = self._beside("colour camera", self.options.photo, find_photos)

    def _beside(self, what: str, option: str, find: Callable[[Any, Any, Any], T | None]) -> T | None:
        """Return a sensor that helps tracking, None if it is missing or its mount is unknown."""
        if self.posed or option == "off":
            return None
        try:
            return find(self._rs, self._device, self._profile)
        except (RuntimeError, StereovoxError) as error:
            self.notes = (*self.notes, f"{self.name}: its {what} is not used ({' '.join(str(error).split())})")
            return None

    def imu(self) -> LiveImu | None:
        """Return the camera's IMU, whose readings arrive with its images."""
        return None if self._motion is None else self._motion.imu

    @classmethod
    def recognises(cls, location: str) -> bool:
        """Return whether `location` names a connected camera."""
        return location.startswith(PREFIX)

    def __iter__(self) -> Iterator[Frame]:
        """Start the camera, yield its frames, and stop it when the consumer stops; frames not consumed in time are
        dropped.
        """
        queue = self._rs.frame_queue(WAITING)
        try:
            if self._motion is not None and not self._motion.start():
                self._motion = None
            if self._photos is not None and not self._photos.start():
                self._photos = None
            try:
                self._sensor.open(self._profile)
                self._sensor.start(queue)
            except RuntimeError as error:
                _failed(self.name, error)
            for number in count():
                arrived, image = queue.try_wait_for_frame(PATIENCE_MS)
                if not arrived:
                    raise SourceError(f"{self.name}: no frame for {PATIENCE_MS / 1000:g} s; check cable and USB port")
                if self._ready(number):
                    yield self._frame(image)
        finally:
            self._stop()

    def _ready(self, images: int) -> bool:
        """Read the IMU; return whether it has enough readings for an image to count, or `images` have waited."""
        if self._motion is None:
            return True
        self._motion.read()
        return self._motion.imu.seconds >= FIRST_S or images >= FIRST_IMAGES

    def _stop(self) -> None:
        for beside in (self._motion, self._photos):
            if beside is not None:
                beside.stop()
        stopped(self._sensor)

    def _frame(self, image: Any) -> Frame:
        depth = np.array(image.get_data())  # a copy: the library reuses its memory
        stamp_ns = ns_from_ms(image.get_timestamp())
        name = f"{self.name} frame {image.get_frame_number()}"
        unit = float(image.as_depth_frame().get_units())
        if self.options.pose == "fixed":
            return Frame(depth, self.camera, np.eye(4), stamp_ns, unit, name=name, sensor=self.name)
        detail = f"{name}: the camera does not know its pose; add ?pose=fixed if it stands still, else record it"
        detail += " and put poses next to the recording in a camera pair (pair.toml)"
        return Frame(
            depth, self.camera, np.full((4, 4), np.nan), stamp_ns, unit, name=name, sensor=self.name,
            fault="no_pose", fault_detail=detail, photo=None if self._photos is None else self._photos.near(stamp_ns),
        )  # fmt: skip


def library() -> Any:
    """Return pyrealsense2; raises MissingExtra without it."""
    try:
        import pyrealsense2
    except ImportError:
        raise MissingExtra("pyrealsense2", "realsense") from None
    return pyrealsense2


def _parse(location: str) -> tuple[str, Options]:
    try:
        serial, given = parameters.split(location.removeprefix(PREFIX))
        return serial, Options(**parameters.typed(given, parameters.defaults(Options)))
    except SourceError as error:
        raise SourceError(f"{location}: {error}") from None


def _device(rs: Any, context: Any, location: str, serial: str) -> Any:
    devices = {_serial(rs, device): device for device in context.query_devices()}
    if not devices:
        cure = "plug one into a USB 3 port, or give a recorded .db3 or .bag file"
        raise SourceError(f"{location}: no RealSense camera is connected; {cure}")
    if serial:
        if serial not in devices:
            raise SourceError(f"{location}: not connected; there is {_device_names(devices)}")
        return devices[serial]
    if len(devices) > 1:
        raise SourceError(f"{location}: several cameras are connected, choose one: {_device_names(devices)}")
    return next(iter(devices.values()))


def _device_names(devices: dict[str, Any]) -> str:
    return " or ".join(PREFIX + serial for serial in devices)


def _serial(rs: Any, device: Any) -> str:
    key = rs.camera_info.serial_number
    return device.get_info(key) if device.supports(key) else "unnamed"


def _depth_sensor(device: Any, location: str) -> Any:
    for sensor in device.query_sensors():
        if sensor.is_depth_sensor():
            return sensor
    raise SourceError(f"{location}: this camera has no depth sensor; give the serial number of one with a depth sensor")


def _profile(rs: Any, sensor: Any, options: Options, location: str) -> Any:
    """Return the requested mode; unspecified values are PREFERRED or as near as possible."""
    modes = {}
    for profile in sensor.get_stream_profiles():
        if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16:
            video = profile.as_video_stream_profile()
            modes[video.width(), video.height(), profile.fps()] = video
    asked = (options.width, options.height, options.fps)
    fitting = [mode for mode in modes if all(want in (0, has) for want, has in zip(asked, mode, strict=True))]
    if not fitting:
        known = ", ".join("{}x{} at {}".format(*mode) for mode in sorted(modes)) or "none at all"
        raise SourceError(f"{location}: the camera has no such depth mode; it has {known} Hz")
    return modes[min(fitting, key=lambda mode: [abs(has - want) for has, want in zip(mode, PREFERRED, strict=True)])]


def _apply(rs: Any, sensor: Any, options: Options, location: str) -> None:
    settings = (
        ("emitter", rs.option.emitter_enabled, options.emitter),
        ("laser_power", rs.option.laser_power, options.laser_power),
    )
    for key, option, value in settings:
        if value < 0:
            continue
        if not sensor.supports(option):
            raise SourceError(f"{location}: this camera has no setting {key}; leave {key}= out")
        try:
            sensor.set_option(option, float(value))
        except RuntimeError:
            limits = sensor.get_option_range(option)
            raise SourceError(f"{location}: {key} must be {limits.min:g} to {limits.max:g}") from None


def _baseline(rs: Any, sensor: Any) -> float | None:
    """Return the metres between the infrared cameras: from the sensor, else from their extrinsics."""
    if sensor.supports(rs.option.stereo_baseline):
        return sensor.get_option(rs.option.stereo_baseline) / 1000 or None
    eyes = {
        profile.stream_index(): profile
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.infrared
    }
    if 1 not in eyes or 2 not in eyes:
        return None
    try:
        apart = eyes[1].get_extrinsics_to(eyes[2]).translation
    except RuntimeError:
        return None
    return float(np.linalg.norm(apart)) or None


def _camera(profile: Any, baseline: float | None, location: str) -> tuple[PinholeCamera, tuple[str, ...]]:
    intrinsics = profile.get_intrinsics()
    numbers = (intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy)
    note = f"{location}: the camera reports lens distortion in its depth, which is not corrected"
    try:
        return PinholeCamera(*numbers, None if baseline is None else abs(baseline)), (note,) if any(
            intrinsics.coeffs
        ) else ()
    except StereovoxError as error:
        raise SourceError(f"{location}: {error}") from None


def _failed(location: str, error: Exception) -> NoReturn:
    said = " ".join(str(error).split()).rstrip(".")
    raise SourceError(f"{location}: {said}; is another program using the camera? plug it in again") from None
