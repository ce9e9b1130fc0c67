# SPDX-License-Identifier: Apache-2.0
"""Whatever happens to a byte of a saved map, it is refused, or the map is the same: cells, settings, history, path."""

import os
import shutil

import numpy as np
import pytest

import stereovox as sv
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps.grid_map import GridMap, load_grid

FLIPS, CUTS = 150, 12
"""Damages of each kind of map: a bit that flips, and a file that is cut off."""


def mapper(**settings):
    made = sv.Mapper(voxel_size=0.2, **{"max_range": 4.0, **settings})
    for frame in sv.open_source("sim:room?image_width=64", frames=":4"):
        made.add(frame)
    made.map.recording = "a walk"
    return made


def in_one_piece(path, seed=0):
    made = mapper(**{"map.keep_frames": True, "map.keep_times": True})
    if seed:
        made.add(next(iter(sv.open_source("sim:room?image_width=64", frames="9:"))))
    made.save(path)


def in_boxes(path, seed=0):
    sv.save_boxed(mapper(max_range=3.0 if seed else 4.0).map, path, 1.6)


def of_a_floor(path, seed=0):
    cells = np.random.default_rng(seed).integers(0, 101, (40, 50)).astype(np.int8)
    made = GridMap.from_occupancy(sv.OccupancyGrid(cells, 0.1), load_config(voxel_size=0.1))
    made.history.frames, made.recording = 7, "floor"
    made.save(path)


KINDS = {"one piece": ("a.svox", in_one_piece), "boxes": ("b.svox", in_boxes), "floor": ("c.npz", of_a_floor)}


def everything(path):
    """All that a map says, to be compared; what is read later is read now."""
    loaded = load_grid(path) if path.suffix == ".npz" else sv.load_map(path)
    parts = loaded.storage.tiles() if path.suffix == ".npz" else loaded.storage.blocks()
    kept = getattr(loaded, "kept_frames", None)
    frames = [] if kept is None else [(frame.packed.content.read(), str(vars_of(frame))) for frame in kept.frames]
    times = loaded.storage.timed() if getattr(loaded.config.map, "keep_times", False) else ()
    return (
        [part.tobytes() for part in parts], [[part.tobytes() for part in slab] for slab in times], frames,
        loaded.config.model_dump(), loaded.history.saved(), str(getattr(loaded.storage, "viewpoint", None)),
        str(getattr(loaded.storage, "window_state", None)), str(getattr(loaded, "origin", None)),
    )  # fmt: skip


def vars_of(frame):
    return [
        frame.number, frame.sensor, frame.name, frame.stamp_ns, frame.T_world_sensor.tolist(), frame.camera,
        frame.quality, frame.pose_sigma, frame.depth_scale, frame.farthest, frame.seen, frame.blocks.tolist(),
    ]  # fmt: skip


def files_of(path):
    if path.is_file():
        return [path]
    return sorted(file for file in path.rglob("*") if file.is_file() and file.stat().st_size)


def outcome(path, truth):
    """Return what a damaged map is: refused, the same, or something else."""
    try:
        return "same" if everything(path) == truth else "another map"
    except StereovoxError as error:
        named = "\n" not in str(error) and path.name.partition(".")[0] in str(error)
        return "refused" if named else f"refused in other words: {error}"


@pytest.fixture(scope="module", params=KINDS)
def saved(request, tmp_path_factory):
    name, save = KINDS[request.param]
    path = tmp_path_factory.mktemp("damage") / name
    save(path)
    return path, save, everything(path)


def test_a_bit_that_flips_or_a_file_that_is_cut_off_is_noticed(saved):
    path, _, truth = saved
    files, random, seen = files_of(path), np.random.default_rng(0), []
    for n in range(FLIPS + CUTS):
        file = files[n % len(files)]
        whole = file.read_bytes()
        at = int(random.integers(len(whole)))
        damaged = bytearray(whole)
        damaged[at] ^= 1 << int(random.integers(8))
        file.write_bytes(bytes(damaged) if n < FLIPS else whole[:at])
        seen.append(outcome(path, truth))
        assert seen[-1] in ("refused", "same"), (file, at)
        file.write_bytes(whole)
    assert seen.count("refused") > FLIPS / 3
    assert outcome(path, truth) == "same"


def test_every_byte_of_what_a_map_says_of_itself_counts(saved):
    """Digits that become other digits are what a parser does not notice."""
    path, _, truth = saved
    if path.is_file():
        pytest.skip("packed: the flips above")
    file = path / "manifest.json"
    whole = file.read_bytes()
    digits = [at for at, byte in enumerate(whole) if byte in b"0123456789"]
    for at in np.random.default_rng(1).choice(digits, 150, replace=False).tolist():
        damaged = bytearray(whole)
        damaged[at] ^= 1
        file.write_bytes(bytes(damaged))
        assert outcome(path, truth) == "refused", (at, whole[at - 40 : at + 10])
    file.write_bytes(whole)


def test_a_file_of_another_save_is_noticed(saved, tmp_path):
    path, save, truth = saved
    other = tmp_path / path.name
    save(other, 1)
    assert everything(other) != truth
    if path.is_file():
        return
    theirs = {_place(file, other): file for file in files_of(other)}
    ours = {_place(file, path): file for file in files_of(path)}
    common = [place for place in ours if place in theirs and "manifest" not in place]
    for place in common:
        whole = ours[place].read_bytes()
        shutil.copy(theirs[place], ours[place])
        assert outcome(path, truth) in ("refused", "same"), place
        ours[place].write_bytes(whole)
    assert outcome(path, truth) == "same"


def _place(file, folder):
    """The path of a file in a map, without what is another name in each save."""
    parts = file.relative_to(folder).parts
    return os.path.join(*(part.partition("-")[0] if "-" in part else part for part in parts))
