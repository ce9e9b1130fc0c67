# SPDX-License-Identifier: Apache-2.0
"""Removes one cell of the tables of checks (entrance, exit) at a time, in memory: do the tests notice?

    python benchmarks/mutations.py [WORD ...]

Each mutation is one edit that takes away what a cell claims. It is killed if one of the named test files fails.
WORD: only mutations whose cell contains one of the words. In the end, they must pass unchanged.
"""

from __future__ import annotations

import gc
import io
import os
import sys
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from pathlib import Path
from types import CodeType, FunctionType
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parents[1]
ENTRANCE, CONTEXT = "tests/mapping/test_entrance.py", "tests/products/test_context.py"


class Mutation(NamedTuple):
    """cell: row and column. path: below src/stereovox. old: occurs once, becomes new. tests: files, comma-separated."""

    cell: str
    path: str
    old: str
    new: str
    tests: str = ENTRANCE


def entrance() -> list[Mutation]:
    """Cells of `mapping.entrance.CHECKS`."""
    quality, gate, mapper = "depth/quality.py", "mapping/gate.py", "mapper.py"
    prepare, cloud, fields = "depth/prepare.py", "depth/cloud.py", "frame/validate.py"
    return [
        Mutation(
            "bad_units, image", prepare, "        check_unit(frame, _sample_depths(frame), config)", "        pass"
        ),
        Mutation("bad_units, cloud", cloud, "    _check_unit(cloud, points, origins, clear, config)\n", ""),
        Mutation("bad_units, scan", quality, "    check_unit_of_rays(scan, ranges, config)\n", ""),
        Mutation("no_valid_depth, image", prepare, "    if not usable and not (", "    if False and not ("),
        Mutation("no_valid_point, cloud", cloud, "    if not used and not len(clear):", "    if False:"),
        Mutation("no_valid_range, scan", quality, "    if not number:\n", "    if False:\n"),
        Mutation("too_few_values, image", quality, "    if informative < least * pixels:", "    if False:"),
        Mutation(
            "too_few_values, cloud",
            quality,
            '    _check_number(cloud, len(checked.ends), given, "points", config)\n',
            "",
        ),
        Mutation(
            "too_few_values, scan", quality, '    _check_number(scan, number, ranges.size, "beams", config)\n', ""
        ),
        Mutation("no_surfaces, image", quality, "    if even < config", "    if False and even < config"),
        Mutation(
            "no_surfaces, cloud",
            quality,
            "        _check_alike(cloud, partial(_alike_of, checked), config)",
            "        pass",
        ),
        Mutation("no_surfaces, scan", quality, "        _check_alike(scan, lambda _: share, config)", "        pass"),
        Mutation("too_dark, pair", quality, '(dark, "too_dark", "black"), ', ""),
        Mutation("overexposed, pair", quality, ', (bright, "overexposed", "saturated")', ","),
        Mutation("frozen_image, repeated", gate, "before.digest != look.digest", "True"),
        Mutation("frozen_image, new noise", gate, "        if is_frozen(", "        if False and is_frozen("),
        Mutation("pose_jump", gate, "(JUMP if haste > 1 else", "(JUMP if False else"),
        Mutation("clock_reset", gate, "(ahead_ns < 0 or ahead_ns > self._ahead_ns)", "ahead_ns < 0"),
        Mutation("stamp_backwards", gate, "self._trust.ordered and (", "self._trust.ordered and ahead_ns > 0 and ("),
        Mutation("pose_extrapolated", gate, "if off_ns > self._off_ns:", "if False:"),
        Mutation("bad_sensor, 65th", gate, "if len(self._history.trusted) >= MAX_SENSORS:", "if False:"),
        Mutation(
            "memory_full, voxels",
            mapper,
            """                self.map.storage.check_room(evidence)
                self.map.storage.set""",
            "                self.map.storage.set",
        ),
        Mutation(
            "memory_full, grid",
            mapper,
            """                self.map.storage.check_room(evidence)
                cells""",
            "                cells",
        ),
        Mutation(
            "disagrees_with_map, voxels",
            mapper,
            "            passed = self._comparison.check(frame, image, evidence, passed, self.map)\n",
            "",
        ),
        Mutation(
            "disagrees_with_map, grid",
            mapper,
            "            passed = self._comparison.check(frame, scan, evidence, passed, self.map)\n",
            "",
        ),
        Mutation("pose_not_rigid", fields, "    if error > tolerance:", "    if False:"),
        Mutation("pose_not_finite", fields, "    if not all(map(isfinite", "    if False and not all(map(isfinite"),
        Mutation(
            "pose_too_far",
            fields,
            '    if farthest >= MAX_POSITION:\n        raise FrameRefused("pose',
            '    if False:\n        raise FrameRefused("pose',
        ),
        Mutation("mount_not_rigid, scan", fields, "    if error > rigidity:", "    if False:"),
        Mutation("bad_form, masked", fields, "isinstance(getattr(seen, name), np.ma.MaskedArray)", "False"),
        Mutation(
            "bad_scale, image",
            prepare,
            "    if not SMALLEST < float(frame.depth_scale) < 1 / SMALLEST:",
            "    if False:",
        ),
        Mutation("bad_reason, image", prepare, "frame.reason is not None and not _are", "False and not _are"),
    ]


