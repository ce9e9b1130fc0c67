# SPDX-License-Identifier: Apache-2.0
"""Depth images with a file or folder of poses next to them, the usual export of recordings."""

from __future__ import annotations

import os
import re
from pathlib import Path

from stereovox.errors import NoPoses, SourceError
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, find_camera
from stereovox.sources.calibration.intrinsics import NAMES
from stereovox.sources.photos import FOLDERS, photo_size
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.depth_files import SUFFIXES, common_depth_size
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, image_pattern, images_in, photos_in
from stereovox.sources.rgbd.pose_files import ImagePoses, read_pose_folder, read_poses

POSES = Part(
    ("poses.txt", "trajectory.log", "trajectory.txt", "traj.txt", "traj_w_c.txt", "pose.txt", "groundtruth.txt",
     "gt.txt", "*.freiburg", "CameraTrajectory.txt", "KeyFrameTrajectory.txt", "poses", "pose", "scene/trajectory.log",
     "*_scene/trajectory.log", "*.log", "trajectory.json", "*truth*.txt", "*cam*pose*.txt", "*pose*.txt",
     "*traj*.txt", "*poses*.npy"),
    "poses",
    "write poses.txt with lines 'stamp tx ty tz qx qy qz qw' or a 4x4 matrix for each image, or add ?poses=FILE",
)  # fmt: skip
POSE_FILE = r".*pose.*\d.*\.txt|.*\d.*pose.*\.txt"
"""A file with the pose of one image, next to it."""


class DepthPart(Part):
    """Depth images, which count only if the first is one: pictures have the same endings."""

    def count(self, folder: str | os.PathLike[str]) -> int:
        """Return how many depth images there are."""
        return super().count(folder) if has_depth(os.fspath(folder)) else 0


DEPTH = DepthPart(
    tuple(f"{place}{suffix}" for place in ("depth/*", "depths/*", "*depth*/*", "results/*depth*", "*depth*", "*")
          for suffix in SUFFIXES),
    "depth images",
)  # fmt: skip


class DepthAndPoses(DepthFolder):
    """Depth images in a folder `depth/` (or the like, or next to the poses) and one file or folder of poses.

    Poses: see `pose_files` for the forms; those over time need images whose names are times, all others are one for
    each image, in order of the numbers in the names. World: the poses'.
    Unit: millimetres by convention, else found from the poses (see `depth_unit`). Camera: see `find_camera`; there is
    no default. Ground robots, hand-held scanners, simulators: the user must check the poses and the camera.
    """

    layout = "depth images with a file of poses (depth/ with poses.txt, trajectory.log or traj.txt)"
    parts = (DEPTH, POSES)

    def list_images(self) -> list[ImageFile]:
        """Return the depth images in the order of their numbers or times."""
        folder, pattern = image_place(self.folder)
        return images_in(folder, pattern, self.fps)

    def list_photos(self) -> list[ImageFile]:
        """Return the pictures of a folder next to the images, if they are of the same size."""
        place = self._images[0].path.parent
        found = (photos_in(place.parent / name, self.fps) for name in FOLDERS if place != self.folder)
        photos = next(filter(None, found), [])
        size = self.camera.width, self.camera.height
        return photos if photos and photo_size(photos[0].path) == size else []

    def read_poses(self) -> Poses | ImagePoses | None:
        """Return the poses next to the images: the first file or folder with as many as there are images."""
        found, error = [], None
        for path in self.pose_places():
            try:
                found.append(
                    self.fitted(read_pose_folder(path, POSE_FILE) if path == self.folder else read_poses(path))
                )
                break
            except SourceError as refused:
                error = error or refused
        if not found:
            raise error or NoPoses(f"{self.folder}: has depth images but no poses; {POSES.cure}")
        if len(self.pose_places()) > 1:
            self.notes += (f"using poses of {found[0].where}; else add ?poses=FILE",)
        return found[0]

    def pose_places(self) -> list[Path]:
        """Return files and folders that may hold the poses, the likeliest first; the folder itself: one file per
        image."""
        places = [path for pattern in POSES.patterns for path in sorted(self.folder.glob(pattern))]
        single = [path for path in places if path.parent == self.folder and re.fullmatch(POSE_FILE, path.name)]
        if len(single) > 1:
            places = [self.folder, *(path for path in places if path not in single)]
        return list(dict.fromkeys(places))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera from the folder, or the one above."""
        names = (*NAMES, *(f"{inner}/{name}" for inner in ("intrinsic", "intrinsics", "camera") for name in NAMES))
        return find_camera([self.folder, self.folder.resolve().parent], size, self.baseline, self.intrinsics, names)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images and poses, or names its poses."""
        folder = folder_part(where)
        posed = "poses=" in where[len(folder) :] or POSES.count(folder) > 0
        return posed and has_depth(folder)

    @classmethod
    def depth_only(cls, where: str) -> DepthAndPoses:
        """Return the images without searching for poses: every pose is NaN."""
        return DepthOnly(where)


class DepthOnly(DepthAndPoses):
    """The same images without poses: all are NaN."""

    posed = False

    def read_poses(self) -> None:
        """Return None."""

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images."""
        return has_depth(folder_part(where))


def has_depth(folder: str) -> bool:
    """Return whether `folder` holds depth images: by their names, or because the first image is one."""
    if not os.path.isdir(folder):
        return False
    place, pattern = image_place(Path(folder))
    images = images_in(place, pattern, 1.0)
    named = bool(images) and "depth" in f"{place.name} {images[0].path.name}".lower()
    return named or (bool(images) and not isinstance(common_depth_size([images[0].path]), str))


def image_place(folder: Path) -> tuple[Path, str]:
    """Return the folder with the depth images, and a regular expression of their names."""
    for pattern in DEPTH.patterns:
        found = next(iter(sorted(folder.glob(pattern))), None)
        if found is not None:
            named = "depth" not in found.parent.name.lower() or found.parent == folder
            suffix = re.escape(found.suffix)
            named = named and "depth" in found.name.lower()
            return found.parent, (
                rf"[^.].*depth.*{suffix}|depth.*{suffix}" if named else image_pattern((found.suffix,))
            )
    return folder, image_pattern()
