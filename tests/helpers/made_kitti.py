# SPDX-License-Identifier: Apache-2.0
"""Small KITTI recordings of all four layouts: a car that drives past a wall, with a moving car before it."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from stereovox.geometry.se3 import inverse, rotation_matrix, transform_points

SIZE = (64, 24)
"""Width, height."""
F, CX, CY = 40.0, 31.5, 11.5
OFFSETS = {0: 0.0, 1: -0.5, 2: 0.06, 3: -0.47}
"""x of camera 0 in each rectified camera, metres."""
LATITUDE, LONGITUDE = 49.0, 8.4
EARTH = 6378137.0
UPRIGHT = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
STAMPS = [f"2011-09-26 13:02:{25 + 0.1 * n:012.9f}" for n in range(100)]


def motion(vector: list[float], position: list[float]) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix(vector), position
    return T


R_RECT = motion([0.01, -0.02, 0.005], [0, 0, 0])
T_CAM_VELO = inverse(UPRIGHT) @ motion([0.004, 0.002, -0.01], [-0.27, 0.0, -0.08])
T_VELO_IMU = motion([0.001, -0.003, 0.012], [-0.81, 0.32, -0.8])
T_CAM0_VELO = R_RECT @ T_CAM_VELO
T_CAM0_IMU = T_CAM0_VELO @ T_VELO_IMU


def projection(number: int) -> np.ndarray:
    return np.array([[F, 0, CX, F * OFFSETS[number]], [0, F, CY, 0], [0, 0, 1, 0]])


def imu_pose(n: int) -> np.ndarray:
    """T_enu_imu: a bend to the left with some roll and pitch; yaw counts from east."""
    yaw = 0.5 + 0.1 * n
    R = rotation_matrix([0, 0, yaw]) @ rotation_matrix([0, -0.02 * n, 0]) @ rotation_matrix([0.03 * n, 0, 0])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, [100 + 1.2 * n, 50 + 0.7 * n, 110 + 0.1 * n]
    return T


def packet(n: int) -> str:
    """The 30 numbers of an oxts packet whose pose is `imu_pose(n)`, up to a shift that is the same for all."""
    x, y, z = imu_pose(n)[:3, 3] - imu_pose(0)[:3, 3]
    scale = math.cos(math.radians(LATITUDE)) * EARTH
    north = math.log(math.tan(math.radians(90 + LATITUDE) / 2)) + y / scale
    latitude = math.degrees(2 * math.atan(math.exp(north))) - 90
    longitude = LONGITUDE + math.degrees(x / scale)
    numbers = [latitude, longitude, 110 + z, 0.03 * n, -0.02 * n, 0.5 + 0.1 * n, *[0.0] * 19]
    return " ".join(f"{number:.15g}" for number in numbers) + " 4 8 4 4 0\n"


def cam0_pose(n: int) -> np.ndarray:
    """T_world_cam0 as `stereovox` has it: the world is camera 0 of the first frame, upright."""
    enu = [imu_pose(k) @ inverse(T_CAM0_IMU) for k in (0, n)]
    return UPRIGHT @ inverse(enu[0]) @ enu[1]


def file_pose(n: int) -> np.ndarray:
    """T_world_cam0 as KITTI's pose files have it: the world is camera 0 of the first frame."""
    return inverse(UPRIGHT) @ cam0_pose(n)


def wall() -> np.ndarray:
    """Points of a wall 15 m ahead of the first camera, in the world; no point near the face of a cell."""
    y, z = np.meshgrid(np.arange(-6.0, 6.0, 0.2) + 0.07, np.arange(-2.0, 2.0, 0.2) + 0.07)
    return np.stack([np.full(y.size, 15.07), y.ravel(), z.ravel()], axis=1)


def car_corner(n: int) -> np.ndarray:
    """Position in rectified camera 0 of frame `n` of the middle of the bottom of a car that drives ahead."""
    return np.array([-0.5 + 0.2 * n, 1.1, 7.0])


def car(n: int) -> np.ndarray:
    """Points on and in the moving car (h 1.5, w 1.6, l 3.9, facing forward), in rectified camera 0 of frame `n`."""
    x, y, z = np.meshgrid(np.linspace(-0.79, 0.79, 9), np.linspace(-1.49, -0.01, 9), np.linspace(-1.94, 1.94, 9))
    return car_corner(n) + np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)


def scan_points(n: int, with_car: bool = True) -> np.ndarray:
    """The scan of frame `n` in the lidar's frame: the wall, the car, and a few points behind and far away."""
    T_cam0_world = inverse(cam0_pose(n))
    seen = [transform_points(T_cam0_world, wall()), np.array([[0.1, 0.2, -5.0], [3.0, 0.1, 90.0], [40.0, 0, 5.0]])]
    points = np.vstack([*seen, car(n)] if with_car else seen)
    return transform_points(inverse(T_CAM0_VELO), points)


