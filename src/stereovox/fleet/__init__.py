# SPDX-License-Identifier: Apache-2.0
"""Many recordings, one map, many machines: Dask runs the tasks, a folder or an object store holds the results.

Space is divided, not time: a cell's value depends only on the frames that see it, in their order. First each recording
is mapped alone, which determines its trusted frames; then each box of the world is mapped from all trusted frames that
see it.
"""

from stereovox.fleet.fleet import FleetMap, map_fleet
from stereovox.fleet.plan import FleetPlan, plan_fleet
from stereovox.fleet.recordings import Recording, RecordingReport, recordings_of
from stereovox.fleet.scores import FleetScores, RecordingScore, ScoreOptions, score_fleet

__all__ = [
    "FleetMap",
    "FleetPlan",
    "FleetScores",
    "Recording",
    "RecordingReport",
    "RecordingScore",
    "ScoreOptions",
    "map_fleet",
    "plan_fleet",
    "recordings_of",
    "score_fleet",
]
