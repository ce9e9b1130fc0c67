# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

from dataclasses import replace

import made_pairs as made
import numpy as np
import pytest
from made_recordings import seven_scenes

from stereovox.errors import SourceError
from stereovox.frame import Frame
from stereovox.mapper import Mapper
from stereovox.maps import State
from stereovox.opening import open_source
from stereovox.simulate.d435 import depth_camera
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rigs.pair import CameraPair
from stereovox.sources.rigs.pair_file import PairSettings, pair_text, read_pair

SECONDS, STAMPS = made.times(8, 10)
CAMERAS = [made.waved(t) for t in SECONDS]
TRACK_SECONDS, TRACK_STAMPS = made.times(300, 200, -0.3)


@pytest.fixture(scope="module")
def images():
    return made.depth_images(CAMERAS)


@pytest.fixture(scope="module")
def poses():
    return made.tracker_poses([made.waved(t) for t in TRACK_SECONDS], TRACK_STAMPS)


@pytest.fixture
def recording(tmp_path, images, poses):
    def make(tracker=None, text=None, confidence=None):
        folder = made.write_depth(tmp_path / "flight", images, STAMPS)
        lines = made.tracker_lines(tracker or poses, confidence=confidence)
        (folder / "tracker.txt").write_text(lines)
        (folder / "pair.toml").write_text(made.settings() if text is None else text)
        return folder

    return make


def test_poses_are_those_of_the_camera_at_the_times_of_the_images(recording):
    source = open_source(recording())
    assert isinstance(source, CameraPair)
    assert (source.name, len(source), source.notes) == ("flight", 8, ())
    assert source.camera == replace(source.camera, width=made.WIDTH, baseline=0.05)
    for frame, T, stamp in zip(source, CAMERAS, STAMPS, strict=True):
        assert frame.fault is None
        assert frame.stamp_ns == stamp
        assert frame.depth_scale == 0.001
        np.testing.assert_allclose(frame.T_world_sensor, T, atol=2e-5)  # straight between poses 5 ms apart


def test_every_setting_of_the_geometry_matters(recording):
    right = open_source(recording())
    for wrong in ({"clock_offset_s": made.OFFSET_S + 0.02}, {"T_tracker_camera": np.eye(4)}, {"axes": "optical"}):
        other = open_source(recording(text=made.settings(**wrong)))
        assert np.abs(other.frame(4).T_world_sensor - right.frame(4).T_world_sensor).max() > 5e-3


def test_optical_world_is_the_same_turned(recording):
    up, optical = (
        open_source(recording(text=made.settings(world=w))).frame(3).T_world_sensor for w in ("up", "optical")
    )
    turn = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(optical, turn @ up, atol=1e-9)


def test_a_drifting_clock_is_followed(recording, poses):
    stretched = (poses.stamps_ns[0] + (poses.stamps_ns - poses.stamps_ns[0]) / 1.01).astype(np.int64)
    slow = Poses(stretched, poses.T_world_body)
    source = open_source(recording(slow, made.settings(clock_rate=1.01)))
    np.testing.assert_allclose(source.frame(5).T_world_sensor, CAMERAS[5], atol=3e-5)


def test_low_confidence_refuses_only_what_lies_beside_it(recording):
    confidence = [3] * 300
    hit = 60 + 2 * 20  # 0.2 s: image 2
    confidence[hit + 1] = 1
    confidence[hit + 20 + 1] = 2  # min_confidence 2 is enough
    source = open_source(recording(confidence=confidence))
    assert [frame.fault for frame in source] == [None] * 8  # images coincide with poses: the one after does not count
    confidence[hit] = 1
    source = open_source(recording(confidence=confidence))
    assert [frame.fault for frame in source] == [None, None, "low_confidence"] + [None] * 5
    assert "min_confidence" in source.frame(2).fault_detail
    assert source.frame(2).depth.shape == (source.camera.height, source.camera.width)
    strict = open_source(recording(confidence=confidence, text=made.settings(min_confidence=3)))
    assert [frame.fault for frame in strict][2:4] == ["low_confidence", None]


def test_a_confidence_that_is_no_number_is_none(recording):
    source = open_source(recording(confidence=[3] * 300))
    assert source.frame(2).fault is None
    trust = np.full(300, 3.0)
    trust[60 + 2 * 20] = np.nan  # a damaged message of a recorded file
    source._poses.confidence = trust
    assert [frame.fault for frame in source] == [None, None, "low_confidence"] + [None] * 5


def test_a_jump_beside_a_line_of_no_use_is_a_jump(recording, poses):
    T = poses.T_world_body.copy()
    T[129:, 0, 3] += 0.4
    source = open_source(recording(Poses(poses.stamps_ns, T)))
    folder = source.folder
    lines = (folder / "tracker.txt").read_text().splitlines()
    lines[129] = lines[129].split()[0] + " broken"
    (folder / "tracker.txt").write_text("\n".join(lines))
    again = open_source(folder)
    assert [frame.fault for frame in again] == [frame.fault for frame in source]
    assert "0.40 m" in again.frame(3).fault_detail
    assert "one jump of up to 0.40 m" in again.notes[0]


