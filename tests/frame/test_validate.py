# SPDX-License-Identifier: Apache-2.0
"""Frames and scans that are made of the wrong things: each is refused in one line and counted."""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.rigs import StereoPair
from stereovox.mapper import GridMapper

CAMERA = sv.PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5, 0.05)
DEPTH = np.full((6, 8), 2.0, np.float32)
FRAME = sv.Frame(DEPTH, CAMERA, np.eye(4))
GREY = np.full((6, 8), 100, np.uint8)
PAIR = sv.StereoFrame(GREY, GREY, StereoPair(CAMERA), np.eye(4))
SCAN = sv.Scan(np.full(9, 2.0, np.float32), -1.0, 0.25, 0.1, 5.0, np.eye(4))
MASKED = np.ma.masked_array(DEPTH, DEPTH > 1)


def state_of(voxel_map):
    cells = voxel_map.storage.tiles() if isinstance(voxel_map, sv.GridMap) else voxel_map.storage.blocks()
    return [array.tobytes() for array in cells], voxel_map.frames, getattr(voxel_map, "viewpoint", None)


def refused(mapper, seen):
    """Offer it to a mapper that has a map already; return why it was refused."""
    before, count = state_of(mapper.map), mapper.map.frames_refused
    report = mapper.add(seen)
    assert state_of(mapper.map) == before
    assert mapper.map.frames_refused == count + (report.refused is not None)
    if report.refused:
        assert report.detail
        assert "\n" not in report.detail
    return report.refused


@pytest.fixture(scope="module")
def voxels():
    mapper = sv.Mapper(voxel_size=0.25, max_range=4.0, **{"stereo.disparities": 16})
    assert mapper.add(FRAME).refused is None
    return mapper


@pytest.fixture(scope="module")
def grid():
    mapper = GridMapper(voxel_size=0.25, max_range=4.0)
    assert mapper.add(SCAN).refused is None
    return mapper


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"depth": None}, "bad_dtype"),
        ({"depth": DEPTH.tolist()}, "bad_dtype"),
        ({"depth": DEPTH.astype(complex)}, "bad_dtype"),
        ({"depth": DEPTH.astype(object)}, "bad_dtype"),
        ({"depth": DEPTH.astype(">f4")}, "bad_dtype"),
        ({"depth": DEPTH.astype(np.float16)}, "bad_dtype"),
        ({"depth": MASKED}, "bad_form"),
        ({"depth": DEPTH[..., None]}, "bad_shape"),
        ({"depth": DEPTH[:0]}, "bad_shape"),
        ({"depth": np.float32(2)}, "bad_dtype"),
        ({"depth": np.array(2.0, np.float32)}, "bad_shape"),
        ({"camera": None}, "bad_form"),
        ({"camera": CAMERA.__dict__}, "bad_form"),
        ({"camera": sv.PinholeCamera(10**4, 10**4, 1e4, 1e4, 5e3, 5e3)}, "bad_shape"),
        ({"camera": SCAN}, "bad_form"),
        ({"depth_scale": None}, "bad_scale"),
        ({"depth_scale": "0.001"}, "bad_scale"),
        ({"depth_scale": 10**400}, "bad_scale"),
        ({"depth_scale": 1j}, "bad_scale"),
        ({"depth_scale": 1e300}, "bad_scale"),
        ({"depth_scale": -0.0}, "bad_scale"),
        ({"reason": [[0]]}, "bad_reason"),
        ({"reason": np.zeros((6, 8))}, "bad_reason"),
        ({"reason": np.zeros((6, 8), "M8[s]")}, "bad_reason"),
        ({"reason": np.full((6, 8), -1, np.int8)}, "bad_reason"),
        ({"reason": np.full((6, 8), 255, np.uint8)}, "bad_reason"),
        ({"stamp_ns": 1.5}, "bad_stamp"),
        ({"stamp_ns": None}, "bad_stamp"),
        ({"stamp_ns": 10**30}, "bad_stamp"),
        ({"stamp_ns": -(10**5000)}, "bad_stamp"),
        ({"stamp_ns": np.array([1, 2])}, "bad_stamp"),
        ({"stamp_ns": np.uint64(2**63)}, "bad_stamp"),
        ({"pose_off_ns": 0.1}, "bad_stamp"),
        ({"pose_sigma": 0.1}, "bad_form"),
        ({"pose_sigma": (0.1, -1)}, "bad_form"),
        ({"pose_sigma": (np.nan, 0.1)}, "bad_form"),
        ({"sensor": None}, "bad_sensor"),
        ({"sensor": 1}, "bad_sensor"),
        ({"name": None}, "bad_form"),
        ({"name": np.zeros(3)}, "bad_form"),
        ({"fault": 1}, "bad_form"),
        ({"fault": "no_pose", "depth": None, "camera": None}, "no_pose"),
        ({"name": "two\nlines\r", "depth": None}, "bad_dtype"),
        ({"T_world_sensor": None}, "no_pose"),
        ({"T_world_sensor": [[1, 2], [3]]}, "pose_not_rigid"),
        ({"T_world_sensor": np.eye(4)[:3]}, "pose_not_rigid"),
        ({"T_world_sensor": np.eye(4).astype(complex)}, "pose_not_rigid"),
        ({"T_world_sensor": np.eye(4).astype(str)}, "pose_not_rigid"),
        ({"T_world_sensor": np.full((4, 4), 10**400, object)}, "pose_not_rigid"),
    ],
)
def test_frames(voxels, grid, changes, reason):
    frame = replace(FRAME, **changes)
    assert refused(voxels, frame) == refused(grid, frame) == reason


