# SPDX-License-Identifier: Apache-2.0
"""Who may look at a page, asked over real sockets: pages, files and the websocket."""

import socket
import urllib.parse
from contextlib import closing

import pytest
import viser
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from stereovox import VoxelMap, load_config
from stereovox.errors import StereovoxError
from stereovox.viewer import serve
from stereovox.viewer.serve import Guard, checked_token, find_address, is_loopback, new_token, url_of
from stereovox.viewer.viewer import open_viewer

TOKEN = "0123456789abcdef-_XYZ"


def small_map():
    return VoxelMap.from_cells(load_config(), [[0, 0, 0], [1, 0, 2]], [2.0, -1.0])


@pytest.fixture(scope="module")
def shown():
    """A page on loopback with a token, as it is served to others."""
    with closing(open_viewer(small_map(), "secret kitchen", port=0, token=TOKEN)) as viewer:
        yield viewer.server.get_port()


@pytest.fixture(scope="module")
def here():
    """A page as it is served by default."""
    with closing(open_viewer(small_map(), "secret kitchen", port=0)) as viewer:
        yield viewer.server.get_port()


def asked(port, path="/", *headers, host=None):
    """Return status, headers and body of what a plain request gets."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host or f'127.0.0.1:{port}'}", *headers, "", ""]
    with socket.create_connection(("127.0.0.1", port), timeout=60) as client:
        client.sendall("\r\n".join(lines).encode())
        with client.makefile("rb") as reply:
            head, _, body = reply.read().partition(b"\r\n\r\n")
    first, *others = head.decode().split("\r\n")
    return int(first.split()[1]), dict(line.lower().split(": ", 1) for line in others), body


def first_message(port, path="/", host="127.0.0.1", **headers):
    """Return what the websocket says first, as viser's page would ask; raises InvalidStatus for a refusal."""
    extra = {name.replace("_", "-"): value for name, value in headers.items()}
    protocol = f"viser-v{viser.__version__}"
    with connect(f"ws://{host}:{port}{path}", additional_headers=extra, subprotocols=[protocol]) as page:
        return page.recv(timeout=60)


def refused(port, *args, **headers):
    with pytest.raises(InvalidStatus) as caught:
        first_message(port, *args, **headers)
    return caught.value.response.status_code


def test_without_the_token_nothing_is_shown(shown):
    for path in (
        "/",
        "/index.html",
        "/?token=",
        "/?token=0123456789abcdef-_XY",
        "/?token=x&tokem=" + TOKEN,
        "/%3Ftoken",
    ):
        status, headers, body = asked(shown, path)
        assert status == 403
        assert "set-cookie" not in headers
        assert b"secret kitchen" not in body
        assert len(body) < 200
    assert asked(shown, "/", "Cookie: stereovox_1=" + TOKEN)[0] == 403
    assert asked(shown, "/", f"Cookie: stereovox_{shown}=nearly")[0] == 403
    assert asked(shown, "/", "Cookie: =;;a b=[]; $x")[0] == 403
    assert refused(shown) == refused(shown, "/?token=wrong") == 403


def test_the_link_lets_a_browser_in_and_it_stays_in(shown):
    status, headers, body = asked(shown, f"/?token={TOKEN}")
    assert (status, b"<html" in body.lower()) == (200, True)
    cookie, *rules = headers["set-cookie"].split("; ")
    assert {"httponly", "samesite=strict", "path=/"} == set(rules)
    assert headers["referrer-policy"] == "no-referrer"
    cookie = f"stereovox_{shown}={TOKEN}"
    status, headers, _ = asked(shown, "/", f"Cookie: theme=dark; {cookie}")
    assert (status, "set-cookie" in headers) == (200, False)
    assert len(first_message(shown, Cookie=cookie)) > 100
    assert len(first_message(shown, f"/?token={TOKEN}")) > 100
    assert len(first_message(shown, Cookie=cookie, Origin=f"http://127.0.0.1:{shown}")) > 100


def test_a_page_from_elsewhere_is_refused_even_with_the_cookie(shown, here):
    cookie = f"stereovox_{shown}={TOKEN}"
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1", "http://[", f"http://localhost:{shown}"):
        assert refused(shown, Cookie=cookie, Origin=origin) == 403
        assert refused(here, Origin=origin) == 403


