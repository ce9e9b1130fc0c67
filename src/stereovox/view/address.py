# SPDX-License-Identifier: Apache-2.0
"""Where a page is served: which addresses there are, and who can reach them."""

from __future__ import annotations

import errno
import socket
from ipaddress import ip_address
from typing import NamedTuple

from stereovox.errors import StereovoxError

HERE, PORT = "127.0.0.1", 8080


class Address(NamedTuple):
    """Where to listen. host: as the user named it; number: the one address of it that is used."""

    host: str
    number: str
    port: int

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach it."""
        return is_loopback(self.number)


def is_loopback(number: str) -> bool:
    """Tell whether an address is one of those that never leave the machine; False for names."""
    try:
        return ip_address(number).is_loopback
    except ValueError:
        return False


def find_address(host: str, port: int) -> Address:
    """Return where to listen: the first address of `host`, which is asked for once lest the answer change.

    Raises StereovoxError where no page can be served there; viser would take another or wait for ever.
    """
    if not 0 <= port <= 65535:
        raise StereovoxError(f"port {port} does not exist; give one from 0 to 65535")
    place = f"{host}:{port}"
    try:
        if not host:
            raise OSError("it has no name")
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server will
            probe.bind(address)
    except (OSError, UnicodeError) as error:
        cures = {
            errno.EADDRINUSE: "in use; give another one (--port 8081), or --port 0 for any that is free",
            errno.EACCES: "reserved; give one above 1023",
        }
        if (number := getattr(error, "errno", None)) in cures:
            raise StereovoxError(f"{place}: this port is {cures[number]}") from None
        why = getattr(error, "strerror", None) or error
        raise StereovoxError(f"{place}: no address of this machine ({why}); leave --host out to serve {HERE}") from None
    return Address(host, str(address[0]), port)


def url_of(host: str, port: int, token: str | None = None) -> str:
    """Return the link to a page; one that is served to everybody is found at localhost."""
    host = "localhost" if host in ("0.0.0.0", "::") else host
    place = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    return place if token is None else f"{place}/?token={token}"
