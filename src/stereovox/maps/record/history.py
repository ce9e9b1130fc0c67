# SPDX-License-Identifier: Apache-2.0
"""The frame history of a map: number of frames, refusals by reason, and each sensor's last trusted frame."""

from __future__ import annotations

import copy
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from stereovox.errors import one_line, shortened
from stereovox.maps.record.camera_path import FARTHEST, CameraPath, LoopLines
from stereovox.maps.record.camera_path import StampedPose as StampedPose
from stereovox.maps.record.glance import Glance

MAX_SENSORS = 64
"""Most sensors that one map distinguishes."""
MAX_REASONS = 256
"""Most reasons by which refusals are counted; further ones count as OTHERS."""
OTHERS = "others"
UNCONFIRMED, TRIES = "unconfirmed", 10
"""Reason under which first frames count that were taken out again, and how often a map may begin anew."""
MAX_NAME_LENGTH = 256
MAX_NOTES = 16
"""Most notes about an imported file."""
MAX_GLANCES = 4
"""Most recent glances kept of each sensor, from different poses."""
EARLIEST, LATEST = -(2**63), 2**63 - 1
"""Range of stamps in int64 nanoseconds."""
CHANGED, MOVED = "changed", "moved"
"""Verdicts on frames that disagree with the map: the world has changed, or the camera was moved."""


class Streak(NamedTuple):
    """Refused frames of one sensor that agree with each other: reason and stamp of the first one, and the last one."""

    why: str
    since_ns: int
    last: StampedPose


class ImageFingerprint(NamedTuple):
    """The last image of a sensor: its checksum and the pose at which it was first seen, as in `StampedPose`."""

    digest: int
    pose: tuple[float, ...]


class RunningMean(NamedTuple):
    """Exponential mean of the disagreement of a sensor's frames with the map, 0 to 1, and of the deviation from it."""

    mean: float
    spread: float

    def updated(self, share: float, gain: float) -> RunningMean:
        """Return both after one more frame, which has the weight `gain`."""
        off = share - self.mean
        return RunningMean(self.mean + gain * off, self.spread + gain * (abs(off) - self.spread))


class DisagreementSpell(NamedTuple):
    """Frames of one sensor that disagree with the map: stamps of the first and the last, and how many follow the first.

    fits: how many of them would agree from another pose. verdict: CHANGED or MOVED; "" while it is open. looks: how
    many of the last ones in a row showed a changed world. glance: the one to compare the next frame with.
    """

    since_ns: int
    last_ns: int
    frames: int = 0
    fits: int = 0
    verdict: str = ""
    looks: int = 0
    glance: Glance | None = None

    def going_on(self, stamp_ns: int) -> DisagreementSpell:
        """Return the doubt after one more frame."""
        return self._replace(last_ns=stamp_ns, frames=self.frames + 1)

    def lasted_ns(self, untimed_hz: float) -> int:
        """Return how long it has lasted; `untimed_hz`: the frame rate if stamps did not advance."""
        return self.last_ns - self.since_ns if self.last_ns > self.since_ns else round(1e9 * self.frames / untimed_hz)


class Imported(NamedTuple):
    """The file that a map was imported from.

    file: name of the file, without its folder. holds: its contents in a few words (`PLY, 12,345 points`).
    notes: decisions made for the user, a phrase each (`cells of 0.05 m, since points are about 0.021 m apart`).
    """

    file: str
    holds: str
    notes: tuple[str, ...] = ()

    def lines(self) -> str:
        """Return lines for people: `imported from cloud.ply (PLY, 12,345 points)`, then one note per line."""
        return "\n  ".join((f"imported from {self.file} ({self.holds})", *self.notes))

    def saved(self) -> dict[str, Any]:
        """Return plain values for JSON, cut to the lengths that can be loaded: other programs' texts may be longer."""
        file, holds, *notes = (
            shortened(one_line(text), MAX_NAME_LENGTH) for text in (self.file, self.holds, *self.notes[:MAX_NOTES])
        )
        return {"file": file, "holds": holds, "notes": notes}


