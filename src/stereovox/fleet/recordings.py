# SPDX-License-Identifier: Apache-2.0
"""The recordings of a fleet: their names, and each mapped alone, which determines its trusted frames.

A recording's results are in `recordings/KEY/`: the depth images of its trusted frames, without loss, the boxes each
sees, and the history of their map. The key is derived from all that these depend on.
"""

from __future__ import annotations

import glob
import hashlib
import io
import json
import os
import shlex
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.config import load_config
from stereovox.correct.remap import remap
from stereovox.errors import DISK_FULL, MapFileError, StereovoxError, one_line
from stereovox.files.places import Bucket, Folder, NoBucketError, Place, is_url
from stereovox.files.safe_io import sealed, unsealed
from stereovox.frame import Cloud, Frame
from stereovox.maps import VoxelMap
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.files.store import MANIFEST, MAX_MANIFEST, is_map
from stereovox.maps.record.frame_store import IN_A_PACK, files_of_frames, read_frames
from stereovox.maps.record.kept_frames import KeptFrame, digest_of
from stereovox.maps.storage.boxes import BoxLayout
from stereovox.opening import is_recording
from stereovox.runs.pose_choice import GIVEN
from stereovox.runs.recording import MapRun
from stereovox.sources.bags.recording import file_part

VERSION = 2
"""Version of a recording's results; others are redone."""
RECORDINGS = "recordings"
SETTINGS = "fleet.json"
"""File of a place's mapping settings, written first, once there are workers."""
SEEN, REPORT = "seen.npy", "report.json"
COPY, POSES = "recording", "poses"
"""Folders for the copies of a recording from an object store, and of its poses."""
TEXTS = (".txt", ".md", ".csv", ".json", ".yaml", ".yml", ".toml", ".log")
"""Endings of text files next to recordings."""
MAX_REPORT = 1 << 24
"""Most bytes of a report."""


@dataclass(frozen=True)
class Recording:
    """One of many recordings.

    Attributes:
        where: Folder, file, simulation or `s3://` prefix, as `open_source` takes it.
        poses: File with corrected poses (TUM), as `remap` takes it; None: the recording's own.
    """

    where: str
    poses: str | None = None

    def key(self, layout: BoxLayout) -> str:
        """Return a name derived from all inputs: the files as they are now, the poses, the settings and the boxes."""
        settings = [layout.side, layout.config.model_dump(mode="json", exclude={"threads"})]
        files = [fingerprint(self.where), None if self.poses is None else fingerprint(self.poses)]
        return digest([VERSION, self.where, files, settings])


Recordings = str | Path | Recording | Iterable[str | Path | Recording]
"""One or more recordings; see `recordings_of`."""


@dataclass(frozen=True)
class RecordingReport:
    """The report of a recording.

    Attributes:
        recording: Its name.
        frames: Trusted frames.
        refused: Refused frames by reason.
        seconds: Time it took to map it alone; 0 if done before.
        error: Why nothing of it is in the map, one line; "" if something is.
        notes: What was assumed about it.
    """

    recording: str
    frames: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    seconds: float = 0.0
    error: str = ""
    notes: Sequence[str] = ()

    def summary(self) -> dict[str, Any]:
        """Return the report as plain values for JSON."""
        return {**vars(self), "notes": list(self.notes)}


def recordings_of(names: Recordings) -> list[Recording]:
    """Return the recordings given by names, in their order.

    Args:
        names: One or more: recordings, patterns (`drives/*`, sorted), lists (`@drives.txt`: each line has a recording,
            and the file of its corrected poses, if any, both relative to the list; # starts a comment), or `Recording`.

    Returns:
        The recordings, each once. A pattern skips maps, and text files that are no recordings.

    Raises:
        StereovoxError: A pattern matches nothing, a list cannot be read, there is no recording, or one is named twice,
            including through a link.
    """
    found: list[Recording] = []
    for name in [names] if isinstance(names, (str, Path, Recording)) else names:
        found += [name] if isinstance(name, Recording) else _expanded(str(name))
    found = [replace(one, where=_bare(one.where)) for one in found]
    if not found:
        raise StereovoxError("no recording is named; give one or more")
    known: dict[str, str] = {}
    for one in found:
        real = _real(one.where)
        if real in known:
            also = "" if known[real] == one.where else f", also as {known[real]}"
            raise StereovoxError(f"{one.where}: is named twice{also}; name it once")
        known[real] = one.where
    return found


