# SPDX-License-Identifier: Apache-2.0
"""The last check before a frame may change the map: does it agree with earlier frames and with the map?

`Gate` compares stamps, poses and images; `disagreement` judges how far the evidence contradicts the map.

Find a frame that repeats its sensor's view from another pose: it is frozen, whatever noise each image has.

Things in the world stay in place as the sensor moves; the contents of a frozen image move with the sensor. So a frame
is compared with earlier glances from other poses: which of their points are unmoved in the sensor, and in the world?
"""

from __future__ import annotations

import zlib
from functools import partial
from math import cos, inf, radians
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stereovox.cameras.lidar import Lidar
from stereovox.cameras.rigs import VirtualCamera
from stereovox.config import Config
from stereovox.errors import FrameRefused
from stereovox.frame import AnyFrame, AnyImage, CheckedCloud, Cloud, Frame, Range, Scan, StereoFrame, name_of
from stereovox.geometry.se3 import Transform, apart
from stereovox.integrate.views import PerCamera, camera_rays
from stereovox.mapping.disagreement import Agreement, DisagreementMonitor, Sight
from stereovox.maps.record._glance import ELSEWHERE, SAME, SIDE, bin_image, place
from stereovox.maps.record.glance import AT_REST, Glance, binned, marks_of
from stereovox.maps.record.history import (
    MAX_GLANCES,
    MAX_NAME_LENGTH,
    MAX_SENSORS,
    DisagreementSpell,
    History,
    ImageFingerprint,
    StampedPose,
    Streak,
)
from stereovox.sensors.noise import RangeNoise

SAMPLED = 4000
"""Most points of a frame that are compared."""
FARTHEST = 10
"""Points farther than this many times `max_range` do not count: a lidar may report any distance."""
BLUR = 1.5
"""Tolerance between two frames, as a multiple of the noise of one: both are noisy."""
STEP, TURN = 0.1, radians(8)
"""A glance is kept once the sensor has moved by this share of the median distance in view, or turned by this angle."""
CHECKED = 4
"""How often frames are compared within such a step; those between two comparisons have hardly moved."""
LEAST_M = 0.01
"""Least median distance: nothing is nearer."""
NEAR, NEAR_TURN = 0.3, 0.4
"""Glances are compared up to this motion: from farther away, many points are unmoved by chance."""
HASTE = 4
"""Times the speed before that a step must have to be a jump of the pose."""
POSE_ERROR_M = 0.1
"""Error of poses that is no motion."""
REPEATED = 0.75
"""Least share of a glance's points that are unmoved in the sensor: wrong depths move them, a frozen image does not."""
FEW, TIMES = 20, 1.5
"""A frame is frozen if this many points are unmoved in the sensor alone, and this many times more than in the world."""