@pytest.mark.parametrize("same", [
    {"depth": np.ascontiguousarray(DEPTH[:, ::-1])[:, ::-1]},
    {"depth": np.asfortranarray(DEPTH)},
    {"depth": np.broadcast_to(np.float32(2), (6, 8))},
    {"T_world_sensor": np.eye(4).tolist()},
    {"T_world_sensor": np.eye(4, dtype=np.float32)},
    {"T_world_sensor": np.eye(4, dtype=">f8")},
    {"T_world_sensor": np.eye(4, dtype=int)},
    {"stamp_ns": np.int64(0)},
    {"depth_scale": 1},
    {"reason": np.zeros((8, 6), np.uint8).T},
])  # fmt: skip
def test_what_means_the_same_does_the_same(same):
    maps = []
    for frame in (FRAME, replace(FRAME, **same)):
        mapper = sv.Mapper(voxel_size=0.25, max_range=4.0)
        assert mapper.add(frame).refused is None
        maps.append(mapper.map.storage.blocks())
    assert all((a == b).all() for a, b in zip(*maps, strict=True))


@pytest.mark.parametrize("kind", [np.uint8, np.int32, np.uint64])
def test_times_are_told_whatever_holds_the_stamps(kind):
    mapper = sv.Mapper(voxel_size=0.25, max_range=4.0, **{"map.keep_times": True})
    for stamp, sensor in ((200, "left"), (5, "right")):  # each has its own clock
        assert mapper.add(replace(FRAME, stamp_ns=kind(stamp), sensor=sensor)).refused is None
    assert set(mapper.map.ages(0).tolist()) == {0.0}
    assert type(mapper.map.viewpoint.stamp_ns) is int


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"left": None}, "bad_form"),
        ({"left": GREY.tolist()}, "bad_form"),
        ({"right": GREY.astype(float)}, "bad_dtype"),
        ({"right": GREY[:0]}, "bad_shape"),
        ({"left": np.full((6, 8, 4), 100, np.uint8)}, "bad_shape"),
        ({"left": np.ma.masked_array(GREY, GREY)}, "bad_form"),
        ({"pair": None}, "bad_form"),
        ({"pair": CAMERA}, "bad_form"),
        ({"fault": "unreadable", "pair": None}, "unreadable"),
        ({"T_world_sensor": "x"}, "pose_not_rigid"),
        ({"stamp_ns": 0.5}, "bad_stamp"),
    ],
)
def test_stereo_pairs(voxels, changes, reason):
    assert refused(voxels, replace(PAIR, **changes)) == reason


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"ranges": None}, "bad_form"),
        ({"ranges": [1.0, 2.0]}, "bad_form"),
        ({"ranges": np.ones(9, complex)}, "bad_dtype"),
        ({"ranges": np.ma.masked_array(np.ones(9), np.eye(9)[0])}, "bad_form"),
        ({"angle_min": None}, "bad_form"),
        ({"angle_step": "0.1"}, "bad_form"),
        ({"angle_min": 1e308, "angle_step": 1e308}, "bad_scan"),
        ({"range_max": 10**400}, "bad_form"),
        ({"clear": 1.0}, "bad_form"),
        ({"clear": np.full(9, "a")}, "bad_clear"),
        ({"clear_from": np.ones(9, complex)}, "bad_clear"),
        ({"T_base_sensor": None}, "mount_not_rigid"),
        ({"T_base_sensor": np.eye(4).astype(complex)}, "mount_not_rigid"),
        ({"sensor": b"lidar"}, "bad_sensor"),
        ({"stamp_ns": float("nan")}, "bad_stamp"),
    ],
)
def test_scans(grid, changes, reason):
    assert refused(grid, replace(SCAN, **changes)) == reason


@pytest.mark.parametrize("what", [None, "a.png", 3, DEPTH, object(), sv.Frame, {"depth": DEPTH}, FRAME.__dict__])
def test_what_is_no_frame_at_all(voxels, grid, what):
    assert refused(voxels, what) == refused(grid, what) == "bad_form"
    assert refused(voxels, SCAN) == "bad_form"
