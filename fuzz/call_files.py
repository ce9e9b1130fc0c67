# SPDX-License-Identifier: Apache-2.0
"""Files and folders for random calls: valid ones of every kind, damaged copies of them, and strange names."""

from __future__ import annotations

import os
import random
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import test_colmap
import test_icl_nuim
import test_klg
import test_nerfstudio
import test_open3d
import test_plain
import test_replica
import test_rtabmap
import test_rtabmap_db
import test_stray_scanner
import test_sun3d
import test_tartanair
from made_asl import asl
from made_bags import realsense_bag, ros_bag
from made_depth import K, matrix_line, posed, sens, slambench_raw, units
from made_kitti import odometry, raw, stereo2015, tracking
from made_pairs import settings as pair_settings
from made_recordings import seven_scenes, tum
from made_rigs import recorded
from made_robot_bags import RobotBagMaker, planar_numbers

from mutate import mutated
from stereovox.config import load_config
from stereovox.formats import EXPORTS, export
from stereovox.formats.map_server import write_map_server
from stereovox.maps import VoxelMap
from stereovox.maps.occupancy import OccupancyGrid
from targets import (
    CAMERA,
    FLASER,
    GRAPHS,
    KALIBR,
    MAP_YAML,
    OPENCV,
    POSES,
    PROFILE,
    ROBOTLASER,
    TWO_VIEW,
)

MAX_CHANGED = 200_000
"""Bytes of the largest file that is damaged."""
COPIES = 40
"""Number of damaged copies of the valid files, each time the files are renewed."""
STRANGE = ("a name with spaces", "what?depth_scale=1&x", "R&D [old] (2)", "naïve-поза-🗺", "-minus",
           "new\nline", "%s{0}", "'quoted' \"twice\"", "x" * 200, "non-utf8-\udcff\udcfe",
           "\x1b[31mred", "a=b,c;d", ".hidden")  # fmt: skip
CONTENTS = (b"", b"\0" * 100, b"\xff" * 3000, b"hello\n", b"{}", b"[]", b"{" * 5000,
            b"\x89PNG\r\n\x1a\n", b"ply\n", b"1 2 3\n" * 50, b"nan nan nan\n" * 9, b"#ROSBAG V2.0\n",
            b"SQLite format 3\0", b"\x89MCAP0\r\n")  # fmt: skip
SUFFIXES = ("", ".txt", ".ply", ".pcd", ".png", ".pgm", ".npy", ".npz", ".bag", ".db3", ".db", ".mcap",
            ".toml", ".yaml", ".json", ".svox", ".bt", ".ot", ".clf", ".log", ".sens", ".klg", ".raw",
            ".las", ".xyz", ".graph", ".exr", ".tiff", ".tum", ".csv", ".obj", ".vdb", ".gz",
            ".log.bz2")  # fmt: skip


class Files:
    """A folder with all files. Valid ones are made once; `renew` restores them and makes new damaged copies."""

    def __init__(self, folder: Path):
        self.folder, self._sound = folder, folder.with_name("sound")
        for name, make in MAKERS.items():
            place = self._sound / name
            place.parent.mkdir(parents=True, exist_ok=True)
            make(place)

    def renew(self, dice: random.Random) -> None:
        """Rebuild the folder with different damage."""
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.copytree(self._sound, self.folder, symlinks=True)
        sound = sorted(os.listdir(self.folder))
        self._recordings = [name for name in sound if (self.folder / name).is_dir()]
        for number in range(COPIES):
            _damaged(self.folder / dice.choice(sound), self.folder / f"bad{number}", dice)
        for number, content in enumerate(CONTENTS):
            (self.folder / f"odd{number}{dice.choice(SUFFIXES)}").write_bytes(content)
        for name in dice.sample(STRANGE, 5):
            _copy(self.folder / dice.choice(sound), self.folder / name)
        for name, target in (("to_room", "open3d"), ("to_itself", "to_itself"), ("to_nothing", "gone"), ("up", "..")):
            (self.folder / name).symlink_to(target)
        (self.folder / "empty").mkdir()
        os.mkfifo(self.folder / "empty/pipe")
        _mixed(*(self.folder / dice.choice(self._recordings) for _ in range(2)), self.folder / "mixed")

    def names(self, dice: random.Random) -> Callable[[str], str]:
        """Return a function that draws a name: of a valid file for kind `sound`, else of anything."""
        names = sorted(os.listdir(self.folder), key=ascii)
        sound = sorted(os.listdir(self._sound))

        def draw(kind: str) -> str:
            name = dice.choice(sound if kind == "sound" else names)
            inner = self.folder / name
            if dice.random() < 0.15 and kind != "sound" and inner.is_dir() and (inside := sorted(os.listdir(inner))):
                name = f"{name}/{dice.choice(inside)}"
            return name

        return draw


def _tum(folder: Path) -> None:
    tum(folder, ["0.100000", "0.200000", "0.300000"], POSES)


def _tartanair(folder: Path) -> None:
    test_tartanair.tartanair(folder)


def _plain(folder: Path) -> None:
    test_plain.images(folder)
    (folder / "poses.txt").write_text("".join(map(matrix_line, posed())))


def _replica(folder: Path) -> None:
    test_replica.replica(folder)
    (folder / "camera-intrinsics.txt").write_text(" ".join(map(str, K)))


def _open3d(folder: Path) -> None:
    test_open3d.folder_of(folder)
    (folder / "trajectory.log").write_text(test_open3d.log_text(posed()))
    (folder / "camera-intrinsics.txt").write_text(" ".join(map(str, K)))


