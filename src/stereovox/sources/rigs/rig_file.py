# SPDX-License-Identifier: Apache-2.0
"""`rig.toml`: any number of stereo pairs, their lenses and mounts on the vehicle; read, checked and written."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.rigs import Eyes, StereoPair, VirtualCamera
from stereovox.cameras.wide import COUNTS, CylindricalCamera, Lens, SphericalCamera
from stereovox.errors import FrameRefused, SourceError, StereovoxError, did_you_mean
from stereovox.files.safe_io import is_number, replacing, shown, toml_text
from stereovox.geometry.se3 import Transform, orthonormalise, rigidity_error
from stereovox.sources.photos import read_picture_png

FILE = "rig.toml"
CAMERAS = {"pinhole": PinholeCamera, "spherical": SphericalCamera, "cylindrical": CylindricalCamera}
LENS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")
EYES = ("left_lens", "right_lens", "T_left_right")
KEYS = ("name", "left", "right", "index", "T_body_left", "mask_rectangles", "mask", "camera", "virtual", *EYES)
WORDS = ("left", "right", "index", "mask")
SIZES = ("width", "height")
LARGEST = 32_767
"""Most pixels along a side; OpenCV's limit."""
TOLERANCE = 5e-3
"""Largest entry of abs(R^T R - I) that counts as rounding."""
UNWRITTEN = ("binning", "correction")


@dataclass(frozen=True)
class Virtual:
    """The camera that the images of a pair's eyes are rectified to; see `stereovox.cameras.rigs.virtual_camera`."""

    model: str = "pinhole"
    size: tuple[int, int] | None = None
    hfov_deg: float | None = None
    vfov_deg: float | None = None


def usual_virtual(eyes: Eyes | None) -> Virtual:
    """Return the virtual camera that suits most lenses: spherical for fisheyes, else a pinhole."""
    return Virtual("spherical" if eyes is not None and eyes.left.model == "fisheye" else "pinhole")


@dataclass(frozen=True, eq=False)
class RigPair:
    """One `[[pair]]` of a rig file. It has either `eyes`, whose images must be rectified, or `camera`.

    name: for messages, and the folder of its images. left, right: folders of images, relative to the file's own folder;
        "": `NAME/left` and `NAME/right`. index: file of lines `stamp left [right]` (seconds, file names in these
        folders); "": images are named by their time in nanoseconds.
    camera: the camera of already rectified images, with the baseline. virtual: the camera to rectify to.
    T_body_left: (4, 4) maps the optical frame of the left eye (raw if there are `eyes`, else
        rectified) into the vehicle's, which the poses refer to.
    mask_rectangles: (u0, v0, u1, v1) in pixels of the rectified left image: columns from u0 up to but not including u1
        and rows from v0 up to v1 are excluded. mask: a PNG of that image's size; only white pixels are used.
    """

    name: str = "stereo"
    left: str = ""
    right: str = ""
    index: str = ""
    camera: VirtualCamera | None = None
    eyes: Eyes | None = None
    T_body_left: Transform = field(default_factory=lambda: np.eye(4))
    virtual: Virtual = Virtual()
    mask_rectangles: tuple[tuple[int, int, int, int], ...] = ()
    mask: str = ""

    def folders(self) -> tuple[str, str]:
        """Return the folders of the left and of the right images, relative to the rig file's own folder."""
        return self.left or os.path.join(self.name, "left"), self.right or os.path.join(self.name, "right")

    def stereo_pair(self, folder: Path | str = ".") -> StereoPair:
        """Return the pair; `folder` contains its mask.

        Raises SourceError if the mask is unreadable or has another size, a rectangle is outside
        the image, or the virtual camera is impossible.
        """
        try:
            pair = self._bare()
        except StereovoxError as error:
            raise SourceError(f"pair '{self.name}': {error}") from None
        valid = self._valid(pair.camera, Path(folder))
        return StereoPair(pair.camera, pair.eyes, pair.T_body_camera, valid, self.name)

    def _bare(self) -> StereoPair:
        if self.eyes is None:
            if self.camera is None:
                raise SourceError("has neither [pair.camera] nor both lenses; give one of them")
            return StereoPair(self.camera, None, self.T_body_left, name=self.name)
        v = self.virtual
        return StereoPair.from_eyes(
            self.eyes, v.model, size=v.size, hfov_deg=v.hfov_deg, vfov_deg=v.vfov_deg, T_body_left=self.T_body_left
        )

    def _valid(self, camera: VirtualCamera, folder: Path) -> NDArray[np.bool_] | None:
        if not self.mask and not self.mask_rectangles:
            return None
        valid = self._white(camera, folder / self.mask) if self.mask else np.ones((camera.height, camera.width), bool)
        for u0, v0, u1, v1 in self.mask_rectangles:
            if not (0 <= u0 < u1 <= camera.width and 0 <= v0 < v1 <= camera.height):
                inside = f"u0 < u1 <= {camera.width} and v0 < v1 <= {camera.height}"
                raise SourceError(f"pair '{self.name}': mask rectangle {[u0, v0, u1, v1]} must have {inside}")
            valid[v0:v1, u0:u1] = False
        return valid

    def _white(self, camera: VirtualCamera, path: Path) -> NDArray[np.bool_]:
        try:
            image = read_picture_png(path, (camera.width, camera.height))
        except FrameRefused as refused:
            wanted = f"{camera.width}x{camera.height} pixels, 8 bits, white where the image may be used"
            raise SourceError(f"pair '{self.name}': {refused} (a mask has {wanted})") from None
        return (image if image.ndim == 2 else image.min(axis=2)) > 127


