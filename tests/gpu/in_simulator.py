"""Tests of maps on graphics cards in numba's simulator, which must be asked for before numba is loaded: `test_gpu.py`.

The simulator runs each thread of a kernel as plain Python, several at once, and finds indices out of range. It rounds
every operation, where processors and cards fuse some; no cell of these images lies that near to an edge.
"""

import pickle
from copy import deepcopy
from functools import lru_cache

import numpy as np
import pytest
from made_images import cells_of, made_image
from numba.core.config import ENABLE_CUDASIM
from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray, FakeWithinKernelCUDAArray
from numba.cuda.simulator.kernel import BlockManager, BlockThread

import stereovox as sv
from stereovox.errors import ConfigError, FrameRefused
from stereovox.integrate import gpu as integrate_gpu
from stereovox.integrate import make_integrator
from stereovox.kernels._gpu import gpu_array
from stereovox.maps import make_map
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage import gpu as maps_gpu
from stereovox.maps.storage.storage import Storage
from stereovox.sensors import SENSORS

assert ENABLE_CUDASIM, "run test_gpu.py, which asks for the simulator"

SMALL = sv.PinholeCamera(24, 18, 15.0, 15.0, 11.3, 8.8)
DEEP = sv.PinholeCamera(8, 6, 400.0, 400.0, 3.3, 2.8)
"""Sees little, but far."""


@pytest.fixture(autouse=True)
def _patience(monkeypatch):
    """The simulator asks its threads all the time whether they have ended, which keeps them from it."""
    alive = BlockThread.is_alive
    monkeypatch.setattr(BlockThread, "is_alive", lambda thread: thread.join(0.0005) or alive(thread))


def bare(value):
    """Return an array as NumPy's, which finds indices out of range as well, and is read in a third of the time."""
    if isinstance(value, FakeWithinKernelCUDAArray):
        return bare(value._item)
    if isinstance(value, tuple):
        parts = [bare(part) for part in value]
        return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
    return value._ary if isinstance(value, FakeCUDAArray) else value


@pytest.fixture(autouse=True)
def _bare_arrays(monkeypatch):
    run = BlockManager.run
    monkeypatch.setattr(BlockManager, "run", lambda self, point, *given: run(self, point, *map(bare, given)))


@pytest.fixture(autouse=True)
def _little_room(monkeypatch):
    """Filling memory takes the simulator long."""
    monkeypatch.setattr(maps_gpu, "ROOM", 24)


def image_of(seed, camera=SMALL, scale=1.0):
    image = made_image(seed, camera)
    return sv.DepthImage(scale * image.depth_m, image.reason, camera, image.T_world_sensor)


def frame_of(n):
    """Return frame `n` of a camera that stands still, before which a wall moves to and fro."""
    image = image_of(7, scale=1 + 0.2 * (n % 2))
    return sv.Frame(image.depth_m, SMALL, image.T_world_sensor, stamp_ns=10**9 * n)


def assert_same_evidence(image, **settings):
    """Both integrators say the same of each cell; return the evidence of the card."""
    ours = make_integrator(sv.load_config(device="cuda", **settings)).evidence(image)
    theirs = make_integrator(sv.load_config(**settings)).evidence(image)
    assert len(theirs.coords)
    assert cells_of(ours) == cells_of(theirs)
    assert {tuple(block) for block in ours.uniform.tolist()} == {tuple(block) for block in theirs.uniform.tolist()}
    return ours


@pytest.mark.parametrize("model", SENSORS)
def test_evidence_is_that_of_the_processor(model):
    assert_same_evidence(image_of(1), voxel_size=0.25, max_range=2.5, **{"sensor.model": model})


def test_wholly_free_blocks_are_those_of_the_processor():
    image = image_of(2)
    upright = np.eye(4)
    upright[:3, 3] = 0.1  # the second layer of blocks before it is nowhere next to the image
    image = sv.DepthImage(np.full_like(image.depth_m, np.inf), image.reason, SMALL, upright)
    evidence = assert_same_evidence(image, voxel_size=0.2, max_range=6.0, blind_range=3.0)
    assert len(evidence.uniform) > 2


def test_cells_that_need_long_keys_are_those_of_the_processor():
    settings = {"voxel_size": 0.0125, "max_range": 6.4, "blind_range": 5.6}
    assert integrate_gpu.GpuHits(DEEP, sv.load_config(**settings))._wide
    assert_same_evidence(image_of(3, DEEP, 3.7), **settings)


@pytest.mark.parametrize("full_share", [0.0, 0.5])
def test_hits_are_weighed_as_by_the_processor(full_share):
    settings = {"voxel_size": 0.2, "max_range": 2.2, "blind_range": 1.5, "projective.full_share": full_share}
    assert_same_evidence(image_of(4), **settings)


