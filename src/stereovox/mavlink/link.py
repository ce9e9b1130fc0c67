# SPDX-License-Identifier: Apache-2.0
"""A MAVLink connection to one autopilot: heartbeats, clock comparison, messages sent and received.

The offset of an autopilot's clock: from TIMESYNC messages, or else from the least message delay.

TIMESYNC (https://mavlink.io/en/services/timesync.html): we send our time ts1, the autopilot returns it with its own,
tc1; if both directions take equally long, its clock was ahead of ours by tc1 - (ts1 + now) / 2, as in PX4's
mavlink_timesync.cpp. The latest answer with the shortest round trip counts; its error is at most half of that.
"""

from __future__ import annotations

import threading
import warnings
from collections import deque
from collections.abc import Callable
from threading import Lock
from time import monotonic_ns
from types import ModuleType
from typing import Any

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.mavlink.transport import open_transport

ANSWERS = 32
"""Number of latest TIMESYNC answers kept."""
HEARD = 200
"""Number of latest message delays kept."""
ENOUGH = 20
"""Fewest messages before their least delay is trusted."""
LONGEST_ROUND_TRIP_NS = 100_000_000
"""Answers that took longer are ignored."""
SET_BACK_NS, SLACK_NS = 100_000_000, 5_000_000
"""A clock that goes back by more than messages overtake each other was set; so was one that contradicts its earlier
answers: each is off by at most half of its round trip plus drift meanwhile."""


class RemoteClock:
    """Converts times of another machine to this one's. Thread-safe.

    Without TIMESYNC, times are late by the least delay of the link, which is unknown.

    Attributes:
        times_set: Number of times the other clock was set or restarted; earlier data is then dropped.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self.times_set = 0
        self._forget()

    def answered(self, sent_ns: int, remote_ns: int, received_ns: int) -> None:
        """Take an answer to TIMESYNC.

        Args:
            sent_ns: Time of the request, by this machine (`ts1`).
            remote_ns: Time of the answer, by the other clock (`tc1`).
            received_ns: Arrival of the answer, by this machine.
        """
        round_trip_ns = received_ns - sent_ns
        if not 0 <= round_trip_ns <= LONGEST_ROUND_TRIP_NS:
            return
        with self._lock:
            offset_ns = remote_ns - (sent_ns + received_ns) // 2
            if self._answers:
                best_trip_ns, best_ns = min(self._answers)
                if abs(offset_ns - best_ns) > (round_trip_ns + best_trip_ns) // 2 + SLACK_NS:
                    self._set_anew()
            self._answers.append((round_trip_ns, offset_ns))

    def heard(self, remote_ns: int, received_ns: int) -> None:
        """Add a message's time, in the other machine's nanoseconds, and its arrival, in this one's."""
        with self._lock:
            if remote_ns < self._latest_heard_ns - SET_BACK_NS:
                self._set_anew()
            self._latest_heard_ns = max(self._latest_heard_ns, remote_ns)
            self._heard.append(remote_ns - received_ns)

    @property
    def offset_ns(self) -> int | None:
        """How far the other clock is ahead of this one; None while too little is known."""
        with self._lock:
            if self._answers:
                return min(self._answers)[1]
            return max(self._heard) if len(self._heard) >= ENOUGH else None

    @property
    def error_ns(self) -> int | None:
        """Largest error of `offset_ns`; None if unknown, without TIMESYNC."""
        with self._lock:
            return min(self._answers)[0] // 2 if self._answers else None

    def local_ns(self, remote_ns: int) -> int | None:
        """Return a time of the other machine in this one's nanoseconds; None while too little is known."""
        offset = self.offset_ns
        return None if offset is None else remote_ns - offset

    def _set_anew(self) -> None:
        self.times_set += 1
        self._forget()

    def _forget(self) -> None:
        self._latest_heard_ns = -(1 << 62)
        self._answers: deque[tuple[int, int]] = deque(maxlen=ANSWERS)
        self._heard: deque[int] = deque(maxlen=HEARD)


AUTOPILOT = 1
"""MAV_COMP_ID_AUTOPILOT1, the component whose messages are used."""
COMPONENT = 196
"""MAV_COMP_ID_OBSTACLE_AVOIDANCE, the identity of this end."""
HEARTBEAT_NS, TIMESYNC_NS = 1_000_000_000, 200_000_000
READ_S = 0.05
Handler = Callable[[Any, int], None]
"""Called by the reading thread with a message of the autopilot and its arrival in nanoseconds."""
Tell = Callable[[str], object]


def warn(line: str) -> None:
    """Warn the user with one line, as a RuntimeWarning."""
    warnings.warn(line, RuntimeWarning, stacklevel=3)


def dialect() -> ModuleType:
    """Return pymavlink's messages of MAVLink 2; raises MissingExtra if it is not installed."""
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError:
        raise MissingExtra("pymavlink", "mavlink") from None
    return ardupilotmega


