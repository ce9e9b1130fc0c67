# SPDX-License-Identifier: Apache-2.0
"""The node's options and parameters, right and wrong."""

import builtins
import subprocess
import sys

import pytest
from made_walks import depth_at

from stereovox.cli import main
from stereovox.errors import StereovoxError
from stereovox.maps import load_map
from stereovox.ros.options import Options, split_pair, with_parameters

DEPTH = "/camera/depth/image_rect_raw"


def test_parameters_come_as_ros_has_them():
    given = {
        "depth": ["/a", "/b=/b/info"],
        "cloud": "/c",
        "wait_s": 1,
        "queue": 3,
        "reliable": True,
        "low": 0.1,
        "high": 2,
    }
    options = with_parameters(Options(), given)
    assert (options.depth, options.cloud, options.wait_s, options.queue) == (("/a", "/b=/b/info"), ("/c",), 1.0, 3)
    assert options.heights == (0.1, 2.0)
    assert Options().heights is None
    assert [split_pair(text) for text in options.depth] == [("/a", ""), ("/b", "/b/info")]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"dept": "/a"}, r"'ros\.dept' \(did you mean 'ros\.depth'"),
        ({"queue": "many"}, r"ros\.queue 'many': give a int"),
        ({"queue": 0}, r"ros\.queue 0"),
        ({"wait_s": -1.0}, r"ros\.wait_s"),
        ({"map_rate": 0.0}, r"ros\.map_rate"),
        ({"low": 1.0}, r"ros\.high"),
        ({"lidar_sigma": -1.0}, r"sigma -1"),
        ({"lidar_min": 5.0, "lidar_max": 4.0}, r"ranges from 5 to 4 m"),
        ({"pose": "/vicon/camera"}, r"ros\.pose '/vicon/camera': write TOPIC=FRAME"),
    ],
)
def test_parameters_that_cannot_be_are_told(given, said):
    with pytest.raises(StereovoxError, match=said):
        with_parameters(Options(), given)


def test_something_must_be_mapped():
    with pytest.raises(StereovoxError, match="--depth"):
        Options().check_sources()
    Options(scan=("/scan",)).check_sources()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--depth", DEPTH, "--ros-args", "-p", "voxle_size:=0.1"], "did you mean 'voxel_size'"),
        (["--depth", DEPTH, "--ros-args", "-p", "voxel_size:=-1.0"], "voxel_size -1"),
        (["--depth", DEPTH, "--ros-args", "-p", "sensor.model:=nothing"], "unknown sensor"),
        (["--depth", DEPTH, "--ros-args", "-p", "profile:=nothing"], "unknown profile"),
        (["--ros-args", "-p", "ros.dept:=/a"], "ros.depth"),
        (["--depth", DEPTH, "--ros-args", "--nonsense"], "--ros-args"),
        (["--depth", DEPTH, "--out", "/proc/x/y"], "/proc"),
        ([], "--depth"),
        (["--cloud", "/lidar", "--poses", "track"], "--poses track"),
        (["--depth", DEPTH, "--odometry", "/odom", "--poses", "track"], "--odometry /odom"),
        (["--depth", DEPTH, "--ros-args", "-p", "ros.poses:=trak"], "did you mean"),
        (["--depth", DEPTH, "--corrected-path", "/mapPath"], "add --set map.keep_frames=true"),
        (["--depth", DEPTH, "--correct-jumps", "--set", "dimensions=2"], "needs a 3-D map"),
        (["--depth", DEPTH, "--ros-args", "-p", "ros.correct_jumps:=true"], "add --set map.keep_frames=true"),
        (["--depth", DEPTH, "--poses", "track", "--load", "x.svox"], "cannot be located"),
        (
            ["--lidar", "/scan", "--poses", "slam", "--set", "dimensions=2", "--load", "x.yaml"],
            "cannot be located",
        ),
        (["--depth", DEPTH, "--poses", "slam"], "give --lidar /scan"),
        (["--depth", DEPTH, "--poses", "slm"], "did you mean 'slam'"),
        (["--depth", DEPTH, "--lidar", "/scan"], "--lidar /scan: is for --poses slam or MAP.yaml"),
        (["--lidar", "/scan", "--poses", "slam", "--start", "0,0,0"], "--poses MAP.yaml"),
        (["--lidar", "/scan", "--poses", "no.yaml", "--start", "0,0"], "give X,Y,DEG"),
        (["--lidar", "/scan", "--poses", "/no/such.yaml"], "/no/such.yaml"),
        (["--depth", DEPTH, "--odometry", "/odom", "--reference", "/no/such.yaml"], "/no/such.yaml"),
        (["--depth", DEPTH, "--exclude", "0,0,1,1"], "give --reference MAP.yaml"),
        (["--lidar", "/scan", "--poses", "slam", "--reference", "x.yaml", "--exclude", "0,0,1"], "give X0,Y0,X1,Y1"),
        (["--depth", DEPTH, "--slam-out", "x.yaml"], "add --poses slam"),
        (["--depth", DEPTH, "--set", "ros.cloud_rat=2"], "did you mean 'ros.cloud_rate'"),
        (["--depth", DEPTH, "--set", "ros.cloud_rate=x"], "ros.cloud_rate 'x': give a float"),
    ],
)
def test_mistakes_end_in_one_line(capsys, words, said):
    pytest.importorskip("rclpy", reason="rclpy is not installed: pip install 'stereovox[ros2]'")
    assert main(["ros2", *words]) == 2
    err = capsys.readouterr().err
    assert said in err.splitlines()[-1]
    assert "Traceback" not in err


@pytest.mark.parametrize("when", ["spin_once", "close"])
def test_whatever_breaks_the_map_is_saved(monkeypatch, tmp_path, alone, when):
    from stereovox.ros.node import MapNode

    def ends(node):
        raise KeyboardInterrupt

    def breaks(node):
        node._mapping.add(depth_at(0))
        raise RuntimeError("nobody foresaw this")

    monkeypatch.setenv("ROS_DOMAIN_ID", alone["ROS_DOMAIN_ID"])
    monkeypatch.setattr(MapNode, "spin_once", ends)
    monkeypatch.setattr(MapNode, when, breaks)
    monkeypatch.setattr("stereovox.ros.run.warm_up", lambda *_: None)
    with pytest.raises(RuntimeError, match="foresaw"):
        main(["ros2", "--depth", DEPTH, "--odometry", "/odom", "--out", str(tmp_path / "live.svox")])
    assert load_map(tmp_path / "live.svox").frames == 1


def test_without_ros_the_cure_is_told(monkeypatch, capsys):
    real = builtins.__import__

    def no_ros(name, *args, **kwargs):
        if name.partition(".")[0] == "rclpy":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", no_ros)
    monkeypatch.setattr("stereovox.ros.library.import_module", lambda name: no_ros(name))
    assert main(["ros2", "--depth", DEPTH]) == 2
    assert "stereovox[ros2]" in capsys.readouterr().err


def test_help_needs_no_ros():
    code = "import sys; sys.modules['rclpy'] = None; from stereovox.cli import main; main(['ros2', '--help'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "--depth TOPIC[=INFO]" in done.stdout