def test_unequal_cells_are_those_of_the_processor():
    assert_same_evidence(image_of(5), steps=(0.3, 0.2, 0.1), max_range=2.5)


def test_lists_that_were_too_short_lose_nothing(monkeypatch):
    monkeypatch.setattr(integrate_gpu, "ROOM", 1)
    monkeypatch.setattr(integrate_gpu, "HIT_ROOM", 1)
    evidence = assert_same_evidence(image_of(1), voxel_size=0.4, max_range=2.5)
    assert evidence.n > 4


@pytest.mark.parametrize("room", ["ROOM", "HIT_ROOM"])
def test_a_frame_that_the_card_cannot_hold_is_refused_and_the_next_one_is_whole(monkeypatch, room):
    """The last array for which there is no more room must not leave the others longer than it is."""
    monkeypatch.setattr(integrate_gpu, room, 1)
    last = {"ROOM": (4, np.int16), "HIT_ROOM": (2, np.uint8)}[room]

    def short(shape, dtype, value=None):
        if (shape, dtype) == last:
            raise MemoryError("no room")
        return gpu_array(shape, dtype, value)

    config = sv.load_config(voxel_size=0.4, max_range=2.5, device="cuda")
    ours = make_integrator(config)
    with monkeypatch.context() as patched:
        patched.setattr(integrate_gpu, "gpu_array", short)
        with pytest.raises(FrameRefused, match=r"^no room; lower max_range") as refused:
            ours.evidence(image_of(1))
    assert refused.value.reason == "memory_full"
    theirs = make_integrator(sv.load_config(voxel_size=0.4, max_range=2.5))
    assert cells_of(ours.evidence(image_of(1))) == cells_of(theirs.evidence(image_of(1)))


def test_a_frame_beyond_all_bounds_is_refused(monkeypatch):
    monkeypatch.setattr(integrate_gpu, "ROOM", 1)
    monkeypatch.setattr("stereovox.integrate.views.MAX_BLOCKS", 2)
    with pytest.raises(FrameRefused, match="lower max_range, or use larger cells"):
        make_integrator(sv.load_config(voxel_size=0.2, max_range=2.5, device="cuda")).evidence(image_of(1))


def test_an_image_without_any_value_says_nothing():
    image = image_of(1)
    blind = sv.DepthImage(np.full_like(image.depth_m, np.nan), image.reason, SMALL, image.T_world_sensor)
    evidence = make_integrator(sv.load_config(voxel_size=0.2, device="cuda")).evidence(blind)
    assert not evidence.values.any()
    assert len(evidence.uniform) == 0


def test_a_wide_camera_is_not_for_the_card():
    camera = sv.SphericalCamera.from_field_of_view(20, 15, 150, 110, 0.1)
    image = sv.DepthImage(np.ones((camera.height, camera.width), np.float32), np.zeros(0, np.uint8), camera, np.eye(4))
    with pytest.raises(ConfigError, match='use device "cpu"'):
        make_integrator(sv.load_config(device="cuda")).evidence(image)


def assert_same_map(ours, theirs):
    for mine, its in zip(ours.cells(), theirs.cells(), strict=True):
        np.testing.assert_array_equal(mine, its)
    assert len(ours.cells()[0])


def numbers(reports):
    return [(report.cells, report.refused, report.detail) for report in reports]


def mapped(device, frames, **settings):
    mapper = sv.Mapper(**{"voxel_size": 0.25, "max_range": 2.5, "device": device, **settings})
    return mapper, [mapper.add(frame_of(n)) for n in range(frames)]


def test_a_mapper_maps_as_on_the_processor():
    (ours, mine), (theirs, its) = mapped("cuda", 2), mapped("cpu", 2)
    assert numbers(mine) == numbers(its)
    assert all(report.cells for report in mine)
    assert_same_map(ours.map, theirs.map)
    assert ours.map.counts() == theirs.map.counts()


def test_quality_levels_run_on_the_card():
    ours, reports = mapped("cuda", 1, deadline_ms=1e6, voxel_size=0.5)
    assert reports[0].refused is None
    assert type(ours.map.storage) is maps_gpu.GpuStorage


def test_a_full_card_refuses_the_frame_and_keeps_the_map(monkeypatch):
    monkeypatch.setattr(maps_gpu, "ROOM", 1)
    (ours, _), (theirs, its) = mapped("cuda", 0), mapped("cpu", 1)
    with monkeypatch.context() as patched:
        patched.setattr(maps_gpu, "gpu_array", full)
        report = ours.add(frame_of(0))
    assert report.refused == "memory_full"
    assert "graphics card" in report.detail
    assert "larger cells" in report.detail
    assert not len(ours.map.cells()[0])
    assert ours.map.storage.viewpoint is None
    assert ours.map.history.refused == {"memory_full": 1}
    assert ours.add(frame_of(0)).cells == its[0].cells
    assert_same_map(ours.map, theirs.map)