def outputs() -> list[Mutation]:
    """Cells of `products.context.OUTPUTS`."""
    sectors, axes, planner = "mavlink/sectors.py", "products/floor_axes.py", "products/level_ways.py"
    octomap, live, shown = "formats/octomap.py", "live/outputs.py", "ros/outputs.py"
    maps, grids = "tests/products/test_map_operations.py", f"{CONTEXT},tests/products/test_projection.py"
    of_octomap, ways = "tests/formats/test_octomap.py", "tests/products/test_level_ways.py"
    ros, of_frontiers = f"{CONTEXT},tests/ros/test_outputs.py", "tests/products/test_frontiers.py"
    return [
        Mutation(
            "sectors frame",
            sectors,
            "    low, high = _spans(T_world_body[:3, 3],",
            "    low, high = _spans(0 * T_world_body[:3, 3],",
            CONTEXT,
        ),
        Mutation("sectors up", sectors, "> LEVEL_ERROR:", "> 9:", CONTEXT),
        Mutation(
            "sectors unknown", sectors, "unknown = (columns == State.UNKNOWN)", "unknown = (columns == 9)", CONTEXT
        ),
        Mutation(
            "ObstacleSender age of frames",
            "mavlink/sending.py",
            "        if age_s > self._max_age_s:",
            "        if False:",
            "tests/mavlink/test_sending.py,tests/mavlink/test_late.py",
        ),
        Mutation(
            "ObstacleSender age of the pose",
            "mavlink/sending.py",
            "        if pose_age_ns > 1e9",
            "        if False and pose_age_ns > 1e9",
            "tests/mavlink/test_sending.py,tests/mavlink/test_late.py",
        ),
        Mutation(
            "check_path unknown",
            "products/path_check.py",
            "[State.UNKNOWN])",
            "[])",
            f"{CONTEXT},tests/products/test_path_check.py",
        ),
        Mutation(
            "check_path age",
            "products/path_check.py",
            "_oldest(voxel_map, points, radius, now_ns))",
            "_oldest(voxel_map, points, radius, None))",
            "tests/products/test_path_check.py",
        ),
        Mutation(
            "frontiers unknown",
            "products/frontiers.py",
            "states == State.UNKNOWN for",
            "states == State.OCCUPIED for",
            of_frontiers,
        ),
        Mutation(
            "frontiers up",
            "products/frontiers.py",
            "heights_of(centres, voxel_map.config.up)",
            'heights_of(centres, "z")',
            of_frontiers,
        ),
        Mutation(
            "frontiers floor",
            "products/frontiers.py",
            "known_floor(voxel_map, floor).at(centres, reach=np.inf)",
            "0.0",
            of_frontiers,
        ),
        Mutation("LevelPlanner up", planner, 'if voxel_map.config.up != "z":', "if False:", ways),
        Mutation("LevelPlanner unknown", planner, "(states == State.FREE).all", "(states != State.OCCUPIED).all", ways),
        Mutation(
            "DistanceField frame",
            "products/distance.py",
            "np.asarray(self._low * self._cell, float)",
            "np.zeros(3)",
            "tests/products/test_distance.py",
        ),
        Mutation(
            "DistanceField unknown",
            "products/distance.py",
            'state_bits(to, "to")',
            'state_bits((State.OCCUPIED,), "to")',
            "tests/products/test_distance.py",
        ),
        Mutation(
            "ground up",
            axes,
            "    if config.tilt > MAX_TILT:",
            "    if False:",
            f"tests/products/test_ground.py,{grids}",
        ),
        Mutation("coarsen unknown", "products/edit.py", "(number == int(factor) ** 3) |", "(number > 0) |", maps),
        Mutation("coarsen age", "products/edit.py", "    coarse.storage.take_history(voxel_map.storage)\n", "", maps),
        Mutation("crop age", "products/edit.py", "    cropped.storage.take_history(voxel_map.storage)\n", "", maps),
        Mutation(
            "crop up",
            "products/edit.py",
            "VoxelMap(voxel_map.config)",
            'VoxelMap(voxel_map.config.model_copy(update={"up": "z"}))',
            maps,
        ),
        Mutation(
            "difference unknown",
            "products/difference.py",
            "(before == State.FREE) & (after == State.OCC",
            "(before != State.OCCUPIED) & (after == State.OCC",
            maps,
        ),
        Mutation(
            "export solids unknown",
            "formats/points.py",
            "centers = voxel_map.occupied()",
            "centers = voxel_map.centers(voxel_map.cells()[0])",
            "tests/formats/test_export.py",
        ),
        Mutation(
            ".npz up",
            "formats/points.py",
            "voxel_map.config.model_dump()",
            '{**voxel_map.config.model_dump(), "up": "z"}',
            "tests/formats/test_export.py,tests/formats/test_imports.py",
        ),
        Mutation(".bt unknown", octomap, "known = occupied | (state == State.FREE)", "known = state < 9", of_octomap),
        Mutation(
            ".ot frame",
            octomap,
            "np.asarray(indices, np.int64) + KEY_ZERO",
            "np.asarray(indices, np.int64) + 1 + KEY_ZERO",
            of_octomap,
        ),
        Mutation(
            ".bag up",
            "formats/bags.py",
            "T_map_cells[:3, :3] = axes",
            "pass",
            "tests/formats/test_export.py,tests/formats/test_imports.py",
        ),
        Mutation(
            ".yaml frame",
            "formats/map_server.py",
            "Metadata(name, grid.resolution, grid.origin,",
            "Metadata(name, grid.resolution, (0.0, 0.0, 0.0),",
            "tests/formats/test_map_server.py,tests/products/test_projection.py",
        ),
        Mutation(
            "grid unknown",
            "products/projection.py",
            "np.where((patch.marked != EMPTY) & may_show, shown, np.int8(UNKNOWN))",
            "np.where((patch.marked != EMPTY) & may_show, shown, np.int8(0))",
            grids,
        ),
        Mutation(
            "grid floor",
            "products/projection.py",
            "may_show = (shown >= 100 * percent.free_below) | seen_free",
            "may_show = shown >= 0",
            grids,
        ),
        Mutation(
            "GridFile frame",
            "products/projection.py",
            "self._canvas.corner * side",
            "0 * self._canvas.corner * side",
            "tests/products/test_live_projection.py",
        ),
        Mutation("GridFile health", live, "and self._current():", "and True:", CONTEXT),
        Mutation("LiveSphere frame", live, "self._poses.newest", "None", CONTEXT),
        Mutation("LiveSphere health", live, "not self._finished and (why :=", "False and (why :=", CONTEXT),
        Mutation(
            "LiveView health", "viewer/live.py", 'f"**{text}**" if health.state in STALE else text', "text", CONTEXT
        ),
        Mutation("PoseSender age", "mavlink/pose_sender.py", "if age_ns > self._max_age_ns:", "if False:", CONTEXT),
        Mutation(
            "map topics frame",
            shown,
            "    message = Message(header=header(stamp_ns, frame_id))\n",
            '    message = Message(header=header(stamp_ns, "odom"))\n',
            ros,
        ),
        Mutation(
            "map topics age",
            shown,
            "occupancy_message(grid, self._stamp_ns, self._frame_id)",
            "occupancy_message(grid, self._node.get_clock().now().nanoseconds, self._frame_id)",
            ros,
        ),
        Mutation("map topics health", shown, "(self._corrected or self._current())", "True", ros),
        Mutation(
            "cloud topic unknown",
            shown,
            "    centers = voxel_map.occupied()\n",
            "    centers = voxel_map.centers(voxel_map.cells()[0])\n",
            ros,
        ),
        Mutation(
            "obstacle topics age",
            "ros/obstacles.py",
            "        if silent := self._stale():",
            "        if silent := False:",
            CONTEXT,
        ),
        Mutation(
            "obstacle topics unknown, obstacles",
            "ros/obstacles.py",
            "np.nonzero(grid.states == State.OCCUPIED)",
            "np.nonzero(grid.states != State.FREE)",
            "tests/ros/test_obstacles.py",
        ),
        Mutation(
            "obstacle topics unknown, free rays",
            "ros/obstacles.py",
            "    passes = free | ((found == State.UNKNOWN) & (distances <= blind / grid.resolution))",
            "    passes = free | (found == State.UNKNOWN)",
            "tests/ros/test_obstacles.py,tests/ros/test_free_rays.py",
        ),
        Mutation(
            "obstacle topics frame",
            "ros/obstacles.py",
            "points_message(lifted, stamp_ns, world)",
            'points_message(lifted, stamp_ns, "base_link")',
            "tests/ros/test_obstacles.py",
        ),
        Mutation("diagnostics health", shown, "level=LEVELS[health.state]", "level=LEVELS['current']", CONTEXT),
        Mutation(
            "pose topics age",
            "ros/poses/location_topics.py",
            "if old := self._late(moved.stamp_ns):",
            "if old := None:",
            CONTEXT,
        ),
    ]


