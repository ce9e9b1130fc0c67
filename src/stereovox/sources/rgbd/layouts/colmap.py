# SPDX-License-Identifier: Apache-2.0
"""Folders with a model of COLMAP and depth images: of a depth camera, or COLMAP's own."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.calibration.intrinsics import metres_per_unit, scaled
from stereovox.sources.photos import spread
from stereovox.sources.poses.trajectory import inside
from stereovox.sources.rgbd.depth_files import SUFFIXES, Depth, Undistortion, depth_size, read_depth
from stereovox.sources.rgbd.depth_unit import unit_words
from stereovox.sources.rgbd.folder import SECOND, DepthFolder, ImageFile, folder_part
from stereovox.sources.rgbd.layouts.colmap_model import UNDISTORT, ColmapImage, ColmapModel, read_model
from stereovox.sources.rgbd.pose_files import ImagePoses, number_in

ROOTS = ("dense", "dense/0", "")
"""Possible places of COLMAP's own depth maps: `ROOT/stereo/depth_maps`."""
MODELS = ("sparse", "sparse/0", "", "colmap/sparse/0", "colmap/sparse", "dense/sparse", "model")
"""Possible places of the model."""
DEPTHS = ("depth", "depths", "depth_images", "depth_maps")
OWN = ("geometric", "photometric")
"""COLMAP's own kinds of depth maps, the better one first."""
SAMPLES, LEAST_POINTS, AGREE = 30, 50, 0.1
"""Images whose points are compared with depth; required points; their largest median relative difference."""
SAME = 0.02
"""A model whose unit differs from a metre by less is in metres."""