def write_scan(path: Path, points: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.column_stack([points, np.full(len(points), 0.3)]).astype("<f4").tofile(path)


def picture(number: int, colour: bool, size: tuple[int, int] = SIZE) -> np.ndarray:
    """An image that differs from frame to frame and from eye to eye; RGB."""
    shape = (size[1], size[0], 3) if colour else (size[1], size[0])
    return np.random.default_rng(number).integers(0, 256, shape, np.uint8)


def write_picture(path: Path, image: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def row(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.12e}" for number in np.asarray(numbers).ravel())


def pose_lines(count: int) -> str:
    return "".join(row(file_pose(n)[:3]) + "\n" for n in range(count))


def raw_calibration(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["calib_time: 09-Jan-2012 13:57:47", "corner_dist: 9.950000e-02"]
    for number in OFFSETS:
        rotation = R_RECT if number == 0 else np.eye(4)
        lines += [f"S_rect_0{number}: {row(np.array(SIZE))}", f"R_rect_0{number}: {row(rotation[:3, :3])}"]
        lines += [f"P_rect_0{number}: {row(projection(number))}"]
    (folder / "calib_cam_to_cam.txt").write_text("\n".join(lines) + "\n")
    for name, T in {"calib_velo_to_cam.txt": T_CAM_VELO, "calib_imu_to_velo.txt": T_VELO_IMU}.items():
        text = f"calib_time: 15-Mar-2012 11:37:16\nR: {row(T[:3, :3])}\nT: {row(T[:3, 3])}\n"
        (folder / name).write_text(text)


def raw(folder: Path, count: int = 4, eyes: tuple[int, ...] = (0, 1)) -> Path:
    """Write a date folder with one drive; return the drive's folder."""
    date = folder / "2011_09_26"
    drive = date / "2011_09_26_drive_0042_sync"
    raw_calibration(date)
    for eye in eyes:
        for n in range(count):
            write_picture(drive / f"image_{eye:02d}/data/{n:010d}.png", picture(10 * n + eye, eye > 1))
        (drive / f"image_{eye:02d}/timestamps.txt").write_text("".join(f"{stamp}\n" for stamp in STAMPS[:count]))
    for n in range(count):
        write_scan(drive / f"velodyne_points/data/{n:010d}.bin", scan_points(n, with_car=False))
        (drive / "oxts/data").mkdir(parents=True, exist_ok=True)
        (drive / f"oxts/data/{n:010d}.txt").write_text(packet(n))
    return drive


def single_calibration(names: tuple[str, str, str, bool]) -> str:
    """One calibration file; names of R_rect, Tr_velo_cam and Tr_imu_velo, and whether they are followed by a colon."""
    colon = ":" if names[3] else ""
    lines = [f"P{number}: {row(projection(number))}" for number in OFFSETS]
    lines += [f"{names[0]}{colon} {row(R_RECT[:3, :3])}", f"{names[1]}{colon} {row(T_CAM_VELO[:3])}"]
    return "\n".join([*lines, f"{names[2]}{colon} {row(T_VELO_IMU[:3])}"]) + "\n\n"


def label(n: int) -> str:
    x, y, z = car_corner(n)
    size_and_place = f"1.5 1.6 3.9 {x} {y} {z} {-math.pi / 2}"
    others = f"{n} -1 DontCare -1 -1 -10 10 10 20 20 -1 -1 -1 -1000 -1000 -1000 -10\n"
    return f"{n} 2 Van 0 0 -1.6 20.5 5.0 40.0 20.0 {size_and_place}\n{others}"


def tracking(folder: Path, count: int = 4, sequence: str = "0000") -> Path:
    """Write a folder `training` with one sequence (call it again for another one) and return it."""
    training = folder / "training"
    for eye in (2, 3):
        for n in range(count):
            write_picture(training / f"image_{eye:02d}/{sequence}/{n:06d}.png", picture(10 * n + eye, True))
    texts = {
        "calib": single_calibration(("R_rect", "Tr_velo_cam", "Tr_imu_velo", False)),
        "oxts": "".join(map(packet, range(count))),
        "label_02": "".join(map(label, range(count))),
    }
    for name, text in texts.items():
        (training / name).mkdir(exist_ok=True)
        (training / name / f"{sequence}.txt").write_text(text)
    for n in range(count):
        write_scan(training / f"velodyne/{sequence}/{n:06d}.bin", scan_points(n))
    return training


def odometry(folder: Path, count: int = 4, eyes: tuple[int, ...] = (0, 1)) -> Path:
    """Write `sequences/03` and `poses/03.txt`; return the sequence's folder."""
    sequence = folder / "sequences/03"
    for eye in eyes:
        for n in range(count):
            write_picture(sequence / f"image_{eye}/{n:06d}.png", picture(10 * n + eye, eye > 1))
    lines = [f"P{number}: {row(projection(number))}" for number in OFFSETS] + [f"Tr: {row(T_CAM0_VELO[:3])}"]
    (sequence / "calib.txt").write_text("\n".join(lines) + "\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * n:e}\n" for n in range(count)))
    for n in range(count):
        write_scan(sequence / f"velodyne/{n:06d}.bin", scan_points(n, with_car=False))
    (folder / "poses").mkdir()
    (folder / "poses/03.txt").write_text(pose_lines(count))
    return sequence


def stereo2015(folder: Path, scenes: tuple[int, ...] = (2, 7)) -> Path:
    """Write a folder `training` with scenes whose pixels in columns 20 to 29 moved; return it."""
    training = folder / "training"
    for scene in scenes:
        for eye in (2, 3):
            write_picture(training / f"image_{eye}/{scene:06d}_10.png", picture(10 * scene + eye, True))
        write_picture(training / f"image_2/{scene:06d}_11.png", picture(0, True))
        moving = np.zeros((SIZE[1], SIZE[0]), np.uint8)
        moving[:, 20:30] = 3
        write_picture(training / f"obj_map/{scene:06d}_10.png", moving)
        write_scan(training / f"velodyne/{scene:06d}.bin", scan_points(0, with_car=False))
        (training / "calib").mkdir(exist_ok=True)
        text = single_calibration(("R0_rect", "Tr_velo_to_cam", "Tr_imu_to_velo", True))
        (training / f"calib/{scene:06d}.txt").write_text(text)
    return training
