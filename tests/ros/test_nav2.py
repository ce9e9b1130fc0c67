# SPDX-License-Identifier: Apache-2.0
"""Nav2's launch file and parameters: whole, and of the topics and options that the node has."""

from __future__ import annotations

import json
import sys
from argparse import ArgumentParser
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import yaml

from stereovox.cli import main
from stereovox.cli.robots.ros2 import add_arguments
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.ros import obstacles, outputs
from stereovox.ros.nav2 import laid_over, overlay, write_nav2
from stereovox.ros.options import PREFIX, Options, with_parameters
from stereovox.ros.poses import location_topics

TOPICS = {
    f"/{name}"
    for name in (
        outputs.MAP, outputs.CLOUD, obstacles.OBSTACLES, obstacles.FREE_RAYS, outputs.MAP_TOPIC,
        location_topics.POSE, location_topics.PARTICLES, location_topics.INITIAL, obstacles.TOPIC, "diagnostics",
    )
}  # fmt: skip
OTHERS = {"/goal_pose", "/clicked_point"}
"""Topics of Nav2 that displays publish."""
THEIRS = {
    "planner_server": {"ros__parameters": {"planner_plugins": ["GridBased"]}},
    "local_costmap": {"local_costmap": {"ros__parameters": {"plugins": ["voxel_layer"], "robot_radius": 0.22}}},
}
OBSTACLE_SOURCE = {
    "topic", "data_type", "sensor_frame", "marking", "clearing", "observation_persistence", "expected_update_rate",
    "min_obstacle_height", "max_obstacle_height", "obstacle_max_range", "obstacle_min_range", "raytrace_max_range",
    "raytrace_min_range", "inf_is_valid",
}  # fmt: skip
"""Parameters that nav2_costmap_2d's obstacle_layer.cpp declares for a source (Humble to main)."""


@pytest.fixture
def written(tmp_path):
    params = tmp_path / "theirs.yaml"
    params.write_text(yaml.safe_dump(THEIRS))
    write_nav2(tmp_path / "nav2", params)
    return tmp_path / "nav2"


def strings(value):
    if isinstance(value, dict):
        return [text for pair in value.items() for one in pair for text in strings(one)]
    if isinstance(value, list):
        return [text for one in value for text in strings(one)]
    return [value] if isinstance(value, str) else []


def test_all_topics_are_the_nodes(written):
    files = [yaml.safe_load((written / name).read_text()) for name in ("nav2_params.yaml", "stereovox.rviz")]
    files.append(json.loads((written / "foxglove.json").read_text()))
    for content in files:
        named = {text.partition(".")[0] for text in strings(content) if text.startswith("/")}
        assert named <= TOPICS | OTHERS
        assert "/map_mapping" in named or "/obstacles" in named


def test_their_parameters_stay_and_ours_lie_over_them(written):
    merged = yaml.safe_load((written / "nav2_params.yaml").read_text())
    local = merged["local_costmap"]["local_costmap"]["ros__parameters"]
    assert merged["planner_server"] == THEIRS["planner_server"]
    assert (local["robot_radius"], local["plugins"]) == (0.22, ["obstacle_layer", "inflation_layer"])
    assert laid_over({"a": {"b": 1, "c": [1]}}, {"a": {"c": [2], "d": 3}, "e": 4}) == {
        "a": {"b": 1, "c": [2], "d": 3},
        "e": 4,
    }


def test_one_source_marks_and_the_other_clears():
    layer = overlay()["local_costmap"]["local_costmap"]["ros__parameters"]["obstacle_layer"]
    sources = [layer[name] for name in layer["observation_sources"].split()]
    assert [(one["topic"], one["marking"], one["clearing"]) for one in sources] == [
        ("/obstacles", True, False),
        ("/free_rays", False, True),
    ]
    given = Options(**options_of(overlay()))
    for one in sources:
        assert set(one) <= OBSTACLE_SOURCE
        assert one["sensor_frame"]  # else rays would begin at the map's origin
        middle = sum(load_config().scan.heights) / 2
        assert one["min_obstacle_height"] < middle < one["max_obstacle_height"]
    assert sources[0]["obstacle_max_range"] >= given.obstacle_range
    assert sources[1]["raytrace_max_range"] >= given.obstacle_range
    monitor = overlay()["collision_monitor"]["ros__parameters"]
    assert monitor["stereovox"]["topic"] == "/obstacles"
    assert monitor["stereovox"]["min_height"] < middle < monitor["stereovox"]["max_height"]
    assert 0 < monitor["source_timeout"] <= 1.0


