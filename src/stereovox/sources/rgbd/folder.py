# SPDX-License-Identifier: Apache-2.0
"""Recordings of a depth camera as a folder: image files, poses, a camera; and the options behind a folder's name."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.frame import Frame, Photo
from stereovox.geometry.se3 import Transform
from stereovox.sources import parameters
from stereovox.sources.base import DepthSource
from stereovox.sources.calibration.camera_file import FoundCamera, Standard, camera_in, find_camera
from stereovox.sources.calibration.intrinsics import NAMES, metres_per_unit
from stereovox.sources.photos import SUFFIXES as PHOTO_SUFFIXES
from stereovox.sources.photos import file_names, nearest_in_time, photo_size, read_photo, registered
from stereovox.sources.poses.poses import OTHER_CLOCK, Poses, in_time_of
from stereovox.sources.poses.tracker import AXES
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.depth_files import SUFFIXES, Depth, common_depth_size, read_depth
from stereovox.sources.rgbd.depth_unit import DepthUnit, find_unit, pairs_of, unit_by_values, unit_words
from stereovox.sources.rgbd.pose_files import ImagePoses, image_numbers, in_order, in_other_hand, number_in, read_poses
from stereovox.sources.rgbd.pose_fit import Images, Reading, misfit

SECOND = 1_000_000_000
UNIT_NOTE, SAMPLED = "depth is assumed to be in", 5
"""Begin of the note about an uncertain unit, and how many images are inspected for it without poses."""
PHOTO_NS, PHOTOS_TRIED = 20_000_000, 5
"""Largest time between a picture and its depth image, and how many pictures are tried for their size."""


class ImageFile(NamedTuple):
    """A depth image's file and its time in nanoseconds."""

    path: Path
    stamp_ns: int


@dataclass(frozen=True)
class FolderOptions:
    """Options after a folder's name, as in `scan?depth_scale=1000&poses=trajectory.log`. File names are searched
    as given, then inside the folder.

    depth_scale: unit of the images; 1000 and 0.001 both mean millimetres (0: the layout's, checked against the poses).
    camera: file of the camera, instead of the layout's own. fps: images a second if they have no times (0: the
    layout's). poses: file or folder of poses, of any form, instead of the layout's own. axes: axes of the posed
    camera, `optical`, `opengl` (x right, y up, z backward), `ros` or `ned`. invert: whether poses are world to camera.
    poses_scale: metres per unit of the poses' positions (0.001: millimetres). max_gap: longest gap in seconds between
    poses that is bridged (0: 0.1 on either side, or as smooth motion allows).
    """

    depth_scale: float = 0.0
    camera: str = ""
    fps: float = 0.0
    poses: str = ""
    axes: str = ""
    invert: bool = False
    poses_scale: float = 1.0
    max_gap: float = 0.0

    def __post_init__(self) -> None:
        if self.axes and self.axes not in AXES:
            raise SourceError(f"axes={self.axes} is unknown{did_you_mean(self.axes, AXES)}")
        for key in ("depth_scale", "fps", "max_gap"):
            if getattr(self, key) < 0:
                raise SourceError(f"{key}={getattr(self, key):g} must be positive")
        if not self.poses_scale > 0:
            raise SourceError(f"poses_scale={self.poses_scale:g} must be above 0: metres per unit of the poses")


def folder_part(where: str | os.PathLike[str]) -> str:
    """Return the folder in `FOLDER?key=value`; never raises."""
    text = os.fspath(where)
    return text if "?" not in text or os.path.exists(text) else text.partition("?")[0]


def folder_options(where: str | os.PathLike[str]) -> tuple[Path, FolderOptions]:
    """Return the folder in `FOLDER?key=value` and its options; raises SourceError for unknown or bad ones."""
    text = os.fspath(where)
    folder = folder_part(text)
    known = {field.name: field.default for field in fields(FolderOptions)}
    try:
        _, given = parameters.split(f"folder{text[len(folder) :]}")
        return Path(folder), FolderOptions(**parameters.typed(given, known))
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None


