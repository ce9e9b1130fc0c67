# SPDX-License-Identifier: Apache-2.0
"""The pose of each image by odometry on the images themselves, or the report that it is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import Config, load_config
from stereovox.errors import FrameRefused, StereovoxError
from stereovox.frame import AnyFrame, StereoFrame
from stereovox.frame.validate import matrix_of
from stereovox.geometry.se3 import (
    Transform,
    interpolate,
    inverse,
    orthonormalise,
    rigidity_error,
    rotation_between,
    rotation_vector,
)
from stereovox.kernels.threads import Ahead
from stereovox.products.floor_axes import up_of
from stereovox.sources.imu import Imu
from stereovox.track.fit import RIGID, Fit, Limits, deviations
from stereovox.track.inertial import Gyroscope, Turn, up_by_force
from stereovox.track.surfaces import Surfaces
from stereovox.track.views import far_apart

LEVEL = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Pose of the first image unless another is given: the camera looks along x, level; z is up."""
POSE_FAULTS = frozenset({"no_pose", "bad_pose_file", "low_confidence", "pose_jump"})
"""Faults of a frame's own pose, which tracking ignores."""
GIVEN, GIVEN_SHARE = np.repeat([np.radians(0.2), 0.005], 3), 0.05
"""Standard deviations of a given motion: radians and metres, and share of it."""
GAP, LONGEST = 2.0, 10.0
"""Longest gaps between images, in usual intervals, for normal tracking, and for tracking at all."""
SHORTEST = 0.3
"""Shortest gap between images, in usual intervals, from which motion is estimated."""
TURNED_AWAY = np.radians(20)
"""Angle between a relocalized image and a trusted gyroscope, beyond four times its uncertainty, that means another
place that looks alike."""
RIVAL, RIVAL_M, RIVAL_RAD = 0.5, 0.3, np.radians(15)
"""If one of two fits this far apart explains this share of what the other does, neither is accepted."""
SOON, NEAR_M, NEAR_RAD = 90.0, 1.2, np.radians(60)
"""Time since the last accepted pose, in usual intervals, and distance from it, within which an image that fits cannot
be from another place that looks alike."""
STAYS = 0.7
"""Share of the overlap demanded of a relocalized image that the images confirming it need."""
LEAP_M, LEAP_RAD, FINE = 0.1, np.radians(4), 0.92
"""How far a pose may leave the expected one, unless this share of the roughly known parts is closely known."""
FIRST = 3.0
"""Factor on the usual spread from the first image to the second: the camera may be moving."""
REMEMBERED = 8
"""Image times from which the usual interval is computed."""
CONFIRMED = 5
"""Images in a row that must be tracked after relocalization, without learning, until poses count."""


class Demand(NamedTuple):
    """Share of an image that must be known, and the inlier share of that."""

    known: float
    inlier_share: float


FOLLOWING, RETURNING, NEARBY, FOUND = Demand(0.2, 0.6), Demand(0.5, 0.8), Demand(0.35, 0.8), Demand(0.75, 0.8)
"""For an image that follows directly, arrives late, is relocalized soon and near, and later or farther.

Long after a loss the camera may be anywhere, and two similar stretches of an aisle share walls and floor: two thirds
of the view.
"""

Seen = TypeVar("Seen")
Guess = tuple[Transform, NDArray[np.float64]]
"""A pose (4, 4) that an image may have, and its covariance (6, 6)."""


