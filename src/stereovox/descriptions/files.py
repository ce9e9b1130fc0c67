# SPDX-License-Identifier: Apache-2.0
"""Single files, as `describe` reports them: clouds, maps of other programs, settings, calibrations, poses, images.

The description of a path, and the words, names and command lines in it.
"""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from stereovox.errors import FrameRefused, MissingExtra, SourceError, StereovoxError
from stereovox.files.safe_io import FLOOR_READABLE
from stereovox.sources.rgbd.depth_files import SUFFIXES, depth_size, read_depth
from stereovox.sources.rgbd.depth_unit import unit_words


@dataclass(frozen=True)
class Description:
    """The description of a path.

    Attributes:
        kind: `map`, `floor map`, `recording`, `bag`, `robot`, `cloud`, `settings`, `calibration`, `poses`, `depth
            image` or `picture`.
        lines: Text lines for people.
        facts: The same as numbers and strings, as `stereovox info --json` prints them.
        commands: Command lines that use it, the most likely first.
    """

    kind: str
    lines: list[str]
    facts: dict[str, Any]
    commands: list[str] = field(default_factory=list)


def command_line(*words: object) -> str:
    """Return a stereovox command quoted for a shell."""
    return shlex.join(["stereovox", *map(str, words)])


def size(number_of_bytes: float) -> str:
    """Format a number of bytes: `12.3 MB`."""
    for unit in ("bytes", "kB", "MB"):
        if number_of_bytes < 1000:
            return f"{number_of_bytes:.3g} {unit}"
        number_of_bytes /= 1000
    return f"{number_of_bytes:.3g} GB"


def many(number: int, thing: str) -> str:
    """Format a number of things: `1 pose`, `4,541 poses`."""
    return f"{number:,} {thing}{'' if number == 1 else 's'}"


def thousands(number: Any) -> str:
    """Format an integer with commas: 1,234,567."""
    return f"{number:,}"


def metres(numbers: Any) -> str:
    """Format lengths along axes: `1.9 x 0.6 x 1.0 m`, or `3 x 98 x 6 mm` if all are short."""
    if max(numbers) < 0.1:
        return " x ".join(f"{1000 * number:.0f}" for number in numbers) + " mm"
    return " x ".join(f"{number:.1f}" if number < 10 else f"{number:.0f}" for number in numbers) + " m"


def map_name(source: str, ending: str = ".svox") -> str:
    """Return the default name of a recording's map: `kitchen.svox`, and `room.svox` for `sim:room`."""
    place = source if os.path.exists(source) else source.partition("?")[0]
    kind, colon, rest = place.partition(":")
    if colon and not os.path.exists(place):
        return f"{rest or kind}{ending}"
    name = os.path.basename(os.path.realpath(place))  # tolerates loops of links
    packed = name.lower().endswith((".bz2", ".gz"))
    return f"{Path(Path(name).stem if packed else name).stem or 'map'}{ending}"


def picture_name(path: str) -> str:
    """Return the default name of a map's picture; the image of a floor's map may have the shorter name."""
    place = Path(os.path.realpath(path))
    return f"{place.stem}{'-picture' if place.suffix.lower() in FLOOR_READABLE else ''}.png"


PICTURE_SUFFIXES = (".jpg", ".jpeg", ".bmp", ".webp", ".ppm", ".pgm")
IMAGE_SUFFIXES = (*SUFFIXES, *PICTURE_SUFFIXES)
TEXT_SUFFIXES = (".txt", ".json", ".yaml", ".yml", ".toml", ".ini", ".cfg", ".xml", ".csv", ".log", ".tum", ".freiburg",
                 ".g2o", ".traj", ".conf")  # fmt: skip
LOOSE = (".txt", ".csv", ".bin", ".npz")
"""Endings of clouds and cells that many other files share."""
SEE = "what each may hold: docs/recordings.md, docs/formats.md"
MAX_TEXT = 1 << 24
"""Largest file in bytes that is tried as poses or a calibration."""
USUAL_UNITS = 0.001, 1 / 5000
"""Metres per unit of whole numbers in nearly all depth images."""


def describe_cloud(path: str) -> Description | None:
    """Describe a cloud, mesh or another program's map that can be imported; None for anything else.

    Raises MapFileError for a damaged one.
    """
    from stereovox.formats import CLOUDS

    ending = Path(path).suffix.lower()
    known = {*CLOUDS, ".bt", ".ot", ".graph"} - set(LOOSE)
    return _cloud(path) if os.path.isfile(path) and ending in known else None


def describe_points(path: str) -> Description | None:
    """Describe points or cells in a file whose ending fits many formats; None for anything else."""
    if not os.path.isfile(path) or Path(path).suffix.lower() not in LOOSE:
        return None
    try:
        return _cloud(path)
    except StereovoxError:
        raise SourceError(f"{path}: holds no readable poses, calibration, image or points; {SEE}") from None