class FrozenViews:
    """Compares frames with recent glances of the same sensor."""

    def __init__(self, config: Config):
        self._reach, self._least = FARTHEST * config.max_range, max(config.voxel_size, POSE_ERROR_M)
        self._noise = PerCamera(partial(RangeNoise.of, config.noise))
        self._tolerances: dict[Glance, NDArray[np.float32]] = {}

    def ranges(self, image: AnyImage) -> NDArray[np.float32]:
        """Return the range in each direction, (SIDE, SIDE) metres, 0 for none."""
        if isinstance(image, CheckedCloud):
            some = slice(None, None, max(1, -(-len(image.ends) // SAMPLED)))
            points = image.ends[some][image.hits[some]]
            with np.errstate(over="ignore"):
                return binned(points[np.einsum("ni,ni->n", points, points) <= self._reach**2])
        ranges = np.zeros((SIDE, SIDE), np.float32)
        step = max(1, round((image.depth_m.size / SAMPLED) ** 0.5))
        bin_image(image.depth_m, *camera_rays(image.camera), step // 2, step, np.float32(self._reach), ranges)
        return ranges

    def unmoved(
        self, glances: tuple[Glance, ...], camera: VirtualCamera | Lidar, T: Transform, ranges: NDArray[np.float32]
    ) -> tuple[int, int]:
        """Return how many points of `glances` are unmoved in the sensor alone, and in the world alone.

        T: T_world_sensor (4, 4) of the frame. ranges: its ranges, (SIDE, SIDE) metres.
        """
        in_sensor = in_world = 0
        pose, into = tuple(T[:3].ravel().tolist()), _turned_back(T)
        for glance in glances:
            metres, angle = apart(glance.pose, pose)
            share = metres / max(glance.typical_m, LEAST_M)
            if share >= NEAR or angle >= NEAR_TURN or (share < STEP / 2 and angle < TURN / 2):
                continue
            marks, tolerance = marks_of(glance), self._tolerance(glance, camera)
            fixed, moved = np.empty((2, len(tolerance)), np.uint8)
            place(ranges, marks.sensor, AT_REST, tolerance, fixed)
            if np.count_nonzero(fixed == SAME) >= REPEATED * np.count_nonzero(fixed):
                place(ranges, (marks.world - T[:3, 3]).astype(np.float32), into, tolerance, moved)
                in_sensor += int(np.count_nonzero((moved == ELSEWHERE) & (fixed == SAME)))
                in_world += int(np.count_nonzero((moved == SAME) & (fixed != SAME)))
        return in_sensor, in_world

    def warm_up(self, glance: Glance, camera: VirtualCamera | Lidar, ranges: NDArray[np.float32]) -> None:
        """Compile with the first frame what later ones need."""
        tolerance = self._tolerance(glance, camera)
        place(ranges, marks_of(glance).sensor, AT_REST, tolerance, np.empty(len(tolerance), np.uint8))

    def _tolerance(self, glance: Glance, camera: VirtualCamera | Lidar) -> NDArray[np.float32]:
        """Return by how many metres the ranges of a glance's points may differ, (N,)."""
        if glance not in self._tolerances:
            if len(self._tolerances) >= MAX_GLANCES * MAX_SENSORS:
                self._tolerances.clear()
            sigma = self._noise[camera].sigma(np.linalg.norm(marks_of(glance).sensor, axis=1))
            self._tolerances[glance] = (BLUR * np.maximum(self._least, sigma)).astype(np.float32)
        return self._tolerances[glance]


def _turned_back(T: Transform) -> NDArray[np.float32]:
    """Return the matrix (3, 4) that turns points from the world's axes into the sensor's."""
    turned = np.zeros((3, 4), np.float32)
    turned[:, :3] = T[:3, :3].T
    return turned


def moved_on(glance: Glance, before: tuple[float, ...], now: tuple[float, ...]) -> bool:
    """Return whether the sensor is another CHECKED part of a step away from a glance than it was before."""
    (metres, angle), (metres_now, angle_now) = apart(glance.pose, before), apart(glance.pose, now)
    part_m, part = STEP / CHECKED * max(glance.typical_m, LEAST_M), TURN / CHECKED
    return metres // part_m != metres_now // part_m or angle // part != angle_now // part


def is_frozen(in_sensor: int, in_world: int) -> bool:
    """Return whether these numbers of unmoved points show a frozen image."""
    return in_sensor >= FEW and in_sensor > TIMES * in_world


def jumped(glances: tuple[Glance, ...], before: StampedPose, now: StampedPose) -> bool:
    """Return whether the pose jumped after `before`, as a tracker does that corrects itself: the image did not move.

    Its step is large, and HASTE times faster than the sensor moved from the last glance to `before`.
    """
    last = next((one for one in reversed(glances) if one.stamp_ns < before.stamp_ns), None)
    if last is None or now.stamp_ns <= before.stamp_ns:
        return False
    step_m, step = apart(before.pose, now.pose)
    large_m, large = step_m > STEP / 2 * last.typical_m, step > TURN / 2
    if not (large_m or large):
        return False
    usual_m, usual = apart(last.pose, before.pose)
    haste = HASTE * (now.stamp_ns - before.stamp_ns) / (before.stamp_ns - last.stamp_ns)
    return (large_m and step_m > haste * usual_m) or (large and step > haste * usual)


def with_glance(glances: tuple[Glance, ...], now: StampedPose, ranges: NDArray[np.float32]) -> tuple[Glance, ...]:
    """Return the glances to keep after a frame: its own is added if it was taken elsewhere than the last one."""
    if glances:
        metres, angle = apart(glances[-1].pose, now.pose)
        if metres < STEP * glances[-1].typical_m and angle < TURN:
            return glances
    return (*glances, Glance.of(ranges, now.pose, now.stamp_ns))[-MAX_GLANCES:]


SLACK_M, SLACK_RAD = 0.05, radians(2)
"""Pose noise: a step this small is never a jump, however short the time."""
BACKWARDS, RESET, JUMP = "stamp_backwards", "clock_reset", "pose_jump"
STILL_M, STILL_RAD = 0.01, radians(0.5)
"""Apparent motion of a camera at rest with a jittery tracker."""
DIGEST_ROWS = 16
"""Rows of an image that its checksum covers."""
DIGEST_POINTS = 1024
"""Points of a cloud that its checksum covers; many may have no value."""
RESOLUTION_M, SILENCE, SPREAD = 1e-4, 1 << 40, 3.0
"""Distances of cones are remembered in these steps; that of silence; and how many sigma the same echo may differ."""
ROUGH, ROUGH_SHARE = 1e-3, 0.2
"""Measured inverse depth bends by more than this share of itself, at more than this share of the pixels; walls without
noise do not, and look the same from many places."""
Seen = Frame | StereoFrame | Cloud | Scan
"""Frames and scans that repeat if their sensor is frozen: all but ranges."""


class GateResult(NamedTuple):
    """A frame that passed the gate: its sensor, stamp and pose.

    after: the reason of the refusals that it ends, mostly "". look: checksum of its image, None if `trust.frozen` is
    off. agreement: how it agrees with the map, None if they were not compared. glances: those to keep for its sensor.
    confirms: whether it is the first to agree with the map. takes_out: number of frames before it, none of which has
    been confirmed, and which it contradicts: the map begins anew with it. is_cone: whether it is a `Range`. repeats:
    whether it adds nothing to what its sensor has heard from the same place.
    """

    sensor: str
    seen: StampedPose
    after: str = ""
    look: ImageFingerprint | None = None
    agreement: Agreement | None = None
    glances: tuple[Glance, ...] = ()
    confirms: bool = False
    takes_out: int = 0
    is_cone: bool = False
    repeats: bool = False

    @property
    def note(self) -> str:
        """Line for the report, "" if there is nothing to report."""
        if self.takes_out:
            return "the map begins anew: the frames before contradict this one, and none had been confirmed"
        return f"frames of '{self.sensor}' are accepted again after {self.after}" if self.after else ""


class Gate:
    """Checks stamps and poses of each sensor against its last trusted frame, kept in `history` and saved with the map.

    A frame that jumped, or whose clock was reset, is refused, and so are the next frames that fit it. Once they have
    agreed with each other for `trust.settle_s` (by their stamps) they are accepted again, so that a tracker that
    relocalised is not refused for ever. A frame joins the refused ones if reaching it from them takes a lower speed
    than from the trusted one. A frame that fits the trusted one ends the wait of the others.
    """

    def __init__(self, config: Config, history: History):
        trust = config.trust
        self._history, self._trust, self._monitor = history, trust, DisagreementMonitor(config, history)
        self._views, self._cell = FrozenViews(config), config.voxel_size
        self._turn = radians(trust.max_turn_dps)
        off, reset, ahead, settle = trust.max_pose_off_s, trust.clock_reset_s, trust.max_gap_s, trust.settle_s
        self._off_ns, self._reset_ns, self._ahead_ns, self._settle_ns = (
            round(1e9 * seconds) for seconds in (off, reset, ahead, settle)
        )

    def check(self, frame: AnyFrame | Scan, image: AnyImage | Scan | Range) -> GateResult:
        """Return what `accept` needs once the map has changed.

        image: holds the frame's pose, exactly rigid. Raises FrameRefused: `bad_sensor`, `pose_extrapolated`,
        `stamp_backwards`, `clock_reset`, `pose_jump`, `frozen_image`. Only the stamp and pose of a refused frame are
        remembered, since the next one may agree with them.
        """
        sensor, stamp_ns = self._identify(frame)
        numbers = image.T_world_sensor.ravel().tolist()
        now = StampedPose(stamp_ns, tuple(numbers[:12]))
        passed = self._fitting(frame, sensor, now)
        if isinstance(frame, Range):
            return self._heard(frame, passed)
        passed = passed._replace(look=self._look(frame, sensor, now))
        if passed.after:
            self._history.doubts.pop(sensor, None)  # they were about another place or another time
            self._history.glances.pop(sensor, None)
        if self._trust.frozen and not isinstance(image, Scan | Range):
            return passed._replace(glances=self._glances(frame, passed, image))
        return passed

    def in_doubt(self, passed: GateResult, against: float | None) -> bool:
        """Return as `DisagreementMonitor.in_doubt`."""
        return self._monitor.in_doubt(passed.sensor, passed.seen.stamp_ns, against)

    def doubt(self, passed: GateResult) -> DisagreementSpell | None:
        """Return the doubt about frames of its sensor, None if they agree."""
        return self._history.doubts.get(passed.sensor)

    def others_apart(self, passed: GateResult, metres: float) -> bool:
        """Return whether the last trusted frame of any other sensor was more than `metres` higher or lower.

        Cones do not count: no cell is surely occupied by them alone, so they contradict nobody.
        """
        height, ignored = passed.seen.pose[11], {passed.sensor, *self._history.cones}
        trusted = self._history.trusted.items()
        return any(abs(one.pose[11] - height) > metres for name, one in trusted if name not in ignored)

    def check_agreement(
        self, frame: AnyFrame | Scan, passed: GateResult, against: float | None, sight: Sight | None
    ) -> GateResult:
        """Return what `accept` needs for a frame that was compared with the map.

        Arguments and errors: as `DisagreementMonitor.check`.
        """
        agreement = self._monitor.check(frame, passed.sensor, passed.seen.stamp_ns, against, sight)
        return passed._replace(agreement=agreement, after=passed.after or agreement.after)

    def accept(self, passed: GateResult) -> None:
        """Remember a frame that was integrated."""
        self._history.trusted[passed.sensor] = passed.seen
        self._history.waiting.pop(passed.sensor, None)
        if passed.look is not None:
            self._history.looks[passed.sensor] = passed.look
        if passed.glances:
            self._history.glances[passed.sensor] = passed.glances
        if passed.agreement is not None:
            self._monitor.accept(passed.sensor, passed.agreement)
        if passed.is_cone:
            self._history.cones[passed.sensor] += 1
        if passed.confirms:
            self._history.unconfirmed = 0
        if passed.after:
            self._history.settled[passed.after] += 1

    def _identify(self, frame: AnyFrame | Scan) -> tuple[str, int]:
        """Return sensor and stamp of a frame with valid fields (`validate_fields`); refuse poses far off in time."""
        off_ns = abs(int(frame.pose_off_ns))
        if off_ns > self._off_ns:
            limit = f"trust.max_pose_off_s {self._trust.max_pose_off_s:g}"
            detail = f"{name_of(frame)}: its pose is extrapolated by {off_ns / 1e9:.3f} s ({limit}); give poses sooner"
            raise FrameRefused("pose_extrapolated", detail)
        if len(frame.sensor) > MAX_NAME_LENGTH or not frame.sensor.isprintable():
            detail = f"the sensor has no printable name of at most {MAX_NAME_LENGTH} characters; rename it"
            raise FrameRefused("bad_sensor", f"{name_of(frame)}: {detail}")
        usual = "scan" if isinstance(frame, Scan) else "lidar" if isinstance(frame, Cloud) else "camera"
        usual = "range" if isinstance(frame, Range) else usual
        return frame.sensor or usual, int(frame.stamp_ns)

    def _look(self, frame: Seen, sensor: str, now: StampedPose) -> ImageFingerprint | None:
        """Return the frame's checksum. Raises FrameRefused if the image repeats although the sensor has moved."""
        if not self._trust.frozen:
            return None
        look, before = ImageFingerprint(_digest(frame), now.pose), self._history.looks.get(sensor)
        if before is None or before.digest != look.digest:
            return look
        metres, angle = apart(before.pose, now.pose)
        if (metres > STILL_M or angle > STILL_RAD) and _is_measured(frame):
            what, cure = ("image", "camera") if isinstance(frame, Frame | StereoFrame) else ("sweep", "lidar")
            detail = f"the {what} repeats the last one, from {metres:.3g} m and {np.degrees(angle):.1f} degrees away"
            raise FrameRefused("frozen_image", f"{name_of(frame)}: {detail}; restart the {cure}")
        return before

    def _heard(self, seen: Range, passed: GateResult) -> GateResult:
        """Return the result for a cone: does it repeat what its sensor heard from there before?

        Echoes from one place are no independent evidence: however many there are, they come from one thing.
        """
        metres = float(seen.distance)
        look = ImageFingerprint(SILENCE if metres == inf else round(metres / RESOLUTION_M), passed.seen.pose)
        before = self._history.looks.get(passed.sensor)
        if before is not None:
            shift, turn = apart(before.pose, look.pose)
            same = abs(before.digest - look.digest) * RESOLUTION_M <= SPREAD * seen.beam.sigma
            if same and shift < self._cell and turn < seen.beam.beam / 4:
                return passed._replace(look=before, is_cone=True, repeats=True)
        return passed._replace(look=look, is_cone=True)

    def _glances(self, frame: Seen, passed: GateResult, image: AnyImage) -> tuple[Glance, ...]:
        """Return the glances to keep. Raises FrameRefused for a frame that repeats a view from elsewhere."""
        glances, before = self._history.glances.get(passed.sensor, ()), self._history.trusted.get(passed.sensor)
        anew = not glances or before is None or jumped(glances, before, passed.seen)
        if before is not None and not anew and not moved_on(glances[-1], before.pose, passed.seen.pose):
            return glances
        ranges = self._views.ranges(image)
        if anew:
            glances = with_glance((), passed.seen, ranges)
            self._views.warm_up(glances[0], image.camera, ranges)
        in_sensor, in_world = self._views.unmoved(glances, image.camera, image.T_world_sensor, ranges)
        if is_frozen(in_sensor, in_world) and _is_measured(frame):
            counts = f"{in_sensor} points moved with the sensor, {in_world} stayed in the world"
            detail = f"it repeats a view from elsewhere ({counts}); restart the sensor, or correct its pose"
            raise FrameRefused("frozen_image", f"{name_of(frame)}: {detail}")
        return with_glance(glances, passed.seen, ranges)

    def _fitting(self, frame: AnyFrame | Scan, sensor: str, now: StampedPose) -> GateResult:
        """Return a frame that fits the last trusted one or is accepted again; refuse any other."""
        trusted = self._history.trusted.get(sensor)
        if trusted is None:
            if len(self._history.trusted) >= MAX_SENSORS:
                raise FrameRefused("bad_sensor", f"{name_of(frame)}: more than {MAX_SENSORS} sensors; use fewer names")
            return GateResult(sensor, now)
        why, haste = self._against(trusted, now)
        waiting = self._history.waiting.get(sensor)
        if waiting is None and not why:
            return GateResult(sensor, now)
        return self._settled(frame, GateResult(sensor, now), trusted, (why, haste), waiting)

    def _against(self, before: StampedPose, now: StampedPose) -> tuple[str, float]:
        """Return why `now` cannot follow `before` ("": it can), and its speed as a share of the limit."""
        ahead_ns = now.stamp_ns - before.stamp_ns
        if self._trust.ordered and (ahead_ns < 0 or ahead_ns > self._ahead_ns):
            return (BACKWARDS if -self._reset_ns <= ahead_ns < 0 else RESET), inf
        if ahead_ns <= 0:
            return "", 0.0  # the same time, or unordered stamps: no speed
        metres, angle = apart(before.pose, now.pose)
        allowed = 1e-9 * ahead_ns
        moved, turned = (metres - SLACK_M) / self._trust.max_speed_mps, (angle - SLACK_RAD) / self._turn
        haste = max(moved, turned) / allowed
        return (JUMP if haste > 1 else ""), haste

    def _settled(
        self,
        frame: AnyFrame | Scan,
        passed: GateResult,
        trusted: StampedPose,
        found: tuple[str, float],
        waiting: Streak | None,
    ) -> GateResult:
        """Return the frame if it may be accepted although it does not fit or others wait; otherwise refuse it."""
        (why, haste), now = found, passed.seen
        follows, slower = False, False
        if waiting is not None:
            unfit, their_haste = self._against(waiting.last, now)
            follows, slower = not unfit, their_haste < haste
        if not why and not (follows and slower):
            return passed
        if waiting is not None and follows:
            why, since_ns = waiting.why, waiting.since_ns
        else:
            since_ns = now.stamp_ns
        detail = f"{name_of(frame)}: {self._detail(why, trusted, now)}"
        if why == BACKWARDS:
            raise FrameRefused(why, detail)
        if now.stamp_ns - since_ns >= self._settle_ns:
            return passed._replace(after=why)
        self._history.waiting[passed.sensor] = Streak(why, since_ns, now)
        raise FrameRefused(why, detail)

    def _detail(self, why: str, before: StampedPose, now: StampedPose) -> str:
        seconds = (now.stamp_ns - before.stamp_ns) / 1e9
        if why == BACKWARDS:
            return f"it is {-seconds:.6g} s older than the last trusted one; sort the frames or set trust.ordered=false"
        until = f"accepted again once frames agree for {self._trust.settle_s:g} s"
        if why == RESET:
            return f"its stamp is {seconds:+.6g} s off the last trusted one, so its clock was reset; {until}"
        metres, angle = apart(before.pose, now.pose)
        return (
            f"the pose jumped by {metres:.3g} m and {round(angle * 57.29578, 1):g} degrees in {seconds:.3g} s; {until}"
        )


def _rows(image: np.ndarray) -> np.ndarray:
    return image[DIGEST_ROWS // 2 if len(image) > DIGEST_ROWS else 0 :: max(1, len(image) // DIGEST_ROWS)]


def _digest(frame: Seen) -> int:
    """Return a checksum of DIGEST_ROWS rows of the frame's images, of DIGEST_POINTS points, or of all ranges."""
    if isinstance(frame, StereoFrame):
        parts = _rows(frame.left), _rows(frame.right)
    elif isinstance(frame, Cloud):
        parts = (frame.points[:: max(1, len(frame.points) // DIGEST_POINTS)],)
    else:
        parts = (frame.ranges if isinstance(frame, Scan) else _rows(frame.depth),)
    number = 0
    for part in parts:
        number = zlib.crc32(np.ascontiguousarray(part).tobytes(), number)
    return number


def _is_measured(frame: Seen) -> bool:
    """Return whether depths or ranges have noise: whether their inverse bends between neighbours.

    The inverse depth of a plane does not bend in an image, nor, corrected for the angle step, between beams. Stereo
    frames and clouds always count as measured.
    """
    if isinstance(frame, StereoFrame | Cloud):
        return True
    is_scan = isinstance(frame, Scan)
    rows = (frame.ranges[None] if is_scan else _rows(frame.depth)).astype(float)
    straight = 2 * cos(frame.angle_step) if is_scan else 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(np.isfinite(rows) & (rows > 0), 1 / rows, np.nan)
        bend = np.abs(inverse[:, 2:] + inverse[:, :-2] - straight * inverse[:, 1:-1]) / inverse[:, 1:-1]
    bend = bend[np.isfinite(bend)]
    return bool(bend.size and (bend > ROUGH).mean() > ROUGH_SHARE)
