# SPDX-License-Identifier: Apache-2.0
"""The IMU of a live camera, with a stand-in for the library and for the camera's sensors."""

from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.opening import open_stream
from stereovox.sources.base import Excerpt
from stereovox.sources.realsense import realsense

WIDTH, HEIGHT = 8, 6
TURNED = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
"""Column by column: x of the IMU is y of the depth image."""
START_MS = 1_700_000_000_000.0


class Queue:
    def __init__(self, size=1):
        self.size, self.items = size, []

    def try_wait_for_frame(self, patience_ms):
        return True, self.items.pop(0)(self)

    def poll_for_frame(self):
        return self.items.pop(0) if self.items else None


class Profile:
    def __init__(self, kind, fps):
        self._kind, self._fps = kind, fps

    def stream_type(self):
        return self._kind

    def fps(self):
        return self._fps

    def format(self):
        return "z16"

    def as_video_stream_profile(self):
        return self

    width, height = staticmethod(lambda: WIDTH), staticmethod(lambda: HEIGHT)

    def get_intrinsics(self):
        return SimpleNamespace(width=WIDTH, height=HEIGHT, fx=6.0, fy=6.0, ppx=3.5, ppy=2.5, coeffs=[0.0] * 5)

    def get_extrinsics_to(self, other):
        return SimpleNamespace(rotation=TURNED, translation=[0.01, 0.02, 0.03])


def reading(kind, ms, x, y, z):
    return SimpleNamespace(
        get_profile=lambda: Profile(kind, 200),
        get_timestamp=lambda: START_MS + ms,
        as_motion_frame=lambda: SimpleNamespace(get_motion_data=lambda: SimpleNamespace(x=x, y=y, z=z)),
    )


class Sensor:
    """Depth images at 10 Hz, or what an IMU measured until each of them."""

    def __init__(self, profiles, fails=False):
        self.profiles, self.queue, self.fails, self.opened, self.stopped = profiles, None, fails, None, 0

    def get_stream_profiles(self):
        return self.profiles

    def is_depth_sensor(self):
        return self.profiles[0].stream_type() == "depth"

    def supports(self, option):
        return False

    def open(self, profiles):
        self.opened = profiles

    def start(self, queue):
        if self.fails:
            raise RuntimeError("busy")
        self.queue = queue

    def stop(self):
        self.stopped += 1

    close = stop


class Camera:
    def __init__(self, imu=True, fails=False):
        self.depth = Sensor([Profile("depth", 30)])
        profiles = [Profile("gyro", 200), Profile("gyro", 400), Profile("accel", 100), Profile("accel", 63)]
        self.motion = Sensor(profiles, fails)
        self.sensors = [self.depth, *([self.motion] if imu else [])]

    def query_devices(self):
        return [self]

    def query_sensors(self):
        return self.sensors

    def supports(self, key):
        return False

    def image(self, k):
        """Image `k`; until then the IMU has measured for another 0.1 s."""

        def take(queue):
            if self.motion.queue is not None:
                for j in range(20):
                    ms = 100 * k + 5 * j
                    self.motion.queue.items.append(reading("gyro", ms, 0.1 * k, 0.2, 0.3))
                    if j % 2:
                        self.motion.queue.items.append(reading("accel", ms, 1.0, 2.0, 9.0))
            queue.items.append(self.image(k + 1))
            return SimpleNamespace(
                get_data=lambda: np.full((HEIGHT, WIDTH), 1000, np.uint16),
                get_timestamp=lambda: START_MS + 100 * k + 98,
                get_frame_number=lambda: k,
                as_depth_frame=lambda: SimpleNamespace(get_units=lambda: 0.001),
            )

        return take


@pytest.fixture
def plugged(monkeypatch):
    def plug(camera):
        def queue(size):
            made = Queue(size)
            if size == realsense.WAITING:
                made.items.append(camera.image(0))
            return made

        names = ("emitter_enabled", "laser_power", "stereo_baseline")
        rs = SimpleNamespace(
            stream=SimpleNamespace(depth="depth", gyro="gyro", accel="accel", infrared="infrared", color="color"),
            format=SimpleNamespace(z16="z16"), camera_info=SimpleNamespace(serial_number="serial"),
            option=SimpleNamespace(**{name: name for name in names}), frame_queue=queue, context=lambda: camera,
        )  # fmt: skip
        monkeypatch.setattr(realsense, "library", lambda: rs)
        return camera

    return plug


def numbers(frames):
    return [int(frame.name.rpartition(" ")[2]) for frame in frames]


def test_readings_arrive_with_the_images(plugged):
    camera = plugged(Camera())
    stream = realsense.RealSense("realsense:")
    imu = stream.imu()
    frames = list(islice(iter(stream), 3))
    found = imu.between(frames[0].stamp_ns - 150_000_000, frames[0].stamp_ns)
    assert len(found) > 28
    np.testing.assert_allclose(found.specific_force[5], [1, 2, 9])
    np.testing.assert_allclose(found.T_sensor_imu[:3, :3] @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(found.T_sensor_imu[:3, 3], [0.01, 0.02, 0.03])
    assert found.stamps_ns[-1] >= frames[0].stamp_ns - 5_000_000
    assert sorted(profile.fps() for profile in camera.motion.opened) == [100, 400]


def test_images_wait_until_the_imu_has_spoken(plugged):
    plugged(Camera())
    assert numbers(islice(iter(realsense.RealSense("realsense:")), 2)) == [5, 6]
    plugged(Camera(imu=False))
    assert numbers(islice(iter(realsense.RealSense("realsense:")), 2)) == [0, 1]


def test_an_imu_that_says_nothing_does_not_stop_the_camera(plugged, monkeypatch):
    camera = plugged(Camera())
    monkeypatch.setattr(camera.motion, "start", lambda queue: None)
    assert numbers(islice(iter(realsense.RealSense("realsense:")), 1)) == [30]


def test_an_imu_that_does_not_start_does_not_stop_the_camera(plugged):
    plugged(Camera(fails=True))
    assert numbers(islice(iter(realsense.RealSense("realsense:")), 2)) == [0, 1]


def test_both_sensors_stop_with_the_consumer(plugged):
    camera = plugged(Camera())
    frames = iter(realsense.RealSense("realsense:"))
    next(frames)
    frames.close()
    assert (camera.depth.stopped, camera.motion.stopped) == (2, 2)


@pytest.mark.parametrize("options", ["?imu=off", "?pose=fixed"])
def test_it_can_be_left_out(plugged, options):
    camera = plugged(Camera())
    stream = realsense.RealSense(f"realsense:{options}")
    next(iter(stream))
    assert stream.imu() is None
    assert camera.motion.opened is None
    with pytest.raises(SourceError, match="imu=on must be off"):
        realsense.RealSense("realsense:?imu=on")


def test_a_camera_whose_imu_cannot_be_mounted_says_so(plugged, monkeypatch):
    def fails(self, other):
        raise RuntimeError("no extrinsics")

    monkeypatch.setattr(Profile, "get_extrinsics_to", fails)
    plugged(Camera())
    stream = realsense.RealSense("realsense:")
    assert stream.imu() is None
    assert "its IMU is not used (no extrinsics)" in stream.notes[-1]


def test_the_stream_that_drops_images_and_an_excerpt_have_the_same_imu(plugged):
    plugged(Camera())
    assert open_stream("realsense:").imu() is not None
    assert Excerpt(open_stream("realsense:"), ":3").imu() is not None