class Evidence(Protocol[Seen]):
    """What a tracker learns from images: `Surfaces` of depth cameras, `Pairs` of stereo pairs."""

    limits: Limits

    def see(self, frame: AnyFrame, /) -> Seen:
        """Return the used parts of a frame; raises FrameRefused if it is unusable.

        It changes no state of the other methods: it may run in another thread, for frames that never arrive.
        """
        ...

    def count(self, seen: Seen, /) -> None:
        """Count an image whose pose is requested."""
        ...

    def picture_use(self) -> str:
        """Return how the color images were used so far, in words; "" if there are none."""
        ...

    def forget(self) -> None:
        """Forget everything learned."""
        ...

    def fit(self, seen: Seen, expected: Transform, doubt: NDArray[np.float64], /) -> Fit:
        """Return how an image fits near an expected pose; `doubt` as in `solve_stages`."""
        ...

    def advance(self, seen: Seen, T: Transform, /) -> None:
        """Advance to an image at T_map_camera without learning from it."""
        ...

    def learn(self, seen: Seen, T: Transform, /) -> None:
        """Learn an image with the accepted pose T_map_camera."""
        ...

    def seek(self, seen: Seen, last: Transform, /) -> list[Fit]:
        """Return how an image fits at places seen before; last: the last known pose."""
        ...

    def doubted(self, seen: Seen, fit: Fit, /) -> str:
        """Return an objection to the pose of a tracked image, "" if there is none."""
        ...

    def ambiguous(self, seen: Seen, T: Transform, known: float, /) -> str:
        """Return why an image may be from another place that resembles T_map_camera, "" if it is not.

        known: share of its distinctive parts that must be known.
        """
        ...

    def contradicted(self, seen: Seen, T: Transform, /) -> str:
        """Return an objection to an image having been taken from T_map_camera, "" if there is none."""
        ...


@dataclass(frozen=True, eq=False)
class Tracked:
    """The pose of one frame.

    Attributes:
        T_world_sensor: (4, 4) float64, maps the optical frame into the tracker's world; of a lost frame, the last
            tracked pose.
        covariance: (6, 6) float64 of its pose relative to what was seen so far: rotation about the camera in radians,
            then position in metres, along the world's axes; infinite if lost. Drift since the start is not included.
        lost: Why the pose is not known, in words; "" if it is.
        begins: Whether a map begins with this image: it is lost until the next one fits it.
        believed: Whether the pose follows from a given motion alone, because nothing known was in view.
        inlier_share: Share of what is known in the image that lies where the pose puts it; 0: not measured.
    """

    T_world_sensor: Transform
    covariance: NDArray[np.float64]
    lost: str = ""
    begins: bool = False
    believed: bool = False
    inlier_share: float = 0.0

    def moved(self, T_to_world: Transform) -> Tracked:
        """Return it in another world; T_to_world (4, 4) maps the present one into it."""
        R = np.kron(np.eye(2), T_to_world[:3, :3])
        covariance = self.covariance if self.lost else R @ self.covariance @ R.T
        return replace(self, T_world_sensor=T_to_world @ self.T_world_sensor, covariance=covariance)


