# SPDX-License-Identifier: Apache-2.0
"""The kinds of mappers to which random frames are offered."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import stereovox as sv
from stereovox.mapper import GridMapper

SELDOM = 0.1
"""Share of kinds with tiles on disk: inspecting these fully is slow."""
ANYWHERE = {"trust.ordered": False, "trust.max_speed_mps": 1e12, "trust.max_turn_dps": 1e12, "trust.settle_s": 0}
"""Otherwise nearly all frames would be refused for jumps."""
SMALL = {"voxel_size": 0.25, "max_range": 4.0, "stereo.disparities": 16, **ANYWHERE}
WINDOW = {"window.size": (12, 12, 6), "window.trigger": 1}


@dataclass(frozen=True)
class Kind:
    """A kind of mapper: its profile and settings, and whether it makes a floor's grid.

    callers: threads that add to it concurrently. share: frequency of its turns, relative to 1 for most others.
    """

    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    profile: str = "default"
    grid: bool = False
    callers: int = 1
    share: float = 1.0

    def make(self) -> sv.Mapper | GridMapper:
        """Return a new mapper."""
        return (GridMapper if self.grid else sv.Mapper)(self.profile, **{**SMALL, **self.settings})


KINDS = [
    Kind("projective"),
    Kind("projective, two threads, as a sensor tells", {"threads": 2, "depth.far": "infinite", "map.cell": "int8"}),
    Kind("projective, window, downsampled", {**WINDOW, "depth.downsample": 2}),
    Kind("projective, window on disk", {**WINDOW, "window.outside": "keep"}, share=SELDOM),
    Kind("projective, fixed window, sphere", {**WINDOW, "window.centre": (0, 0, 0), "sphere.step_deg": 5}),
    Kind("projective, flat cells, stamps in order",
         {"steps": (0.25, 0.25, 0.1), "trust.ordered": True, "trust.settle_s": 1}),
    Kind("projective, not denoised, times, confirmed",
         {"depth.denoise": False, "map.keep_times": True, "map.forget_s": 2.0, "map.confirm_hits": 3}),
    Kind("projective, little memory", {"max_memory": 150_000, "up": "-y"}),
    Kind("projective, rolls when full", {"max_memory": 4_000_000, "when_full": "roll"}),
    Kind("projective, deadline", {"deadline_ms": 0.4}),
    Kind("ray, every", {"integrator": "ray", "map.cell": "uint8"}),
    Kind("ray, once, valenti", {"integrator": "ray", "ray.update": "once", "depth.far": "measured"}),
    Kind("ray, two threads, deadline", {"integrator": "ray", "threads": 2, "deadline_ms": 0.2}),
    Kind("line", {"integrator": "line", "map.cell": "int8"}),
    Kind("line, deadline, window", {"integrator": "line", "deadline_ms": 0.3, **WINDOW}),
    Kind("profile chien2020", profile="chien2020"),
    Kind("profile valenti2018", profile="valenti2018"),
    Kind("callers: projective", {"threads": 2, "map.keep_times": True}, callers=3),
    Kind("callers: ray, window", {"integrator": "ray", **WINDOW}, callers=3, share=0.5),
    Kind("grid, exact, once", {"grid.thickness": 0.3}, grid=True),
    Kind("grid, bresenham, every",
         {"grid.traversal": "bresenham", "grid.update": "every", "scan.method": "rows"}, grid=True),
    Kind("grid, profile ist2019", profile="ist2019", grid=True),
    Kind("callers: grid", grid=True, callers=3, share=0.5),
]  # fmt: skip