@dataclass
class History:
    """Everything a map remembers about its frames; saved with it, so that a run can stop and resume anywhere.

    Attributes:
        frames: Number of frames in the map.
        refused: Number of refused frames, by reason.
        settled: How often frames were accepted again after a jump, a reset or a disagreement, by reason.
        quality: Number of frames by quality level (`full`, `near`, `coarse`).
        recording: Name of the recording, if known.
        last_frame: Name and stamp of the frame offered last.
        trusted: Last trusted frame of each sensor.
        waiting: Refused frames that may yet be accepted, by sensor.
        path: Poses of the sensors.
        looks: Last image of each camera.
        usual: Usual disagreement with the map of each camera's frames, 0 to 1.
        doubts: Cameras whose last frames disagree with the map more than usual.
        glances: Recent views of each sensor from different poses, the newest last; later frames are compared with them.
        imported: The file of another program that the map began with; None for a map without one.
        loops: The loops that were closed; None if nobody searched for loops, or poses were corrected otherwise since.
        recordings: Number of recordings that were merged by their given poses; 1 without a merge, or if `join` made
            one path of them, which it can if they were recorded one after the other.
        unconfirmed: How often the map may still begin anew with a frame that contradicts it; 0 once two frames agreed.
        cones: How many of the frames are distances of sonars and the like, which are not compared, by sensor.
    """

    frames: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    settled: Counter[str] = field(default_factory=Counter)
    quality: Counter[str] = field(default_factory=Counter)
    recording: str = ""
    last_frame: tuple[str, int] | None = None
    trusted: dict[str, StampedPose] = field(default_factory=dict)
    waiting: dict[str, Streak] = field(default_factory=dict)
    path: CameraPath = field(default_factory=CameraPath)
    looks: dict[str, ImageFingerprint] = field(default_factory=dict)
    usual: dict[str, RunningMean] = field(default_factory=dict)
    doubts: dict[str, DisagreementSpell] = field(default_factory=dict)
    glances: dict[str, tuple[Glance, ...]] = field(default_factory=dict)
    imported: Imported | None = None
    loops: LoopLines | None = None
    recordings: int = 1
    unconfirmed: int = 0
    cones: Counter[str] = field(default_factory=Counter)

    def made_of(self) -> str:
        """Return lines for people: the recording, or the imported file and the notes about it, or both."""
        frames = f"made of {self.recording or 'frames without a name'}"
        if self.imported is None:
            return frames
        return f"{self.imported.lines()}\n{frames}" if self.frames else self.imported.lines()

    def offered(self, frame: object) -> None:
        """Remember the frame offered last."""
        name, stamp_ns = getattr(frame, "name", ""), getattr(frame, "stamp_ns", 0)
        whole = int(stamp_ns) if isinstance(stamp_ns, int | np.integer) else 0  # a refused frame may hold anything
        text = name[:MAX_NAME_LENGTH] if isinstance(name, str) else ""
        self.last_frame = text, min(max(whole, EARLIEST), LATEST)

    def refuse(self, reason: str) -> None:
        """Count one refused frame."""
        reason = one_line(str(reason))[:MAX_NAME_LENGTH]  # as `loaded` reads it
        self.refused[reason if reason in self.refused or len(self.refused) < MAX_REASONS else OTHERS] += 1

    @property
    def is_provisional(self) -> bool:
        """Whether it has frames that could agree, and no two of them have."""
        return self.frames > self.cones.total() and self.unconfirmed > 0

    def begin_anew(self) -> None:
        """Count all frames as refused, and forget their sensors."""
        for _ in range(self.frames):
            self.refuse(UNCONFIRMED)
        self.frames, self.path, self.unconfirmed = 0, CameraPath(), self.unconfirmed - 1
        for remembered in (
            self.cones,
            self.quality,
            self.trusted,
            self.waiting,
            self.looks,
            self.usual,
            self.doubts,
            self.glances,
        ):
            remembered.clear()

    def copied(self) -> History:
        """Return an independent copy."""
        return copy.deepcopy(self)

    def saved(self) -> dict[str, Any]:
        """Return the history as plain values for JSON, which `loaded` reads."""
        return {
            "frames": self.frames,
            "frames_refused": self.refused.total(),
            "last_frame": self._last_frame(),
            "recording": self.recording,
            "recordings": self.recordings,
            "imported": None if self.imported is None else self.imported.saved(),
            "history": {
                "refused": dict(self.refused),
                "settled": dict(self.settled),
                "quality": dict(self.quality),
                "trusted": {name: _seen_to(seen) for name, seen in self.trusted.items()},
                "waiting": {
                    name: {"why": streak.why, "since_ns": streak.since_ns, **_seen_to(streak.last)}
                    for name, streak in self.waiting.items()
                },
                "looks": {name: {"digest": look.digest, "pose": list(look.pose)} for name, look in self.looks.items()},
                "usual": {name: list(usual) for name, usual in self.usual.items()},
                "doubts": {name: _doubt_to(doubt) for name, doubt in self.doubts.items()},
                "glances": {name: [_glance_to(one) for one in seen] for name, seen in self.glances.items()},
                "unconfirmed": self.unconfirmed,
                "cones": dict(self.cones),
            },
            "camera_path": self.path.saved(),
            "loops": None if self.loops is None else self.loops.saved(),
        }

    @classmethod
    def loaded(cls, saved: dict[str, Any]) -> History:
        """Return the history in a saved manifest.

        Raises KeyError, TypeError or ValueError if the values cannot be one.
        """
        frames, refused = _whole(saved["frames"], "frames"), _whole(saved["frames_refused"], "frames_refused")
        history = cls(
            frames,
            recording=one_line(str(saved["recording"])),
            last_frame=_last_frame_from(saved["last_frame"]),
            path=_path_from(saved["camera_path"]),
            imported=_imported_from(saved["imported"]),
            loops=None if saved["loops"] is None else LoopLines.loaded(saved["loops"]),
            recordings=_whole(saved["recordings"], "recordings", 1),
        )
        entries = saved["history"]
        history.refused, history.settled, history.quality = (
            _counts(entries[name], name) for name in ("refused", "settled", "quality")
        )
        history.trusted = {name: _seen_from(seen) for name, seen in _sensors(entries["trusted"]).items()}
        history.waiting = {name: _streak_from(streak) for name, streak in _sensors(entries["waiting"]).items()}
        if not history.waiting.keys() <= history.trusted.keys():
            raise ValueError("history.waiting names a sensor that was never trusted")
        history.looks = {name: _look_from(look) for name, look in _sensors(entries["looks"]).items()}
        history.usual = {name: _usual_from(shares) for name, shares in _sensors(entries["usual"]).items()}
        history.doubts = {name: _doubt_from(doubt) for name, doubt in _sensors(entries["doubts"]).items()}
        history.glances = {  # older maps have none
            name: _glances_from(seen) for name, seen in _sensors(entries.get("glances", {})).items()
        }
        history.unconfirmed = _whole(entries.get("unconfirmed", 0), "history.unconfirmed")
        history.cones = _counts(entries.get("cones", {}), "cones")
        if history.refused.total() != refused:
            raise ValueError(f"frames_refused is {refused}, but its reasons add up to {history.refused.total()}")
        return history

    def _last_frame(self) -> dict[str, Any] | None:
        """Return number (from 1, refused frames included), name and stamp of the last frame."""
        if self.last_frame is None:
            return None
        name, stamp_ns = self.last_frame
        return {"number": self.frames + self.refused.total(), "name": name, "stamp_ns": stamp_ns}


