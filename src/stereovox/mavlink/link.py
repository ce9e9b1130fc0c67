# SPDX-License-Identifier: Apache-2.0
"""A MAVLink connection to one autopilot: heartbeats, clock comparison, messages sent and received."""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable
from time import monotonic_ns
from types import ModuleType
from typing import Any

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.mavlink.clock import RemoteClock
from stereovox.mavlink.transport import open_transport

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
