# SPDX-License-Identifier: Apache-2.0
"""Folders exported by RTAB-Map: `rtabmap-export --images --poses_camera rtabmap.db`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, is_number, read_text
from stereovox.geometry.se3 import Transform, from_quaternion
from stereovox.sources.base import Part
from stereovox.sources.calibration.calibration_files import read_yaml
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import scaled
from stereovox.sources.poses.trajectory import ns_from_seconds
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, image_pattern, images_in
from stereovox.sources.rgbd.pose_files import ImagePoses

CAMERA_POSES, BASE_POSES = "camera_poses.txt", "poses.txt"
EXPORT = "export again with: rtabmap-export --images --poses_camera FILE.db"


class RtabmapExport(DepthFolder):
    """`rtabmap_depth/`, `rtabmap_calib/` and `rtabmap_camera_poses.txt` or `rtabmap_poses.txt`, with any prefix.

    Depth: 16-bit millimetres. Poses: TUM lines, with the node's number behind them (`--poses_format 11`, the default)
    or without (10), found by the image's time, else by the node's number. `poses.txt` is for the robot's base and is
    combined with `local_transform` of each calibration. World: the graph's, z up. Each image has a camera.
    """

    up = "z"
    layout = "a folder of rtabmap-export (rtabmap_depth/, rtabmap_calib/, rtabmap_camera_poses.txt)"
    parts = (
        Part(("*_depth/*.png",), "depth images"),
        Part(("*_calib/*.yaml",), "calibrations", EXPORT),
        Part((f"*_{CAMERA_POSES}", f"*_{BASE_POSES}"), "poses", EXPORT),
    )
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the images in order of their times."""
        folder = next(iter(sorted(path for path in self.folder.glob("*_depth") if path.is_dir())), None)
        if folder is None:
            raise SourceError(f"{self.folder}: has no folder *_depth; {EXPORT}")
        self._prefix = folder.name.removesuffix("depth")
        found = images_in(folder, image_pattern((".png",)), self.fps)
        self._calibrations = [_Calibration(self._calib(image.path.stem)) for image in found]
        return [image._replace(stamp_ns=_stamp(image)) for image in found]

    def read_poses(self) -> ImagePoses:
        """Return T_world_camera of the images: the camera's own poses, else the base's with the calibrations'."""
        own = self.folder / f"{self._prefix}{CAMERA_POSES}"
        path = own if own.is_file() else self.folder / f"{self._prefix}{BASE_POSES}"
        by_time, by_node = _poses(path)
        found: list[Transform | str] = []
        for image, calibration in zip(self._images, self._calibrations, strict=True):
            T = by_time.get(image.stamp_ns)
            T = by_node.get(image.path.stem) if T is None else T
            missing = f"{path}: has no line for {image.path.name}; leave the image out"
            found.append(missing if T is None else T if path == own else T @ calibration.T_base_camera)
        return ImagePoses(found, str(path))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the first image."""
        self._size = size
        return FoundCamera(self._calibrations[0].camera(size))

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i`."""
        return self.camera if self.options.camera else self._calibrations[i].camera(self._size)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with images, calibrations and poses of one export."""
        return all(part.count(folder_part(where)) for part in cls.parts)

    def _calib(self, stem: str) -> Path:
        return self.folder / f"{self._prefix}calib" / f"{stem}.yaml"


class _Calibration:
    """The calibration of one image; raises SourceError if it is not a pinhole camera."""

    def __init__(self, path: Path):
        table, self.path = read_yaml(path), path
        width = table.get("image_width")
        self._width = float(width) if is_number(width) and width and width > 0 else 0.0
        P, K = _matrix(table, "projection_matrix", 12), _matrix(table, "camera_matrix", 9)
        if P is not None and P[0] > 0:
            self._numbers = P[[0, 5, 2, 6]].tolist()
        elif K is not None:
            self._numbers = K[[0, 4, 2, 5]].tolist()
        else:
            raise SourceError(f"{path}: has neither projection_matrix nor camera_matrix; {EXPORT}")
        local = _matrix(table, "local_transform", 12)
        self.T_base_camera = np.eye(4)
        if local is not None:
            self.T_base_camera[:3] = local.reshape(3, 4)

    def camera(self, size: tuple[int, int]) -> PinholeCamera:
        """Return the camera, scaled to images of (width, height) = `size`."""
        factor = size[0] / self._width if self._width else 1.0
        try:
            return pinhole(size, scaled(self._numbers, factor), None)
        except SourceError as error:
            raise SourceError(f"{self.path}: {error}") from None


def _matrix(table: dict, key: str, count: int) -> np.ndarray | None:
    entry = table.get(key)
    data = entry.get("data") if isinstance(entry, dict) else None
    if not isinstance(data, list) or len(data) != count or not all(map(is_number, data)):
        return None
    return np.array(data, float)


def _stamp(image: ImageFile) -> int:
    """Return the time in the name of an image; else its number."""
    try:
        return ns_from_seconds(image.path.stem) if "." in image.path.stem else image.stamp_ns
    except ValueError:
        return image.stamp_ns


def _poses(path: Path) -> tuple[dict[int, Transform], dict[str, Transform]]:
    """Return poses by time in nanoseconds and by number of the node; raises SourceError with the line."""
    by_time, by_node = {}, {}
    try:
        lines = read_text(path, MAX_LIST, "replace").splitlines()
    except OSError as error:
        raise SourceError(f"{path}: {error.strerror}; {EXPORT}") from None
    for n, line in enumerate(lines, 1):
        words = line.partition("#")[0].split()
        if not words:
            continue
        if len(words) not in (8, 9):
            raise SourceError(f"{path}:{n}: has {len(words)} numbers, not 'stamp x y z qx qy qz qw id'; {EXPORT}")
        try:
            numbers = [float(word) for word in words[1:8]]
            if any(numbers[3:]):
                T = by_time[ns_from_seconds(words[0])] = from_quaternion(numbers[:3], numbers[3:])
                by_node[words[8] if len(words) == 9 else ""] = T
        except ValueError as error:
            raise SourceError(f"{path}:{n}: {error}; correct or delete the line") from None
    return by_time, by_node
