# SPDX-License-Identifier: Apache-2.0
"""Frames that a map keeps: without loss, within their budget, and on disk as they were."""

import copy
import json
import os
import pickle
from dataclasses import replace

import numpy as np
import pytest
from made_manifest import manifest_in, put_manifest
from naive_packing import split

import stereovox as sv
from stereovox.cameras.pinhole import DepthCorrection
from stereovox.errors import ConfigError, MapFileError
from stereovox.maps.cells import _packing
from stereovox.maps.record import frame_store
from stereovox.maps.record.camera_path import StampedPose
from stereovox.maps.record.kept_frames import KeptFrame, KeptFrames, Packed

CAMERA = sv.PinholeCamera(12, 9, 10.0, 10.0, 5.5, 4.0, 0.05)
LOOKS_AHEAD = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
KEEP = {"voxel_size": 0.1, "map.keep_frames": True}


def kept(number, x=0.0, sensor="camera", size=(9, 12), camera=CAMERA):
    depth = np.random.default_rng(number).integers(0, 5000, size).astype(np.uint16)
    T = LOOKS_AHEAD.copy()
    T[0, 3] = x
    frame = sv.Frame(depth, camera, T, number, 0.001, name=f"frame {number}", sensor=sensor)
    seen = StampedPose(number, tuple(T.ravel().tolist()[:12]))
    blocks = np.array([[0, 0, 0], [1, 2, 3]], np.int32)
    return KeptFrame(
        number, sensor, frame.name, number, T, camera, "full", (0.0, 0.0), 0.001, np.inf, Packed.of(frame), seen, blocks
    )


def wall_frame(x=0.0, stamp_ns=0, camera=None, **more):
    camera = camera or sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.05)
    T = LOOKS_AHEAD.copy()
    T[0, 3] = x
    depth = np.full((camera.height, camera.width), 2.5, np.float32) + np.float32(0.003) * (np.arange(camera.width) % 5)
    depth += np.float32(0.001) * np.float32(stamp_ns % 7)  # no image is the one before
    return sv.Frame(depth, camera, T, stamp_ns, **more)


def mapped(frames, **settings):
    mapper = sv.Mapper("default", **{**KEEP, **settings})
    for frame in frames:
        assert mapper.add(frame).refused is None
    return mapper


@pytest.mark.parametrize("dtype", [np.uint16, np.uint32])
@pytest.mark.parametrize("shape", [(1, 1), (1, 70), (33, 1), (17, 66)])
def test_kernels_split_as_the_slow_twin_does_and_join_again(dtype, shape):
    random = np.random.default_rng(1)
    for high in (3, np.iinfo(dtype).max):
        bits = random.integers(0, high, shape, dtype, endpoint=True)
        planes = np.empty((bits.itemsize, *shape), np.uint8)
        _packing.split(bits, planes)
        assert (planes == split(bits)).all()
        again = np.empty_like(bits)
        _packing.join(planes, again)
        assert (again == bits).all()


@pytest.mark.parametrize("dtype", ["uint16", "float32", "float64"])
@pytest.mark.parametrize("with_reasons", [False, True])
def test_packing_loses_nothing(dtype, with_reasons):
    random = np.random.default_rng(2)
    depth = random.integers(0, 255, (9, 12 * np.dtype(dtype).itemsize), np.uint8).view(dtype)  # any NaN as well
    if dtype != "uint16":
        depth[0, :4] = np.nan, np.inf, -np.inf, -0.0
    reason = random.integers(0, 6, (9, 12), np.uint8) if with_reasons else None
    frame = sv.Frame(depth[::-1], CAMERA, LOOKS_AHEAD, depth_scale=0.001, reason=reason)
    there, why = Packed.of(frame).unpacked(CAMERA)
    assert there.dtype == depth.dtype
    assert there.tobytes() == depth[::-1].tobytes()
    assert (why is None) if reason is None else (why == reason).all()


