# SPDX-License-Identifier: Apache-2.0
"""The path of the camera is kept with the map: thinned, bounded, and the same for any split of a run."""

import json

import numpy as np

import stereovox as sv
from stereovox.geometry.se3 import look_at
from stereovox.maps.record.camera_path import MAX_STOPS, SPACING_M, CameraPath, StampedPose


def seen(n, x, turn=0.0):
    c, s = np.cos(turn), np.sin(turn)
    return StampedPose(n, (c, -s, 0.0, x, s, c, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0))


def xs(path, sensor="camera"):
    return path.poses(sensor)[:, 0, 3]


def test_what_stands_still_is_kept_once_and_what_moves_or_turns_again():
    path = CameraPath()
    for n in range(100):
        path.walk("camera", seen(n, 1e-6 * n))
    assert len(path.stops["camera"]) == 1
    path.walk("camera", seen(100, SPACING_M * 1.01))
    path.walk("camera", seen(101, SPACING_M * 1.01, 2.02 * SPACING_M))
    assert [stop.stamp_ns for stop in path.stops["camera"]] == [0, 100, 101]


def test_a_long_way_is_thinned_evenly_and_never_outgrows_its_bound():
    path = CameraPath()
    for n in range(3 * MAX_STOPS):
        path.walk("left" if n % 2 else "right", seen(n, 0.1 * n))
        assert sum(map(len, path.stops.values())) <= MAX_STOPS
    for sensor in ("left", "right"):
        steps = np.diff(xs(path, sensor))
        assert steps.min() >= path.spacing - 1e-3
        assert steps.max() <= 2 * path.spacing
        assert xs(path, sensor)[0] < 0.2
        assert xs(path, sensor)[-1] > 0.1 * 3 * MAX_STOPS - 2 * path.spacing


def test_a_way_that_is_saved_midway_goes_on_the_same():
    whole, split = CameraPath(), CameraPath()
    random = np.random.default_rng(3)
    x = np.cumsum(random.uniform(0, 0.1, 3 * MAX_STOPS))
    for n in range(len(x)):
        whole.walk("camera", seen(n, x[n]))
        split.walk("camera", seen(n, x[n]))
        if n % 1500 == 0:
            split = CameraPath.loaded(json.loads(json.dumps(split.saved())))
    assert split == whole
    assert len(json.dumps(whole.saved())) < 64 * 1024 * 4


def test_a_map_remembers_where_its_camera_went(tmp_path):
    camera = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5, 0.05)
    mapper = sv.Mapper(voxel_size=0.25)
    wanted = []
    for n in range(5):
        pose = look_at((0.2 * n, 0, 1), (0.2 * n + 2, 0.5, 1), (0, 0, 1))
        depth = np.full((12, 16), np.nan if n == 3 else 2.0, np.float32)
        fault = "no_pose" if n == 3 else None
        report = mapper.add(sv.Frame(depth, camera, pose, stamp_ns=n * 10**9, fault=fault))
        assert (report.refused is None) == (n != 3)
        if n != 3:
            wanted.append(pose)
        if n == 2:
            mapper.map.save(tmp_path / "m")
            mapper = sv.Mapper(resume=sv.load_map(tmp_path / "m"), voxel_size=0.25)
    path = mapper.map.history.path
    assert np.allclose(path.poses("camera"), wanted, atol=1e-6)
    assert len(path.until(2 * 10**9)) == 3
    np.testing.assert_allclose(mapper.map.path, np.array(wanted)[:, :3, 3], atol=1e-6)
    assert sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0]).path.shape == (0, 3)
    copy = mapper.map.history.copied().path
    copy.walk("camera", seen(9, 99.0))
    assert len(path.stops["camera"]) == 4
