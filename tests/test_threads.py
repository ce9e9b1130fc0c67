# SPDX-License-Identifier: Apache-2.0
"""Several threads at one map: every call holds its lock, copies have locks of their own, nothing waits for ever."""

import copy
import inspect
import pickle
import subprocess
import sys
import threading
from contextlib import nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest
from made_threads import CAMERA, MOVING, frames_of, scans_of

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox.formats import bags, meshes, octomap, points, rerun
from stereovox.frame import Viewpoint
from stereovox.kernels.threads import MapLock, one_state
from stereovox.mapper import GridMapper
from stereovox.maps import make_map
from stereovox.maps.cells import cell_pool
from stereovox.maps.cells.evidence import Evidence, GridEvidence
from stereovox.maps.occupancy import Percent
from stereovox.maps.record.history import WithHistory
from stereovox.maps.storage import cubes
from stereovox.maps.storage.storage import OnStorage, Storage
from stereovox.maps.voxel_map import OnBlocks
from stereovox.products import difference, edit, floor_axes, frontiers, ground, moved, path_check, projection
from stereovox.products.projection import LiveProjection

NO_EVIDENCE = Evidence(np.empty((0, 3), np.int32), np.empty((0, 512), np.int16), np.empty((0, 3), np.int32), 0)
NO_SCAN = GridEvidence(np.empty((0, 3), np.int32), np.empty((0, 4096), np.int16))
NO_BLOCKS = np.empty((0, 3), np.int32)
PLACE = [[0.1, 0.2, 0.3]]


class CountingLock(MapLock):
    """Counts how often it was taken by a thread that did not hold it."""

    def __init__(self):
        self.depth = self.times = 0

    def __enter__(self):
        super().__enter__()
        self.times += self.depth == 0
        self.depth += 1
        return True

    def __exit__(self, *why):
        self.depth -= 1
        return super().__exit__(*why)


def mapped(**settings):
    mapper = sv.Mapper(voxel_size=0.2, **{"map.keep_times": True, **MOVING, **settings})
    for frame in frames_of(0, 4):
        mapper.add(frame)
    return mapper


def taken(lock):
    """Tell whether another thread would have to wait for a lock."""
    found = []

    def attempt():
        found.append(not lock.acquire(blocking=False))
        if not found[0]:
            lock.release()

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return found[0]


def test_threads_that_add_ask_and_save_meet_the_map_between_two_frames():
    """Crashes and endless waits are failures, too: all happens in a process of its own."""
    script = Path(__file__).with_name("helpers") / "made_threads.py"
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


SPACE = {
    "add": (NO_EVIDENCE,),
    "age": (PLACE,),
    "replace_contents": "another",
    "blocks_within": ((0, 0, 0), (1, 1, 1)),
    "cast_rays": (PLACE, PLACE, 1.0),
    "cells_in": (sv.State.FREE,),
    "cells_of": (NO_BLOCKS,),
    "cells_within": ((0, 0, 0), (1, 1, 1)),
    "slabs_within": ((0, 0, 0), (1, 1, 1)),
    "centers": ([[0, 0, 0]],),
    "check_boxes": (PLACE, PLACE),
    "check_capsules": (PLACE, PLACE, 0.1),
    "check_cells": "config",
    "agreement": (NO_EVIDENCE, 1),
    "check_room": (NO_EVIDENCE,),
    "go_on_with": "storage",
    "insert": (NO_BLOCKS, np.empty((0, 512), np.int16)),
    "log_odds": (PLACE,),
    "replace_blocks": "unknown",
    "set_viewpoint": (Viewpoint(CAMERA, np.eye(4), 0),),
    "nearest_obstacle": (PLACE, 1.0),
    "probability": (PLACE,),
    "save": "path",
    "set_times": (NO_BLOCKS, np.empty((0, 512), np.uint32), None),
    "state": (PLACE,),
    "take_history": "storage",
    "times_at": (np.array(PLACE),),
    "times_of": (NO_BLOCKS,),
    "stored_at": (np.array(PLACE),),
    "seconds_ago": (np.zeros(1, np.uint32), 0),
    "continue_with": "config",
    "fill": "blocks",
}
FLOOR = {
    "add": (NO_SCAN,),
    "agreement": (NO_SCAN, 1),
    "seen_at": (np.zeros((1, 2), np.int64), 1),
    "cast": (np.zeros((1, 4)),),
    "surfaces": (0, 0, 2, 2),
    "check_room": (NO_SCAN,),
    "insert": (NO_BLOCKS, np.empty((0, 4096), np.int16)),
    "log_odds": ([[0.1, 0.2]],),
    "probability": ([[0.1, 0.2]],),
    "save": "path",
    "state": ([[0.1, 0.2]],),
    "stored_at": (np.zeros((1, 2), np.int64),),
    "paint": "picture",
    "continue_with": "config",
}
WINDOW = {"window.size": [4, 4, 3], "window.outside": "keep"}


