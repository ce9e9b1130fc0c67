"""Each check of `mapping.entrance` refuses a bad input of each kind, and does so by the function in the table."""

import ast
import inspect
import re
import textwrap
from pathlib import Path

import numpy as np
import pytest
from entrance_cases import RECIPES, SETTINGS, cases, good, mapper_of
from made_robot_bags import MS, START_NS, RobotBagMaker, planar_numbers

import stereovox as sv
from frames import digest
from stereovox.cli import main
from stereovox.mapping.entrance import CHECKS, ELSEWHERE, KINDS, Check, functions, table
from stereovox.sources.poses.trajectory import write_trajectory

NUMBERS = [sum(one.reason == check.reason for one in CHECKS[:n]) for n, check in enumerate(CHECKS)]
CELLS = [
    pytest.param(check, number, kind, id=f"{check.reason}{number or ''}-{kind}".replace(" ", "_"))
    for check, number in zip(CHECKS, NUMBERS, strict=True)
    for kind in KINDS
    if not isinstance(check.cells.get(kind, ""), str)
]


def complaints(check: Check, number: int, kind: str, monkeypatch) -> list[str]:
    """Offer the bad inputs of a cell; return all deviations."""
    found = []
    for case in cases(check.reason, number, kind):
        with monkeypatch.context() as patch:
            for name, value in case.patch.items():
                patch.setattr(name, value)
            mapper = case.mapper(**SETTINGS) if case.mapper else mapper_of(kind, case.settings)
            for frame in case.before:
                report = mapper.add(frame)
                assert report.refused is None, report.detail
            case.arrange(mapper)
            before = digest(mapper.map)
            report = mapper.add(case.bad)
            wanted = case.reason or check.reason
            if report.refused != wanted:
                found.append(f"{kind}: {report.refused} instead of {wanted}: {report.detail}")
            elif not report.detail.isprintable() or not report.detail:
                found.append(f"{kind}: {wanted} is not explained in one line")
            if report.refused and digest(mapper.map) != before:
                found.append(f"{kind}: {wanted} changed the map")
    return found


def taken_away(function, reason: str):
    """Return the code of a function without what refuses for `reason`, or for a reason that it is given."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(function)))

    class Without(ast.NodeTransformer):
        removed = 0

        def visit_Raise(self, node):
            words = [part.value for part in ast.walk(node) if isinstance(part, ast.Constant)]
            known = [word for word in words[:1] if isinstance(word, str) and word.isidentifier()]
            if known and known[0] != reason and reason != "(its own)":
                return node
            self.removed += 1
            return ast.copy_location(ast.Pass(), node)

    without = Without()
    tree = ast.fix_missing_locations(without.visit(tree))
    tree.body[0].decorator_list = []
    assert without.removed, f"{function.__qualname__} refuses nothing for {reason}"
    names: dict = {}
    exec(compile(tree, function.__code__.co_filename, "exec"), dict(function.__globals__), names)
    return names[function.__name__].__code__


def test_the_table_has_no_hole():
    """And can be printed: pytest -s shows it."""
    print("\n".join(table()))
    for check in CHECKS:
        assert set(check.cells) == set(KINDS), check
        for kind, cell in check.cells.items():
            assert not isinstance(cell, str) or len(cell) > 10, f"{check.reason}, {kind}: no function, no reason why"
    assert set(RECIPES) == {(check.reason, number) for check, number in zip(CHECKS, NUMBERS, strict=True)}


@pytest.mark.parametrize("kind", KINDS)
def test_good_inputs_are_taken(kind):
    mapper = mapper_of(kind, {})
    for n in range(6):
        report = mapper.add(good(kind, n))
        assert report.refused is None, report.detail
    least = ("tentative", 3) if kind.startswith("range") else ("occupied", 20)  # an arc is weak, and these are one look
    assert mapper.map.counts()[least[0]] > least[1]


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
def test_pixels_of_all_reasons_are_taken(integrator):
    depth = good("depth image").depth.copy()
    depth[0, :6] = np.nan, np.inf, -np.inf, 0, -1, 1e30
    assert mapper_of("depth image", {"integrator": integrator}).add(good("depth image", depth=depth)).refused is None


@pytest.mark.parametrize(("check", "number", "kind"), CELLS)
def test_a_bad_input_is_refused(check, number, kind, monkeypatch):
    assert complaints(check, number, kind, monkeypatch) == []


@pytest.mark.parametrize(("check", "number", "kind"), CELLS)
def test_a_check_that_is_taken_away_is_missed(check, number, kind, monkeypatch):
    """So the function in the cell is the one that refuses, and the test above would notice its absence."""
    for function in functions(check.cells[kind]):
        function = inspect.unwrap(function)  # without the lock around it
        monkeypatch.setattr(function, "__code__", taken_away(function, check.reason))
    try:
        found = complaints(check, number, kind, monkeypatch)
    except Exception as error:  # what comes next stumbles over what was let through
        found = [repr(error)]
    assert found


SOURCES = Path(sv.__file__).parent
MAKERS = {
    "evidence", "scan_evidence", "cone_evidence", "crossed_cells", "prepare", "checked", "checked_cloud",
    "checked_scan", "validate_scan", "validate_upright_scan", "check_unit_of_rays", "Mapper", "GridMapper",
}  # fmt: skip
"""What is called by whoever turns measurements into evidence, or into a map."""
INSIDE = ("depth/", "integrate/", "frame/")
"""Rooms of what the entrance calls."""
DOORS = {
    "mapper.py": "the entrance",
    "mapping/deadline.py": "the entrance: prepares frames for `Mapper.add`",
    "runs/recording.py": "recordings of depth images, pairs and clouds, also those that run now: Mapper.add",
    "runs/floor.py": "recordings of robots: GridMapper.add",
    "ros/mapping.py": "ROS 2: Mapper.add and GridMapper.add",
    "correct/remap.py": "a recording again, from corrected poses: Mapper.correct, of frames that were taken",
    "correct/close_loops.py": "loops: Mapper.correct, of frames that were taken",
    "mapping/rebuild.py": "frames that a mapper took, from corrected poses",
    "fleet/plan.py": "recordings of a fleet: Mapper.add in each worker",
    "fleet/boxes.py": "frames that a worker's Mapper took",
    "runs/warm_up.py": "frames that are made here, into maps that are thrown away",
    "localize/slam/pipeline.py": "SLAM: checked_scan",
    "localize/amcl/localise.py": "localisation: validate_scan and check_scan; it makes no map",
    "localize/robot_track.py": "scores a track; makes no map",
    "formats/scan_graph.py": "scans of OctoMap: checked_cloud",
    "formats/rerun.py": "draws frames; makes no map",
    "viewer/frame.py": "a recording on the page: Mapper.add; draws a frame",
    "depth/sphere/vehicle.py": "the sphere round a vehicle: DepthPipeline.checked",
    "live/outputs.py": "the sphere of a live run: DepthPipeline.checked, of images that a mapper took",
    "evaluate/lidar_truth.py": "truth of a recording's lidar: its unit; it makes no map to move by",
    "calibrate/pair.py": "registers images with each other; makes no map",
}
"""All places that make evidence or a map of measurements, and how their input is checked."""


def sources():
    """Return each file's name and text."""
    return {path.relative_to(SOURCES).as_posix(): path.read_text() for path in sorted(SOURCES.rglob("*.py"))}