def test_a_smooth_image_becomes_small():
    depth = np.tile(np.arange(640, dtype=np.uint16) // 3 + 1000, (480, 1))
    frame = sv.Frame(depth, sv.PinholeCamera.from_field_of_view(640, 480, 60), LOOKS_AHEAD, depth_scale=0.001)
    assert Packed.of(frame).content.size < depth.nbytes / 100


def test_without_a_budget_all_are_kept():
    frames = KeptFrames()
    for number in range(20):
        assert frames.wants("camera", kept(number).seen)
        frames.keep(kept(number))
    assert len(frames) == 20
    assert frames.are_all(20)
    assert not frames.are_all(21)
    assert frames.bytes == sum(frame.packed.content.size for frame in frames.frames)


def test_a_budget_keeps_the_views_that_differ_most():
    one = kept(0).packed.content.size
    frames = KeptFrames(budget=8 * one)
    for number in range(400):
        frame = kept(number, x=0.03 * number)
        if frames.wants("camera", frame.seen):
            frames.keep(frame)
        assert frames.bytes <= 8 * one
    places = [frame.T_world_sensor[0, 3] for frame in frames.frames]
    assert places[0] == 0
    assert 4 <= len(places) <= 8
    assert min(np.diff(places)) >= frames.spacing > 1
    assert not frames.are_all(400)


def test_a_budget_for_less_than_one_frame_keeps_one_of_each_sensor():
    frames = KeptFrames(budget=1)
    for number in range(4):
        frames.keep(kept(number, x=number, sensor="ab"[number % 2]))
    assert [frame.number for frame in frames.frames][:2] == [0, 1]
    assert {frame.sensor for frame in frames.frames} == {"a", "b"}


def test_maps_keep_frames_only_if_asked():
    assert mapped([wall_frame()]).map.kept_frames.are_all(1)
    assert mapped([wall_frame()], **{"map.keep_frames": False}).map.kept_frames is None


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"dimensions": 2}, "map.keep_frames"),
        ({"device": "cuda"}, "map.keep_frames"),
        ({"map.keep_frames": False, "map.frames_budget": "1MB"}, "frames_budget"),
    ],
)
def test_settings_that_make_no_sense_are_refused(settings, said):
    with pytest.raises(ConfigError, match=said):
        sv.load_config(**{**KEEP, **settings})


CAMERAS = [
    sv.PinholeCamera(80, 60, 60.0, 61.0, 39.5, 29.5, 0.05, 2, DepthCorrection("scale", (1.0, 0, 0, 0, 0, 0)), 0.1),
    sv.SphericalCamera.from_field_of_view(80, 60, 100, 80, 0.1),
    sv.CylindricalCamera.from_field_of_view(80, 60, 100, 80, 0.1),
]


def test_copies_and_pickles_of_a_map_have_frames_of_their_own():
    mapper = mapped(wall_frame(0.01 * n, n) for n in range(3))
    twin, pickled = copy.deepcopy(mapper.map), pickle.loads(pickle.dumps(mapper.map))
    mapper.add(wall_frame(0.05, 5))
    assert len(mapper.map.kept_frames) == 4
    for one in (twin, pickled):
        assert len(one.kept_frames) == 3
        assert one.kept_frames.bytes == sum(frame.packed.content.size for frame in one.kept_frames.frames)


def test_maps_of_floors_keep_none():
    with pytest.raises(ConfigError, match="maps in space"):
        sv.GridMapper(**{"map.keep_frames": True})


def test_info_tells_of_kept_frames(tmp_path):
    mapped([wall_frame()]).save(tmp_path / "m")
    told = sv.describe(tmp_path / "m")
    assert told.facts["kept_frames"]["frames"] == 1
    assert told.facts["kept_frames"]["bytes"] > 0
    assert any("keeps 1 of its frames" in line for line in told.lines)


def same(a, b):
    assert (a.number, a.sensor, a.name, a.stamp_ns, a.camera, a.quality) == (
        b.number, b.sensor, b.name, b.stamp_ns, b.camera, b.quality,
    )  # fmt: skip
    assert (a.depth_scale, a.farthest, a.seen, a.packed.digest) == (b.depth_scale, b.farthest, b.seen, b.packed.digest)
    assert a.pose_sigma == b.pose_sigma
    assert np.array_equal(a.T_world_sensor, b.T_world_sensor)
    assert np.array_equal(a.blocks, b.blocks)
    assert a.packed.unpacked(a.camera)[0].tobytes() == b.packed.unpacked(b.camera)[0].tobytes()


