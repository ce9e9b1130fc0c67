# SPDX-License-Identifier: Apache-2.0
"""Rectified pairs of independent scenes, as in the stereo benchmarks of Middlebury (2014, 2021) and ETH3D."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes
from stereovox.cameras.wide import Lens
from stereovox.config.maps import StereoConfig
from stereovox.errors import FrameRefused, SourceError, StereovoxError
from stereovox.files.safe_io import read_text
from stereovox.sources.base import Part
from stereovox.sources.kitti.poses import UPRIGHT
from stereovox.sources.photos import EYE_KINDS, png_size
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.rig import RigSource, Shot
from stereovox.sources.rigs.rig_file import Rig, RigPair, Virtual
from stereovox.sources.rigs.rig_options import folder_and_options

IMAGES, CALIBRATION = ("im0.png", "im1.png"), "calib.txt"
SECOND_NS = 1_000_000_000
DISPARITIES: int = StereoConfig.model_fields["disparities"].default
METRES = 2.0
"""The baseline is in millimetres; a smaller number must be in metres."""
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
SINGLE = "single scenes without poses, each in its own world; map one, for example --frames 0:1"
EXAMPLE = "'cam0=[f 0 cx; 0 f cy; 0 0 1]', 'cam1=[...]' and 'baseline=' in mm"


class TwoView(RigSource):
    """A folder with im0.png, im1.png and calib.txt, or a folder of such folders: each is an independent scene.

    where: the folder, or with options `Motorcycle?scale=0.5`: scale: factor on the size of the images, above 0 to 1;
        default: the largest 1/n at which no disparity (`ndisp` + `doffs`) exceeds the default `stereo.disparities`.
    calib.txt: lines `key=value`: `cam0` and `cam1`, 3x3; `baseline` in millimetres; perhaps `width` and `height`. The
    eyes may differ in cx (`doffs`); rectification then shifts the images. If the images are smaller or
    larger by one factor, the calibration is scaled by it, with a note.
    World: the left eye of each scene, upright (z up, x forward); there are no poses. Time: a second for each scene.
    Faults: see `RigSource`. Raises SourceError if a calibration is missing or bad.
    """

    layout = "a stereo pair of Middlebury or ETH3D (im0.png, im1.png and calib.txt)"
    up = "z"
    parts = (Part(IMAGES[:1], "left image"), Part(IMAGES[1:], "right image"), Part((CALIBRATION,), CALIBRATION))

    def __init__(self, where: str | os.PathLike[str]):
        self.folder, options = folder_and_options(where, {"scale": ""})
        self.name = self.folder.resolve().name
        scenes = _scenes(self.folder)
        if not scenes:
            raise SourceError(f"{self.folder}: holds no {IMAGES[0]} and {IMAGES[1]}; give the folder with both")
        scale = _scale(options["scale"], str(where))
        pairs, notes = zip(*(_pair(scene, scale) for scene in scenes), strict=True)
        shots = [Shot(i * SECOND_NS, i, *(scene / name for name in IMAGES)) for i, scene in enumerate(scenes)]
        poses = Poses([shot.stamp_ns for shot in shots], np.tile(UPRIGHT, (len(shots), 1, 1)), where=str(self.folder))
        self._set(Rig(pairs), self.folder, shots, poses, CALIBRATION)
        self.notes = tuple(note for some in notes for note in some)
        if len(scenes) > 1:
            self.notes = (f"{self.folder}: {SINGLE}", *self.notes)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with such a pair, or with folders that contain one."""
        return bool(_scenes(Path(folder_part(where))))


def _scenes(folder: Path) -> list[Path]:
    """Return the folders of the pairs, in order of their names."""
    if _is_scene(folder):
        return [folder]
    try:
        with os.scandir(folder) as entries:
            return sorted(Path(entry.path) for entry in entries if entry.is_dir() and _is_scene(Path(entry.path)))
    except (OSError, ValueError):
        return []


def _is_scene(folder: Path) -> bool:
    return all(os.path.isfile(folder / name) for name in IMAGES)


def _scale(text: str, where: str) -> float | None:
    try:
        scale = float(text) if text else None
    except ValueError:
        scale = math.nan
    if scale is not None and not 0.01 <= scale <= 1:
        raise SourceError(f"{where}: scale={text} must be a number from 0.01 to 1")
    return scale


