# SPDX-License-Identifier: Apache-2.0
"""The health of a map: the age of its last data, and what became of recent frames."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

from stereovox.config import Config
from stereovox.frame.stamp_clock import StampClock, StampsBy
from stereovox.kernels.threads import MapLock

MAX_FRAMES = 1000
"""Most recent frames that are remembered."""
FULL = "full"
"""Name of the quality level that omits nothing."""
State = Literal["waiting", "current", "degraded", "stale", "lost"]
STALE: tuple[State, ...] = ("stale", "lost")
"""States in which a map is too old to act on."""
UNFIT: tuple[State, ...] = ("waiting", *STALE)
"""States in which outputs of a growing map are silent."""


@dataclass(frozen=True)
class Health:
    """How current a map is.

    Attributes:
        state: `waiting`: no trusted frame yet, or no second one that agrees with the first. `current`. `degraded`:
            recent frames were refused or used at reduced quality, or one of several sensors is silent. `stale`,
            `lost`: the last trusted frame is older than `trust.stale_s`, `trust.lost_s`; also stale while frames of any
            sensor arrive that late.
        age_s: Seconds since the last trusted frame was taken, by its stamp (`Mapper.stamp_clock`), and at least since
            it arrived; None before the first.
        ages_s: The same for each sensor.
        stamp_ns: Time of the last trusted frame by its own clock, in nanoseconds; None before the first.
        frames: Frames offered within the last `trust.lost_s` seconds.
        refused: How many of these were refused, by reason.
        reduced: How many of these were used at reduced quality, by quality level.
        text: All of it in one line.
    """

    state: State
    age_s: float | None
    ages_s: dict[str, float]
    stamp_ns: int | None
    frames: int
    refused: dict[str, int]
    reduced: dict[str, int]
    text: str

    @property
    def refused_share(self) -> float:
        """Share of the recent frames that were refused, 0 to 1."""
        return sum(self.refused.values()) / max(self.frames, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all values as plain types for JSON.

        Returns:
            The attributes by name, and `refused_share`.
        """
        return {**asdict(self), "refused_share": self.refused_share}


class MonotonicClock:
    """A clock that never goes back: it continues when the clock that it reads is set back."""

    def __init__(self, clock: Callable[[], int]):
        self._clock, self._lock = clock, MapLock()
        self._last_ns: int | None = None
        self._ahead_ns = 0

    def __call__(self, reading_ns: int | None = None) -> int:
        """Return nanoseconds now, or those that correspond to a reading of the underlying clock."""
        if reading_ns is not None:
            return reading_ns + self._ahead_ns
        with self._lock:
            now, last = self._clock(), self._last_ns
            self._ahead_ns += 0 if last is None else max(last - now, 0)
            self._last_ns = now
            return now + self._ahead_ns


class _Taken(NamedTuple):
    """The last trusted frame of a sensor: its stamp, when it arrived, and how old it was then."""

    stamp_ns: int
    arrived_ns: int
    late_ns: int