class Tracker:
    """Finds the pose of each depth image or stereo pair by registering it to the earlier ones.

    Depth images, and pairs with a wide view, are registered to surfels, point to plane, from coarse to fine; in pinhole
    pairs corners are tracked. Both start from constant velocity. If too little is known, or some direction of the pose
    is unconstrained (a bare wall), the frame is lost and nothing is learned from it. A pose that is slightly open is
    tracked on; otherwise the tracker relocalizes among the views that it kept. A relocalized view counts after several
    images that agree. Poses of the frames are not used. All frames must come from one camera.

    With an IMU, its gyroscope predicts the turn to each image once its turns agree with the images; if they do not, it
    is left out. Its accelerometer gives the up direction.

    Args:
        profile: Profile name, TOML file or `Config`: depth, noise and range are prepared as for a map.
        start: (4, 4) T_world_sensor of the image that the map begins with, the first that the next one fits; without
            it the camera looks along x, level, z up.
        imu: An IMU next to the camera: `ImuReadings` of a recording, or a `LiveImu` that is fed before each frame.
                `start` is tilted to the up direction of its accelerometer if they differ by more than the error of
                that: 1 degree if the camera stood still around that image, else 5.
        **overrides: Settings that replace those of the profile.

    Attributes:
        config: The resolved settings.

    Raises:
        ConfigError: A setting is unknown, of the wrong type or out of range.
    """

    def __init__(
        self,
        profile: str | Path | Config = "default",
        *,
        start: Transform | None = None,
        imu: Imu | None = None,
        **overrides: Any,
    ):
        self.config = load_config(profile, **overrides)
        self._start = LEVEL if start is None else matrix_of(start)
        if not rigidity_error(self._start) < RIGID:
            raise StereovoxError("start is no rigid motion; give a (4, 4) T_world_sensor in metres")
        self._given_start, self._felt_up = self._start, False
        self._imu, self._gyroscope = imu, None if imu is None else Gyroscope(imu)
        self._evidence: Evidence[Any] | None = None
        self._see: Ahead[AnyFrame, Any] | None = None
        self._sensor = ""
        self._T, self._motion, self._covariance = np.eye(4), np.eye(4), np.zeros((6, 6))  # from the start
        self._inlier_share = 0.0
        self._stamps: list[int] = []  # of the last tracked images
        self._learned, self._sure = 0, np.eye(4)  # the last pose that counted
        self._adrift = False  # tracked, though open along some direction
        self._counted = False  # whether the pose of the last tracked image did
        self._near_ns, self._back = -1, FOUND  # until then the camera is near its last pose; demand
        self._trial: int | None = None  # images until poses count: 0 while tracking, None while lost

    @property
    def imu_use(self) -> str:
        """How the IMU was used so far, in one line; "" without one."""
        if self._imu is None or self._gyroscope is None:
            return ""
        up = "gave which way is up" if self._felt_up else "did not show which way is up"
        doubt = ", which may be as wrong" if self._felt_up and self._gyroscope.left_out else ""
        return f"{self._imu.name}: {self._gyroscope.use}; its accelerometer {up}{doubt}"

    def add(self, frame: AnyFrame, motion: Transform | None = None) -> Tracked:
        """Return the pose of a frame. Add frames in the order they were taken.

        Args:
            frame: Depth image or stereo pair; its pose is not used.
            motion: (4, 4) T_before_now, the camera's motion since the frame before by its wheels or another tracker. It
                replaces constant velocity, and is accepted along unconstrained directions, and if all in view is new;
                then a frame is lost only if its view contradicts what is known.

        Returns:
            Its pose, or why it is lost: also if the image itself is unusable. The first image counts once the next one
            is tracked on it.

        Raises:
            StereovoxError: `motion` is not a rigid motion.
        """
        if motion is not None:
            motion = matrix_of(motion)
            if not rigidity_error(motion) < RIGID:
                raise StereovoxError("motion is no rigid motion; give a (4, 4) T_before_now in metres, or None")
        if self._evidence is None or self._see is None:
            self._evidence, self._sensor = _evidence_for(frame, self.config), frame.sensor
            self._see = Ahead(partial(_seen, self._evidence))  # without `self`, which would keep itself alive
        if frame.sensor != self._sensor:
            return self._lost(f"the camera {self._sensor or 'of the first frame'} is tracked, not {frame.sensor}")
        try:
            seen = self._see(frame)
        except FrameRefused as refused:
            return self._lose(str(refused))
        self._evidence.count(seen)
        if self._learned < 2 and self._trial != 0:
            return self._begin(self._evidence, seen, frame.stamp_ns)
        if motion is None and (self._trial is None or self._later(frame.stamp_ns) > LONGEST):
            return self._return(self._evidence, seen, frame.stamp_ns)
        if motion is not None and not self._trial:
            return self._correct(self._evidence, seen, motion, frame.stamp_ns)
        return self._follow(self._evidence, seen, frame.stamp_ns)

    def expect(self, frame: AnyFrame) -> None:
        """Start to prepare, in the background, a frame that `add` will get later.

        It does not change the poses. Unlike `Mapper.expect` it ignores `threads`. Nothing happens before the first
        frame is added.

        Args:
            frame: The very object that `add` will get. It must not change meanwhile.
        """
        if self._see is not None and frame.sensor == self._sensor:
            self._see.begin(frame)

    def picture_use(self) -> str:
        """Return how the color images were used so far, in words; "" if there are none."""
        return self._evidence.picture_use() if self._evidence else ""

    def _correct(self, evidence: Evidence[Seen], seen: Seen, motion: Transform, stamp_ns: int) -> Tracked:
        """Take the pose of an image predicted by a given motion, corrected along the constrained directions."""
        expected = self._T @ motion
        way = np.repeat([np.linalg.norm(rotation_vector(motion[:3, :3])), np.linalg.norm(motion[:3, 3])], 3)
        doubt = np.diag(np.square(GIVEN + GIVEN_SHARE * way, dtype=np.float64))
        fit = evidence.fit(seen, expected, doubt)
        believed = fit.known < FOLLOWING.known
        if believed:
            fit = Fit(expected, doubt, fit.known, 1.0)
        contrary = _doubt(fit, Demand(0.0, FOLLOWING.inlier_share))
        self._place(expected if contrary else fit.T_map_camera, fit.covariance, 0.0 if believed else fit.inlier_share)
        self._motion, self._trial = motion, 0
        self._stamps = [*self._stamps[1 - REMEMBERED :], stamp_ns]
        if self._gyroscope is not None:
            self._gyroscope.interrupt()  # its turn to this image is not compared
        if contrary:
            evidence.advance(seen, self._T)
            return self._lost(contrary)
        evidence.learn(seen, self._T)
        self._learned += 1
        return self._found(believed)

    def _begin(self, evidence: Evidence[Seen], seen: Seen, stamp_ns: int, why: str = "") -> Tracked:
        """Start with an image; it counts once the next is tracked on it. why: reason the one before does not count."""
        evidence.forget()
        evidence.learn(seen, np.eye(4))
        self._level(stamp_ns)
        self._place(np.eye(4), np.zeros((6, 6)))
        self._stamps, self._trial, self._learned = [stamp_ns], 0, 1
        words = f"the map begins anew ({why})" if why else "the first image"
        return replace(self._lost(f"{words}; poses count from the next image that fits it"), begins=True)

    def _level(self, stamp_ns: int) -> None:
        """Tilt the start to the accelerometer's up at the first image, if they differ by more than its error."""
        self._start = self._given_start
        up = None if self._imu is None else up_by_force(self._imu, stamp_ns)
        self._felt_up = up is not None
        if up is None:
            return
        tilt = rotation_between(self._start[:3, :3] @ up.direction, up_of(self.config))
        if np.linalg.norm(rotation_vector(tilt)) > up.off:
            self._start = self._start.copy()
            self._start[:3, :3] = tilt @ self._start[:3, :3]

    def _follow(self, evidence: Evidence[Seen], seen: Seen, stamp_ns: int, demand: Demand = FOLLOWING) -> Tracked:
        """Take the pose of an image that fits, and learn from it if it is accepted."""
        later, turn = self._later(stamp_ns), self._turn(stamp_ns)
        if later > GAP:
            demand = RETURNING
        if self._trial and not self._adrift:
            demand = self._back._replace(known=STAYS * self._back.known)
        guess, *others = self._guesses(evidence.limits, stamp_ns, later, turn)
        fit, why = _followed(evidence, seen, guess, demand)
        if why and others:
            fit, why = _followed(evidence, seen, others[0], demand)
        if why:
            return self._begin(evidence, seen, stamp_ns, why) if self._learned < 2 else self._lose(why)
        before = self._T
        self._place(fit.T_map_camera, fit.covariance, fit.inlier_share)
        self._motion = inverse(before) @ self._T
        self._stamps = [*self._stamps[1 - REMEMBERED :], stamp_ns]
        why = self._wait(evidence, seen, fit)
        if self._gyroscope is not None:
            self._gyroscope.learn(None if why else turn, before[:3, :3], self._T[:3, :3], fit.covariance[:3, :3])
        self._counted = not why
        if why:
            evidence.advance(seen, self._T)
            return self._lost(why)
        evidence.learn(seen, self._T)
        self._learned, self._sure = self._learned + 1, self._T
        self._near_ns = stamp_ns + round(SOON * self._usual())
        return self._found()

    def _turn(self, stamp_ns: int) -> Turn | None:
        """Return the camera's turn by the gyroscope since the last tracked image; None if unknown."""
        return None if self._gyroscope is None else self._gyroscope.turn(self._stamps[-1], stamp_ns)

    def _guesses(self, limits: Limits, stamp_ns: int, later: float, turn: Turn | None) -> list[Guess]:
        """Return candidate poses of an image, the likeliest first, and their covariances (6, 6).

        A trusted gyroscope's turn replaces the constant turn rate; an untrusted one is tried second.
        """
        even, doubt = self._expected(limits, stamp_ns, later)
        if self._gyroscope is None or turn is None:
            return [(even, doubt)]
        turned = even.copy()
        turned[:3, :3] = R = self._T[:3, :3] @ turn.R
        if not self._gyroscope.trusted:
            return [(even, doubt), (turned, doubt)]
        self._gyroscope.used += 1
        doubt[:3, :3] = self._covariance[:3, :3] + R @ self._gyroscope.doubt(turn) @ R.T
        return [(turned, doubt)]

    def _wait(self, evidence: Evidence[Seen], seen: Seen, fit: Fit) -> str:
        """Return why a tracked pose does not count yet: it is open, or was until just before."""
        why = _open(fit, evidence.limits.unsure)
        if not why and self._adrift:
            why = evidence.contradicted(seen, fit.T_map_camera)
        self._adrift = bool(why)
        if why:
            self._trial = max(self._trial or 0, 1)
        elif self._trial:
            self._trial -= 1
            why = f"found again; {self._trial + 1} more images must agree"
        return why

    def _later(self, stamp_ns: int) -> float:
        """Return the time since the last image in usual intervals; infinity if it is negative."""
        if stamp_ns < self._stamps[-1]:
            return np.inf
        inlier_share = self._usual()
        return (stamp_ns - self._stamps[-1]) / inlier_share if inlier_share else 1.0

    def _usual(self) -> float:
        """Return the usual interval between images in nanoseconds; 0 if unknown."""
        apart = np.diff(self._stamps)
        return float(np.median(apart[apart > 0])) if np.any(apart > 0) else 0.0

    def _expected(self, limits: Limits, stamp_ns: int, later: float) -> tuple[Transform, NDArray[np.float64]]:
        """Return the pose that constant velocity predicts for a time, and its covariance (6, 6)."""
        share = 1.0
        if len(self._stamps) > 1 and later > 0 and stamp_ns > self._stamps[-1]:
            last = self._stamps[-1] - self._stamps[-2]
            inlier_share = (stamp_ns - self._stamps[-1]) / later
            share = (stamp_ns - self._stamps[-1]) / last if last > SHORTEST * inlier_share else 0.0
        spread = limits.spread * max(later, 1.0) * (1 if len(self._stamps) > 1 else FIRST)
        return self._T @ interpolate(np.eye(4), self._motion, share), self._covariance + np.diag(spread**2)

    def _return(self, evidence: Evidence[Seen], seen: Seen, stamp_ns: int) -> Tracked:
        """Resume from the last pose after a short loss, if a trusted gyroscope gives the turn; else relocalize."""
        if self._counted and self._later(stamp_ns) <= LONGEST and np.isfinite(self._turned(stamp_ns)[1]):
            self._trial = 0
            tracked = self._follow(evidence, seen, stamp_ns, RETURNING)
            if self._trial is not None:
                return tracked
        return self._seek(evidence, seen, stamp_ns)

    def _seek(self, evidence: Evidence[Seen], seen: Seen, stamp_ns: int) -> Tracked:
        """Relocalize an image among the views kept so far."""
        last, reach = self._turned(stamp_ns)
        fits = sorted(evidence.seek(seen, last), key=lambda fit: -fit.known * fit.inlier_share)
        if not fits:
            return self._lose("not found again: it looks like nothing before")
        if stamp_ns < self._stamps[-1]:
            self._near_ns = -1  # another clock, or a restarted recording: the time since is unknown
        said = [self._refused(evidence, seen, fit, stamp_ns, last, reach) for fit in fits]
        best, why = next(((fit, why) for fit, why in zip(fits, said, strict=True) if not why), (fits[0], said[0]))
        rivals = [
            fit
            for fit in fits
            if fit.known * fit.inlier_share > RIVAL * best.known * best.inlier_share and fit.fine >= FINE
        ]
        apart = [fit for fit in rivals if far_apart(best.T_map_camera, fit.T_map_camera, RIVAL_M, RIVAL_RAD)]
        if not why and any(not evidence.contradicted(seen, fit.T_map_camera) for fit in apart):
            why = "it fits at several places"
        if why:
            return self._lose(f"not found again: {why}")
        self._back = self._demand(best, stamp_ns)
        self._place(best.T_map_camera, best.covariance)
        self._motion, self._stamps, self._trial, self._counted = np.eye(4), [stamp_ns], CONFIRMED, False
        evidence.advance(seen, self._T)
        return self._lost(f"found again; {CONFIRMED} more images must agree")

    def _demand(self, fit: Fit, stamp_ns: int) -> Demand:
        """Return the demand on an image that fits at a place: higher if the camera can be elsewhere by now."""
        if stamp_ns <= self._near_ns and not far_apart(self._sure, fit.T_map_camera, NEAR_M, NEAR_RAD):
            return NEARBY
        return FOUND

    def _refused(
        self, evidence: Evidence[Seen], seen: Seen, fit: Fit, stamp_ns: int, last: Transform, reach: float
    ) -> str:
        """Return why an image is not accepted where it fits, "" if it is; last, reach: as from `_turned`."""
        demand, T = self._demand(fit, stamp_ns), fit.T_map_camera
        why = _doubt(fit, demand) or _open(fit, evidence.limits.unsure)
        if not why and far_apart(last, T, np.inf, reach):
            why = "it fits where, by the gyroscope, the camera does not look"
        if not why and fit.fine < FINE:
            why = f"only {fit.fine:.0%} of it fits closely"
        why = why or evidence.doubted(seen, fit) or evidence.contradicted(seen, T)
        return why or ("" if demand is NEARBY else evidence.ambiguous(seen, T, demand.known))

    def _turned(self, stamp_ns: int) -> tuple[Transform, float]:
        """Return the last pose, turned by a trusted gyroscope, and its possible error in radians."""
        turn = self._turn(stamp_ns)
        if self._gyroscope is None or turn is None or not self._gyroscope.trusted:
            return self._sure, np.inf
        T = self._T.copy()
        T[:3, :3] = T[:3, :3] @ turn.R
        return T, TURNED_AWAY + 4 * float(np.sqrt(np.trace(self._gyroscope.doubt(turn))))

    def _place(self, T: Transform, covariance: NDArray[np.float64], inlier_share: float = 0.0) -> None:
        self._T, self._covariance, self._inlier_share = orthonormalise(T), covariance, inlier_share

    def _lose(self, why: str) -> Tracked:
        self._adrift = False
        if self._gyroscope is not None:
            self._gyroscope.interrupt()
        if self._learned >= 2:
            self._trial = None
        return self._lost(why)

    def _found(self, believed: bool = False) -> Tracked:
        found = Tracked(self._T, self._covariance, believed=believed, inlier_share=self._inlier_share)
        return found.moved(self._start)

    def _lost(self, why: str) -> Tracked:
        return Tracked(self._T, np.full((6, 6), np.inf), why).moved(self._start)