class DepthFolder(DepthSource, ABC):
    """Frames from depth images, one file each; an unusable file becomes a frame with a `fault`.

    A layout lists its images and reads its poses; anything else is searched for: the camera next to the
    images, the unit by convention and by how well images agree (see `depth_unit`). Options behind the
    folder's name take precedence (see `FolderOptions`).
    Invalid pixels are 0, 65535, NaN or infinity, without a reason: all are UNKNOWN and clear nothing.
    Faults: those of `read_depth`, and `no_pose` and `bad_pose_file`.
    Raises SourceError if there is no readable image, no camera or no poses.

    Attributes:
        depth_scale: Metres per unit of integer images, by convention; floats are metres.
        baseline: Metres between the eyes of the sensor, None if unknown.
            intrinsics: fx, fy, cx, cy of 640x480 images, or by size, for use without a camera file; None: a file is
            required.
            axes: Axes of the posed camera.
            fps: Images a second, if they have no times.
            calibrations: Names of camera files, in order of preference.
            certain: Whether all writers of this layout use its unit; else a unit that cannot be checked gives a note.
            posed: Whether anything is known about poses; if False, all are NaN.
            unit: The unit of the images, and its evidence.
    """

    depth_scale: float = 0.001
    baseline: float | None = None
    intrinsics: Standard | None = None
    axes: str = "optical"
    fps: float = 30.0
    calibrations: tuple[str, ...] = NAMES
    certain: bool = False
    unit: DepthUnit
    posed: bool = True
    _poses: Poses | ImagePoses | None = None

    def __init__(self, where: str | os.PathLike[str], posed: bool = True):
        self.folder, self.options = folder_options(where)
        self.name = self.folder.resolve().name
        if self.options.poses or self.options.axes or self.options.invert:
            self.up = None  # the layout's up holds only for its own poses
        self.axes, self.fps = self.options.axes or self.axes, self.options.fps or self.fps
        self._reading = Reading(self.axes, self.options.invert, self.options.poses_scale)
        self._images = self.list_images()
        if not self._images:
            raise SourceError(f"{self.folder}: has no depth image ({', '.join(SUFFIXES)}); give a folder that has some")
        self.posed = posed and self.posed
        self._poses = self._read_poses() if self.posed else None
        self.posed = self.posed and (self._poses is not None or self._has_own_poses())
        self.camera, notes, self._mirrored, scale = self._find_camera()
        expected = scale or (1.0 if self._dtype().kind == "f" else self.depth_scale)
        self.unit = self._find_unit(expected, bool(scale))
        unit_note = () if self.options.depth_scale else self._unit_note(expected)
        self.depth_scale = self.unit.scale
        if not (self.posed or self.certain or self.options.fps) and self._invented_times():
            self.notes += (self._rate_note(),)
        self.notes = (*self.notes, *notes, *unit_note, *self._misfit(expected))

    @classmethod
    def depth_only(cls, where: str) -> DepthFolder:
        """Return the images without searching for poses: every pose is NaN."""
        return cls(where, posed=False)

    @abstractmethod
    def list_images(self) -> list[ImageFile]:
        """Return the image files in order of time."""

    def read_poses(self) -> Poses | ImagePoses | None:
        """Return the layout's poses; None: nothing is known, all are NaN."""
        return None

    def numbers(self) -> list[int]:
        """Return the numbers in the names of the image files; -1 if missing."""
        return [number_in(image.path.name)[0] for image in self._images]

    def size(self) -> tuple[int, int]:
        """Return (width, height) of the images; raises SourceError if no image is readable."""
        size = common_depth_size([image.path for image in self._images])
        if isinstance(size, str):
            raise SourceError(f"none of the {len(self)} depth images of {self.folder} can be read: {size}")
        return size

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of images of (width, height) = `size`."""
        return find_camera([self.folder], size, self.baseline, self.intrinsics, self.calibrations)

    def list_photos(self) -> list[ImageFile]:
        """Return pictures that the depth images are registered to, in any order; [] if missing."""
        return []

    def photo_camera(self, size: tuple[int, int]) -> tuple[PinholeCamera | None, Transform]:
        """Return the camera of pictures of (width, height) = `size`, None: unknown, and T_depth_photo (4, 4)."""
        return registered(self.camera, size), np.eye(4)

    @cached_property
    def _listed_photos(self) -> list[ImageFile]:
        """The pictures, listed once."""
        return self.list_photos()

    @cached_property
    def _photos(self) -> list[Path | None]:
        """The picture of each depth image: the nearest in time; None if none is near."""
        photos = self._listed_photos
        found = nearest_in_time([i.stamp_ns for i in self._images], [p.stamp_ns for p in photos], PHOTO_NS)
        return [None if k is None else photos[k].path for k in found]

    @cached_property
    def _photo_camera(self) -> tuple[PinholeCamera | None, Transform]:
        """The camera of the pictures, from the first readable one."""
        paths = [path for path in self._photos if path is not None][:PHOTOS_TRIED]
        size = next(filter(None, map(photo_size, paths)), None)
        return (None, np.eye(4)) if size is None else self.photo_camera(size)

    @cached_property
    def _no_photos(self) -> str:
        """Why none of the existing pictures can be used; "" if one can, or there are none."""
        if not self._listed_photos or self._photo_camera[0] is not None:
            return ""
        path = next(filter(None, self._photos), None)
        if path is None:
            return f"{self.folder}: no picture within {PHOTO_NS / 1e6:g} ms of a depth image; do they share a clock?"
        return f"{path}: not read, or no camera is known for its size; give pictures of the depth images' shape"

    def _refuse_photo(self) -> NDArray[np.uint8]:
        raise FrameRefused("no_photo", self._no_photos)

    def photo(self, i: int) -> Photo | None:
        """Return the picture taken with frame `i` (0 to len - 1), None if missing.

        If no picture of the recording can be used, its `pixels` raise FrameRefused with the reason.
        """
        if self._no_photos:
            return Photo(self._refuse_photo, self.camera)
        path, (camera, T_depth_photo) = self._photos[i], self._photo_camera
        if path is None or camera is None:
            return None
        return Photo(partial(read_photo, path, (camera.width, camera.height)), camera, T_depth_photo)

    def __len__(self) -> int:
        return len(self._images)

    def image(self, i: int) -> ImageFile:
        """Return the image file of frame `i` (0 to len - 1) and its time in nanoseconds."""
        return self._images[i]

    def pose_in_file(self, i: int) -> Transform:
        """Return the pose (4, 4) of frame `i` as in the file; raises FrameRefused if it is missing."""
        if isinstance(self._poses, ImagePoses):
            return self._poses.at(i)
        return np.full((4, 4), np.nan) if self._poses is None else self._poses.at(self._images[i].stamp_ns)

    def pose(self, i: int) -> Transform:
        """Return T_world_camera (4, 4) of frame `i` (0 to len - 1); raises FrameRefused if missing."""
        if not self.posed:
            return np.full((4, 4), np.nan)
        return self._reading.pose(self._pose_as_written(i))

    def _pose_as_written(self, i: int) -> Transform:
        """Return the pose of frame `i` in a right-handed world; raises FrameRefused if missing."""
        T = self.pose_in_file(i)
        return in_other_hand(T) if self._mirrored else T

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i` (0 to len - 1); a layout may have one for each image, of the same size."""
        return self.camera

    def read(self, i: int) -> Depth:
        """Return the depth image (height, width) of frame `i` (0 to len - 1); raises FrameRefused (`read_depth`)."""
        return read_depth(self._images[i].path, (self.camera.width, self.camera.height))

    def frame(self, i: int) -> Frame:
        """Return frame `i`; depth is (0, 0) and the pose NaN if the frame has a `fault`."""
        i = range(len(self))[i]
        path, stamp_ns = self.image(i)
        try:
            T_world_camera = self.pose(i)
            depth = self.read(i)
        except FrameRefused as refused:
            no_depth, no_pose = np.empty((0, 0), np.uint16), np.full((4, 4), np.nan)
            blank = Frame(no_depth, self.camera, no_pose, stamp_ns, self.depth_scale, name=str(path))
            return replace(blank, fault=refused.reason, fault_detail=str(refused))
        frame = Frame(depth, self.camera_of(i), T_world_camera, stamp_ns, self.depth_scale, name=str(path))
        return replace(frame, photo=self.photo(i))

    def _read_poses(self) -> Poses | ImagePoses | None:
        named = self.options.poses
        found = self.fitted(read_poses(self._file(named))) if named else self.read_poses()
        if isinstance(found, Poses):
            found.max_gap_ns = round(self.options.max_gap * SECOND)
        return found

    def fitted(self, found: Poses | ImagePoses) -> Poses | ImagePoses:
        """Assign poses to the images: by number, by time, or one for each in order.

        Raises SourceError if their number differs and neither numbers nor times assign them.
        """
        numbers, known = self.numbers(), image_numbers(found)
        invented = self._invented_times()
        if isinstance(found, Poses) and not invented:
            found = in_time_of(found, [image.stamp_ns for image in self._images])
            self.notes += (found.note,) if found.note else ()
        shifted = len(found) == len(self) and known is not None and set(known) != set(numbers)
        poses = found if isinstance(found, ImagePoses) else in_order(found)
        if invented and known is not None and not shifted and 2 * len(set(known) & set(numbers)) >= len(self):
            return poses.of(numbers)
        if isinstance(found, Poses) and not (invented and len(found) == len(self)):
            first, last = self._images[0].stamp_ns, self._images[-1].stamp_ns
            if found.stamps_ns[0] <= last and first <= found.stamps_ns[-1]:
                if invented:
                    self.notes += (self._rate_note(),)
                return found
        if len(found) != len(self):
            raise SourceError(
                f"{found.where}: holds {len(found)} poses for {len(self)} images of {self.folder}; give one for each"
            )
        if isinstance(found, Poses) and not invented and known is None:
            self.notes += (f"{found.where}: {OTHER_CLOCK}",)
        return poses

    def _invented_times(self) -> bool:
        """Return whether the images' times are only their numbers."""
        stamps = [image.stamp_ns for image in self._images]
        return any(
            stamps == [int(n * SECOND / self.fps) for n in which] for which in (self.numbers(), range(len(self)))
        )

    def _rate_note(self) -> str:
        return f"images are assumed to be {self.fps:g} a second; else give {self.folder}?fps=15"

    def _find_camera(self) -> FoundCamera:
        size = self.size()
        if self.options.camera:
            return camera_in(self._file(self.options.camera), size, self.baseline)
        return self.find_camera(size)

    def _find_unit(self, expected: float, told: bool) -> DepthUnit:
        """Return the unit of the images; `expected`: metres per unit by convention, or, if `told`, as the camera's
        file says."""
        if self.options.depth_scale:
            return DepthUnit(metres_per_unit(self.options.depth_scale), True, "as ?depth_scale= says")
        if not self.posed and not self.certain:
            return unit_by_values(self._some_images(), expected, told)
        pairs = pairs_of(len(self), self.pose, self.read) if self.posed else []
        return find_unit(pairs, self.camera, expected)

    def _some_images(self) -> list[Depth]:
        """Return a few readable images, spread over the recording."""
        found = []
        for i in np.unique(np.linspace(0, len(self) - 1, SAMPLED).astype(int)).tolist():
            with suppress(FrameRefused):
                found.append(self.read(i))
        return found

    def _unit_note(self, expected: float) -> tuple[str, ...]:
        """Return a note if the unit is not the `expected` one, or is neither checked nor certain."""
        unit, usual = self.unit, abs(self.unit.scale / expected - 1) < 1e-6
        if usual and unit.plausible and (unit.sure or self.certain):
            return ()
        contrary = "" if usual else f", not {unit_words(expected)}"
        override = f"else give {self.folder}?depth_scale={5000 if unit.scale == 0.001 else 1000}"
        poses = "&poses_scale=0.001" if unit.sure and not unit.plausible else ""  # they agree in any common unit
        return (f"{UNIT_NOTE} {unit.words}{contrary} ({unit.why}); {override}{poses}",)

    def _misfit(self, expected: float) -> tuple[str, ...]:
        """Return a note if poses do not fit the images, whose unit is `expected` by convention."""
        confirmed = self.unit.sure and not self.options.depth_scale
        if not self.posed or confirmed:
            return ()
        images = Images(len(self), self._pose_as_written, cache(self.read), self.camera)
        found = misfit(
            images, self.unit.scale, self.unit.scale if self.options.depth_scale else expected, self._reading
        )
        return (found,) if found else ()

    def _has_own_poses(self) -> bool:
        """Return whether the layout overrides `pose_in_file`."""
        return type(self).pose_in_file is not DepthFolder.pose_in_file

    def _dtype(self) -> np.dtype[np.generic]:
        """Return the type of the images, from the first readable one."""
        for i in range(len(self)):
            try:
                return self.read(i).dtype
            except FrameRefused:
                continue
        return np.dtype(np.uint16)

    def _file(self, text: str) -> Path:
        """Return the file named by an option, see `parameters.file_of`."""
        return parameters.file_of(text, self.folder if os.path.isdir(self.folder) else self.folder.parent)