def test_a_saved_map_brings_its_frames_back(tmp_path):
    frames = [
        wall_frame(0.1 * n, n, camera, name=f"f{n}", sensor=f"eye {n}", pose_sigma=(0.001 * n, 0.01))
        for n, camera in enumerate(CAMERAS)
    ]
    mapper = mapped(frames, integrator="ray", **{"trust.max_disagreement": 1})  # a plane and parts of a sphere
    mapper.save(tmp_path / "m")
    assert [frame.frame().pose_sigma for frame in mapper.map.kept_frames.frames] == [f.pose_sigma for f in frames]
    loaded = sv.load_map(tmp_path / "m").kept_frames
    assert len(loaded) == 3
    for before, after in zip(mapper.map.kept_frames.frames, loaded.frames, strict=True):
        same(before, after)
    assert sv.load_map(tmp_path / "m").frames == 3


def test_checkpoints_write_only_what_is_new_and_leave_nothing_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(frame_store, "IN_A_PACK", 4)
    folder, written = tmp_path / "m", []
    mapper = mapped(wall_frame(0.01 * n, n) for n in range(9))
    write = frame_store._write
    monkeypatch.setattr(
        frame_store, "_write", lambda folder, name, parts: (written.append(name), write(folder, name, parts))
    )
    mapper.save(folder)
    assert len(written) == 4  # two whole packs, one that is not, the index
    mapper.save(folder)
    assert len(written) == 5  # the index alone
    mapper.add(wall_frame(0.09, 9))
    mapper.save(folder)
    assert len(written) == 7  # the last pack and the index
    assert len(list(folder.glob("frames-*"))) == 4
    assert len(sv.load_map(folder).kept_frames) == 10


def test_a_loaded_map_can_be_saved_elsewhere_and_gone_on_with(tmp_path):
    mapper = mapped(wall_frame(0.01 * n, n) for n in range(3))
    mapper.save(tmp_path / "m")
    sv.load_map(tmp_path / "m").save(tmp_path / "n")
    for name in ("m", "n"):
        more = sv.Mapper("default", resume=sv.load_map(tmp_path / name), **KEEP)
        more.add(wall_frame(0.05, 5))
        assert [frame.number for frame in more.map.kept_frames.frames] == [0, 1, 2, 3]
        more.save(tmp_path / name)
        assert len(sv.load_map(tmp_path / name).kept_frames) == 4


def test_a_loaded_map_is_saved_again_and_again_where_it_was(tmp_path):
    mapped(wall_frame(0.01 * n, n) for n in range(3)).save(tmp_path / "m")
    more = sv.Mapper("default", resume=sv.load_map(tmp_path / "m"), **KEEP)
    copied = copy.deepcopy(more.map)
    for n in range(3, 6):
        assert more.add(wall_frame(0.01 * n, n)).refused is None
        more.save(tmp_path / "m")
    for whose in (more.map, copied, sv.load_map(tmp_path / "m")):
        for n, frame in enumerate(whose.kept_frames.frames):
            assert (frame.frame().depth == wall_frame(0.01 * n, n).depth).all()
    assert len(list((tmp_path / "m").glob("frames-*"))) == 2


def test_a_map_goes_on_only_as_its_frames_allow(tmp_path):
    mapper = mapped([wall_frame()])
    with pytest.raises(ConfigError, match="max_range"):
        sv.Mapper("default", resume=mapper.map, **{**KEEP, "max_range": 4.0})
    assert sv.Mapper("default", resume=mapper.map, **{**KEEP, "threads": 2}).map.kept_frames.are_all(1)
    without = sv.Mapper("default", resume=mapper.map, **{**KEEP, "map.keep_frames": False})
    assert without.map.kept_frames is None
    with pytest.raises(ConfigError, match="did not keep its frames"):
        sv.Mapper("default", resume=without.map, **KEEP)


