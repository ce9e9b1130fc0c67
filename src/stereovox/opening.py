# SPDX-License-Identifier: Apache-2.0
"""Open recordings, simulations and live cameras; what a path holds is recognised by its content."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from stereovox import registry
from stereovox.errors import MAX_SHOWN, MAX_WORD_LENGTH, NoPoses, SourceError, shortened
from stereovox.formats import IMPORTS, UNREADABLE
from stereovox.maps.files.lock import LOCK
from stereovox.sources.bags.files import cut_off
from stereovox.sources.base import DepthSource as DepthSource
from stereovox.sources.base import Excerpt as Excerpt
from stereovox.sources.base import Part as Part
from stereovox.sources.base import Selection as Selection
from stereovox.sources.base import Source as Source
from stereovox.sources.base import Stream as Stream
from stereovox.sources.base import kind_of
from stereovox.sources.base import parse_slice as parse_slice
from stereovox.sources.foreign_files import POINTS, cure_of, is_pointer
from stereovox.sources.latest import LatestStream
from stereovox.sources.paced import Paced
from stereovox.sources.rgbd.folder import folder_part
from stereovox.sources.rigs.pair_file import PairSettings
from stereovox.sources.robots.robot import Robot

SOURCES = {
    "pair": "stereovox.sources.rigs.pair:CameraPair",  # first: such a folder may hold groundtruth.txt as well
    "seven_scenes": "stereovox.sources.rgbd.layouts.seven_scenes:SevenScenes",
    "icl_nuim": "stereovox.sources.rgbd.layouts.icl_nuim:IclNuim",  # before tum: it may hold groundtruth.txt as well
    "icl_scene": "stereovox.sources.rgbd.layouts.icl_nuim:IclNuimScene",
    "sun3d": "stereovox.sources.rgbd.layouts.sun3d:Sun3d",
    "tum": "stereovox.sources.rgbd.layouts.tum:TumRgbd",
    "rig": "stereovox.sources.rigs.rig:StereoRig",
    "asl": "stereovox.sources.asl:AslRig",
    "two_view": "stereovox.sources.rigs.two_view:TwoView",
    "velodyne": "stereovox.sources.clouds.velodyne:Velodyne",  # before KITTI's images, which are in the same folders
    "camera_and_velodyne": "stereovox.sources.clouds.velodyne:CameraAndVelodyne",
    "kitti_raw": "stereovox.sources.kitti.raw:KittiRaw",
    "kitti_tracking": "stereovox.sources.kitti.tracking:KittiTracking",
    "kitti_odometry": "stereovox.sources.kitti.odometry:KittiOdometry",
    "kitti_stereo2015": "stereovox.sources.kitti.stereo2015:KittiStereo2015",
    "surround": "stereovox.simulate.surround:Surround",  # before all others of sim:
    "simulation": "stereovox.simulate.simulation:Simulation",
    "rtabmap_db": "stereovox.sources.rgbd.layouts.rtabmap_db:RtabmapDatabase",  # before bags: SQLite files too
    "bag_clouds": "stereovox.sources.clouds.bag:BagClouds",  # before the depth images of the same bag
    "bag": "stereovox.sources.bags.recording:Bag",
    "sens": "stereovox.sources.rgbd.packed:SensFile",
    "klg": "stereovox.sources.rgbd.layouts.klg:KlgLog",
    "slambench": "stereovox.sources.rgbd.packed:SlambenchRaw",
    "replica": "stereovox.sources.rgbd.layouts.replica:Replica",
    "open3d": "stereovox.sources.rgbd.layouts.open3d:Open3DFolder",
    "nerfstudio": "stereovox.sources.rgbd.layouts.nerfstudio:NerfTransforms",
    "rtabmap": "stereovox.sources.rgbd.layouts.rtabmap:RtabmapExport",
    "colmap": "stereovox.sources.rgbd.layouts.colmap:Colmap",
    "tartanair": "stereovox.sources.rgbd.layouts.tartanair:TartanAir",
    "polycam": "stereovox.sources.rgbd.layouts.polycam:Polycam",
    "record3d": "stereovox.sources.rgbd.layouts.record3d:Record3D",
    "stray_scanner": "stereovox.sources.rgbd.layouts.stray_scanner:StrayScanner",
    "clouds": "stereovox.sources.clouds.folder:CloudFolder",
    "plain": "stereovox.sources.rgbd.plain:DepthAndPoses",  # last: nearly any folder with depth images
}
"""Asked in this order, after those of other packages (entry points in the group `stereovox.sources`)."""
STREAMS = {"realsense": "stereovox.sources.realsense.realsense:RealSense"}
"""Live cameras, which cannot be rewound; entry points in the group `stereovox.streams`."""
ROBOTS = {
    "floor": "stereovox.simulate.floors.floor:Floor",
    "carmen": "stereovox.sources.robots.carmen:CarmenLog",
    "bag": "stereovox.sources.robots.bag:RobotBag",
}
"""Recordings of ground robots, asked in this order, after those of other packages (entry points `stereovox.robots`)."""


BAGS = (".db3", ".mcap")
"""Endings of files in a rosbag2 folder."""
AMBIGUOUS = (".txt", ".csv", ".bin")
"""Endings of clouds that may be anything else: poses, a camera."""
MAX_BELOW, MAX_LISTED = 50, 10_000
"""Most folders that are tried, and most entries that are counted, to explain why a folder cannot be opened."""


def open_source(path_or_name: str | os.PathLike[str], frames: str | None = None) -> Source:
    """Open a recorded folder or file, or a simulation (`sim:room`).

    The layout is recognised by content.

    Args:
        path_or_name: Folder, file or name of a simulation; some layouts take options behind a `?`.
        frames: Frames to keep, as a Python slice (`A:B:S`); None for all.

    Returns:
        The frames, which can be counted and read in any order.

    Raises:
        NoPoses: There are images, but no poses.
        SourceError: Nothing there, no known layout, nothing usable in it, or `frames` selects nothing.
    """
    where = os.fspath(path_or_name)
    if frames is not None:
        parse_slice(frames)  # a slip of the pen shows before a long recording is opened
    source = _open(_recognise(where), where)
    return source if frames is None else Selection(source, frames)


def open_stream(path_or_name: str | os.PathLike[str], frames: str | None = None) -> Stream:
    """Open a source as `open_source` does, or start a live camera (`realsense:`).

    A live camera is read by its own thread; frames that are not consumed in time are dropped, oldest first, and counted
    in `dropped`.

    Args:
        path_or_name: As for `open_source`, or the name of a live camera.
        frames: Frames to keep (`A:B:S`); for a live camera it can only count forwards: `:300` is the next 300 consumed.

    Returns:
        The frames in time order.

    Raises:
        SourceError: As for `open_source`.
    """
    where = os.fspath(path_or_name)
    live = _live_class(where)
    if live is None:
        return open_source(where, frames)
    if frames is not None:
        parse_slice(frames)
    camera = LatestStream(live(where))
    return camera if frames is None else Excerpt(camera, frames)


def open_camera(path_or_name: str | os.PathLike[str]) -> Stream:
    """Start a live camera (`realsense:`), or play a recording or simulation at its own pace as if it were one.

    Args:
        path_or_name: As for `open_stream`.

    Returns:
        Its frames as they come, which nothing drops here; those of a recording are stamped by this machine's clock.

    Raises:
        SourceError: As for `open_source`.
    """
    where = os.fspath(path_or_name)
    live = _live_class(where)
    if live is not None:
        return live(where)
    try:
        return Paced(open_source(where))
    except NoPoses:
        images = Paced(open_images(where))
        images.posed = False
        return images


def open_images(path_or_name: str | os.PathLike[str], frames: str | None = None) -> Stream:
    """Open a source as `open_source` does, or a live camera, but without poses if it can do without them.

    Args:
        path_or_name: As for `open_source`, or the name of a live camera (`realsense:`); needs no poses.
        frames: Frames to keep, as a Python slice (`A:B:S`); None for all.

    Returns:
        The frames in time order; poses are NaN, or not to be used.

    Raises:
        SourceError: As for `open_source`.
    """
    where = os.fspath(path_or_name)
    if _live_class(where):
        return open_stream(where, frames)
    kind = next((kind for kind in _classes() if kind.recognises(where)), None)
    if kind is None:
        source = _images_alone(where)
    elif kind.composite:
        source = _open(kind, where)
    else:
        source = kind.depth_only(where)
    return source if frames is None else Selection(source, frames)


def open_depth(folder: Path, settings: PairSettings) -> DepthSource:
    """Return the depth images of a camera pair; poses they may have of their own are ignored.

    A folder with `depth.txt` or `depth/` holds stamped images (see `StampedImages`); anything else is opened by the
    source that recognises it, with its `depth_only(where)`. Raises SourceError if there are no depth images.
    """
    from stereovox.sources.rigs.pair import CorrectedDepth

    source = _depth_of(os.path.join(folder, settings.depth))
    if settings.depth_scale is None and settings.baseline is None:
        return source
    return CorrectedDepth(source, settings)


def open_robot(where: str | os.PathLike[str]) -> Robot:
    """Open the recording of a ground robot: a bag, a CARMEN log (`.clf`, `.clf.bz2`) or `sim:floor`.

    Raises SourceError if there is nothing, nothing known or nothing usable.
    """
    place = os.fspath(where)
    for kind in registry.every("robots", ROBOTS):
        if kind.recognises(place):
            return kind(place)
    if place.startswith("sim:"):
        raise SourceError(f"{place}: no simulation of a ground robot; there is sim:floor")
    if not os.path.exists(place):
        raise SourceError(f"{place}: no such file or folder")
    raise SourceError(f"{place}: no recording of a ground robot; give a bag with scans, a CARMEN log or sim:floor")


def is_robot(path: str | os.PathLike[str]) -> bool:
    """Return whether `open_robot` recognises `path`, by its name or content."""
    return any(kind.recognises(os.fspath(path)) for kind in registry.every("robots", ROBOTS))


def is_recording(path: str | os.PathLike[str]) -> bool:
    """Return whether `open_source` recognises `path`."""
    return any(kind.recognises(os.fspath(path)) for kind in _classes())


def _depth_of(where: str) -> DepthSource:
    """Return the depth images of a recording that is not composite, or images alone."""
    for kind in _classes():
        if not kind.composite and kind.recognises(where):
            return kind.depth_only(where)
    return _images_alone(where)


def _images_alone(where: str) -> DepthSource:
    """Return depth images without poses; raises SourceError if missing."""
    for kind in _image_classes():
        if kind.recognises(where):
            return kind(where, posed=False)
    _recognise(where)  # which says what is wrong with it
    raise SourceError(f"{where}: no depth images; name a folder with depth.txt or depth/, or a recording")


def _image_classes() -> tuple[Any, ...]:
    """Return the classes of depth images without poses."""
    from stereovox.sources.rgbd.layouts.tum import StampedImages
    from stereovox.sources.rgbd.plain import DepthOnly

    return StampedImages, DepthOnly


def _classes() -> Iterator[Any]:
    """Yield the classes of recordings one by one, so that only those needed are imported."""
    return map(kind_of, registry.every("sources", SOURCES))


def _live_class(where: str) -> Any:
    """Return the class of the live camera that `where` names, None if it names none."""
    kinds = map(kind_of, registry.every("streams", STREAMS))
    return next((kind for kind in kinds if kind.recognises(where)), None)


def _open(kind: Any, where: str) -> Any:
    """Return the source of class `kind`; a composite one is handed what opens its parts."""
    return kind(where, open_depth) if kind.composite else kind(where)


def _recognise(where: str) -> Any:
    kinds = []
    if is_pointer(where.partition("?")[0]):
        raise SourceError(f"{shortened(where)}: {POINTS}")
    for kind in _classes():
        kinds.append(kind)
        if kind.recognises(where):
            return kind
    kind = NoPoses if _are_images(where, kinds) else SourceError
    raise kind(f"{shortened(where)}: {_problem(where, kinds)}")


def _are_images(where: str, kinds: list[Any]) -> bool:
    """Return whether `where` is a folder of depth images itself, which lacks nothing but poses."""
    return any(kind.recognises(where) for kind in _image_classes()) and not _inner(folder_part(where), kinds)


def _inner(place: str, kinds: list[Any]) -> str:
    """Name a recording or map that lies in a folder which is none itself, empty if there is none."""
    below = _below(place)
    likely = next((folder for folder in below for kind in kinds if kind.recognises(folder)), None)
    if likely:
        return f"no recording itself; did you mean {likely}?"
    likely = next((folder for folder in below if os.path.isfile(os.path.join(folder, "manifest.json"))), None)
    if likely:
        return f"no recording, but it holds a map (did you mean {likely}?)"
    files = sorted(entry.path for entry in os.scandir(place) if entry.name.endswith(BAGS))
    return f"no recording itself (metadata.yaml is missing); did you mean {files[0]}?" if files else ""


def _problem(where: str, kinds: list[Any]) -> str:
    """Explain in less than 300 characters why `where` cannot be opened, and name the cure."""
    if _live_class(where):
        return "a live camera can be mapped, but has no frames to go back to: record it into a file first"
    place = where if os.path.exists(where) else where.partition("?")[0]
    if not os.path.exists(place):
        return f"no such folder or file{_near(place)}"
    if os.path.isfile(os.path.join(place, "manifest.json")):
        return f"is a map, not a recording; see what it was made of with: stereovox info {shlex.quote(place)}"
    if not os.path.isdir(place):
        if not os.path.isfile(place):  # a pipe or a device, which may never end
            return "is neither a file nor a folder; copy what it gives into a file"
        name = shlex.quote(place) if len(place) <= MAX_SHOWN else "FILE"
        return file_cure(place) or f"is a file, but no recording that is known; see: stereovox info {name}"
    try:
        inner = _inner(place, kinds)
    except OSError as error:
        return f"{error.strerror}, so it cannot be listed"
    return inner or _missing(place, kinds) or f"no recording: {_contents(place)}; layouts: see docs/recordings.md"


def _below(folder: str) -> list[str]:
    """Return folders in a folder, and those in these; raises OSError if it cannot be listed."""
    inside = sorted(entry.path for entry in os.scandir(folder) if entry.is_dir())[:MAX_BELOW]
    deeper = []
    for path in inside:
        with suppress(OSError):
            deeper += sorted(entry.path for entry in os.scandir(path) if entry.is_dir())[:MAX_BELOW]
    return [*inside, *deeper][: 2 * MAX_BELOW]


def file_cure(file: str) -> str:
    """Say what a file is that is no recording, and name the cure, by its ending; empty if that says nothing."""
    ending = os.path.splitext(file)[1].lower()
    if cure_of(file):
        return cure_of(file)
    if ending in registry.names("import", IMPORTS) and ending not in AMBIGUOUS:
        name = shlex.quote(file) if len(file) <= MAX_SHOWN else "FILE"
        return f"is a map or cloud, no recording; import it with: stereovox import {name} map.svox"
    return f"is no recording: {UNREADABLE[ending]}" if ending in UNREADABLE else ""


def _missing(folder: str, kinds: list[Any]) -> str:
    """Say what the nearest layout has in `folder` and what it lacks, with the cure; empty if none is near."""
    best, words = 0.0, ""
    for kind in kinds:
        parts: tuple[Part, ...] = kind.parts
        counts = [part.count(folder) for part in parts]
        share = sum(map(bool, counts)) / max(len(parts), 1)
        near = bool(counts) and counts[0] > 0  # it has the images: poses alone may belong to anything
        if near and best <= share < 1:  # of equals the last, which is the most general
            there = [f"{part.what} ({count})" for part, count in zip(parts, counts, strict=True) if count]
            lacks = next(part for part, count in zip(parts, counts, strict=True) if not count)
            best = share
            words = f"has {', '.join(there)} but no {lacks.what}; {lacks.cure or f'put {lacks.patterns[0]} there'}"
    return words


def _contents(folder: str) -> str:
    """Describe what a folder holds, by suffix."""
    entries = [entry for entry in os.scandir(folder) if not entry.name.startswith(".")][:MAX_LISTED]
    kinds = Counter("folders" if entry.is_dir() else os.path.splitext(entry.name)[1] or "others" for entry in entries)
    found = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common(4))
    return f"it holds {found or 'nothing'}, no depth images, stereo pairs or bag"


def _is_only_begun(path: str) -> bool:
    """Return whether `path` is the folder of a map that somebody begins to write and that holds nothing yet."""
    return os.path.isdir(path) and os.listdir(path) == [LOCK]


def _near(place: str) -> str:
    """Return a hint with the name in the same folder that is nearest to a name that is not there."""
    folder, name = os.path.split(os.path.abspath(place))
    if place and (left := cut_off(place)):
        return f", but a recording that was cut off: {left}"
    try:
        close = get_close_matches(name[:MAX_WORD_LENGTH], os.listdir(folder)) if place else []
        close = [found for found in close if not _is_only_begun(os.path.join(folder, found))]
    except (OSError, ValueError):
        close = []
    return f" (did you mean {os.path.join(os.path.dirname(place), close[0])}?)" if close else "; check the name"
