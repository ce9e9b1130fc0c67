# SPDX-License-Identifier: Apache-2.0
"""A live run sends the vehicle's pose to an autopilot: a pymavlink peer at the other end of a connection.

The clock of the connection is the simulation's, so that nothing depends on how busy the machine is.
"""

import json
import socket
import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.cli import main
from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import covariance_at, inverse, rotation_matrix
from stereovox.live.rig import LiveCamera, mount_of
from stereovox.live.run import LiveRun, map_live
from stereovox.mavlink.link import MavlinkLink, dialect
from stereovox.mavlink.pose_sender import upper_triangle
from stereovox.mavlink.sectors import SectorRules
from stereovox.mavlink.sending import ObstacleSender
from stereovox.opening import open_source
from stereovox.runs.pose_choice import TRACK
from stereovox.sources.base import Stream
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.track.tracker import Tracked

SMALL = {"voxel_size": 0.2, "max_range": 4.0}
BEGIN_NS = 1_000 * 10**9
KINDS = {"odometry": "ODOMETRY", "vision": "VISION_POSITION_ESTIMATE"}
MOUNT = [0.2, -0.1, 0.05, 5, 20, 30]
NOWHERE = np.full((4, 4), np.nan)
WAIT_S = 60


class Peer:
    """A server that keeps all MAVLink messages of its one client, read by pymavlink, until that hangs up."""

    def __init__(self):
        self._server = socket.create_server(("127.0.0.1", 0))
        self.url = f"tcp:127.0.0.1:{self._server.getsockname()[1]}"
        self._read, self._thread = [], threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def messages(self, *kinds):
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()
        return [message for message in self._read if message.get_type() in kinds]

    def _run(self):
        client, _ = self._server.accept()
        parser = dialect().MAVLink(None)
        with client, self._server:
            while data := client.recv(4096):
                self._read += parser.parse_buffer(data) or ()


class Moving(Stream):
    """A simulated camera that moves, with true poses but for some `lost` images, in simulated time.

    The clock is at each image's stamp plus 5 ms, but for `late` images: 0.3 s. step: called with each image before it
    is given.
    """

    def __init__(self, frames=40, lost=(), late=(), posed=True, step=lambda k, frame: None):
        self.source = open_source("sim:room?image_width=96", frames=f":{frames}")
        self.name, self.camera, self.notes, self.posed = "moving", self.source.camera, (), posed
        self.lost, self.late, self.step = lost, late, step
        self.now_ns, self.truth = BEGIN_NS, {}

    def __iter__(self):
        for k, frame in enumerate(self.source):
            frame = replace(frame, stamp_ns=BEGIN_NS + frame.stamp_ns, name=f"moving {k}")
            self.truth[frame.stamp_ns] = frame.T_world_sensor
            if k in self.lost:
                frame = replace(frame, T_world_sensor=NOWHERE, fault="no_pose", fault_detail="the tracker is lost")
            self.step(k, frame)
            self.now_ns = frame.stamp_ns + (300_000_000 if k in self.late else 5_000_000)
            yield frame if self.posed else replace(frame, T_world_sensor=NOWHERE, fault="no_pose")


@pytest.fixture
def peer():
    return Peer()


def expected(T_world_body):
    """Position and rotation in forward, right, down of the world and of the body."""
    flip = np.diag([1.0, -1, -1])
    return flip @ T_world_body[:3, 3], flip @ T_world_body[:3, :3] @ flip


def rotation_of(message):
    if message.get_type() == "ODOMETRY":
        return Rotation.from_quat(np.roll(message.q, -1)).as_matrix()
    angles = zip((message.yaw, message.pitch, message.roll), np.eye(3)[::-1], strict=True)
    yaw, pitch, roll = (rotation_matrix(angle * axis) for angle, axis in angles)
    return yaw @ pitch @ roll


def check_places(messages, truth, T_body_camera):
    for message in messages:
        stamp_ns = min(truth, key=lambda stamp_ns: abs(stamp_ns - 1000 * message.usec_of))
        assert abs(stamp_ns - 1000 * message.usec_of) <= 1000
        position, rotation = expected(truth[stamp_ns] @ inverse(T_body_camera))
        np.testing.assert_allclose([message.x, message.y, message.z], position, atol=1e-6)
        np.testing.assert_allclose(rotation_of(message), rotation, atol=1e-6)


def timed(messages):
    for message in messages:
        message.usec_of = message.time_usec if message.get_type() == "ODOMETRY" else message.usec
    return messages