class HealthMonitor:
    """Records when each frame was taken and arrived, and what became of it.

    clock: nanoseconds now; it may be set back. stamps_by, epoch: as for `StampClock`.

    Attributes:
        stamps: The present time by the clock of the stamps.
    """

    def __init__(self, config: Config, clock: Callable[[], int], stamps_by: StampsBy, epoch: Callable[[], int]):
        self.now = MonotonicClock(clock)
        self.stamps = StampClock(self.now, stamps_by, epoch, config.trust.ordered)
        self._stale_ns, self._lost_ns = round(1e9 * config.trust.stale_s), round(1e9 * config.trust.lost_s)
        self._taken: dict[str, _Taken] = {}
        self._stamp_ns: int | None = None
        self._recent: deque[tuple[int, str, str]] = deque(maxlen=MAX_FRAMES)  # arrival, refusal, quality

    def accept(self, arrived_ns: int, sensor: str, stamp_ns: int, quality: str) -> None:
        """Record a frame that was integrated; arrived_ns: by `now`."""
        self.stamps.heard(sensor, stamp_ns, arrived_ns)
        self._taken[sensor] = _Taken(stamp_ns, arrived_ns, max(self.stamps.age_ns(stamp_ns, arrived_ns), 0))
        self._stamp_ns = stamp_ns
        self._recent.append((arrived_ns, "", quality))

    def refuse(self, arrived_ns: int, reason: str) -> None:
        """Record a frame that was refused."""
        self._recent.append((arrived_ns, str(reason), FULL))

    def health(self, now_ns: int | None = None, provisional: bool = False) -> Health:
        """Return the health at `now_ns` by the clock; None: now. provisional: no two frames have agreed yet."""
        now, taken = self.now(now_ns), self._taken.copy()  # another thread may add
        ages = {sensor: self._age_ns(one, now) for sensor, one in taken.items()}
        late = {sensor: ns for sensor, one in taken.items() if (ns := self._late_ns(one, now)) > self._stale_ns}
        recent = [(why, quality) for arrived, why, quality in self._recent.copy() if now - arrived <= self._lost_ns]
        refused = Counter(why for why, _ in recent if why)
        reduced = Counter(quality for _, quality in recent if quality != FULL)
        age = min(ages.values(), default=None)
        silent = {sensor: ns for sensor, ns in ages.items() if ns > self._stale_ns}
        state = self._state(age, bool(late), bool(refused or reduced or silent))
        if provisional and state not in STALE:
            state = "waiting"
        text = _text(state, age, len(recent), refused, reduced, silent, late)
        seconds = {sensor: ns / 1e9 for sensor, ns in ages.items()}
        return Health(
            state, None if age is None else age / 1e9, seconds, self._stamp_ns, len(recent), dict(refused),
            dict(reduced), text,
        )  # fmt: skip

    def _age_ns(self, one: _Taken, now_ns: int) -> int:
        """Return the age of a frame: by its stamp, and at least its delay plus the time since it arrived."""
        return max(now_ns - one.arrived_ns + one.late_ns, self.stamps.age_ns(one.stamp_ns, now_ns))

    def _late_ns(self, one: _Taken, now_ns: int) -> int:
        """Return how old a frame was when it arrived, as known by now; 0 if its sensor counts as silent since."""
        since_ns = now_ns - one.arrived_ns
        if since_ns > self._stale_ns:
            return 0
        return max(one.late_ns, self.stamps.clock_age_ns(one.stamp_ns, now_ns) - since_ns)

    def _state(self, age_ns: int | None, late: bool, impaired: bool) -> State:
        if age_ns is None:
            return "waiting"
        if age_ns > self._lost_ns:
            return "lost"
        if age_ns > self._stale_ns or late:
            return "stale"
        return "degraded" if impaired else "current"


def _text(
    state: State, age_ns: int | None, frames: int, refused: Counter[str], reduced: Counter[str],
    silent: dict[str, int], late: dict[str, int],
) -> str:  # fmt: skip
    parts = ["no trusted frame yet" if age_ns is None else f"last trusted frame {age_ns / 1e9:.2f} s ago"]
    for word, counts in (("refused", refused), ("mapped at reduced quality", reduced)):
        if counts:
            listed = ", ".join(f"{number} x {name}" for name, number in counts.most_common(3))
            others = counts.total() - sum(number for _, number in counts.most_common(3))
            listed += f", {others} x other" if others else ""
            parts.append(f"{counts.total()} of {frames} frames {word} ({listed})")
    parts += [f"frames of '{sensor}' arrive {ns / 1e9:.2f} s late" for sensor, ns in list(late.items())[:3]]
    if state == "waiting" and age_ns is not None:
        parts.append("no frame has confirmed the first one yet")
    if state == "degraded":
        parts += [f"sensor '{sensor}' silent for {ns / 1e9:.2f} s" for sensor, ns in list(silent.items())[:3]]
    return f"{state}: {'; '.join(parts)}"
