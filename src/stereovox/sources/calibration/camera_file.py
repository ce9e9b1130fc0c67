# SPDX-License-Identifier: Apache-2.0
"""The camera of a recording: `camera.toml`, or the small text files next to the images."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from stereovox.cameras.pinhole import DepthCorrection, PinholeCamera
from stereovox.errors import SourceError, StereovoxError, did_you_mean
from stereovox.files.safe_io import is_number, read_table, shown, toml_text
from stereovox.frame import AnyFrame, Frame, Rays, StereoFrame
from stereovox.sources.base import Changed, Stream
from stereovox.sources.calibration.intrinsics import NAMES, Intrinsics, read_camera_numbers, scaled

FILE = "camera.toml"
SIZES = ("width", "height")
INTRINSICS = ("fx", "fy", "cx", "cy")
NEEDED = {
    **dict.fromkeys(SIZES, "its number of pixels"),
    **dict.fromkeys(("fx", "fy"), "its focal length in pixels"),
    **dict.fromkeys(("cx", "cy"), "where the optical axis meets the image, in pixels"),
}
"""Explains each required key."""
KEYS = (*SIZES, *INTRINSICS, "baseline", "correction")
CORRECTION = ("model", "coefficients", "provenance")
MATRIX = "camera-intrinsics.txt"
VGA = (640, 480)
Standard = Intrinsics | Mapping[tuple[int, int], Intrinsics]
"""Default camera of a data set: of 640x480 images, or of each size (width, height)."""
OTHER = "give the file of their own camera"


def read_camera(path: Path) -> PinholeCamera:
    """Return the camera in `path`; raises SourceError naming file and key for anything wrong in it.

    Keys: width, height, fx, fy, cx, cy in pixels; optionally baseline in metres, a table [correction] with model
    and coefficients as in `DepthCorrection`, and a free table [correction.provenance].
    """
    table = read_table(path)
    try:
        return _camera(table)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None


def camera_text(camera: PinholeCamera, provenance: Mapping[str, Any] | None = None, remarks: Sequence[str] = ()) -> str:
    """Return the text of a camera file, with `remarks` as comments at its top.

    provenance: strings, numbers and lists of them that document the origin of the correction.
    """
    lines = [f"# {remark}" for remark in remarks]
    lines += [f"{key} = {toml_text(getattr(camera, key))}" for key in (*SIZES, *INTRINSICS)]
    if camera.baseline is not None:
        lines.append(f"baseline = {toml_text(camera.baseline)}")
    if camera.correction:
        lines += ["", "[correction]", f"model = {toml_text(camera.correction.model)}"]
        lines.append(f"coefficients = {toml_text(camera.correction.coefficients)}")
    if camera.correction and provenance:
        lines += ["", "[correction.provenance]", *(f"{key} = {toml_text(value)}" for key, value in provenance.items())]
    return "\n".join(lines) + "\n"


class FoundCamera(NamedTuple):
    """Camera of a recording, and further contents of its file.

    notes: what was assumed, used or ignored. mirrored: its file has a negative fy, so the second axis of the camera of
    its poses points up (see `rgbd.folder`). depth_scale: metres per unit of depth images, None if no file gives it.
    """

    camera: PinholeCamera
    notes: tuple[str, ...] = ()
    mirrored: bool = False
    depth_scale: float | None = None


def find_camera(
    folders: Sequence[Path],
    size: tuple[int, int],
    baseline: float | None,
    default: Standard | None,
    names: Sequence[str] = NAMES,
) -> FoundCamera:
    """Find the camera of images of (width, height) = `size`.

    The first file found is used: `camera.toml` (see `read_camera`) in the first of `folders`, the recording's own; then
    the `names`, in the order of `folders`, each as `read_camera_numbers` reads it. Without one, images get the
    `default` of their size. `baseline` in metres applies if the file has none. Raises SourceError for a bad file, or
    if there is none and the images have another size.
    """
    places = [folders[0] / FILE, *(folder / name for folder in folders for name in names)]
    found = [path for path in dict.fromkeys(places) if os.path.isfile(path)]  # Path.is_file may raise
    far = [folder / FILE for folder in folders[1:] if os.path.isfile(folder / FILE)]
    cure = "it counts only in the recording's own folder; give it with --camera"
    ignored = [f"{path} is not used: {cure}" for path in far]
    ignored += [f"{path} is not used: {found[0]} comes first" for path in found[1:]]
    if found:
        camera = camera_in(found[0], size, baseline)
        return camera._replace(notes=(*camera.notes, *ignored))
    standard = default.get(size) if isinstance(default, Mapping) else default if size == VGA else None
    if standard is None:
        raise SourceError(
            f"{folders[0] / MATRIX}: no such file, and {size[0]}x{size[1]} images have no standard calibration; "
            "write the 3x3 camera matrix into it, or add ?camera=FILE"
        )
    fx, fy, cx, cy = standard
    numbers = f"{fx:g} {fy:g} {cx:g} {cy:g}"
    note = f"{folders[0]} has no {MATRIX}: fx fy cx cy are assumed to be the usual {numbers}; else give --camera FILE"
    return FoundCamera(PinholeCamera(*size, fx, abs(fy), cx, cy, baseline), (note, *ignored), mirrored=fy < 0)


def camera_in(path: Path, size: tuple[int, int], baseline: float | None) -> FoundCamera:
    """Return the camera in a camera.toml or another program's file, for images of (width, height) = `size`.

    Raises SourceError for a bad file, and if the camera has another size.
    """
    if path.suffix.lower() != ".toml":
        return _foreign(path, size, baseline)
    camera = _of_size(path, size, baseline)
    return FoundCamera(camera, (f"{path} is used ({describe_correction(camera)})",))


def with_camera(stream: Stream, file: str | os.PathLike[str]) -> Stream:
    """Return `stream` with the camera in `file` (see `camera_in`); if that has no baseline, the stream's own is kept.

    Raises SourceError for a bad file and for a camera with another number of pixels.
    """
    own, path = stream.camera, Path(file)
    if path.suffix.lower() != ".toml":
        found = _foreign(path, (own.width, own.height), own.baseline)
        if found.mirrored:
            raise SourceError(f"{file}: fy is negative, which turns poses too; give it behind the folder: ?camera=")
        return WithCamera(stream, found.camera, (f"{file} is used instead of the recording's own camera",))
    camera = read_camera(path)
    if (camera.width, camera.height) != (own.width, own.height):
        raise SourceError(
            f"{file}: is for a camera with {camera.width}x{camera.height} pixels, {stream.name} has "
            f"{own.width}x{own.height}; give the file of its own camera"
        )
    note = f"{file} is used instead of the recording's own camera ({describe_correction(camera)})"
    return WithCamera(stream, camera if camera.baseline else replace(camera, baseline=own.baseline), (note,))


class WithCamera(Changed):
    """A stream whose frames get another `camera` of the same size; `notes` follow the stream's own."""

    def __init__(self, stream: Stream, camera: PinholeCamera, notes: tuple[str, ...] = ()):
        super().__init__(stream)
        self.camera, self.notes = camera, (*self.notes, *notes)

    def change(self, frame: AnyFrame) -> Frame:
        """Return a depth frame with the camera; raises SourceError for a stereo pair or rays."""
        if isinstance(frame, StereoFrame):
            raise SourceError(f"{self.name}: has stereo pairs, which no camera file fits; correct its rig file")
        if isinstance(frame, Rays):
            raise SourceError(f"{self.name}: has no images, so a camera file does not apply; leave it out")
        return replace(frame, camera=self.camera)


