# SPDX-License-Identifier: Apache-2.0
"""Stereo recordings in the ASL layout of EuRoC, TUM VI and many tools."""

from __future__ import annotations

import os
import re
from bisect import bisect_left
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import NoPoses, SourceError
from stereovox.files.safe_io import MAX_LIST, read_text
from stereovox.geometry.se3 import Transform, inverse
from stereovox.sources.base import Part
from stereovox.sources.calibration.calibration_files import read_calibration
from stereovox.sources.calibration.calibration_values import StereoCalibration, read_yaml, rigid
from stereovox.sources.imu import ImuReadings, checked_imu, in_order
from stereovox.sources.parameters import file_of
from stereovox.sources.photos import file_names
from stereovox.sources.poses.poses import Poses, UnknownPoses, seconds_from_ns
from stereovox.sources.poses.trajectory import Trajectory, inside, transforms
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig import RigSource, Shot
from stereovox.sources.rigs.rig_file import Rig, RigPair, Virtual, usual_virtual
from stereovox.sources.rigs.rig_options import POSES, as_body, folder_and_options, poses_of_images

ROOT, EYES, DATA, SENSOR = "mav0", ("cam0", "cam1"), "data.csv", "sensor.yaml"
IMU = "imu0"
TRUTHS = ("state_groundtruth_estimate0", "mocap0", "vicon0")
"""Folders with poses, the best first: EuRoC's estimate, TUM VI's motion capture, EuRoC's."""
TEXTS = ("poses.txt", "groundtruth.txt")
"""Files with poses of the body in TUM format, used if there are no such folders."""
CHAINS = ("camchain.yaml", "dso/camchain.yaml")
"""Kalibr's calibrations that replace sensor.yaml; TUM VI has the second."""
SAME_NS = 1_000_000
"""Images of both eyes more than 1 ms apart are not a pair."""