class WithHistory:
    """Properties of every map that come from its frame history."""

    history: History

    def _described(self, sides: Sequence[float], counts: dict[str, int], memory_bytes: int) -> str:
        """Return the `repr` of a map whose cells have `sides` in metres."""
        cells = ", ".join(f"{number:,} {state}" for state, number in counts.items())
        side = " x ".join(f"{x:g}" for x in sides)
        made_of = f"{self.history.frames:,} frames, {self.history.refused.total():,} refused"
        return f"<{type(self).__name__} of {side} m cells: {cells}; {made_of}; {memory_bytes / 1e6:.1f} MB>"

    @property
    def frames(self) -> int:
        """Number of frames in the map."""
        return self.history.frames

    @frames.setter
    def frames(self, number: int) -> None:
        self.history.frames = number

    @property
    def frames_refused(self) -> int:
        """Number of refused frames; `history.refused` has the reasons."""
        return self.history.refused.total()

    @property
    def recording(self) -> str:
        """Name of the recording, if known."""
        return self.history.recording

    @recording.setter
    def recording(self, name: str) -> None:
        self.history.recording = name


def _seen_to(seen: StampedPose) -> dict[str, Any]:
    return {"stamp_ns": seen.stamp_ns, "pose": list(seen.pose)}


def _seen_from(saved: Any) -> StampedPose:
    return StampedPose(_whole(saved["stamp_ns"], "history: stamp_ns", EARLIEST), _pose_from(saved["pose"]))


