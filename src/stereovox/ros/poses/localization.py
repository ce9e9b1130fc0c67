# SPDX-License-Identifier: Apache-2.0
"""Localise the robot live by its lidar: in a map (AMCL), or in the map that SLAM makes of the same scans.

Each scan corrects the pose of the odometry's world in the map. That is a transform like any other, so frames of all
sensors wait for it, and it is interpolated like the track of a recording.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused
from stereovox.frame import Scan
from stereovox.geometry import se2
from stereovox.geometry.pose_graph import need_gtsam
from stereovox.geometry.se3 import Transform
from stereovox.localize.amcl.localise import Localiser
from stereovox.localize.robot_track import check_start
from stereovox.localize.slam.pipeline import Slam, SlamResult
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.ros.inputs import PoseLookup, ScanInput
from stereovox.ros.poses.poses import RESET_NS, Pose, PoseBuffer
from stereovox.sources.bags.robot_messages import StampedTransform, frame_name
from stereovox.sources.bags.tf import WORLDS

NOT_LOCALISED = "not_localised"
"""Why frames are refused while the robot's pose is unknown."""
ECHOES = 1000
"""Most own transforms that are remembered, to recognise them on /tf."""


class Located(NamedTuple):
    """The pose of the robot after a scan.

    pose_map_base, pose_map_odom: (3,) float64 x, y in metres and yaw in radians. covariance: (3, 3) float64 of the
    first, metres and radians; None: unknown. particles: (N, 3) float64, its possible poses; None: unknown.
    moved: whether the scan was compared with the map. settled: whether the pose can be trusted.
    """

    stamp_ns: int
    pose_map_base: se2.Pose
    pose_map_odom: se2.Pose
    covariance: NDArray[np.float64] | None
    particles: se2.Pose | None
    moved: bool
    settled: bool


class Localization(Protocol):
    """A method of localising the robot."""

    def add(self, scan: Scan) -> Located:
        """Return the robot's pose after one more scan; raises FrameRefused for one that cannot be trusted."""
        ...

    def restart(self) -> None:
        """Start again, as at the beginning, since the clock was set back."""
        ...


class MapLocalization(Localization):
    """Adaptive Monte Carlo localisation in a map. start: (3,) x, y, yaw at the first scan; None: anywhere.

    Raises StereovoxError for a start outside the map, and as `Localiser`.
    """

    def __init__(self, grid: OccupancyGrid, config: Config, start: ArrayLike | None = None):
        self._grid, self._config = grid, config
        self._start = None if start is None else np.asarray(start, float)
        check_start(self._start, grid)
        self._localiser = Localiser(grid, config, self._start)

    def add(self, scan: Scan) -> Located:
        """Compare a scan with the map."""
        found = self._localiser.add(scan)
        return Located(
            scan.stamp_ns, found.pose_map_base, found.pose_map_odom, found.covariance, found.particles, found.moved,
            found.settled,
        )  # fmt: skip

    def place(self, pose: se2.Pose | None, std: ArrayLike | None = None) -> None:
        """Assume that the robot is at a pose (3,) at the next scan; None: anywhere. Earlier particles are discarded.

        std: (3,) metres, metres, radians; None: `amcl.start_std`. Raises StereovoxError for a pose outside the map.
        """
        check_start(pose, self._grid)
        config = self._config
        if std is not None:
            config = load_config(config, **{"amcl.start_std": tuple(map(float, np.asarray(std)))})
        self._localiser = Localiser(self._grid, config, pose)

    def restart(self) -> None:
        """Start again at the first start pose."""
        self.place(self._start)


