# SPDX-License-Identifier: Apache-2.0
"""Many recordings scored against their own lidars: a table like Valenti 2018, Table 8.1, made by a fleet."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.errors import MapFileError, StereovoxError
from stereovox.evaluate.lidar_truth import FREE, lidar_truth
from stereovox.evaluate.metrics import Confusion
from stereovox.evaluate.scores import score
from stereovox.evaluate.truth_cells import TruthCells, level
from stereovox.files.places import Place
from stereovox.files.safe_io import sealed, unsealed
from stereovox.fleet.cluster import cluster
from stereovox.fleet.fleet import suggested
from stereovox.fleet.recordings import COPY, Recording, Recordings, digest, fingerprint, local, recordings_of, why_not
from stereovox.frame import Progress, no_progress
from stereovox.maps.files.boxed_manifest import only_writer_at
from stereovox.maps.files.store import MANIFEST
from stereovox.opening import open_source
from stereovox.runs.engine import ended_in_order
from stereovox.runs.pose_choice import GIVEN
from stereovox.runs.recording import MapRun

VERSION = 2
"""Version of a stored score; others are redone."""
SCORES, TABLE = "scores.json", "scores.csv"
MAX_ROW = 1 << 22
"""Most bytes of one recording's stored scores."""
COLUMNS: tuple[str, ...] = (
    "recording", "profile", "frames", "refused", "tp", "fp", "tn", "fn", "accuracy", "precision", "recall",
    "specificity", "npv", "error", "correlation", "tolerance_precision", "tolerance_recall", "coverage",
)  # fmt: skip
"""Columns of the table: as in Table 8.1, plus three that forgive neighbouring cells."""


@dataclass(frozen=True)
class ScoreOptions:
    """Options for comparing maps with the truth.

    Attributes:
        free: Which cells are free in truth: all others in `view`, or those that `rays` cross; see `lidar_truth`.
        frames: Frames of each recording (`A:B:S`); None: all.
        threshold: A cell is called occupied above this probability; None: the map's own.
        tolerance: Cells within which a surface counts as found.
    """

    free: str = "view"
    frames: str | None = None
    threshold: float | None = None
    tolerance: int = 1


@dataclass(frozen=True)
class RecordingScore:
    """The score of one recording's map.

    Attributes:
        recording: Its name.
        profile: Profile of the map.
        frames: Frames in the map.
        refused: Refused frames.
        scores: All measures, as `Scores.as_dict` names them; empty if there are none.
        seconds: Time it took.
        error: Why it has no scores, one line; "" if it has some.
    """

    recording: str
    profile: str
    frames: int = 0
    refused: int = 0
    scores: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0
    error: str = ""

    def row(self) -> dict[str, Any]:
        """Return its table row: a value for each of `COLUMNS`."""
        known = {"recording": self.recording, "profile": self.profile, "frames": self.frames, "refused": self.refused}
        return {name: known.get(name, self.scores.get(name)) for name in COLUMNS}


