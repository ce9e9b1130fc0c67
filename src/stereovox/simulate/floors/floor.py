# SPDX-License-Identifier: Apache-2.0
"""`sim:floor`: a Pioneer with a lidar and a Kinect drives through a simulated floor of a building (IST 2019).

Write the drive through a simulated floor as a bag, with the topics and frames of the robot of IST 2019.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from heapq import merge

import numpy as np
from numpy.typing import NDArray

from stereovox import registry
from stereovox.errors import ConfigError, SourceError
from stereovox.frame import Frame, Reason, Scan
from stereovox.geometry import se2
from stereovox.geometry.se3 import Transform
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.simulate.d435 import classify
from stereovox.simulate.floors.drive import STEP_NS, Kinect, Odometry, drive, kinect_camera
from stereovox.simulate.floors.layouts import Layout
from stereovox.simulate.floors.plan import FloorPlan, Rectangle
from stereovox.simulate.floors.view import LevelView, cast, with_lids
from stereovox.simulate.stage import one_of, within
from stereovox.sources import parameters
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.base import Lazy
from stereovox.sources.poses.poses import Poses
from stereovox.sources.robots.robot import Robot

PLANS = {
    "corridors": "stereovox.simulate.floors.layouts:corridors",
    "testbed": "stereovox.simulate.floors.layouts:testbed",
}
"""Functions `(shut) -> Layout`."""
START_NS = 1_575_900_000 * 10**9
"""Start of the drive: December 2019."""
ODOMETRY_HZ = 10
BEAMS, STEP_DEG = 683, 360 / 1024
RANGE = (0.02, 5.6)
SCAN_DELAY_NS, FRAME_DELAY_NS = 40_000_000, 60_000_000
"""Delays after the odometry's pose: lidar and camera do not wait for it."""


@dataclass(frozen=True)
class Options:
    """Parameters of `sim:floor`.

    plan: `corridors` or `testbed`. seed: of all noise. shut: the door to the stairs of `corridors` is closed. drift:
    factor on the odometry's errors; noise: 0 makes lidar and camera exact. speed: m/s. scan_hz, depth_hz: scans and
    depth images a second (0: none). image_width: of the Kinect, in pixels. seconds: length of the drive (0: to its last
    stop).
    """

    plan: str = "corridors"
    seed: int = 0
    shut: bool = False
    drift: float = 1.0
    noise: bool = True
    speed: float = 0.5
    scan_hz: float = 10.0
    depth_hz: float = 5.0
    image_width: int = 640
    seconds: float = 0.0

    def __post_init__(self) -> None:
        one_of("plan", self.plan, tuple(registry.names("floors", PLANS)))
        within("seed", self.seed, 0, 2**63)
        within("drift", self.drift, 0, 10)
        within("speed", self.speed, 0.05, 2)
        within("scan_hz", self.scan_hz, 0, 40)
        within("depth_hz", self.depth_hz, 0, 30)
        within("image_width", self.image_width, 16, 640)
        if self.seconds:
            within("seconds", self.seconds, 1, 100_000)


