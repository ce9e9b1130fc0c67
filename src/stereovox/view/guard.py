# SPDX-License-Identifier: Apache-2.0
"""Who may look at a page: asked by the server before each request, the websocket's too."""

from __future__ import annotations

import re
import secrets
from collections.abc import Iterable, Iterator
from http.cookies import CookieError, SimpleCookie
from typing import Protocol
from urllib.parse import parse_qs, urlsplit

from stereovox.errors import StereovoxError
from stereovox.view.address import is_loopback

TOKEN = re.compile(r"[A-Za-z0-9_-]{16,128}")
"""What fits into a link and a cookie as it is, and cannot be guessed."""


class Headers(Protocol):
    """Headers of a request."""

    def get_all(self, key: str) -> list[str]:
        """Return all headers of a name, whatever its case."""
        ...


def new_token() -> str:
    """Return a token that nobody can guess."""
    return secrets.token_urlsafe(24)


def checked_token(token: str) -> str:
    """Return a token that a user chose; raises StereovoxError for one that is short or does not fit into a link."""
    if not TOKEN.fullmatch(token):
        raise StereovoxError(
            f"a token of {len(token)} characters: give 16 to 128 letters, digits, - or _, or none and one is made"
        )
    return token


class Guard:
    """Lets in who knows the token; without one, whoever sits at this machine.

    host: the name or address that is served. A browser is believed only when the page that asks came from here: else
    any page on the web could read the map through the browser that shows it, or by a name of its own that leads to
    this machine (DNS rebinding).
    """

    def __init__(self, host: str, token: str | None):
        self._host, self._token = host.lower(), token

    def refusal(self, path: str, headers: Headers, port: int) -> str | None:
        """Return in a line why a request is refused, None where it may pass. path: with its query."""
        named, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(named) != 1:
            return "one Host header is needed"
        if any(_place(origin) != named[0].lower() for origin in origins):
            return "the page that asks came from elsewhere"
        if self._token is None:
            return None if self._is_here(named[0]) else "this machine has no such name"
        offered = [*_in_link(path), *_in_cookies(headers.get_all("Cookie"), _cookie_name(port))]
        if any(self._is_token(one) for one in offered):
            return None
        return "open the link that stereovox printed: it holds the token"

    def cookie(self, path: str, port: int) -> str | None:
        """Return the header that lets a browser in from now on, for requests whose link holds the token.

        Neither scripts nor other sites ever see it.
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
    """Return name and port of an origin; nothing for what is none."""
    try:
        return urlsplit(origin).netloc.lower()
    except ValueError:
        return ""


def _name(host: str) -> str:
    """Return the name in a Host header, without its port; nothing for what is none."""
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
    """Return a name of its own for each port: browsers show cookies to all ports of a machine."""
    return f"stereovox_{port}"