def _cloud(path: str) -> Description:
    """Describe the result of importing the file; raises MapFileError."""
    from stereovox.formats import import_map

    out = f"{Path(path).stem}.svox"
    voxel_map = import_map(path)
    counts, bounds = voxel_map.counts(), voxel_map.bounds()
    lines = [f"a file for `stereovox import`, {size(os.path.getsize(path))}", *voxel_map.history.made_of().splitlines()]
    cells = ", ".join(f"{thousands(counts[state])} {state}" for state in ("occupied", "free", "tentative"))
    lines.append(f"it gives cells of {voxel_map.voxel_size:g} m: {cells}")
    if bounds is not None:
        lines.append(f"it covers {metres(bounds[1] - bounds[0])}")
    facts = {"kind": "cloud", "voxel_size": voxel_map.voxel_size, **counts, "imported": voxel_map.history.made_of(),
             "bounds": None if bounds is None else bounds.round(6).tolist()}  # fmt: skip
    return Description("cloud", lines, facts, [command_line("import", path, out)])


def describe_settings(path: str) -> Description | None:
    """Describe a TOML file of stereovox: settings, a camera, a rig or a pair; None for anything else.

    Raises StereovoxError if it has a mistake.
    """
    if Path(path).suffix.lower() != ".toml" or not os.path.isfile(path):
        return None
    from stereovox.files.safe_io import read_table

    table = read_table(Path(path))
    if "pair" in table:
        return _rig(path)
    if {"fx", "width"} & set(table):
        return _camera_toml(path)
    if {"depth", "poses", "T_tracker_camera"} & set(table):
        folder = os.path.dirname(path) or "."
        lines = ["the settings of a camera pair: depth images, and a tracker's poses"]
        return Description(
            "settings", lines, {"kind": "settings", "keys": sorted(table)}, [command_line("info", folder)]
        )
    from stereovox.config import load_config

    config = load_config(Path(path))
    lines = [f"a profile with {len(table)} settings: {', '.join(sorted(table))}"]
    facts = {"kind": "settings", "settings": config.model_dump(mode="json")}
    return Description(
        "settings", lines, facts, [command_line("map", "RECORDING", "--out", "map.svox", "--profile", path)]
    )


def describe_calibration(path: str) -> Description | None:
    """Describe another program's calibration of a camera or stereo pair; None for anything else."""
    if not _is_text(path):
        return None
    from stereovox.sources.calibration.calibration_files import import_rig
    from stereovox.sources.calibration.intrinsics import SeveralCamerasError, read_camera_numbers

    try:
        rig = import_rig([Path(path)])
        pairs = ", ".join(pair.name for pair in rig.pairs)
        lines = [f"a stereo calibration: {pairs}"]
        facts = {"kind": "calibration", "pairs": [pair.name for pair in rig.pairs]}
        return Description(
            "calibration", lines, facts, [command_line("calibrate", "import", path, "--out", "rig.toml")]
        )
    except StereovoxError as error:
        stereo = str(error)
    try:
        numbers = read_camera_numbers(Path(path))
    except SeveralCamerasError:
        raise
    except (StereovoxError, ValueError):
        return None
    if not all(1 < abs(n) < 1e5 for n in numbers.intrinsics[:2]) or Path(path).suffix == ".csv":
        return None
    fx, fy, cx, cy = numbers.intrinsics
    of = "" if numbers.size is None else f" of {numbers.size[0]}x{numbers.size[1]} images"
    lines = [f"the calibration of one camera{of}: fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}"]
    if numbers.depth_scale is not None:
        lines.append(f"its depth images are in {unit_words(numbers.depth_scale)}")
    facts = {"kind": "calibration", "fx": fx, "fy": fy, "cx": cx, "cy": cy, "size": numbers.size,
             "depth_scale": numbers.depth_scale, "stereo": stereo}  # fmt: skip
    return Description(
        "calibration", lines, facts, [command_line("map", f"RECORDING?camera={path}", "--out", "map.svox")]
    )


def describe_poses(path: str) -> Description | None:
    """Describe a file or folder of poses; None for anything else. Raises SourceError without quaternions."""
    from stereovox.sources.poses.poses import Poses
    from stereovox.sources.rgbd.pose_files import UnknownRotationError, read_poses

    if not _is_text(path):
        return None
    try:
        found = read_poses(Path(path))
    except UnknownRotationError:
        raise
    except (SourceError, FrameRefused):
        return None
    if isinstance(found, Poses):
        T, seconds = found.T_world_body, float(found.stamps_ns[-1] - found.stamps_ns[0]) / 1e9
    else:
        T, seconds = np.array([_pose(found, i) for i in range(len(found))]), None
    places = T[np.isfinite(T).all(axis=(1, 2)), :3, 3]
    if not len(places):
        return None
    length = float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())
    when = "one for each image" if seconds is None else f"over {seconds:.1f} s"
    lines = [
        f"{many(len(T), 'pose')}, {when}",
        f"a path of {length:,.0f} m within {metres(np.ptp(places, axis=0))}"
        if length >= 100
        else f"a path of {length:.3g} m within {metres(np.ptp(places, axis=0))}",
        "poses alone make no map: name them with the depth images they belong to",
    ]
    facts = {"kind": "poses", "poses": len(T), "seconds": seconds, "path_m": length,
             "extent_m": np.ptp(places, axis=0).round(4).tolist()}  # fmt: skip
    return Description("poses", lines, facts, [command_line("map", f"IMAGES?poses={path}", "--out", "map.svox")])