def describe_correction(camera: PinholeCamera) -> str:
    """Describe a camera's depth correction in words."""
    return f"depth correction '{camera.correction.model}'" if camera.correction else "no depth correction"


def pinhole(
    size: tuple[int, int],
    intrinsics: tuple[float, float, float, float],
    baseline: float | None,
    correction: DepthCorrection | None = None,
) -> PinholeCamera:
    """Return a camera from numbers of a file: (width, height), and fx, fy, cx, cy; all finite.

    Raises SourceError naming the invalid number.
    """
    named = {"fx": intrinsics[0], "fy": intrinsics[1], "baseline": 1.0 if baseline is None else baseline}
    for name, number in named.items():
        if number <= 0:
            raise SourceError(f"{name} = {number:g} must be positive")
    try:
        return PinholeCamera(*size, *intrinsics, baseline, correction=correction)
    except StereovoxError as error:  # it shows the whole camera; its last words name the fault
        numbers = " ".join(f"{number:g}" for number in intrinsics)
        raise SourceError(f"fx fy cx cy = {numbers}: {str(error).rpartition(': ')[2]}") from None


def _camera(table: dict[str, Any]) -> PinholeCamera:
    if "pair" in table:
        raise SourceError("is a rig file, not a camera file; put it into the recording's folder as rig.toml")
    _check_keys(table, KEYS, "")
    for key, what in NEEDED.items():
        if key not in table:
            raise SourceError(f"{key} is missing; write {key} = {what}")
    sizes = [_number(table, key) for key in SIZES]
    if not all(size.is_integer() and 0 < size < 100_000 for size in sizes):
        raise SourceError(f"width and height must be whole numbers of pixels, not {sizes[0]:g} and {sizes[1]:g}")
    baseline = _number(table, "baseline") if "baseline" in table else None
    correction = _correction(table["correction"]) if "correction" in table else None
    fx, fy, cx, cy = (_number(table, key) for key in INTRINSICS)
    return pinhole((int(sizes[0]), int(sizes[1])), (fx, fy, cx, cy), baseline, correction)


