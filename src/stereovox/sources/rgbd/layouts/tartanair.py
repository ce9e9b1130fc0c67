# SPDX-License-Identifier: Apache-2.0
"""Folders of the simulated TartanAir data sets (AirSim)."""

from __future__ import annotations

from stereovox.errors import SourceError
from stereovox.sources.base import Part
from stereovox.sources.calibration.camera_file import FoundCamera, pinhole
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.folder import DepthFolder, ImageFile, folder_part, images_in
from stereovox.sources.rgbd.pose_files import ImagePoses, read_poses

SIDES = ("left", "right", "lcam_front", "rcam_front")
FOCAL = 320.0
"""Focal length in pixels of all its images, 90 degrees wide."""


class TartanAir(DepthFolder):
    """`depth_left/000000_left_depth.npy` (metres) with `pose_left.txt`; second edition: `depth_lcam_front/*.png`.

    Poses: `tx ty tz qx qy qz qw` a line, one for each image; x forward, y right, z down for camera and world alike, so
    z points down in the map. Camera: 320 320 and the middle of the image; baseline 0.25 m. Times: 10 images a second.
    The sky is thousands of metres away. If both eyes are present, the left one is used.
    """

    up = "-z"
    layout = "a TartanAir folder (depth_left/*.npy with pose_left.txt)"
    parts = (
        Part(tuple(f"depth_{side}/[0-9]*" for side in SIDES), "depth images"),
        Part(tuple(f"pose_{side}.txt" for side in SIDES), "poses"),
    )
    baseline = 0.25
    axes = "ned"
    fps = 10.0
    certain = True

    def list_images(self) -> list[ImageFile]:
        """Return the images of the left eye, else of the right, in the order of their numbers."""
        side = next((side for side in SIDES if (self.folder / f"depth_{side}").is_dir()), None)
        if side is None:
            raise SourceError(f"{self.folder}: has no depth_left/; give the folder that holds it, such as P000")
        return images_in(self.folder / f"depth_{side}", r"\d.*\.(npy|png)", self.fps)

    def read_poses(self) -> Poses | ImagePoses:
        """Return the poses of the same eye."""
        side = self.image(0).path.parent.name.removeprefix("depth_")
        return self.fitted(read_poses(self.folder / f"pose_{side}.txt"))

    def find_camera(self, size: tuple[int, int]) -> FoundCamera:
        """Return the camera in the folder, else the data set's."""
        if any((self.folder / name).is_file() for name in ("camera.toml", *self.calibrations)):
            return super().find_camera(size)
        factor = size[0] / 640
        return FoundCamera(pinhole(size, (factor * FOCAL, factor * FOCAL, size[0] / 2, size[1] / 2), self.baseline))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` is a folder with depth images and poses named as in TartanAir."""
        return all(part.count(folder_part(where)) for part in cls.parts)