@pytest.mark.parametrize("word", KINDS)
def test_the_command_sends_poses_at_30_hz_in_the_right_frame_and_none_when_lost_or_late(
    word, peer, tmp_path, capsys, monkeypatch
):
    stream = Moving(frames=60, lost=range(20, 30), late=range(45, 50))
    monkeypatch.setattr("stereovox.live.stream.open_camera", lambda name: stream)
    clocked = partial(MavlinkLink, clock=lambda: stream.now_ns)
    monkeypatch.setattr("stereovox.mavlink.sending.MavlinkLink", clocked)
    words = ["live", "sim:room", "--out", str(tmp_path / "a.svox"), "--json", "--mavlink", peer.url]
    mount = f"--mount={','.join(map(str, MOUNT))}"
    assert main([*words, "--send-pose", word, mount, "--set", "voxel_size=0.2"]) == 0
    live = json.loads(capsys.readouterr().out.splitlines()[-1])["live"]
    sent = timed(peer.messages(KINDS[word]))
    check_places(sent, stream.truth, mount_of(MOUNT))
    held = word == "odometry"  # the first pose after a silence has no velocity
    numbers = [round((message.usec_of * 1000 - BEGIN_NS) * 30 / 1e9) for message in sent]
    assert numbers == [*range(held, 20), *range(30 + held, 45), *range(50 + held, 60)]
    assert [message.reset_counter for message in sent] == [(k >= 30) + (k >= 50) for k in numbers]
    assert (live["poses_sent"], live["pose_resets"]) == (len(sent), 2)


def test_poses_of_a_stream_go_out_at_the_rate_asked_for_with_covariance_and_quality(peer, tmp_path):
    """100 poses a second come; 20 go out. Those that the tracker does not trust end it."""
    poses, covariance = LivePoses("tracker"), np.diag([1.0, 2, 3, 4, 5, 6]) * 1e-4
    link_ns = [BEGIN_NS]

    def step(k, frame):
        for n in range(10 * k, 10 * k + 10):
            link_ns[0] = BEGIN_NS + n * 10_000_000
            T = np.eye(4)
            T[0, 3] = 0.01 * n
            poses.add(link_ns[0], T, n < 200, covariance, 80)

    stream = Moving(frames=30, posed=False, step=step)
    with MavlinkLink(peer.url, clock=lambda: link_ns[0]) as link:
        done = run_of(stream, tmp_path, poses=poses, mavlink=link, send_pose="odometry", pose_rate_hz=20)
    sent = timed(peer.messages("ODOMETRY"))
    assert done.live["poses_sent"] == len(sent) == pytest.approx(40, abs=1)
    assert max(message.usec_of * 1000 for message in sent) < BEGIN_NS + 200 * 10_000_000
    np.testing.assert_allclose([message.vx for message in sent], 1.0, atol=1e-5)
    assert {message.quality for message in sent} == {80}
    np.testing.assert_allclose(sent[0].pose_covariance, upper_triangle(covariance, (0.0, 0.0, 0.0)), rtol=1e-6)


def run_of(stream, tmp_path, mount=None, **options):
    """Run it; images may all be refused, which is an error."""
    camera = LiveCamera(stream, "front", mount_of(mount or 6 * [0]))
    outputs = {name: options.pop(name) for name in ("mavlink", "send_pose", "pose_rate_hz") if name in options}
    with LiveRun(camera, tmp_path / "a.svox", wait_s=0.0, **options, **SMALL) as run:
        run.add_outputs(**outputs)
        run.mapper.map.history.frames = 1  # it is the poses that are wanted
        return run.finish()


def test_tracked_poses_have_the_covariance_of_the_body_and_the_share_that_fits(peer, tmp_path, monkeypatch):
    """The camera is on an arm of the body: what is not known of its turn, the body's place is not known by."""
    added, errors = threading.Event(), np.diag([0.01, 0.02, 0.03, 0.001, 0.002, 0.003]) ** 2

    class Known:
        imu_use = ""

        def __init__(self, config, camera):
            pass

        def expect(self, frame):
            pass

        def add(self, frame):
            if 8 <= int(frame.name.split()[1]) < 12:
                return Tracked(stream.truth[frame.stamp_ns], np.full((6, 6), np.inf), "it is dark")
            return Tracked(stream.truth[frame.stamp_ns], errors, inlier_share=0.876)

    def step(k, frame):
        if k > 0:  # the one before is tracked
            assert added.wait(WAIT_S)
            added.clear()

    stream = Moving(frames=24, posed=False, step=step)
    monkeypatch.setattr("stereovox.live.stream._LateTracker", Known)
    camera = LiveCamera(stream, "front", mount_of(MOUNT))
    with (
        MavlinkLink(peer.url, clock=lambda: stream.now_ns) as link,
        LiveRun(camera, tmp_path / "a.svox", poses=TRACK, **SMALL) as run,
    ):
        run.add_outputs(mavlink=link, send_pose="vision")
        run.stream.poses.listen(added.set)
        run.finish()
    sent = timed(peer.messages("VISION_POSITION_ESTIMATE"))
    check_places(sent, stream.truth, camera.T_body_camera)
    assert [message.reset_counter for message in sent] == 8 * [0] + 12 * [1]
    stamp_ns = min(stream.truth, key=lambda stamp_ns: abs(stamp_ns - 1000 * sent[3].usec))
    T_world_camera = stream.truth[stamp_ns]
    lever = (T_world_camera @ inverse(camera.T_body_camera))[:3, 3] - T_world_camera[:3, 3]
    angles = sent[3].roll, sent[3].pitch, sent[3].yaw
    of_body = upper_triangle(covariance_at(errors, lever), angles)
    np.testing.assert_allclose(sent[3].covariance, of_body, rtol=1e-4, atol=1e-12)
    assert not np.allclose(sent[3].covariance, upper_triangle(errors, angles), rtol=0.1)


