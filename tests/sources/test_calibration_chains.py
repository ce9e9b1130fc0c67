# SPDX-License-Identifier: Apache-2.0
"""Calibrations of visual-inertial odometry, written by hand from one known pair on a body, come back as that pair."""

import json

import numpy as np
import pytest
from made_asl import sensor_text
from made_rigs import FORWARD

from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens
from stereovox.errors import SourceError
from stereovox.geometry.se3 import inverse, rotation_matrix
from stereovox.sources.calibration.calibration_files import import_rig

T = np.eye(4)
T[:3, :3], T[:3, 3] = rotation_matrix([0.02, -0.03, 0.01]), (0.12, 0.003, -0.004)
MOUNTS = (FORWARD, FORWARD @ T)
LEFT = Lens("pinhole", 640, 480, 500.0, 501.0, 322.0, 238.0, (-0.3, 0.1, 0.001, -0.0005))
RIGHT = Lens("pinhole", 640, 480, 498.0, 499.0, 318.0, 241.0, (-0.28, 0.09, -1e-05, 0.0004))
FISHEYE = Lens("fisheye", 640, 480, 250.0, 251.0, 322.0, 238.0, (-0.02, 0.011, -0.008, 0.0014))
NARROW, WIDE = (LEFT, RIGHT), (FISHEYE, FISHEYE)
FOCAL = ("fx", "fy", "cx", "cy")


def focal(lens):
    return [lens.fx, lens.fy, lens.cx, lens.cy]


def check(rig, lenses, T_body_left=FORWARD):
    (pair,) = rig.pairs
    assert (pair.eyes.left, pair.eyes.right) == lenses
    np.testing.assert_allclose(pair.eyes.T_left_right, T, atol=1e-7)
    np.testing.assert_allclose(pair.T_body_left, T_body_left, atol=1e-7)


def saved(folder, text, name="calibration.yaml"):
    (folder / name).write_text(text if isinstance(text, str) else json.dumps(text))
    return [folder / name]


def opencv(name, matrix):
    """A matrix as OpenCV's FileStorage writes it, though without the blank after `data:`."""
    rows, columns = np.shape(matrix)
    numbers = "\n      ".join(", ".join(f"{number:.12g}" for number in row) for row in matrix)  # commas forgotten
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data:[{numbers}]\n"


def kalibr(lenses, places, model="radtan"):
    def camera(lens, place):
        return {
            "camera_model": "pinhole",
            "intrinsics": focal(lens),
            "distortion_model": model,
            "distortion_coeffs": list(lens.distortion),
            "resolution": [lens.width, lens.height],
            "cam_overlaps": [0],
            **place,
        }

    return {f"cam{i}": camera(lens, place) for i, (lens, place) in enumerate(zip(lenses, places, strict=True))}


def to_body(mounts=MOUNTS):
    return [{"T_imu_cam": mount.tolist()} for mount in mounts]


def to_cameras(mounts=MOUNTS):
    return [{"T_cam_imu": inverse(mount).tolist()} for mount in mounts]


@pytest.mark.parametrize("places", [to_body(), to_cameras(), [to_body()[0], to_cameras()[1]]])
def test_kalibr_chains_without_a_relative_pose(tmp_path, places):
    text = "%YAML:1.0 # of OpenCV\n" + json.dumps(kalibr(WIDE, places, "equidistant"))
    check(import_rig(saved(tmp_path, text)), WIDE)
    check(import_rig(saved(tmp_path, kalibr(NARROW[::-1], places[::-1]))), NARROW)  # the right eye is cam0