@dataclass(frozen=True, eq=False)
class Rig:
    """The contents of a `rig.toml`: the pairs, and the file of poses T_world_body (TUM format), relative to its
    folder."""

    pairs: tuple[RigPair, ...]
    poses: str = "poses.txt"

    def stereo_pairs(self, folder: Path | str = ".") -> list[StereoPair]:
        """Return the pairs in the file's order; raises SourceError as `RigPair.stereo_pair`."""
        return [pair.stereo_pair(folder) for pair in self.pairs]


def read_rig(path: Path | str) -> Rig:
    """Return the rig in `path`; raises SourceError naming file, pair and key for anything wrong in it."""
    from stereovox.files.safe_io import read_table

    table = read_table(Path(path))
    try:
        return rig_of(table)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None


def write_rig(path: Path | str, rig: Rig, remarks: Sequence[str] = ()) -> None:
    """Write `rig` so that `read_rig` restores it; `remarks` are comments at its top. Raises SourceError."""
    with replacing(path, SourceError) as file:
        file.write(rig_text(rig, remarks).encode())


def rig_of(table: dict[str, Any]) -> Rig:
    """Return the rig in a rig file's table; raises StereovoxError, one line with pair and key."""
    _check_keys(table, ("poses", "pair"), "")
    tables = table.get("pair")
    if not isinstance(tables, list) or not tables or not all(isinstance(one, dict) for one in tables):
        raise SourceError("holds no pair; write a table [[pair]] for each")
    pairs = tuple(_named(number, one) for number, one in enumerate(tables))
    names = [pair.name for pair in pairs]
    if len(set(names)) < len(names):
        raise SourceError(f"two pairs have one name (names: {', '.join(names)}); give each its own")
    return Rig(pairs, _word(table, "poses") if "poses" in table else Rig.poses)


def rig_text(rig: Rig, remarks: Sequence[str] = ()) -> str:
    """Return `rig` as the text of a `rig.toml`, with `remarks` as comments at its top."""
    lines = [f"# {remark}" for remark in remarks]
    lines.append(f"poses = {toml_text(rig.poses)}")
    for pair in rig.pairs:
        lines += ["", *_pair_lines(pair)]
    return "\n".join(lines) + "\n"