def images_in(folder: Path, pattern: str, fps: float) -> list[ImageFile]:
    """Return the images of a folder whose names match a regular expression, in the order of their numbers.

    Their times are the numbers divided by `fps`, or, if all names are times (seconds with decimals, or 16 or more
    digits of nanoseconds or microseconds), those.
    """
    names = [name for name in file_names(folder) if re.fullmatch(pattern, name, re.IGNORECASE)]
    stems = [os.path.splitext(name)[0] for name in names]
    if stems and all(re.fullmatch(r"\d+\.\d+", stem) for stem in stems):
        stamps = [ns_from_seconds(stem) for stem in stems]
    elif stems and all(re.fullmatch(r"\d{16,19}", stem) for stem in stems):
        stamps = [int(stem) * (1 if len(stem) > 17 else 1000) for stem in stems]
    else:
        names.sort(key=number_in)
        numbers = [number_in(name)[0] for name in names]
        numbers = numbers if len(set(numbers)) == len(numbers) and min(numbers, default=0) >= 0 else range(len(names))
        stamps = [int(number * SECOND / fps) for number in numbers]
    files = [ImageFile(folder / name, stamp) for name, stamp in zip(names, stamps, strict=True)]
    return sorted(files, key=lambda image: image.stamp_ns)


def photos_in(folder: Path, fps: float) -> list[ImageFile]:
    """Return the pictures of a folder with their times, as `images_in`; [] if there is no such folder."""
    return images_in(folder, image_pattern(PHOTO_SUFFIXES), fps) if folder.is_dir() else []


def image_pattern(names: Sequence[str] = SUFFIXES) -> str:
    """Return a regular expression of all files with these suffixes."""
    return rf"[^.].*({'|'.join(re.escape(name) for name in names)})"
