# SPDX-License-Identifier: Apache-2.0
"""stereovox: depth and stereo camera streams with poses in, calibrated occupancy maps out."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from stereovox.cameras.lidar import Lidar as Lidar
    from stereovox.cameras.lidar import RangeSensor as RangeSensor
    from stereovox.cameras.pinhole import PinholeCamera as PinholeCamera
    from stereovox.cameras.rigs import StereoPair as StereoPair
    from stereovox.cameras.wide import CylindricalCamera as CylindricalCamera
    from stereovox.cameras.wide import SphericalCamera as SphericalCamera
    from stereovox.config import Config as Config
    from stereovox.config import load_config as load_config
    from stereovox.correct.close_loops import ClosedMap as ClosedMap
    from stereovox.correct.close_loops import LoopClosure as LoopClosure
    from stereovox.correct.close_loops import close_loops as close_loops
    from stereovox.correct.corrected_poses import CorrectedPoses as CorrectedPoses
    from stereovox.correct.corrected_poses import OdometryJumps as OdometryJumps
    from stereovox.correct.corrected_poses import poses_by_path as poses_by_path
    from stereovox.correct.merge_maps import Joined as Joined
    from stereovox.correct.merge_maps import join as join
    from stereovox.correct.merge_maps import merge as merge
    from stereovox.correct.remap import Remapped as Remapped
    from stereovox.correct.remap import remap as remap
    from stereovox.depth.cloud import deskewed as deskewed
    from stereovox.descriptions import describe as describe
    from stereovox.errors import StereovoxError as StereovoxError
    from stereovox.evaluate.trajectory_score import TrajectoryScore as TrajectoryScore
    from stereovox.evaluate.trajectory_score import score_trajectory as score_trajectory
    from stereovox.fleet import FleetMap as FleetMap
    from stereovox.fleet import FleetPlan as FleetPlan
    from stereovox.fleet import FleetScores as FleetScores
    from stereovox.fleet import ScoreOptions as ScoreOptions
    from stereovox.fleet import map_fleet as map_fleet
    from stereovox.fleet import plan_fleet as plan_fleet
    from stereovox.fleet import score_fleet as score_fleet
    from stereovox.formats import export as export
    from stereovox.formats import import_map as import_map
    from stereovox.formats.meshes import surface as surface
    from stereovox.frame import Cloud as Cloud
    from stereovox.frame import DepthImage as DepthImage
    from stereovox.frame import Frame as Frame
    from stereovox.frame import Photo as Photo
    from stereovox.frame import Range as Range
    from stereovox.frame import Reason as Reason
    from stereovox.frame import Scan as Scan
    from stereovox.frame import StereoFrame as StereoFrame
    from stereovox.live.rig import LiveCamera as LiveCamera
    from stereovox.live.run import LiveResult as LiveResult
    from stereovox.live.run import LiveRun as LiveRun
    from stereovox.live.run import map_live as map_live
    from stereovox.mapper import AnyMapper as AnyMapper
    from stereovox.mapper import GridMapper as GridMapper
    from stereovox.mapper import Mapper as Mapper
    from stereovox.mapper import UpdateReport as UpdateReport
    from stereovox.mapping.rebuild import CorrectionReport as CorrectionReport
    from stereovox.maps import State as State
    from stereovox.maps import VoxelMap as VoxelMap
    from stereovox.maps import load_map as load_map
    from stereovox.maps import save_boxed as save_boxed
    from stereovox.maps.grid_map import GridMap as GridMap
    from stereovox.maps.occupancy import OccupancyGrid as OccupancyGrid
    from stereovox.maps.record.health import Health as Health
    from stereovox.mavlink.link import MavlinkLink as MavlinkLink
    from stereovox.mavlink.pose_sender import PoseSender as PoseSender
    from stereovox.mavlink.poses import PoseReceiver as PoseReceiver
    from stereovox.mavlink.poses import receive_poses as receive_poses
    from stereovox.mavlink.sectors import DirectionRules as DirectionRules
    from stereovox.mavlink.sectors import SectorRules as SectorRules
    from stereovox.mavlink.sectors import obstacle_sectors as obstacle_sectors
    from stereovox.mavlink.sending import ObstacleSender as ObstacleSender
    from stereovox.opening import open_images as open_images
    from stereovox.opening import open_source as open_source
    from stereovox.products.difference import difference as difference
    from stereovox.products.distance import DistanceField as DistanceField
    from stereovox.products.edit import coarsen as coarsen
    from stereovox.products.edit import crop as crop
    from stereovox.products.frontiers import frontiers as frontiers
    from stereovox.products.ground import ground as ground
    from stereovox.products.level_ways import LevelPlanner as LevelPlanner
    from stereovox.products.level_ways import Waypoints as Waypoints
    from stereovox.products.path_check import check_path as check_path
    from stereovox.ros.nav2 import write_nav2 as write_nav2
    from stereovox.runs.floor import FloorRun as FloorRun
    from stereovox.runs.floor import map_floor as map_floor
    from stereovox.runs.recording import MapResult as MapResult
    from stereovox.runs.recording import MapRun as MapRun
    from stereovox.runs.recording import map_recording as map_recording
    from stereovox.runs.trajectory import CameraTrack as CameraTrack
    from stereovox.runs.trajectory import track_recording as track_recording
    from stereovox.sources.imu import ImuReadings as ImuReadings
    from stereovox.sources.imu import LiveImu as LiveImu
    from stereovox.sources.latest import Latest as Latest
    from stereovox.sources.poses.live_poses import LivePoses as LivePoses
    from stereovox.sources.poses.poses import Poses as Poses
    from stereovox.track.tracker import Tracked as Tracked
    from stereovox.track.tracker import Tracker as Tracker
    from stereovox.view.loops import loops_picture as loops_picture
    from stereovox.view.trajectory import trajectory_picture as trajectory_picture
    from stereovox.viewer.live import LiveView as LiveView
    from stereovox.viewer.viewer import open_viewer as open_viewer

__version__ = "0.1.0"

_HOMES = {
    "Lidar": "cameras.lidar",
    "RangeSensor": "cameras.lidar",
    "PinholeCamera": "cameras.pinhole",
    "Config": "config",
    "load_config": "config",
    "StereovoxError": "errors",
    "Cloud": "frame",
    "DepthImage": "frame",
    "Frame": "frame",
    "Photo": "frame",
    "Range": "frame",
    "Scan": "frame",
    "StereoFrame": "frame",
    "StereoPair": "cameras.rigs",
    "SphericalCamera": "cameras.wide",
    "CylindricalCamera": "cameras.wide",
    "Reason": "frame",
    "Health": "maps.record.health",
    "AnyMapper": "mapper",
    "GridMapper": "mapper",
    "Mapper": "mapper",
    "UpdateReport": "mapper",
    "CorrectionReport": "mapping.rebuild",
    "State": "maps",
    "VoxelMap": "maps",
    "load_map": "maps",
    "save_boxed": "maps",
    "describe": "descriptions",
    "GridMap": "maps.grid_map",
    "OccupancyGrid": "maps.occupancy",
    "TrajectoryScore": "evaluate.trajectory_score",
    "score_trajectory": "evaluate.trajectory_score",
    "export": "formats",
    "import_map": "formats",
    "DistanceField": "products.distance",
    "LevelPlanner": "products.level_ways",
    "Waypoints": "products.level_ways",
    "check_path": "products.path_check",
    "coarsen": "products.edit",
    "crop": "products.edit",
    "difference": "products.difference",
    "frontiers": "products.frontiers",
    "ground": "products.ground",
    "Joined": "correct.merge_maps",
    "join": "correct.merge_maps",
    "merge": "correct.merge_maps",
    "CorrectedPoses": "correct.corrected_poses",
    "OdometryJumps": "correct.corrected_poses",
    "poses_by_path": "correct.corrected_poses",
    "deskewed": "depth.cloud",
    "Poses": "sources.poses.poses",
    "ClosedMap": "correct.close_loops",
    "LoopClosure": "correct.close_loops",
    "close_loops": "correct.close_loops",
    "Remapped": "correct.remap",
    "remap": "correct.remap",
    "surface": "formats.meshes",
    "FloorRun": "runs.floor",
    "map_floor": "runs.floor",
    "write_nav2": "ros.nav2",
    "MapResult": "runs.recording",
    "MapRun": "runs.recording",
    "map_recording": "runs.recording",
    "LiveCamera": "live.rig",
    "LiveResult": "live.run",
    "LiveRun": "live.run",
    "map_live": "live.run",
    "FleetMap": "fleet",
    "FleetPlan": "fleet",
    "FleetScores": "fleet",
    "ScoreOptions": "fleet",
    "map_fleet": "fleet",
    "plan_fleet": "fleet",
    "score_fleet": "fleet",
    "DirectionRules": "mavlink.sectors",
    "MavlinkLink": "mavlink.link",
    "PoseReceiver": "mavlink.poses",
    "receive_poses": "mavlink.poses",
    "SectorRules": "mavlink.sectors",
    "obstacle_sectors": "mavlink.sectors",
    "ObstacleSender": "mavlink.sending",
    "PoseSender": "mavlink.pose_sender",
    "open_images": "opening",
    "open_source": "opening",
    "ImuReadings": "sources.imu",
    "LiveImu": "sources.imu",
    "Latest": "sources.latest",
    "LivePoses": "sources.poses.live_poses",
    "Tracked": "track.tracker",
    "Tracker": "track.tracker",
    "CameraTrack": "runs.trajectory",
    "track_recording": "runs.trajectory",
    "loops_picture": "view.loops",
    "trajectory_picture": "view.trajectory",
    "open_viewer": "viewer.viewer",
    "LiveView": "viewer.live",
}
__all__ = [*_HOMES, "__version__"]


def __getattr__(name: str) -> Any:
    """Import public names when they are first used: `import stereovox` alone stays fast."""
    if name in _HOMES:
        return getattr(import_module(f"stereovox.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'stereovox' has no attribute '{name}'")


def __dir__() -> list[str]:
    """Return the public names and the modules that are imported: for tab completion."""
    return sorted({*globals(), *__all__})