class MavlinkLink:
    """Connection to an autopilot, as its onboard computer. Thread-safe.

    It sends a heartbeat a second (MAV_TYPE_ONBOARD_CONTROLLER), requests the autopilot's time five times a second,
    answers requests for its own, and passes messages of the autopilot to handlers (`listen`).

    MAVLink without signatures is not protected: anyone who can send to the port is taken for the autopilot.

    Args:
        url: `udpout:HOST:PORT`, `udpin:HOST:PORT`, `tcp:HOST:PORT` or `serial:DEVICE:BAUD`.
        system: Number of the vehicle (PX4's MAV_SYS_ID, ArduPilot's SYSID_THISMAV); this end has the same.
        clock: This machine's time in nanoseconds.
        tell: Called with one line when the connection fails and when it recovers.

    Attributes:
        clock: Converts the autopilot's times to this machine's.
        messages: The module of pymavlink's messages and constants.

    Raises:
        StereovoxError: Another form of address, or it cannot be opened. MissingExtra: no pymavlink.
    """

    def __init__(self, url: str, *, system: int = 1, clock: Callable[[], int] = monotonic_ns, tell: Tell = warn):
        if not 1 <= system <= 255:
            raise StereovoxError(f"system {system}: give the vehicle's number, 1 to 255")
        self.messages, self.url, self.system, self.now_ns = dialect(), url, system, clock
        self.clock = RemoteClock()
        self._tell = tell
        self._failures: set[str] = set()
        self._transport = open_transport(url)
        self._packer = self.messages.MAVLink(self, system, COMPONENT)
        self._parser = self.messages.MAVLink(self, system, COMPONENT)
        self._parser.robust_parsing = True
        self._sending, self._closed = threading.Lock(), threading.Event()
        self._handlers: list[Handler] = []
        self._thread = threading.Thread(target=self._run, name="stereovox-mavlink", daemon=True)
        self._thread.start()

    def listen(self, handler: Handler) -> None:
        """Call `handler` with each message of the autopilot from now on."""
        self._handlers.append(handler)

    def ignore(self, handler: Handler) -> None:
        """Stop calling `handler`."""
        if handler in self._handlers:
            self._handlers.remove(handler)

    def send(self, message: Any) -> bool:
        """Send a message of `messages`.

        Args:
            message: An instance of one of its `MAVLink_..._message` classes.

        Returns:
            Whether the system accepted it; datagrams may still be lost.
        """
        with self._sending:
            done = self._attempt("write", lambda: self._transport.write(message.pack(self._packer)))
            self._packer.seq = (self._packer.seq + 1) % 256
            return done

    def close(self) -> None:
        """Close the connection."""
        self._closed.set()
        self._thread.join()
        self._transport.close()

    def __enter__(self) -> MavlinkLink:
        """Return itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Close the connection."""
        self.close()

    def _run(self) -> None:
        heartbeat_ns = timesync_ns = self.now_ns()
        while not self._closed.is_set():
            now_ns = self.now_ns()
            if now_ns >= heartbeat_ns:
                heartbeat_ns = now_ns + HEARTBEAT_NS
                self.send(self._heartbeat())
            if now_ns >= timesync_ns:
                timesync_ns = now_ns + TIMESYNC_NS
                self.send(self.messages.MAVLink_timesync_message(0, self.now_ns()))
            self._attempt("read", self._read)

    def _read(self) -> None:
        data = self._transport.read(READ_S)
        came_ns = self.now_ns()
        for message in (data and self._parser.parse_buffer(data)) or ():
            if message.get_srcSystem() == self.system and message.get_srcComponent() == AUTOPILOT:
                self._take(message, came_ns)

    def _take(self, message: Any, came_ns: int) -> None:
        if message.get_type() == "TIMESYNC":
            if message.tc1 == 0:
                self.send(self.messages.MAVLink_timesync_message(self.now_ns(), message.ts1))
            elif message.ts1 <= came_ns:
                self.clock.answered(message.ts1, message.tc1, came_ns)
        for handler in tuple(self._handlers):
            try:
                handler(message, came_ns)
            except Exception as error:  # one message must not end the connection
                self._told_once(f"{self.url}: {message.get_type()} cannot be used: {error}")

    def _told_once(self, line: str) -> None:
        if line not in self._failures:
            self._failures.add(line)
            self._tell(line)

    def _heartbeat(self) -> Any:
        m = self.messages
        return m.MAVLink_heartbeat_message(
            m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE, 3
        )

    def _attempt(self, what: str, act: Callable[[], object]) -> bool:
        """Attempt something that may fail with the connection; report the first failure and the recovery."""
        try:
            act()
        except OSError as error:
            if not self._closed.is_set():
                self._failed(what, error)
                self._closed.wait(READ_S)
            return False
        if what in self._failures:
            self._failures.discard(what)
            self._tell(f"{self.url}: works again")
        return True

    def _failed(self, what: str, error: OSError) -> None:
        if what not in self._failures:
            self._failures.add(what)
            self._tell(f"{self.url}: cannot {what} ({error}); is the autopilot still connected?")
