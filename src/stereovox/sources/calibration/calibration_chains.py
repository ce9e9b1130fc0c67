# SPDX-License-Identifier: Apache-2.0
"""Stereo calibrations in the formats of visual-inertial odometry: each camera with its pose on a body.

Kalibr (also as OpenVINS writes it), sensor.yaml of EuRoC (also Kimera's), OKVIS, VINS-Fusion, ORB-SLAM3 and Basalt.
In all of them `T_a_b` maps b into a, though names differ: Kalibr's T_cam_imu maps the body into the camera; T_imu_cam
(OpenVINS, Basalt), T_BS (EuRoC), T_SC (OKVIS), body_T_cam (VINS-Fusion) and T_b_c1 (ORB-SLAM3) map the camera into the
body.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import Lens
from stereovox.errors import SourceError
from stereovox.files.safe_io import shown
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.calibration.calibration_values import (
    StereoCalibration,
    Table,
    from_rectification,
    intrinsics_of,
    lens_model,
    lens_of,
    matrix,
    numbers,
    of_eyes,
    of_mounts,
    read_yaml,
    rigid,
)
from stereovox.sources.poses.trajectory import transforms

KALIBR = ("pinhole-radtan", "pinhole-equidistant", "pinhole-none")
PLACES = ("T_cam_imu", "T_imu_cam")
FOCAL = ("fx", "fy", "cx", "cy")
VINS = {
    "PINHOLE": ("pinhole", FOCAL, ("k1", "k2", "p1", "p2")),
    "KANNALA_BRANDT": ("fisheye", ("mu", "mv", "u0", "v0"), ("k2", "k3", "k4", "k5")),
}
"""Our lens model for each `model_type`, and its names of fx fy cx cy and of the coefficients."""
ORB = {"PinHole": ("pinhole", ("k1", "k2", "p1", "p2", "k3")), "KannalaBrandt8": ("fisheye", ("k1", "k2", "k3", "k4"))}
"""Our lens model for each `Camera.type`, and its names of the coefficients."""
BASALT = {"pinhole": ("pinhole", ()), "kb4": ("fisheye", ("k1", "k2", "k3", "k4"))}
"""Our lens model for each `camera_type`, and its names of the coefficients."""


def _kalibr(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    table = tables[0]
    if "cam1" not in table:
        raise SourceError("has cam0 but no cam1, so there is no stereo; give the camchain of a stereo camera")
    lenses = [_kalibr_lens(table, name) for name in ("cam0", "cam1")]
    bodies = [_kalibr_place(table, name) for name in ("cam0", "cam1")]
    if "T_cn_cnm1" in table["cam1"]:
        T_left_right = inverse(rigid(table["cam1"]["T_cn_cnm1"], "cam1.T_cn_cnm1"))
    elif bodies[0] is not None and bodies[1] is not None:
        T_left_right = inverse(bodies[0]) @ bodies[1]
    else:
        missing = "cam0" if bodies[0] is None else "cam1"
        raise SourceError(f"cam1.T_cn_cnm1 is missing, and {missing} has neither T_cam_imu nor T_imu_cam; write one")
    return of_eyes(lenses[0], lenses[1], T_left_right, bodies)


def _kalibr_place(table: Table, name: str) -> Transform | None:
    """Return T_body_cam (4, 4), None if the file has none; raises SourceError if both transforms contradict."""
    camera = table[name]
    T_cam_imu, T_imu_cam = (rigid(camera[key], f"{name}.{key}") if key in camera else None for key in PLACES)
    if T_cam_imu is None:
        return T_imu_cam
    if T_imu_cam is not None and not np.allclose(inverse(T_cam_imu), T_imu_cam, atol=1e-3):
        raise SourceError(f"{name}: T_imu_cam is not the inverse of T_cam_imu; remove the wrong one")
    return inverse(T_cam_imu)


def _kalibr_lens(table: Table, name: str) -> Lens:
    camera = table[name]
    if not isinstance(camera, dict):
        raise SourceError(f"{name} is not a table; give the camchain as Kalibr wrote it")
    model, distortion = camera.get("camera_model"), camera.get("distortion_model", "none")
    try:
        ours = lens_model(distortion, name)
    except SourceError:
        ours = None
    if model != "pinhole" or ours is None:
        known = ", ".join(KALIBR)
        raise SourceError(f"{name}: {model}-{distortion} is not supported ({known}); calibrate with one of them")
    return _listed_lens(camera, name, ours, "distortion_coeffs")


def _listed_lens(camera: Table, name: str, model: str, distortion: str) -> Lens:
    """Return a lens with `intrinsics` fx fy cx cy, `resolution` and a list of coefficients."""
    intrinsics = numbers(_needed(camera, name, "intrinsics"), f"{name}.intrinsics", 4)
    size = numbers(_needed(camera, name, "resolution"), f"{name}.resolution", 2)
    return lens_of(model, intrinsics, camera.get(distortion) or [], size, name)


def _asl(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    """Return the pair of two `sensor.yaml`; the body is that of T_BS."""
    if len(tables) != 2:
        raise SourceError("is the sensor.yaml of one camera; give both files: cam0/sensor.yaml cam1/sensor.yaml")
    lenses, bodies = [], []
    for table, eye in zip(tables, ("first", "second"), strict=True):
        model = table.get("camera_model")
        if model != "pinhole":
            raise SourceError(f"the {eye} camera_model {shown(model)} is not supported; calibrate a pinhole")
        ours = lens_model(table.get("distortion_model"), f"the {eye} distortion_model")
        lenses.append(_listed_lens(table, eye, ours, "distortion_coefficients"))
        bodies.append(rigid(_needed(table, eye, "T_BS"), f"{eye} T_BS"))
    return of_mounts(lenses, bodies)


def _okvis(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    cameras = tables[0]["cameras"]
    if len(cameras) < 2:
        raise SourceError("lists one camera; give the settings of a stereo camera")
    lenses, bodies = [], []
    for number, camera in enumerate(cameras[:2]):
        name = f"cameras[{number}]"
        focal = numbers(_needed(camera, name, "focal_length"), f"{name}.focal_length", 2)
        centre = numbers(_needed(camera, name, "principal_point"), f"{name}.principal_point", 2)
        size = numbers(_needed(camera, name, "image_dimension"), f"{name}.image_dimension", 2)
        model = lens_model(str(camera.get("distortion_type", "")).removesuffix("8"), f"{name}.distortion_type")
        lenses.append(lens_of(model, (*focal, *centre), camera.get("distortion_coefficients", []), size, name))
        bodies.append(rigid(_needed(camera, name, "T_SC"), f"{name}.T_SC"))
    return of_mounts(lenses, bodies)


def _vins(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    table = tables[0]
    if "cam1_calib" not in table:
        raise SourceError("has cam0_calib but no cam1_calib, so there is no stereo; give the settings of two cameras")
    lenses, bodies = [], []
    for name in ("cam0", "cam1"):
        path = folder / os.path.basename(str(table[f"{name}_calib"]))
        lenses.append(_vins_lens(read_yaml(path), str(path)))
        bodies.append(rigid(_needed(table, "", f"body_T_{name}"), f"body_T_{name}"))
    return of_mounts(lenses, bodies)


def _vins_lens(table: Table, name: str) -> Lens:
    kind = table.get("model_type")
    if kind not in VINS:
        raise SourceError(f"{name}: model_type {shown(kind)} is not supported ({', '.join(VINS)}); calibrate with one")
    model, focal, coefficients = VINS[kind]
    values = table.get("projection_parameters", {})
    bent = table.get("distortion_parameters", values) if model == "pinhole" else values
    k = [_number(bent, name, key) for key in coefficients]
    size = [_number(table, name, f"image_{side}") for side in ("width", "height")]
    return lens_of(model, [_number(values, name, key) for key in focal], k, size, name)


def _vins_alone(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    raise SourceError("is one lens of VINS-Fusion; give the settings that name it as cam0_calib")


def _orb(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    """Return the pair of ORB-SLAM3's settings: two lenses, already rectified images, or the older LEFT and RIGHT."""
    table = tables[0]
    if "LEFT.K" in table:
        return _orb_rectification(table)
    if any(key.endswith("DepthMapFactor") for key in table):
        raise SourceError("is for a depth camera, which has one lens; give the settings of a stereo camera")
    kind = str(table.get("Camera.type", "PinHole"))
    first = "Camera1" if "Camera1.fx" in table else "Camera"
    rectified = kind == "Rectified" or ("Camera.bf" in table and kind == "PinHole" and not _bent(table, first))
    if not rectified and (kind not in ORB or "Camera2.fx" not in table):
        raise SourceError(
            f"Camera.type {kind} without Camera2.fx has one lens, so there is no stereo; give the settings of a pair"
        )
    size = [_number(table, "", f"Camera.{side}") for side in ("width", "height")]
    if rectified:
        return StereoCalibration(None, _orb_camera(table, first, size), _orb_body(table))
    T = table.get("Stereo.T_c1_c2", table.get("Tlr"))
    if T is None:
        raise SourceError("Stereo.T_c1_c2 is missing; write how the right camera's frame maps into the left one's")
    lenses = [_orb_lens(table, name, kind, size) for name in (first, "Camera2")]
    T_body_left = _orb_body(table)
    return of_mounts(lenses, (T_body_left, T_body_left @ rigid(T, "Stereo.T_c1_c2")))


