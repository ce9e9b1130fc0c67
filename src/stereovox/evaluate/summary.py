# SPDX-License-Identifier: Apache-2.0
"""What a run did, as a dict of numbers: the same for every command."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from stereovox.frame import UpdateReport
from stereovox.maps import VoxelMap
from stereovox.maps.grid_map import GridMap


def summarise(voxel_map: VoxelMap | GridMap, reports: Sequence[UpdateReport]) -> dict[str, Any]:
    """Return frames, refusals by reason, the ways they were looked at, milliseconds, cells and memory of a run.

    `settled`: how often frames were believed again after a jump or a reset, by what a report says about it. `ways`: how
    many frames were looked at in full, how many less thoroughly for want of time (docs/safety.md).
    `frame_ms` is the whole of a frame, `match_ms` (stereo pairs), `depth_ms` and `integrate_ms` are its parts. Times
    leave out the first frame that was taken in, which may compile kernels. `memory_reserved`: the memory is that of a
    window, taken at the start.
    """
    taken = [report for report in reports if not report.refused]
    refused = Counter(report.refused for report in reports if report.refused)
    return {
        "frames": len(taken),
        "frames_refused": refused.total(),
        "refused": dict(refused.most_common()),
        "settled": dict(Counter(report.detail for report in taken if report.detail).most_common()),
        "ways": dict(Counter(report.way for report in taken).most_common()),
        "match_ms": percentiles([report.match_ms for report in taken]),
        "depth_ms": percentiles([report.depth_ms for report in taken]),
        "integrate_ms": percentiles([report.integrate_ms for report in taken]),
        "frame_ms": percentiles([report.match_ms + report.depth_ms + report.integrate_ms for report in taken]),
        **voxel_map.counts(),
        "memory_bytes": voxel_map.memory_bytes,
        "memory_reserved": voxel_map.config.window.size is not None,
    }


def percentiles(milliseconds: Sequence[float]) -> dict[str, float]:
    """Return median, p90, p99 and max, the first value left out where there are more; zeros for no value at all."""
    values = np.percentile(milliseconds[1:] or milliseconds or [0.0], [50, 90, 99, 100])
    return {name: round(float(value), 4) for name, value in zip(("median", "p90", "p99", "max"), values, strict=True)}