def index_recording(place: Place, recording: Recording, layout: BoxLayout, key: str) -> RecordingReport:
    """Map a recording alone, and write its results to a place, the report last; a worker's task.

    key: `Recording.key` at the start of the run; on another machine, or if files change, it may differ now.
    Read and mapping errors go into the report. Raises MapFileError if the place cannot be written.
    """
    notes, started = list[str](), perf_counter()
    home = place / f"{RECORDINGS}/{key}"
    with TemporaryDirectory(prefix="stereovox-") as folder:
        try:
            made, seen = _mapped_alone(recording, layout, Path(folder), notes)
        except Exception as error:
            return RecordingReport(recording.where, error=why_not(recording, error, Path(folder)), notes=notes)
        manifest = unsealed((made / MANIFEST).read_bytes())
        for name in sorted(files_of_frames(manifest["kept_frames"])):
            home.write(name, (made / name).read_bytes())
        numbers = np.repeat(np.arange(len(seen)), [len(boxes) for boxes in seen])
        rows = np.column_stack([numbers, np.concatenate(seen)]).astype(np.int32)
        array = io.BytesIO()
        np.save(array, rows)
        manifest["seen"] = digest_of(array.getvalue())
        home.write_all({MANIFEST: sealed(manifest), SEEN: array.getvalue()})
        refused = {str(why): int(number) for why, number in manifest["history"]["refused"].items()}
    report = RecordingReport(recording.where, len(seen), refused, perf_counter() - started, notes=notes)
    home.write(REPORT, sealed(report.summary()))
    return report


def why_not(recording: Recording, error: Exception, folder: Path) -> str:
    """Return in one line why a recording is unusable, including unexpected reader failures.

    Raises the error itself if it is not the recording's: `folder` has no room for its copy and its map.
    """
    if isinstance(error, MemoryError):
        return "there is too little memory for it; continue with --resume and fewer --workers"
    if isinstance(error, OSError):
        if error.errno in DISK_FULL:
            raise error
        what = _named(str(error.filename or recording.where), recording, folder)
        return f"{what}: {error.strerror or error}; check that you may read it"
    if isinstance(error, MapFileError) and str(folder) in str(error):
        raise error
    if not isinstance(error, StereovoxError):
        why = one_line(f"it cannot be read ({type(error).__name__}: {error}); is it damaged?")
        return _named(why, recording, folder)
    return _named(str(error), recording, folder).removeprefix(f"{recording.where}: ")


def _named(text: str, recording: Recording, folder: Path) -> str:
    """Return a text with names of copies in `folder` replaced by names in the object store."""
    for copy, where in ((COPY, recording.where), (POSES, recording.poses)):
        if where is not None and is_url(where):
            text = text.replace(str(folder / copy), where.rpartition("/")[0])
    return text


def report_of(place: Place, key: str) -> RecordingReport | None:
    """Return the report of a recording that was already indexed, else None."""
    saved = (place / f"{RECORDINGS}/{key}").find(REPORT, MAX_REPORT)
    try:
        values: dict[str, Any] | None = None if saved is None else {**unsealed(saved), "seconds": 0.0}
        return None if values is None else RecordingReport(**values)
    except (TypeError, ValueError):
        return None  # it is mapped again


def boxes_seen(place: Place, key: str) -> NDArray[np.int32]:
    """Return the boxes seen by a recording's trusted frames: (n, 4) frame number and box index, by number.

    Raises MapFileError if the file is damaged.
    """
    data = (place / f"{RECORDINGS}/{key}").read(SEEN)
    if digest_of(data) != manifest_of(place, key).get("seen"):
        raise _damaged(place, key, f"{SEEN} does not match its digest")
    return np.load(io.BytesIO(data), allow_pickle=False)


def manifest_of(place: Place, key: str) -> dict[str, Any]:
    """Return the manifest of a recording's own map. Raises MapFileError if it is damaged."""
    data = (place / f"{RECORDINGS}/{key}").read(MANIFEST, MAX_MANIFEST)
    try:
        manifest = unsealed(data)
        files_of_frames(manifest["kept_frames"])
    except (KeyError, TypeError, ValueError) as error:
        raise _damaged(place, key, error) from None
    return manifest


@contextmanager
def frames_of(place: Place, key: str, numbers: Sequence[int]) -> Iterator[Iterator[KeptFrame]]:
    """Yield some trusted frames of a recording, ascending; each pack of an object store is fetched once."""
    home, saved = place / f"{RECORDINGS}/{key}", manifest_of(place, key)["kept_frames"]
    if isinstance(home, Folder):
        frames = _kept(place, key, home.path, saved)
        yield (frames[n] for n in numbers)
        return
    with TemporaryDirectory(prefix="stereovox-") as folder:
        (Path(folder) / str(saved["index"])).write_bytes(home.read(str(saved["index"])))
        frames = _kept(place, key, Path(folder), saved)
        yield _fetched(home, Path(folder), saved["packs"], frames, numbers)


