# SPDX-License-Identifier: Apache-2.0
"""Whether a map is current: how old the last trusted frame is, and how frames fared lately."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, Literal

from stereovox.config import Config
from stereovox.threads import MapLock

MOST = 1000
"""Frames that are looked back at."""
FULL = "full"
State = Literal["waiting", "current", "degraded", "stale", "lost"]


@dataclass(frozen=True)
class Health:
    """How far a map can be relied on now.

    state: `waiting`: no trusted frame yet; `current`; `degraded`: frames were lately refused or looked at less
        thoroughly, or one of several sensors is silent; `stale`, `lost`: no trusted frame for longer than
        `trust.stale_s`, `trust.lost_s`.
    age_s: seconds since the last trusted frame arrived; None while waiting. ages_s: the same for each sensor.
    stamp_ns: time of the last trusted frame by its own clock; None while waiting.
    frames: frames offered within the last `trust.lost_s` seconds. refused: how many of them were refused, by reason.
    reduced: how many were looked at less thoroughly, by the name of the way.
    text: the same in one line.
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
        """Share of the frames of late that were refused, 0 to 1."""
        return sum(self.refused.values()) / max(self.frames, 1)

    def as_dict(self) -> dict[str, Any]:
        """Return all that as plain values, for JSON."""
        return {**asdict(self), "refused_share": self.refused_share}


class Onward:
    """A clock that goes on where the one that it reads was set back; after a step forward it is ahead as well."""

    def __init__(self, clock: Callable[[], int]):
        self._clock, self._lock = clock, MapLock()
        self._last_ns: int | None = None
        self._ahead_ns = 0

    def __call__(self, reading_ns: int | None = None) -> int:
        """Return nanoseconds now, or at a reading of the clock as it goes now."""
        if reading_ns is not None:
            return reading_ns + self._ahead_ns
        with self._lock:
            now, last = self._clock(), self._last_ns
            self._ahead_ns += 0 if last is None else max(last - now, 0)
            self._last_ns = now
            return now + self._ahead_ns


class Watch:
    """Sees every frame arrive. clock: nanoseconds now; one that is set back makes no frame younger than it was."""

    def __init__(self, config: Config, clock: Callable[[], int]):
        self.now = Onward(clock)
        self._stale_ns, self._lost_ns = round(1e9 * config.trust.stale_s), round(1e9 * config.trust.lost_s)
        self._arrivals: dict[str, int] = {}
        self._stamp_ns: int | None = None
        self._lately: deque[tuple[int, str, str]] = deque(maxlen=MOST)  # arrival, why it was refused, way

    def took(self, arrived_ns: int, sensor: str, stamp_ns: int, way: str) -> None:
        """Note a frame that the map took in; arrived_ns: by `now`."""
        self._arrivals[sensor] = arrived_ns
        self._stamp_ns = stamp_ns
        self._lately.append((arrived_ns, "", way))

    def refused(self, arrived_ns: int, reason: str) -> None:
        """Note a frame that was refused."""
        self._lately.append((arrived_ns, str(reason), FULL))

    def health(self, now_ns: int | None = None) -> Health:
        """Return how things stand at `now_ns` by the clock; None: now."""
        now = self.now(now_ns)
        ages = {sensor: now - arrived for sensor, arrived in self._arrivals.copy().items()}  # another thread may add
        lately = [(why, way) for arrived, why, way in self._lately.copy() if now - arrived <= self._lost_ns]
        refused = Counter(why for why, _ in lately if why)
        reduced = Counter(way for _, way in lately if way != FULL)
        age = min(ages.values(), default=None)
        silent = {sensor: ns for sensor, ns in ages.items() if ns > self._stale_ns}
        state = self._state(age, bool(refused or reduced or silent))
        text = _text(state, age, len(lately), refused, reduced, silent)
        seconds = {sensor: ns / 1e9 for sensor, ns in ages.items()}
        return Health(
            state, None if age is None else age / 1e9, seconds, self._stamp_ns, len(lately), dict(refused),
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
    for word, counts in (("refused", refused), ("looked at less thoroughly", reduced)):
        if counts:
            told = ", ".join(f"{number} x {name}" for name, number in counts.most_common(3))
            others = counts.total() - sum(number for _, number in counts.most_common(3))
            told += f", {others} x other" if others else ""
            parts.append(f"{counts.total()} of {frames} frames {word} ({told})")
    if state == "degraded":
        parts += [f"sensor '{sensor}' silent for {ns / 1e9:.2f} s" for sensor, ns in list(silent.items())[:3]]
    return f"{state}: {'; '.join(parts)}"
