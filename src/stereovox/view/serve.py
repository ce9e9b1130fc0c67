# SPDX-License-Identifier: Apache-2.0
"""A viser server that asks a guard before it answers anything."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from http import HTTPStatus
from http.client import HTTPConnection, HTTPException
from threading import Lock
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

from stereovox.errors import MissingExtra, StereovoxError
from stereovox.view.address import Address
from stereovox.view.guard import Guard

if TYPE_CHECKING:
    from viser import ViserServer

PATIENCE_S = 5.0
"""Seconds in which a browser must have said what it wants."""
ANSWER_S = 60.0
"""Seconds in which the server must have refused a stranger, however busy the machine is."""
STRANGER = "stranger.invalid"
_STARTING = Lock()


def serve(name: str, address: Address, guard: Guard) -> ViserServer:
    """Start a server whose every page, file and websocket is behind `guard`.

    Raises MissingExtra without viser, StereovoxError where the port was taken meanwhile and where this viser does not
    ask the guard.
    """
    try:
        import viser
    except ImportError:
        raise MissingExtra("viser", "viewer") from None
    with redirect_stdout(io.StringIO()), _guarded(guard):  # viser introduces itself there
        server = viser.ViserServer(host=address.number, port=address.port, label=name, verbose=False)
    port = server.get_port()
    if address.port and port != address.port:
        stop(server)
        raise StereovoxError(f"{address.host}:{address.port}: this port is in use; give another one (--port {port})")
    if not _is_guarded(address.number, port):
        stop(server)
        raise StereovoxError(f"viser {viser.__version__} would show the map to anyone; install viser 1.1")
    return server


def stop(server: ViserServer) -> None:
    """Take the server down."""
    with redirect_stdout(io.StringIO()):  # viser says goodbye there
        server.stop()


@contextmanager
def _guarded(guard: Guard) -> Iterator[None]:
    """While this is open, servers that viser starts ask `guard` first: viser has no way to tell it so."""
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
            response.headers["Referrer-Policy"] = "no-referrer"  # the link holds the token
            if (cookie := guard.cookie(request.path, port)) is not None:
                response.headers["Set-Cookie"] = cookie
        return response

    return ask


def _is_guarded(number: str, port: int) -> bool:
    """Ask as a stranger, whom a guard never lets in."""
    here = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(number, number)
    connection = HTTPConnection(here, port, timeout=ANSWER_S)
    try:
        connection.request("GET", "/", headers={"Host": STRANGER})
        return connection.getresponse().status == HTTPStatus.FORBIDDEN
    except (OSError, HTTPException):
        return False
    finally:
        connection.close()
