# SPDX-License-Identifier: Apache-2.0
"""A fleet's whole run: index the recordings, map the boxes, coarsen them, and write the manifest last."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

from stereovox.config import Config, load_config
from stereovox.errors import ConfigError, MapFileError, StereovoxError
from stereovox.evaluate.metrics import mostly_lost
from stereovox.files.places import Place
from stereovox.files.safe_io import sealed, unsealed
from stereovox.fleet.boxes import DONE, Box, BoxesBefore, DoneBox, boxes_of, map_box
from stereovox.fleet.cluster import Cluster, cluster
from stereovox.fleet.recordings import (
    RECORDINGS,
    SETTINGS,
    Recording,
    RecordingReport,
    Recordings,
    boxes_seen,
    frames_of,
    index_recording,
    local,
    manifest_of,
    recordings_of,
    report_of,
)
from stereovox.frame import Progress, no_progress
from stereovox.maps.boxed_map import USUAL_SIDE, BoxedMap, check_boxed_target, side_of
from stereovox.maps.cells.pyramid import coarser_layout, families, is_top, names_of, write_parent
from stereovox.maps.files.boxed_manifest import (
    BoxedManifest,
    only_writer_at,
    read_boxed_manifest,
    sweep_boxes,
    write_boxed_manifest,
)
from stereovox.maps.files.store import MANIFEST, viewpoint_from
from stereovox.maps.record.history import History
from stereovox.maps.storage.boxes import MAX_SIDE, BoxEntry, BoxLayout
from stereovox.opening import open_source
from stereovox.products.edit import together
from stereovox.runs.engine import SURVEYED, ended_in_order
from stereovox.runs.survey import PICTURES_UPRIGHT, survey

MAX_SETTINGS = 1 << 20
MAX_BOXES = 250_000
"""Most boxes that a manifest can name, with the levels' boxes and all inputs."""
OVERLAP = 4.0
"""Approximate upper bound on the boxes per frame."""
ONE_MACHINE = {"window.size": None, "max_memory": None, "deadline_ms": None, "map.forget_s": None}
"""Settings under which a box can be mapped alone: others make a cell depend on more than the frames that see it."""


@dataclass(frozen=True, eq=False)
class FleetMap:
    """Result of `map_fleet`.

    Attributes:
        map: The map, opened without loading it.
        out: Its location.
        recordings: The report of each recording.
        boxes: Number of boxes, and how many of them were mapped by this run.
        frames_read: Number of times a frame was mapped into a box.
        seconds: Time of this run, and of its tasks over all workers.
    """

    map: BoxedMap
    out: str
    recordings: Sequence[RecordingReport]
    boxes: tuple[int, int]
    frames_read: int
    seconds: tuple[float, float]

    @property
    def overlap(self) -> float:
        """Average number of boxes of a trusted frame."""
        return self.frames_read / max(self.map.frames, 1)

    def summary(self) -> dict[str, Any]:
        """Return the numbers of `stereovox fleet --json`, except the map's."""
        broken: list[Any] = [f"{one.recording}: {one.error}" for one in self.recordings if one.error]
        broken += mostly_lost(self.map.frames, self.map.frames + self.map.frames_refused, "frames")
        return {
            "recordings": [one.summary() for one in self.recordings],
            "boxes": self.boxes[0],
            "boxes_mapped": self.boxes[1],
            "frames_read": self.frames_read,
            "overlap": round(self.overlap, 3),
            "seconds": round(self.seconds[0], 1),
            "seconds_of_workers": round(self.seconds[1], 1),
            **({"doubts": broken} if broken else {}),
        }


