# SPDX-License-Identifier: Apache-2.0
"""Maps as ROS's map_server and nav2_map_server read and write them: a picture, and a .yaml that tells what it means."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereovox.errors import MapFileError, StereovoxError, did_you_mean
from stereovox.files import replacing
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.maps.voxel_map import State
from stereovox.products.floor_axes import Heights
from stereovox.products.inflate import inflated_grid
from stereovox.products.map_image import Picture, read_picture, write_pgm, write_png
from stereovox.products.map_yaml import MODES, Meaning, read_meaning
from stereovox.products.projection import project

OCCUPIED_THRESH, FREE_THRESH = 0.65, 0.196
"""What map_saver writes. With a free_thresh of 0.25, as nav2 has it, its own grey 205, unknown, is read as free."""
FREE_PIXEL, UNKNOWN_PIXEL, OCCUPIED_PIXEL, NO_PIXEL = 254, 205, 0, 128
SCALE_STEPS = 254
"""Greys of mode scale between 0 and 99 per cent: each per cent is read back as it was."""


def read_map_server(path: str | Path) -> OccupancyGrid:
    """Return the map whose .yaml is `path`, or stands beside `path` where that is its picture.

    With p = (255 - brightness) / 255, or brightness / 255 where `negate` is set, cells are, by mode:
    trinary: 100 where p > occupied_thresh, 0 where p < free_thresh, else -1; opacity counts as one more colour.
    scale: the same, but between them 99 (p - free_thresh) / (occupied_thresh - free_thresh) rounded down, and -1
    where the picture lets the background through.
    raw: the brightness, rounded down, where that is 0 to 100, else -1. The map's thresholds are then the file's.
    (map_server 1.17, image_loader.cpp. nav2_map_server scales by 100 and rounds, and negates no raw maps.)
    Raises MapFileError: one line with the file and what is wrong.
    """
    meaning = read_meaning(_yaml_of(Path(path)))
    cells = np.ascontiguousarray(_cells(read_picture(meaning.image), meaning)[::-1])
    if meaning.mode != "raw":
        return OccupancyGrid(cells, meaning.resolution, meaning.origin)
    return OccupancyGrid(cells, meaning.resolution, meaning.origin, meaning.free_thresh, meaning.occupied_thresh)


def write_map_server(grid: OccupancyGrid, path: str | Path, mode: str = "trinary", negate: bool = False) -> None:
    """Write a picture and its .yaml; `path` names either (a .yaml's picture is a .pgm; scaled: a .png).

    Both or none: if the power goes, the .yaml names a picture that belongs to it, for a moment one of another name.

    trinary: free cells 254, occupied ones 0, all others 205, which are unknown. scale: per cent as greys, unknown cells
    are see-through and need a .png. raw: per cent as they are, unknown 255; the thresholds are the map's own. Scaled
    and raw maps are read back as they were. negate: white is occupied.
    Raises MapFileError: one line about an empty map, an unknown mode or ending, or a place that cannot be written.
    """
    yaml, image = _files(Path(path), mode)
    png = image.suffix.lower() == ".png"
    _check(grid, image, mode, negate)
    greys, occupied, free = _greys(grid, mode)
    shown = np.ascontiguousarray(grid.cells[::-1])
    pixels = _through(255 - greys if negate else greys, shown)
    opaque = shown >= 0 if mode == "scale" else None
    spare = image.with_name(f".{image.name}")
    # They take their places from the last to the first: so whenever it ends, a .yaml names a picture of its own.
    with (
        replacing(yaml) as text,
        replacing(image) as picture,
        replacing(yaml) as text_between,
        replacing(spare) as picture_between,
    ):
        for file, name in ((text, image), (text_between, spare)):
            file.write(Meaning(name, grid.resolution, grid.origin, negate, occupied, free, mode).text().encode())
        for file in (picture, picture_between):
            if png:
                write_png(file, pixels, opaque)
            else:
                write_pgm(file, pixels, f"CREATOR: stereovox {grid.resolution:.3f} m/pix")
        for file in (text, picture, text_between):
            file.flush()  # a full disk shows before the first of them is in its place
    spare.unlink(missing_ok=True)


def _cells(picture: Picture, meaning: Meaning) -> NDArray[np.int8]:
    if meaning.mode == "trinary" and picture.with_opacity is not None:
        return _percent(picture.with_opacity, None, meaning)
    if picture.brightness.dtype == np.uint8:
        return _through(_percent(np.arange(256.0), None, meaning), picture.brightness).view(np.int8)
    return _percent(picture.brightness, picture.see_through, meaning)


def _through(table: NDArray[Any], cells: NDArray[Any]) -> NDArray[np.uint8]:
    """Return what a table of 256 bytes makes of each byte: four times as quick as an index."""
    return np.frombuffer(cells.tobytes().translate(table.tobytes()), np.uint8).reshape(cells.shape)


def _percent(brightness: NDArray[Any], see_through: NDArray[np.bool_] | None, meaning: Meaning) -> NDArray[np.int8]:
    brightness = 255 - brightness if meaning.negate else brightness
    if meaning.mode == "raw":
        value = np.floor(brightness)
        return np.where(value <= 100, value, UNKNOWN).astype(np.int8)
    p, between = (255 - brightness) / 255, np.float64(UNKNOWN)
    if meaning.mode == "scale":
        between = np.trunc(99 * ((p - meaning.free_thresh) / (meaning.occupied_thresh - meaning.free_thresh)))
        between = between if see_through is None else np.where(see_through, UNKNOWN, between)
    free = np.where(p < meaning.free_thresh, 0, between)
    return np.where(p > meaning.occupied_thresh, 100, free).astype(np.int8)


def _greys(grid: OccupancyGrid, mode: str) -> tuple[NDArray[np.uint8], float, float]:
    """Return the grey (256,) of each value of a cell read as uint8, and the thresholds: occupied above, free below."""
    percent = np.arange(256, dtype=np.uint8).view(np.int8)
    known = percent >= 0
    if mode == "raw":
        greys = np.where(known & (percent <= 100), percent, 255)
        return greys.astype(np.uint8), grid.occupied_above, grid.free_below
    if mode == "scale":
        dark = np.where(percent < 100, np.ceil(percent.astype(float) * SCALE_STEPS / 99), 255)
        return np.where(known, 255 - dark, NO_PIXEL).astype(np.uint8), SCALE_STEPS / 255, 0.0
    states = OccupancyGrid(percent, 1.0, (0, 0, 0), grid.free_below, grid.occupied_above).states
    greys = np.full(256, UNKNOWN_PIXEL, np.uint8)
    greys[states == State.FREE], greys[states == State.OCCUPIED] = FREE_PIXEL, OCCUPIED_PIXEL
    return greys, OCCUPIED_THRESH, FREE_THRESH


def _check(grid: OccupancyGrid, image: Path, mode: str, negate: bool) -> None:
    if not grid.cells.size:
        raise MapFileError(f"{image}: the map is empty, there is nothing to write")
    if negate and mode == "raw":
        raise MapFileError(f"{image}: map_server negates raw maps and nav2_map_server does not; leave out negate")
    if mode == "scale" and image.suffix.lower() != ".png" and (grid.cells < 0).any():
        raise MapFileError(f"{image}: mode scale has no grey for unknown cells; name a .png")


def _files(path: Path, mode: str) -> tuple[Path, Path]:
    """Return .yaml and picture."""
    if mode not in MODES:
        raise MapFileError(f"{path}: no mode '{mode}'{did_you_mean(mode, MODES)}")
    ending = path.suffix.lower()
    if ending in (".yaml", ".yml"):
        return path, path.with_suffix(".png" if mode == "scale" else ".pgm")
    if ending in (".pgm", ".png"):
        return path.with_suffix(".yaml"), path
    raise MapFileError(f"{path}: the name of a map_server map ends in .yaml, .pgm or .png")


def _yaml_of(path: Path) -> Path:
    if path.suffix.lower() not in (".pgm", ".png", ".bmp"):
        return path
    there = [path.with_suffix(ending) for ending in (".yaml", ".yml") if path.with_suffix(ending).is_file()]
    if not path.is_file():
        raise MapFileError(f"{path}: no such file; give the .yaml of a map_server map")
    if not there:
        raise MapFileError(f"{path}: no {path.stem}.yaml beside it, which tells what its greys mean")
    return there[0]


def write_grid(
    voxel_map: VoxelMap, path: str | Path, heights: Heights | None = None, inflate: float | None = None
) -> None:
    """Write the map seen from above as map_server's two files, a picture and its .yaml; `path` names either.

    heights: see `project`. inflate: radius of a robot in metres by which obstacles grow, with a margin of one cell.
    Raises StereovoxError as `project`, `inflated_grid` and `write_map_server` do.
    """
    try:
        grid = project(voxel_map, heights)
        grid = grid if inflate is None else inflated_grid(grid, inflate)
    except StereovoxError as error:
        raise StereovoxError(f"{path}: {error}") from None
    write_map_server(grid, path)