class SlamLocalization(Localization):
    """SLAM by the scans. Raises MissingExtra without gtsam, which loops need.

    Attributes:
        bent: How often loops moved earlier poses of the robot. Anything mapped at those poses is not moved.
    """

    def __init__(self, config: Config):
        need_gtsam()
        self._config, self._slam, self.bent = config, Slam(config), 0

    def add(self, scan: Scan) -> Located:
        """Match a scan with the map so far."""
        before, poses = dict(self._slam.refused), [keyframe.pose for keyframe in self._slam.keyframes]
        pose = self._slam.add(scan)
        for reason, count in self._slam.refused.items():
            if count > before.get(reason, 0):
                raise FrameRefused(reason, f"{scan.name}: refused by SLAM: {reason}")
        self.bent += self._moved(poses)
        pose_map_odom = se2.compose(pose, se2.inverse(scan.pose_world_base))
        return Located(scan.stamp_ns, pose, pose_map_odom, None, None, len(self._slam.keyframes) > len(poses), True)

    def grid(self) -> OccupancyGrid | None:
        """Return the map so far, None if there is no map yet."""
        return self._slam.grid()

    def finish(self) -> SlamResult | None:
        """Return the polished map and track, None if no scan became part of them."""
        return self._slam.finish() if self._slam.keyframes else None

    def restart(self) -> None:
        """Begin a new map."""
        self._slam = Slam(self._config)

    def _moved(self, poses: list[se2.Pose]) -> bool:
        """Return whether a keyframe has moved by more than a cell of the map."""
        apart = [now.pose[:2] - pose[:2] for now, pose in zip(self._slam.keyframes, poses, strict=False)
                 if now.pose is not pose]  # fmt: skip
        return bool(apart) and float(np.linalg.norm(apart, axis=1).max()) > self._config.slam.voxel_size


class LocalizedPoses(PoseBuffer):
    """Poses by odometry, and by the pose of the odometry's world in the map, which scans correct (`correct`).

    world: frame of the map; "": `map`. odom: frame of the odometry's world. Others: as for `PoseBuffer`.

    Attributes:
        odom: Frame of the odometry's world.
        rival: Whether another node publishes the same transform, which is ignored.
        lost: Why the robot's pose is unknown at present; "" if it is known.
    """

    def __init__(self, world: str, base: str, extrapolate_s: float, odom: str):
        super().__init__(world or WORLDS[0], base, extrapolate_s)
        self.odom, self.rival = frame_name(odom), False
        self.lost = "no scan has been localised yet"
        self._own: deque[int] = deque(maxlen=ECHOES)

    def odometry(self, frame_id: str, stamp_ns: int) -> Pose:
        """Return the pose of a sensor in the odometry's world; raises FrameRefused `no_pose`."""
        base = self._base_of(frame_id)
        T_base_sensor = np.eye(4) if base == frame_id else self.tf.lookup(base, frame_id, stamp_ns)
        T_odom_sensor = self.tf.lookup(self.odom, frame_id, stamp_ns)
        self._base = base
        return Pose(T_odom_sensor, T_base_sensor, self.tf.off_ns(self.odom, frame_id, stamp_ns))

    def odometry_is_final(self, frame_id: str, stamp_ns: int) -> bool:
        """Return whether no later message can change the pose of a sensor in the odometry's world."""
        try:
            return self.tf.off_ns(self.odom, frame_id, stamp_ns) == 0
        except FrameRefused:
            return False

    def pose(self, frame_id: str, stamp_ns: int) -> Pose:
        """Return the pose of a sensor in the map; raises FrameRefused `not_localised` or `no_pose`."""
        try:
            return super().pose(frame_id, stamp_ns)
        except FrameRefused as error:
            if self.lost:
                raise FrameRefused(NOT_LOCALISED, f"{frame_id}: {self.lost}") from None
            raise error

    def correct(self, stamp_ns: int, T_map_odom: Transform) -> None:
        """Set the pose of the odometry's world in the map, (4, 4).

        If the robot was lost, earlier values are discarded, so that nothing is interpolated across the gap.
        """
        if self.lost:
            self.tf.forget(self.world, self.odom)
            self.lost = ""
        numbers = (*T_map_odom[:3, 3], *Rotation.from_matrix(T_map_odom[:3, :3]).as_quat())
        super()._add(StampedTransform(stamp_ns, self.world, self.odom, numbers))

    def published(self, stamp_ns: int) -> None:
        """Remember the stamp of a published transform, which comes back on /tf."""
        self._own.append(stamp_ns)

    def _add(self, one: StampedTransform, fixed: bool = False) -> None:
        if frame_name(one.child) == self.odom:
            self.rival = self.rival or one.stamp_ns not in self._own
        else:
            super()._add(one, fixed)