def _evidence_for(frame: AnyFrame, config: Config) -> Evidence[Any]:
    """Return the evidence that tracks a camera."""
    if isinstance(frame, StereoFrame) and isinstance(frame.pair.camera, PinholeCamera):
        from stereovox.track.landmarks import Pairs  # needs OpenCV

        return Pairs(frame.pair)
    return Surfaces(config)


def _seen(evidence: Evidence[Seen], frame: AnyFrame) -> Seen:
    """Return the used parts of a frame, whatever is wrong with its own pose."""
    return evidence.see(replace(frame, fault=None, fault_detail="") if frame.fault in POSE_FAULTS else frame)


def _followed(evidence: Evidence[Seen], seen: Seen, guess: Guess, demand: Demand) -> tuple[Fit, str]:
    """Return how an image fits near a guess, and why it is not accepted, "" if it is."""
    fit = evidence.fit(seen, *guess)
    why = _doubt(fit, demand) or _open(fit, evidence.limits.adrift) or _leap(fit, guess)
    why = why or evidence.doubted(seen, fit)
    if not why and demand is not FOLLOWING:
        why = evidence.contradicted(seen, fit.T_map_camera)
    return fit, why


def _leap(fit: Fit, guess: Guess) -> str:
    """Return the objection to a loose fit far from the expected pose, "" if there is none."""
    far = far_apart(guess[0], fit.T_map_camera, LEAP_M, LEAP_RAD)
    return f"only {fit.fine:.0%} of it fits closely, off from even motion" if far and fit.fine < FINE else ""


def _doubt(fit: Fit, demand: Demand) -> str:
    """Return why a fit is not accepted, "" if it is."""
    if fit.known < demand.known:
        return f"{fit.known:.0%} of what it sees is known, {demand.known:.0%} is needed"
    if fit.inlier_share < demand.inlier_share:
        return f"{fit.inlier_share:.0%} of what is known lies where it should, {demand.inlier_share:.0%} is needed"
    return ""


def _open(fit: Fit, limit: tuple[float, float]) -> str:
    """Return how open a pose is, if beyond a limit in radians and metres; "" if it is not."""
    turn, shift = deviations(fit.covariance)
    if turn > limit[0] or shift > limit[1]:
        return f"what it sees leaves the pose open by {shift:.3f} m and {np.degrees(turn):.1f} degrees"
    return ""