@pytest.mark.parametrize("kind", ["plain", "capped", "window", "floor"])
def test_every_call_holds_the_lock_once(kind, tmp_path):
    settings = {"plain": {}, "capped": {"max_memory": "16M"}, "window": WINDOW, "floor": {}}[kind]
    mapper = GridMapper(voxel_size=0.1) if kind == "floor" else mapped(**settings)
    given = FLOOR if kind == "floor" else SPACE
    one = mapper.map
    one.lock = one.storage.lock = lock = CountingLock()
    makers = {
        "config": lambda: (one.config,),
        "storage": lambda: (sv.VoxelMap(one.config).storage,),
        "blocks": lambda: (sv.VoxelMap(one.config).storage, []),
        "another": lambda: (make_map(one.config).storage,),
        "unknown": lambda: (NO_BLOCKS, sv.VoxelMap(one.config).storage),
        "path": lambda: (tmp_path / "m",),
        "picture": lambda: (0, 0, Percent(one.storage.rules), np.zeros((2, 2), np.int8)),
    }
    plain = {*vars(WithHistory), *vars(OnStorage), *vars(OnBlocks), "bounded"}
    names = [(part, name) for part in (one, one.storage) for name in dir(type(part)) if name[0] != "_"]
    names = [(part, name) for part, name in names if name not in plain]
    names = [(part, name) for part, name in names if not inspect.ismethod(getattr(type(part), name))]
    assert len(names) > 20
    for part, name in sorted(names, key=lambda one: one[1] == "close"):
        what = given.get(name, ())
        what = makers[what]() if isinstance(what, str) else what
        before, value = lock.times, getattr(part, name)
        if inspect.isgeneratorfunction(inspect.unwrap(getattr(type(part), name))):
            assert next(value(*what)) is not None
        elif callable(value):
            value(*what)
        assert lock.times == before + 1, name


def two():
    return mapped().map, mapped().map


ALONE = {
    "bag": lambda m, path: bags.write_bag(m, path / "m.bag", (-9, 9)),
    "coarsen": lambda m, path: edit.coarsen(m, 2),
    "crop": lambda m, path: edit.crop(m, (-1, -1, -1), (1, 1, 1)),
    "cubes": lambda m, path: cubes.in_cubes(m),
    "difference": lambda m, path: difference.difference(m, mapped().map),
    "frontiers": lambda m, path: frontiers.frontiers(m, 0.2),
    "ground": lambda m, path: ground.ground(m),
    "inflate": lambda m, path: projection.inflated(m, 0.3),
    "layer": lambda m, path: floor_axes.layer(m, "z", 0.0),
    "merge": lambda m, path: edit.merge(m, mapped().map),
    "mesh": lambda m, path: meshes.surface(m),
    "moved": lambda m, path: moved.moved(m, np.eye(4)),
    "octomap": lambda m, path: octomap.binary_tree(m),
    "path": lambda m, path: path_check.check_path(m, [[-0.8, 0, 0], [0.5, 0, 0]], 0.2),
    "pcd": lambda m, path: points.write_pcd(m, path / "m.pcd"),
    "ply": lambda m, path: points.write_ply(m, path / "m.ply"),
    "project": lambda m, path: projection.project(m, (0, 18), -9.0),
    "rerun": lambda m, path: rerun.write_rrd(m, path / "m.rrd"),
}
NEEDS = {"bag": "rosbags", "rerun": "rerun", "ground": "scipy", "mesh": "skimage"}


@pytest.mark.parametrize("name", ALONE)
def test_what_reads_a_map_in_several_calls_lets_it_not_change_between_them(name, tmp_path):
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
    one = mapped().map
    one.lock = one.storage.lock = CountingLock()
    with suppress(StereovoxError) if name == "ground" else nullcontext():  # there is none: it looked for it
        ALONE[name](one, tmp_path)
    assert one.lock.times == 1


def test_a_live_projection_misses_no_frame_while_it_looks(monkeypatch):
    mapper = mapped()
    above, seen = LiveProjection(mapper.map, (0, 18), floor=-9.0), []
    within = Storage.blocks_within
    monkeypatch.setattr(
        Storage, "blocks_within", lambda *words: (within(*words), seen.append(taken(mapper.map.lock)))[0]
    )
    assert above.grid() is not None
    assert seen == [True]


