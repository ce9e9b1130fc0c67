# SPDX-License-Identifier: Apache-2.0
"""Run all mappers over one drive at one setting, and score each map against lidar truth (Valenti 2018, 8.2)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import FrameRefused
from stereovox.evaluate.decisions import Outcomes, outcomes
from stereovox.evaluate.lidar_truth import FREE, lidar_truth
from stereovox.evaluate.scores import QuickScores, Scores, score, score_reading
from stereovox.evaluate.truth_cells import TruthCells
from stereovox.maps import VoxelMap
from stereovox_lab.papers.valenti.figures import THRESHOLDS, figures
from stereovox_lab.papers.valenti.mappers import MAPPERS, Contestant, Matched, Setting, make_contestant
from stereovox_lab.papers.valenti.recordings import Drive
from stereovox_lab.papers.valenti.street import halves

TOLERANCE = 1
"""Cells."""
BOX = "box"
"""The kind of truth whose cells are those of Valenti 2018, Table 8.1: of the whole box."""
Halves = Mapping[str, tuple[TruthCells, TruthCells]]
"""By the kind of truth: its parts at the first and second half of a path."""

CALLED = 0.7
"""A cell is called occupied above this probability (8.3)."""


@dataclass
class ScoreSeries:
    """Scores a map after each frame against one truth, the same for all frames.

    truth: the truth, prepared once. threshold: as in `score`. frames, scores: entries so far.
    """

    truth: TruthCells
    threshold: float = CALLED
    frames: list[int] = field(default_factory=list)
    scores: list[QuickScores] = field(default_factory=list)

    def add(self, frame: int, voxel_map: VoxelMap) -> QuickScores:
        """Score `voxel_map` as of frame number `frame`, and record it."""
        result = score_reading(self.truth.read(voxel_map), self.truth, self.threshold)
        self.frames.append(frame)
        self.scores.append(result)
        return result

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return `frame` (F,) int64 and each measure by name (F,) float64, NaN if it has no value.

        Names of measures over observed cells alone begin with `observed_`.
        """
        rows = [_flat(score) for score in self.scores]
        columns = {name: np.array([row[name] for row in rows], float) for name in (rows[0] if rows else ())}
        return {"frame": np.array(self.frames, np.int64), **columns}


def _flat(score: QuickScores) -> dict[str, float | None]:
    numbers = score.as_dict()
    observed = numbers.pop("observed")
    return {**numbers, **{f"observed_{name}": value for name, value in observed.items()}}


@dataclass(frozen=True, eq=False)
class Judged:
    """One map of one drive. scores: by the kind of truth, `view` and `rays`, see `lidar_truth`; also `box`, if the map
    was scored after every frame.

    halves: likewise, without `box`, for the street's first and second half; None if not requested, or if the path is
    too short.
    series: measures against the frame, truth `view` (Valenti 2018, Fig 8.4), and shown: cells for a picture; both None
    if not requested.
    """

    drive: str
    mapper: str
    setting: Setting
    frames: int
    scores: Mapping[str, Scores]
    halves: Mapping[str, tuple[Scores, Scores]] | None = None
    series: Mapping[str, NDArray[Any]] | None = None
    shown: Outcomes | None = None

    def numbers(self) -> dict[str, Any]:
        """Return all figures, fit for JSON."""
        return {
            "mapper": self.mapper,
            "voxel_size": self.setting.voxel_size,
            "max_range": self.setting.max_range,
            "frames": self.frames,
            "truth": {kind: figures(scores) for kind, scores in self.scores.items()},
        }


def judge(
    drive: Drive,
    numbers: Sequence[int],
    setting: Setting,
    matched: Mapping[str, Matched],
    mappers: Iterable[str],
    *,
    every_frame: bool = False,
    halved: bool = False,
    step: Callable[[], None] = lambda: None,
) -> tuple[list[Judged], dict[str, Any]]:
    """Return the result of each mapper, and the counts of the lidar's points.

    numbers: frames of the drive; matched: their depth images, by profile. every_frame: also score each map after
    every frame, and in the end over the whole box. halved: also score both halves of the street. step: called after
    each frame of each pass: one pass for each kind of truth and each profile.
    """
    truths, counts = _truths(drive, numbers, setting, kinds(every_frame), step)
    parts = _halves(truths, _way(drive, numbers)) if halved else None
    found = []
    for profile, frames in matched.items():
        contestants = {name: make_contestant(name, setting) for name in mappers if MAPPERS[name] == profile}
        series = {name: ScoreSeries(truths["view"]) for name in contestants if every_frame}
        taken = 0
        for number, frame in frames:
            for name, contestant in contestants.items():
                contestant.add(frame)
                if name in series:
                    series[name].add(number, contestant.map())
            taken += 1
            step()
        for name, contestant in contestants.items():
            found.append(_judged(drive.name, name, contestant, setting, taken, truths, parts, series.get(name)))
    order = list(MAPPERS)
    return sorted(found, key=lambda one: order.index(one.mapper)), counts


def kinds(every_frame: bool) -> tuple[str, ...]:
    """Return the kinds of truth that `judge` uses."""
    return FREE if every_frame else tuple(kind for kind in FREE if kind != BOX)


def _truths(
    drive: Drive, numbers: Sequence[int], setting: Setting, wanted: Iterable[str], step: Callable[[], None]
) -> tuple[dict[str, TruthCells], dict[str, Any]]:
    def watched(picked: Iterable[int], count: int) -> Iterable[int]:
        for i in picked:
            yield i
            step()

    truths, counts = {}, {}
    for kind in wanted:
        truth, about = lidar_truth(drive, *setting, kind, numbers, watch=watched)
        truths[kind], counts[kind] = TruthCells(truth, TOLERANCE), about.as_dict()
    return truths, counts


def _way(drive: Drive, numbers: Sequence[int]) -> NDArray[np.float64]:
    """Return the camera positions (F, 3) of frames with a pose."""
    way = []
    for i in numbers:
        with suppress(FrameRefused):
            way.append(drive.viewpoint(i).T_world_camera[:3, 3])
    return np.array(way).reshape(-1, 3)


def _halves(truths: Mapping[str, TruthCells], way: NDArray[np.float64]) -> Halves | None:
    """Return each truth at the first and second half of the path; None if one of them has no surface."""
    found = {}
    for kind, truth in truths.items():
        if kind == BOX:
            continue
        parts = halves(way, truth.centers())
        if not all(truth.occupied[part].any() for part in parts):
            return None
        found[kind] = (truth.part(parts[0]), truth.part(parts[1]))
    return found


def _judged(
    drive: str,
    name: str,
    contestant: Contestant,
    setting: Setting,
    frames: int,
    truths: Mapping[str, TruthCells],
    parts: Halves | None,
    series: ScoreSeries | None,
) -> Judged:
    voxel_map = contestant.map()
    scores = {kind: score(voxel_map, truth, CALLED, thresholds=THRESHOLDS) for kind, truth in truths.items()}
    both = None
    if parts is not None:
        both = {
            kind: (
                score(voxel_map, first, CALLED, thresholds=THRESHOLDS),
                score(voxel_map, second, CALLED, thresholds=THRESHOLDS),
            )
            for kind, (first, second) in parts.items()
        }
    arrays, shown = None, None
    if series is not None:
        arrays, shown = series.arrays(), outcomes(truths["view"].read(voxel_map), truths["view"], CALLED)
    return Judged(drive, name, setting, frames, scores, both, arrays, shown)
