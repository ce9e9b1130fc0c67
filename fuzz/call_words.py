# SPDX-License-Identifier: Apache-2.0
"""Random words for the command line: its own options, with valid, nearly valid and arbitrary values."""

from __future__ import annotations

import argparse
import random
from collections.abc import Callable
from functools import cache
from typing import Any

from stereovox.cli import _Parser, command_module, commands

Draw = Callable[[str], str]
WEIGHTS = {"info": 8, "map": 8, "import": 5, "calibrate": 3, "picture": 3, "export": 3}
"""Relative frequency of a command; others have 1."""
SLOW = ("demo", "bench", "reproduce", "ros2", "view")
"""Commands that run long, or until stopped, unless something is wrong: each call gets an invalid word."""
SIMULATIONS = ("sim:nothing", "sim:", "realsense:", "sim:room?noise=x", "sim:room?seed=1&fx=0")
NUMBERS = ("0", "1", "-1", "0.05", "0.5", "3", "nan", "inf", "-inf", "1e308", "1e-320", "1e-9", "x", "",
           "٣", "1_0")  # fmt: skip
LISTS = (
    "0,0,0",
    "1,2,3",
    "0,0,0,1,1,1",
    "1,1,1,0,0,0",
    "nan,0,0",
    "0,0",
    "1e300,0,0",
    "a,b,c",
    "0.5,0.5,90",
    "1,2,3,4",
)
RANGES = (":2", "::2", "1:", "0:0", "5:1", "-2:", "::0", "a:b", "1:2:3:4", "9999999999999999999:",
          "::-1", "7")  # fmt: skip
WORDS = (
    "z",
    "-y",
    "y",
    "up",
    "mm",
    "inch",
    "trinary",
    "andert",
    "ray",
    "line",
    "6x4",
    "640x480",
    "0:1",
    "1:0",
    "/topic",
)
SETTINGS = ("voxel_size=0.1", "voxel_size=nan", "up=-y", "up=w", "sensor.model=andert", "sensor.model=",
            "max_range=-1", "max_range=1e9", "steps=[0.1]", "steps=x", "window.size=[1,2]", "a.b.c=1",
            "=", "x", "map.cell=int8", "map.memory_mb=1", "threads=99999999", "prior=2",
            "up_direction=[0,0,0]", "sensor=1")  # fmt: skip
OPTIONS = ("depth_scale=1000", "depth_scale=0", "depth_scale=x", "depth_scale=inf",
           "depth_scale=1e-300", "fps=15", "fps=nan", "fps=1e300", "poses=poses.txt", "poses=gone",
           "poses=", "poses=../tum/groundtruth.txt", "axes=ros", "poses_scale=0.001", "poses_scale=-1",
           "axes=opengl", "axes=left", "invert=1", "invert=maybe", "camera=camera.toml",
           "camera=floor.yaml", "x=1", "", "=", "&&", "depth_scale", "poses=/dev/zero", "unit=3",
           "topic=/a", "stride=0")  # fmt: skip
PLACES = ("gone", "/dev/null", "/dev/zero", "", ".", "empty/pipe", "/proc/self/mem", "gone/deep/er",
          "~", "x" * 300, "d/" * 600, "http://example.com/a.bag", "-", "-h", "--", "con\nfused",
          "a?b?c")  # fmt: skip
ENDINGS = {"localize": ".tum", "slam": ".yaml", "grid": ".yaml", "ground": ".yaml", "calibrate": ".toml",
           "simulate": ".mcap", "distance": ".npz", "picture": ".png"}  # fmt: skip
"""Ending of a command's output, if it is not a map."""
FITTING = {
    "SOURCE": ("7scenes", "tum", "icl", "sun3d", "rig", "asl", "kitti_raw", "scan.sens", "log.klg", "bench.raw",
               "replica", "open3d", "nerf", "colmap", "tartanair", "stray", "plain", "pair", "rtabmap", "rtabmap.db",
               "ros.bag", "realsense.bag", "kitti_tracking/training", "kitti2015/training"),
    "ROBOT": ("robot.bag", "robot2/robot2.db3", "walk.clf"),
    "FILE": ("cloud.ply", "cloud.pcd", "cloud.bt", "cloud.ot", "points.graph", "floor.yaml", "kalibr.yaml"),
    "MAP": ("map.svox", "map.svox", "out0.svox", "out1.svox", "cloud.svox", "floor.yaml"),
    "PATH": ("map.svox", "floor.yaml", "depth.npy", "poses.txt", "camera.toml", "profile.toml", "kalibr.yaml", "pair"),
}  # fmt: skip
"""Names of valid files by kind of argument."""
SUFFIXES = (".svox", ".ply", ".pcd", ".bt", ".npz", ".png", ".yaml", ".toml", ".bag", ".tum", ".rrd",
            ".glb", ".gz", "")  # fmt: skip


