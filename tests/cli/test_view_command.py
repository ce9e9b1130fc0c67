# SPDX-License-Identifier: Apache-2.0
"""`stereovox view` as a user runs it: it prints the link, serves the page, and ends at Ctrl-C."""

import json
import signal
import socket
import subprocess
import sys
import urllib.error
import urllib.request

import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.maps import State


@pytest.fixture
def saved(tmp_path):
    voxel_map = sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0], [1, 0, 2]], [2.0, -1.0])
    voxel_map.save(tmp_path / "two cells.svox")
    return tmp_path / "two cells.svox"


@pytest.fixture
def start(obeys_signals):
    """Starts commands, of which none outlives the test."""
    started = []

    def run(*words):
        command = [sys.executable, "-m", "stereovox", *map(str, words)]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))
        return started[-1]

    yield run
    for one in started:
        one.kill()
        one.communicate()


def test_it_serves_until_ctrl_c(saved, start):
    running = start("view", saved, "--port", 0, "--json")
    line = running.stderr.readline()
    url = next(word for word in line.split() if word.startswith("http://127.0.0.1:"))
    with socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2]))):
        pass  # a browser that hangs up at once
    for _ in range(2):
        with urllib.request.urlopen(url, timeout=60) as page:
            assert page.status == 200
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=120)
    assert (running.returncode, err) == (0, "")
    assert json.loads(out) == {"url": url}


def test_up_is_taken_or_refused(saved, capsys, monkeypatch):
    from stereovox.viewer import viewer

    told = []
    monkeypatch.setattr(viewer.Viewer, "wait", lambda self: told.append(self.layer.across.value))
    assert main(["view", str(saved), "--port", "0", "--up=-y"]) == 0
    assert main(["view", str(saved), "--port", "0"]) == 0
    assert told == ["y", "z"]
    assert main(["view", str(saved), "--port", "0", "--up=w"]) == 2
    assert "up 'w' is no axis" in capsys.readouterr().err


def test_fewer_cells_are_drawn_where_fewer_are_wanted(tmp_path, capsys, monkeypatch):
    from stereovox.viewer import viewer

    cells = np.argwhere(np.ones((250, 60, 1)))
    sv.VoxelMap.from_cells(sv.load_config(), cells, np.full(len(cells), 2.0)).save(tmp_path / "floor.svox")
    drawn = []

    def count(page):
        drawn.append(sum(len(node.batched_positions) for node in page.cells.kinds[State.OCCUPIED].sent))

    monkeypatch.setattr(viewer.Viewer, "wait", count)
    for most in (250_000, 5000):
        assert main(["view", str(tmp_path / "floor.svox"), "--port", "0", "--most-cells", str(most)]) == 0
    assert drawn[0] == len(cells)
    assert drawn[1] < 6000
    assert main(["view", str(tmp_path / "floor.svox"), "--port", "0", "--most-cells", "0"]) == 2
    assert "0 cells at once" in capsys.readouterr().err


def status_of(link):
    try:
        with urllib.request.urlopen(link, timeout=60) as page:
            return page.status
    except urllib.error.HTTPError as error:
        return error.code


def test_a_page_for_others_needs_the_link_that_is_printed(saved, start):
    running = start("view", saved, "--port", 0, "--host", "0.0.0.0")
    assert "anyone with this link" in running.stderr.readline()
    link = next(word for word in running.stderr.readline().split() if word.startswith("http://localhost:"))
    place, token = link.split("/?token=")
    assert (status_of(link), status_of(place), status_of(f"{place}/?token={token[:-1]}")) == (200, 403, 403)
    running.send_signal(signal.SIGINT)
    out, _ = running.communicate(timeout=120)
    assert (running.returncode, out) == (0, "")


def test_a_token_may_come_from_the_environment(saved, capsys, monkeypatch):
    from stereovox.viewer import viewer

    seen = []
    monkeypatch.setattr(viewer.Viewer, "wait", lambda self: seen.append(self.url))
    monkeypatch.setenv("STEREOVOX_TOKEN", "known-to-all-of-us")
    assert main(["view", str(saved), "--port", "0"]) == 0
    assert main(["view", str(saved), "--port", "0", "--token", "only-known-to-me"]) == 0
    assert [url.partition("/?token=")[2] for url in seen] == ["known-to-all-of-us", "only-known-to-me"]
    assert main(["view", str(saved), "--port", "0", "--token", "short"]) == 2
    assert "16 to 128 letters" in capsys.readouterr().err


def test_a_taken_port_is_one_line(saved, capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        assert main(["view", str(saved), "--port", str(other.getsockname()[1])]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "this port is in use; give another one, as 8081" in captured.err


def test_a_link_for_this_machine_alone_promises_nothing_to_others(saved, capsys, monkeypatch):
    from stereovox.viewer import viewer

    monkeypatch.setattr(viewer.Viewer, "wait", lambda self: None)
    assert main(["view", str(saved), "--port", "0", "--token", "a" * 16]) == 0
    assert "anyone with this link can view the map\n" in capsys.readouterr().err


def test_a_recording_adds_a_timeline(saved, tmp_path, capsys, monkeypatch):
    from stereovox.viewer import viewer

    said = []

    def look(page):
        labels = [
            handle.label for handle in page.server.gui._container_handle_from_uuid.values() if hasattr(handle, "label")
        ]
        said.append(labels)

    monkeypatch.setattr(viewer.Viewer, "wait", look)
    assert main(["view", str(saved), "--port", "0", "--recording", "sim:room", "--frames", ":3"]) == 0
    assert main(["view", str(saved), "--port", "0"]) == 0
    assert ["Recording" in labels for labels in said] == [True, False]
    assert main(["view", str(saved), "--port", "0", "--recording", str(tmp_path / "nothing")]) == 2
    assert main(["view", str(saved), "--port", "0", "--frames", ":3"]) == 2
    assert "--frames: selects frames of --recording" in capsys.readouterr().err


def test_map_shows_the_map_while_it_grows(tmp_path, start):
    room = tmp_path / "room.svox"
    running = start("map", "sim:room", "--out", room, "--frames", ":4", "--voxel-size", "0.2", "--view", 0)
    line = running.stderr.readline()
    url = next(word for word in line.split() if word.startswith("http://127.0.0.1:"))
    while "Ctrl-C ends" not in line:
        line = running.stderr.readline()
        assert line
    assert sv.load_map(room).frames == 4
    with urllib.request.urlopen(url, timeout=60) as page:
        assert page.status == 200
    running.send_signal(signal.SIGINT)
    assert running.wait(timeout=60) == 0


def test_a_taken_port_is_told_before_a_map_is_made(tmp_path, capsys):
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        assert main(["map", "sim:room", "--out", str(tmp_path / "room.svox"), "--frames", ":2", "--view", port]) == 2
    assert "this port is in use" in capsys.readouterr().err
    assert not (tmp_path / "room.svox").exists()
