"""Tests of maps on graphics cards in numba's simulator, which must be asked for before numba is loaded: `test_gpu.py`.

The simulator runs each thread of a kernel as plain Python, several at once, and finds indices out of range. It rounds
every operation, where processors and cards fuse some; no cell of these images lies that near to an edge.
"""

import pickle
from copy import deepcopy

import numpy as np
import pytest
from made_images import cells_of, made_image
from numba.core.config import ENABLE_CUDASIM

import stereovox as sv
from stereovox._gpu import gpu_array
from stereovox.errors import ConfigError, FrameRefused
from stereovox.integrate import gpu as integrate_gpu
from stereovox.integrate import make_integrator
from stereovox.maps import gpu as maps_gpu
from stereovox.maps.evidence import Evidence
from stereovox.maps.storage import Storage
from stereovox.sensors import SENSORS

assert ENABLE_CUDASIM, "run test_gpu.py, which asks for the simulator"

SMALL = sv.PinholeCamera(24, 18, 15.0, 15.0, 11.3, 8.8)
DEEP = sv.PinholeCamera(8, 6, 400.0, 400.0, 3.3, 2.8)
"""Sees little, but far."""


@pytest.fixture(autouse=True)
def _little_room(monkeypatch):
    """Filling memory takes the simulator long."""
    monkeypatch.setattr(maps_gpu, "ROOM", 24)


def image_of(seed, camera=SMALL, scale=1.0):
    image = made_image(seed, camera)
    return sv.DepthImage(scale * image.depth_m, image.reason, camera, image.T_world_sensor)


def frame_of(n):
    """Return frame `n` of a camera that stands still, before which a wall moves to and fro."""
    image = image_of(7, scale=1 + 0.2 * (n // 2 % 2))
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
    assert_same_evidence(image_of(1), voxel_size=0.2, max_range=2.5, **{"sensor.model": model})


def test_wholly_free_blocks_are_those_of_the_processor():
    image = image_of(2)
    image = sv.DepthImage(np.full_like(image.depth_m, np.inf), image.reason, SMALL, image.T_world_sensor)
    evidence = assert_same_evidence(image, voxel_size=0.2, max_range=6.0, blind_range=3.0)
    assert len(evidence.uniform) > 2


def test_cells_that_need_long_keys_are_those_of_the_processor():
    settings = {"voxel_size": 0.0125, "max_range": 6.4, "blind_range": 5.6}
    assert integrate_gpu.GpuHits(DEEP, sv.load_config(**settings))._wide
    assert_same_evidence(image_of(3, DEEP, 3.7), **settings)


@pytest.mark.parametrize("full_share", [0.0, 0.5])
def test_hits_are_weighed_as_by_the_processor(full_share):
    settings = {"voxel_size": 0.1, "max_range": 2.2, "blind_range": 1.5, "projective.full_share": full_share}
    assert_same_evidence(image_of(4), **settings)


def test_unequal_cells_are_those_of_the_processor():
    assert_same_evidence(image_of(5), steps=(0.3, 0.2, 0.1), max_range=2.5)


def test_lists_that_were_too_short_lose_nothing(monkeypatch):
    monkeypatch.setattr(integrate_gpu, "ROOM", 1)
    monkeypatch.setattr(integrate_gpu, "HIT_ROOM", 1)
    evidence = assert_same_evidence(image_of(1), voxel_size=0.2, max_range=2.5)
    assert evidence.n > 4


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


def mapped(device, frames=4, **settings):
    """Return a mapper and its reports of so many frames from one place, each of them farther off every second time."""
    mapper = sv.Mapper(voxel_size=0.25, max_range=2.5, device=device, **settings)
    return mapper, [mapper.add(frame_of(n)) for n in range(frames)]


def numbers(reports):
    return [(report.cells, report.refused, report.detail) for report in reports]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"map.cell": "int8"},
        {"map.cell": "uint8", "map.prior": 0.5},
        {"map.confirm_hits": 3},
        {"map.log_odds_min": -0.4, "trust.max_disagreement": 1},
    ],
    ids=str,
)
def test_maps_are_those_of_the_processor(settings):
    (ours, mine), (theirs, its) = mapped("cuda", **settings), mapped("cpu", **settings)
    assert numbers(mine) == numbers(its)
    assert sum(report.cells for report in mine)
    assert_same_map(ours.map, theirs.map)
    assert ours.map.counts() == theirs.map.counts()