def _look_from(saved: Any) -> ImageFingerprint:
    return ImageFingerprint(_whole(saved["digest"], "history: digest"), _pose_from(saved["pose"]))


def _doubt_to(doubt: DisagreementSpell) -> dict[str, Any]:
    return {**doubt._asdict(), "glance": None if doubt.glance is None else _glance_to(doubt.glance)}


def _glance_to(glance: Glance) -> dict[str, Any]:
    return {"pose": list(glance.pose), "ranges": glance.packed(), "stamp_ns": glance.stamp_ns}


def _glance_from(saved: Any) -> Glance:
    stamp_ns = _whole(saved["stamp_ns"], "history: stamp_ns", EARLIEST)
    return Glance.unpacked(_pose_from(saved["pose"]), saved["ranges"], stamp_ns)


def _glances_from(saved: Any) -> tuple[Glance, ...]:
    if not isinstance(saved, list) or len(saved) > MAX_GLANCES:
        raise ValueError(f"history: glances are not a list of at most {MAX_GLANCES}")
    return tuple(map(_glance_from, saved))


def _doubt_from(saved: Any) -> DisagreementSpell:
    since_ns, last_ns = (_whole(saved[name], f"history: {name}", EARLIEST) for name in ("since_ns", "last_ns"))
    frames, fits, looks = (_whole(saved[name], f"history: {name}") for name in ("frames", "fits", "looks"))
    if saved["verdict"] not in ("", CHANGED, MOVED):
        raise ValueError("history: a doubt has an unknown verdict")
    seen = None if saved["glance"] is None else _glance_from(saved["glance"])
    return DisagreementSpell(since_ns, last_ns, frames, fits, saved["verdict"], looks, seen)


def _usual_from(saved: Any) -> RunningMean:
    shares = RunningMean(*saved)
    if any(type(share) not in (float, int) or not 0 <= share <= 1 for share in shares):
        raise ValueError("history: a share is not a number from 0 to 1")
    return shares


def _pose_from(pose: Any) -> tuple[float, ...]:
    if not isinstance(pose, list) or len(pose) != 12 or not all(type(x) in (float, int) for x in pose):
        raise ValueError("history: a pose is not 12 numbers")
    numbers = tuple(map(float, pose))
    if not all(math.isfinite(x) and abs(x) <= FARTHEST for x in numbers):
        raise ValueError("history: a pose holds NaN, infinity or absurdly large numbers")
    return numbers


def _last_frame_from(saved: Any) -> tuple[str, int] | None:
    if saved is None:
        return None
    return _name(saved["name"]), _whole(saved["stamp_ns"], "last_frame: stamp_ns", EARLIEST)


def _imported_from(saved: Any) -> Imported | None:
    if saved is None:
        return None
    if not isinstance(saved["notes"], list | tuple) or len(saved["notes"]) > MAX_NOTES:
        raise ValueError(f"imported: notes are not a list of at most {MAX_NOTES}")
    return Imported(_name(saved["file"]), _name(saved["holds"]), tuple(map(_name, saved["notes"])))


def _path_from(saved: Any) -> CameraPath:
    return CameraPath.loaded({**saved, "stops": _sensors(saved["stops"])})


def _streak_from(saved: Any) -> Streak:
    return Streak(_name(saved["why"]), _whole(saved["since_ns"], "history: since_ns", EARLIEST), _seen_from(saved))


def _sensors(saved: Any) -> dict[str, Any]:
    if not isinstance(saved, dict) or len(saved) > MAX_SENSORS:
        raise ValueError(f"history: sensors are not a table of at most {MAX_SENSORS}")
    return {_name(name): value for name, value in saved.items()}


def _counts(saved: Any, what: str) -> Counter[str]:
    if not isinstance(saved, dict) or len(saved) > MAX_REASONS + 1:
        raise ValueError(f"history.{what} is not a table of at most {MAX_REASONS} counts")
    return Counter({_name(name): _whole(number, f"history.{what}") for name, number in saved.items()})


def _name(value: Any) -> str:
    if not isinstance(value, str) or len(value) > MAX_NAME_LENGTH:
        raise ValueError(f"history: a name is not a text of at most {MAX_NAME_LENGTH} letters")
    return one_line(value)


def _whole(value: Any, what: str, least: int = 0) -> int:
    if type(value) is not int or not least <= value <= LATEST:
        raise ValueError(f"{what} is not a whole number of at least {least}")
    return value
