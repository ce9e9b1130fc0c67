# SPDX-License-Identifier: Apache-2.0
"""Page server: addresses, access control, and a server that checks every request."""

from __future__ import annotations

import errno
import io
import re
import secrets
import socket
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from http.cookies import CookieError, SimpleCookie
from ipaddress import ip_address
from threading import Lock
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol
from unittest.mock import patch
from urllib.parse import parse_qs, urlsplit

from stereovox.errors import MissingExtra, StereovoxError

if TYPE_CHECKING:
    from viser import ViserServer

HERE, PORT = "127.0.0.1", 8080
TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")
"""A token that needs no escaping in a link or a cookie and cannot be guessed."""
PATIENCE_S = 5.0
"""Seconds within which a browser must send its request."""
ANSWER_S = 60.0
"""Seconds within which the server must refuse a stranger, even on a busy machine."""
STRANGER = "stranger.invalid"
_STARTING = Lock()


class Address(NamedTuple):
    """Address to listen on. host: as given by the user; number: the IP address that is used."""

    host: str
    number: str
    port: int

    @property
    def is_private(self) -> bool:
        """Whether only this machine can reach it."""
        return is_loopback(self.number)


def is_loopback(number: str) -> bool:
    """Return whether an address is a loopback address; False for names."""
    try:
        return ip_address(number).is_loopback
    except ValueError:
        return False


def find_address(host: str, port: int) -> Address:
    """Return the address to listen on: the first one of `host`, resolved only once, because the answer may change.

    Raises StereovoxError if no page can be served there; viser would use another port or wait forever.
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
            errno.EADDRINUSE: "in use; give another one, as 8081, or 0 for any that is free",
            errno.EACCES: "reserved; give one above 1023",
        }
        if (number := getattr(error, "errno", None)) in cures:
            raise StereovoxError(f"{place}: this port is {cures[number]}") from None
        why = getattr(error, "strerror", None) or error
        raise StereovoxError(f"{place}: no address of this machine ({why}); leave --host out to serve {HERE}") from None
    return Address(host, str(address[0]), port)


def url_of(host: str, port: int, token: str | None = None) -> str:
    """Return the link to a page; a page on all addresses is linked at localhost."""
    host = "localhost" if host in ("0.0.0.0", "::") else host
    place = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
    return place if token is None else f"{place}/?token={token}"


class Headers(Protocol):
    """Headers of a request."""

    def get_all(self, key: str) -> list[str]:
        """Return all headers of a name, ignoring case."""
        ...


def new_token() -> str:
    """Return a random token."""
    return secrets.token_urlsafe(24)


def checked_token(token: str) -> str:
    """Return the user's token; raises StereovoxError for one that is too short or does not fit into a link."""
    if not TOKEN.fullmatch(token):
        raise StereovoxError(
            f"a token of {len(token)} characters: give 16 to 128 letters, digits, - or _, or none and one is made"
        )
    return token


class Guard:
    """Access control: admits requests with the token or, without one, from this machine.

    host: the name or address that is served. A browser is admitted only if the requesting page is from this server:
    else any page on the web could read the map through that browser, or through its own name that resolves to this
    machine (DNS rebinding).
    """

    def __init__(self, host: str, token: str | None):
        self._host, self._token = host.lower(), token

    def refusal(self, path: str, headers: Headers, port: int) -> str | None:
        """Return in one line why a request is refused, None if it is admitted. path: with its query."""
        named, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(named) != 1:
            return "one Host header is needed"
        if any(_place(origin) != named[0].lower() for origin in origins):
            return "the requesting page is from elsewhere"
        if self._token is None:
            return None if self._is_here(named[0]) else "this machine has no such name"
        offered = [*_in_link(path), *_in_cookies(headers.get_all("Cookie"), _cookie_name(port))]
        if any(self._is_token(one) for one in offered):
            return None
        return "open the link that stereovox printed: it holds the token"

    def cookie(self, path: str, port: int) -> str | None:
        """Return the cookie header that admits a browser from now on, for requests whose link has the token.

        It is hidden from scripts and other sites.
        """
        if not any(self._is_token(one) for one in _in_link(path)):
            return None
        return f"{_cookie_name(port)}={self._token}; Path=/; HttpOnly; SameSite=Strict"

    def _is_token(self, offered: str) -> bool:
        return self._token is not None and secrets.compare_digest(
            offered.encode(errors="replace"), self._token.encode()
        )

    def _is_here(self, named: str) -> bool:
        name = _name(named)
        return name in ("localhost", self._host) or is_loopback(name)


