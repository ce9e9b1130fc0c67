# SPDX-License-Identifier: Apache-2.0
"""The table of outputs: no output is missing, and each cell that claims something is true of the real output."""

import ast
import re
from importlib import import_module
from math import cos, sin
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import stereovox as sv
from stereovox.depth.sphere import T_BODY_OPTICAL
from stereovox.errors import StereovoxError
from stereovox.formats import EXPORTS
from stereovox.frame.stamp_clock import StampClock
from stereovox.live import outputs as live_outputs
from stereovox.live.outputs import GridFile, LiveSphere
from stereovox.maps import State
from stereovox.maps.record import health
from stereovox.mavlink import sectors
from stereovox.mavlink.link import dialect
from stereovox.mavlink.pose_sender import Body
from stereovox.products import projection
from stereovox.products.context import OUTPUTS, context_of
from stereovox.products.projection import project
from stereovox.sources.poses.live_poses import LivePoses

S = 1_000_000_000
CAMERA = sv.PinholeCamera.from_field_of_view(48, 36, 90.0)
DOES = ("uses: ", "refuses: ", "carries along: ", "not meaningful, because ")
SOURCE = Path(sv.__file__).parent
HOMES = ("products.", "formats", "view.", "viewer.", "mavlink.", "descriptions", "ros.")
"""Rooms whose public names are outputs, but for these:"""
NO_OUTPUT = {"DirectionRules", "MavlinkLink", "PoseReceiver", "SectorRules", "import_map", "receive_poses"}


class World:
    """A mapper by a clock of the test that has seen a wall; late_s: how old its frames are."""

    def __init__(self, late_s=0.0, tilt=0.0, frames=8):
        self.ns = 10**15
        more = {"up_direction": (sin(tilt), 0.0, cos(tilt))} if tilt else {}
        more["scan.floor"] = 0.0  # the wall's images show no floor
        self.mapper = sv.Mapper(
            voxel_size=0.2, max_range=4.0, clock=lambda: self.ns, stamp_clock=lambda: self.ns, **more
        )
        self.frames = [self.frame(k, late_s) for k in range(frames)]

    def frame(self, k, late_s):
        self.ns += S // 10
        depth = 2.0 + np.random.default_rng(k).normal(0, 0.005, (36, 48)).astype(np.float32)
        T = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])
        frame = sv.Frame(depth, CAMERA, T, self.ns - round(late_s * S), sensor="front")
        report = self.mapper.add(frame)
        assert not report.refused, report.detail
        return frame, report

    def link(self, heard):
        return SimpleNamespace(
            url="x", messages=dialect(), now_ns=lambda: self.ns, send=lambda m: heard.append(m) or True
        )

    def sender(self, heard):
        sender = sv.ObstacleSender(self.mapper, self.link(heard), rate_hz=None, tell=lambda line: None)
        sender.after(*self.frames[-1])
        return sender


def old_poses_are_not_sent():
    """The second pose comes 3 s late."""
    world, heard = World(frames=1), []
    sender = sv.PoseSender(world.link(heard), message="vision_position_estimate", tell=lambda line: None)
    fresh = sender.pose(world.ns, np.eye(4))
    world.ns += 3 * S
    return fresh and not sender.pose(world.ns - 3 * S + 1, np.eye(4)) and len(heard) == 1


def refused(act):
    try:
        act()
    except StereovoxError:
        return True
    return False


def moved(world, metres):
    T = world.frames[-1][0].T_world_sensor.copy()
    T[0, 3] += metres
    return T


def newest_pose_is_used():
    world, heard = World(), []
    sender = world.sender(heard)
    sender.send()
    world.ns += S // 10
    sender.pose(world.ns, moved(world, 0.6))
    sender.send()
    return heard[0].distances != heard[1].distances


def sphere_of(world, poses=None):
    sphere = LiveSphere(world.mapper.config, {"front": T_BODY_OPTICAL}, None, world.mapper, poses)
    sphere.after(*world.frames[-1])
    return sphere


def sphere_moves():
    world, poses = World(), LivePoses()
    sphere = sphere_of(world, poses)
    before = np.nanmin(sphere.grid()[0].range_m)
    T = np.eye(4)
    T[:3, 3] = 0.6, 0, 1
    poses.add(world.ns + 1, T)
    return np.nanmin(sphere.grid()[0].range_m) < before - 0.3


def grid_file_is_silent(tmp=Path("/tmp")):
    world, said = World(late_s=3.0), []
    file = GridFile(world.mapper, tmp / "context_test.yaml", period_s=0.0, notify=said.append)
    file._write = lambda: said.append("written")
    file.after(*world.frames[-1])
    file.close()
    return len(said) == 1 and "not updated" in said[0]