def _named(number: int, table: dict[str, Any]) -> RigPair:
    name = _word(table, "name") if "name" in table else RigPair.name
    try:
        return _pair(name, table)
    except StereovoxError as error:
        raise SourceError(f"pair {number + 1} ('{name}'): {error}") from None


def _pair(name: str, table: dict[str, Any]) -> RigPair:
    _check_keys(table, KEYS, "")
    given: dict[str, Any] = {key: _word(table, key) for key in WORDS if key in table}
    if "T_body_left" in table:
        given["T_body_left"] = _matrix(table, "T_body_left")
    if "mask_rectangles" in table:
        given["mask_rectangles"] = _rectangles(table["mask_rectangles"])
    eyes = [key for key in (*EYES, "virtual") if key in table]
    if "camera" in table and eyes:
        raise SourceError(f"has [pair.camera] and {eyes[0]}: the images are either already rectified or not; keep one")
    if "camera" in table:
        return RigPair(name, camera=_camera(_table(table, "camera")), **given)
    for key in EYES:
        if key not in table:
            raise SourceError(f"{key} is missing; give both lenses and T_left_right, or [pair.camera] if rectified")
    left, right = (_lens(_table(table, key), f"{key}.") for key in EYES[:2])
    virtual = _virtual(_table(table, "virtual")) if "virtual" in table else Virtual()
    return RigPair(name, eyes=Eyes(left, right, _matrix(table, "T_left_right")), virtual=virtual, **given)


def _camera(table: dict[str, Any]) -> VirtualCamera:
    model = table.get("model", "pinhole")
    if model not in CAMERAS:
        raise SourceError(f"camera.model = {shown(model)} is unknown{did_you_mean(str(model), CAMERAS)}")
    entries = {entry.name: entry for entry in fields(CAMERAS[model]) if entry.name not in UNWRITTEN}
    _check_keys(table, ("model", *entries), "camera.")
    needed = [name for name, entry in entries.items() if entry.default is MISSING or name == "baseline"]
    given = dict.fromkeys([*needed, *(name for name in entries if name in table)])
    values: dict[str, Any] = {key: _count(table, key) if key in SIZES else _number(table, key) for key in given}
    return CAMERAS[model](**values)


def _lens(table: dict[str, Any], prefix: str) -> Lens:
    _check_keys(table, LENS, prefix)
    try:
        width, height = (_count(table, key) for key in SIZES)
        fx, fy, cx, cy = (_number(table, key) for key in LENS[3:7])
        distortion = table.get("distortion", [])
        if not isinstance(distortion, list) or not all(map(is_number, distortion)):
            raise SourceError(f"distortion = {shown(distortion)} must be a list of numbers")
        lens = Lens(_word(table, "model"), width, height, fx, fy, cx, cy, tuple(map(float, distortion)))
        *counts, most = COUNTS[lens.model]
        if len(distortion) not in COUNTS[lens.model]:
            wanted = f"{', '.join(map(str, counts))} or {most} numbers for a {lens.model}, not {len(distortion)}"
            raise SourceError(f"distortion must have {wanted}")
        return lens
    except StereovoxError as error:
        raise SourceError(f"{prefix.removesuffix('.')}: {error}") from None


def _virtual(table: dict[str, Any]) -> Virtual:
    _check_keys(table, [entry.name for entry in fields(Virtual)], "virtual.")
    given: dict[str, Any] = {key: _number(table, key) for key in ("hfov_deg", "vfov_deg") if key in table}
    if "model" in table:
        given["model"] = _word(table, "model")
    if "size" in table:
        size = table["size"]
        if not isinstance(size, list) or len(size) != 2:
            raise SourceError(f"virtual.size = {shown(size)} must be [width, height] in pixels")
        given["size"] = tuple(_count({"virtual.size": side}, "virtual.size") for side in size)
    return Virtual(**given)


