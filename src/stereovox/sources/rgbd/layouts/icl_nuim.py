# SPDX-License-Identifier: Apache-2.0
"""Renderings of ICL-NUIM (living room, office), in the form of SLAMBench and TUM's tools.

Their camera is left-handed: x right, y up, z forward, so its fy is negative (481.2 -480 319.5 239.5), and so is their
world. Both are mirrored here (see `in_other_hand`), so the room looks as in its images.
"""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.files.safe_io import MAX_LIST, read_bounded, read_text
from stereovox.geometry.se3 import Transform
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera
from stereovox.sources.calibration.intrinsics import NAMES
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.trajectory import Trajectory
from stereovox.sources.rgbd.depth_files import SUFFIXES, Depth
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, image_pattern, images_in, photos_in
from stereovox.sources.rgbd.pose_files import ImagePoses

INTRINSICS = (481.2, -480.0, 319.5, 239.5)
IMAGES, PICTURES, POSES, RENAMED = "depth", "rgb", "*.freiburg", "groundtruth.txt"
NUMBERED = re.compile(r"\d{1,6}\.\w+")
SCENE = re.compile(r"(scene_\d+_\d+)\.depth")
VECTOR = re.compile(r"(cam_pos|cam_dir|cam_up)\s*=\s*\[([^\]]*)\]")


class IclNuim(DepthFolder):
    """`depth/0.png` (1/5000 m) with `livingRoom2.gt.freiburg`, TUM's lines whose stamps are numbers of images.

    Also with `groundtruth.txt` instead, if images and stamps are such numbers and there is no camera file.
    Image 0 has no pose in the data set. World: y up. Times: number / 30 Hz.
    """

    layout = "an ICL-NUIM folder (depth/0.png with *.gt.freiburg)"
    parts = (Part((f"{IMAGES}/0.png", f"{IMAGES}/1.png"), "depth images"), Part((POSES, RENAMED), "poses"))
    depth_scale = 1 / 5000
    intrinsics = INTRINSICS
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the depth images in the order of their numbers."""
        return images_in(self.folder / IMAGES, image_pattern(), self.fps)

    def list_photos(self) -> list[ImageFile]:
        """Return the pictures next to them."""
        return photos_in(self.folder / PICTURES, self.fps)

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses by the numbers of the images."""
        path = next(iter(sorted(self.folder.glob(POSES))), self.folder / RENAMED)
        return self.fitted(Trajectory(path))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera; its poses are left-handed whatever the sign of fy in its file."""
        return super().find_camera(size)._replace(mirrored=True)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with numbered depth images and poses by number."""
        folder = Path(folder_part(where))
        images, poses = cls.parts
        return images.count(folder) > 0 and (Part(poses.patterns[:1], "").count(folder) > 0 or _is_renamed(folder))


class IclNuimScene(DepthFolder):
    """ICL-NUIM as POV-Ray wrote it: `scene_00_0000.depth` (text: metres along the ray) with `scene_00_0000.txt`.

    The texts hold cam_pos, cam_dir and cam_up. World: y up. Times: number / 30 Hz.
    """

    layout = "an ICL-NUIM scene (scene_*.depth with scene_*.txt)"
    parts = (Part(("scene_*.depth",), "depth images"), Part(("scene_*.txt",), "poses"))
    depth_scale = 1.0
    intrinsics = INTRINSICS
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the depth texts in the order of their numbers."""
        return images_in(self.folder, SCENE.pattern, self.fps)

    def size(self) -> tuple[int, int]:
        """Return (width, height): the texts lack it, the data set's is 640x480."""
        return 640, 480

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera; its poses are left-handed whatever the sign of fy in its file."""
        return super().find_camera(size)._replace(mirrored=True)

    def pose_in_file(self, i: int) -> Transform:
        """Return the pose of POV-Ray's camera; raises FrameRefused `no_pose` or `bad_pose_file`."""
        return super().pose_in_file(i) if self._poses is not None else _povray_pose(self._images[i].path)

    def read(self, i: int) -> Depth:
        """Return the depth (height, width) float32 in metres; raises FrameRefused `missing_file` or `unreadable`."""
        path, camera = self._images[i].path, self.camera
        try:
            numbers = np.array(read_bounded(path, MAX_LIST).split(), np.float32)
        except OSError as error:
            raise FrameRefused("missing_file", f"{path}: {error.strerror}; put it back or remove it") from None
        except ValueError as error:
            raise FrameRefused("unreadable", f"{path}: {error}; copy it again or remove it") from None
        if numbers.size != camera.width * camera.height:
            raise FrameRefused("unreadable", f"{path}: holds {numbers.size} numbers, not 640 x 480; copy it again")
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = (np.arange(camera.height) - camera.cy)[:, None] / camera.fy
        return (numbers.reshape(camera.height, camera.width) / np.sqrt(1 + x**2 + y**2)).astype(np.float32)

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth texts and their cameras."""
        folder = folder_part(where)
        return all(part.count(folder) > 0 for part in cls.parts)


def _povray_pose(image: Path) -> Transform:
    path = image.with_suffix(".txt")
    try:
        found = {key: _vector(text) for key, text in VECTOR.findall(read_text(path))}
        position, forward, up = (found[key] for key in ("cam_pos", "cam_dir", "cam_up"))
    except FileNotFoundError:
        raise FrameRefused("no_pose", f"{path}: no such file; put it back or remove the image") from None
    except (OSError, ValueError, KeyError):
        raise FrameRefused(
            "bad_pose_file", f"{path}: needs cam_pos, cam_dir and cam_up of three numbers each"
        ) from None
    T = np.eye(4)
    with np.errstate(invalid="ignore", divide="ignore"):
        z = forward / np.linalg.norm(forward)
        x = np.cross(up, z)
        x /= np.linalg.norm(x)
    T[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    T[:3, 3] = position
    return T


def _vector(text: str) -> NDArray[np.float64]:
    numbers = np.array(text.replace(",", " ").split(), float)
    if numbers.shape != (3,):
        raise ValueError
    return numbers


def _is_renamed(folder: Path) -> bool:
    """Return whether images and the stamps of groundtruth.txt are small integers, and there is no camera file."""
    if any(os.path.isfile(folder / name) for name in ("camera.toml", *NAMES)):
        return False
    try:
        names = [name for name in os.listdir(folder / IMAGES) if name.lower().endswith(SUFFIXES)]
        with (folder / RENAMED).open("rb") as file:
            lines = file.read(4096).decode(errors="replace").splitlines()
    except OSError:
        return False
    stamps = [line.split()[0] for line in lines if line.strip() and not line.startswith("#")][:3]
    whole = [re.fullmatch(r"\d{1,6}(\.0*)?", stamp) for stamp in stamps]
    return bool(names) and bool(whole) and all(whole) and all(NUMBERED.fullmatch(name) for name in names)