def describe_image(path: str) -> Description | None:
    """Describe a depth image or a picture; None for anything else. Raises StereovoxError for a damaged image."""
    if not os.path.isfile(path) or Path(path).suffix.lower() not in IMAGE_SUFFIXES:
        return None
    try:
        width, height = depth_size(Path(path))
        depth = read_depth(Path(path), (width, height))
    except MissingExtra:
        raise
    except FrameRefused as refused:
        if Path(path).suffix.lower() in LOOSE:  # cells or points, see `describe_points`
            return None
        if refused.reason == "bad_dtype" or Path(path).suffix.lower() in PICTURE_SUFFIXES:
            return _picture(path, str(refused))
        raise
    valid = depth[np.isfinite(depth) & (depth > 0)]
    if depth.dtype == np.uint16:
        valid = valid[valid < 65535]
    lines = [
        f"a depth image of {width}x{height}, {depth.dtype}, {100 * (1 - valid.size / depth.size):.0f} % without value"
    ]
    facts: dict[str, Any] = {"kind": "depth image", "width": width, "height": height, "dtype": str(depth.dtype)}
    if valid.size:
        low, middle, high = np.percentile(valid, [5, 50, 95]).tolist()
        facts["values"] = [low, middle, high]
        lines.append(f"90 % of the values are from {low:.6g} to {high:.6g}; half of them are below {middle:.6g}")
        lines.append(_unit_line(middle, depth.dtype == np.uint16))
    lines.append("one image makes no map: put the images into depth/ with a file of poses next to it")
    folder = os.path.dirname(os.path.abspath(path))
    return Description("depth image", lines, facts, [command_line("info", folder)])


def _unit_line(middle: float, whole: bool) -> str:
    """Return a line on the likely unit, judged by the middle value."""
    if not whole and 0.1 < middle < 60:
        return "the unit is likely metres"
    fitting = [
        f"{unit_words(unit)} (then half is below {middle * unit:.2f} m)"
        for unit in USUAL_UNITS
        if 0.2 < middle * unit < 20
    ]
    return f"the unit may be {' or '.join(fitting)}" if fitting else "the unit is not a usual one"


def _picture(path: str, refused: str) -> Description:
    """Describe a picture that was refused as a depth image; raises SourceError if it is not a picture."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            width, height, mode = *image.size, image.mode
    except (UnidentifiedImageError, OSError, ValueError, Image.DecompressionBombError):
        known = Path(path).suffix.lower() in SUFFIXES  # as depth, so that the reason names the contents
        raise SourceError(refused if known else f"{path}: not a readable image; copy it again") from None
    kind = {"L": "8-bit grey", "RGB": "colour", "RGBA": "colour"}.get(mode, mode)
    lines = [
        f"a {kind} picture of {width}x{height}: no depth, so it makes no map by itself",
        "stereovox maps depth images, or pairs of pictures of a calibrated stereo camera, with poses",
    ]
    if mode == "L":
        lines.append(f"if it is the map of a floor, its {Path(path).stem}.yaml is missing next to it")
    folder = os.path.dirname(os.path.abspath(path))
    facts = {"kind": "picture", "width": width, "height": height, "mode": mode}
    return Description("picture", lines, facts, [command_line("info", folder)])


def _rig(path: str) -> Description:
    from stereovox.sources.rigs.rig_file import read_rig

    rig = read_rig(Path(path))
    names = [pair.name for pair in rig.pairs]
    lines = [f"a rig of {len(names)} stereo pairs: {', '.join(names)}; poses in {rig.poses}"]
    return Description(
        "settings", lines, {"kind": "settings", "pairs": names}, [command_line("info", os.path.dirname(path) or ".")]
    )


def _camera_toml(path: str) -> Description:
    from stereovox.sources.calibration.camera_file import describe_correction, read_camera

    camera = read_camera(Path(path))
    numbers = f"fx {camera.fx:g}, fy {camera.fy:g}, cx {camera.cx:g}, cy {camera.cy:g}"
    lines = [
        f"a camera of {camera.width}x{camera.height}: {numbers}",
        f"baseline {'unknown' if camera.baseline is None else f'{camera.baseline:g} m'}, {describe_correction(camera)}",
    ]
    facts = {"kind": "calibration", "fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy,
             "size": [camera.width, camera.height], "baseline": camera.baseline}  # fmt: skip
    return Description(
        "calibration", lines, facts, [command_line("map", "RECORDING", "--out", "map.svox", "--camera", path)]
    )


def _pose(poses: Any, i: int) -> Any:
    try:
        return poses.at(i)
    except FrameRefused:
        return np.full((4, 4), np.nan)


def _is_text(path: str) -> bool:
    """Return whether a file may hold poses or a calibration."""
    try:
        return (
            os.path.isfile(path)
            and Path(path).suffix.lower() in TEXT_SUFFIXES
            and 0 < os.path.getsize(path) <= MAX_TEXT
        )
    except (OSError, ValueError):
        return False
