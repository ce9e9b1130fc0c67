# SPDX-License-Identifier: Apache-2.0
"""Fixes of a GNSS receiver in bags: `sensor_msgs/NavSatFix`, from latitude and longitude to metres."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from stereovox.errors import FrameRefused, SourceError, did_you_mean
from stereovox.sources.bags import open_bag
from stereovox.sources.bags.messages import Wire
from stereovox.sources.bags.recording import parse_as

FIX = "sensor_msgs/NavSatFix"
RADIUS, FLATTENING = 6378137.0, 1 / 298.257223563
"""WGS 84 ellipsoid: semi-major axis in metres, and flattening."""
MAX_FIXES = 1_000_000


@dataclass(frozen=True)
class FixOptions:
    """Options behind a bag's name: the topic of the receiver, if there are several."""

    topic: str = ""


def read_fixes(location: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the positions of a receiver, in metres east, north and up of its first fix.

    Args:
        location: A bag with `sensor_msgs/NavSatFix`; if there are several topics: `drive.bag?topic=/gps/fix`.

    Returns:
        Times (N,) in nanoseconds, ascending, and positions (N, 3). Messages without a fix or a height are left out.

    Raises:
        SourceError: There is no such topic, or no fix in it.
    """
    name, options = parse_as(location, FixOptions)
    topic, file = options.topic, open_bag(name)
    topics = sorted(one for one, kind in file.types.items() if kind == FIX)
    if topic and topic not in topics:
        raise SourceError(f"{name}: no topic {topic} of {FIX}{did_you_mean(topic, topics)}")
    if not topics:
        raise SourceError(f"{name}: holds no {FIX}; give a bag with a topic of it, or a file of positions in metres")
    if len(topics) > 1 and not topic:
        raise SourceError(f"{name}: several receivers, choose one: ?topic={' or ?topic='.join(topics)}")
    found = dict[int, tuple[float, ...]]()
    topic = topic or topics[0]
    for i in range(min(len(file.stamps(topic)), MAX_FIXES)):
        try:
            stamp_ns, fix = _fix(file.read(topic, i))
        except (FrameRefused, ValueError):
            continue
        found.setdefault(stamp_ns, fix)
    if not found:
        raise SourceError(f"{name}: {topic} has no fix with latitude, longitude and height")
    stamps = sorted(found)
    return np.array(stamps, np.int64), in_metres([found[stamp_ns] for stamp_ns in stamps])


def in_metres(fixes: ArrayLike) -> NDArray[np.float64]:
    """Return fixes (N, 3), degrees north, degrees east and metres above the ellipsoid, in metres east, north and up.

    Relative to the first fix and its horizon, computed through geocentric axes (WGS 84, NIMA TR8350.2, 4.3).
    """
    fixes = np.asarray(fixes, float)
    north, east = np.radians(fixes[0, :2])
    axes = np.array(
        [[-np.sin(east), np.cos(east), 0],
         [-np.sin(north) * np.cos(east), -np.sin(north) * np.sin(east), np.cos(north)],
         [np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)]]
    )  # fmt: skip
    places = _geocentric(fixes)
    return (places - places[0]) @ axes.T


def _geocentric(fixes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return fixes (N, 3) in metres from the earth's centre: towards 0 E on the equator, 90 E there, and the pole."""
    (north, east), height = np.radians(fixes[:, :2]).T, fixes[:, 2]
    e2 = FLATTENING * (2 - FLATTENING)
    across = RADIUS / np.sqrt(1 - e2 * np.sin(north) ** 2)
    level = (across + height) * np.cos(north)
    return np.stack([level * np.cos(east), level * np.sin(east), (across * (1 - e2) + height) * np.sin(north)], 1)


def _fix(wire: Wire) -> tuple[int, tuple[float, ...]]:
    """Return time and fix of a message; raises ValueError if it has none."""
    stamp_ns, _ = wire.header()
    status, _ = wire.number("b"), wire.number("H")
    fix = wire.numbers("d", 3)
    if status < 0 or not np.isfinite(fix).all() or abs(fix[0]) > 90:
        raise ValueError("no fix")
    return stamp_ns, fix