class AslRig(RigSource):
    """A folder `mav0` or its parent: cam0 and cam1 with images named or listed by ns, calibration and poses.

    where: the folder, or with options `MH_01_easy?rectify=pinhole&poses=CameraTrajectory.txt&axes=optical`:
        rectify: `pinhole`, `spherical` or `cylindrical`; default: spherical for fisheyes, else pinhole.
        poses: a file or folder of poses of the body in any form (see `rgbd.pose_files`).
        axes: the poses are the left eye's instead, in `optical`, `opengl` or `ros` axes. invert: 1 if they
        map the world into the posed frame.
        imu: `off` to leave imu0 out.
    posed: if False, poses are not searched for, and are NaN.
    Images: `cam0/data.csv` (lines `ns,file`), else all `cam0/data/*.png`; listed but missing ones
    are left out, with a note. The right image is the one of the same time, or less than 1 ms away.
    Calibration: `sensor.yaml` of both cameras, else a camchain.yaml of Kalibr there, above or in `dso/`.
    Poses: data.csv of `state_groundtruth_estimate0`, `mocap0` or `vicon0` (ns, metres, quaternion w x y z, then
    anything), moved from that sensor to the body by its T_BS; else T_world_body in poses.txt or groundtruth.txt (TUM
    format).
    IMU: `imu0/data.csv` (ns, rad/s, m/s^2), mounted by T_BS of its sensor.yaml, or in the body's frame without it.
    World, poses and faults: see `RigSource`. Raises SourceError if a part is missing or invalid as a whole.
    """

    layout = "a EuRoC / ASL folder (mav0 with cam0, cam1 and state_groundtruth_estimate0)"
    parts = (
        *(Part((f"{ROOT}/{eye}", eye), f"images of {eye}", "copy it there: stereo needs both cameras") for eye in EYES),
        Part(tuple(f"{place}{name}/{DATA}" for place in (f"{ROOT}/", "") for name in TRUTHS), "poses"),
    )

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        self.folder, options = folder_and_options(where, {"rectify": "", "imu": "", "max_gap": 0.0, **POSES})
        self._imu = None if checked_imu(str(where), options["imu"]) == "off" else IMU
        self.name = self.folder.resolve().name
        root = _root(str(self.folder))
        if root is None:
            raise SourceError(f"{self.folder}: holds no {ROOT}/{EYES[0]}; give the folder that holds {ROOT}")
        for eye in EYES:
            if not os.path.isdir(root / eye):
                other = EYES[1 - EYES.index(eye)]
                raise SourceError(f"{root}: has {other} but no {eye}; copy it there, stereo needs both cameras")
        found, calibration = _calibration(root)
        virtual = Virtual(options["rectify"]) if options["rectify"] else usual_virtual(found.eyes)
        self._root = root
        pair = RigPair("stereo", camera=found.camera, eyes=found.eyes, T_body_left=found.T_body_left, virtual=virtual)
        left, right = (_Images(root / eye) for eye in (EYES[::-1] if found.swapped else EYES))
        poses = self._read_poses(root, left, found.T_body_left, options) if posed else UnknownPoses()
        try:
            self._set(Rig((pair,)), root, _shots(left, right), poses, calibration)
        except SourceError as error:
            raise SourceError(f"{root / EYES[0]}: {error}") from None
        note = getattr(poses, "note", "")
        self.notes = (*self.notes, *left.notes, *right.notes, *([note] if note else []))

    def _read_poses(self, root: Path, left: _Images, T_body_left: Transform, options: Mapping[str, Any]) -> Poses:
        if options["poses"]:
            poses = poses_of_images(file_of(options["poses"], self.folder), left.stamps)
        else:
            poses = _poses(root)
            _check_clocks(left, poses)
            self.up = "z" if any(os.path.isfile(root / name / DATA) for name in TRUTHS) else None
        poses.max_gap_ns = round(options["max_gap"] * 1e9)
        return as_body(poses, T_body_left, options["axes"], options["invert"])

    def imu(self) -> ImuReadings | None:
        """Return the readings of imu0; raises SourceError if they are damaged."""
        if self._imu is None or not os.path.isfile(self._root / self._imu / DATA):
            return None
        return _readings(self._root / self._imu, self.pairs[0].T_body_camera)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is or contains a folder `mav0` with a camera in it."""
        return _root(folder_part(where)) is not None


class _Images:
    """The images of one camera: their times (sorted) and files."""

    def __init__(self, camera: Path):
        self.folder = next((camera / name for name in ("data", "images") if os.path.isdir(camera / name)), camera)
        present = {name for name in file_names(self.folder) if name.endswith(".png")}
        if not present:
            raise SourceError(f"{self.folder}: holds no PNG; copy the images of {camera.name} there, named by their ns")
        listed = _list(camera / DATA) if os.path.isfile(camera / DATA) else {}
        self.notes: tuple[str, ...] = ()
        if listed:
            self.files = {stamp: name for stamp, name in listed.items() if name in present}
            lost = len(listed) - len(self.files)
            if lost:
                self.notes = (f"{camera / DATA}: lists {len(listed)} images, {lost} of them are missing: left out",)
        else:
            self.files = {_stamp(self.folder / name): name for name in present}
        if not self.files:
            raise SourceError(f"{camera / DATA}: none of its {len(listed)} images is in {self.folder}; copy them there")
        self.stamps = sorted(self.files)

    def nearest(self, stamp_ns: int) -> Path:
        """Return the image at a time, or the name it would have if none is near."""
        after = bisect_left(self.stamps, stamp_ns)
        near = self.stamps[max(after - 1, 0) : after + 1]
        best = min(near, key=lambda stamp: abs(stamp - stamp_ns))
        return self.folder / (self.files[best] if abs(best - stamp_ns) < SAME_NS else f"{stamp_ns}.png")


def _root(where: str) -> Path | None:
    """Return the folder that contains the cameras, None if missing."""
    for root in (Path(where) / ROOT, Path(where)):
        for eye in EYES:
            if any(os.path.exists(root / eye / name) for name in (DATA, SENSOR, "data")):
                return root
    return None


def _shots(left: _Images, right: _Images) -> list[Shot]:
    return [Shot(stamp, 0, left.folder / left.files[stamp], right.nearest(stamp)) for stamp in left.stamps]


def _calibration(root: Path) -> tuple[StereoCalibration, str]:
    """Return the calibration of the pair and the file it comes from."""
    sensors = [root / eye / SENSOR for eye in EYES]
    missing = [path for path in sensors if not os.path.isfile(path)]
    if not missing:
        return read_calibration(sensors), SENSOR
    for place in (root, root.parent):
        for name in CHAINS:
            if os.path.isfile(place / name):
                return read_calibration([place / name]), name
    raise SourceError(f"{missing[0]}: no such file; put it there, or Kalibr's camchain.yaml into {root}")


def _poses(root: Path) -> Poses:
    for name in TRUTHS:
        if os.path.isfile(root / name / DATA):
            return _truth(root / name)
    for path in (place / name for place in (root, root.parent) for name in TEXTS):
        if os.path.isfile(path):
            return Trajectory(path)
    said = "leica0 has positions but no orientations" if os.path.isdir(root / "leica0") else "no poses of the vehicle"
    raise NoPoses(
        f"{root}: {said}; put {TRUTHS[0]}/{DATA} or {TRUTHS[1]}/{DATA} there, "
        f"or {TEXTS[0]} with lines 'stamp tx ty tz qx qy qz qw' (seconds), or add ?poses=FILE"
    )


def _truth(folder: Path) -> Poses:
    """Return T_world_body over time from `data.csv` of a sensor that measures poses."""
    path = folder / DATA
    rows, header = _rows(path)
    w = _w_column(header)
    stamps, numbers, faults = [], np.full((len(rows), 7), np.nan), {}
    for row, (words, where) in zip(numbers, rows, strict=True):
        stamps.append(_ns(words[0], where))
        try:
            x, y, z, *q = (float(word) for word in words[1:8])
            q = [*q[1:], q[0]] if w == 4 else q
            row[:] = (x, y, z, *q)
            if not (np.isfinite(row).all() and np.linalg.norm(row[3:]) > 1e-6):
                raise ValueError
        except ValueError:
            row[:] = np.nan
            faults[stamps[-1]] = f"{where}: needs ns, x, y, z and a quaternion; correct or delete the line"
    if not rows:
        raise SourceError(f"{path}: holds no pose; copy the recording's own file there")
    return Poses(stamps, transforms(numbers) @ inverse(_mount(folder / SENSOR)), where=str(path), faults=faults)


def _mount(path: Path) -> Transform:
    """Return T_BS (4, 4), which maps the frame of the poses into the body's; the identity by default."""
    table = read_yaml(path) if os.path.isfile(path) else {}
    try:
        return rigid(table["T_BS"], "T_BS") if "T_BS" in table else np.eye(4)
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from None


