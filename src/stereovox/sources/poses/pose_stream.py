# SPDX-License-Identifier: Apache-2.0
"""Poses from other programs and devices while they run: TUM lines over UDP or TCP, and a connected T265."""

from __future__ import annotations

import socket
from abc import abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator
from threading import Event, Thread
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import SourceError, did_you_mean
from stereovox.geometry.se3 import Transform, from_quaternion
from stereovox.sources import parameters
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.tracker import AXES, HIGHEST_CONFIDENCE, turned
from stereovox.sources.poses.trajectory import FORMAT, ns_from_seconds
from stereovox.sources.realsense.realsense import library
from stereovox.sources.realsense.realsense_sensor import ns_from_ms

HERE = "127.0.0.1"
"""Default address of a stream: nobody else on the network can send the robot's pose."""
MAX_LINE, MAX_DATAGRAM = 512, 65_536
"""Most bytes of a line and of a datagram."""
LISTEN_S, RETRY_S = 0.2, 1.0
"""Seconds until a silent stream checks whether it must stop, and between two attempts to connect."""
CONFIDENT = 2.0
"""Smallest confidence of a pose, if lines have one, and of a T265's (0 failed to 3 high)."""
T_OPTICAL_BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""Maps a body's axes x forward, y left, z up into optical ones."""


class PoseStream:
    """Poses that its own thread receives and puts into `poses`, from `start` until `stop`.

    A registered class also has `recognises(where: str) -> bool` and is constructed from `where` alone.

    Attributes:
        name: For messages.
        poses: The buffer that is filled.
        counts: Events: `bad` lines, `low_confidence`, `connections`.
        trouble: The fault of the newest bad line, or of the connection; "" if missing.
    """

    def __init__(self, name: str):
        self.name, self.poses = name, LivePoses(name)
        self.counts: Counter[str] = Counter()
        self.trouble = ""
        self._stopped = Event()
        self._thread = Thread(target=self._run, name="stereovox-poses", daemon=True)

    def start(self) -> None:
        """Start receiving.

        Raises:
            SourceError: The address or device cannot be used.
        """
        self._thread.start()

    def stop(self) -> None:
        """Stop receiving."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(5.0)

    @abstractmethod
    def _receive(self) -> None:
        """Put poses into the buffer until `_stopped` is set."""

    def _run(self) -> None:
        try:
            self._receive()
            self.poses.end("the stream ended")
        except SourceError as error:
            self._fail(str(error))
        except Exception as error:  # a device that breaks must be reported, not vanish with its thread
            self._fail(f"{self.name}: {type(error).__name__}: {error}")

    def _fail(self, why: str) -> None:
        self.trouble = why
        self.poses.end(why)


class Received(NamedTuple):
    """Options behind an address. axes: axes of body and world in the lines, a word of `AXES`."""

    axes: str = "ros"


class LineStream(PoseStream):
    """Lines `stamp tx ty tz qx qy qz qw [confidence]` (TUM): seconds, metres, quaternion; # begins a comment.

    where: `udp://HOST:PORT` listens there (without HOST: only on this machine), and `tcp://HOST:PORT` connects to a
        server that sends lines, and reconnects if it hangs up. `?axes=` behind it: axes of body and world, as in
        `sources/poses/tracker.py`: `ros` (x forward, y left, z up; default), `ned`, `opengl` or `optical`.

    An unreadable line is counted and changes nothing. A pose below medium confidence (2) is unusable.
    """

    scheme = ""

    def __init__(self, where: str):
        name, given = parameters.split(where)
        super().__init__(name)
        try:
            self.axes = Received(**parameters.typed(given, {"axes": "ros"})).axes
            host, _, port = name.removeprefix(self.scheme).rpartition(":")
            self.address = host.strip("[]") or HERE, int(port)
            self.address[0].encode("idna")  # as the socket does; raises for an impossible host
            if not 0 <= self.address[1] < 65536:
                raise ValueError
        except ValueError as error:
            if isinstance(error, SourceError):
                raise SourceError(f"{where}: {error}") from None
            raise SourceError(f"{where}: write {self.scheme}HOST:PORT, for example {self.scheme}:5005") from None
        if self.axes not in AXES:
            raise SourceError(f"{where}: axes={self.axes} is unknown{did_you_mean(self.axes, AXES)}")

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` names such a stream."""
        return where.startswith(cls.scheme)

    def take(self, line: bytes) -> None:
        """Process one line."""
        text = line.partition(b"#")[0].strip()
        if not text:
            return
        try:
            if len(line) > MAX_LINE:
                raise ValueError(f"longer than {MAX_LINE} bytes")
            stamp_ns, T, confidence = read_line(text.decode("ascii"))
        except ValueError as error:
            self.counts["bad"] += 1
            self.trouble = f"{self.name}: a line cannot be read ({_short(text)}: {error}); send '{FORMAT}'"
            return
        confident = confidence is None or confidence >= CONFIDENT
        if not confident:
            self.counts["low_confidence"] += 1
        self.poses.add(stamp_ns, body_pose(T, self.axes), confident, quality=_quality(confidence))


