# SPDX-License-Identifier: Apache-2.0
"""Calibrations of other tools, written by hand in their formats from one known pair, come back as that pair."""

import json

import cv2
import numpy as np
import pytest

from stereovox.cameras.rigs import Eyes, StereoPair
from stereovox.cameras.wide import Lens
from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.sources.calibration.calibration_files import import_rig

T = np.eye(4)
T[:3, :3], T[:3, 3] = rotation_matrix([0.02, -0.03, 0.01]), (0.12, 0.003, -0.004)
LEFT = Lens("pinhole", 640, 480, 500.0, 501.0, 322.0, 238.0, (-0.3, 0.1, 0.001, -0.0005, 0.01))
RIGHT = Lens("pinhole", 640, 480, 498.0, 499.0, 318.0, 241.0, (-0.28, 0.09, -1e-05, 0.0004, 0.0))
RATIONAL = Lens("pinhole", 640, 480, 500.0, 501.0, 322.0, 238.0, (0.9, 0.4, 0.0007, -0.0004, 0.03, 1.25, 0.6, 0.09))
FISHEYE = Lens("fisheye", 640, 480, 250.0, 251.0, 322.0, 238.0, (-0.02, 0.011, -0.008, 0.0014))


def matrix(lens):
    return np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])


def table(rows, columns, numbers):
    return {"rows": rows, "cols": columns, "data": [float(number) for number in np.ravel(numbers)]}


def info(lens, model, R, shift):
    P = np.column_stack([[[510, 0, 320], [0, 510, 240], [0, 0, 1]], [-510 * shift, 0, 0]])
    return json.dumps(  # every JSON is YAML
        {
            "image_width": lens.width,
            "image_height": lens.height,
            "camera_name": "x",
            "camera_matrix": table(3, 3, matrix(lens)),
            "distortion_model": model,
            "distortion_coefficients": table(1, len(lens.distortion), lens.distortion),
            "rectification_matrix": table(3, 3, R),
            "projection_matrix": table(3, 4, P),
        }
    )


def infos(folder, lens, other, model):
    eyes = Eyes(lens, other, T)
    R_left, R_right = eyes.rectifying_rotations()
    (folder / "l.yaml").write_text(info(lens, model, R_left.T, 0.0))
    (folder / "r.yaml").write_text(info(other, model, R_right.T, eyes.baseline))
    return [folder / "l.yaml", folder / "r.yaml"]


def kalibr(lens, other, distortion, **more):
    def camera(which, extra):
        return {
            "camera_model": "pinhole",
            "intrinsics": [which.fx, which.fy, which.cx, which.cy],
            "distortion_model": distortion,
            "distortion_coeffs": list(which.distortion[:4]),
            "resolution": [which.width, which.height],
            "rostopic": "/x",
            **extra,
        }

    return {"cam0": camera(lens, more), "cam1": camera(other, {"T_cn_cnm1": inverse(T).tolist()})}


def opencv(path, **values):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in values.items():
        storage.write(key, value if isinstance(value, int) else np.asarray(value, float))
    storage.release()
    return path


def both(lens, other):
    named = {"M1": matrix(lens), "D1": [lens.distortion], "M2": matrix(other), "D2": [other.distortion]}
    return {key: np.array(value) for key, value in named.items()}


def places():
    return {"R": inverse(T)[:3, :3], "T": inverse(T)[:3, 3:]}


def check(rig, left, right, T_left_right=T):
    (pair,) = rig.pairs
    assert pair.eyes.left == left
    assert pair.eyes.right == right
    np.testing.assert_allclose(pair.eyes.T_left_right, T_left_right, atol=1e-9)
    return pair


@pytest.mark.parametrize(
    ("lens", "other", "model"),
    [(LEFT, RIGHT, "plumb_bob"), (RATIONAL, RATIONAL, "rational_polynomial"), (FISHEYE, FISHEYE, "equidistant")],
)
def test_camera_info_of_both_eyes(tmp_path, lens, other, model):
    files = infos(tmp_path, lens, other, model)
    check(import_rig(files, name="front"), lens, other)
    assert import_rig(files, name="front").pairs[0].name == "front"
    check(import_rig(files[::-1]), lens, other)  # given the wrong way round


