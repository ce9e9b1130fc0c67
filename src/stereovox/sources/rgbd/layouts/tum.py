# SPDX-License-Identifier: Apache-2.0
"""Folders of the TUM RGB-D benchmark, and of the many tools that use its layout."""

from __future__ import annotations

import math
import os
import re
from pathlib import Path

from stereovox.errors import NoPoses, SourceError
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, find_camera
from stereovox.sources.calibration.intrinsics import NAMES
from stereovox.sources.photos import FOLDERS, file_names
from stereovox.sources.photos import SUFFIXES as PHOTO_SUFFIXES
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import (
    FORMAT,
    StampedLine,
    Trajectory,
    by_time,
    inside,
    ns_from_seconds,
    stamped_lines,
)
from stereovox.sources.rgbd.depth_files import SUFFIXES
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses

LIST, IMAGES, POSES = "depth.txt", "depth", "groundtruth.txt"
PHOTO_LIST = "rgb.txt"
PAIRED = ("associations.txt", "association.txt", "associate.txt", "associated.txt", "rgbd_assoc.txt")
"""Lists of colour and depth images with their times: `stamp file stamp file`."""
OTHER_POSES = ("*truth*.txt", "CameraTrajectory.txt", "KeyFrameTrajectory.txt", "trajectory.txt", "poses.txt",
               "pose.txt", "*cam*pose*.txt", "*traj*.txt")  # fmt: skip
"""Other pose files, mostly of SLAM programs, in order of preference; groundtruth.txt takes precedence."""
BONN, BONN_INTRINSICS = "rgbd_bonn", (542.822841, 542.57687, 315.59352, 237.756098)
"""Folders of the Bonn dynamic data set, and the camera from its web page."""


class StampedImages(DepthFolder):
    """`depth.txt` (lines `stamp file`), else all `depth/<stamp>.png`; 5000 per metre by convention. No poses.

    Without both, the depth images in `associations.txt` (lines `stamp file stamp file`).
    Camera: `camera.toml`, else `camera-intrinsics.txt` (3x3), else `calibration.txt` (fx fy cx cy), else another
    program's file, or the only YAML, in the folder. The layout itself has no such file; without one, 640x480
    images get 525 525 319.5 239.5, which TUM recommends for all its sequences because the depth is registered to the
    colour image with it (folders `rgbd_bonn*`: the camera of that data set). Baseline 0.075 m (Kinect v1, Xtion).
    Images are in order of time; of several with one stamp the first counts; stamps are exact to the nanosecond.
    Faults: see `DepthFolder`. Raises SourceError with file and line for a bad depth.txt.
    """

    layout = "stamped depth images (depth.txt or depth/*.png)"
    parts = (Part((LIST, f"{IMAGES}/*"), "depth images"),)
    depth_scale = 1 / 5000
    baseline = 0.075
    intrinsics = (525.0, 525.0, 319.5, 239.5)

    def list_images(self) -> list[ImageFile]:
        """Return the image files in order of time; of several with one stamp, the first."""
        lines = _lines(self.folder)
        images = by_time(lines)
        if len(lines) > len(images):
            self.notes = (f"{self.folder}: left out {len(lines) - len(images)} images with a stamp used before",)
        if not images:
            raise SourceError(f"{self.folder}: {LIST} and {IMAGES}/ name no image; give a folder with images")
        return [ImageFile(self.folder / name, stamp_ns) for stamp_ns, name, _ in images]

    def list_photos(self) -> list[ImageFile]:
        """Return the pictures of rgb.txt, else of associations.txt, else of rgb/ or color/."""
        return [ImageFile(self.folder / name, stamp_ns) for stamp_ns, name, _ in by_time(_photo_lines(self.folder))]

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera from the folder."""
        yaml = [name for name in sorted(file_names(self.folder)) if name.endswith((".yaml", ".yml"))]
        default = BONN_INTRINSICS if self.name.startswith(BONN) else self.intrinsics
        names = (*NAMES, *(yaml if len(yaml) == 1 else ()))
        return find_camera([self.folder], size, self.baseline, default, names)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a list of depth images, or a folder of them named by their times.

        Numbered images are not TUM's: recorders of depth cameras write those, in millimetres (see `DepthOnly`).
        """
        return _is_stamped(Path(folder_part(where)))