class UdpPoses(LineStream):
    """One or several lines in each datagram; see `LineStream`."""

    scheme = "udp://"

    def start(self) -> None:
        """Start listening."""
        self._socket = _opened(self.name, self.address, socket.SOCK_DGRAM)
        self._socket.settimeout(LISTEN_S)
        self.port: int = self._socket.getsockname()[1]
        super().start()

    def _receive(self) -> None:
        with self._socket:
            while not self._stopped.is_set():
                try:
                    data = self._socket.recv(MAX_DATAGRAM)
                except TimeoutError:
                    continue
                except OSError as error:
                    raise SourceError(f"{self.name}: {error.strerror or error}; is the address in use?") from None
                for line in data.split(b"\n"):
                    self.take(line)


class TcpPoses(LineStream):
    """Lines sent by a server; see `LineStream`."""

    scheme = "tcp://"

    def _receive(self) -> None:
        while not self._stopped.is_set():
            try:
                with socket.create_connection(self.address, RETRY_S) as connection:
                    self.counts["connections"] += 1
                    self.poses.resume()
                    connection.settimeout(LISTEN_S)
                    for line in lines_of(connection.recv, self._stopped.is_set):
                        self.take(line)
                why = "the server hung up"
            except OSError as error:
                why = error.strerror or str(error)
            self.trouble = f"{self.name}: {why}; trying again"
            self.poses.end(why)
            self._stopped.wait(RETRY_S)


