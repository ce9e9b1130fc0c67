# SPDX-License-Identifier: Apache-2.0
"""Simulated cameras live, as `stereovox live` maps them: images lost, latency, share of the processor.

    python benchmarks/live.py [--seconds 600] [--cameras 1] [--hz 30] [--poses udp|track] [--no-page] [--json]

Images (a D435's, 848x480, without reasons) of a loop through the furnished room are rendered first. A player in its own
process then plays them in real time: it reports when each image is due, and sends the poses of the body 200 times a
second as lines over UDP; with `--poses track` it sends IMU readings instead, and the camera is tracked by depth, IMU
and the grey pictures of a pattern on all surfaces (`--contrast 0`: no pictures). Several cameras face all around, 360
degrees shared out. The page is open: another process reads its drawings. Another is the autopilot, which gets
OBSTACLE_DISTANCE ten times a second. 2-D map and distances all around are kept up to date (with --record a recording
too). Latency is from the stamp, when the image is due, until it is in the map and its outputs, and until the autopilot
has a message from it (`obstacles`); share: CPU time of the mapping process alone. At the end the same images are mapped
offline in the same order: `cells_that_differ`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import socket
import sys
import tempfile
from collections.abc import Iterator
from multiprocessing.connection import Connection
from pathlib import Path
from time import monotonic, sleep, time_ns
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from obstacle_latency import listen
from scipy.spatial.transform import Rotation

import stereovox as sv
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.evaluate.metrics import percentiles
from stereovox.frame import UpdateReport
from stereovox.geometry.se3 import Transform, inverse, rotation_vector
from stereovox.live.rig import LiveCamera, mount_of
from stereovox.live.run import LiveRun
from stereovox.maps.storage.storage import EVERYWHERE
from stereovox.simulate.d435 import photograph
from stereovox.simulate.simulation import GREY_NOISE, Simulation
from stereovox.sources.base import Stream
from stereovox.sources.imu import LiveImu

LOOP_S = 8.0
"""Seconds of one pass through the room; the loop returns along the same path."""
POSE_HZ, LEAD_S = 200, 1.0
"""Poses and IMU readings a second, and how much earlier they begin."""
NOWHERE = np.full((4, 4), np.nan)


class Way:
    """The body's path, back and forth forever, at rest where it turns around."""

    def __init__(self, scene: str):
        self.simulation = Simulation(scene)
        stage = self.simulation.stage
        self._path, self._share = stage.path, min(1.0, LOOP_S * 2 / np.pi * stage.hz / stage.frames)

    def at(self, seconds: float) -> Transform:
        """Return T_world_body (4, 4)."""
        share = self._share * (1 - np.cos(np.pi * seconds / LOOP_S)) / 2
        return self._path(share) @ inverse(T_BODY_OPTICAL)


