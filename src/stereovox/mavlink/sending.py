# SPDX-License-Identifier: Apache-2.0
"""Obstacle distances from a growing map to an autopilot, at a steady rate, and none once the map is stale."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np

from stereovox.errors import StereovoxError
from stereovox.frame import R_SENSOR_OPTICAL, AnyFrame, Range, Rays, UpdateReport
from stereovox.geometry.se3 import Transform, inverse, orthonormalise, rigidity_error
from stereovox.mapper import Mapper
from stereovox.mavlink.link import MavlinkLink, Tell, warn
from stereovox.mavlink.pose_sender import Body, BodyPose
from stereovox.mavlink.sectors import INCREMENT_DEG, DirectionRules, SectorRules, nearest_places, obstacle_sectors

T_BODY_LIDAR = np.eye(4)
"""Default mount of a lidar: at the body's origin, facing ahead."""
T_BODY_LIDAR[:3, :3] = R_SENSOR_OPTICAL.T
T_BODY_LIDAR.setflags(write=False)
HIGHEST_RATE_HZ = 200.0
PATIENCE = 0.5
"""Share of a period for which a message waits for the next frame."""
POSE_SHARE = 0.6
"""Largest age of the body's pose, as a share of the map's: the body moves, most of the scene does not."""


class ObstacleSender:
    """Sends OBSTACLE_DISTANCE of a mapper's map, and OBSTACLE_DISTANCE_3D if requested.

    It is an `Observer` for `map_recording`, and `after` may be called next to any `Mapper.add`. Its own thread reads
    the map; each message is for the body's present place: its newest pose, from a frame in the map (`after`, `at`) or
    without one (`pose`), extrapolated by the motion between the last two. It waits up to half a period for the next
    frame. Unknown space ends free space, as `SectorRules.unknown` sets.


    Nothing is sent before a second frame has agreed with the first, nor once any camera's newest frame is older than
    `max_age_s` or the newest pose is older than 0.6 of that: PX4 does not move without data for 0.5 s, and ArduPilot
    reports its sensor as failed. Ages count from the event, by its stamp (`Mapper.stamp_clock`, which becomes "live"
    unless set), and at least from its arrival. After a jump of the body's pose nothing is sent until a frame from there
    is in the map.

    `time_usec` and `time_boot_ms` are the time of the oldest of the cameras' newest frames, by this machine's clock,
    which the autopilot may request (TIMESYNC). A map whose layers are not level is refused: nothing is sent.

    Args:
        mapper: The mapper whose map is sent.
        connection: A `MavlinkLink`, or the address of one, which is closed with the sender.
        rate_hz: Messages a second. PX4 was tested with 10. None: no thread; only `send` sends.
        max_age_s: Age of the newest frame's content in seconds above which nothing is sent.
        rules: Rules of OBSTACLE_DISTANCE; by default `SectorRules()`.
        directions: Rules of OBSTACLE_DISTANCE_3D; None: it is not sent.
        mounts: T_body_sensor (4, 4) by the name of the sensor: maps a camera's optical frame into the body in optical
            axes (x right, y down, z forward); for a lidar its own frame (x forward, y left, z up). One that is not
            named faces ahead at the body's origin; a range sensor that is not named gives no pose.
        tell: Called with one line when sending stops, with the reason, and when it resumes.

    Attributes:
        sent: Number of OBSTACLE_DISTANCE messages sent.
        link: The connection.

    Raises:
        StereovoxError: A value is out of range, a mount is not rigid, or as for `MavlinkLink`.
    """

    def __init__(
        self,
        mapper: Mapper,
        connection: str | MavlinkLink,
        *,
        rate_hz: float | None = 10.0,
        max_age_s: float = 0.5,
        rules: SectorRules | None = None,
        directions: DirectionRules | None = None,
        mounts: Mapping[str, Transform] | None = None,
        tell: Tell = warn,
    ):
        if rate_hz is not None and not 0.1 <= rate_hz <= HIGHEST_RATE_HZ:
            raise StereovoxError(f"rate_hz {rate_hz:g}: give 0.1 to {HIGHEST_RATE_HZ:g} messages a second")
        if not 0 < max_age_s <= 60:
            raise StereovoxError(f"max_age_s {max_age_s:g}: give seconds above 0, at most 60")
        self._mapper, self._rules, self._directions = mapper, rules or SectorRules(), directions
        self._mounts = _checked_mounts(mounts or {})
        self._period_s, self._max_age_s, self._tell = 1 / (rate_hz or HIGHEST_RATE_HZ), max_age_s, tell
        self._own = isinstance(connection, str)
        self.link = MavlinkLink(connection, tell=tell) if isinstance(connection, str) else connection
        if mapper.stamp_clock is None:
            mapper.stamp_clock = "live"
        self.sent = 0
        self._body = Body()
        self._waited_s: dict[str, float] = {}
        self._why, self._new, self._stopped = "", threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="stereovox-obstacles", daemon=True)
        if rate_hz is not None:
            self._thread.start()

    def after(self, frame: AnyFrame, report: UpdateReport) -> None:
        """Use the pose of a frame that entered the map.

        Args:
            frame: The frame that was offered to the mapper.
            report: What `Mapper.add` returned for it.
        """
        if report.refused is not None:
            return
        if isinstance(frame, Range) and frame.sensor not in self._mounts:
            return  # a sonar may look anywhere
        mount = self._mounts.get(frame.sensor, T_BODY_LIDAR if isinstance(frame, Rays) else None)
        T_world_sensor = orthonormalise(np.asarray(frame.T_world_sensor, float))
        T_world_body = T_world_sensor if mount is None else T_world_sensor @ inverse(mount)
        self.at(T_world_body, frame.sensor, stamp_ns=frame.stamp_ns or None)

    def at(self, T_world_body: Transform, sensor: str, waited_s: float = 0.0, stamp_ns: int | None = None) -> None:
        """Use the body's pose from a frame that entered the map; `after` calls it, using the mounts.

        Args:
            T_world_body: (4, 4) maps the body (optical axes) into the world.
            sensor: Name of the frame's sensor.
            waited_s: Seconds from its arrival to its entry into the map, added to its age.
            stamp_ns: The frame's; None: the stamp of the last frame in the map.
        """
        self._waited_s[sensor] = waited_s
        taken_ns = self._mapper.health().stamp_ns if stamp_ns is None else stamp_ns
        self._body.take(BodyPose(taken_ns or 0, self._mapper.now_ns(), T_world_body))
        self._new.set()

    def pose(self, stamp_ns: int, T_world_body: Transform) -> None:
        """Use a pose of the body that arrived now, without a frame.

        Args:
            stamp_ns: Its time, by the clock of the frames' stamps.
            T_world_body: (4, 4) maps the body (optical axes) into the world. One that is not finite or not rigid
                means that the pose is unknown, and is ignored.
        """
        self._mapper.heard(stamp_ns)
        if np.isfinite(T_world_body).all() and rigidity_error(T_world_body) < 1e-3:
            self._body.take(BodyPose(int(stamp_ns), self._mapper.now_ns(), T_world_body))

    def finish(self) -> None:
        """Do nothing: sending stops when the map is stale, or with `close`."""

    def close(self) -> None:
        """Stop sending, and close the connection unless it was given."""
        self._stopped.set()
        self._new.set()
        if self._thread.ident is not None:
            self._thread.join()
        if self._own:
            self.link.close()

    def __enter__(self) -> ObstacleSender:
        """Return itself."""
        return self

    def __exit__(self, *_: Any) -> None:
        """Stop sending."""
        self.close()

    def _run(self) -> None:
        due = monotonic()
        while not self._stopped.wait(max(due - monotonic(), 0)):
            self._new.clear()
            self._new.wait(PATIENCE * self._period_s)
            if self._stopped.is_set():
                return
            self.send()
            due = max(due + self._period_s, monotonic() - self._period_s)

    def send(self) -> str:
        """Send the current distances, and report when that starts or stops failing; called by the thread.

        Returns:
            Why nothing was sent; "" if it was, or no frame has arrived yet.
        """
        try:
            why = self._send()
        except Exception as error:  # on any error nothing is sent, the user is informed, and the next try may succeed
            why = f"{type(error).__name__}: {error}" if not isinstance(error, StereovoxError) else str(error)
        if bool(why) != bool(self._why):
            self._tell(f"no obstacle distances are sent: {why}" if why else "obstacle distances are sent again")
        self._why = why
        return why

    def _send(self) -> str:
        """Send the current distances; return why not, or "" if sent."""
        health, newest = self._mapper.health(), self._body.newest
        if newest is None or health.state == "waiting":
            return ""  # too little has arrived yet: not worth a report
        ages_s = {sensor: age_s + self._waited_s.get(sensor, 0.0) for sensor, age_s in health.ages_s.items()}
        sensor, age_s = max(ages_s.items(), key=lambda item: item[1])
        if age_s > self._max_age_s:
            return f"the last trusted frame{f' of {sensor}' if sensor else ''} is {age_s:.2f} s old"
        pose_age_ns = self._mapper.age_ns(newest.stamp_ns, newest.came_ns)
        if pose_age_ns > 1e9 * POSE_SHARE * self._max_age_s:
            return f"the body's newest pose is {pose_age_ns / 1e9:.2f} s old; give newer ones (ObstacleSender.pose)"
        if self._body.jumped_ns is not None and (health.stamp_ns or 0) < self._body.jumped_ns:
            return "the body's pose has jumped, and no frame from there is in the map yet"
        T_world_body = self._body.after(pose_age_ns)
        assert T_world_body is not None
        seen_ns = max(self.link.now_ns() - round(1e9 * age_s), 0)
        sectors, places = self._sectors(T_world_body, seen_ns), self._places(T_world_body, seen_ns)
        if not self.link.send(sectors):
            return f"{self.link.url} does not take them"
        self.sent += 1
        taken = [self.link.send(message) for message in places]
        return "" if all(taken) else f"{self.link.url} does not take all directions"

    @property
    def _T_world_body(self) -> Transform | None:  # noqa: N802 - T_a_b is what poses are called
        """The newest pose of the body."""
        newest = self._body.newest
        return None if newest is None else newest.T_world_body

    def _sectors(self, T_world_body: Transform, seen_ns: int) -> Any:
        m, rules = self.link.messages, self._rules
        distances = obstacle_sectors(self._mapper.map, T_world_body, rules).centimetres(rules).tolist()
        return m.MAVLink_obstacle_distance_message(
            seen_ns // 1000, m.MAV_DISTANCE_SENSOR_UNKNOWN, distances, round(INCREMENT_DEG), 0, rules.max_cm,
            INCREMENT_DEG, 0.0, m.MAV_FRAME_BODY_FRD,
        )  # fmt: skip

    def _places(self, T_world_body: Transform, seen_ns: int) -> list[Any]:
        """Return the messages of all directions; all made before sending, because they must arrive close together."""
        if self._directions is None:
            return []
        m, farthest = self.link.messages, self._directions.max_distance
        return [
            m.MAVLink_obstacle_distance_3d_message(
                seen_ns // 1_000_000 % 2**32, m.MAV_DISTANCE_SENSOR_UNKNOWN, m.MAV_FRAME_BODY_FRD, 0xFFFF, *place, 0.0,
                farthest,
            )
            for place in nearest_places(self._mapper.map, T_world_body, self._directions).tolist()
        ]  # fmt: skip


def _checked_mounts(mounts: Mapping[str, Transform]) -> dict[str, Transform]:
    """Return the mounts as arrays; raises StereovoxError for one that is not rigid."""
    for sensor, mount in mounts.items():
        if not rigidity_error(mount) < 1e-3:
            raise StereovoxError(f"mounts['{sensor}'] is no rigid motion (4, 4); give T_body_sensor")
    return {sensor: np.array(mount, float) for sensor, mount in mounts.items()}