class T265(PoseStream):
    """A connected tracking camera, `t265` or `t265:SERIAL`, whose body is the tracker, facing forward.

    Poses below medium confidence are unusable. context: as for `RealSense`.
    Raises MissingExtra without pyrealsense2; SourceError if none is connected, as with pyrealsense2 2.55 and later,
    which no longer support it.
    """

    def __init__(self, where: str, context: Any = None):
        super().__init__(where)
        rs = library()
        self._rs, self._queue = rs, rs.frame_queue(64)
        serial = where.partition(":")[2]
        try:
            found = [
                (sensor, profile)
                for device in (context or rs.context()).query_devices()
                if not serial or device.get_info(rs.camera_info.serial_number) == serial
                for sensor in device.query_sensors()
                for profile in sensor.get_stream_profiles()
                if profile.stream_type() == rs.stream.pose
            ]
        except RuntimeError as error:
            raise SourceError(f"{where}: {error}; plug it in again") from None
        if not found:
            cure = "it needs pyrealsense2 before 2.55; or send its poses as lines (udp://:5005)"
            raise SourceError(f"{where}: pyrealsense2 finds no tracking camera; {cure}")
        self._sensor, self._profile = found[0]

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` names a T265."""
        return where.partition(":")[0] == "t265"

    def start(self) -> None:
        """Start tracking."""
        try:
            self._sensor.open(self._profile)
            self._sensor.start(self._queue)
        except RuntimeError as error:
            raise SourceError(f"{self.name}: {' '.join(str(error).split())}; plug it in again") from None
        super().start()

    def _receive(self) -> None:
        try:
            while not self._stopped.is_set():
                arrived, image = self._queue.try_wait_for_frame(round(1000 * LISTEN_S))
                if arrived:
                    self._take(image)
        finally:
            for end in (self._sensor.stop, self._sensor.close):
                try:
                    end()
                except RuntimeError:
                    continue  # unplugged

    def _take(self, image: Any) -> None:
        data = image.as_pose_frame().get_pose_data()
        p, q = data.translation, data.rotation
        try:
            T = from_quaternion((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))
        except ValueError:
            T = np.full((4, 4), np.nan)
        confident = data.tracker_confidence >= CONFIDENT
        if not confident:
            self.counts["low_confidence"] += 1
        quality = _quality(data.tracker_confidence)
        self.poses.add(ns_from_ms(image.get_timestamp()), body_pose(T, "opengl"), confident, quality=quality)


def read_line(text: str) -> tuple[int, Transform, float | None]:
    """Return stamp in nanoseconds, pose (4, 4) and confidence (None if none is reported) of a line.

    Raises ValueError for anything but `stamp tx ty tz qx qy qz qw [confidence]`.
    """
    stamp, *words = text.replace(",", " ").split()
    numbers = [float(word) for word in words]
    if len(numbers) not in (7, 8) or not np.isfinite(numbers).all():
        raise ValueError(f"needs 7 or 8 finite numbers behind the stamp, not {len(numbers)}")
    if max(map(abs, numbers)) > 1e6 or np.hypot.reduce(numbers[3:7]) < 1e-6:
        raise ValueError("quaternion of length zero, or numbers beyond a million")
    confidence = numbers[7] if len(numbers) == 8 else None
    if confidence is not None and not 0 <= confidence <= HIGHEST_CONFIDENCE:
        raise ValueError(f"confidence {confidence:g} is not 0 to {HIGHEST_CONFIDENCE}")
    return ns_from_seconds(stamp), from_quaternion(numbers[:3], numbers[3:7]), confidence


def body_pose(T_file: Transform, axes: str) -> NDArray[np.float64]:
    """Return T_world_body (4, 4), body x forward, y left, z up, world z up, of a pose whose body and world have `axes`.

    axes: a word of `sources.tracker.AXES`.
    """
    if axes == "ros":
        return T_file
    return turned(T_file[None], axes, "up")[0] @ T_OPTICAL_BODY


def lines_of(receive: Callable[[int], bytes], stopped: Callable[[], bool]) -> Iterator[bytes]:
    """Yield the lines of a stream of bytes until it ends; overlong lines are truncated."""
    rest = b""
    while not stopped():
        try:
            data = receive(4096)
        except TimeoutError:
            continue
        if not data:
            return
        *lines, rest = (rest + data).split(b"\n")
        yield from lines
        rest = rest[: MAX_LINE + 1]  # a line without end cannot fill the memory


def _opened(name: str, address: tuple[str, int], kind: socket.SocketKind) -> socket.socket:
    try:
        family, _, _, _, place = socket.getaddrinfo(*address, type=kind)[0]
        opened = socket.socket(family, kind)
        opened.bind(place)
    except OSError as error:
        raise SourceError(f"{name}: {error.strerror or error}; choose a free port of this machine") from None
    return opened


def _quality(confidence: float | None) -> int:
    """Return a confidence in per cent, 0 if it is unknown."""
    return 0 if confidence is None else round(100 * confidence / HIGHEST_CONFIDENCE)


def _short(text: bytes) -> str:
    return repr(text[:40])[1:]