def call(draw: Draw, dice: random.Random) -> list[str]:
    """Return the words of one call."""
    names = list(commands())
    command = dice.choices(names, [WEIGHTS.get(name, 1) for name in names])[0]
    if dice.random() < 0.02:
        return dice.choice(([], ["--json"], ["--version"], [command], [command, "--help"], ["mpa", draw("")]))
    parser = _parser(command)
    words = [command]
    below = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if below:
        kind = dice.choice(sorted(below[0].choices))
        words, parser = [command, kind], below[0].choices[kind]
    for action in parser._actions:
        words += _words_of(command, action, draw, dice)
    if command in SLOW:
        words.append(dice.choice(("--no-such-option", "--voxel-sze=1", "--frames=::0")))
    if dice.random() < 0.05:
        words.insert(dice.randrange(len(words)), dice.choice(("--", "-x", "--json", "--json=3", "--set", "extra")))
    if dice.random() < 0.03:
        del words[dice.randrange(len(words))]
    return words or [command]


@cache
def _parser(command: str) -> argparse.ArgumentParser:
    parser = _Parser(prog=command, add_help=False)
    command_module(command).add_arguments(parser)
    parser.add_argument("--json", action="store_true")
    return parser


def _words_of(command: str, action: Any, draw: Draw, dice: random.Random) -> list[str]:
    """Return an argument with a value, or nothing if omitted."""
    if not action.option_strings:
        many = dice.choice((1, 1, 2)) if action.nargs in ("+", "*", "...") else 1
        return [_value(command, action, draw, dice) for _ in range(many)]
    option = action.option_strings[-1]
    if not (action.required or dice.random() < 0.05) or option in ("--view", "--help") or dice.random() < 0.01:
        return []
    if action.nargs == 0:
        return [option]
    value = _value(command, action, draw, dice)
    return [f"{option}={value}"] if value.startswith("-") or dice.random() < 0.1 else [option, value]


def _value(command: str, action: Any, draw: Draw, dice: random.Random) -> str:
    """Return a value, usually one meant for the argument."""
    what = f"{action.dest} {action.metavar}"
    if action.option_strings and dice.random() < 0.15:
        return dice.choice((*NUMBERS, *LISTS, *RANGES, *WORDS, *PLACES))
    if action.choices and dice.random() < 0.9:
        return str(dice.choice(list(action.choices)))
    if action.type in (int, float):
        return dice.choice(("1", "2", "3", "0.5") if dice.random() < 0.6 else NUMBERS)
    if "frames" in what:
        return dice.choice(RANGES)
    if "KEY=VALUE" in what:
        return dice.choice(SETTINGS)
    if "," in what or "box" in what:
        fitting = [text for text in LISTS if text.count(",") == what.count(",")]
        return dice.choice(fitting if fitting and dice.random() < 0.8 else LISTS)
    if "out" in what.split() or (action.dest == "file" and command in ("export", "distance", "picture", "ground")):
        ending = ENDINGS.get(command, dice.choice(SUFFIXES) if command == "export" else ".svox")
        return f"out{dice.randrange(3)}{dice.choice((*[ending] * 9, *SUFFIXES))}"
    if action.metavar and action.metavar.startswith("FILE."):
        return f"out{dice.randrange(3)}{action.metavar[4:]}"
    if command == "import" and action.dest == "map":
        return f"out{dice.randrange(3)}.svox"
    wanted = {"RECORDING": "SOURCE", "A": "MAP", "B": "MAP", "TRUTH": "MAP"}.get(action.metavar, action.metavar)
    if wanted in FITTING and dice.random() < 0.6:
        return dice.choice(FITTING[wanted])
    if any(
        word in what for word in ("SOURCE", "RECORDING", "PATH", "ROBOT", "FILE", "MAP", "FOLDER", "TRUTH", " A", " B")
    ):
        return _place(draw, dice)
    return dice.choice((*WORDS, *NUMBERS, *LISTS))


def _place(draw: Draw, dice: random.Random) -> str:
    if dice.random() < 0.1:
        return dice.choice((*PLACES, *SIMULATIONS))
    if dice.random() < 0.15:
        return f"map{dice.choice(SUFFIXES)}"
    name = draw("sound" if dice.random() < 0.5 else "")
    return f"{name}?{'&'.join(dice.sample(OPTIONS, dice.choice((1, 1, 2))))}" if dice.random() < 0.2 else name
