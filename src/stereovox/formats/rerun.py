# SPDX-License-Identifier: Apache-2.0
"""Maps, and frames over time, as a recording for the Rerun viewer (.rrd)."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.depth import DepthPipeline
from stereovox.depth.cloud import checked_cloud, cloud_of
from stereovox.errors import FrameRefused, MissingExtra
from stereovox.files.safe_io import replacing
from stereovox.formats.points import cell_colours
from stereovox.frame import AnyFrame, CheckedCloud, DepthImage, Rays
from stereovox.geometry.se3 import Transform
from stereovox.kernels.threads import one_state
from stereovox.maps import VoxelMap
from stereovox.maps.storage.cubes import in_cubes

CAMERA, CELLS, PATH, CLOUD = "world/camera", "world/occupied", "world/path", "world/cloud"
TIME = "stamp"
MAX_BOXES = 300_000
"""Maps of more cells are written as points."""
MAX_POINTS = 20_000
"""Most points of a cloud; larger ones are thinned."""
WIDEST_PX = 320
"""Most columns of a depth image; larger ones are thinned."""
REWRITE_RATIO = 25
"""Least time between two writes of the map, as a multiple of the time one takes."""
PATH_COLOUR = (224, 69, 47)


@one_state
def write_rrd(voxel_map: VoxelMap, path: str | Path) -> None:
    """Write the occupied cells, the cameras' path, and the camera along it over time, for the Rerun viewer.

    Raises MissingExtra without rerun, MapFileError if the file cannot be written.
    """
    with rerun_file(path, voxel_map.config.up) as file:
        file.add_map(voxel_map)
        camera = None if voxel_map.viewpoint is None else voxel_map.viewpoint.camera
        way = voxel_map.history.path
        for sensor, stops in way.stops.items():
            for seen, pose in zip(stops, way.poses(sensor), strict=True):
                file.add_camera(camera, pose, seen.stamp_ns)


@contextmanager
def rerun_file(path: str | Path, up: str) -> Iterator[RerunFile]:
    """Yield the writer of a recording that becomes the file `path` when the block ends without an error.

    up: the world's axis that points up. Raises as `write_rrd`.
    """
    rerun = _rerun()
    with replacing(path) as file:
        stream = rerun.RecordingStream("stereovox")
        stream.save(file.name)
        axes = getattr(rerun.ViewCoordinates, f"RIGHT_HAND_{up[-1].upper()}_{'DOWN' if up.startswith('-') else 'UP'}")
        stream.log("world", axes, static=True)
        try:
            yield RerunFile(rerun, stream)
        finally:
            stream.flush()
            stream.disconnect()


class RerunFile:
    """Adds to a recording; made by `rerun_file`."""

    def __init__(self, rerun: ModuleType, stream: Any):
        self._rerun, self._stream = rerun, stream

    def add_map(self, voxel_map: VoxelMap, stamp_ns: int | None = None) -> None:
        """Add the occupied cells, coloured by height, and the path; as of a time, or for all times."""
        self._at(stamp_ns)
        cubes = in_cubes(voxel_map)
        centres, size = cubes.occupied(), cubes.voxel_size
        self._stream.log(CELLS, self._cells(centres, cell_colours(cubes, centres), size), static=stamp_ns is None)
        lines = voxel_map.history.path.lines()
        way = self._rerun.LineStrips3D(lines, colors=[PATH_COLOUR] * len(lines))
        self._stream.log(PATH, way, static=stamp_ns is None)

    def add_camera(self, camera: PinholeCamera | None, T_world_camera: Transform, stamp_ns: int) -> None:
        """Add a camera's pose at a time."""
        self._at(stamp_ns)
        pose = self._rerun.Transform3D(translation=T_world_camera[:3, 3], mat3x3=T_world_camera[:3, :3])
        self._stream.log(CAMERA, pose)
        if camera is not None:
            self._stream.log(CAMERA, self._pinhole(camera, 1))

    def add_depth(self, image: DepthImage) -> None:
        """Add a depth image, thinned, and its camera; pixels without value are 0."""
        viewpoint = image.viewpoint
        self.add_camera(None, viewpoint.T_world_camera, image.stamp_ns)
        step = -(-image.depth_m.shape[1] // WIDEST_PX)
        depth_m = image.depth_m[::step, ::step]
        millimetres = np.where(np.isfinite(depth_m), 1000 * depth_m, 0).clip(0, 65535).astype(np.uint16)
        if isinstance(image.camera, PinholeCamera):
            self._stream.log(CAMERA, self._pinhole(image.camera, step))
        self._stream.log(f"{CAMERA}/depth", self._rerun.DepthImage(millimetres, meter=1000.0))

    def add_cloud(self, cloud: CheckedCloud) -> None:
        """Add the points of a cloud and the pose of its sensor."""
        viewpoint = cloud.viewpoint
        self.add_camera(None, viewpoint.T_world_camera, cloud.stamp_ns)
        T = cloud.T_world_sensor
        points = cloud.ends[cloud.hits][:: -(-len(cloud.ends) // MAX_POINTS)] @ T[:3, :3].T + T[:3, 3]
        self._stream.log(CLOUD, self._rerun.Points3D(points.astype(np.float32)))

    def _at(self, stamp_ns: int | None) -> None:
        if stamp_ns is not None:
            self._stream.set_time(TIME, duration=np.timedelta64(stamp_ns, "ns"))

    def _pinhole(self, camera: PinholeCamera, step: int) -> Any:
        focal, principal = (camera.fx / step, camera.fy / step), (camera.cx / step, camera.cy / step)
        resolution = (-(-camera.width // step), -(-camera.height // step))
        return self._rerun.Pinhole(focal_length=focal, principal_point=principal, resolution=resolution)

    def _cells(self, centres: NDArray[np.float64], colours: NDArray[np.uint8], size: float) -> Any:
        if len(centres) > MAX_BOXES:
            return self._rerun.Points3D(centres, colors=colours, radii=size / 2)
        halves = np.full((len(centres), 3), size / 2)
        return self._rerun.Boxes3D(centers=centres, half_sizes=halves, colors=colours, fill_mode="solid")


class RerunLog:
    """Logs each frame as it is mapped, and the map as often as time permits."""

    def __init__(self, file: RerunFile, depth: DepthPipeline):
        self._file, self._depth = file, depth
        self._due = 0.0

    def after(self, voxel_map: VoxelMap, frame: AnyFrame) -> None:
        """Log a frame that was offered to the map, between two frames."""
        start = monotonic()
        try:
            if isinstance(frame, Rays):
                self._file.add_cloud(checked_cloud(cloud_of(frame, voxel_map.config), voxel_map.config))
            else:
                self._file.add_depth(self._depth.image(self._depth.matched(frame)))
        except FrameRefused:
            return
        if start >= self._due:
            self._file.add_map(voxel_map.snapshot(), int(frame.stamp_ns))
            done = monotonic()
            self._due = done + REWRITE_RATIO * (done - start)

    def finish(self, voxel_map: VoxelMap) -> None:
        """Log the map after its last frame."""
        stamp_ns = 0 if voxel_map.viewpoint is None else voxel_map.viewpoint.stamp_ns
        self._file.add_map(voxel_map.snapshot(), stamp_ns)


def _rerun() -> ModuleType:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import rerun
    except ImportError:
        raise MissingExtra("rerun-sdk", "rerun") from None
    return rerun