class Floor:
    """The recording of a robot that drives through a simulated floor; see `sources.robot.Robot`.

    where: `sim:floor`, or with parameters `sim:floor?plan=testbed&seed=1`; see `Options`. World of `truth` and
    `plan`: the building's, z up. Poses of scans and frames are the odometry's, which begins at 0 and drifts.
    The parameters determine everything: the same `where` gives the same recording.
    T_base_lidar, T_base_camera: (4, 4) float64, mounts of the sensors (IST 2019, III-E), the camera's frame optical.
    odometry: T_odom_base at 10 Hz. truth: T_world_base every 20 ms.
    Raises SourceError for an unknown parameter and for values out of range.
    """

    notes: tuple[str, ...] = ()

    def __init__(self, where: str = "sim:floor"):
        self.name = str(where)
        try:
            _, given = parameters.split(self.name)
            self.options = Options(**parameters.typed(given, parameters.defaults(Options)))
        except (SourceError, ConfigError) as error:
            raise SourceError(f"{where}: {error}") from None
        self.T_base_lidar = se2.lifted((0.04, 0.0, 0.0))
        self.T_base_lidar[2, 3] = 0.225
        self.T_base_camera = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0.28], [0, 0, 0, 1]])
        self.kinect = Kinect(kinect_camera(self.options.image_width))
        self.camera = self.kinect.camera
        self._poses = self._driven()
        self._stamps = START_NS + STEP_NS * np.arange(len(self._poses))
        self.truth = Poses(self._stamps, se2.lifted(self._poses), where=self.name)
        self.odometry = self._odometry()
        self.scans: Sequence[Scan] = Lazy(self._scan, range(self._count(self.options.scan_hz, SCAN_DELAY_NS)))
        self.frames: Sequence[Frame] = Lazy(self._frame, range(self._count(self.options.depth_hz, FRAME_DELAY_NS)))

    @classmethod
    def recognises(cls, where: str) -> bool:
        """Return whether `where` names this simulation."""
        return where.partition("?")[0] == "sim:floor"

    @cached_property
    def layout(self) -> Layout:
        """The floor and the robot's path."""
        return registry.find("floors", PLANS, self.options.plan)(self.options.shut)

    @property
    def plan(self) -> FloorPlan:
        """Walls and obstacles, in the world of `truth`."""
        return self.layout.plan

    @property
    def behind_door(self) -> Rectangle | None:
        """The area that a shut door closes off, in the world of `truth`; None on a floor without such a door."""
        return self.layout.behind_door

    @property
    def start(self) -> se2.Pose:
        """Start pose of the robot (3,), in the world of `truth`: the origin of the odometry's world."""
        return self._poses[0].copy()

    def true_grid(
        self, resolution: float = 0.05, heights: tuple[float, float] = (0.225, 0.225), lids: bool = False
    ) -> OccupancyGrid:
        """Return a perfect map of the floor between two heights (the lidar's), in the world of `truth`.

        lids: include the tops and undersides that the Kinect sees, as in a 3-D map seen from above: a table is
        occupied as a whole. Without them only its outline is, as beams on the floor see it.
        """
        grid = self.plan.truth(resolution, self.start[:2], heights)
        return with_lids(grid, self.plan.obstacles, heights, float(self.T_base_camera[2, 3])) if lids else grid

    def true_ranges(self, stamp_ns: int) -> NDArray[np.float64]:
        """Return the exact ranges (N,) in metres of the lidar's beams, inf beyond its reach."""
        x, y, yaw = se2.flattened(self.truth.at(stamp_ns) @ self.T_base_lidar)
        return cast(self._at_lidar, (x, y), yaw + _angles(), RANGE[1])

    def true_depth(self, stamp_ns: int) -> NDArray[np.float32]:
        """Return the exact depth (height, width) in metres along the camera's optical axis."""
        x, y, yaw = se2.flattened(self.truth.at(stamp_ns))
        forward, side = self.T_base_camera[:2, 3]
        return self._view.depth(se2.compose((x, y, yaw), (forward, side, 0.0)))

    def _scan(self, i: int) -> Scan:
        stamp = self._stamp(i, self.options.scan_hz, SCAN_DELAY_NS)
        ranges = self.true_ranges(stamp)
        if self.options.noise:
            random = np.random.default_rng([self.options.seed, 1, i])
            ranges = ranges + np.maximum(0.01, 0.01 * ranges.clip(0, 99)) * random.standard_normal(len(ranges))
        ranges = np.where(ranges > RANGE[1], np.inf, np.where(ranges < RANGE[0], -np.inf, ranges))
        pose = self.odometry.at(stamp) @ self.T_base_lidar
        name = f"{self.name} scan {i}"
        return Scan(
            ranges=ranges.astype(np.float32),
            angle_min=float(_angles()[0]),
            angle_step=float(np.radians(STEP_DEG)),
            range_min=RANGE[0],
            range_max=RANGE[1],
            T_world_sensor=pose,
            T_base_sensor=self.T_base_lidar,
            stamp_ns=stamp,
            name=name,
        )

    def _frame(self, i: int) -> Frame:
        stamp = self._stamp(i, self.options.depth_hz, FRAME_DELAY_NS)
        true = self.true_depth(stamp)
        if self.options.noise:
            depth, reason = self.kinect.measure(true, [self.options.seed, 2, i])
        else:
            reason = classify(true, self.kinect.nearest, self.kinect.farthest)
            depth = np.where(reason == Reason.VALID, true, np.float32(0))
        scale = 0.001 if self.options.noise else 1.0
        pose = self.odometry.at(stamp) @ self.T_base_camera
        name, farthest = f"{self.name} frame {i}", self.kinect.farthest
        return Frame(depth, self.camera, pose, stamp, scale, reason, name, farthest=farthest)

    def _driven(self) -> se2.Pose:
        poses = drive(self.layout.stops, self.options.speed)
        return poses[: round(self.options.seconds * 1e9 / STEP_NS) + 1] if self.options.seconds else poses

    def _odometry(self) -> Poses:
        believed = Odometry().measured(self._poses, [self.options.seed, 0], self.options.drift)
        every = round(1e9 / ODOMETRY_HZ / STEP_NS)
        return Poses(self._stamps[::every], se2.lifted(believed[::every]), where=f"{self.name}: odometry")

    def _count(self, hz: float, delay_ns: int) -> int:
        """Return the number of measurements within the odometry's time span."""
        if not hz:
            return 0
        return max(0, int((self.odometry.stamps_ns[-1] - START_NS - delay_ns) * hz / 1e9) + 1)

    def _stamp(self, i: int, hz: float, delay_ns: int) -> int:
        return START_NS + delay_ns + round(i * 1e9 / hz)

    @cached_property
    def _at_lidar(self) -> NDArray[np.float64]:
        height = float(self.T_base_lidar[2, 3])
        return self.plan.outline(height, height)

    @cached_property
    def _view(self) -> LevelView:
        return LevelView(self.plan, self.camera, float(self.T_base_camera[2, 3]))