def read_frame(place: Place, key: str, frame: KeptFrame) -> Frame | Cloud:
    """Return one of these frames. Raises MapFileError if it is damaged."""
    try:
        return frame.frame()
    except MapFileError as error:
        raise _damaged(place, key, str(error).partition(";")[0]) from None  # the cure is another one


def digest(parts: Any) -> str:
    """Return a digest of plain values, 24 hexadecimal digits."""
    return hashlib.blake2b(json.dumps(parts, sort_keys=True).encode(), digest_size=12).hexdigest()


def _mapped_alone(
    recording: Recording, layout: BoxLayout, folder: Path, notes: list[str]
) -> tuple[Path, list[NDArray[np.int64]]]:
    """Return the folder of a recording's map, which kept its frames, and the boxes (n, 3) that each frame sees."""
    keeping, by_frame = load_config(layout.config, **{"map.keep_frames": True}), list[NDArray[np.int64]]()
    source = local(recording.where, folder / COPY)
    settings: dict[str, Any] = {"profile": keeping, "poses": GIVEN, "checkpoint_s": 0}  # tracked maps have other worlds

    def report(note: str) -> None:
        notes.append(_named(note, recording, folder))

    with MapRun(source, folder / "map", **settings, notify=report) as run:
        run.mapper.map.listeners.append(lambda evidence: by_frame.append(boxes_with(layout, evidence)))
        made = run.finish()
    if recording.poses is None:
        return folder / "map", _by_frame(layout, _all_kept(made.map), by_frame)
    remapped = remap(folder / "map", local(recording.poses, folder / POSES), folder / "remapped")
    return remapped.out, [_around(layout, frame) for frame in _all_kept(remapped.map)]


def _all_kept(voxel_map: VoxelMap) -> Sequence[KeptFrame]:
    kept = voxel_map.kept_frames
    assert kept is not None
    assert kept.are_all(voxel_map.frames)
    return kept.frames


def _by_frame(
    layout: BoxLayout, frames: Sequence[KeptFrame], by_frame: Sequence[NDArray[np.int64]]
) -> list[NDArray[np.int64]]:
    """Return the boxes that each frame sees, as collected by a map's listener: none if there was no evidence.

    If rounding depends on the frame's number, which differs among recordings, the listener's boxes are too few; if
    frames were taken back, they are too many. All boxes around each frame serve then.
    """
    saying = [bool((frame.blocks[1] > frame.blocks[0]).all()) for frame in frames]
    if layout.config.map.cell != "int16" or len(by_frame) != sum(saying):
        return [_around(layout, frame) for frame in frames]
    coming, nothing = iter(by_frame), np.empty((0, 3), np.int64)
    return [next(coming) if says else nothing for says in saying]


def _around(layout: BoxLayout, frame: KeptFrame) -> NDArray[np.int64]:
    """Return all boxes within the bounds of a frame's view: more than it sees."""
    if not (frame.blocks[1] > frame.blocks[0]).all():
        return np.empty((0, 3), np.int64)
    low, high = layout.indices_of(frame.blocks[0]), layout.indices_of(frame.blocks[1] - 1)
    return low + np.column_stack(np.unravel_index(np.arange((high - low + 1).prod()), high - low + 1))


def boxes_with(layout: BoxLayout, evidence: Evidence) -> NDArray[np.int64]:
    """Return the boxes (n, 3) on which a frame has evidence, in ascending order."""
    boxes = layout.indices_of(np.concatenate([evidence.coords, evidence.uniform]))
    if not len(boxes):
        return np.empty((0, 3), np.int64)
    low = boxes.min(axis=0)
    sides = boxes.max(axis=0) - low + 1
    found = np.unique(((boxes[:, 0] - low[0]) * sides[1] + boxes[:, 1] - low[1]) * sides[2] + boxes[:, 2] - low[2])
    return low + np.column_stack(np.unravel_index(found, sides))


def local(where: str, folder: Path) -> str:
    """Return a recording that this machine can open: one in an object store is copied to `folder`."""
    if not is_url(where):
        return where
    place, files = _stored(where)
    if not files:
        raise MapFileError(f"{where}: no such recording in the store; check the name")
    for file in files:
        data = place.read(file)
        target = folder / file
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    return str(folder / where.rstrip("/").rpartition("/")[2])


