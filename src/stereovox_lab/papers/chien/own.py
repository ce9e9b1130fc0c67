# SPDX-License-Identifier: Apache-2.0
"""Your own recording under the profile of a paper, and under `default`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import StereovoxError
from stereovox.evaluate.metrics import summarise
from stereovox.mapper import Mapper
from stereovox.maps import VoxelMap
from stereovox.sources.base import Stream
from stereovox.view.picture import draw
from stereovox_lab.papers.chapter import Chapter, Sheet, Shown
from stereovox_lab.papers.pictures import png

PROFILES = ("chien2020", "default")


def overview_png(voxel_map: VoxelMap, way: NDArray[np.float64], heading: str) -> bytes:
    """Return a map from above, from three sides and cut open, with the camera's path (N, 3)."""
    return png(draw(voxel_map, heading=heading, trajectory=way, up=voxel_map.config.up), 70)


def map_own(source: Stream, step: Callable[[], None] = lambda: None) -> Chapter:
    """Return a chapter about a recording; without truth there is nothing to claim.

    Raises StereovoxError if it has no usable frame.
    """
    mappers = {name: Mapper(name, **{"window.size": None, "up": "z"}) for name in PROFILES}
    reports = {name: [] for name in PROFILES}
    way = []
    for frame in source:
        for name, mapper in mappers.items():
            reports[name].append(mapper.add(frame))
        if not reports[PROFILES[0]][-1].refused:
            way.append(frame.T_world_sensor[:3, 3])
        step()
    if not way:
        raise StereovoxError(f"{source.name}: not one frame can be used; stereovox map says why")
    figures = {name: summarise(mapper.map, reports[name]) for name, mapper in mappers.items()}
    heads = ("profile", "frames", "refused", "ms a frame, median", "occupied", "free")
    rows = [(name, *_row(one)) for name, one in figures.items()]
    shown = [
        Shown(f"Your recording, {name}", "", f"{source.name} under the profile {name}, without its window.",
              overview_png(mapper.map, np.array(way), f"{source.name}, {name}"))
        for name, mapper in mappers.items()
    ]  # fmt: skip
    method = (
        "The recording given with --data, mapped under both profiles. Its truth is not known, so nothing is claimed."
    )
    sheets = [Sheet("Figures", heads, rows)]
    return Chapter("own", f"Your recording: {source.name}", method, [], shown, sheets, numbers=figures)


def _row(figures: dict[str, Any]) -> tuple[str, ...]:
    ms = figures["depth_ms"]["median"] + figures["integrate_ms"]["median"]
    counts = (f"{figures[name]:,}" for name in ("occupied", "free"))
    return (f"{figures['frames']:,}", f"{figures['frames_refused']:,}", f"{ms:.2f}", *counts)