def _place(origin: str) -> str:
    """Return name and port of an origin; empty if invalid."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _name(host: str) -> str:
    """Return the name in a Host header, without its port; empty if invalid."""
    try:
        return urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return ""


def _in_link(path: str) -> list[str]:
    return parse_qs(path.partition("?")[2]).get("token", [])


def _in_cookies(headers: Iterable[str], name: str) -> Iterator[str]:
    for header in headers:
        try:
            found = SimpleCookie(header).get(name)
        except CookieError:
            continue
        if found is not None:
            yield found.value


def _cookie_name(port: int) -> str:
    """Return a name per port, since browsers send cookies to all ports of a machine."""
    return f"stereovox_{port}"


def serve(name: str, address: Address, guard: Guard) -> ViserServer:
    """Start a server whose every page, file and websocket is behind `guard`.

    Raises MissingExtra without viser, StereovoxError if the port has been taken meanwhile or this version of viser
    bypasses the guard.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtra("viser", "viewer") from None
    with redirect_stdout(io.StringIO()), _guarded(guard):  # viser prints a greeting
        server = viser.ViserServer(host=address.number, port=address.port, label=name, verbose=False)
    port = server.get_port()
    if address.port and port != address.port:
        stop(server)
        raise StereovoxError(f"{address.host}:{address.port}: this port is in use; give another one, as {port}")
    if not _is_guarded(address.number, port):
        stop(server)
        raise StereovoxError(f"viser {viser.__version__} would show the map to anyone; install viser 1.1")
    return server


def stop(server: ViserServer) -> None:
    """Stop the server."""
    with redirect_stdout(io.StringIO()):  # viser prints a farewell
        server.stop()


@contextmanager
def _guarded(guard: Guard) -> Iterator[None]:
    """Make servers that viser starts in this context ask `guard` first; viser has no option for it."""
    import websockets.asyncio.server as websockets

    plain = websockets.serve

    def serve_guarded(handler: Callable[..., Any], *place: Any, **options: Any) -> Any:
        if handler.__module__.partition(".")[0] == "viser":
            options["process_request"] = _asking(guard, options.get("process_request"))
            options["open_timeout"] = PATIENCE_S
        return plain(handler, *place, **options)

    with _STARTING, patch.object(websockets, "serve", serve_guarded):
        yield


def _asking(guard: Guard, answer: Callable[..., Any] | None) -> Callable[..., Any]:
    def ask(connection: Any, request: Any) -> Any:
        port = connection.local_address[1]
        refusal = guard.refusal(request.path, request.headers, port)
        if refusal is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, f"stereovox: {refusal}\n")
        response = None if answer is None else answer(connection, request)
        if response is not None:
            response.headers["Referrer-Policy"] = "no-referrer"  # the link has the token
            if (cookie := guard.cookie(request.path, port)) is not None:
                response.headers["Set-Cookie"] = cookie
        return response

    return ask


def _is_guarded(number: str, port: int) -> bool:
    """Return whether a stranger's request, which a guard never admits, is refused."""
    here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(number, number)
    connection = HTTPConnection(here, port, timeout=ANSWER_S)
    try:
        connection.request("GET", "/", headers={"Host": STRANGER})
        return connection.getresponse().status == HTTPStatus.FORBIDDEN
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()