@dataclass(frozen=True, eq=False)
class FleetScores:
    """Result of `score_fleet`.

    Attributes:
        scored: The score of each recording under each profile, in their order.
        out: Folder or URL with `scores.csv` and `scores.json`.
    """

    scored: Sequence[RecordingScore]
    out: str

    def table(self) -> list[dict[str, Any]]:
        """Return the rows of the table, then one for all recordings of each profile.

        That row sums the cells; its error is over all observed cells together, and it has no correlation.
        """
        good = [one for one in self.scored if not one.error]
        profiles = dict.fromkeys(one.profile for one in good)
        return [*(one.row() for one in good), *(_all_of(name, [one for one in good if one.profile == name])
                                                 for name in profiles)]  # fmt: skip

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox score --json`."""
        broken = [f"{one.recording}: {one.error}" for one in self.scored if one.error]
        return {"table": self.table(), "out": self.out, **({"doubts": broken} if broken else {})}


def score_fleet(
    recordings: Recordings,
    out: str | Path,
    profiles: Iterable[str | Path | Config] | None = None,
    *,
    options: ScoreOptions | None = None,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> FleetScores:
    """Map each of many recordings alone, and score its map against the truth from its lidar.

    Finished work is kept: the same call with `resume` scores only new recordings, profiles and settings.

    Args:
        recordings: See `recordings_of`; each must have a lidar, as in KITTI.
        out: Folder or URL for `scores.csv` (the table) and `scores.json` (all measures).
        profiles: Profiles to compare: names, TOML files or `Config`; None: the default one with the cell size and range
            that the first recording suggests, as for `map_fleet`.
        options: How maps are compared with the truth; None: as in Valenti 2018.
        resume: Continue existing scores.
        workers: Processes of a cluster of this machine; None: one for each core.
        scheduler: Address of a Dask scheduler (`tcp://host:8786`) instead.
        progress: Called with steps done, steps in all, and the current activity.
        notify: Called with a line about settings that the recording suggests.
        **overrides: Settings by name, for all profiles.

    Returns:
        The scores; recordings without one are reported there.

    Raises:
        StereovoxError: One line: a setting or `options` is wrong, no recording could be scored, or the cluster
            failed.
        MapFileError: Something else is at `out`, or it cannot be written.
        MissingExtra: Dask or obstore is not installed.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP; finished work is kept.
    """
    options = _checked(options or ScoreOptions())
    listed, place = recordings_of(recordings), Place.of(out)
    if profiles is None:
        chosen, lines = suggested(listed, overrides)
        for line in lines:
            notify(f"note: {line}")
        profiles, overrides = ["default"], {**overrides, **chosen}
    configs = [load_config(profile, **overrides) for profile in profiles]
    if not configs:
        raise StereovoxError("no profile is named; give one or more")
    _check_target(place, resume)
    with ended_in_order(), only_writer_at(place):
        keys = {one: _keys(one, configs, options) for one in listed}
        rows = {key: row for each in keys.values() for key in each if (row := _scored_before(place, key)) is not None}
        missing = {one: {key: config for key, config in keys[one].items() if key not in rows} for one in listed}
        tasks = {next(iter(each)): (place, one, each, options) for one, each in missing.items() if each}
        before = len(listed) - len(tasks)
        progress(before, len(listed), "recordings")
        with cluster(scheduler, workers, notify) as run:
            for n, (_, found) in enumerate(run.results(score_recording, tasks), before + 1):
                rows |= found
                progress(n, len(listed), "recordings")
        scores = FleetScores([rows[key] for one in listed for key in keys[one]], str(out))
        if all(row.error for row in scores.scored):
            first = scores.scored[0]
            raise StereovoxError(f"not one recording could be scored ({first.recording}: {first.error})")
        place.write_all({SCORES: json.dumps([asdict(row) for row in scores.scored]).encode(), TABLE: _csv(scores)})
    return scores


def score_recording(
    place: Place, recording: Recording, configs: Mapping[str, Config], options: ScoreOptions
) -> dict[str, RecordingScore]:
    """Score a recording's maps under settings by their keys, and store each score in a place; a worker's task."""
    truths, rows, where = dict[tuple[float, float], TruthCells](), dict[str, RecordingScore](), ""
    with TemporaryDirectory(prefix="stereovox-") as folder:
        for number, (key, config) in enumerate(configs.items()):
            started = perf_counter()
            try:
                where = where or local(recording.where, Path(folder) / COPY)  # from an object store only once
                sizes = config.voxel_size, config.max_range
                if sizes not in truths:  # first, so that a recording without a lidar is not mapped in vain
                    source: Any = open_source(where)
                    truth, _ = lidar_truth(source, *sizes, options.free, options.frames)
                    truths[sizes] = TruthCells(truth, options.tolerance)
                row = _scored(where, Path(folder) / f"map{number}", config, truths[sizes], options, recording)
            except Exception as error:
                why = why_not(recording, error, Path(folder))
                row = RecordingScore(recording.where, config.profile, error=why)
            rows[key] = replace(row, seconds=perf_counter() - started)
            if not row.error:  # failures are retried
                (place / "scores").write(f"{key}.json", sealed(asdict(rows[key])))
    return rows


def _scored(
    where: str, folder: Path, config: Config, truth: TruthCells, options: ScoreOptions, recording: Recording
) -> RecordingScore:
    settings: dict[str, Any] = {"profile": config, "poses": GIVEN, "checkpoint_s": 0, "frames": options.frames}
    with MapRun(where, folder, **settings) as run:
        made = run.finish().map
    numbers = score(made, truth, options.threshold).as_dict()
    return RecordingScore(recording.where, config.profile, made.frames, made.frames_refused, numbers)


def _checked(options: ScoreOptions) -> ScoreOptions:
    """Return the validated options; raises StereovoxError for bad values, before any work."""
    if options.threshold is not None:
        level(options.threshold)
    if options.free not in FREE:
        raise StereovoxError(f"free '{options.free}' is not known; say {' or '.join(FREE)}")
    if not 0 <= options.tolerance <= 8:
        raise StereovoxError(f"tolerance {options.tolerance} must be 0 to 8 cells")
    return options


def _check_target(place: Place, resume: bool) -> None:
    """Raise MapFileError if a place is not for scores."""
    if place.find(MANIFEST) is not None:
        raise MapFileError(f"{place}: is a map; choose another name for the scores")
    there = [name for name in place.names("") if not name.startswith(".")]
    foreign = [name for name in there if name not in (SCORES, TABLE) and not name.startswith("scores/")]
    if foreign:
        raise MapFileError(f"{place}: holds other things ({foreign[0]}); choose another name for the scores")
    if there and not resume:
        raise MapFileError(f"{place}: there are already scores; continue them with --resume, or choose another name")


def _keys(recording: Recording, configs: Sequence[Config], options: ScoreOptions) -> dict[str, Config]:
    """Return the settings by names derived from all that their scores depend on."""
    of = [VERSION, recording.where, fingerprint(recording.where), asdict(options)]
    return {digest([*of, config.model_dump(mode="json", exclude={"threads"})]): config for config in configs}


def _scored_before(place: Place, key: str) -> RecordingScore | None:
    saved = (place / "scores").find(f"{key}.json", MAX_ROW)
    try:
        return None if saved is None else RecordingScore(**unsealed(saved))
    except (TypeError, ValueError):
        return None  # damaged: it is scored again


def _all_of(profile: str, scored: Sequence[RecordingScore]) -> dict[str, Any]:
    """Return the row of all recordings under one profile."""
    counts = {name: sum(one.scores[name] for one in scored) for name in ("tp", "fp", "tn", "fn")}
    observed = [one.scores["observed"]["cells"] for one in scored]
    cells, errors = sum(observed), [one.scores["error"] or 0.0 for one in scored]
    error = sum(n * error for n, error in zip(observed, errors, strict=True)) / cells if cells else None
    known = {
        "recording": "all", "profile": profile, "frames": sum(one.frames for one in scored),
        "refused": sum(one.refused for one in scored), **counts, **Confusion(**counts).rates(), "error": error,
        "coverage": cells / max(sum(counts.values()), 1),
    }  # fmt: skip
    return {name: known.get(name) for name in COLUMNS}


def _csv(scores: FleetScores) -> bytes:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS)
    writer.writeheader()
    writer.writerows(scores.table())
    return text.getvalue().encode()