def _stored(where: str) -> tuple[Bucket, dict[str, list[Any]]]:
    """Return the place above a recording in an object store, and `Bucket.versions` of its files."""
    above, _, name = where.rstrip("/").rpartition("/")
    if above.endswith(":/"):
        raise MapFileError(f"{where}: is a bucket; name a recording in it, {where.rstrip('/')}/NAME")
    place = Bucket(above)
    found = place.versions(f"{name}/")
    return place, found or {file: one for file, one in place.versions(name).items() if file == name}


def _below(folder: str) -> Iterator[str]:
    """Yield all files below a folder, following links, but each folder once: links may lead back up."""
    known: set[str] = set()
    for above, folders, names in os.walk(folder, followlinks=True):
        if (real := os.path.realpath(above)) in known:
            folders.clear()
            continue
        known.add(real)
        folders.sort()
        yield from (os.path.join(above, name) for name in names)


def _kept(place: Place, key: str, folder: Path, saved: Any) -> Sequence[KeptFrame]:
    """Return the trusted frames of a recording whose index is in `folder`."""
    try:
        kept = read_frames(folder, saved, None)
        assert kept is not None
    except (KeyError, TypeError, ValueError, OSError) as error:
        raise _damaged(place, key, error) from None
    return kept.frames


def _fetched(
    home: Place, folder: Path, packs: Sequence[str], frames: Sequence[KeptFrame], numbers: Sequence[int]
) -> Iterator[KeptFrame]:
    here = ""
    for n in numbers:
        pack = packs[n // IN_A_PACK]
        if pack != here:
            if here:
                (folder / here).unlink()
            (folder / pack).write_bytes(home.read(pack))
            here = pack
        yield frames[n]


def _expanded(name: str) -> list[Recording]:
    if name.startswith("@"):
        return _listed(Path(name[1:]))
    if any(letter in name for letter in "*[") and not is_url(name) and not os.path.exists(name):
        found = sorted(glob.glob(name, recursive=True))
        drives = [one for one in found if not _lies_beside(one)]
        if not drives:
            what = "no recording" if found else "nothing"
            raise StereovoxError(f"{name}: {what} has such a name; check the pattern")
        return [Recording(one) for one in drives]
    return [Recording(name)]


def _lies_beside(path: str) -> bool:
    """Return whether a pattern's match is no recording, but a map, or text such as calibrations next to some."""
    begun = os.path.isfile(os.path.join(path, SETTINGS))  # a map that a fleet has not finished yet
    return is_map(path) or begun or (path.lower().endswith(TEXTS) and os.path.isfile(path) and not is_recording(path))


def _real(where: str) -> str:
    """Return the canonical name of a recording: links are followed, options stay."""
    path = file_part(where)
    return where if not os.path.exists(path) else os.path.realpath(path) + where.removeprefix(path)


def _bare(where: str) -> str:
    """Return a name without trailing slashes: results are stored by name."""
    return where if "?" in where else where.rstrip("/") or where


def _listed(file: Path) -> list[Recording]:
    try:
        lines = file.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StereovoxError(f"{file}: the list cannot be read ({error}); write a recording in each line") from None
    found: list[Recording] = []
    for number, line in enumerate(lines, 1):
        try:
            words = shlex.split(line, comments=True)
        except ValueError as error:
            raise StereovoxError(f"{file}:{number}: {error}; close the quotes") from None
        if len(words) > 2:
            raise StereovoxError(f"{file}:{number}: {len(words)} words; give a recording, and the file of its poses")
        if words:
            found.append(Recording(*(_beside(file, word) for word in words)))
    return found


def _beside(file: Path, name: str) -> str:
    """Return a name in a list relative to here: paths in it are relative to the list."""
    return name if is_url(name) or ":" in name.partition("/")[0] else str(file.parent / name)


def fingerprint(where: str) -> list[Any]:
    """Return names, sizes and times of a recording's files (tags in an object store); files may be missing.

    Folders that are links are followed.
    """
    if is_url(where):
        with suppress(NoBucketError):  # reported when the recording is copied
            return list(_stored(where)[1].items())
        return []
    path = file_part(where)
    found: list[list[Any]] = []
    for file in [path] if os.path.isfile(path) else _below(path):
        with suppress(OSError):  # a dangling link
            stat = os.stat(file)
            found.append([os.path.relpath(file, path), stat.st_size, stat.st_mtime_ns])
    return sorted(found)


def _damaged(place: Place, key: str, why: object) -> MapFileError:
    return MapFileError(f"{place}/{RECORDINGS}/{key}: is damaged ({why}); remove it and run again with --resume")
