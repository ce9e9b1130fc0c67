# SPDX-License-Identifier: Apache-2.0
"""Summary of a run as a dict of numbers, the same for every command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.frame import UpdateReport
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap
from stereovox.maps.record.history import UNCONFIRMED


def summarise(voxel_map: VoxelMap | GridMap, reports: Sequence[UpdateReport]) -> dict[str, Any]:
    """Summarise frames, refusals by reason, quality levels, milliseconds, cells and memory of a run.

    `settled`: number of times frames were accepted again after a jump or a reset, by description. `quality`:
    number of frames by quality level, full or reduced to meet the deadline (docs/safety.md).
    `frame_ms` is the whole frame, `match_ms` (stereo pairs only), `depth_ms` and `integrate_ms` are its parts.
    Times leave out the first mapped frame, which may compile kernels. `memory_reserved`: the memory is a
    window's, reserved at the start.
    """
    mapped = [report for report in reports if not report.refused]
    refused = Counter(report.refused for report in reports if report.refused)
    taken_out = max((n for n, report in enumerate(mapped) if report.taken_out), default=0)
    if taken_out:
        refused[UNCONFIRMED] += taken_out
    return {
        "frames": len(mapped) - taken_out,
        "frames_refused": refused.total(),
        "refused": dict(refused.most_common()),
        "settled": dict(Counter(report.detail for report in mapped if report.detail).most_common()),
        "quality": dict(Counter(report.quality for report in mapped).most_common()),
        "match_ms": percentiles([report.match_ms for report in mapped if report.match_ms]),
        "depth_ms": percentiles([report.depth_ms for report in mapped]),
        "integrate_ms": percentiles([report.integrate_ms for report in mapped]),
        "frame_ms": percentiles([report.match_ms + report.depth_ms + report.integrate_ms for report in mapped]),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "memory_reserved": voxel_map.config.window.size is not None,
    }


def mostly_lost(frames: int, offered: int, what: str, became: str = "are in the map") -> list[dict[str, Any]]:
    """Return, for the summary, a doubt if less than half of the frames are in the map; else nothing.

    frames: number of this run's `offered` frames in the map. what: their name (images). became: predicate of the frames
    that are not lost.
    """
    if 2 * frames >= offered:
        return []
    text = f"only {frames} of {offered} {what} {became}"
    return [{"kind": "mostly_lost", "frames": frames, "offered": offered, "text": text}]


def percentiles(milliseconds: Sequence[float]) -> dict[str, float]:
    """Return median, p90, p99 and max without the first of several values; zeros for no values."""
    values = np.percentile(milliseconds[1:] or milliseconds or [0.0], [50, 90, 99, 100])
    return {name: round(float(value), 4) for name, value in zip(("median", "p90", "p99", "max"), values, strict=True)}
