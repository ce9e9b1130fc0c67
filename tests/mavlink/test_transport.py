"""Ways to an autopilot: addresses, and connections that break."""

import os
import pty
import socket
import sys

import pytest

from stereovox import StereovoxError
from stereovox.errors import MissingExtra
from stereovox.mavlink import transport
from stereovox.mavlink.link import MavlinkLink
from stereovox.mavlink.transport import open_transport


@pytest.mark.parametrize(
    "url",
    [
        "", "udp:1.2.3.4:5", "udpout:host", "udpout::5", "tcp:host:port", "udpin:127.0.0.1:70000", "serial:115200",
        f"udpin:{'h' * 64}:5", "tcp:a..b:5", f"udpin:127.0.0.1:{'9' * 5000}",
    ],
)  # fmt: skip
def test_other_addresses_are_refused(url):
    with pytest.raises(StereovoxError, match="connection '"):
        open_transport(url)


def test_a_port_in_use_and_a_server_that_is_not_there_are_told():
    first = open_transport("udpin:127.0.0.1:0")
    with pytest.raises(StereovoxError, match="port not in use"):
        open_transport(f"udpin:127.0.0.1:{first.port}")
    with pytest.raises(StereovoxError, match="is the address right"):
        open_transport(f"tcp:127.0.0.1:{first.port}")
    first.close()
    with pytest.raises(StereovoxError, match="is the device right"):
        open_transport("serial:/dev/ttyNONE:115200")


def test_udpin_answers_whom_it_heard():
    here = open_transport("udpin:127.0.0.1:0")
    here.write(b"lost")
    there = open_transport(f"udpout:127.0.0.1:{here.port}")
    there.write(b"hello")
    assert here.read(5) == b"hello"
    here.write(b"answer")
    assert there.read(5) == b"answer"
    assert there.read(0.01) == b""
    here.close()
    there.close()


def test_bytes_go_over_a_serial_port():
    ours, theirs = pty.openpty()
    port = open_transport(f"serial:{os.ttyname(theirs)}:115200")
    port.write(b"to the autopilot\n")
    assert os.read(ours, 100).rstrip() == b"to the autopilot"
    os.write(ours, b"back\n")
    assert port.read(5).startswith(b"b")
    port.close()
    os.close(ours)
    os.close(theirs)


def test_a_tcp_connection_that_ends_is_told_once_and_made_anew(monkeypatch):
    monkeypatch.setattr(transport, "RETRY_S", 0.05)
    server = socket.create_server(("127.0.0.1", 0))
    address, told = server.getsockname(), []
    with MavlinkLink(f"tcp:127.0.0.1:{address[1]}", tell=told.append) as link:
        peer, _ = server.accept()
        peer.settimeout(30)
        assert peer.recv(100)[0] == 0xFD  # MAVLink 2
        peer.close()
        server.close()
        while not any("cannot read" in line for line in told):
            link._closed.wait(0.01)
        link._closed.wait(0.3)
        assert sum("cannot read" in line for line in told) == 1
        assert not any("works again" in line for line in told)
        server = socket.create_server(address)
        peer, _ = server.accept()
        peer.settimeout(30)
        assert peer.recv(100)[0] == 0xFD
        while not any("works again" in line for line in told):
            link._closed.wait(0.01)
        peer.close()
        server.close()


def test_rubbish_is_passed_over(start_autopilot):
    autopilot = start_autopilot()
    here = open_transport("udpin:127.0.0.1:0")
    with MavlinkLink(f"udpout:127.0.0.1:{here.port}") as link:
        data = here.read(5)
        for rubbish in (b"\xfd" * 300, os.urandom(2000), b"", data[:7], data + b"\x00" * 9):
            here.write(rubbish)
        link._closed.wait(0.2)
        assert link._thread.is_alive()
    here.close()
    assert autopilot.port


def test_without_pymavlink_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymavlink.dialects.v20", None)
    with pytest.raises(MissingExtra, match=r"stereovox\[mavlink\]"):
        MavlinkLink("udpout:127.0.0.1:14550")


def test_a_system_out_of_range_is_refused():
    with pytest.raises(StereovoxError, match="1 to 255"):
        MavlinkLink("udpout:127.0.0.1:14550", system=0)
