# SPDX-License-Identifier: Apache-2.0
"""Measurements beyond time per frame, by name: start, overhead, threads, growth with path and map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from stereovox.config import Config
from stereovox.errors import ConfigError, did_you_mean
from stereovox_lab.bench.frames import Progress, Recording, silent
from stereovox_lab.bench.growth import CELLS, FRAMES, cost_along_path, cost_by_map_size, path_table, size_table
from stereovox_lab.bench.overhead import overhead, overhead_table, thread_scaling, thread_table
from stereovox_lab.bench.results import Table
from stereovox_lab.bench.rows import Variant
from stereovox_lab.bench.start import first_frame, first_frame_table, start_up, start_up_table

USUAL_SIZE = 0.05
"""Metres; measurements at one voxel size use the requested size nearest to this."""


@dataclass(frozen=True)
class Given:
    """Inputs of measurements: frames in memory, and options."""

    recording: Recording
    voxel_sizes: Sequence[float]
    variant: Variant = field(default_factory=Variant)
    max_range: float | None = None
    path_frames: int = FRAMES
    most_cells: int = CELLS[-1]
    tell: Progress = silent

    @property
    def config(self) -> Config:
        """Settings with the usual voxel size."""
        size = min(self.voxel_sizes, key=lambda size: abs(size - USUAL_SIZE))
        return self.variant.config(size, self.max_range)


@dataclass(frozen=True)
class Measurement:
    """A measurement: description, function, and table of its result."""

    about: str
    run: Callable[[Given], dict[str, Any]]
    table: Callable[[dict[str, Any]], Table]


def _threads(given: Given) -> dict[str, Any]:
    name = given.variant.integrator
    return thread_scaling(given.recording, given.voxel_sizes, name, given.max_range, tell=given.tell)


def _map_size(given: Given) -> dict[str, Any]:
    cells = [number for number in CELLS if number <= given.most_cells]
    return cost_by_map_size(given.recording, given.config, cells or CELLS[:1], tell=given.tell)


MEASUREMENTS = {
    "threads": Measurement("ms a frame on 1 to all cores", _threads, thread_table),
    "first-frame": Measurement(
        "seconds to the first frame in the map, with and without compiled kernels",
        lambda given: first_frame(given.recording.frames, given.config, tell=given.tell),
        first_frame_table,
    ),
    "start-up": Measurement("import stereovox and --help", lambda given: start_up(tell=given.tell), start_up_table),
    "overhead": Measurement(
        "Mapper.add on empty images", lambda given: overhead(given.config, tell=given.tell), overhead_table
    ),
    "map-size": Measurement("ms a frame in maps of 10^4 to 10^8 cells", _map_size, size_table),
    "path": Measurement(
        "ms a frame along a simulated flight",
        lambda given: cost_along_path(given.path_frames, given.tell),
        path_table,
    ),
}
"""By name, the quick ones first."""


def check_names(names: Sequence[str]) -> list[str]:
    """Return `names` in the order of `MEASUREMENTS`, each once; raises ConfigError for an unknown one."""
    for name in names:
        if name not in MEASUREMENTS:
            raise ConfigError(f"unknown measurement '{name}'{did_you_mean(name, MEASUREMENTS)}")
    return [name for name in MEASUREMENTS if name in names]
