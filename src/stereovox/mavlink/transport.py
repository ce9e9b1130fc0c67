# SPDX-License-Identifier: Apache-2.0
"""Bytes to and from an autopilot: `udpout:HOST:PORT`, `udpin:HOST:PORT`, `tcp:HOST:PORT`, `serial:DEVICE:BAUD`.

pymavlink's own connections choose the protocol version by a process-wide environment variable; these do not.
"""

from __future__ import annotations

import socket
from collections.abc import Callable
from contextlib import suppress
from time import monotonic
from typing import Any, Protocol

from stereovox.errors import MissingExtra, StereovoxError

MAX_DATAGRAM = 65536
CONNECT_S, RETRY_S = 2.0, 1.0
FORMS = "udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


class Transport(Protocol):
    """A byte channel; one thread reads, another may write meanwhile."""

    def read(self, seconds: float) -> bytes:
        """Return bytes that arrived within `seconds`, possibly none. Raises OSError if the channel is gone."""
        ...

    def write(self, data: bytes) -> None:
        """Send bytes; datagrams may be lost. Raises OSError if the channel is gone."""
        ...

    def close(self) -> None:
        """Close it; a `read` in another thread returns soon."""
        ...


def open_transport(url: str) -> Transport:
    """Return the channel to an autopilot given by `url`; raises StereovoxError if invalid or unreachable."""
    kind, _, rest = url.partition(":")
    place, _, number = rest.rpartition(":")
    if kind not in {"udpout", "udpin", "tcp", "serial"} or not place or not number.isdecimal() or len(number) > 9:
        raise StereovoxError(f"connection '{url}': give {FORMS}")
    if kind == "serial":
        return Reopened(lambda: SerialTransport(url, place, int(number)))
    if not 0 <= int(number) <= 65535:
        raise StereovoxError(f"connection '{url}': {number} is no port; give one up to 65535")
    try:
        if kind == "tcp":
            return Reopened(lambda: TcpTransport(place, int(number)))
        return UdpTransport(kind, place, int(number))
    except (OSError, UnicodeError) as error:  # UnicodeError: a host of impossible length
        raise StereovoxError(f"connection '{url}': {error}; is the address right, and the port not in use?") from None


class Reopened:
    """A channel that reopens after a break, such as a pulled cable, trying once a second.

    open: returns the channel; its first error is raised.
    """

    def __init__(self, open: Callable[[], Transport]):
        self._open, self._way, self._due_s, self._broken = open, open(), 0.0, False

    def read(self, seconds: float) -> bytes:
        """Return bytes that arrived; reopen the channel if it broke."""
        if self._broken:
            if monotonic() < self._due_s:
                raise ConnectionError("the connection is gone")
            self._due_s = monotonic() + RETRY_S
            self._way, self._broken = self._opened(), False
        try:
            return self._way.read(seconds)
        except OSError:
            self._broken = True
            self._way.close()
            raise

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        if self._broken:
            raise ConnectionError("the connection is gone")
        self._way.write(data)

    def close(self) -> None:
        """Close the channel."""
        self._way.close()

    def _opened(self) -> Transport:
        try:
            return self._open()
        except StereovoxError as error:
            raise ConnectionError(str(error)) from None


class UdpTransport:
    """Datagrams. udpin: listens, and answers the last sender; udpout: sends to one address."""

    def __init__(self, kind: str, host: str, port: int):
        address = socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._peer: Any = address if kind == "udpout" else None
        try:
            self._socket.bind(("", 0) if kind == "udpout" else address)
        except OSError:
            self._socket.close()
            raise
        self._follow = kind == "udpin"

    @property
    def port(self) -> int:
        """The port of this end."""
        return int(self._socket.getsockname()[1])

    def read(self, seconds: float) -> bytes:
        """Return the next datagram."""
        self._socket.settimeout(seconds)
        try:
            data, sender = self._socket.recvfrom(MAX_DATAGRAM)
        except (TimeoutError, ConnectionRefusedError):  # refused: the other end is not listening yet
            return b""
        if self._follow:
            self._peer = sender
        return data

    def write(self, data: bytes) -> None:
        """Send one datagram, if the receiver is known."""
        if self._peer is not None:
            with suppress(ConnectionRefusedError, BlockingIOError, TimeoutError):
                self._socket.sendto(data, self._peer)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class TcpTransport:
    """A stream to a server."""

    def __init__(self, host: str, port: int):
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def read(self, seconds: float) -> bytes:
        """Return bytes that arrived."""
        self._socket.settimeout(seconds)
        try:
            data = self._socket.recv(MAX_DATAGRAM)
        except TimeoutError:
            return b""
        if not data:
            raise ConnectionResetError("the autopilot closed the connection")
        return data

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        self._socket.sendall(data)

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class SerialTransport:
    """A serial port, by pyserial."""

    def __init__(self, url: str, device: str, baud: int):
        try:
            import serial
        except ImportError:
            raise MissingExtra("pyserial", "mavlink") from None
        try:
            self._port = serial.Serial(device, baud, timeout=0.1)
        except (OSError, ValueError) as error:
            raise StereovoxError(
                f"connection '{url}': {error}; is the device right, and may this user use it?"
            ) from None

    def read(self, seconds: float) -> bytes:
        """Return bytes that arrived."""
        self._port.timeout = seconds
        return self._port.read(max(1, self._port.in_waiting))

    def write(self, data: bytes) -> None:
        """Send all bytes."""
        self._port.write(data)

    def close(self) -> None:
        """Close the port."""
        self._port.close()