def map_fleet(
    recordings: Recordings,
    out: str | Path,
    *,
    profile: str | Path | Config | None = None,
    box_m: float | None = None,
    resume: bool = False,
    workers: int | None = None,
    scheduler: str | None = None,
    progress: Progress = no_progress,
    notify: Callable[[str], None] = lambda line: None,
    **overrides: Any,
) -> FleetMap:
    """Map many recordings into one map in boxes, on all cores of this machine or on a Dask cluster.

    Each recording is first mapped alone, by its own mapper, which decides which of its frames are trusted. Then each
    box of the world is mapped from all trusted frames that see it, in the order of the recordings. So the map does not
    depend on the number of workers, the boxes or their order: for one recording it equals the map of `map_recording`
    with the same settings, for several the map of one mapper that gets the trusted frames recording by recording.


    Finished work is kept: after a kill, a full disk or a lost scheduler the same call with `resume` completes the rest.
    With other recordings, or other poses of some, it redoes only what these change.

    Args:
        recordings: See `recordings_of`. All workers must reach them under these names.
        out: Folder or URL (`s3://bucket/city.svox`) of the map, which all workers must reach.
        profile: Profile name, TOML file or `Config`; None: with `resume` as before, else as the first recording
            suggests.
        box_m: Side of a box in metres; None: as before, else 256 cells, or 512 if frames reach far (`box_side`).
        resume: Continue an existing map: it becomes the map of these recordings.
        workers: Processes of a cluster of this machine; None: one for each core.
        scheduler: Address of a Dask scheduler (`tcp://host:8786`) instead.
        progress: Called with steps done, steps in all, and the current activity.
        notify: Called with each line that a user should see.
        **overrides: Settings by name, as for `Mapper`.

    Returns:
        The map, and the report of each recording; an unreadable one is reported and left out.

    Raises:
        StereovoxError: One line: no frame was usable, a setting is impossible in boxes, or the cluster failed.
        MapFileError: Something else is at `out`, another run is writing it, or it cannot be written.
        MissingExtra: Dask or obstore is not installed.
        KeyboardInterrupt: Ctrl-C, SIGTERM or SIGHUP; finished work is kept.
    """
    started, listed, place = perf_counter(), recordings_of(recordings), Place.of(out)
    check_boxed_target(place, (SETTINGS, f"{RECORDINGS}/", f"{DONE}/"))
    with ended_in_order(), only_writer_at(place):
        layout = _layout(place, listed, profile, box_m, resume, notify, overrides)
        keys = {one: one.key(layout) for one in listed}  # once, because files may change meanwhile
        with cluster(scheduler, workers, notify) as run:
            place.write(SETTINGS, sealed(_settings(layout)))
            reports = _indexed(run, place, keys, layout, progress)
            used = [one for one in listed if not reports[one].error]
            if not used:
                if not place.names(f"{RECORDINGS}/") and place.find(MANIFEST) is None:
                    place.remove([SETTINGS])  # the next run starts afresh
                first = reports[listed[0]]
                raise StereovoxError(
                    f"not one recording could be used, no map is written ({first.recording}: {first.error})"
                )
            _check_still_there(place, reports)
            boxes = _boxes(place, layout, [(keys[one], reports[one].frames) for one in used])
            if len(boxes) > MAX_BOXES:
                raise StereovoxError(
                    f"{len(boxes):,} boxes of {layout.side} cells: a map has at most {MAX_BOXES:,}; choose larger "
                    "boxes (--box, at most 512 cells), or make several maps"
                )
            before = BoxesBefore(place)
            done, mapped = _mapped(run, place, layout, boxes, before, progress)
            entries = [box.entry for box in done.values() if box.entry is not None]
            levels = _levels(run, place, layout, entries, before, progress)
        inputs = {inputs: None if box.entry is None else box.entry.box for inputs, box in done.items()}
        manifest = _manifest(place, layout, {one: keys[one] for one in used}, entries, levels, inputs)
        write_boxed_manifest(place, manifest)
        _sweep(place, manifest, {keys[one] for one in used})
    return FleetMap(
        BoxedMap(place, manifest), str(out), [reports[one] for one in listed], (len(boxes), len(mapped)),
        sum(box.frames for box in boxes),
        (perf_counter() - started, sum(one.seconds for one in (*mapped, *reports.values()))),
    )  # fmt: skip