def doors():
    call = re.compile(rf"(?<!def )(?<!class )(?<!`)\b(?:{'|'.join(sorted(MAKERS))})\(")
    found = {name for name, text in sources().items() if call.search(text)}
    return {name for name in found if not name.startswith(INSIDE) or name in DOORS}


def test_no_door_is_beside_the_entrance():
    """A file that makes evidence or a map must be listed, with how its input is checked; one that does not must not."""
    assert doors() == set(DOORS)


def refusals():
    """Return the reasons of all refusals in the sources, and their places."""
    word = re.compile(r'(?:FrameRefused\(\s*|\bfault=)"([^"]+)"')
    return {(found, name) for name, text in sources().items() for found in word.findall(text)}


def test_every_reason_is_in_the_table():
    known = {check.reason for check in CHECKS} | set(ELSEWHERE)
    assert {(word, place) for word, place in refusals() if word not in known} == set()
    assert len(refusals()) > 80


@pytest.mark.parametrize("where", ["folder", "bag"])
def test_clouds_in_millimetres_are_refused_from_recordings(tmp_path, where, capsys):
    clouds = [good("cloud", n) for n in range(3)]
    if where == "folder":
        for cloud in clouds:
            columns = np.column_stack([1000 * cloud.points, np.zeros(len(cloud.points))])
            columns.astype("<f4").tofile(tmp_path / f"{cloud.stamp_ns / 1e9 + 1:.6f}.bin")
        poses = np.array([cloud.T_world_sensor for cloud in clouds])
        write_trajectory(tmp_path / "poses.txt", [cloud.stamp_ns + 10**9 for cloud in clouds], poses, "lidar")
        recording = str(tmp_path)
    else:
        with RobotBagMaker(tmp_path / "drive.bag") as bag:
            for k in range(50):
                bag.tf(START_NS + 10 * k * MS, "odom", "lidar", planar_numbers(0.001 * k, 0, 0))
            for n, cloud in enumerate(clouds):
                stamp = START_NS + 100 * (n + 1) * MS
                bag.add("/points", "sensor_msgs/PointCloud2", stamp, bag.cloud(stamp, 1000 * cloud.points))
        recording = f"{tmp_path / 'drive.bag'}?cloud=/points"
    source = sv.open_source(recording)
    mapper = sv.Mapper(**SETTINGS)
    assert [mapper.add(cloud).refused for cloud in source] == ["bad_units"] * 3
    assert main(["map", recording, "--out", str(tmp_path / "map"), "--voxel-size", "0.2"]) != 0
    assert "multiply by 0.001" in capsys.readouterr().err


def test_the_tables_of_the_docs_name_the_same_checks_and_settings():
    text = (SOURCES.parents[1] / "docs/safety.md").read_text()
    rows = [
        line.strip("| ").split(" | ")
        for line in text.splitlines()
        if re.match(r"\| `[a-z_]+`[^|]*\|[^|]*\|[^|]*\|$", line)
    ]
    settings = {check.reason: set(check.setting.split(", ")) for check in CHECKS}
    named = {}
    for words, _, setting in rows:
        for word in re.findall(r"`([a-z_]+)`", words):
            if word in settings or word in ELSEWHERE:
                named[word] = set(re.findall(r"`([a-z_.]+)`", setting)) or {""}
    assert len(named) >= 14
    for word, found in named.items():
        if word in settings:
            assert found == settings[word], word
