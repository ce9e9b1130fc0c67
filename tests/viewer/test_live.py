# SPDX-License-Identifier: Apache-2.0
"""A page next to a map in the making: whatever becomes of the page or its lookers, the mapping goes on."""

import socket
import struct
import threading
import time
import urllib.request
from contextlib import closing

import made_along as made
import numpy as np
import pytest

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.viewer import live as viewer_live
from stereovox.viewer.live import LiveView

pytest.importorskip("viser")
SOURCE = made.Along()
PATIENCE_S = 30


@pytest.fixture(autouse=True)
def no_rest(monkeypatch):
    """Show every frame that can be shown."""
    for name in ("MIN_S", "COPY_REST", "DRAW_REST"):
        monkeypatch.setattr(viewer_live, name, 0)


def new_mapper():
    return sv.Mapper(voxel_size=0.1, max_range=4.0)


def same_as_alone(mapper, number):
    alone = new_mapper()
    for i in range(number):
        alone.add(SOURCE.frame(i))
    return all(
        np.array_equal(one, other)
        for one, other in zip(mapper.map.storage.blocks(), alone.map.storage.blocks(), strict=True)
    )


def wait_for(condition):
    until = time.monotonic() + PATIENCE_S
    while not condition() and time.monotonic() < until:
        time.sleep(0.01)
    return condition()


def shows(live, mapper):
    cells = np.rint(mapper.map.occupied() / 0.1 - 0.5).astype(int)
    return sorted(map(tuple, live.viewer.cells.solid.tolist())) == sorted(map(tuple, cells.tolist()))


@pytest.mark.filterwarnings("ignore")
def test_a_picture_that_cannot_be_drawn_ends_neither_mapping_nor_page(monkeypatch):
    mapper = new_mapper()
    with LiveView(mapper, port=0) as live:
        update, broken = live.viewer.update, []

        def break_twice(voxel_map):
            if len(broken) < 2:
                broken.append(voxel_map)
                raise RuntimeError("drawing broke")
            update(voxel_map)

        monkeypatch.setattr(live.viewer, "update", break_twice)
        for i in range(6):
            live.add(SOURCE.frame(i))
            assert live._free.wait(PATIENCE_S)
        live.finish()
        assert wait_for(lambda: shows(live, mapper))
    assert len(broken) == 2
    assert same_as_alone(mapper, 6)


def test_what_could_not_be_drawn_is_reported():
    live = LiveView(new_mapper(), port=0)
    live.viewer.update = None

    def add_and_wait():
        live.add(SOURCE.frame(0))
        assert live._free.wait(PATIENCE_S)

    with closing(live), pytest.warns(UserWarning, match=r"the live view could not be drawn \(TypeError"):
        add_and_wait()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("end", [lambda live: live.close(), lambda live: live.viewer.close()], ids=["view", "page"])
def test_a_page_that_was_taken_down_keeps_no_frame_waiting(end, monkeypatch):
    monkeypatch.setattr(viewer_live, "PATIENCE_S", 1e6)  # whoever waits for it waits for ever
    mapper = new_mapper()
    live = LiveView(mapper, port=0)
    for i in range(6):
        if i == 2:
            end(live)
        live.add(SOURCE.frame(i))
    finishing = threading.Thread(target=live.finish, daemon=True)
    finishing.start()
    finishing.join(PATIENCE_S)
    assert not finishing.is_alive()
    live.close()
    assert same_as_alone(mapper, 6)


def test_lookers_that_vanish_are_nobodys_trouble():
    """Browsers that are killed: connections that end in the middle of anything."""
    mapper = new_mapper()
    with LiveView(mapper, port=0) as live:
        port = live.viewer.server.get_port()
        upgrade = (
            f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            f"Origin: http://127.0.0.1:{port}\r\nSec-WebSocket-Version: 13\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Protocol: viser-v1\r\n\r\n"
        ).encode()
        for i in range(6):
            with socket.create_connection(("127.0.0.1", port)) as looker:
                looker.sendall(upgrade[: (len(upgrade) * (i + 1)) // 6])
                looker.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closed by a reset
                live.add(SOURCE.frame(i))
        live.finish()
        assert wait_for(lambda: shows(live, mapper))
        with urllib.request.urlopen(live.url, timeout=PATIENCE_S) as page:
            assert page.status == 200
    assert same_as_alone(mapper, 6)


def test_a_taken_port_leaves_no_thread_and_the_mapper_as_it_was():
    mapper = new_mapper()
    before = set(threading.enumerate())
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(StereovoxError, match="this port is in use"):
        LiveView(mapper, port=other.getsockname()[1])
    assert not {thread.name for thread in set(threading.enumerate()) - before} & {"stereovox-live-view"}
    assert mapper.add(SOURCE.frame(0)).refused is None
