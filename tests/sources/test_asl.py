# SPDX-License-Identifier: Apache-2.0
"""EuRoC / ASL folders: frames with the pose of the rectified left eye, and what is missing is named."""

import json
import shutil

import numpy as np
import pytest
from made_asl import START, STEP, asl, matrix_text, poses_csv
from made_recordings import write_png
from made_rigs import FORWARD, eyes, picture, poses_text

from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.cameras.wide import Lens
from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse
from stereovox.opening import open_source
from stereovox.sources.asl import AslRig

TURNED = np.array([[0.0, -1, 0, 0], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
"""T_world_body of `poses_csv` at x = 0."""


def same_pair(found: StereoPair, expected: Eyes) -> None:
    assert found.eyes is not None
    assert (found.eyes.left, found.eyes.right) == (expected.left, expected.right)
    np.testing.assert_allclose(found.eyes.T_left_right, expected.T_left_right, atol=1e-9)


def test_a_euroc_folder_opens_by_either_name(tmp_path):
    folder = asl(tmp_path / "MH_01_easy")
    source = open_source(folder)
    assert isinstance(source, AslRig)
    assert source.name == "MH_01_easy"
    assert open_source(folder, frames=":1").up == source.up == "z", (
        "the data sets' own ground truth is upright, however the camera was held"
    )
    assert isinstance(open_source(folder / "mav0"), AslRig)
    frames = list(source)
    assert [(frame.stamp_ns, frame.fault) for frame in frames] == [(START, None), (START + STEP, None)]
    np.testing.assert_array_equal(frames[1].left, picture(2, (48, 36)))
    np.testing.assert_array_equal(frames[1].right, picture(3, (48, 36)))
    same_pair(frames[0].pair, eyes())


def test_the_pose_is_that_of_the_rectified_left_eye(tmp_path):
    first, second = open_source(asl(tmp_path))
    expected = TURNED @ FORWARD
    raw = first.T_world_sensor @ inverse(first.pair.T_body_camera) @ FORWARD
    expected[0, 3] += 0.5  # halfway from x = 0 to 1
    np.testing.assert_allclose(raw, expected, atol=1e-6)
    assert first.T_world_sensor[2, 2] == pytest.approx(0, abs=0.05), "the camera looks along the horizon: z is up"
    moved = second.T_world_sensor[:3, 3] - first.T_world_sensor[:3, 3]
    np.testing.assert_allclose(moved, [30 / 50 + 0.5, 0, 0], atol=0.2)


def test_narrow_lenses_become_a_pinhole_and_rectify_chooses(tmp_path):
    lens = Lens("pinhole", 48, 36, 40.0, 40.5, 23.0, 18.0, (-0.2, 0.05, 0.001, -0.0005))
    narrow = Eyes(lens, lens, eyes().T_left_right)
    folder = asl(tmp_path, narrow, distortion="radial-tangential")
    (frame, _) = open_source(folder)
    same_pair(frame.pair, narrow)
    assert type(frame.pair.camera).__name__ == "PinholeCamera"
    wide = open_source(f"{folder}?rectify=cylindrical")
    assert type(wide.frame(0).pair.camera).__name__ == "CylindricalCamera"
    with pytest.raises(SourceError, match="unknown parameter 'rectfy'"):
        open_source(f"{folder}?rectfy=pinhole")
    with pytest.raises(SourceError, match=r"cam0: .*unknown model 'round'"):
        open_source(f"{folder}?rectify=round")


def test_eyes_in_the_other_order(tmp_path):
    folder = asl(tmp_path)
    (folder / "mav0/cam0").rename(folder / "mav0/x")
    (folder / "mav0/cam1").rename(folder / "mav0/cam0")
    (folder / "mav0/x").rename(folder / "mav0/cam1")
    frame = open_source(folder).frame(0)
    same_pair(frame.pair, eyes())
    np.testing.assert_array_equal(frame.left, picture(0, (48, 36)))


def test_tum_vi_has_a_camchain_motion_capture_and_16_bits(tmp_path):
    folder = asl(tmp_path / "dataset-room1_512_16", truth="mocap0")
    chain = {}
    T_right_left = inverse(eyes().T_left_right)
    for side, lens in enumerate((eyes().left, eyes().right)):
        (folder / f"mav0/cam{side}/sensor.yaml").unlink()
        T_cam_imu = inverse(FORWARD) if side == 0 else T_right_left @ inverse(FORWARD)
        chain[f"cam{side}"] = {
            "T_cam_imu": T_cam_imu.tolist(),
            "camera_model": "pinhole",
            "intrinsics": [lens.fx, lens.fy, lens.cx, lens.cy],
            "distortion_model": "equidistant",
            "distortion_coeffs": list(lens.distortion),
            "resolution": [lens.width, lens.height],
        }
    with pytest.raises(SourceError, match=r"cam0/sensor\.yaml: no such file; .*camchain\.yaml"):
        open_source(folder)
    (folder / "dso").mkdir()
    (folder / "dso/camchain.yaml").write_text(json.dumps(chain))
    deep = picture(0, (48, 36)).astype(np.uint16) * 256 + 77
    write_png(folder / f"mav0/cam0/data/{START}.png", deep)
    frame = open_source(folder).frame(0)
    assert frame.fault is None
    np.testing.assert_array_equal(frame.left, picture(0, (48, 36)))
    same_pair(frame.pair, eyes())
    np.testing.assert_allclose(frame.pair.T_body_camera[:3, 3], FORWARD[:3, 3], atol=1e-9)


def test_poses_of_a_marker_are_moved_to_the_body(tmp_path):
    folder = asl(tmp_path, truth="vicon0")
    plain = open_source(folder).frame(0).T_world_sensor
    T_body_marker = np.eye(4)
    T_body_marker[:3, 3] = 0.0, 0.0, 0.25
    (folder / "mav0/vicon0/sensor.yaml").write_text(f"%YAML:1.0\nT_BS:\n{matrix_text(T_body_marker)}")
    moved = open_source(folder).frame(0).T_world_sensor
    np.testing.assert_allclose(moved[:3, 3] - plain[:3, 3], [0, 0, -0.25], atol=1e-9)


def test_a_header_that_puts_w_last_is_heeded(tmp_path):
    folder = asl(tmp_path)
    path = folder / "mav0/state_groundtruth_estimate0/data.csv"
    before = open_source(folder).frame(0).T_world_sensor
    lines = [line.split(",") for line in path.read_text().split()[-3:]]
    moved = [",".join([*w[:4], *w[5:8], w[4]]) for w in lines]
    path.write_text("\n".join(["timestamp,p_x,p_y,p_z,q_x,q_y,q_z,q_w", *moved]))
    np.testing.assert_allclose(open_source(folder).frame(0).T_world_sensor, before, atol=1e-9)


def test_excerpts_and_slightly_different_times(tmp_path):
    folder = asl(tmp_path)
    with (folder / "mav0/cam0/data.csv").open("a") as file:
        file.write(f"{START + 9 * STEP},{START + 9 * STEP}.png\n")
    for i in range(2):
        stamp = START + i * STEP
        later = stamp + (300_000 if i == 0 else 30_000_000)
        (folder / f"mav0/cam1/data/{stamp}.png").rename(folder / f"mav0/cam1/data/{later}.png")
    (folder / "mav0/cam1/data.csv").unlink()
    source = open_source(folder)
    assert [frame.fault for frame in source] == [None, "missing_file"]
    assert "lists 3 images, 1 of them are missing" in "\n".join(source.notes)


def test_a_bad_line_of_poses_costs_the_frames_beside_it(tmp_path):
    folder = asl(tmp_path)
    path = folder / "mav0/state_groundtruth_estimate0/data.csv"
    lines = path.read_text().split("\n")
    path.write_text("\n".join([*lines[:-2], f"{START + STEP + 20_000_000},1,2", ""]))
    frames = list(open_source(folder))
    assert [frame.fault for frame in frames] == [None, "bad_pose_file"]
    assert "data.csv:" in frames[1].fault_detail


def test_poses_in_tum_format(tmp_path):
    folder = asl(tmp_path)
    shutil.rmtree(folder / "mav0/state_groundtruth_estimate0")
    (folder / "mav0/groundtruth.txt").write_text(
        f"{START / 1e9:.9f} 1 2 3 0 0 0 1\n{(START + 2 * STEP) / 1e9:.9f} 1 2 3 0 0 0 1"
    )
    assert open_source(folder).up is None
    frame = open_source(folder).frame(1)
    assert frame.fault is None
    np.testing.assert_allclose(frame.T_world_sensor[:3, 3], FORWARD[:3, 3] + [1, 2, 3], atol=1e-6)


def remove(name):
    return lambda mav0: shutil.rmtree(mav0 / name)


def write(name, text):
    return lambda mav0: (mav0 / name).write_text(text)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (remove("cam1"), r"mav0: has cam0 but no cam1; copy it there, stereo needs both"),
        (lambda mav0: (mav0 / "cam1/sensor.yaml").unlink(), r"cam1/sensor\.yaml: no such file; put it there"),
        (
            remove("state_groundtruth_estimate0"),
            r"mav0: no poses of the vehicle; put state_groundtruth_estimate0/data\.csv",
        ),
        (remove("cam0/data"), r"cam0: holds no PNG; copy the images of cam0 there"),
        (write("cam0/data.csv", "5,none.png\n"), r"data\.csv: none of its 1 images is in .*data; copy them there"),
        (write("cam0/data.csv", "5.5,none.png\n6.5,b.png"), r"data\.csv:2: '6\.5' is not a time in whole nanoseconds"),
        (write("cam0/data.csv", f"{START},../x.png\n"), r"data\.csv:1: '\.\./x\.png' leads out"),
        (write("state_groundtruth_estimate0/data.csv", poses_csv([5, 6])), "no time in common"),
        (write("state_groundtruth_estimate0/data.csv", "\n\n"), "holds no pose"),
        (write("state_groundtruth_estimate0/sensor.yaml", "T_BS: [1, 2]"), r"sensor\.yaml: T_BS must be 16 numbers"),
        (
            write("cam0/sensor.yaml", "T_BS: [1]\ncamera_model: omni"),
            r"cam0/sensor\.yaml: the first camera_model 'omni'",
        ),
    ],
)
def test_what_is_missing_or_wrong_is_named_in_one_line(tmp_path, spoil, said):
    folder = asl(tmp_path)
    spoil(folder / "mav0")
    with pytest.raises(SourceError, match=said) as caught:
        open_source(folder)
    line = str(caught.value).replace(str(tmp_path), "")
    assert "\n" not in line
    assert len(line) <= 250