def full(shape, dtype, value=None):
    if np.prod(shape) > 512:
        raise MemoryError
    return gpu_array(shape, dtype, value)


@lru_cache
def evidence_of(n):
    """Return the evidence of frame `n`, made by the processor; it takes the simulator long."""
    image = image_of(7, scale=1 + 0.2 * (n // 2 % 2))
    return make_integrator(sv.load_config(voxel_size=0.25, max_range=2.5)).evidence(image)


def grown(device, frames, resume=None, **settings):
    """Return a map of frames from `frames[0]` to before `frames[1]`, and how many cells each of them changed."""
    config = sv.load_config(voxel_size=0.25, max_range=2.5, device=device, **settings)
    made, changed = make_map(config, resume), []
    for n in range(*frames):
        changed.append(made.add(evidence_of(n)))
        made.history.frames += 1
    return made, changed


@pytest.mark.parametrize(
    "settings",
    [
        {"map.cell": "int16", "map.log_odds_min": -0.4},
        {"map.cell": "int8"},
        {"map.cell": "uint8", "map.prior": 0.5},
        {"map.confirm_hits": 3},
    ],
    ids=str,
)
def test_all_kinds_of_cells_are_those_of_the_processor(settings):
    (ours, mine), (theirs, its) = grown("cuda", (0, 5), **settings), grown("cpu", (0, 5), **settings)
    assert mine == its
    assert any(mine)
    assert_same_map(ours, theirs)


def test_a_map_outgrows_its_room(monkeypatch):
    monkeypatch.setattr(maps_gpu, "ROOM", 1)
    (ours, mine), (theirs, its) = grown("cuda", (0, 4)), grown("cpu", (0, 4))
    assert mine == its
    assert_same_map(ours, theirs)
    assert ours.reserved_bytes >= ours.memory_bytes > 1024 * len(ours.storage.blocks()[0])


def test_how_far_a_frame_agrees_with_the_map_is_as_on_the_processor(monkeypatch):
    monkeypatch.setattr("stereovox.maps.record.glance.SAMPLE", 3)  # so that blocks are left out
    maps = [grown(device, (0, 2))[0] for device in ("cuda", "cpu")]
    mine, its = (one.storage.agreement(evidence_of(2), 100) for one in maps)
    assert mine == its
    assert mine.hits > 0
    assert mine.passes > 0


def test_the_map_is_copied_once_between_two_frames():
    ours, _ = grown("cuda", (0, 1))
    pool = ours.storage._pool
    host = pool.host
    ours.occupied()
    assert pool.host is host
    ours.add(evidence_of(1))
    assert pool.host is not host


@pytest.mark.parametrize(("first", "second"), [("cuda", "cpu"), ("cpu", "cuda"), ("cuda", "cuda")])
def test_a_map_goes_on_on_the_other_device(first, second, tmp_path):
    whole, _ = grown("cpu", (0, 3))
    begun, _ = grown(first, (0, 2))
    begun.save(tmp_path / "map")
    for resume in (sv.load_map(tmp_path / "map"), begun):
        ended, _ = grown(second, (2, 3), resume)
        assert (type(ended.storage) is Storage) == (second == "cpu")
        assert (ended is begun) == (resume is begun and first == second)
        assert ended.config.device == second
        assert ended.frames == 3
        assert_same_map(ended, whole)


def test_copies_are_maps_of_their_own():
    (ours, _), (theirs, _) = grown("cuda", (0, 1)), grown("cpu", (0, 1))
    copies = [deepcopy(ours), pickle.loads(pickle.dumps(ours)), ours.snapshot()]
    ours.add(evidence_of(1))
    for copy in copies:
        assert_same_map(copy, theirs)


def test_listeners_and_other_programs_may_read_and_write():
    heard, maps = [], [grown(device, (0, 0))[0] for device in ("cuda", "cpu")]
    for one in maps:
        one.listeners.append(lambda evidence: heard.append(cells_of(evidence)))
        one.add(evidence_of(0))
        coords, cells = one.storage.blocks()
        one.storage.insert(coords[:1], np.full_like(cells[:1], 77))
        one.add(Evidence(coords[:2], np.full((2, 512), 5, np.int16), coords[2:3], np.array([-9], np.int16)))
        assert one.add(Evidence(coords[:0], cells[:0].astype(np.int16), coords[:0], np.zeros(0, np.int16))) == 0
    assert heard[: len(heard) // 2] == heard[len(heard) // 2 :]
    assert_same_map(*maps)