def test_the_pose_is_level_whatever_axis_of_the_map_is_up(peer, tmp_path):
    """In a world whose y points down, 2 m up is 2 m up."""
    stream = Moving(frames=3)
    T_other_world = np.eye(4)
    T_other_world[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # z up to y down
    stream.step = lambda k, frame: object.__setattr__(frame, "T_world_sensor", T_other_world @ frame.T_world_sensor)
    with MavlinkLink(peer.url, clock=lambda: stream.now_ns) as link:
        camera = LiveCamera(stream, "front", mount_of(MOUNT))
        map_live(camera, tmp_path / "a.svox", mavlink=link, send_pose="vision", up="-y", **SMALL)
    sent = timed(peer.messages("VISION_POSITION_ESTIMATE"))
    assert len(sent) == 3
    check_places(sent, stream.truth, mount_of(MOUNT))


def test_the_rules_of_obstacle_distances_are_options_of_the_command(tmp_path, monkeypatch, peer):
    made = []

    class Noting(ObstacleSender):
        def __init__(self, *words, rules, **options):
            made.append(rules)
            super().__init__(*words, rules=rules, **options)

    monkeypatch.setattr("stereovox.live.autopilot.ObstacleSender", Noting)
    words = ["live", "sim:room?frames=3&image_width=96", "--out", str(tmp_path / "a.svox"), "--mavlink", peer.url]
    rules = ["--half-height", "0.5", "--own-radius", "0.75", "--max-distance", "8", "--unknown", "unmeasured"]
    assert main([*words, *rules, "--set", "voxel_size=0.2"]) == 0
    assert made == [SectorRules(max_distance=8, half_height=0.5, own_radius=0.75, unknown="unmeasured")]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--send-pose"], "--send-pose: there is no autopilot; give --mavlink URL"),
        (["--half-height", "0.5"], "--half-height: there is no autopilot; give --mavlink URL"),
        (["--mavlink", "udpout:127.0.0.1:9", "--own-radius", "9"], "own_radius 9: give a number from 0 to 5"),
        (["--mavlink", "udpout:127.0.0.1:9", "--send-pose", "--pose-rate", "0"], "rate_hz 0: give 1 to 200"),
        (
            ["--mavlink", "udpin:127.0.0.1:0", "--poses", "mavlink:udpin:127.0.0.1:0", "--send-pose"],
            "send_pose: the poses are an autopilot's own",
        ),
    ],
)
def test_mistakes_are_told_in_one_line(words, said, tmp_path, capsys):
    assert main(["live", "sim:room?image_width=96", "--out", str(tmp_path / "a.svox"), *words]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]


def test_options_without_an_autopilot_are_refused_in_python(tmp_path):
    with LiveRun("sim:room?frames=3&image_width=96", tmp_path / "a.svox", **SMALL) as run:
        for options in ({"send_pose": "odometry"}, {"rules": SectorRules()}):
            with pytest.raises(StereovoxError, match="give mavlink"):
                run.add_outputs(**options)
        with pytest.raises(StereovoxError, match="give odometry or vision"):
            run.add_outputs(mavlink="udpout:127.0.0.1:9", send_pose="gps")


def test_nothing_is_sent_of_an_image_whose_pose_was_extrapolated_too_far(peer, tmp_path):
    def step(k, frame):
        if k == 2:
            object.__setattr__(frame, "pose_off_ns", 60_000_000)

    stream = Moving(frames=5, step=step)
    with MavlinkLink(peer.url, clock=lambda: stream.now_ns) as link:
        map_live(stream, tmp_path / "a.svox", mavlink=link, send_pose="vision", **SMALL)
    assert [message.reset_counter for message in peer.messages("VISION_POSITION_ESTIMATE")] == [0, 0, 1, 1]


def test_given_deviations_become_the_covariance_of_the_body(peer, tmp_path):
    sigma = (0.02, 0.005)
    stream = Moving(frames=2, step=lambda k, frame: object.__setattr__(frame, "pose_sigma", sigma))
    camera = LiveCamera(stream, "front", mount_of(MOUNT))
    with MavlinkLink(peer.url, clock=lambda: stream.now_ns) as link:
        map_live(camera, tmp_path / "a.svox", mavlink=link, send_pose="vision", **SMALL)
    message = peer.messages("VISION_POSITION_ESTIMATE")[0]
    T_world_camera = stream.truth[BEGIN_NS]
    lever = (T_world_camera @ inverse(camera.T_body_camera))[:3, 3] - T_world_camera[:3, 3]
    errors = np.diag(np.repeat(np.square(sigma), 3))
    angles = message.roll, message.pitch, message.yaw
    np.testing.assert_allclose(
        message.covariance, upper_triangle(covariance_at(errors, lever), angles), rtol=1e-4, atol=1e-12
    )
