# SPDX-License-Identifier: Apache-2.0
"""The health of a map: the age of its last trusted frame, and what became of recent frames."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from stereovox.config import Config
from stereovox.threads import MapLock

MAX_FRAMES = 1000
"""Recent frames that are remembered."""
FULL = "full"
"""Name of the quality level that leaves nothing out."""
State = Literal["waiting", "current", "degraded", "stale", "lost"]


@dataclass(frozen=True)
class Health:
    """How current a map is.

    Attributes:
        state: `waiting`: no trusted frame yet. `current`. `degraded`: recent frames were refused or used at reduced
            quality, or one of several sensors is silent. `stale`, `lost`: no trusted frame for longer than
            `trust.stale_s`, `trust.lost_s`.
        age_s: Seconds since the last trusted frame arrived; None while waiting.
        ages_s: The same for each sensor.
        stamp_ns: Time of the last trusted frame by its own clock, in nanoseconds; None while waiting.
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
    """A clock that never goes back: it continues where the clock it reads was set back."""

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


class HealthMonitor:
    """Records when each frame arrived and what became of it. clock: nanoseconds now; it may be set back."""

    def __init__(self, config: Config, clock: Callable[[], int]):
        self.now = MonotonicClock(clock)
        self._stale_ns, self._lost_ns = round(1e9 * config.trust.stale_s), round(1e9 * config.trust.lost_s)
        self._arrivals: dict[str, int] = {}
        self._stamp_ns: int | None = None
        self._recent: deque[tuple[int, str, str]] = deque(maxlen=MAX_FRAMES)  # arrival, refusal, quality

    def accept(self, arrived_ns: int, sensor: str, stamp_ns: int, quality: str) -> None:
        """Record a frame that the map took in; arrived_ns: by `now`."""
        self._arrivals[sensor] = arrived_ns
        self._stamp_ns = stamp_ns
        self._recent.append((arrived_ns, "", quality))

    def refuse(self, arrived_ns: int, reason: str) -> None:
        """Record a frame that was refused."""
        self._recent.append((arrived_ns, str(reason), FULL))

    def health(self, now_ns: int | None = None) -> Health:
        """Return the health at `now_ns` by the clock; None: now."""
        now = self.now(now_ns)
        ages = {sensor: now - arrived for sensor, arrived in self._arrivals.copy().items()}  # another thread may add
        recent = [(why, quality) for arrived, why, quality in self._recent.copy() if now - arrived <= self._lost_ns]
        refused = Counter(why for why, _ in recent if why)
        reduced = Counter(quality for _, quality in recent if quality != FULL)
        age = min(ages.values(), default=None)
        silent = {sensor: ns for sensor, ns in ages.items() if ns > self._stale_ns}
        state = self._state(age, bool(refused or reduced or silent))
        text = _text(state, age, len(recent), refused, reduced, silent)
        seconds = {sensor: ns / 1e9 for sensor, ns in ages.items()}
        return Health(
            state, None if age is None else age / 1e9, seconds, self._stamp_ns, len(recent), dict(refused),
            dict(reduced), text,
        )  # fmt: skip

    def _state(self, age_ns: int | None, impaired: bool) -> State:
        if age_ns is None:
            return "waiting"
        if age_ns > self._lost_ns:
            return "lost"
        if age_ns > self._stale_ns:
            return "stale"
        return "degraded" if impaired else "current"


def _text(
    state: State, age_ns: int | None, frames: int, refused: Counter[str], reduced: Counter[str], silent: dict[str, int]
) -> str:
    parts = ["no trusted frame yet" if age_ns is None else f"last trusted frame {age_ns / 1e9:.2f} s ago"]
    for word, counts in (("refused", refused), ("mapped at reduced quality", reduced)):
        if counts:
            listed = ", ".join(f"{number} x {name}" for name, number in counts.most_common(3))
            others = counts.total() - sum(number for _, number in counts.most_common(3))
            listed += f", {others} x other" if others else ""
            parts.append(f"{counts.total()} of {frames} frames {word} ({listed})")
    if state == "degraded":
        parts += [f"sensor '{sensor}' silent for {ns / 1e9:.2f} s" for sensor, ns in list(silent.items())[:3]]
    return f"{state}: {'; '.join(parts)}"