class TumRgbd(StampedImages):
    """Stamped images (see `StampedImages`) with `groundtruth.txt`, the poses of the optical frame.

    Without it, if depth.txt or associations.txt lists the images or their names are times, the poses of a SLAM program
    (`CameraTrajectory.txt` and the like), with a note. World: the poses' (TUM's motion capture: z up).
    Pose: interpolated between the neighbours of the image's time, linear in position and rotation angle; both must
    be less than 0.1 s away, or the motion smooth. Further faults: those of `Poses.at`.
    """

    layout = "a TUM RGB-D folder (depth.txt or depth/*.png, with groundtruth.txt)"
    parts = (
        *StampedImages.parts,
        Part(
            (POSES, *OTHER_POSES), "poses", f"write {POSES} with lines '{FORMAT}', or add ?poses=FILE (other forms too)"
        ),
    )

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses of groundtruth.txt, else of a SLAM program."""
        if os.path.isfile(self.folder / POSES):
            return Trajectory(self.folder / POSES)
        path = _other_poses(self.folder)
        if path is None:
            raise NoPoses(f"{self.folder}: has no {POSES}; {self.parts[-1].cure}")
        self.notes += (f"{self.folder} has no {POSES}: using poses of {path.name}; else add ?poses=FILE",)
        return self.fitted(Trajectory(path))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with poses, and a list or folder of depth images."""
        folder = folder_part(where)
        if os.path.isfile(os.path.join(folder, POSES)):
            return super().recognises(where) or os.path.isdir(os.path.join(folder, IMAGES))
        return super().recognises(where) and _posed(where)

    @classmethod
    def depth_only(cls, where: str) -> StampedImages:
        """Return the images without searching for poses: every pose is NaN."""
        return StampedImages(where, posed=False)


def _posed(where: str) -> bool:
    folder = folder_part(where)
    return "poses=" in where[len(folder) :] or _other_poses(Path(folder)) is not None


def _other_poses(folder: Path) -> Path | None:
    """Return the file of a SLAM program whose lines look like stamped poses, None if missing."""
    paths = (path for pattern in OTHER_POSES for path in sorted(folder.glob(pattern)))
    return next((path for path in paths if _is_trajectory(path)), None)


def _is_trajectory(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            start = file.read(4096).decode(errors="replace").splitlines()
        words = next((plain.split() for line in start if (plain := line.partition("#")[0].strip())), [])
        return len(words) == 8 and all(math.isfinite(float(word)) for word in words)
    except (OSError, ValueError):
        return False


def _is_stamped(folder: Path) -> bool:
    """Return whether the images have times: in a list, or as their names."""
    if any(os.path.isfile(folder / name) for name in (LIST, *PAIRED)):
        return True
    try:
        names = sorted(name for name in os.listdir(folder / IMAGES) if name.lower().endswith(SUFFIXES))
    except (OSError, ValueError):
        return False
    return bool(names) and re.fullmatch(r"\d+\.\d{3,}", os.path.splitext(names[0])[0]) is not None


def _lines(folder: Path) -> list[StampedLine]:
    paired = next((folder / name for name in PAIRED if os.path.isfile(folder / name)), None)
    if os.path.isfile(folder / LIST):
        return _listed(folder / LIST)
    if paired is not None:
        return _columns(paired)[0]
    return _named(folder, IMAGES, SUFFIXES)


def _photo_lines(folder: Path) -> list[StampedLine]:
    """Return the pictures of a folder, [] if their list is unusable: maps do not need them."""
    paired = next((folder / name for name in PAIRED if os.path.isfile(folder / name)), None)
    try:
        if os.path.isfile(folder / PHOTO_LIST):
            return _listed(folder / PHOTO_LIST)
        place = next((name for name in FOLDERS if os.path.isdir(folder / name)), FOLDERS[0])
        found = _columns(paired)[1] if paired else _named(folder, place, PHOTO_SUFFIXES)
        return [line for line in found if inside(line[1], line[2])]
    except SourceError:
        return []


def _listed(path: Path) -> list[StampedLine]:
    lines = stamped_lines(path)
    for _, name, where in lines:
        if not name:
            raise SourceError(f"{where}: needs 'stamp file'; correct or delete the line")
        inside(name, where)
    return lines


def _columns(path: Path) -> tuple[list[StampedLine], list[StampedLine]]:
    """Return the depth images and the pictures of lines `stamp file stamp file`.

    Depth is the column with `depth` in its names, else the second.
    """
    lines = [(stamp_ns, rest.split(), where) for stamp_ns, rest, where in stamped_lines(path)]
    bad = next((where for _, words, where in lines if len(words) != 3), None)
    if bad:
        raise SourceError(f"{bad}: needs 'stamp file stamp file'; correct or delete the line")
    columns: tuple[list[StampedLine], list[StampedLine]] = [], []
    for stamp_ns, (name, stamp, other), where in lines:
        try:
            columns[0].append((stamp_ns, name, where))
            columns[1].append((ns_from_seconds(stamp), other, where))
        except ValueError as error:
            raise SourceError(f"{where}: {error}; correct or delete the line") from None
    first = bool(lines) and "depth" in lines[0][1][0] and "depth" not in lines[0][1][2]
    depth, photos = columns if first else columns[::-1]
    for _, name, where in depth:
        inside(name, where)
    return depth, photos


def _named(folder: Path, inner: str, suffixes: tuple[str, ...]) -> list[StampedLine]:
    images = [f"{inner}/{name}" for name in sorted(file_names(folder / inner)) if name.lower().endswith(suffixes)]
    return [(_stamp(folder / image), image, image) for image in images]


def _stamp(path: Path) -> int:
    try:
        return ns_from_seconds(path.stem)
    except ValueError as error:
        raise SourceError(f"{path}: {error}; name images by their time or list them in {LIST}") from None