def test_a_map_outgrows_its_room(monkeypatch):
    monkeypatch.setattr(maps_gpu, "ROOM", 1)
    ours, mine = mapped("cuda")
    theirs, its = mapped("cpu")
    assert numbers(mine) == numbers(its)
    assert_same_map(ours.map, theirs.map)
    assert ours.map.reserved_bytes >= ours.map.memory_bytes > 512 * len(ours.map.storage.blocks()[0])


def test_a_full_card_refuses_the_frame_and_keeps_the_map(monkeypatch):
    monkeypatch.setattr(maps_gpu, "ROOM", 1)
    ours, _ = mapped("cuda", frames=0)
    theirs, its = mapped("cpu", frames=1)
    with monkeypatch.context() as patched:
        patched.setattr(maps_gpu, "gpu_array", full)
        report = ours.add(frame_of(0))
    assert report.refused == "memory_full"
    assert "graphics card" in report.detail
    assert "larger cells" in report.detail
    assert not len(ours.map.cells()[0])
    assert ours.map.history.refused == {"memory_full": 1}
    assert ours.add(frame_of(0)).cells == its[0].cells
    assert_same_map(ours.map, theirs.map)


def full(shape, dtype, value=None):
    if np.prod(shape) > 512:
        raise MemoryError
    return gpu_array(shape, dtype, value)


def test_how_far_a_frame_agrees_with_the_map_is_as_on_the_processor(monkeypatch):
    monkeypatch.setattr("stereovox.maps.frame_agreement.SAMPLE", 3)  # so that blocks are left out
    (ours, _), (theirs, _) = mapped("cuda"), mapped("cpu")
    evidence = make_integrator(theirs.config).evidence(image_of(7, scale=1.3))
    mine, its = (mapper.map.storage.agreement(evidence, 100) for mapper in (ours, theirs))
    assert mine == its
    assert mine.hits > 0
    assert mine.passes > 0


def test_the_map_is_copied_once_between_two_frames():
    ours, _ = mapped("cuda", frames=1)
    pool = ours.map.storage._pool
    host = pool.host
    ours.map.occupied()
    assert pool.host is host
    ours.add(frame_of(1))
    assert pool.host is not host


def test_a_map_goes_on_on_the_other_device(tmp_path):
    whole, _ = mapped("cpu", frames=4)
    for first, second in (("cuda", "cpu"), ("cpu", "cuda"), ("cuda", "cuda")):
        begun, _ = mapped(first, frames=2)
        begun.save(tmp_path / f"{first}-{second}")
        for resume in (sv.load_map(tmp_path / f"{first}-{second}"), begun.map):
            ended = sv.Mapper(begun.config, resume=resume, device=second)
            assert (type(ended.map.storage) is Storage) == (second == "cpu")
            for n in (2, 3):
                ended.add(frame_of(n))
            assert ended.map.frames == 4
            assert_same_map(ended.map, whole.map)
            if resume is begun.map and first == second:
                assert ended.map is resume


def test_copies_are_maps_of_their_own():
    ours, _ = mapped("cuda", frames=1)
    theirs, _ = mapped("cpu", frames=1)
    copies = [deepcopy(ours.map), pickle.loads(pickle.dumps(ours.map)), ours.map.snapshot()]
    ours.add(frame_of(1))
    for copy in copies:
        assert_same_map(copy, theirs.map)


def test_listeners_and_other_programs_may_read_and_write():
    ours, _ = mapped("cuda", frames=0)
    theirs, _ = mapped("cpu", frames=0)
    heard = {}
    for mapper in (ours, theirs):
        mapper.map.listeners.append(lambda evidence, mapper=mapper: heard.update({id(mapper): cells_of(evidence)}))
        mapper.add(frame_of(0))
        coords, cells = mapper.map.storage.blocks()
        mapper.map.storage.insert(coords[:1], np.full_like(cells[:1], 77))
        mapper.map.add(Evidence(coords[:2], np.full((2, 512), 5, np.int16), coords[2:3], np.array([-9], np.int16)))
    assert heard[id(ours)] == heard[id(theirs)]
    assert_same_map(ours.map, theirs.map)
    assert ours.map.add(Evidence(coords[:0], cells[:0].astype(np.int16), coords[:0], np.zeros(0, np.int16))) == 0


def test_quality_levels_run_on_the_card():
    ours, reports = mapped("cuda", frames=2, deadline_ms=1e6)
    assert [report.refused for report in reports] == [None, None]
    assert type(ours.map.storage) is maps_gpu.GpuStorage