def test_by_default_only_this_machine_is_served_and_by_its_own_name(here):
    with socket.socket() as other, pytest.raises(OSError, match="refused"):
        other.connect(("127.0.0.2", here))  # it listens on 127.0.0.1 alone
    assert asked(here)[0] == 200
    assert asked(here, host="LOCALHOST:9")[0] == 200  # a tunnel's port
    assert asked(here, host="[::1]")[0] == 200
    for name in (
        "evil.example",
        f"evil.example:{here}",
        "localhost.evil.example",
        "192.0.2.7",
        "[",
        "a@127.0.0.1@b",
        "",
    ):
        assert asked(here, host=name or " ")[0] == 403
    assert asked(here, "/", "Host: localhost")[0] == 403  # two of them
    assert len(first_message(here, Origin=f"http://127.0.0.1:{here}")) > 100
    assert len(first_message(here, "/", "localhost", Origin=f"http://localhost:{here}")) > 100


def test_who_says_nothing_or_too_much_is_hung_up_on(monkeypatch):
    monkeypatch.setattr(serve, "PATIENCE_S", 2.0)
    with closing(open_viewer(small_map(), port=0)) as viewer:
        place = "127.0.0.1", viewer.server.get_port()
        with socket.create_connection(place, timeout=60) as slow:
            slow.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\nX-Slow")
            assert b"<html" not in slow.makefile("rb").read()
        with socket.create_connection(place, timeout=60) as long:
            long.sendall(b"GET / HTTP/1.1\r\nX-Long: " + b"a" * 20_000)
            assert b"200" not in long.makefile("rb").read().partition(b"\r\n")[0]


def test_a_viser_that_asks_nobody_is_not_served(monkeypatch):
    monkeypatch.setattr(serve, "_asking", lambda guard, answer: answer)
    with pytest.raises(StereovoxError, match="would show the map to anyone"):
        open_viewer(small_map(), port=0)


def test_other_servers_of_the_program_are_left_alone(here):
    import websockets.asyncio.server

    assert websockets.asyncio.server.serve.__module__ == "websockets.asyncio.server"


@pytest.mark.parametrize("host", ["0.0.0.0", "0"])
def test_a_page_for_others_gets_a_token_of_its_own(host):
    links = []
    for _ in range(2):
        with closing(open_viewer(small_map(), host=host, port=0)) as viewer:
            links.append(urllib.parse.urlsplit(viewer.url))
            assert asked(links[-1].port)[0] == 403
            assert asked(links[-1].port, f"/?{links[-1].query}")[0] == 200
            assert asked(links[-1].port, f"/?{links[-1].query}", host="a-name-of-mine")[0] == 200
    assert links[0].query != links[1].query
    assert len(links[0].query) > len("token=") + 30


def test_a_token_that_can_be_guessed_or_does_not_fit_is_refused():
    assert checked_token(TOKEN) == TOKEN
    assert checked_token(new_token())
    for token in (
        "",
        "short",
        "a" * 15,
        "a" * 129,
        "with spaces in it",
        "semicolon;semicolon",
        "a" * 16 + "\n",
        "ü" * 16,
    ):
        with pytest.raises(StereovoxError, match="16 to 128 letters"):
            open_viewer(small_map(), port=0, token=token)


def test_addresses():
    assert url_of("127.0.0.1", 8080) == "http://127.0.0.1:8080"
    assert url_of("0.0.0.0", 1, "t") == "http://localhost:1/?token=t"
    assert url_of("::1", 1) == "http://[::1]:1"
    private = {"127.0.0.1": True, "localhost": True, "127.1": True, "0x7f.1": True, "0.0.0.0": False, "0": False}
    assert {host: find_address(host, 0).is_private for host in private} == private
    assert [is_loopback(name) for name in ("::1", "127.9.9.9", "localhost", "evil.example", "::", "10.0.0.1")] == [
        True, True, False, False, False, False,
    ]  # fmt: skip


def test_a_name_that_leads_elsewhere_is_not_this_machine(monkeypatch):
    """Whatever a name says at another time, the address that was looked at is the one that is used."""
    answers = [[(socket.AF_INET, socket.SOCK_STREAM, 0, "", ("0.0.0.0", 0))]]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: answers.pop())
    address = find_address("localhost", 0)
    assert (address.number, address.is_private) == ("0.0.0.0", False)


def test_the_guard_compares_whole_tokens():
    class Headers:
        def get_all(self, key):
            return {"Host": ["box:1"]}.get(key, [])

    guard = Guard("box", TOKEN)
    assert guard.refusal(f"/?token={TOKEN}", Headers(), 1) is None
    for path in (
        "/",
        f"/?token={TOKEN}x",
        f"/?Token={TOKEN}",
        f"/{TOKEN}",
        f"/?token={TOKEN.upper()}",
        "/?token=%ff%00",
    ):
        assert guard.refusal(path, Headers(), 1)
        assert guard.cookie(path, 1) is None