class Colmap(DepthFolder):
    """A model of COLMAP (text or binary, in the folder, `sparse/`, `sparse/0/` or `dense/sparse/`) with depth images.

    Depth: an image in `depth/` for each of the model's, of the same name; else COLMAP's own (`stereo/depth_maps`).
    COLMAP's poses have their own unit. With images of a depth camera it is found from the model's points, whose
    depths the images show, and the map is in metres; with COLMAP's own depth the map is in COLMAP's unit. A note
    reports either. World: the model's, with arbitrary axes.
    Camera: the model's, scaled to the depth images. Distorted ones are undistorted (nearest pixel), fisheye refused.
    Images without depth are left out and counted. Times: number in order of names / 30 Hz.
    """

    layout = "a COLMAP model (sparse/ or sparse/0/) with depth/ or stereo/depth_maps/"
    parts = (
        Part(tuple(f"{place}/images.*".lstrip("/") for place in MODELS), "COLMAP poses"),
        Part(
            tuple(f"{place}/*" for place in (*DEPTHS, "stereo/depth_maps", "dense/stereo/depth_maps")),
            "depth images",
            "put one for each image into depth/, of the same name, or run: colmap patch_match_stereo",
        ),
    )

    def list_images(self) -> list[ImageFile]:
        """Return the depth images of the model's images, in the order of the numbers in their names."""
        folder, self._own = _places(self.folder)
        self._model: ColmapModel = read_model(folder)
        every = sorted(self._model.images, key=lambda image: number_in(image.name))
        found = [(image, path) for image in every if (path := self._depth_path(image.name))]
        if not found:
            raise SourceError(
                f"{self.folder}: none of the {len(every)} images of {folder} has a depth image; put one for each into "
                f"depth/, of the same name{f' ({Path(every[0].name).stem[:40]}.png)' if every else ''}"
            )
        if len(found) < len(every):
            self.notes += (f"{folder}: {len(every) - len(found)} images have no depth image, left out",)
        self._posed_images = [image for image, _ in found]
        return [ImageFile(path, int(n * SECOND / self.fps)) for n, (_, path) in enumerate(found)]

    def read_poses(self) -> ImagePoses:
        """Return the poses of the images in metres, or in COLMAP's unit if depth is COLMAP's own too."""
        scale = 1.0 if self._own else self._metres_per_unit()
        if self._own:
            self.notes += (f"{self.folder}: depth and poses are in COLMAP's own unit, not metres; so is the map",)
        poses = []
        for image in self._posed_images:
            T = image.T_world_camera.copy()
            T[:3, 3] *= scale
            poses.append(T)
        return ImagePoses(poses, str(self.folder))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera of the first image."""
        if (self.folder / "camera.toml").is_file():
            return super().find_camera(size)
        self._cameras = {number: self._pinhole(number, size) for number in {i.camera for i in self._posed_images}}
        self._undistort = {
            number: Undistortion(camera, self._model.cameras[number].coefficients)
            for number, camera in self._cameras.items()
        }
        moved = max(undistort.moved_px for undistort in self._undistort.values())
        notes = (f"{self.folder}: images are distorted by up to {moved:.1f} pixels; depth is undistorted",)
        return FoundCamera(self._cameras[self._posed_images[0].camera], notes if moved else ())

    def camera_of(self, i: int) -> PinholeCamera:
        """Return the camera of frame `i`."""
        return self._cameras[self._posed_images[i].camera] if self._uses_model() else self.camera

    def read(self, i: int) -> Depth:
        """Return depth image `i`, undistorted; raises FrameRefused."""
        depth = super().read(i)
        return self._undistort[self._posed_images[i].camera](depth) if self._uses_model() else depth

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with a model and a folder of depth images."""
        folder = folder_part(where)
        return model_folder(folder) is not None and cls.parts[1].count(folder) > 0

    def _uses_model(self) -> bool:
        return not self.options.camera and not (self.folder / "camera.toml").is_file()

    def _depth_path(self, name: str) -> Path | None:
        inside(name, f"{self.folder}: image names")
        if self._own is not None:
            return next((path for kind in OWN if (path := self._own / f"{name}.{kind}.bin").is_file()), None)
        stem, _ = os.path.splitext(name)
        tries = (
            self.folder / place / f"{start}{suffix}"
            for place in DEPTHS
            for start in dict.fromkeys((stem, name, os.path.basename(stem)))
            for suffix in SUFFIXES
        )
        return next((path for path in tries if path.is_file()), None)

    def _pinhole(self, number: int, size: tuple[int, int]) -> PinholeCamera:
        camera = self._model.cameras[number]
        x, y = size[0] / camera.size[0], size[1] / camera.size[1]
        if abs(x / y - 1) > 0.02:
            raise SourceError(
                f"{self.folder}: camera {number} is for {camera.size[0]}x{camera.size[1]} images, depth has "
                f"{size[0]}x{size[1]}; if depth is of undistorted images, {UNDISTORT}"
            )
        try:
            return pinhole(size, scaled(camera.intrinsics, x, y), None)
        except SourceError as error:
            raise SourceError(f"{self.folder}: camera {number}: {error}") from None

    def _metres_per_unit(self) -> float:
        """Return the length of the model's unit, found from its points in the depth images; else 1 with a note."""
        ratios = [np.empty(0)]
        chosen = spread([image.path for image in self._images], SAMPLES)[:SAMPLES]
        by_path = {file.path: image for file, image in zip(self._images, self._posed_images, strict=True)}
        for path in chosen:
            try:
                ratios.append(self._ratios(by_path[path], path))
            except FrameRefused:
                continue  # reported when it is read
        found = np.concatenate(ratios)
        scale = float(np.median(found)) if len(found) else 1.0
        off = float(np.median(np.abs(found / scale - 1))) if len(found) else 1.0
        if len(found) < LEAST_POINTS or not off < AGREE:
            few = f"{len(found)} points are seen in depth images" if len(found) < LEAST_POINTS else "depths do not fit"
            self.notes += (
                f"{self.folder}: poses are assumed to be in metres; COLMAP's unit could not be found: {few}",
            )
            return 1.0
        if abs(scale - 1) < SAME:
            return 1.0
        self.notes += (
            f"{self.folder}: poses are scaled by {scale:.4g}, as {len(found)} points of the model show (half within "
            f"{100 * off:.1f} %) if depth is in {unit_words(self._unit)}; else give {self.folder}?depth_scale=5000",
        )
        return scale

    def _ratios(self, image: ColmapImage, path: Path) -> NDArray[np.float64]:
        """Return metres per unit of the model from each of its points (K,) in a depth image."""
        known = [k for k, number in enumerate(image.points.tolist()) if number in self._model.points]
        if not known:
            return np.empty(0)
        depth = read_depth(path, depth_size(path))
        self._unit = metres_per_unit(self.options.depth_scale) or (1.0 if depth.dtype.kind == "f" else self.depth_scale)
        points = np.array([self._model.points[int(image.points[k])] for k in known])
        z = transform_points(inverse(image.T_world_camera), points)[:, 2]
        factor = np.array(depth.shape[::-1]) / self._model.cameras[image.camera].size
        u, v = np.rint((image.pixels[known] + 0.5) * factor - 0.5).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0]) & (z > 0)
        seen = depth[v[inside], u[inside]].astype(float)
        usable = np.isfinite(seen) & (seen > 0) & ((seen < 65535) | (depth.dtype != np.uint16))
        return seen[usable] * self._unit / z[inside][usable]


def model_folder(folder: str | os.PathLike[str], places: Sequence[str] = MODELS) -> Path | None:
    """Return the first of `places` in a folder with cameras and images of a model, None if missing."""
    for place in places:
        for suffix in (".bin", ".txt"):
            paths = [os.path.join(folder, place, f"{name}{suffix}") for name in ("cameras", "images")]
            if all(map(os.path.isfile, paths)):
                return Path(folder) / place
    return None


def _places(folder: Path) -> tuple[Path, Path | None]:
    """Return the folder of the model, and the folder of COLMAP's own depth maps if there are no others."""
    others = any((folder / place).is_dir() for place in DEPTHS)
    for root in () if others else ROOTS:
        own = folder / root / "stereo/depth_maps"
        model = model_folder(folder, (f"{root}/sparse".lstrip("/"), f"{root}/sparse/0".lstrip("/")))
        if own.is_dir() and model is not None:
            return model, own
    model = model_folder(folder)
    if model is None:
        raise SourceError(f"{folder}: has no model of COLMAP (cameras and images, .bin or .txt); copy it into sparse/")
    return model, None