def page_says_stale():
    from stereovox.viewer.live import LiveView

    view = LiveView.__new__(LiveView)
    view._mapper, view.health = World(late_s=3.0).mapper, SimpleNamespace(content="")
    view._show_health()
    return view.health.content.startswith("**stale")


def node(sent, said):
    logger = SimpleNamespace(error=lambda line, **_: said.append(line), info=lambda *_: None)
    publisher = SimpleNamespace(publish=sent.append, get_subscription_count=lambda: 1)
    now = SimpleNamespace(nanoseconds=0)
    return SimpleNamespace(
        create_publisher=lambda *_: publisher, get_logger=lambda: logger,
        get_clock=lambda: SimpleNamespace(now=lambda: now), get_fully_qualified_name=lambda: "n",
    )  # fmt: skip


def ros_mapping(world):
    grid = project(world.mapper.map)
    return SimpleNamespace(
        config=world.mapper.config,
        health=world.mapper.health,
        grid=lambda last=False: grid,
        snapshot=lambda: None,
    )


def ros_map_is_silent():
    from stereovox.ros.options import Options
    from stereovox.ros.outputs import Outputs

    sent, said = [], []
    outputs = Outputs(node(sent, said), ros_mapping(World(late_s=3.0)), Options(), dict, clock=lambda: 0.5)
    outputs.changed(1, "map")
    outputs.update()
    return not any("OccupancyGrid" in type(one).__name__ for one in sent)


def ros_obstacles_are_silent():
    from stereovox.ros.obstacles import Obstacles
    from stereovox.ros.options import Options

    sent = []
    obstacles = Obstacles(node(sent, []), ros_mapping(World(late_s=3.0)), Options(), clock=lambda: 0.0)
    obstacles.seen(1, "map", np.eye(4))
    obstacles.update()
    return not sent


def diagnostics_say(figure):
    from stereovox.ros.outputs import diagnostics_message

    status = diagnostics_message("n", World(late_s=3.0).mapper.health(), {}, 0).status[0]
    values = {one.key: one.value for one in status.values}
    return status.level == b"\3" if figure == "level" else values["age_s"] == "3.000"


def odometry_is_silent():
    from stereovox.ros.poses.location_topics import MotionPublisher

    sent = []
    publisher = MotionPublisher(node(sent, []), False, lambda stamp_ns: "old")
    publisher.publish(SimpleNamespace(stamp_ns=0))
    return not sent


def unknown_ends_free(sectors_of=lambda m, T: sv.obstacle_sectors(m, T)):
    world = World()
    return np.isfinite(sectors_of(world.mapper.map, world.frames[-1][0].T_world_sensor).unknown_m).any()


def path_is_blocked():
    return sv.check_path(World(frames=1).mapper.map, [[-3, 0, 1], [-2, 0, 1]], 0.1).blocked_at is not None