def _bent(table: Table, name: str) -> bool:
    return any(table.get(f"{name}.{key}") for key in ORB["PinHole"][1])


def _orb_body(table: Table) -> Transform:
    key = next((key for key in ("IMU.T_b_c1", "Tbc") if key in table), None)
    return np.eye(4) if key is None else rigid(table[key], key)


def _orb_lens(table: Table, name: str, kind: str, size: Sequence[float]) -> Lens:
    model, coefficients = ORB[kind]
    intrinsics = [_number(table, "", f"{name}.{key}") for key in FOCAL]
    given = coefficients if f"{name}.k3" in table else coefficients[:4]
    k = numbers([table.get(f"{name}.{key}", 0.0) for key in given], f"{name} distortion")
    return lens_of(model, intrinsics, k, size, name)


def _orb_camera(table: Table, name: str, size: Sequence[float]) -> PinholeCamera:
    fx, fy, cx, cy = (_number(table, "", f"{name}.{key}") for key in FOCAL)
    baseline = _number(table, "", "Stereo.b") if "Stereo.b" in table else None
    if baseline is None:
        baseline = _number(table, "", "Camera.bf") / fx
    return PinholeCamera(int(size[0]), int(size[1]), fx, fy, cx, cy, baseline)


def _orb_rectification(table: Table) -> StereoCalibration:
    lenses, turns, places = [], [], []
    for eye in ("LEFT", "RIGHT"):
        size = [_number(table, "", f"{eye}.{side}") for side in ("width", "height")]
        K, R, P = (
            matrix(_needed(table, "", f"{eye}.{key}"), f"{eye}.{key}", 3, columns)
            for key, columns in (("K", 3), ("R", 3), ("P", 4))
        )
        D = _needed(table, "", f"{eye}.D")
        D = D.get("data", []) if isinstance(D, dict) else D
        model = "fisheye" if table.get("Camera.type") == "KannalaBrandt8" else "pinhole"
        lenses.append(lens_of(model, intrinsics_of(K), D, size, eye))
        turns.append(R)
        places.append(P)
    return from_rectification(lenses, turns, places)._replace(T_body_left=_orb_body(table))