class Film:
    """Depth images in a file, (images, cameras, height, width) uint16 millimetres, one pass through the loop.

    With a contrast above 0, pictures of the colour camera next to the first one in another file, (images, 480, 640)
    uint8.
    """

    T_depth_eye = np.eye(4)
    T_depth_eye[0, 3] = 0.015

    def __init__(self, file: str, count: int, mounts: list[Transform], camera: PinholeCamera, contrast: float):
        self.file, self.count, self.mounts, self.camera, self.contrast = file, count, mounts, camera, contrast
        self.shape = count, len(mounts), camera.height, camera.width
        self.eye = PinholeCamera.from_field_of_view(640, 480, 55.0)  # a D435's colour camera in this mode

    def render(self, way: Way, hz: float) -> None:
        """Write all images."""
        device, camera = way.simulation.device, self.camera
        x, y = camera.ray_slopes()
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], np.float32(1)), axis=-1).reshape(-1, 3)
        images = np.memmap(self.file, np.uint16, "w+", shape=self.shape)
        for k in range(self.count):
            for c, mount in enumerate(self.mounts):
                T = way.at(k / hz) @ mount
                depth = way.simulation.scene.cast(T[:3, 3], rays @ T[:3, :3].T.astype(np.float32))
                images[k, c] = device.measure(depth.reshape(camera.height, camera.width), [c, k], T)[0]
        images.flush()
        if self.contrast:
            eye = self.eye
            lens = Lens("pinhole", eye.width, eye.height, eye.fx, eye.fy, eye.cx, eye.cy)
            pictures = self._pictures("w+")
            for k in range(self.count):
                T = way.at(k / hz) @ self.mounts[0] @ self.T_depth_eye
                pictures[k] = photograph(way.simulation.scene, lens, T, GREY_NOISE, [k], self.contrast)
            pictures.flush()

    def photo(self, k: int, camera: int) -> sv.Photo | None:
        """Return the picture taken with image `k` of a camera."""
        if camera or not self.contrast:
            return None
        return sv.Photo(np.array(self._pictures("r")[k]), self.eye, self.T_depth_eye)

    def _pictures(self, mode: Literal["r", "w+"]) -> NDArray[np.uint8]:
        return np.memmap(f"{self.file}_grey", np.uint8, mode, shape=(self.count, self.eye.height, self.eye.width))

    def read(self) -> NDArray[np.uint16]:
        """Return the images."""
        return np.memmap(self.file, np.uint16, "r", shape=self.shape)

    def number(self, k: int) -> int:
        """Return the image shown as number `k` of an endless flight."""
        period = 2 * (self.count - 1)
        return min(k % period, period - k % period)


class Played(Stream):
    """A camera played by the player."""

    def __init__(self, name: str, number: int, film: Film, told: Connection, imu: bool):
        self.name, self.camera, self.notes, self.posed = name, film.camera, (), False
        self._film, self._number, self._told = film, number, told
        self._imu = LiveImu(np.eye(4), "made IMU") if imu else None

    def imu(self) -> LiveImu | None:
        return self._imu

    def __iter__(self) -> Iterator[sv.Frame]:
        images = self._film.read()
        while True:
            if not self._told.poll(0.2):
                continue
            said = self._told.recv()
            if said is None:
                return
            k, stamp_ns, readings = said
            if self._imu is not None:
                for when, rate, force in readings:
                    self._imu.add_angular_rate(when, rate)
                    self._imu.add_specific_force(when, force)
            image = self._film.number(k)
            depth = np.array(images[image, self._number])  # a copy, as from a camera's buffer
            yield sv.Frame(
                depth, self.camera, NOWHERE, stamp_ns, 0.001, name=f"{self.name} {k}", fault="no_pose",
                photo=self._film.photo(image, self._number),
            )  # fmt: skip


class Noted:
    """Offered images, in order, and their outcome."""

    def __init__(self) -> None:
        self.offered: list[tuple[str, int, Transform, str | None, str]] = []
        self.refused = 0
        self._mapped: list[tuple[float, float]] = []

    def after(self, frame: Any, report: UpdateReport) -> None:
        self.offered.append((frame.sensor, frame.stamp_ns, frame.T_world_sensor, frame.fault, frame.name))
        self.refused += bool(report.refused)
        if not report.refused:
            self._mapped.append((monotonic(), (time_ns() - frame.stamp_ns) / 1e9))

    def heard_ms(self, came: list[tuple[float, float]]) -> list[float]:
        """Return the ages of images behind messages, from their stamps until the messages arrived.

        came: arrival of each message, and since when its image was being mapped, both by `monotonic`.
        """
        done, age = np.array(self._mapped).reshape(-1, 2).T
        at, since = np.array(came).reshape(-1, 2).T
        image = np.searchsorted(done, since, "right")  # the first mapped after that
        in_flight = (image < len(done)) & (at < done[-1] + 0.05)  # not repeats after the last image
        at, image = at[in_flight], image[in_flight]
        return (1e3 * (at - done[image] + age[image])).tolist()