ROS = pytest.mark.skipif(not __import__("importlib").util.find_spec("rclpy"), reason="rclpy is not installed")
PROBES = {
    ("sv.obstacle_sectors", "frame"): lambda: (
        not np.array_equal(*(sv.obstacle_sectors((w := World()).mapper.map, moved(w, m)).free_m for m in (0.0, 0.6)))
    ),
    ("sv.obstacle_sectors", "up"): lambda: refused(
        lambda: sv.obstacle_sectors((w := World(tilt=0.3)).mapper.map, moved(w, 0))
    ),
    ("sv.obstacle_sectors", "unknown"): unknown_ends_free,
    ("sv.ObstacleSender", "frame"): newest_pose_is_used,
    ("sv.ObstacleSender", "up"): lambda: "tilted" in World(tilt=0.3).sender([]).send(),
    ("sv.ObstacleSender", "age"): lambda: "old" in World(late_s=3.0).sender([]).send(),
    ("sv.ObstacleSender", "health"): lambda: "old" in World(late_s=3.0).sender([]).send(),
    ("sv.ObstacleSender", "unknown"): unknown_ends_free,
    ("sv.PoseSender", "age"): old_poses_are_not_sent,
    ("sv.check_path", "unknown"): path_is_blocked,
    ("sv.LiveView", "health"): page_says_stale,
    ("live.GridFile", "health"): grid_file_is_silent,
    ("live.LiveSphere", "frame"): sphere_moves,
    ("live.LiveSphere", "health"): lambda: refused(sphere_of(World(late_s=3.0)).grid),
    ("grid", "up"): lambda: refused(lambda: project(World(tilt=0.3).mapper.map)),
    ("grid", "unknown"): lambda: bool((project(World().mapper.map).cells == -1).any()),
    ("map topics", "health"): ros_map_is_silent,
    ("obstacle topics", "age"): ros_obstacles_are_silent,
    ("topic /diagnostics", "health"): lambda: diagnostics_say("level"),
    ("topic /diagnostics", "age"): lambda: diagnostics_say("age"),
    ("pose topics", "age"): odometry_is_silent,
}
"""Bad cases: each returns whether the real output does what its cell says."""
GRIDS = {name for name, cells in OUTPUTS.items() if cells.frame.startswith("carries along: origin and axes")}
GROUPS = {
    "map topics": {"topic map_mapping", "topic occupied_cells", "topic octomap_binary", "topic octomap_full"},
    "obstacle topics": {"topic obstacles", "topic free_rays"},
    "pose topics": {"topic tracked_odometry", "topic /tf", "topic amcl_pose", "topic particlecloud"},
    "grid": GRIDS,
}
ELSEWHERE = {
    "floor": "tests/products/test_floor_heights.py and tests/products/test_projection.py",
    ("sv.frontiers", "unknown"): "tests/products/test_frontiers.py",
    ("sv.LevelPlanner", "unknown"): "tests/products/test_level_ways.py",
    ("sv.Waypoints", "unknown"): "tests/products/test_level_ways.py",
    ("sv.ground", "up"): "tests/products/test_ground.py",
    ("obstacle topics", "unknown"): "tests/ros/test_obstacles.py",
}
"""Cells whose bad case is in another file."""


def claims():
    for name, cells in OUTPUTS.items():
        for key, text in cells._asdict().items():
            if text.startswith(("uses", "refuses")):
                yield name, key


def probed(name, key, table):
    names = [name, *(group for group, members in GROUPS.items() if name in members)]
    if any((one, key) in table for one in names):
        return True
    return key == "health" and probed(name, "age", table) and OUTPUTS[name].health == OUTPUTS[name].age


def test_each_cell_says_what_is_done():
    for name, cells in OUTPUTS.items():
        assert all(text.startswith(DOES) for text in cells), name


def test_each_claim_has_its_bad_case():
    missing = [
        (name, key) for name, key in claims() if key not in ELSEWHERE and not probed(name, key, {**PROBES, **ELSEWHERE})
    ]
    assert missing == []


@pytest.mark.parametrize("cell", PROBES, ids=" ".join)
def test_the_outputs_do_what_their_cells_say(cell):
    if "topic" in cell[0]:
        pytest.importorskip("rclpy")
    assert PROBES[cell]()


def missing_outputs(table, topics):
    """Return what leaves a map, as public names, files and `topics`, and is not in the table."""
    public = {f"sv.{name}" for name, home in sv._HOMES.items() if home.startswith(HOMES) and name not in NO_OUTPUT}
    formats = {f"format {ending}" for ending in EXPORTS}
    live = {
        f"live.{name}"
        for name, one in vars(live_outputs).items()
        if isinstance(one, type) and one.__module__ == live_outputs.__name__ and hasattr(one, "after")
    } - {"live.Output", "live._Mark"}  # a mark only measures time
    return sorted((public | formats | live | topics) - set(table))


def topics():
    """Return the topics of all publishers in the ROS room."""
    found = set()
    for path in (SOURCE / "ros").rglob("*.py"):
        tree = ast.parse(path.read_text())
        for call in ast.walk(tree):
            if isinstance(call, ast.Call) and getattr(call.func, "attr", "") == "create_publisher":
                module = import_module(".".join(["stereovox", *path.relative_to(SOURCE).with_suffix("").parts]))
                found |= {f"topic {name}" for name in named(call.args[1], module)}
    return found


def named(node, module):
    if isinstance(node, ast.Constant):
        return {node.value}
    if isinstance(node, ast.IfExp):
        return named(node.body, module) | named(node.orelse, module)
    if node.id == "topic":
        return {"obstacles", "free_rays"}
    return {getattr(module, node.id)}


def test_no_output_is_missing(monkeypatch):
    pytest.importorskip("rclpy")
    published = topics()
    assert missing_outputs(OUTPUTS, published) == []
    for name in OUTPUTS:
        rest = {key: value for key, value in OUTPUTS.items() if key != name}
        assert missing_outputs(rest, published) == [name]
    monkeypatch.setitem(EXPORTS, ".new", "stereovox.formats.points:write_ply")
    monkeypatch.setitem(sv._HOMES, "flood", "products.flood")
    assert missing_outputs(OUTPUTS, published) == ["format .new", "sv.flood"]


