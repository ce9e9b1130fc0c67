# SPDX-License-Identifier: Apache-2.0
"""What is left of a map when a save fails or is killed at any of its steps, and who may write a map."""

import errno
import os
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from full_disks import full_disk
from made_faults import disk, in_child, small_map

from stereovox.config import load_config
from stereovox.errors import MapFileError
from stereovox.files.safe_io import replacing
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.maps import load_map, make_map
from stereovox.maps.files import store
from stereovox.maps.files.lock import only_store_in, only_writer_in, only_writer_of
from stereovox.maps.grid_map import GridMap, load_grid
from stereovox.maps.occupancy import OccupancyGrid

HOLDER = """
import sys
from pathlib import Path
from stereovox.maps.files import lock
with getattr(lock, sys.argv[1])(Path(sys.argv[2])):
    print("held", flush=True)
    sys.stdin.readline()
"""


def no_room():
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def steps_of(action, folder):
    with disk(folder) as counted:
        action()
    return counted.steps


@pytest.mark.parametrize("ever", [False, True], ids=["one", "all from then on"])
def test_a_save_that_fails_at_any_step_leaves_a_whole_map(tmp_path, ever):
    folder, before, after = tmp_path / "m", small_map(1), small_map(2)
    before.save(folder)
    whole = names(folder)
    steps = steps_of(lambda: after.save(folder), tmp_path)
    assert steps > 30
    for step in range(1, steps + 1):
        before.save(folder)
        assert len(names(folder)) == len(whole) == 2
        failed = None
        with disk(tmp_path, no_room, step, ever):
            try:
                after.save(folder)
            except MapFileError as error:
                failed = str(error)
        found = load_map(folder)
        assert found.frames == len(found.cells()[0])
        if failed is None:  # only what is no longer needed could not be removed
            assert found.frames == 2
        else:
            assert found.frames == 1 or step > steps - 10, step
            assert "No space left" in failed
            assert "\n" not in failed
        if failed and found.frames == 2:  # until the disk has the new manifest, the old one may come back
            assert len(names(folder)) >= 3, step
        if failed and not ever and found.frames == 1:
            assert len(names(folder)) == 2, step  # what the save had written is gone


def test_a_first_save_that_fails_at_any_step_leaves_nothing_that_looks_like_a_map(tmp_path):
    folder = tmp_path / "new" / "m"
    steps = steps_of(lambda: small_map(1).save(folder), tmp_path)
    store.remove_map(folder)
    folder.rmdir()
    folder.parent.rmdir()
    for step in range(1, steps + 1):
        with disk(tmp_path, no_room, step):
            try:
                small_map(1).save(folder)
            except MapFileError:
                assert store.is_map(folder) or names(tmp_path) == [], step
        if store.is_map(folder):
            assert load_map(folder).frames == 1
            store.remove_map(folder)
            folder.rmdir()
            folder.parent.rmdir()


def test_a_save_that_is_killed_at_any_step_leaves_a_whole_map(tmp_path):
    script = Path(__file__).parents[2] / "helpers/made_faults.py"
    words = [sys.executable, script, tmp_path / "m", "6"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) > 30


def test_data_is_on_the_disk_before_the_manifest_names_it(tmp_path, monkeypatch):
    events = []
    fsync, rename = os.fsync, Path.replace

    def note_sync(number):
        events.append(os.readlink(f"/proc/self/fd/{number}"))
        fsync(number)

    def note_rename(path, target):
        events.append(f"rename {Path(target).name}")
        return rename(path, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_rename)
    small_map(2).save(tmp_path / "m")
    at = events.index("rename manifest.json")
    data = next(iter((tmp_path / "m").glob("cells-*")))
    written = [str(path) for path in (data, *data.rglob("*"))]
    assert set(written) <= set(events[:at])
    assert str(tmp_path / "m" / ".manifest.json.new") in events[:at]
    assert str(tmp_path / "m") in events[:at]
    assert str(tmp_path) in events[:at]  # the name of the new folder itself
    assert events[at + 1] == str(tmp_path / "m")