def _colmap(folder: Path) -> None:
    test_colmap.text_model(test_colmap.sensor_depth(folder) / "sparse/0")


def _pair(folder: Path) -> None:
    _tum(folder)
    (folder / "pair.toml").write_text(pair_settings())
    (folder / "tracker.txt").write_text(POSES)


def _raw(path: Path) -> None:
    slambench_raw(path, posed(), (64, 48), K)
    path.with_suffix(".freiburg").write_text(POSES)


def _npy(path: Path) -> None:
    np.save(path, units(np.ones((48, 64)), 1000))


def _robot(path: Path) -> None:
    with RobotBagMaker(path) as bag:
        bag.tf(1_700_000_000_000_000_000, "base_link", "laser", planar_numbers(0, 0, 0), "/tf_static")
        bag.scans(5)
        bag.depth(3)


def _map(path: Path) -> None:
    grid = np.stack(np.meshgrid(np.arange(20), np.arange(15), [0, 7], indexing="ij"), -1).reshape(-1, 3)
    values = np.where(grid[:, 2] > 0, -2.0, 2.0)
    VoxelMap.from_cells(load_config(), grid, values).save(path)


def _exported(path: Path) -> None:
    _map(path.with_suffix(".svox"))
    from stereovox.maps import load_map

    export(load_map(path.with_suffix(".svox")), path)


def _floor(path: Path) -> None:
    cells = np.zeros((20, 30), np.int8)
    cells[3:8, 4:20], cells[0] = 100, -1
    write_map_server(OccupancyGrid(cells, 0.1, np.zeros(3)), path)


def _text(text: str | bytes) -> Callable[[Path], object]:
    return lambda path: path.write_bytes(text.encode() if isinstance(text, str) else text)


MAKERS: dict[str, Callable[[Path], object]] = {
    "7scenes": seven_scenes, "tum": _tum, "icl": test_icl_nuim.icl,
    "sun3d": lambda folder: _made(test_sun3d.sun3d, folder),
    "rig": recorded, "asl": lambda folder: asl(folder), "kitti_raw": lambda folder: raw(folder),
    "kitti_tracking": lambda folder: tracking(folder), "kitti_odometry": lambda folder: odometry(folder),
    "kitti2015": lambda folder: stereo2015(folder), "rtabmap.db": test_rtabmap_db.database,
    "rtabmap": lambda folder: _made(test_rtabmap.exported, folder), "scan.sens": lambda path: sens(path, posed()),
    "log.klg": test_klg.klg, "bench.raw": _raw, "replica": _replica, "open3d": _open3d,
    "nerf": lambda folder: _made(test_nerfstudio.nerf, folder), "colmap": _colmap, "tartanair": _tartanair,
    "stray": lambda folder: _made(test_stray_scanner.stray, folder), "plain": _plain, "pair": _pair,
    "images": test_plain.images, "realsense.bag": realsense_bag, "ros.bag": ros_bag, "robot.bag": _robot,
    "robot2.db3": _robot, "walk.clf": _text(FLASER * 5 + ROBOTLASER), "map.svox": _map, "floor.yaml": _floor,
    "camera.toml": _text(CAMERA), "profile.toml": _text(PROFILE), "kalibr.yaml": _text(KALIBR),
    "opencv.yml": _text(OPENCV), "calib.txt": _text(TWO_VIEW), "other.yaml": _text(MAP_YAML), "poses.txt": _text(POSES),
    "depth.npy": _npy, "points.graph": _text(GRAPHS[0]), "text": _text(CAMERA * 20),
    **{f"cloud{ending}": _exported for ending in EXPORTS if ending in (".bt", ".ot", ".ply", ".pcd", ".npz", ".glb")},
}  # fmt: skip
"""Name -> maker of a valid file or folder."""


def _made(make: Callable[[Path], object], folder: Path) -> None:
    folder.mkdir()
    make(folder)


def _copy(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.copytree(source, target, symlinks=True)
    else:
        shutil.copyfile(source, target)


def _damaged(source: Path, target: Path, dice: random.Random) -> None:
    """Copy a file under another ending, or damaged, or a folder with damaged, missing or renamed files."""
    if source.is_file():
        suffix = dice.choice(SUFFIXES) if dice.random() < 0.3 else source.suffix
        target = target.with_suffix(suffix)
        _copy(source, target)
        if dice.random() < 0.8:
            _change(target, dice)
        return
    _copy(source, target)
    files = sorted(path for path in target.rglob("*") if path.is_file())
    for path in dice.sample(files, min(len(files), dice.choice((1, 1, 2, 5)))):
        what = dice.choice(("change", "change", "change", "remove", "empty", "folder", "swap", "rename", "all"))
        if what == "all":
            for other in path.parent.iterdir():
                if other.is_file() and other.suffix == path.suffix:
                    other.unlink()
        elif not path.is_file():
            continue
        elif what == "change":
            _change(path, dice)
        elif what == "empty":
            path.write_bytes(b"")
        elif what == "swap" and (other := dice.choice(files)).is_file():
            path.write_bytes(other.read_bytes())
        elif what == "rename":
            path.rename(path.with_name(dice.choice(STRANGE) + path.suffix))
        else:
            path.unlink()
            if what == "folder":
                path.mkdir()


def _change(path: Path, dice: random.Random) -> None:
    data = path.read_bytes()[:MAX_CHANGED]
    path.write_bytes(data[: dice.randrange(len(data) + 1)] if dice.random() < 0.3 else mutated(data, dice))


def _mixed(first: Path, second: Path, target: Path) -> None:
    _copy(first, target)
    shutil.copytree(second, target, symlinks=True, dirs_exist_ok=True)