def test_near_a_jump_frames_are_refused_and_then_count_as_the_tracker_says(recording, poses):
    T = poses.T_world_body.copy()
    T[129:, 0, 3] += 0.4  # between 0.34 and 0.345 s
    source = open_source(recording(Poses(poses.stamps_ns, T)))
    faults = [frame.fault for frame in source]
    assert faults == [None, None, None, "pose_jump", "pose_jump", None, None, None]
    assert "0.40 m" in source.frame(3).fault_detail
    assert "one jump of up to 0.40 m" in source.notes[0]
    np.testing.assert_allclose(source.frame(6).T_world_sensor[:3, 3], CAMERAS[6][:3, 3] + [0.4, 0, 0], atol=1e-4)
    calm = open_source(recording(Poses(poses.stamps_ns, T), made.settings(max_speed_mps=200.0)))
    assert [frame.fault for frame in calm] == [None] * 8


def test_a_gap_in_the_poses_refuses_what_lies_in_it(recording, poses):
    keep = (poses.stamps_ns < STAMPS[3] - 95_000_000) | (poses.stamps_ns > STAMPS[3] + 110_000_000)
    source = open_source(recording(Poses(poses.stamps_ns[keep], poses.T_world_body[keep])))
    assert [frame.fault for frame in source].count("no_pose") == 2
    assert source.frame(3).fault == "no_pose"


def test_a_damaged_image_keeps_its_own_fault(recording):
    folder = recording()
    first = sorted((folder / "depth").iterdir())[0]
    first.write_bytes(first.read_bytes()[:100])
    assert [frame.fault for frame in open_source(folder)] == ["unreadable"] + [None] * 7


def test_clocks_without_common_time_end_in_one_line(recording):
    with pytest.raises(SourceError, match="clocks do not overlap") as caught:
        open_source(recording(text=made.settings(clock_offset_s=0.0)))
    said = str(caught.value)
    assert "\n" not in said
    assert "1700000000.000000000" in said  # the images
    assert "1699998765.132200000" in said  # the tracker
    assert "clock_offset_s" in said
    assert "stereovox calibrate pair" in said


def test_extrinsics_must_be_known(recording):
    with pytest.raises(SourceError, match=r"T_tracker_camera is missing.*stereovox calibrate pair"):
        open_source(recording(text="axes = 'opengl'\n"))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("T_tracker_camrea = 3", "did you mean 'T_tracker_camera'"),
        ("T_tracker_camera = [[1, 0], [0, 1]]", "four rows"),
        ("T_tracker_camera = [[1,0,0,0],[0,1,0,0],[0,0,-1,0],[0,0,0,1]]", "four rows"),
        ("T_tracker_camera = 'none'", "four rows"),
        ("axes = 'open'", "did you mean 'opengl'"),
        ("world = 1", "must be a string"),
        ("clock_offset_s = 'soon'", "must be a number"),
        ("clock_offset_s = nan", "must be a number"),
        ("clock_rate = 2.0", "must be a number from 0.9 to 1.1"),
        ("max_speed_mps = true", "must be a number"),
        ("min_confidence = 4", "from 0 to 3"),
        ("poses = ''", "must be a string"),
        ("depth = ", "end of document"),
    ],
)
def test_slips_in_the_file_are_named(tmp_path, text, said):
    (tmp_path / "pair.toml").write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        read_pair(tmp_path / "pair.toml")
    assert "pair.toml: " in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("key", "value"), [("depth", "nowhere"), ("poses", "nowhere.txt")])
def test_what_is_not_there_is_named(recording, key, value):
    with pytest.raises(SourceError, match="nowhere") as caught:
        open_source(recording(text=made.settings(**{key: value})))
    assert "\n" not in str(caught.value)


def test_what_is_written_is_read_again(tmp_path):
    written = PairSettings(
        depth='odd "name"\\é',
        poses="t\t1.txt",
        T_tracker_camera=made.T_TRACKER_CAMERA,
        clock_offset_s=-1.7e9 + 0.123456,
    )
    (tmp_path / "pair.toml").write_text(pair_text(written, ("made by hand",)))
    found = read_pair(tmp_path / "pair.toml")
    for key, value in vars(written).items():
        if key == "T_tracker_camera":
            np.testing.assert_allclose(getattr(found, key), value, atol=1e-8)
        else:
            assert getattr(found, key) == value, key


def test_depth_may_be_any_recording_and_its_own_poses_do_not_count(tmp_path, poses):
    folder = seven_scenes(tmp_path / "kitchen")
    stamps = np.arange(0, 200_000_000, 5_000_000)
    (tmp_path / "tracker.txt").write_text(made.tracker_lines(Poses(stamps, poses.T_world_body[: len(stamps)]), 0.0))
    (tmp_path / "pair.toml").write_text(made.settings(depth="kitchen", clock_offset_s=0.0, depth_scale=None))
    source = open_source(tmp_path)
    assert len(source) == 4
    assert source.frame(0).fault is None
    expected = poses.T_world_body[0] @ made.T_TRACKER_CAMERA
    np.testing.assert_allclose(source.frame(0).T_world_sensor, expected, atol=1e-6)
    assert folder.is_dir()


def test_a_pair_comes_before_poses_that_lie_beside_it(recording):
    folder = recording()
    (folder / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert isinstance(open_source(folder), CameraPair)


def test_the_map_is_that_of_the_true_poses(recording, images):
    found, true = (Mapper(voxel_size=0.1, max_range=4.0) for _ in range(2))
    camera = replace(depth_camera(made.WIDTH), baseline=0.05)
    for frame in open_source(recording()):
        assert found.add(frame).refused is None
    for image, T in zip(images, CAMERAS, strict=True):
        assert true.add(Frame(image, camera, T, depth_scale=0.001)).refused is None
    cells = true.map.occupied()
    assert len(cells) > 300
    same = found.map.state(cells) == State.OCCUPIED
    assert same.mean() > 0.995
    assert abs(len(found.map.occupied()) / len(cells) - 1) < 0.005