@pytest.mark.parametrize("room", [0, 100, 500, 2000])
def test_files_that_may_not_grow_leave_the_older_map(tmp_path, room):
    small_map(1).save(tmp_path / "m")
    whole = names(tmp_path / "m")
    with full_disk(room), pytest.raises(MapFileError, match="File too large"):
        small_map(2).save(tmp_path / "m")
    assert names(tmp_path / "m") == whole
    assert load_map(tmp_path / "m").frames == 1


def test_a_damaged_map_is_not_swept_away(tmp_path, monkeypatch):
    small_map(1).save(tmp_path / "m")
    (tmp_path / "m" / "manifest.json").write_text("{")
    cells = next((tmp_path / "m").glob("cells-*"))
    monkeypatch.setattr(store, "_manifest", lambda *_: no_room())
    with pytest.raises(MapFileError, match="No space left"):
        small_map(2).save(tmp_path / "m")
    assert cells.is_dir()


def test_a_reader_that_is_overtaken_by_a_save_reads_the_newer_map(tmp_path, monkeypatch):
    small_map(1).save(tmp_path / "m")
    read = store.read_manifest

    def read_and_be_overtaken(folder):
        monkeypatch.setattr(store, "read_manifest", read)
        manifest = read(folder)
        small_map(2).save(folder)
        return manifest

    monkeypatch.setattr(store, "read_manifest", read_and_be_overtaken)
    assert load_map(tmp_path / "m").frames == 2


def held_elsewhere(kind, path):
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, kind, path], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b"held\n"
    return process


def save_map(path):
    small_map(1).save(path)


def save_grid(path):
    GridMap(load_config(dimensions=2)).save(path)


def keep_tiles(path):
    make_map(load_config(voxel_size=0.1, window={"size": [4, 4, 4], "outside": "keep"}), tiles=path).close()


@pytest.mark.parametrize(
    ("kind", "write"),
    [("only_writer_in", save_map), ("only_writer_of", save_grid), ("only_store_in", keep_tiles)],
)
def test_of_two_processes_the_second_is_refused_until_the_first_is_dead(tmp_path, kind, write):
    path = tmp_path / "target"
    first = held_elsewhere(kind, path)
    with pytest.raises(MapFileError, match="is being written by another run") as caught:
        write(path)
    assert "\n" not in str(caught.value)
    first.kill()
    first.wait()
    write(path)
    assert ".lock" not in "".join(names(tmp_path) + (names(path) if path.is_dir() else []))
    first.stdin.close()
    first.stdout.close()


def test_a_map_that_is_written_can_be_read_and_saved_by_its_writer(tmp_path):
    with only_writer_in(tmp_path / "m"):
        small_map(3).save(tmp_path / "m")
        small_map(4).save(os.path.relpath(tmp_path / "m"))  # by any name
        assert load_map(tmp_path / "m").frames == 4
        refused = []

        def other():
            try:
                small_map(5).save(tmp_path / "m")
            except MapFileError as error:
                refused.append(str(error))

        thread = threading.Thread(target=other)
        thread.start()
        thread.join()
        assert "is being written by another run" in refused[0]
    assert len(names(tmp_path / "m")) == 2
    small_map(5).save(tmp_path / "m")


def test_a_folder_that_vanished_is_told_and_stays_away(tmp_path):
    with only_writer_in(tmp_path / "m"):
        (tmp_path / "m").rename(tmp_path / "elsewhere")
        with pytest.raises(MapFileError, match="removed or moved"):
            small_map(1).save(tmp_path / "m")
    assert names(tmp_path) == ["elsewhere"]