def test_cells_that_are_not_free_are_lethal_to_the_static_layer():
    told = overlay()["global_costmap"]["global_costmap"]["ros__parameters"]
    assert told["lethal_cost_threshold"] == 30  # free in a message is below; tests/maps/test_grid_map.py
    assert told["static_layer"]["map_topic"] == f"/{outputs.MAP}"
    assert told["static_layer"]["map_subscribe_transient_local"] is True


def options_of(params):
    given = params["stereovox"]["ros__parameters"]
    return {name.removeprefix(PREFIX): value for name, value in given.items() if name.startswith(PREFIX)}


def test_our_parameters_are_parameters_of_the_node():
    given = overlay()["stereovox"]["ros__parameters"]
    with_parameters(Options(), options_of(overlay()))
    load_config(**{name: value for name, value in given.items() if not name.startswith(PREFIX)})


def test_the_launch_file_starts_the_node_with_options_that_it_has(written, monkeypatch):
    for name, members in {
        "ament_index_python": (), "ament_index_python.packages": ("get_package_share_directory",),
        "launch": ("LaunchDescription",), "launch.conditions": ("IfCondition",), "launch_ros": (),
        "launch.actions": ("DeclareLaunchArgument", "ExecuteProcess", "IncludeLaunchDescription", "OpaqueFunction"),
        "launch.launch_description_sources": ("PythonLaunchDescriptionSource",),
        "launch.substitutions": ("LaunchConfiguration",), "launch_ros.actions": ("Node",),
    }.items():  # fmt: skip
        module = ModuleType(name)
        for member in members:
            setattr(module, member, lambda *args, made=member, **more: SimpleNamespace(made=made, args=args, **more))
        monkeypatch.setitem(sys.modules, name, module)
    space = {"__file__": str(written / "nav2.launch.py"), "__name__": "launched"}
    exec(compile((written / "nav2.launch.py").read_text(), "nav2.launch.py", "exec"), space)
    (actions,) = space["generate_launch_description"]().args
    assert [one.args[0] for one in actions if one.made == "DeclareLaunchArgument"] == list(space["ARGUMENTS"])
    given = {**space["ARGUMENTS"], "lidar": "/scan", "poses": "m.yaml", "start": "1,2,3", "out": "x.svox"}
    words = space["mapping_command"](given)
    assert words[:2] == ["stereovox", "ros2"]
    parser = ArgumentParser()
    add_arguments(parser)
    parsed = parser.parse_args(words[2:])
    assert (parsed.poses, parsed.lidar, parsed.depth) == ("m.yaml", "/scan", ["/camera/camera/depth/image_rect_raw"])
    assert parsed.ros_args[:2] == ["--params-file", str(written / "nav2_params.yaml")]
    assert "--lidar" not in space["mapping_command"](space["ARGUMENTS"])


def test_the_command_finds_the_distributions_file_or_says_what_to_give(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    assert main(["ros2", "--write-nav2", str(tmp_path / "a")]) == 2
    assert "--nav2-params" in capsys.readouterr().err
    theirs = tmp_path / "opt/share/nav2_bringup/params/nav2_params.yaml"
    theirs.parent.mkdir(parents=True)
    theirs.write_text(yaml.safe_dump(THEIRS))
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere:{tmp_path / 'opt'}")
    assert main(["ros2", "--write-nav2", str(tmp_path / "a"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert [Path(path).name for path in told["written"]] == [
        "nav2_params.yaml", "nav2.launch.py", "stereovox.rviz", "foxglove.json",
    ]  # fmt: skip
    assert all(Path(path).is_file() for path in told["written"])


@pytest.mark.parametrize(
    ("text", "said"), [("[1, 2]", "holds no parameters"), ("a: [", "is not YAML"), (None, "cannot be read")]
)
def test_files_that_are_no_parameters_are_told(tmp_path, text, said):
    path = tmp_path / "p.yaml"
    if text is not None:
        path.write_text(text)
    with pytest.raises(StereovoxError, match=said):
        write_nav2(tmp_path / "nav2", path)
    assert not (tmp_path / "nav2").exists()