def settings_for(
    recordings: Sequence[Recording], profile: str | Path | Config | None, overrides: Mapping[str, Any]
) -> tuple[Config, list[str]]:
    """Return the settings of a fleet, as the first recording suggests if no profile is given, and lines about it.

    Raises ConfigError for settings with which boxes cannot be mapped one by one.
    """
    chosen, lines = suggested(recordings, overrides) if profile is None else ({}, [])
    config = load_config("default" if profile is None else profile, **{**overrides, **chosen})
    flat = {"window.size": config.window.size, "max_memory": config.max_memory}
    flat |= {"deadline_ms": config.deadline_ms, "map.forget_s": config.map.forget_s}
    for name, value in flat.items():
        if value != ONE_MACHINE[name]:
            raise ConfigError(f"{name} {value}: cells would depend on more than the frames that see them; leave it out")
    if config.dimensions != 3 or config.device != "cpu" or config.map.frames_budget is not None:
        raise ConfigError("a fleet maps in space, on processors, and keeps all frames; choose a profile that does")
    return load_config(config, **{"map.keep_frames": False}), lines


def suggested(recordings: Sequence[Recording], overrides: Mapping[str, Any]) -> tuple[dict[str, Any], list[str]]:
    """Return the settings that the first readable recording suggests, and lines about them.

    A recording in an object store is copied for that.
    """
    for one in recordings:
        with TemporaryDirectory(prefix="stereovox-") as folder, suppress(StereovoxError, OSError):
            # its fault is reported later; the next may do
            return survey(open_source(local(one.where, Path(folder))), SURVEYED).settings(overrides, PICTURES_UPRIGHT)
    return {}, []


def box_side(box_m: float | None, config: Config) -> int:
    """Return the side of a fleet's boxes in cells: of `box_m` metres, else 256, or 512 if frames reach far.

    A frame is in about (1 + reach / side)^2 boxes. A completely known box takes 34 MB with 256 cells,
    eight times as much with 512. Raises StereovoxError as `side_of`.
    """
    if box_m is not None:
        return side_of(box_m, config.cell)
    reach = config.max_range / min(config.cell)
    return USUAL_SIDE if (1 + reach / USUAL_SIDE) ** 2 <= OVERLAP else MAX_SIDE


def _layout(
    place: Place,
    listed: Sequence[Recording],
    profile: str | Path | Config | None,
    box_m: float | None,
    resume: bool,
    notify: Callable[[str], None],
    overrides: Mapping[str, Any],
) -> BoxLayout:
    """Return settings and boxes, or an earlier run's if it is continued."""
    known = _known_layout(place)
    if known is None and place.find(MANIFEST) is not None:
        raise MapFileError(f"{place}: is a map that no fleet made, and would be lost; choose another name")
    if known is not None and not resume:
        raise MapFileError(
            f"{place}: there is already a map, or a part of one; continue it with --resume, or choose another name"
        )
    config, lines = settings_for(listed, known.config if known is not None and profile is None else profile, overrides)
    layout = BoxLayout(config, known.side if known is not None and box_m is None else box_side(box_m, config))
    if known is not None and (_settings(layout) != _settings(known)):
        raise MapFileError(f"{place}: was made with other settings; leave them out to continue, or choose another name")
    for line in lines:
        notify(f"note: {line}")
    return layout


def _settings(layout: BoxLayout) -> dict[str, Any]:
    """Return settings and boxes as plain values for JSON, except settings that do not affect cells."""
    return {"config": layout.config.model_dump(mode="json", exclude={"threads"}), "side": layout.side}


def _known_layout(place: Place) -> BoxLayout | None:
    """Return settings and boxes of an earlier run; None if there was none."""
    known = place.find(SETTINGS, MAX_SETTINGS)
    try:
        values = None if known is None else unsealed(known)
        return None if values is None else BoxLayout(load_config(values["config"]), values["side"])
    except (KeyError, TypeError, ValueError) as error:
        raise MapFileError(f"{place}/{SETTINGS}: is damaged ({error}); choose another name for the map") from None


def _indexed(
    run: Cluster, place: Place, keys: Mapping[Recording, str], layout: BoxLayout, progress: Progress
) -> dict[Recording, RecordingReport]:
    """Return the report of each recording, mapping the ones not yet mapped alone."""
    reports = {one: report for one, key in keys.items() if (report := report_of(place, key)) is not None}
    missing = {one.where: one for one in keys if one not in reports}
    tasks = {where: (place, one, layout, keys[one]) for where, one in missing.items()}
    progress(len(reports), len(keys), "recordings")
    for where, report in run.results(index_recording, tasks):
        reports[missing[where]] = report
        progress(len(reports), len(keys), "recordings")
    return reports