def _rectangles(value: Any) -> tuple[Any, ...]:
    good = isinstance(value, list) and all(isinstance(one, list) and len(one) == 4 for one in value)
    if not good or not all(type(number) is int and abs(number) <= LARGEST for one in value for number in one):
        raise SourceError(f"mask_rectangles = {shown(value)} must be a list of [u0, v0, u1, v1] in whole pixels")
    return tuple(map(tuple, value))


def _matrix(table: dict[str, Any], key: str) -> Transform:
    try:
        T = np.array(table[key], float)
    except (TypeError, ValueError, OverflowError):
        T = np.empty(0)
    if rigidity_error(T) > TOLERANCE:
        raise SourceError(f"{key} must be four rows of four numbers, a rotation and metres, below them 0 0 0 1")
    return orthonormalise(T)


def _table(table: dict[str, Any], key: str) -> dict[str, Any]:
    if not isinstance(table[key], dict):
        raise SourceError(f"{key} must be a table [pair.{key}]")
    return table[key]


def _word(table: dict[str, Any], key: str) -> str:
    value = table.get(key)
    if not isinstance(value, str) or not value or "\0" in value:
        said = f"{key} = {shown(value)} must be a string" if key in table else f"{key} is missing; give a string"
        raise SourceError(said)
    return value


def _number(table: dict[str, Any], key: str) -> float:
    if key not in table:
        raise SourceError(f"{key} is missing; write {key} = its number")
    if not is_number(table[key]):
        raise SourceError(f"{key} = {shown(table[key])} must be a number")
    return float(table[key])


def _count(table: dict[str, Any], key: str) -> int:
    number = _number(table, key)
    if not (number.is_integer() and 0 < number < LARGEST):
        raise SourceError(f"{key} = {number:g} must be a whole number of pixels")
    return int(number)


def _check_keys(table: dict[str, Any], known: Sequence[str], prefix: str) -> None:
    for key in table:
        if key not in known:
            raise SourceError(f"unknown key '{prefix}{key}'{did_you_mean(key, known)}")


def _pair_lines(pair: RigPair) -> list[str]:
    lines = ["[[pair]]", f"name = {toml_text(pair.name)}"]
    lines += [f"{key} = {toml_text(getattr(pair, key))}" for key in WORDS if getattr(pair, key)]
    lines += _matrix_lines("T_body_left", pair.T_body_left)
    if pair.mask_rectangles:
        lines.append(f"mask_rectangles = {toml_text(pair.mask_rectangles)}")
    if pair.eyes is None:
        assert pair.camera is not None
        model = next(name for name, kind in CAMERAS.items() if isinstance(pair.camera, kind))
        named = [entry.name for entry in fields(pair.camera) if entry.name not in UNWRITTEN]
        return [*lines, "", "[pair.camera]", f'model = "{model}"', *_lines(pair.camera, named)]
    lines += _matrix_lines("T_left_right", pair.eyes.T_left_right)
    for side in ("left", "right"):
        lines += ["", f"[pair.{side}_lens]", *_lines(_filled(getattr(pair.eyes, side)), LENS)]
    return [*lines, "", "[pair.virtual]", *_lines(pair.virtual, [entry.name for entry in fields(Virtual)])]


def _filled(lens: Lens) -> Lens:
    """Return the same lens with a number of coefficients that `_lens` accepts."""
    count = next(count for count in COUNTS[lens.model] if count >= len(lens.distortion))
    return replace(lens, distortion=lens.distortion + (0.0,) * (count - len(lens.distortion)))


def _lines(what: Any, names: Sequence[str]) -> list[str]:
    values = {name: getattr(what, name) for name in names}
    return [f"{name} = {toml_text(value)}" for name, value in values.items() if value is not None]


def _matrix_lines(key: str, T: Transform) -> list[str]:
    return [f"{key} = [", *(f"    {toml_text([float(number) for number in row])}," for row in T + 0.0), "]"]
