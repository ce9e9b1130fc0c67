# SPDX-License-Identifier: Apache-2.0
"""The loader on a real drive: its parts fit together only if calibration, poses and directions are right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from stereovox.evaluate.lidar_truth import project
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.opening import open_source

DRIVE = (
    Path(__file__).resolve().parents[3] / "../shared/data/kitti_raw/2011_09_26/2011_09_26_drive_9001_sync"
).resolve()
SCENES = (Path(__file__).resolve().parents[3] / "../shared/data/kitti_stereo2015/training").resolve()
on_the_drive = pytest.mark.skipif(not DRIVE.is_dir(), reason="the drive ../shared/data/kitti_raw is absent")


def in_left(source, n: int, other: int) -> tuple[np.ndarray, np.ndarray]:
    """Points of scan `other` in the left camera of frame `n`, those 5 to 25 m ahead, and their pixels."""
    scan, viewpoint = source.scan(other), source.viewpoint(n)
    points = transform_points(inverse(viewpoint.T_world_camera) @ scan.T_world_lidar, scan.points)
    pixels, shown = project(viewpoint.camera, points)
    keep = shown & (points[:, 2] > 5) & (points[:, 2] < 25)
    return points[keep], pixels[keep]


def grey_at(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Brightness at pixels, NaN outside the image."""
    u, v = np.rint(u).astype(int), np.rint(v).astype(int)
    good = (u >= 0) & (u < image.shape[1]) & (v >= 0) & (v < image.shape[0])
    return np.where(good, image[v.clip(0, image.shape[0] - 1), u.clip(0, image.shape[1] - 1)].astype(float), np.nan)


def difference(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.nanmedian(np.abs(a - b)))


@on_the_drive
def test_the_drive_has_23_frames_and_its_refined_poses():
    source = open_source(DRIVE)
    assert len(source) == 23
    frames = list(source)
    assert all(frame.fault is None for frame in frames)
    assert frames[0].stamp_ns == 1317045935913420800
    lines = np.loadtxt(DRIVE / "poses_refined.txt").reshape(-1, 3, 4)
    for frame, matrix in zip(frames, lines, strict=True):
        x, y, z = matrix[:, 3]
        np.testing.assert_allclose(frame.T_world_sensor[:3, 3], [z, -x, -y], atol=1e-6)
    assert frames[-1].T_world_sensor[0, 3] > 80


@on_the_drive
def test_poses_from_oxts_are_those_of_poses_ins():
    by_oxts, by_file = (open_source(f"{DRIVE}?poses={kind}") for kind in ("oxts", "ins"))
    for n in range(23):
        got, wanted = by_oxts.viewpoint(n).T_world_camera, by_file.viewpoint(n).T_world_camera
        np.testing.assert_allclose(got, wanted, atol=1e-5)


@on_the_drive
@pytest.mark.parametrize("n", [4, 12])
def test_lidar_points_look_the_same_in_both_eyes_at_their_disparity(n):
    source = open_source(DRIVE)
    frame, camera = source.frame(n), source.camera
    points, pixels = in_left(source, n, n)
    assert len(points) > 5000
    disparity = camera.fx * camera.baseline / points[:, 2]
    left = grey_at(frame.left, *pixels.T)

    def alike(shift: int) -> float:  # the eyes differ in brightness, so no plain difference
        right = grey_at(frame.right, pixels[:, 0] - disparity + shift, pixels[:, 1])
        both = np.isfinite(left + right)
        return float(np.corrcoef(left[both], right[both])[0, 1])

    found = {shift: alike(shift) for shift in range(-12, 13)}
    assert abs(max(found, key=found.__getitem__)) <= 1
    assert 1 - found[0] < 0.75 * (1 - max(found[-6], found[6]))


@on_the_drive
def test_the_next_scan_looks_the_same_in_this_image_and_only_at_its_pose():
    source = open_source(DRIVE)
    now, then = source.frame(4), source.frame(5)
    own, own_pixels = in_left(source, 5, 5)
    T_now_then = inverse(now.T_world_sensor) @ then.T_world_sensor

    def unlike(moved_by: float) -> float:
        shifted = transform_points(T_now_then, own) + np.array([moved_by, 0, 0])
        pixels, _ = project(source.camera, shifted)
        return difference(grey_at(then.left, *own_pixels.T), grey_at(now.left, *np.nan_to_num(pixels, nan=-9).T))

    assert unlike(0.0) < 0.7 * min(unlike(-0.3), unlike(0.3))


@pytest.mark.skipif(not SCENES.is_dir(), reason="the scenes ../shared/data/kitti_stereo2015 are absent")
def test_lidar_of_the_scenes_agrees_with_their_disparity():
    import cv2

    source = open_source(SCENES)
    assert len(source) == 8
    points, pixels = in_left(source, 2, 2)
    truth = cv2.imread(str(SCENES / "disp_occ_0/000010_10.png"), cv2.IMREAD_UNCHANGED) / 256.0
    u, v = np.rint(pixels).astype(int).T
    known = truth[v, u] > 0
    camera = source.frame(2).pair.camera
    off = truth[v, u][known] - camera.fx * camera.baseline / points[known, 2]
    assert known.sum() > 3000
    assert abs(np.median(off)) < 0.3
    assert np.median(np.abs(off)) < 0.6