def test_kalibrs_own_relative_pose_comes_first(tmp_path):
    elsewhere = FORWARD @ np.array([[1.0, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    chain = kalibr(NARROW, to_body((FORWARD, elsewhere)))
    chain["cam1"]["T_cn_cnm1"] = inverse(T).tolist()
    check(import_rig(saved(tmp_path, chain)), NARROW)


def test_one_mount_is_enough_where_the_right_eye_is_first(tmp_path):
    chain = kalibr(NARROW[::-1], [to_body()[1], {"T_cn_cnm1": T.tolist()}])
    check(import_rig(saved(tmp_path, chain)), NARROW)


@pytest.mark.parametrize(
    ("lenses", "model"), [(NARROW, "radial-tangential"), (NARROW, "radtan"), (WIDE, "equidistant")]
)
def test_two_sensor_yaml(tmp_path, lenses, model):
    files = [
        saved(tmp_path, sensor_text(lens, mount, model), f"cam{i}.yaml")[0]
        for i, (lens, mount) in enumerate(zip(lenses, MOUNTS, strict=True))
    ]
    check(import_rig(files), lenses)
    check(import_rig(files[::-1]), lenses)
    with pytest.raises(SourceError, match=r"is the sensor\.yaml of one camera; give both files"):
        import_rig(files[:1])


def test_okvis(tmp_path):
    cameras = [
        {
            "T_SC": mount.ravel().tolist(),
            "image_dimension": [lens.width, lens.height],
            "distortion_coefficients": list(lens.distortion),
            "distortion_type": "radialtangential",
            "focal_length": [lens.fx, lens.fy],
            "principal_point": [lens.cx, lens.cy],
        }
        for lens, mount in zip(NARROW, MOUNTS, strict=True)
    ]
    check(import_rig(saved(tmp_path, "%YAML:1.0\n" + json.dumps({"cameras": cameras}))), NARROW)
    with pytest.raises(SourceError, match="lists one camera"):
        import_rig(saved(tmp_path, {"cameras": cameras[:1]}))


def vins(folder, lenses):
    for name, lens in zip(("left.yaml", "right.yaml"), lenses, strict=True):
        table = {"image_width": lens.width, "image_height": lens.height}
        k = lens.distortion
        if lens.model == "pinhole":
            table |= {"model_type": "PINHOLE", "projection_parameters": dict(zip(FOCAL, focal(lens), strict=True))}
            table["distortion_parameters"] = dict(zip(("k1", "k2", "p1", "p2"), k, strict=True))
        else:
            names = ("mu", "mv", "u0", "v0", "k2", "k3", "k4", "k5")
            table |= {"model_type": "KANNALA_BRANDT"}
            table["projection_parameters"] = dict(zip(names, [*focal(lens), *k], strict=True))
        saved(folder, "%YAML:1.0\n---\n" + json.dumps(table), name)
    text = '%YAML:1.0\nimu: 1\ncam0_calib: "left.yaml"\ncam1_calib: "right.yaml"\n'
    return saved(folder, text + opencv("body_T_cam0", MOUNTS[0]) + opencv("body_T_cam1", MOUNTS[1]))


@pytest.mark.parametrize("lenses", [NARROW, WIDE])
def test_vins_fusion(tmp_path, lenses):
    files = vins(tmp_path, lenses)
    check(import_rig(files), lenses)
    with pytest.raises(SourceError, match="one lens of VINS-Fusion; give the settings that name it"):
        import_rig([tmp_path / "left.yaml"])
    saved(tmp_path, "model_type: MEI", "right.yaml")
    with pytest.raises(SourceError, match=r"right\.yaml: model_type 'MEI' is not supported \(PINHOLE, KANN"):
        import_rig(files)
    (tmp_path / "left.yaml").unlink()
    with pytest.raises(SourceError, match=r"left\.yaml: No such file"):
        import_rig(files)


def orb(kind, lenses, **more):
    lines = ["%YAML:1.0", f'Camera.type: "{kind}"', "Camera.width: 640", "Camera.height: 480", "Viewer.PointSize:2"]
    names = ("k1", "k2", "p1", "p2") if kind == "PinHole" else ("k1", "k2", "k3", "k4")
    for number, lens in enumerate(lenses, 1):
        values = zip((*FOCAL, *names), [*focal(lens), *lens.distortion], strict=False)
        lines += [f"Camera{number}.{key}: {value}" for key, value in values]
    lines += [f"{key}: {value}" for key, value in more.items()]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(("kind", "lenses"), [("PinHole", NARROW), ("KannalaBrandt8", WIDE)])
def test_orb_slam3(tmp_path, kind, lenses):
    text = orb(kind, lenses) + opencv("Stereo.T_c1_c2", T)
    check(import_rig(saved(tmp_path, text)), lenses, np.eye(4))
    check(import_rig(saved(tmp_path, text + opencv("IMU.T_b_c1", FORWARD))), lenses)
    with pytest.raises(SourceError, match=r"Stereo\.T_c1_c2 is missing"):
        import_rig(saved(tmp_path, orb(kind, lenses)))
    with pytest.raises(SourceError, match=r"Camera\.type \w+ without Camera2\.fx has one lens"):
        import_rig(saved(tmp_path, orb(kind, lenses[:1])))
    with pytest.raises(SourceError, match="for a depth camera"):
        import_rig(saved(tmp_path, orb(kind, lenses[:1], **{"RGBD.DepthMapFactor": 5000})))


def test_orb_slam3_with_rectified_images(tmp_path):
    (pair,) = import_rig(saved(tmp_path, orb("Rectified", [LEFT], **{"Stereo.b": 0.12}))).pairs
    assert pair.eyes is None
    assert (pair.camera.fx, pair.camera.fy, pair.camera.baseline) == (500, 501, 0.12)
    text = orb("PinHole", [Lens("pinhole", 640, 480, 500.0, 500.0, 322.0, 238.0)], **{"Camera.bf": 60})
    old = text.replace("Camera1.", "Camera.")
    assert import_rig(saved(tmp_path, old)).pairs[0].camera.baseline == pytest.approx(0.12)


def test_orb_slam_with_a_rectification(tmp_path):
    eyes = Eyes(LEFT, RIGHT, T)
    text = orb("PinHole", [])
    for eye, lens, R, shift in zip(
        ("LEFT", "RIGHT"), NARROW, eyes.rectifying_rotations(), (0, eyes.baseline), strict=True
    ):
        K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1]])
        P = np.column_stack([[[510, 0, 320], [0, 510, 240], [0, 0, 1]], [-510 * shift, 0, 0]])
        text += f"{eye}.width: 640\n{eye}.height: 480\n" + opencv(f"{eye}.D", [lens.distortion])
        text += opencv(f"{eye}.K", K) + opencv(f"{eye}.R", R.T) + opencv(f"{eye}.P", P)
    check(import_rig(saved(tmp_path, text)), NARROW, np.eye(4))


