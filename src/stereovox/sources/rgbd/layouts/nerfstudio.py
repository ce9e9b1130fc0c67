# SPDX-License-Identifier: Apache-2.0
"""Folders with `transforms.json`, as written by nerfstudio, instant-ngp and many exporters of phone scans."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.files.safe_io import MAX_LIST, is_number, read_bounded, read_json
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.poses.trajectory import inside
from stereovox.sources.rgbd.depth_files import SUFFIXES, Depth, Undistortion
from stereovox.sources.rgbd.folder import SECOND, DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.pose_files import ImagePoses, number_in

FILE = "transforms.json"
DEPTH_KEYS = ("depth_file_path", "depth_path")
"""Keys of a frame's depth image: nerfstudio's and instant-ngp's."""
SCALE_KEYS = ("depth_unit_scale_factor", "integer_depth_scale")
"""Keys of metres per unit of the depth images."""
RADIAL = ("k1", "k2", "p1", "p2", "k3")
"""Coefficients of the distortion, in OpenCV's order."""
PLAIN_MODELS = ("", "OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "RADIAL", "SIMPLE_RADIAL")
Table = dict[str, Any]


class NerfTransforms(DepthFolder):
    """`transforms.json` whose frames name depth images (`depth_file_path`, or `depth_path` as in instant-ngp).

    Unit: millimetres by nerfstudio's convention, unless the file has `depth_unit_scale_factor` or
    `integer_depth_scale`; floats are metres. Depth is along the optical axis.
    Poses: `transform_matrix`, camera to world in OpenGL axes; the world is the file's, z up by convention.
    `applied_scale` is undone; other transforms of the world are not. Poses of COLMAP have no metric scale:
    if the images then do not fit together, a note reports it.
    Camera: fl_x fl_y cx cy w h of the frame, else of the file, scaled to the depth images. Distorted images are
    undistorted (nearest pixel); fisheye ones are refused. Frames without a depth image are left out and counted.
    Times: number of the frame / 30 Hz.
    """

    layout = "a nerfstudio folder (transforms.json whose frames have depth_file_path)"
    parts = (
        Part((FILE, "transforms*.json"), "transforms.json"),
        Part(
            tuple(f"*depth*/*{suffix}" for suffix in SUFFIXES),
            "depth images",
            "stereovox needs depth: export it too, and name it as depth_file_path in each frame",
        ),
    )
    axes = "opengl"

    def list_images(self) -> list[ImageFile]:
        """Return the depth images named by the frames, in the order of the numbers in their names."""
        self._cameras: list[PinholeCamera] = []
        self._table = _read(self.folder / FILE)
        every = self._table["frames"]
        named = [frame for frame in every if _depth_name(frame)]
        if not named:
            raise SourceError(
                f"{self.folder / FILE}: none of its {len(every)} frames has a depth image; "
                "stereovox needs depth: export it too, and name it as depth_file_path"
            )
        if len(named) < len(every):
            self.notes = (f"{self.folder / FILE}: {len(every) - len(named)} frames have no depth image, left out",)
        self._frames = sorted(named, key=lambda frame: number_in(_depth_name(frame)))
        place = str(self.folder / FILE)
        paths = [self.folder / inside(_depth_name(frame), place) for frame in self._frames]
        return [ImageFile(_existing(path), int(n * SECOND / self.fps)) for n, path in enumerate(paths)]

    def read_poses(self) -> ImagePoses:
        """Return the poses of the frames, as in the file."""
        where = str(self.folder / FILE)
        scale = self._table.get("applied_scale", 1.0)
        scale = float(scale) if is_number(scale) and scale > 0 else 1.0
        return ImagePoses([_pose(frame, scale, where) for frame in self._frames], where)

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the file, else of its first frame with depth; and the unit in the file."""
        if (self.folder / "camera.toml").is_file():
            return super().find_camera(size)
        where = self.folder / FILE
        self._cameras = [_camera({**self._table, **frame}, size, where) for frame in self._frames]
        self._undistort = Undistortion(self._cameras[0], _coefficients(self._table | self._frames[0], where))
        moved = self._undistort.moved_px
        notes = (f"{where}: pictures are distorted by up to {moved:.1f} pixels; depth is undistorted",) if moved else ()
        scale = next((self._table[key] for key in SCALE_KEYS if is_number(self._table.get(key))), 0.0)
        return FoundCamera(self._cameras[0], notes, depth_scale=scale if scale > 0 else None)

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i`."""
        return self._cameras[i] if self._cameras and not self.options.camera else self.camera

    def read(self, i: int) -> Depth:
        """Return depth image `i`, undistorted; raises FrameRefused."""
        depth = super().read(i)
        return self._undistort(depth) if self._cameras and not self.options.camera else depth

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a transforms.json that is not only the camera of another layout."""
        path = os.path.join(folder_part(where), FILE)
        if not os.path.isfile(path):
            return False
        try:
            content = read_bounded(Path(path), MAX_LIST)
        except OSError:
            return False
        named = any(key.encode() in content for key in DEPTH_KEYS)
        return named and b"frames" in content


def _read(path: Path) -> Table:
    """Return the table of a transforms.json with at least one frame; raises SourceError."""
    table = read_json(path)
    frames = table.get("frames") if isinstance(table, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise SourceError(f"{path}: has no list of frames; it must be as written by nerfstudio or instant-ngp")
    return table


def _depth_name(frame: Table) -> str:
    name = next((frame[key] for key in DEPTH_KEYS if frame.get(key)), "")
    return name if isinstance(name, str) else ""


def _existing(path: Path) -> Path:
    """Return the path, with a suffix if the file leaves it out."""
    if path.suffix.lower() in SUFFIXES:
        return path
    return next((found for suffix in SUFFIXES if (found := path.with_name(path.name + suffix)).is_file()), path)


def _pose(frame: Table, scale: float, where: str) -> Transform | str:
    try:
        T = np.array(frame.get("transform_matrix"), float)
    except (TypeError, ValueError):
        T = np.empty(0)
    if T.shape not in ((3, 4), (4, 4)):
        return f"{where}: transform_matrix of {_depth_name(frame)[:60]} is not a 4x4 matrix; correct it"
    T = np.vstack([T[:3], [0.0, 0, 0, 1]])
    T[:3, 3] /= scale
    return T


def _camera(table: Table, size: tuple[int, int], where: Path) -> PinholeCamera:
    """Return the pinhole camera of a frame, scaled to depth images of (width, height) = `size`."""
    model = str(table.get("camera_model", "")).upper()
    if model not in PLAIN_MODELS or table.get("is_fisheye"):
        raise SourceError(
            f"{where}: a {model[:40] or 'fisheye'} camera; undistort the images to a pinhole camera first"
        )
    numbers = {key: float(table[key]) for key in ("fl_x", "fl_y", "cx", "cy", "w", "h") if is_number(table.get(key))}
    width, height = numbers.get("w", float(size[0])), numbers.get("h", float(size[1]))
    if "fl_x" not in numbers and is_number(table.get("camera_angle_x")):
        numbers["fl_x"] = width / 2 / math.tan(table["camera_angle_x"] / 2) if table["camera_angle_x"] else 0.0
    if "fl_x" not in numbers:
        raise SourceError(f"{where}: has no fl_x (or camera_angle_x) of its camera; add it, or ?camera=FILE")
    if width <= 0 or height <= 0 or abs(size[0] / width / (size[1] / height) - 1) > 0.02:
        raise SourceError(
            f"{where}: is for {width:g}x{height:g} pictures, depth has {size[0]}x{size[1]}; add ?camera=FILE"
        )
    x, y = size[0] / width, size[1] / height
    fx = numbers["fl_x"] * x
    fy = numbers.get("fl_y", numbers["fl_x"]) * y
    cx, cy = numbers.get("cx", width / 2) * x - 0.5, numbers.get("cy", height / 2) * y - 0.5  # pixel 0 begins at 0
    try:
        return pinhole(size, (fx, fy, cx, cy), None)
    except SourceError as error:
        raise SourceError(f"{where}: {error}") from None


def _coefficients(table: Table, where: Path) -> list[float]:
    """Return the coefficients of the distortion; raises SourceError for a fisheye camera."""
    if is_number(table.get("k4")) and table["k4"]:
        raise SourceError(f"{where}: k4 belongs to a fisheye camera; undistort the images to a pinhole camera first")
    return [float(table[key]) if is_number(table.get(key)) else 0.0 for key in RADIAL]