def _angles() -> NDArray[np.float64]:
    """Return the directions of the lidar's beams, (N,) radians from straight ahead: 240 degrees in all."""
    return np.radians(STEP_DEG) * (np.arange(BEAMS) - (BEAMS - 1) / 2)


BASE, LASER, CAMERA, OPTICAL = "base_link", "laser", "camera_link", "camera_depth_optical_frame"
TRUTH = "/ground_truth"
Recorded = tuple[int, Scan | Frame | se2.Pose]


def write_bag(
    robot: Robot | Floor, path: str | os.PathLike[str], progress: Callable[[int, int], None] | None = None
) -> None:
    """Write all recordings of a simulated robot: ROS 1 for `.bag`, ROS 2 for `.mcap` and `.db3`.

    Topics: /scan, /camera/depth/image_raw and its camera_info, /odom, /tf (odom -> base_link), /tf_static, and the true
    pose in the building on /ground_truth. Depth is in millimetres, 0 for none: a bag has no reasons. progress: called
    with the done and the total number of messages: odometry poses, scans and images. Raises SourceError for robots of
    other kinds and if the file cannot be written.
    """
    if not isinstance(robot, Floor):
        raise SourceError(f"{robot.name}: only a simulated robot can be recorded; give sim:floor")
    total = len(robot.odometry) + len(robot.scans) + len(robot.frames)
    with BagWriter(path) as bag:
        _fixed(bag, robot)
        for done, (stamp_ns, one) in enumerate(merge(*_streams(robot), key=lambda recorded: recorded[0]), 1):
            if isinstance(one, Scan):
                bag.scan(one, "/scan", LASER)
            elif isinstance(one, Frame):
                bag.depth(one, "/camera/depth/image_raw", OPTICAL)
            else:
                bag.odometry(stamp_ns, one)
                bag.pose(stamp_ns, se2.flattened(robot.truth.at(stamp_ns)), topic=TRUTH, frame_id="building")
            if progress:
                progress(done, total)


def _streams(robot: Floor) -> Iterator[Iterator[Recorded]]:
    odometry = zip(robot.odometry.stamps_ns.tolist(), robot.odometry.T_world_body, strict=True)
    yield ((stamp_ns, se2.flattened(T)) for stamp_ns, T in odometry)
    yield ((scan.stamp_ns, scan) for scan in robot.scans)
    yield ((frame.stamp_ns, frame) for frame in robot.frames)


def _fixed(bag: BagWriter, robot: Floor) -> None:
    """Write the sensors' mounts; the camera's body (x forward) contains its optical frame (z forward)."""
    T_link_optical: Transform = robot.T_base_camera.copy()
    T_link_optical[:3, 3] = 0
    T_base_link = np.eye(4)
    T_base_link[:3, 3] = robot.T_base_camera[:3, 3]
    bag.fixed(BASE, LASER, robot.T_base_lidar)
    bag.fixed(BASE, CAMERA, T_base_link)
    bag.fixed(CAMERA, OPTICAL, T_link_optical)