def test_an_echoed_camera_info_message(tmp_path):
    files = infos(tmp_path, LEFT, RIGHT, "plumb_bob")
    for path in files:
        old = json.loads(path.read_text())
        short = {"width": 640, "height": 480, "distortion_model": "plumb_bob"}
        names = {"k": "camera_matrix", "d": "distortion_coefficients", "r": "rectification_matrix"}
        short |= {key: old[name]["data"] for key, name in (names | {"p": "projection_matrix"}).items()}
        path.write_text(json.dumps(short))
    check(import_rig(files), LEFT, RIGHT)


def test_opencv_in_one_file_and_in_two(tmp_path):
    one = opencv(tmp_path / "stereo.yml", **both(LEFT, RIGHT), **places(), image_width=640, image_height=480)
    check(import_rig([one]), LEFT, RIGHT)
    intrinsics = opencv(tmp_path / "intrinsics.yml", **both(LEFT, RIGHT))
    extrinsics = opencv(tmp_path / "extrinsics.yml", **places(), Q=np.eye(4))
    check(import_rig([intrinsics, extrinsics], (640, 480)), LEFT, RIGHT)
    check(import_rig([extrinsics, intrinsics], (640, 480)), LEFT, RIGHT)
    with pytest.raises(SourceError, match="--size"):
        import_rig([intrinsics, extrinsics])
    old = one.read_text().replace("%YAML 1.2", "%YAML:1.0")
    one.write_text(old)
    check(import_rig([one]), LEFT, RIGHT)


def test_opencv_fisheyes_and_lenses_with_too_much(tmp_path):
    sides = both(FISHEYE, FISHEYE)
    path = opencv(tmp_path / "fisheye.yml", **sides, **places())
    check(import_rig([path], (640, 480), "fisheye"), FISHEYE, FISHEYE)
    tilted = opencv(tmp_path / "tilted.yml", **{**sides, "D2": np.full((1, 14), 0.1)}, **places())
    with pytest.raises(SourceError, match="camera 2: a pinhole lens has 8 coefficients, not 14"):
        import_rig([tilted], (640, 480))
    with pytest.raises(SourceError, match="--lens omni"):
        import_rig([path], (640, 480), "omni")


@pytest.mark.parametrize(("model", "lens"), [("radtan", LEFT), ("equidistant", FISHEYE)])
def test_kalibr(tmp_path, model, lens):
    path = tmp_path / "camchain.yaml"
    four = Lens(lens.model, 640, 480, lens.fx, lens.fy, lens.cx, lens.cy, lens.distortion[:4])
    path.write_text(json.dumps(kalibr(four, four, model)))
    pair = check(import_rig([path]), four, four)
    np.testing.assert_array_equal(pair.T_body_left, np.eye(4))
    T_cam_imu = np.eye(4)
    T_cam_imu[:3, 3] = 0.1, 0.2, 0.3
    path.write_text(json.dumps(kalibr(four, four, model, T_cam_imu=T_cam_imu.tolist())))
    np.testing.assert_allclose(import_rig([path]).pairs[0].T_body_left[:3, 3], [-0.1, -0.2, -0.3])


def test_kalibr_with_the_right_eye_first(tmp_path):
    chain = kalibr(LEFT, RIGHT, "radtan")
    chain["cam1"]["T_cn_cnm1"] = T.tolist()
    (tmp_path / "c.yaml").write_text(json.dumps(chain))
    (pair,) = import_rig([tmp_path / "c.yaml"]).pairs
    assert pair.eyes.left.fx == RIGHT.fx
    np.testing.assert_allclose(pair.eyes.T_left_right, T, atol=1e-9)