def free_states(voxel_map, points, oldest_s):
    return np.full(len(points), State.FREE, np.uint8)


def flat_up(config):
    return np.array([0.0, 0, 1])


MUTATIONS = [
    (("sv.obstacle_sectors", "up"), sectors, "up_of", flat_up),
    (("sv.obstacle_sectors", "unknown"), sectors, "states_of", free_states),
    (("sv.ObstacleSender", "up"), sectors, "up_of", flat_up),
    (("sv.ObstacleSender", "age"), StampClock, "age_ns", lambda *_: 0),
    (("sv.ObstacleSender", "unknown"), sectors, "states_of", free_states),
    (("sv.PoseSender", "age"), StampClock, "age_ns", lambda *_: 0),
    (
        ("sv.ObstacleSender", "frame"),
        Body,
        "take",
        lambda self, pose: None if self._poses else self._poses.append(pose),
    ),
    (("sv.check_path", "unknown"), sv.VoxelMap, "check_capsules", lambda self, a, b, r: np.full(len(a), State.FREE)),
    (("sv.LiveView", "health"), health.HealthMonitor, "_state", lambda *_: "current"),
    (("live.GridFile", "health"), live_outputs, "context_of", lambda mapper: SimpleNamespace(stale="")),
    (("live.LiveSphere", "health"), live_outputs, "context_of", lambda mapper: SimpleNamespace(stale="")),
    (("live.LiveSphere", "frame"), LivePoses, "newest", None),
    (("grid", "up"), projection, "check_level", lambda voxel_map: None),
    (("map topics", "health"), health.HealthMonitor, "_state", lambda *_: "current"),
    (("obstacle topics", "age"), StampClock, "age_ns", lambda *_: 0),
    (("topic /diagnostics", "health"), health.HealthMonitor, "_state", lambda *_: "current"),
    (("topic /diagnostics", "age"), StampClock, "age_ns", lambda *_: 0),
]
"""A cell, and what removes what it claims."""


@pytest.mark.parametrize(("cell", "home", "name", "instead"), MUTATIONS, ids=[" ".join(one[0]) for one in MUTATIONS])
def test_a_behaviour_that_is_removed_is_noticed(cell, home, name, instead, monkeypatch):
    if "topic" in cell[0]:
        pytest.importorskip("rclpy")
    monkeypatch.setattr(home, name, instead)
    if name == "age_ns":
        monkeypatch.setattr(StampClock, "clock_age_ns", lambda *_: 0)
    assert not PROBES[cell]()


def test_a_context_says_what_the_mapper_knows():
    world = World(late_s=3.0)
    context = context_of(world.mapper, "odom")
    assert (context.world, context.up, context.tilt_deg, context.floor) == ("odom", (0.0, 0.0, 1.0), 0.0, None)
    assert (context.age_s, context.stamp_ns) == (pytest.approx(3.0), world.frames[-1][0].stamp_ns)
    assert context.stale.startswith("stale: ")
    assert context_of(World().mapper).stale == ""
    assert context_of(World(frames=1).mapper).stale.startswith("waiting: ")
    assert context_of(World(tilt=0.3, frames=0).mapper).tilt_deg == pytest.approx(np.degrees(0.3))


def test_directions_end_at_the_unknown():
    world = World(frames=1)
    assert len(sectors.nearest_places(world.mapper.map, moved(world, 0.0))) == 40


WORDS = {
    "frame": "frame|world|body|pose",
    "up": "level|tilt|upright",
    "floor": "floor|ground",
    "age": "old|age|stamp",
    "health": "stale|health|lost",
    "unknown": "unknown|known to be free",
}
"""What a docstring that speaks of a property says, one of these words at least."""


@pytest.mark.parametrize("name", [name for name in OUTPUTS if name.startswith(("sv.", "live."))])
def test_docstrings_state_what_is_used_or_refused(name):
    home, _, called = name.partition(".")
    output = getattr(sv if home == "sv" else live_outputs, called)
    parts = [output, *(vars(output).values() if isinstance(output, type) else ())]
    said = " ".join(part.__doc__ or "" for part in parts if hasattr(part, "__doc__")).lower()
    for which, cell in OUTPUTS[name]._asdict().items():
        if cell.startswith(("uses", "refuses")):
            assert re.search(WORDS[which], said), f"{name} says nothing of {which}: {cell}"
