# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse, rotation_vector
from stereovox.opening import open_depth
from stereovox.simulate.recorder import MOUNT, START_NS, record
from stereovox.simulate.simulation import Simulation
from stereovox.simulate.t265 import T265, Drift
from stereovox.sources.rigs.pair import CameraPair
from stereovox.sources.rigs.pair_file import read_pair

STEADY = T265(
    drift=Drift(share=0, yaw_deg=0), jitter_m=0, jitter_deg=0, clock_offset_s=-3.2, clock_drift_ppm=40, settle_s=0.1
)


@pytest.fixture(scope="module")
def simulation():
    return Simulation("sim:flight?length=30&speed=3&image_width=64")


@pytest.fixture(scope="module")
def recorded(simulation, tmp_path_factory):
    return record(simulation, tmp_path_factory.mktemp("pair") / "new", STEADY)


def test_a_pair_read_back_has_the_true_poses(simulation, recorded):
    pair = CameraPair(recorded.folder, open_depth)
    assert len(pair) == len(simulation)
    truth = simulation.stage.moved(recorded.T_map_world)
    for i in range(0, len(pair), 23):
        frame = pair.frame(i)
        assert frame.fault is None, frame.fault_detail
        off = inverse(truth.path(i / (len(pair) - 1))) @ frame.T_world_sensor
        assert np.linalg.norm(off[:3, 3]) < 5e-4
        assert np.linalg.norm(rotation_vector(off[:3, :3])) < 5e-4
        assert frame.stamp_ns == START_NS + simulation.frame(i).stamp_ns


def test_the_map_begins_at_the_tracker_and_is_level(simulation, recorded):
    first = recorded.T_map_world @ simulation.upright_pose_at(0)
    np.testing.assert_allclose(first[:3, 3], MOUNT[:3, 3], atol=3e-3)
    np.testing.assert_allclose(recorded.T_map_world[:3, :3] @ [0, 0, 1], [0, -1, 0], atol=1e-12)


def test_images_are_the_cameras_in_millimetres(simulation, recorded):
    pair = CameraPair(recorded.folder, open_depth)
    frame, true = pair.frame(11), simulation.frame(11)
    np.testing.assert_array_equal(frame.depth, true.depth)
    assert frame.depth_scale == true.depth_scale == 0.001
    assert pair.camera == simulation.camera


def test_exact_depth_is_rounded_to_millimetres(tmp_path):
    simulation = Simulation("sim:wall?distance=1.2345&noise=0&image_width=32&frames=2")
    record(simulation, tmp_path, STEADY)
    image = cv2.imread(str(next((tmp_path / "depth").iterdir())), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert np.isin(image, [1234, 1235]).all()


def test_what_is_to_be_found_out_is_left_out(simulation, tmp_path):
    record(Simulation("sim:box?image_width=32&frames=3"), tmp_path / "a", STEADY, calibrated=False, world="up")
    settings = read_pair(tmp_path / "a" / "pair.toml")
    assert settings.T_tracker_camera is None
    assert (settings.clock_offset_s, settings.clock_rate, settings.world) == (0, 1, "up")


def test_a_folder_that_holds_something_is_refused(simulation, tmp_path: Path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SourceError, match="is not empty"):
        record(simulation, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