def basalt(kind="kb4"):
    half = np.sqrt(0.5)
    place = {"px": 1.0, "py": 2.0, "pz": 3.0, "qx": 0.0, "qy": 0.0, "qz": half, "qw": half}
    right = {**place, "py": 2.1}  # 90 degrees about z: the camera's x is the body's y
    names = dict(zip((*FOCAL, "k1", "k2", "k3", "k4"), [*focal(FISHEYE), *FISHEYE.distortion], strict=True))
    camera = {"camera_type": kind, "intrinsics": names}
    return {"value0": {"T_imu_cam": [place, right], "intrinsics": [camera] * 2, "resolution": [[640, 480]] * 2}}


def test_basalt(tmp_path):
    (pair,) = import_rig(saved(tmp_path, basalt())).pairs
    assert pair.eyes.left == FISHEYE
    np.testing.assert_allclose(pair.eyes.T_left_right[:3, 3], [0.1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(pair.T_body_left[:3], [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3]], atol=1e-9)
    with pytest.raises(SourceError, match=r"intrinsics\[0\]: camera_type 'ds' is not supported"):
        import_rig(saved(tmp_path, basalt("ds")))


CONTRADICTION = [{**to_body()[0], "T_cam_imu": FORWARD.tolist()}, to_body()[1]]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        (kalibr(NARROW, [{}, {}]), "cam1.T_cn_cnm1 is missing, and cam0 has neither T_cam_imu nor T_imu_cam"),
        (kalibr(NARROW, [to_body()[0], {}]), "and cam1 has neither"),
        (kalibr(NARROW, CONTRADICTION), "cam0: T_imu_cam is not the inverse of T_cam_imu; remove the wrong one"),
        (kalibr(NARROW[:1], to_body()[:1]), "has cam0 but no cam1, so there is no stereo"),
        (kalibr(NARROW, to_body(), "fov"), "cam0: pinhole-fov is not supported"),
        ({"cameras": [{"T_SC": 1}, 2]}, r"cameras\[0\]\.focal_length is missing"),
        ({"cameras": [1, 2]}, r"cameras\[0\]\.focal_length is missing"),
        ({"cam0_calib": "x"}, "has cam0_calib but no cam1_calib"),
        ({"value0": {}}, "value0.T_imu_cam is missing"),
        ({"value0": {"T_imu_cam": [1], "intrinsics": 1, "resolution": 2}}, "lists one camera"),
        ({"T_BS": [1], "intrinsics": 2}, "sensor.yaml of one camera"),
        ({"Camera.type": "PinHole"}, "Camera.type PinHole without Camera2.fx has one lens"),
        ({"Camera.type": "Rectified"}, "Camera.width is missing"),
        ({"LEFT.K": 1}, "LEFT.width is missing"),
    ],
)
def test_each_mistake_is_one_line(tmp_path, table, said):
    with pytest.raises(SourceError, match=said) as caught:
        import_rig(saved(tmp_path, table))
    line = str(caught.value)
    assert line.startswith(str(tmp_path / "calibration.yaml"))
    assert "\n" not in line
    assert len(line.replace(str(tmp_path), "")) < 250