@pytest.fixture
def folder(tmp_path):
    mapped(wall_frame(0.01 * n, n) for n in range(3)).save(tmp_path / "m")
    return tmp_path / "m"


def index_of(folder):
    name = manifest_in(folder / "manifest.json")["kept_frames"]["index"]
    return folder / name, json.loads((folder / name).read_text())


def put_index(folder, index):
    """Write an index under the name that matches its content, as an attacker would."""
    content = json.dumps(index).encode()
    manifest = manifest_in(folder / "manifest.json")
    manifest["kept_frames"]["index"] = frame_store._name(content)
    (folder / frame_store._name(content)).write_bytes(content)
    put_manifest(folder / "manifest.json", manifest)


@pytest.mark.parametrize(
    "change",
    [
        lambda index: index.update(spacing=-1),
        lambda index: index.update(frames=index["frames"] * 100),
        lambda index: index["frames"].reverse(),
        lambda index: index["frames"][1].update(number=-1),
        lambda index: index["frames"][1].update(bytes="many"),
        lambda index: index["frames"][1].update(dtype="object"),
        lambda index: index["frames"][1].update(quality="best"),
        lambda index: index["frames"][1].update(depth_bytes=10**9),
        lambda index: index["frames"][1].update(camera=7),
        lambda index: index["frames"][1].update(T_world_sensor=[float("nan")] * 16),
        lambda index: index["frames"][1].update(T_world_sensor=[0.0] * 12),
        lambda index: index["frames"][1].update(blocks=[[0, 0]]),
        lambda index: index["frames"][1].update(pose_sigma=[0.1]),
        lambda index: index["frames"][1].update(pose_sigma=[0.1, float("inf")]),
        lambda index: index["frames"][1].pop("seen"),
        lambda index: index["cameras"][0].update(width=10**9),
        lambda index: index["cameras"][0].update(kind="box"),
    ],
)
def test_an_index_of_a_stranger_is_refused_in_one_line(folder, change):
    _, index = index_of(folder)
    change(index)
    put_index(folder, index)
    with pytest.raises(MapFileError, match="damaged map") as caught:
        sv.load_map(folder)
    assert str(caught.value).isprintable()


def test_names_of_frames_lead_nowhere_else(folder):
    manifest = manifest_in(folder / "manifest.json")
    manifest["kept_frames"]["packs"] = ["frames-../../x"]
    put_manifest(folder / "manifest.json", manifest)
    with pytest.raises(MapFileError, match="damaged map"):
        sv.load_map(folder)


def test_a_changed_index_is_noticed(folder):
    path, _ = index_of(folder)
    path.write_text(path.read_text().replace('"number": 1', '"number": 7'))
    with pytest.raises(MapFileError, match="does not match its name"):
        sv.load_map(folder)


def test_damaged_and_missing_images_are_told_when_they_are_needed(folder):
    loaded = sv.load_map(folder)
    pack = next(path for path in folder.glob("frames-*") if path != index_of(folder)[0])
    content = bytearray(pack.read_bytes())
    content[20] ^= 255
    pack.write_bytes(content)
    with pytest.raises(MapFileError, match="damaged"):
        loaded.kept_frames.frames[0].frame()
    pack.unlink()
    with pytest.raises(MapFileError, match="reload it"):
        loaded.kept_frames.frames[1].frame()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_a_pipe_in_the_place_of_images_is_not_waited_for(folder):
    loaded = sv.load_map(folder)
    pack = next(path for path in folder.glob("frames-*") if path != index_of(folder)[0])
    pack.unlink()
    os.mkfifo(pack)
    writer = os.open(pack, os.O_RDWR)  # or who waits would do so for ever
    with pytest.raises(MapFileError, match="not a file"):
        loaded.kept_frames.frames[0].frame()
    os.close(writer)


def test_an_image_must_unpack_to_the_size_of_its_camera():
    frame = kept(0)
    with pytest.raises(MapFileError, match="does not unpack"):
        frame.packed.unpacked(replace(CAMERA, width=13))
