# SPDX-License-Identifier: Apache-2.0
"""The lidar of KITTI's recordings: `DRIVE?sensor=velodyne`, or with the images: `DRIVE?sensor=both`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import AnyFrame, Cloud
from stereovox.sources.base import Source
from stereovox.sources.clouds.options import CloudSource, LidarOptions, options_of
from stereovox.sources.kitti.base import KittiSource
from stereovox.sources.kitti.odometry import KittiOdometry
from stereovox.sources.kitti.raw import KittiRaw
from stereovox.sources.kitti.tracking import KittiTracking
from stereovox.sources.rgbd.folder import folder_part

SENSOR, BOTH = "velodyne", "both"
LAYOUTS = (KittiRaw, KittiTracking, KittiOdometry)


@dataclass(frozen=True)
class Options(LidarOptions):
    """Options of `LidarOptions`, and `sensor`: `velodyne` or `both`; all others are the recording's."""

    sensor: str = ""


class Velodyne(CloudSource):
    """The clouds of a KITTI raw drive, a tracking or an odometry sequence, as measured.

    where: as for the recording's images, with `?sensor=velodyne`, other options after an `&`.
    Points: from the `.bin` files; they have no times, so each cloud counts as measured at once.
    World, poses and times: the recording's. Faults: `missing_file`, `unreadable`, `no_pose`, `bad_pose_file`.
    Raises SourceError as for the recording, and if it has no lidar.

    Attributes:
        drive: The recording.
    """

    layout = "the lidar of a KITTI recording (DRIVE?sensor=velodyne)"
    up = "z"

    def __init__(self, where: str):
        folder = folder_part(where)
        options, others = options_of(where, len(folder), Options)
        inner = "&".join(f"{key}={text}" for key, text in others.items())
        whole = f"{folder}?{inner}" if inner else folder
        kind = next(kind for kind in LAYOUTS if kind.recognises(folder))
        self.drive: KittiSource = kind(whole)
        if not self.drive.has_lidar:
            raise SourceError(f"{where}: has no lidar scans, or no calibration of the lidar; leave ?sensor= out")
        self.lidar, self.name = options.lidar, f"{self.drive.name} {SENSOR}"
        self.notes = self.drive.notes

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` requests the lidar of a KITTI recording."""
        folder = folder_part(where)
        return _asked(where) == SENSOR and any(kind.recognises(folder) for kind in LAYOUTS)

    def __len__(self) -> int:
        return len(self.drive)

    def stamp_ns(self, i: int) -> int:
        """Return the time of cloud `i`."""
        return self.drive.stamp_ns(i)

    def file(self, i: int) -> Path:
        """Return its file."""
        return self.drive.velodyne(i)

    def cloud(self, i: int) -> Cloud:
        """Return cloud `i`."""
        scan = self.drive.scan(i)
        if scan is None:
            raise FrameRefused("missing_file", f"{self.file(i)}: this frame's calibration has no lidar; leave it out")
        return Cloud(scan.points, scan.T_world_lidar, scan.stamp_ns, self.lidar, name=str(self.file(i)), sensor=SENSOR)


class CameraAndVelodyne(Source):
    """The images and the clouds of such a recording, alternating: both make one map.

    where: as for `Velodyne`, with `?sensor=both`. Each stereo pair is followed by the cloud
    of the same time.
    """

    layout = "images and lidar of a KITTI recording (DRIVE?sensor=both)"
    up = "z"

    def __init__(self, where: str):
        self._clouds = Velodyne(where)
        self.name, self.notes, self.camera = (
            f"{self._clouds.drive.name} both",
            self._clouds.notes,
            self._clouds.drive.camera,
        )

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` requests both."""
        folder = folder_part(where)
        return _asked(where) == BOTH and any(kind.recognises(folder) for kind in LAYOUTS)

    def __len__(self) -> int:
        return 2 * len(self._clouds)

    def frame(self, i: int) -> AnyFrame:
        """Return frame `i`."""
        number, turn = divmod(range(len(self))[i], 2)
        return (self._clouds if turn else self._clouds.drive).frame(number)


def _asked(where: str) -> str:
    """Return the value of the option `sensor`, "" without it; never raises."""
    words = where[len(folder_part(where)) :].lstrip("?").split("&")
    return next((text for key, _, text in (word.partition("=") for word in words) if key == "sensor"), "")