def test_positions_alone_are_no_poses(tmp_path):
    folder = asl(tmp_path)
    (folder / "mav0/state_groundtruth_estimate0").rename(folder / "mav0/leica0")
    with pytest.raises(SourceError, match="leica0 has positions but no orientations; put state_groundtruth"):
        open_source(folder)
    (folder / "poses.txt").write_text(poses_text(START, START + STEP))
    assert len(open_source(folder)) == 2


def with_imu(folder, lines, T_BS=None):
    place = asl(folder) / "mav0/imu0"
    place.mkdir()
    (place / "data.csv").write_text("#timestamp [ns],w_RS_S_x [rad s^-1],...\n" + "\n".join(lines) + "\n")
    if T_BS is not None:
        (place / "sensor.yaml").write_text(f"sensor_type: imu\nT_BS:\n{matrix_text(T_BS)}rate_hz: 200\n")
    return folder


def test_an_imu_is_read_and_mounted_as_its_file_says(tmp_path):
    T_body_imu = inverse(FORWARD)
    lines = [f"{START + k},{k}.5,2,3,4,5,{k}" for k in range(3)]
    source = open_source(with_imu(tmp_path / "a", lines, T_body_imu))
    found = source.imu()
    np.testing.assert_array_equal(found.stamps_ns, START + np.arange(3))
    np.testing.assert_array_equal(found.angular_rate, [[0.5, 2, 3], [1.5, 2, 3], [2.5, 2, 3]])
    np.testing.assert_array_equal(found.specific_force, [[4, 5, 0], [4, 5, 1], [4, 5, 2]])
    np.testing.assert_allclose(found.T_sensor_imu, inverse(source.pairs[0].T_body_camera) @ T_body_imu, atol=1e-9)
    body = open_source(with_imu(tmp_path / "b", lines)).imu()
    np.testing.assert_allclose(body.T_sensor_imu, inverse(source.pairs[0].T_body_camera), atol=1e-9)


def test_an_imu_can_be_left_out_and_a_damaged_one_says_so(tmp_path):
    lines = [f"{START},1,2,3,4,5,6", f"{START + 1},1,2,3,4,5,six", f"{START + 2},1,2,3,4,5,6"]
    folder = with_imu(tmp_path / "a", lines)
    assert len(open_source(folder).imu()) == 2
    assert open_source(f"{folder}?imu=off").imu() is None
    with pytest.raises(SourceError, match="imu=on must be off"):
        open_source(f"{folder}?imu=on")
    with pytest.raises(SourceError, match="is not a time in whole nanoseconds"):
        open_source(with_imu(tmp_path / "b", ["soon,1,2,3,4,5,6"])).imu()
    assert open_source(asl(tmp_path / "c")).imu() is None