def test_locks_make_no_folder_and_tiles_are_never_shared(tmp_path):
    with pytest.raises(MapFileError, match="No such file"), only_writer_of(tmp_path / "no" / "floor.yaml"):
        pass
    assert names(tmp_path) == []
    with only_store_in(tmp_path / "t"), pytest.raises(MapFileError, match="being written"):
        keep_tiles(tmp_path / "t")
    assert names(tmp_path) == []


def test_no_room_for_a_tile_loses_no_cell(tmp_path):
    config = load_config(voxel_size=0.1, window={"size": [3.2, 3.2, 3.2], "outside": "keep", "trigger": 0.4})
    rolling = make_map(config, small_map(60), tmp_path / "tiles")
    wanted = small_map(60).cells()
    with disk(tmp_path, no_room, 1, ever=True):
        told = []
        for x in (0.0, 10.0, 20.0, 30.0, 40.0):
            try:
                rolling.storage.set_viewpoint(at(x))
            except MapFileError as error:
                told.append(str(error))
            rolling.storage.tile_store._writer.submit(lambda: None).result()  # all that waited was tried
    assert len(told) == 4  # all but the first, which put them there
    assert "a tile cannot be written (No space left" in told[0]
    assert rolling.viewpoint.T_world_camera[0, 3] == 0.0
    rolling.save(tmp_path / "m")
    for got, expected in zip(load_map(tmp_path / "m").cells(), wanted, strict=True):
        np.testing.assert_array_equal(got, expected)
    rolling.close()
    assert names(tmp_path) == ["m"]


@pytest.mark.parametrize("again", [True, False], ids=["times", "none"])
def test_what_a_killed_run_left_of_its_tiles_goes_with_the_next(tmp_path, again):
    window = {"size": [3.2, 3.2, 3.2], "outside": "keep"}
    config = load_config(voxel_size=0.1, window=window, map={"keep_times": True})

    def killed_run():
        rolling = make_map(config, tiles=tmp_path / "tiles")
        rolling.storage.set_viewpoint(at(0.0))
        rolling.storage.insert(*small_map(9).storage.blocks())
        coords = small_map(9).storage.blocks()[0]
        rolling.storage.set_times(coords, np.full((len(coords), 512), 1 << 30, np.uint32), 0)
        rolling.storage.set_viewpoint(at(10.0))
        for tiles in (rolling.storage._store, rolling.storage._times_store):
            tiles._writer.submit(lambda: None).result()
        os.kill(os.getpid(), signal.SIGKILL)

    assert in_child(killed_run) == signal.SIGKILL
    assert len(list(tmp_path.rglob(".lock"))) == 2
    assert len(list(tmp_path.rglob("c/*/*/*"))) >= 2
    config = load_config(config, **{"map.keep_times": again})
    rolling = make_map(config, tiles=tmp_path / "tiles")
    assert not list(tmp_path.rglob("c/*/*/*"))
    with pytest.raises(MapFileError, match="being written"):
        make_map(config, tiles=tmp_path / "tiles")
    rolling.close()
    assert names(tmp_path) == []


@pytest.mark.parametrize("stopped", ["_store", "_times_store"])
def test_what_cannot_be_written_of_a_tile_ends_the_run(tmp_path, monkeypatch, stopped):
    config = load_config(voxel_size=0.1, window={"size": [3.2, 3.2, 3.2], "outside": "keep"}, map={"keep_times": True})
    rolling = make_map(config, tiles=tmp_path / "tiles")
    rolling.storage.set_viewpoint(at(0.0))
    coords, cells = small_map(3).storage.blocks()
    rolling.storage.insert(coords - np.array([2, 0, 0], np.int32), cells)  # in two tiles
    monkeypatch.setattr(getattr(rolling.storage, stopped), "_write", lambda *_: no_room())
    monkeypatch.setattr("stereovox.maps.storage.tiles.WAITING", 1)  # nobody waits for what cannot be written
    rolling.storage.set_viewpoint(at(10.0))
    for tiles in (rolling.storage._store, rolling.storage._times_store):
        tiles._writer.submit(lambda: None).result()
    with pytest.raises(MapFileError, match="a tile cannot be written"):
        rolling.storage.set_viewpoint(at(20.0))
    rolling.close()
    assert names(tmp_path) == []


