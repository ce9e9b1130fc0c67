# SPDX-License-Identifier: Apache-2.0
"""Cameras and senders of poses for tests of live runs: small, quick, and stamped by the clock of this machine."""

from __future__ import annotations

import socket
import threading
from time import monotonic, sleep, time_ns

import numpy as np
from scipy.spatial.transform import Rotation

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.frame import FORWARD, Cloud, Frame
from stereovox.sources.base import Stream

CAMERA = PinholeCamera.from_field_of_view(64, 48, 80.0)
NOWHERE = np.full((4, 4), np.nan)
SPEED_MPS = 0.5


def wall(distance_m, camera=CAMERA, seed=0):
    """A wall that stands across the view, in millimetres, a little noisy as a measured one is."""
    noise = np.random.default_rng(seed).normal(0, 3, (camera.height, camera.width))
    return np.rint(1000 * distance_m + noise).astype(np.uint16)


class Images(Stream):
    """`count` images of a wall, every `period_s`, stamped when they are taken, without poses, from an event on."""

    def __init__(self, name="camera", count=10, period_s=0.02, offset_ns=0, distance_m=2.0, failure=None, begins=None):
        self.name, self.camera, self.notes, self.posed = name, CAMERA, (), False
        self.count, self.period_s, self.offset_ns, self.distance_m = count, period_s, offset_ns, distance_m
        self.failure, self.closed, self.stamps, self.begins = failure, False, [], begins

    def __iter__(self):
        try:
            if self.begins is not None:
                self.begins.wait(60)
            begin = monotonic()
            for k in range(self.count):
                sleep(max(0.0, begin + k * self.period_s - monotonic()))
                now_ns = time_ns()
                self.stamps.append(now_ns)
                yield Frame(
                    wall(self.distance_m, seed=k), CAMERA, NOWHERE, now_ns + self.offset_ns, 0.001,
                    name=f"{self.name} {k}", fault="no_pose", fault_detail="none of its own",
                )  # fmt: skip
            if self.failure:
                raise self.failure
        finally:
            self.closed = True


class Clouds(Stream):
    """Clouds of a wall that stands `distance_m` before the lidar, in its own axes (x forward), without poses."""

    name, camera, notes, posed = "lidar", FORWARD, (), False

    def __init__(self, count=10, period_s=0.03, distance_m=3.05):
        self.count, self.period_s, self.distance_m = count, period_s, distance_m

    def __iter__(self):
        y, z = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-3, 3, 120)]))
        for k in range(self.count):
            sleep(self.period_s)
            x = self.distance_m + np.random.default_rng(k).normal(0, 0.003, y.size)
            yield Cloud(np.column_stack([x, y, z]), NOWHERE, time_ns(), fault="no_pose", fault_detail="none of its own")


def pose_at(now_ns, begin_ns):
    """T_world_body of a body that moves to the left, slowly, while it turns a little."""
    seconds = (now_ns - begin_ns) / 1e9
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", 5 * seconds, degrees=True).as_matrix()
    T[1, 3] = SPEED_MPS * seconds
    return T


def tum_line(stamp_ns, T):
    numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d} {' '.join(f'{x:.9f}' for x in numbers)}\n".encode()


class Sender:
    """Calls `send(stamp_ns, T_world_body)` every 5 ms in a thread, while the block lasts."""

    def __init__(self, send):
        self._send, self.begin_ns = send, time_ns()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ended.set()
        self._thread.join()

    def _run(self):
        while not self._ended.wait(0.005):
            now_ns = time_ns()
            self._send(now_ns, pose_at(now_ns, self.begin_ns))


def udp_sender(port):
    """Return what sends lines to a port of this machine."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return lambda stamp_ns, T: out.sendto(tum_line(stamp_ns, T), ("127.0.0.1", port))


def free_port(kind=socket.SOCK_DGRAM):
    with socket.socket(socket.AF_INET, kind) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def at_body(T_world_body, T_body_camera=T_BODY_OPTICAL):
    return T_world_body @ T_body_camera