class Changed:
    """While it is entered, the functions of a module are those of a changed text."""

    def __init__(self, one: Mutation):
        name = f"stereovox.{one.path.removesuffix('.py').replace('/', '.')}".removesuffix(".__init__")
        file = str(import_module(name).__file__)
        text = Path(file).read_text()
        if text.count(one.old) != 1:
            raise SystemExit(f"{one.cell}: {one.path} has its text {text.count(one.old)} times")
        before, after = (dict(_functions(compile(t, file, "exec"))) for t in (text, text.replace(one.old, one.new)))
        self._codes = {name: code for name, code in after.items() if code != before.get(name)}
        gc.unfreeze()  # frozen objects are not listed
        self._found = [
            function
            for function in gc.get_objects()
            if isinstance(function, FunctionType)
            and function.__code__.co_filename == file
            and function.__code__.co_qualname in self._codes
        ]
        if not self._found:
            raise SystemExit(f"{one.cell}: no function changes")

    def __enter__(self) -> None:
        self._before = [function.__code__ for function in self._found]
        for function in self._found:
            function.__code__ = self._codes[function.__code__.co_qualname]

    def __exit__(self, *_: object) -> None:
        for function, code in zip(self._found, self._before, strict=True):
            function.__code__ = code


def _functions(code: CodeType) -> Iterator[tuple[str, CodeType]]:
    for part in code.co_consts:
        if isinstance(part, CodeType):
            yield part.co_qualname, part
            yield from _functions(part)


def failing(tests: str, word: str = "") -> bool:
    """Return whether a test fails; word: only tests whose names contain it."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        status = pytest.main(["-x", "-q", "-p", "no:cacheprovider", "-k", word, *tests.split(",")])
    if status not in (0, 1, 2):
        raise RuntimeError(said.getvalue())
    return status != 0


def main() -> int:
    os.chdir(ROOT)
    chosen = [one for one in (*entrance(), *outputs()) if not sys.argv[1:] or any(w in one.cell for w in sys.argv[1:])]
    survived, words = [], {one: one.cell.partition(",")[0] if one.tests == ENTRANCE else "" for one in chosen}
    for one in chosen:
        with Changed(one):
            killed = failing(one.tests, words[one])
        survived += [] if killed else [one.cell]
        print(f"{'killed' if killed else 'SURVIVED':9} {one.cell}", flush=True)
    for tests, word in sorted({(one.tests, words[one]) for one in chosen}):
        if failing(tests, word):
            print(f"void: {tests} fails on the unchanged source")
    print(f"{len(chosen) - len(survived)} of {len(chosen)} killed; survived: {', '.join(survived) or 'none'}")
    return len(survived)


if __name__ == "__main__":
    sys.exit(main())