def at(x):
    from stereovox.cameras.pinhole import PinholeCamera
    from stereovox.frame import Viewpoint

    T = np.eye(4)
    T[0, 3] = x
    return Viewpoint(PinholeCamera.from_field_of_view(64, 48, 90), T, 0)


def test_a_file_is_replaced_whole_or_not_at_all(tmp_path):
    path = tmp_path / "f.ply"

    def write(text):
        with replacing(path) as file:
            file.write(text)

    write(b"old")
    steps = steps_of(lambda: write(b"new"), tmp_path)
    for step in range(1, steps + 1):
        write(b"old")
        failed = ""
        with disk(tmp_path, no_room, step):
            try:
                write(b"new")
            except MapFileError as error:
                failed = str(error)
        done = step > steps - 2  # in its place; does the disk know, and is the temporary file gone?
        assert path.read_bytes() == (b"new" if done else b"old")
        assert "f.ply: cannot be written (No space" in failed or step == steps
        assert names(tmp_path) == ["f.ply"]
    with pytest.raises(MapFileError, match="not a plain file"), replacing("/dev/null"):
        pass


class Killed(BaseException):
    pass


def killed():
    raise Killed


def test_a_floor_map_that_is_killed_at_any_step_opens_and_is_the_older_or_the_newer(tmp_path):
    older = OccupancyGrid(np.full((3, 3), 100, np.int8), 0.05, (1.0, 2.0, 0.0))
    newer = OccupancyGrid(np.full((5, 4), 0, np.int8), 0.05, (-3.0, 0.0, 0.0))
    path = tmp_path / "floor.yaml"
    write_map_server(older, path)
    steps = steps_of(lambda: write_map_server(newer, path), tmp_path)
    found = []
    for step in range(1, steps + 1):
        write_map_server(older, path)
        with disk(tmp_path, killed, step, ever=True), pytest.raises(Killed):  # nothing is tidied up after it
            write_map_server(newer, path)
        read = read_map_server(path)
        assert any(read.origin == one.origin and np.array_equal(read.cells, one.cells) for one in (older, newer)), step
        found.append(read.origin == newer.origin)
    assert found == sorted(found)
    assert found[0] < found[-1]
    write_map_server(newer, path)
    assert [name for name in names(tmp_path) if not name.endswith(".new")] == ["floor.pgm", "floor.yaml"]


def test_a_grid_is_saved_whole_or_not_at_all(tmp_path):
    path, config = tmp_path / "floor.npz", load_config(dimensions=2)
    before, after = GridMap(config), GridMap(config)
    after.frames = 2
    before.save(path)
    for step in range(1, steps_of(lambda: after.save(path), tmp_path) + 1):
        before.save(path)
        with disk(tmp_path, no_room, step), suppress(MapFileError):
            after.save(path)
        assert load_grid(path).frames in (0, 2)
        assert [name for name in names(tmp_path) if not name.endswith(".lock")] == ["floor.npz"]


def test_what_a_dead_writer_left_of_a_file_goes_and_nothing_else(tmp_path):
    long = tmp_path / ("x" * 245 + ".yaml")
    mine = [".floor.yaml.0123456789ab.new", ".floor.pgm.ba9876543210.new", f".{'x' * 200}.0123456789ab.new"]
    others = [".floor.yaml.0123456789ab.new.bag", ".floor2.yaml.0123456789ab.new", ".0123456789ab.new", "floor.new"]
    for name in mine + others:
        (tmp_path / name).touch()
    with only_writer_of(tmp_path / "floor.yaml", tmp_path / "floor.pgm", long), replacing(long) as file:
        file.write(b"whole")
    assert names(tmp_path) == sorted([*others, long.name])
