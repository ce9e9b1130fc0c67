# SPDX-License-Identifier: Apache-2.0
"""Time from a stereo pair to an updated map, by part."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

from stereovox.config import Config
from stereovox.evaluate.metrics import percentiles
from stereovox.frame import StereoFrame, UpdateReport
from stereovox.mapper import Mapper
from stereovox.sources.base import prefetch
from stereovox_lab.papers.valenti.mappers import Setting, config_of
from stereovox_lab.papers.valenti.recordings import Drive

THREADS = 2
MAX_FRAMES = 100
"""Most frames timed."""


@dataclass(frozen=True)
class Speed:
    """Speed of a profile on a drive, from image files to updated map, with files read ahead by their own thread.

    hertz: frames a second over all; ms: median and further percentiles of each part, reading runs in parallel with the
    others.
    cores: processors this process may use.
    """

    profile: str
    setting: Setting
    image: str
    frames: int
    hertz: float
    ms: dict[str, dict[str, float]]
    cores: int

    def numbers(self) -> dict[str, Any]:
        """Return all figures, fit for JSON."""
        sizes = {"voxel_size": self.setting.voxel_size, "max_range": self.setting.max_range}
        return {**{name: value for name, value in vars(self).items() if name != "setting"}, **sizes}


def time_mapping(
    drive: Drive, numbers: Sequence[int], profile: str, setting: Setting, step: Callable[[], None] = lambda: None
) -> Speed:
    """Map the drive twice and time the second pass, when all kernels are compiled. step: called after each frame."""
    numbers = numbers[:MAX_FRAMES]
    config = config_of(profile, setting, threads=THREADS, **{"stereo.threads": THREADS})
    _map_all(drive, numbers, config, step)
    seconds, reading, reports = _map_all(drive, numbers, config, step)
    taken = [report for report in reports if not report.refused]
    ms = {
        "read": percentiles(reading),
        "match": percentiles([report.match_ms for report in taken]),
        "prepare": percentiles([report.depth_ms for report in taken]),
        "map": percentiles([report.integrate_ms for report in taken]),
    }
    image, hertz = f"{drive.camera.width}x{drive.camera.height}", round(len(taken) / seconds, 2)
    return Speed(profile, setting, image, len(taken), hertz, ms, _cores())


def _map_all(
    drive: Drive, numbers: Sequence[int], config: Config, step: Callable[[], None]
) -> tuple[float, list[float], list[UpdateReport]]:
    """Return the seconds for all frames, the milliseconds to read each, and the mapper's report of each."""
    mapper, reading, reports = Mapper(config), [], []

    def read(n: int) -> StereoFrame:
        begun = perf_counter()
        frame = drive.frame(numbers[n])
        reading.append(1e3 * (perf_counter() - begun))
        return frame

    start = perf_counter()
    for frame in prefetch(read, len(numbers)):
        reports.append(mapper.add(frame))
        step()
    return perf_counter() - start, reading, reports


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