def _correction(table: Any) -> DepthCorrection:
    if not isinstance(table, dict):
        raise SourceError("correction must be a table [correction] with model and coefficients")
    _check_keys(table, CORRECTION, "correction.")
    model, numbers = table.get("model"), table.get("coefficients")
    if not isinstance(model, str) or not isinstance(numbers, list):
        raise SourceError("[correction] needs model, a string, and coefficients, a list of numbers")
    if not all(is_number(number) for number in numbers):
        raise SourceError(f"correction.coefficients {shown(numbers)} must be numbers")
    return DepthCorrection(model, tuple(map(float, numbers)))


def _check_keys(table: dict[str, Any], known: Sequence[str], prefix: str) -> None:
    for key in table:
        if key not in known:
            raise SourceError(f"unknown key '{prefix}{key}'{did_you_mean(key, known)}")


def _number(table: dict[str, Any], key: str) -> float:
    value = table[key]
    if not is_number(value):
        raise SourceError(f"{key} = {shown(value)} must be a number")
    return float(value)


def _of_size(path: Path, size: tuple[int, int], baseline: float | None) -> PinholeCamera:
    camera = read_camera(path)
    if (camera.width, camera.height) != size:
        raise SourceError(
            f"{path}: is for a camera with {camera.width}x{camera.height} pixels, the images have {size[0]}x{size[1]}; "
            "replace or remove it"
        )
    return camera if camera.baseline else replace(camera, baseline=baseline)


def _foreign(path: Path, size: tuple[int, int], baseline: float | None) -> FoundCamera:
    """Return the camera in a file of another program, with its numbers scaled if they are for images of another
    size."""
    numbers = read_camera_numbers(path)
    fx, fy, cx, cy = numbers.intrinsics
    notes: tuple[str, ...] = ()
    if numbers.size is not None and numbers.size != size:
        width, height = numbers.size
        if abs(size[0] / width - size[1] / height) > 0.01 * size[0] / width:
            raise SourceError(f"{path}: is for {width}x{height} images, these have {size[0]}x{size[1]}; {OTHER}")
        factor = size[0] / width
        fx, fy, cx, cy = scaled(numbers.intrinsics, factor)
        notes = (f"{path} is for {width}x{height} images; its numbers are scaled to {size[0]}x{size[1]}",)
    try:
        camera = pinhole(size, (fx, abs(fy), cx, cy), baseline)
    except StereovoxError as error:
        raise SourceError(f"{path}: {error}") from None
    return FoundCamera(camera, notes, mirrored=fy < 0, depth_scale=numbers.depth_scale)