def play(tell: list[Connection], scene: str, hz: float, seconds: float, port: int, imu: bool, ready: Any) -> None:
    """Play in real time, in a separate process."""
    way, out = Way(scene), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    count = round(seconds * hz)
    ready.wait()
    begin_ns = time_ns() + round(1e9 * LEAD_S)
    due = [(begin_ns + round(1e9 * k / hz), k) for k in range(count)]
    ticks = iter([begin_ns + round(1e9 * i / POSE_HZ) for i in range(round(-LEAD_S * POSE_HZ),
                 round((seconds + 0.3) * POSE_HZ))])  # fmt: skip
    tick, readings, at = next(ticks), [], 0
    while tick is not None:
        image_ns = due[at][0] if at < count else tick + 1
        next_ns = min(tick, image_ns)
        while (left_ns := next_ns - time_ns()) > 0:
            sleep(left_ns / 1e9)
        if image_ns < tick:
            for one in tell:
                one.send((due[at][1], image_ns, readings))
            readings, at = [], at + 1
            continue
        T = way.at((tick - begin_ns) / 1e9)
        if imu:
            readings.append((tick, *felt(way, (tick - begin_ns) / 1e9)))
        else:
            numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
            text = " ".join(f"{number:.9f}" for number in numbers)
            out.sendto(f"{tick // 10**9}.{tick % 10**9:09d} {text}\n".encode(), ("127.0.0.1", port))
        tick = next(ticks, None)
    for one in tell:
        one.send(None)


def felt(way: Way, seconds: float) -> tuple[list[float], list[float]]:
    """Return rate (rad/s) and force (m/s^2) along the first camera's axes, without errors."""
    h = 2e-3
    before, here, after = (way.at(seconds + step) @ T_BODY_OPTICAL for step in (-h, 0.0, h))
    rate = rotation_vector(before[:3, :3].T @ after[:3, :3]) / (2 * h)
    faster = (after[:3, 3] - 2 * here[:3, 3] + before[:3, 3]) / h**2
    return rate.tolist(), (here[:3, :3].T @ (faster + np.array([0, 0, 9.81]))).tolist()


def look(port: int, received: Any) -> None:
    """Count the bytes that a page gets, in a separate process, like a browser on another machine."""
    import viser
    from websockets.sync.client import connect

    protocol = f"viser-v{viser.__version__}"
    try:
        with connect(f"ws://127.0.0.1:{port}/", subprotocols=[protocol], max_size=None) as page:  # type: ignore[list-item]
            while True:
                received.value += len(page.recv())
    except Exception:  # the page closed
        return


def differing(one: sv.VoxelMap, other: sv.VoxelMap) -> int:
    """Return the number of cells that differ between two maps, bit for bit, including unknown ones."""
    found = []
    for voxel_map in (one, other):
        coords, cells = voxel_map.storage.blocks_within(*EVERYWHERE)
        found.append({tuple(c): block for c, block in zip(coords.tolist(), np.asarray(cells), strict=True)})
    a, b = found
    alone = sum(np.asarray(block).size for key, block in a.items() if key not in b)
    alone += sum(np.asarray(block).size for key, block in b.items() if key not in a)
    return alone + sum(int((np.asarray(a[key]) != np.asarray(b[key])).sum()) for key in a.keys() & b.keys())


def offline(noted: Noted, film: Film, names: list[str], settings: dict[str, Any]) -> sv.VoxelMap:
    """Return the map of the same images in the same order."""
    mapper, images = sv.Mapper("default", **settings), film.read()
    for name, stamp_ns, T, fault, frame_name in noted.offered:
        k = int(frame_name.rpartition(" ")[2])
        depth = np.array(images[film.number(k), names.index(name)])
        mapper.add(sv.Frame(depth, film.camera, T, stamp_ns, 0.001, name=frame_name, sensor=name, fault=fault))
    return mapper.map