def _pair(scene: Path, scale: float | None) -> tuple[RigPair, list[str]]:
    path = scene / CALIBRATION
    try:
        return _calibrated(scene, _values(path), scale)
    except StereovoxError as error:
        raise SourceError(f"{error}" if str(path) in str(error) else f"{path}: {error}") from None


def _calibrated(scene: Path, values: dict[str, list[float]], scale: float | None) -> tuple[RigPair, list[str]]:
    path, notes = scene / CALIBRATION, []
    baseline = _one(values, "baseline")
    if baseline < METRES:
        notes.append(
            f"{path}: baseline={baseline:g} is assumed to be metres, since the format's millimetres would be tiny"
        )
    metres = baseline if baseline < METRES else baseline / 1000
    size, factor = _size(scene, values)
    if factor != 1:
        notes.append(
            f"{path}: is of larger or smaller images; used times {factor:g}, as {IMAGES[0]} has {size[0]}x{size[1]}"
        )
    (f, cx0, cy), (_, cx1, _) = (_camera(values, key, factor) for key in ("cam0", "cam1"))
    largest = _one(values, "ndisp", 0.0) * factor + cx1 - cx0
    divisor = math.ceil(largest / DISPARITIES) if scale is None and largest > 0 else 1
    used = scale if scale is not None else 1 / divisor
    if divisor > 1:
        why = f"so that its {largest:.0f} disparities fit into {DISPARITIES}"
        notes.append(f"{scene}: images are used at 1/{divisor} of their size {why}; ?scale=1 keeps it")
    if cx0 == cx1 and used == 1:
        return RigPair(scene.name, camera=PinholeCamera(*size, f, f, cx0, cy, metres)), notes
    T_left_right = np.eye(4)
    T_left_right[0, 3] = metres
    left, right = (Lens("pinhole", *size, f, f, cx, cy) for cx in (cx0, cx1))
    eyes = Eyes(left, right, T_left_right)
    smaller = None if used == 1 else (round(size[0] * used), round(size[1] * used))
    return RigPair(scene.name, eyes=eyes, virtual=Virtual(size=smaller)), notes


def _size(scene: Path, values: dict[str, list[float]]) -> tuple[tuple[int, int], float]:
    """Return width and height in pixels, and their factor relative to the calibration."""
    told = (_one(values, "width", 0.0), _one(values, "height", 0.0))
    try:
        size = png_size(scene / IMAGES[0], EYE_KINDS)
    except FrameRefused as refused:
        if min(told) < 1:
            raise SourceError(str(refused)) from None
        return (int(told[0]), int(told[1])), 1.0  # reported when the frame is read
    if min(told) < 1:
        return size, 1.0
    factor = size[0] / told[0]
    if abs(told[1] * factor - size[1]) > 1.5:
        return (int(told[0]), int(told[1])), 1.0  # reported when the frame is read
    return size, factor


def _camera(values: dict[str, list[float]], key: str, factor: float) -> tuple[float, float, float]:
    """Return the focal length and the centre cx, cy in pixels of images `factor` times as large."""
    K = values.get(key, [])
    if len(K) != 9:
        raise SourceError(f"{key} must be 9 numbers; write {EXAMPLE}")
    return K[0] * factor, (K[2] + 0.5) * factor - 0.5, (K[5] + 0.5) * factor - 0.5


def _one(values: dict[str, list[float]], key: str, default: float | None = None) -> float:
    found = values.get(key, [] if default is None else [default])
    if len(found) != 1 or not math.isfinite(found[0]) or not abs(found[0]) < 1e6:
        raise SourceError(f"{key} must be a number; write {EXAMPLE}")
    return found[0]


def _values(path: Path) -> dict[str, list[float]]:
    """Return the numbers of each key; brackets and semicolons are optional."""
    try:
        text = read_text(path, errors="replace")
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; write {EXAMPLE} into it") from None
    lines = (line.partition("=") for line in text.splitlines())
    return {key.strip(): [float(number) for number in NUMBER.findall(value)] for key, sign, value in lines if sign}