KITTI = """calib_time: 09-Jan-2012 13:57:47
S_rect_00: 1.242000e+03 3.750000e+02
R_rect_00: 1 0 0 0 1 0 0 0 1
P_rect_00: 7.2e+02 0 6.1e+02 0 0 7.2e+02 1.7e+02 0 0 0 1 0
P_rect_01: 7.2e+02 0 6.1e+02 -3.6e+02 0 7.2e+02 1.7e+02 0 0 0 1 0
S_rect_02: 1.242000e+03 3.750000e+02
P_rect_02: 7.2e+02 0 6.1e+02 7.2e+01 0 7.2e+02 1.7e+02 0 0 0 1 0
P_rect_03: 7.2e+02 0 6.1e+02 -2.88e+02 0 7.2e+02 1.7e+02 0 0 0 1 0
"""


def test_kitti_has_two_rectified_pairs(tmp_path):
    path = tmp_path / "calib_cam_to_cam.txt"
    path.write_text(KITTI)
    grey, colour = import_rig([path]).pairs
    assert (grey.name, grey.left, colour.right) == ("grey", "image_00/data", "image_03/data")
    assert (grey.camera.width, grey.camera.fx, grey.camera.cx) == (1242, 720.0, 610.0)
    assert grey.camera.baseline == pytest.approx(0.5)
    assert colour.camera.baseline == pytest.approx(0.5)
    np.testing.assert_allclose(colour.T_body_left[:3, 3], [-0.1, 0, 0])
    assert isinstance(colour.stereo_pair(), StereoPair)


def test_kitti_odometry_needs_the_size(tmp_path):
    path = tmp_path / "calib.txt"
    lines = [line.replace("P_rect_0", "P") for line in KITTI.splitlines() if line.startswith("P_")]
    path.write_text("\n".join([*lines, "Tr: 1 0 0 0 0 1 0 0 0 0 1 0"]))
    assert [pair.name for pair in import_rig([path], (1241, 376)).pairs] == ["grey", "colour"]
    with pytest.raises(SourceError, match="--size"):
        import_rig([path])


def omni():
    chain = kalibr(LEFT, RIGHT, "radtan")
    chain["cam1"]["camera_model"] = "omni"
    return json.dumps(chain)


def changed(**changes):
    chain = kalibr(LEFT, RIGHT, "radtan")
    chain["cam1"] |= changes
    return json.dumps(chain)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (omni(), "cam1: omni-radtan is not supported .pinhole-radtan, pinhole-equidistant"),
        (changed(distortion_model="fov"), "pinhole-fov is not supported"),
        (changed(T_cn_cnm1=[[1]]), "cam1.T_cn_cnm1 must be 16 numbers"),
        (changed(T_cn_cnm1=np.diag([2.0, 1, 1, 1]).tolist()), "not a rigid motion"),
        (changed(intrinsics=["a"]), "cam1.intrinsics must be 4 numbers"),
        (changed(resolution=None), "cam1.resolution must be 2 numbers"),
        (json.dumps({"cam0": 3}), "no cam1"),
        (json.dumps({"cam0": 3, "cam1": 4}), "cam0 is not a table"),
        (info(LEFT, "plumb_bob", np.eye(3), 0.0), "camera_info of one eye"),
        ("hello: world", "not a stereo calibration of a known kind"),
        ("- a", "holds no table"),
        ("a: [1, 2", "not valid YAML"),
        ("a: !!python/object:os.system x", "not valid YAML"),
    ],
)
def test_each_mistake_is_one_line(tmp_path, text, said):
    path = tmp_path / "file.yaml"
    path.write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        import_rig([path])
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_camera_info_that_is_no_stereo_pair(tmp_path):
    (tmp_path / "l.yaml").write_text(info(LEFT, "plumb_bob", np.eye(3), 0.0))
    with pytest.raises(SourceError, match="no baseline"):
        import_rig([tmp_path / "l.yaml"] * 2)
    (tmp_path / "r.yaml").write_text(info(LEFT, "thin_prism", np.eye(3), 0.1))
    with pytest.raises(SourceError, match="thin_prism"):
        import_rig([tmp_path / "l.yaml", tmp_path / "r.yaml"])
    with pytest.raises(SourceError, match="No such file"):
        import_rig([tmp_path / "none.yaml"])