def _boxes(place: Place, layout: BoxLayout, used: Sequence[tuple[str, int]]) -> list[Box]:
    """Return the boxes that recordings' frames see; used: key and number of frames of each."""
    start_ns = None
    if layout.config.map.keep_times:
        with frames_of(place, used[0][0], [0]) as frames:
            start_ns = next(frames).seen.stamp_ns
    return boxes_of([(key, boxes_seen(place, key), frames) for key, frames in used], start_ns)


def _check_still_there(place: Place, reports: Mapping[Recording, RecordingReport]) -> None:
    """Raise StereovoxError if a recording in the map is now unreadable: it would be removed."""
    if place.find(MANIFEST) is None:
        return
    made_of = read_boxed_manifest(place).extra.get("fleet", {}).get("recordings", [])
    for one, report in reports.items():
        if report.error and one.where in made_of:
            raise StereovoxError(
                f"{one.where}: is in the map and cannot be used now ({report.error}); repair it, or leave it out to "
                "remove it"
            )


def _mapped(
    run: Cluster, place: Place, layout: BoxLayout, boxes: Sequence[Box], before: BoxesBefore, progress: Progress
) -> tuple[dict[str, DoneBox], list[DoneBox]]:
    """Return all boxes by their inputs, and the ones mapped now because no earlier run had."""
    names, mapped = {box.inputs(layout): box for box in boxes}, list[DoneBox]()
    done = before.boxes(layout, names)
    tasks = {inputs: (place, layout, box) for inputs, box in names.items() if inputs not in done}
    progress(len(done), len(names), "boxes")
    for inputs, box in run.results(map_box, tasks, {inputs: names[inputs].frames for inputs in tasks}):
        done[inputs] = box
        mapped.append(box)
        progress(len(done), len(names), "boxes")
    return done, mapped


def _levels(
    run: Cluster,
    place: Place,
    layout: BoxLayout,
    entries: Sequence[BoxEntry],
    before: BoxesBefore,
    progress: Progress,
) -> list[list[BoxEntry]]:
    """Return the coarser levels, each made from the one before unless an earlier run made it from the same boxes."""
    levels: list[list[BoxEntry]] = []
    while not is_top(entries):
        of, known = {names_of(family): family for family in families(entries).values()}, before.parents(layout)
        made = {names: known[names] for names in of if names in known}
        tasks = {
            f"{layout.level}-{'-'.join(entry.name[-16:] for entry in family)}": (place, layout, family)
            for names, family in of.items()
            if names not in made
        }
        parents = [parent for parent in made.values() if parent is not None]
        for n, (_, parent) in enumerate(run.results(write_parent, tasks), len(made) + 1):
            parents += [] if parent is None else [parent]
            progress(n, len(of), "coarser levels")
        entries, layout = sorted(parents), coarser_layout(layout)
        levels.append(list(entries))
    return levels


def _manifest(
    place: Place,
    layout: BoxLayout,
    used: Mapping[Recording, str],
    entries: list[BoxEntry],
    levels: list[list[BoxEntry]],
    inputs: dict[str, Any],
) -> BoxedManifest:
    manifests = [manifest_of(place, key) for key in used.values()]
    histories = [History.loaded(one) for one in manifests]
    starts = [entry.times_start_ns for entry in entries if entry.times_start_ns is not None]
    return BoxedManifest(
        layout, entries, levels, reduce(together, histories), viewpoint_from(manifests[-1].get("viewpoint")),
        min(starts, default=None), {"fleet": {"recordings": [one.where for one in used], "boxes": inputs}},
    )  # fmt: skip


def _sweep(place: Place, manifest: BoxedManifest, keys: set[str]) -> None:
    """Remove what the map no longer uses, entries of boxes before the boxes."""
    old = [file for file in place.names(f"{RECORDINGS}/") if file.split("/")[1] not in keys]
    place.remove([*place.names(f"{DONE}/"), *old])
    sweep_boxes(place, manifest.names)