def _readings(folder: Path, T_body_camera: Transform) -> ImuReadings:
    path = folder / DATA
    rows = _rows(path)[0]
    numbers = np.full((len(rows), 6), np.nan)
    for row, (words, _) in zip(numbers, rows, strict=True):
        with suppress(ValueError):  # the row stays NaN and is left out
            row[:] = [float(word) for word in words[1:7]]
    stamps = [_ns(words[0], where) for words, where in rows]
    mount = inverse(T_body_camera) @ _mount(folder / SENSOR)
    return in_order(stamps, numbers[:, :3], numbers[:, 3:], mount, str(path))


def _w_column(header: list[str]) -> int:
    """Return the column of the quaternion's w: the fourth, as in EuRoC, unless the header says that it is the last."""
    return 7 if len(header) > 7 and re.search(r"q.*w|^ *w\b", header[7].lower()) else 4


def _check_clocks(images: _Images, poses: Poses) -> None:
    ours, theirs = (images.stamps[0], images.stamps[-1]), (int(poses.stamps_ns[0]), int(poses.stamps_ns[-1]))
    if ours[0] > theirs[1] or theirs[0] > ours[1]:
        a, b = (f"{seconds_from_ns(start)} to {seconds_from_ns(end)} s" for start, end in (ours, theirs))
        raise SourceError(
            f"{poses.where}: poses from {b}, images from {a}: no time in common; give those of this flight"
        )


def _list(path: Path) -> dict[int, str]:
    """Return the files of a camera by time."""
    files: dict[int, str] = {}
    for words, where in _rows(path)[0]:
        stamp = _ns(words[0], where)
        files.setdefault(stamp, inside(words[1] if len(words) > 1 and words[1] else f"{words[0]}.png", where))
    return files


def _rows(path: Path) -> tuple[list[tuple[list[str], str]], list[str]]:
    """Return the rows of a comma-separated list, each with `file:line`, and its header's words, with or without `#`."""
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; make it readable") from None
    rows, header = [], []
    for n, line in enumerate(lines, 1):
        words = [word.strip() for word in (line.split(",") if "," in line else line.split())]
        if not any(words):
            continue
        if words[0].startswith("#") or (n == 1 and not words[0].isdecimal()):
            header = words
        else:
            rows.append((words, f"{path}:{n}"))
    return rows, header


def _ns(word: str, where: str) -> int:
    if not (word.isascii() and word.isdecimal() and int(word) < 2**63):
        raise SourceError(f"{where}: '{word[:30]}' is not a time in whole nanoseconds; correct or delete the line")
    return int(word)


def _stamp(path: Path) -> int:
    if not (path.stem.isascii() and path.stem.isdecimal() and int(path.stem) < 2**63):
        raise SourceError(f"{path}: its name is not a time in nanoseconds; rename it, or list the images in {DATA}")
    return int(path.stem)