class Localizer:
    """Localises scan by scan; corrects `poses` and calls `located`.

    Attributes:
        poses: The poses that it corrects.
        localization: The method.
        used: Number of scans.
        refused: Refused scans by reason.
    """

    def __init__(self, localization: Localization, poses: LocalizedPoses, located: Callable[[Located], None],
                 log: Callable[[str], object] = lambda text: None):  # fmt: skip
        self.localization, self.poses, self._located, self._log = localization, poses, located, log
        self.used, self.refused = 0, Counter[str]()
        self._last_ns: int | None = None

    def counts(self) -> dict[str, object]:
        """Return the values for diagnostics."""
        state = f"lost: {self.poses.lost}" if self.poses.lost else "localised"
        return {"localisation": state, "scans_localised": self.used, "scans_refused": dict(self.refused)}

    def locate(self, scan: Scan) -> Located:
        """Localise the robot by a scan with its pose in the odometry's world; raises FrameRefused."""
        try:
            if scan.fault:
                raise FrameRefused(scan.fault, scan.fault_detail)
            if self._last_ns is not None and scan.stamp_ns < self._last_ns - RESET_NS:
                self._log("stamps went back: localisation starts again")
                self.localization.restart()
                self._last_ns = None
            found = self.localization.add(scan)
        except FrameRefused as refusal:
            self.refused[refusal.reason] += 1
            raise
        self.used, self._last_ns = self.used + 1, max(self._last_ns or 0, scan.stamp_ns)
        self._take(found)
        return found

    def forget(self) -> None:
        """Treat the pose as unknown until the next scan."""
        self.poses.lost = "the next scan will localise it"

    def _take(self, found: Located) -> None:
        if found.settled:
            self.poses.correct(found.stamp_ns, se2.lifted(found.pose_map_odom))
        else:
            self.poses.lost = "the robot may be in several places of the map; keep driving, or publish /initialpose"
        self._located(found)


class LocalizingScanInput(ScanInput):
    """Scans by which the robot is localised. mapped: whether they enter the map too."""

    def __init__(self, topic: str, localizer: Localizer, mapped: bool):
        super().__init__(topic)
        self._localizer, self._mapped = localizer, mapped

    def is_final(self, poses: PoseBuffer, frame_id: str, stamp_ns: int) -> bool:
        """Return whether the odometry's pose is final."""
        return self._localizer.poses.odometry_is_final(frame_id, stamp_ns)

    def look_up(self, poses: PoseBuffer) -> PoseLookup:
        """Return the function that looks poses up in the odometry's world."""
        return self._localizer.poses.odometry

    def frame(self, data: bytes, where: PoseLookup) -> Scan | None:
        """Localise by a scan; return it with its pose in the map if it is to be mapped."""
        scan = self.scan(data, where)
        try:
            found = self._localizer.locate(scan)
        except FrameRefused as refusal:
            return replace(scan, fault=refusal.reason, fault_detail=str(refusal)) if self._mapped else None
        if not self._mapped:
            return None
        if not found.settled:
            return replace(scan, fault=NOT_LOCALISED, fault_detail=f"{scan.name}: {self._localizer.poses.lost}")
        return replace(scan, T_world_sensor=se2.lifted(found.pose_map_odom) @ scan.T_world_sensor)