def main() -> None:
    wanted = arguments()
    context = multiprocessing.get_context("spawn")
    scene = f"sim:room?image_width={wanted.width}"
    yaws = [360 * c / wanted.cameras for c in range(wanted.cameras)]
    mounts = [mount_of([0.05 * np.cos(np.radians(y)), 0.05 * np.sin(np.radians(y)), 0, 0, 0, y]) for y in yaws]
    tracked = wanted.poses == "track"
    way = Way(scene)
    settings = {"voxel_size": wanted.voxel_size, "max_range": wanted.max_range, "threads": wanted.threads}
    with tempfile.TemporaryDirectory(dir=wanted.folder) as folder:
        film = Film(os.path.join(folder, "film"), round(LOOP_S * wanted.hz) + 1, mounts, way.simulation.camera,
                    wanted.contrast if tracked else 0.0)  # fmt: skip
        say(f"rendering {film.count} x {wanted.cameras} images of {wanted.width} pixels across ...")
        film.render(way, wanted.hz)
        pipes = [context.Pipe(duplex=False) for _ in mounts]
        names = [f"camera{c}" for c in range(wanted.cameras)]
        cameras = [
            LiveCamera(Played(name, c, film, pipes[c][0], tracked and c == 0), name, mounts[c])
            for c, name in enumerate(names)
        ]
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        ready, noted, shown = context.Event(), Noted(), context.Value("q", 0)
        player = context.Process(
            target=play, args=([send for _, send in pipes], scene, wanted.hz, wanted.seconds, port, tracked, ready),
            daemon=True,
        )  # fmt: skip
        player.start()
        autopilot, told = context.Pipe()
        context.Process(target=listen, args=(told,), daemon=True).start()
        out = os.path.join(folder, "map.svox")
        with LiveRun(cameras, out, poses="track" if tracked else f"udp://:{port}", notify=say, **settings) as run:
            record = os.path.join(folder, "log.mcap") if wanted.record else None
            view = None if wanted.no_page else 0
            grid, mavlink = os.path.join(folder, "grid.yaml"), f"udpout:127.0.0.1:{autopilot.recv()}"
            run.add_outputs(grid=grid, sphere=True, record=record, view=view, mavlink=mavlink)
            if run.page:
                page = int(run.page.split(":")[2].split("/")[0])
                context.Process(target=look, args=(page, shown), daemon=True).start()
            begin = monotonic()
            run.stream.on_start = ready.set
            done = run.finish([noted])
            say(f"done after {monotonic() - begin:.0f} s")
        autopilot.send("end")
        heard_ms = noted.heard_ms(autopilot.recv())
        same = differing(done.map, offline(noted, film, names, settings))
    sent = round(wanted.seconds * wanted.hz) * wanted.cameras
    live = done.live
    found = {
        "cameras": wanted.cameras, "hz": wanted.hz, "seconds": wanted.seconds, "poses": wanted.poses,
        "size": [film.camera.width, film.camera.height], "sent": sent,
        "received": sum(one["received"] for one in live["cameras"].values()),
        "dropped": live["dropped"], "offered": len(noted.offered), "refused": done.summary()["refused"],
        "lost": sent - len(noted.offered), "latency_ms": {**live["latency_ms"], "obstacles": percentiles(heard_ms)},
        "messages": len(heard_ms), "cpu_share": live["cpu_share"],
        "cells_that_differ": same, "occupied": done.summary()["occupied"], "load": os.getloadavg()[0],
        "page_bytes": shown.value, "recorded": live.get("recorded"), "poses_added": live.get("poses", {}).get("added"),
    }  # fmt: skip
    say(json.dumps(found, indent=1))
    if wanted.json:
        print(json.dumps(found))


def arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="how long to fly")
    parser.add_argument("--cameras", type=int, default=1)
    parser.add_argument("--hz", type=float, default=30.0, help="images of each camera a second")
    parser.add_argument("--width", type=int, default=848, help="pixels across")
    parser.add_argument("--poses", choices=("udp", "track"), default="udp")
    parser.add_argument("--contrast", type=float, default=0.3, help="of the pattern in pictures, for --poses track")
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--max-range", type=float, default=5.0)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--no-page", action="store_true", help="no page is open")
    parser.add_argument("--record", action="store_true", help="record beside")
    parser.add_argument("--folder", type=Path, help="where the images are kept meanwhile (/dev/shm: in memory)")
    parser.add_argument("--json", action="store_true", help="all figures as JSON on stdout")
    return parser.parse_args()


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    main()
