# SPDX-License-Identifier: Apache-2.0
"""Merge two maps; the result has the frame and the settings of A.

Maps that kept their frames (map.keep_frames) become exactly the map of one run over both. For other maps evidence is
added up, and a note says how the result may differ.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stereovox.cli.maps import Doubts, check_new, open_map, save_new
from stereovox.cli.options import transform_of
from stereovox.cli.terminal import progress_of_steps, say
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_vector

if TYPE_CHECKING:
    from stereovox.maps import VoxelMap

EXAMPLES = """stereovox merge kitchen.svox hall.svox --out both.svox --transform 4.2,0,0,0,0,0.7071,0.7071
stereovox merge kitchen.svox hall.svox --out both.svox --find"""


def add_arguments(parser: ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("a", metavar="A", help="folder of a map")
    parser.add_argument("b", metavar="B", help="folder of another map with cells of the same size")
    parser.add_argument("--out", metavar="OUT", required=True, help="folder of the new map")
    add_transform(parser)
    parser.add_argument(
        "--find", action="store_true",
        help="find the pose of B in A by places that both saw, and correct both (maps that kept their frames)",
    )  # fmt: skip


def add_transform(parser: ArgumentParser) -> None:
    """Declare --transform."""
    parser.add_argument(
        "--transform",
        metavar="T",
        help="pose of B's frame in A's (default: the same frame): tx,ty,tz,qx,qy,qz,qw in metres and a quaternion, or"
        " a file with these or with a 4x4 matrix T_a_b. Write --transform=... if it begins with -",
    )


def run(arguments: Namespace) -> dict[str, Any]:
    """Load both maps and save the merged one."""
    from stereovox.correct.merge_maps import frames_in_both, merge, why_added

    if Path(arguments.a).resolve() == Path(arguments.b).resolve():
        raise StereovoxError(f"{arguments.b}: is also the first map, so its frames would count twice; name another map")
    if arguments.find:
        return _joined(arguments)
    T_a_b = None if arguments.transform is None else transform_of(arguments.transform)
    check_new(arguments.out, arguments.a, arguments.b)
    a, b = open_map(arguments.a), open_map(arguments.b)
    merged, why = merge(a, b, T_a_b), why_added(a, b, T_a_b)
    if why is not None:
        say(
            f"note: evidence is added up, since {why}; cells at their limits may differ from those of one run over both"
        )
    elif (both := frames_in_both(a, b)) > 0:
        say(f"note: {both} frames are in both maps and count once, from their poses in A")
    return {**save_new(merged, arguments.out, _doubts(merged)), "exact": why is None}


def _doubts(merged: VoxelMap) -> Doubts:
    """Return a doubt if most of the frames of both maps are missing from the result."""
    from stereovox.evaluate.metrics import mostly_lost

    return mostly_lost(merged.frames, merged.frames + merged.frames_refused, "frames of both")


def _joined(arguments: Namespace) -> dict[str, Any]:
    """Find the pose of the second map in the first, and save the map of both."""
    from stereovox.correct.merge_maps import join

    if arguments.transform is not None:
        raise StereovoxError("--find: finds the transform; leave --transform out")
    check_new(arguments.out, arguments.a, arguments.b)
    a, b = open_map(arguments.a), open_map(arguments.b)
    with progress_of_steps("searching for loops") as progress:
        done = join(a, b, progress)
    x, y, z = done.T_a_b[:3, 3]
    turn = np.degrees(np.linalg.norm(rotation_vector(done.T_a_b[:3, :3])))
    say(f"B was found in A at {done.found} places; origin at ({x:.2f}, {y:.2f}, {z:.2f}) m, turned by {turn:.0f} deg")
    say(f"{done.loops} loops closed in and between both")
    found = {"exact": True, "T_a_b": done.T_a_b.round(6).tolist(), "loops": done.loops}
    return {**save_new(done.map, arguments.out, _doubts(done.map)), **found}