def test_two_maps_are_always_locked_in_the_same_order():
    order = []

    class Noting(MapLock):
        def __enter__(self):
            order.append(id(self))
            return super().__enter__()

    one, other = two()
    one.lock, other.lock = Noting(), Noting()
    both = one_state(lambda a, b: order.append("inside"))
    both(one, other)
    both(other, b=one)
    assert order == [*sorted({id(one.lock), id(other.lock)}), "inside"] * 2
    order.clear()
    both(one, one)
    assert order == [id(one.lock), "inside"]


def test_a_reader_that_stops_half_way_keeps_nobody_waiting():
    one = mapped().map
    for generator in (one.storage.slabs(), one.storage.timed()):
        next(generator)
        assert not taken(one.lock)
    with one.lock:
        assert taken(one.lock)


def blocks_by_place(one):
    return dict(zip(map(tuple, one.storage.blocks()[0].tolist()), one.storage.blocks()[1], strict=True))


@pytest.mark.parametrize("window", [{}, WINDOW], ids=["plain", "window"])
def test_pieces_of_a_map_that_grows_are_as_it_is_at_their_time(window, monkeypatch):
    monkeypatch.setattr(cell_pool, "PIECE", 4)
    mapper, found = mapped(**window), []
    before, frames = blocks_by_place(mapper.map), list(frames_of(0, 40))[6:]
    for coords, cells in mapper.map.storage.slabs():
        now = blocks_by_place(mapper.map)
        for place, block in zip(map(tuple, coords.tolist()), cells, strict=True):
            assert np.array_equal(block, now[place])
            found.append(place)
        mapper.add(frames.pop(0))
    assert len(found) == len(set(found)) > len(before) // 2
    assert set(found) >= before.keys() & blocks_by_place(mapper.map).keys()
    mapper.map.close()


def test_who_holds_the_lock_cannot_add_a_frame():
    """It would wait for a thread that adds one, and that thread for the lock."""
    mapper, floor = mapped(), GridMapper(voxel_size=0.1)
    frame, before = list(frames_of(0, 5))[4], mapper.map.cells()
    with mapper.map.lock, pytest.raises(StereovoxError, match="holds the map's lock"):
        mapper.add(frame)
    with floor.map.lock, pytest.raises(StereovoxError, match="holds the map's lock"):
        floor.add(next(scans_of(0, 1)))
    assert mapper.map.frames == 4
    for part, was in zip(mapper.map.cells(), before, strict=True):
        assert np.array_equal(part, was)
    slips = []

    def add_another(evidence):
        try:
            mapper.add(frame)
        except StereovoxError as error:
            slips.append(str(error))

    mapper.map.storage.listeners.append(add_another)
    assert mapper.add(frame).refused is None
    assert len(slips) == 1
    assert mapper.map.frames == 5


COPIES = [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))]


@pytest.mark.parametrize("way", [copy.copy, *COPIES], ids=["shallow", "copy", "pickle"])
def test_who_listens_to_a_map_does_not_listen_to_its_copy(way):
    mapper = mapped()
    seen = LiveProjection(mapper.map, (0.0, 2.0))
    twin = way(mapper.map)
    assert len(mapper.map.storage.listeners) == 1
    assert twin.storage.listeners == []
    assert twin.lock is not mapper.map.lock
    twin.add(Evidence(np.zeros((1, 3), np.int32), np.full((1, 512), 999, np.int16), np.empty((0, 3), np.int32), 0))
    assert twin.counts() != mapper.map.counts()
    assert seen.grid() is not None


@pytest.mark.parametrize("way", COPIES, ids=["copy", "pickle"])
def test_copies_have_locks_of_their_own_and_go_on(way):
    for mapper, rest in ((mapped(), list(frames_of(0, 7))[4:]), (GridMapper(voxel_size=0.1), list(scans_of(0, 3)))):
        with mapper.map.lock:
            twin = way(mapper)
            assert not taken(twin.map.lock)
            assert not taken(way(mapper.map).lock)
        for frame in rest:
            assert twin.add(frame).refused == mapper.add(frame).refused
        for part, other in zip(mapper.map.cells(), twin.map.cells(), strict=True):
            assert np.array_equal(part, other)
        assert twin.map.frames == mapper.map.frames > 0


@pytest.mark.parametrize("way", COPIES, ids=["copy", "pickle"])
def test_a_copy_is_made_with_the_lock_held(way, monkeypatch):
    one, held = mapped().map, []

    def state(pool):
        held.append(taken(one.lock))
        return vars(pool)

    monkeypatch.setattr(cell_pool.CellPool, "__getstate__", state, raising=False)
    twin = way(one)
    assert held[0]
    assert np.array_equal(twin.storage.blocks()[1], one.storage.blocks()[1])
    twin.storage._pool.values[:] = 0
    assert one.counts() != twin.counts()
    kept = one.storage.__getstate__()["history"]
    one.history.refused["later"] += 1
    assert kept.refused["later"] == 0