def _basalt(tables: Sequence[Table], folder: Path) -> StereoCalibration:
    table = tables[0]["value0"]
    places, cameras, sizes = (_needed(table, "value0", key) for key in ("T_imu_cam", "intrinsics", "resolution"))
    if not all(isinstance(some, list) and len(some) >= 2 for some in (places, cameras, sizes)):
        raise SourceError("value0 lists one camera; give the calibration of a stereo camera")
    lenses, bodies = [], []
    for number in (0, 1):
        name = f"value0.intrinsics[{number}]"
        kind = _needed(cameras[number], name, "camera_type")
        if kind not in BASALT:
            raise SourceError(f"{name}: camera_type {shown(kind)} is not supported (pinhole, kb4); calibrate with one")
        model, coefficients = BASALT[kind]
        values = _needed(cameras[number], name, "intrinsics")
        k = [_number(values, name, key) for key in coefficients]
        size = numbers(sizes[number], "value0.resolution", 2)
        lenses.append(lens_of(model, [_number(values, name, key) for key in FOCAL], k, size, name))
        what = f"value0.T_imu_cam[{number}]"
        place = [[_number(places[number], what, key) for key in ("px", "py", "pz", "qx", "qy", "qz", "qw")]]
        bodies.append(rigid(transforms(np.array(place))[0], what))
    return of_mounts(lenses, bodies)


def _needed(table: Any, name: str, key: str) -> Any:
    if not isinstance(table, dict) or key not in table:
        raise SourceError(f"{_dotted(name, key)} is missing; give the file as its tool wrote it")
    return table[key]


def _number(table: Any, name: str, key: str) -> float:
    return numbers([_needed(table, name, key)], _dotted(name, key), 1)[0]


def _dotted(name: str, key: str) -> str:
    return f"{name}.{key}" if name else key


CHAINS: tuple[tuple[Callable[[Table], bool], Callable[[Sequence[Table], Path], StereoCalibration]], ...] = (
    (lambda table: "cam0" in table, _kalibr),
    (lambda table: "T_BS" in table and ("intrinsics" in table or "camera_model" in table), _asl),
    (lambda table: isinstance(table.get("cameras"), list), _okvis),
    (lambda table: "cam0_calib" in table, _vins),
    (lambda table: "model_type" in table, _vins_alone),
    (lambda table: any(key in table for key in ("Camera.type", "Camera1.fx", "Camera.fx", "LEFT.K")), _orb),
    (lambda table: isinstance(table.get("value0"), dict), _basalt),
)
"""For each kind, a test of its (first) table, and its reader, which receives all tables and their folder."""
