# SPDX-License-Identifier: Apache-2.0
"""Poses from other programs: lines over UDP and TCP, whatever somebody sends, and a T265 that is not there."""

import socket
import threading
from time import monotonic, sleep

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import from_quaternion
from stereovox.sources.poses.pose_stream import (
    MAX_LINE,
    T265,
    PoseStream,
    TcpPoses,
    UdpPoses,
    body_pose,
    lines_of,
    read_line,
)

SECONDS = 10.0


def wait_for(true):
    end = monotonic() + SECONDS
    while not true():
        assert monotonic() < end, "nothing came"
        sleep(0.002)


@pytest.fixture
def stream():
    stream = UdpPoses("udp://127.0.0.1:0")
    stream.start()
    yield stream
    stream.stop()


def send(stream, data):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.sendto(data, ("127.0.0.1", stream.port))


def test_lines_over_udp_are_poses(stream):
    send(stream, b"# stamp tx ty tz qx qy qz qw\n1700000000.123456789 1 2 3 0 0 0 1\n")
    send(stream, b"1700000000.133456789,1,2,3.5,0,0,0.7071068,0.7071068 3")
    wait_for(lambda: stream.poses.added == 2)
    T = stream.poses.at(1_700_000_000_123_456_789)
    np.testing.assert_array_equal(T[:3, 3], [1, 2, 3])
    T = stream.poses.at(1_700_000_000_133_456_789)
    np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-7)
    assert not stream.counts


@pytest.mark.parametrize(
    "line",
    [
        b"now 1 2 3 0 0 0 1", b"1 1 2 3 0 0 0", b"1 1 2 3 0 0 0 0", b"1 nan 2 3 0 0 0 1", b"1 1 2 3 0 0 0 1 9",
        b"\xff\xfe\x00", b"1e99 1 2 3 0 0 0 1", b"1 1e9 2 3 0 0 0 1", b"1 2 3", b"1" * (MAX_LINE + 1),
        b"1 1 2 3 0 0 0 1 3 3",
    ],
)  # fmt: skip
def test_lines_that_cannot_be_read_are_counted_and_told(stream, line):
    send(stream, line)
    send(stream, b"1 0 0 0 0 0 0 1")
    wait_for(lambda: stream.poses.added == 1)
    assert stream.counts["bad"] == 1
    assert stream.trouble.startswith("udp://127.0.0.1:0: a line cannot be read")
    assert len(stream.trouble) < 300


def test_poses_of_low_confidence_cannot_be_used(stream):
    send(stream, b"1 0 0 0 0 0 0 1 1\n1.05 0 0 0 0 0 0 1 3\n1.1 0 0 0 0 0 0 1 1\n")
    wait_for(lambda: stream.poses.added == 3)
    assert (stream.counts["low_confidence"], stream.poses.counts["unusable"]) == (2, 2)
    for stamp_ns in (10**9, 1_020_000_000, 1_080_000_000):
        with pytest.raises(FrameRefused, match="the tracker does not trust its pose") as refused:
            stream.poses.at(stamp_ns)
        assert refused.value.reason == "low_confidence"
    assert np.isfinite(stream.poses.at(1_050_000_000)).all()


def test_an_address_in_use_is_told(stream):
    other = UdpPoses(f"udp://127.0.0.1:{stream.port}")
    with pytest.raises(SourceError, match="choose a free port"):
        other.start()


@pytest.mark.parametrize("host", ["h" * 64, "robot..local"])
@pytest.mark.parametrize("kind", [UdpPoses, TcpPoses])
def test_what_cannot_be_a_host_is_refused(kind, host):
    with pytest.raises(SourceError, match="HOST:PORT, for example"):
        kind(f"{kind.scheme}{host}:5005")


def test_a_stream_that_breaks_says_so_and_ends():
    class Broken(PoseStream):
        def _receive(self):
            raise RuntimeError("pulled out")

    stream = Broken("tracker")
    stream.start()
    wait_for(lambda: stream.trouble)
    assert stream.trouble == "tracker: RuntimeError: pulled out"
    assert stream.poses.is_final(0)  # nobody waits for a pose any more
    stream.stop()


def test_lines_over_tcp_come_again_after_the_server_hung_up(monkeypatch):
    monkeypatch.setattr("stereovox.sources.poses.pose_stream.RETRY_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as server:
        stream = TcpPoses(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        stream.start()
        try:
            for second in (1, 2):
                connection, _ = server.accept()
                with connection:
                    for part in (f"{second} 0 0 ".encode(), b"0 0 0 0 1\n"):  # a line in two pieces
                        connection.sendall(part)
                    wait_for(lambda: stream.poses.added == second)  # noqa: B023
                    assert not stream.poses.is_final(10**18)
                wait_for(lambda: stream.poses.is_final(10**18))  # nobody waits while there is no server
            assert stream.counts["connections"] == 2
        finally:
            stream.stop()
    assert "trying again" in stream.trouble


def test_a_stream_stops_while_nothing_comes(stream):
    thread = threading.Thread(target=stream.stop)
    thread.start()
    thread.join(SECONDS)
    assert not thread.is_alive()
    assert stream.poses.is_final(0)


def test_a_line_without_end_does_not_fill_the_memory():
    pieces = [b"1" * 4096] * 50 + [b"\n2 ok\n", b""]
    lines = list(lines_of(lambda size: pieces.pop(0), lambda: False))
    assert [len(line) for line in lines] == [MAX_LINE + 1, 4]


def test_numbers_that_are_read():
    stamp_ns, T, confidence = read_line("1.5 1 2 3 0 0 0 2")
    assert (stamp_ns, confidence) == (1_500_000_000, None)
    np.testing.assert_array_equal(T, from_quaternion((1, 2, 3), (0, 0, 0, 1)))


AHEAD_AND_UP = {"ros": ((1, 0, 0), (0, 0, 1)), "ned": ((1, 0, 0), (0, 0, -1)), "opengl": ((0, 0, -1), (0, 1, 0)),
                "optical": ((0, 0, 1), (0, -1, 0))}  # fmt: skip


@pytest.mark.parametrize("axes", AHEAD_AND_UP)
def test_the_body_looks_ahead_and_stands_upright_in_all_axes(axes):
    """A body that went 2 m ahead and 1 m up, and turned 90 degrees to the left, says so in its own axes."""
    ahead, up = (np.array(one, float) for one in AHEAD_AND_UP[axes])
    T_file = np.eye(4)
    T_file[:3, :3] = Rotation.from_rotvec(np.pi / 2 * up).as_matrix()
    T_file[:3, 3] = 2 * ahead + up
    T = body_pose(T_file, axes)
    np.testing.assert_allclose(T[:3, 3], [2, 0, 1], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(T[:3, 2], [0, 0, 1], atol=1e-12)


class SoftwareTracker:
    """A T265 as pyrealsense2's software device."""

    def __init__(self, rs):
        self._rs, self.device = rs, rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "265")
        self.sensor = self.device.add_sensor("Tracking Module")
        stream = rs.pose_stream()
        stream.type, stream.index, stream.uid, stream.fps, stream.fmt = rs.stream.pose, 0, 7, 200, rs.format.six_dof
        self.profile = self.sensor.add_pose_stream(stream)

    def query_devices(self):
        return [self.device]

    def send(self, k, place, confidence):
        """Let it report a place, unturned, one millisecond later each time."""
        rs, said, image = self._rs, self._rs.pose(), self._rs.software_pose_frame()
        vector, quaternion = rs.vector(), rs.quaternion()
        (vector.x, vector.y, vector.z), quaternion.w = place, 1.0
        said.translation, said.rotation, said.tracker_confidence = vector, quaternion, confidence
        image.data, image.timestamp, image.frame_number = said, 1_700_000_000_123.5 + k, k
        image.domain, image.profile = rs.timestamp_domain.hardware_clock, self.profile.as_pose_stream_profile()
        self.sensor.on_pose_frame(image)


def test_a_connected_t265_tells_poses_of_a_body_that_looks_ahead():
    rs = pytest.importorskip("pyrealsense2", exc_type=ImportError)
    tracker = SoftwareTracker(rs)
    stream = T265("t265", tracker)
    stream.start()
    try:
        for k, confidence in enumerate((3, 3, 1)):
            tracker.send(k, (1.0, 2.0, -3.0), confidence)
            wait_for(lambda: stream.poses.added == k + 1)  # noqa: B023
    finally:
        stream.stop()
    stamp_ns = 1_700_000_000_123_500_000
    np.testing.assert_allclose(stream.poses.at(stamp_ns)[:3, 3], [3, -1, 2])  # ahead, left, up of x right, y up, z back
    np.testing.assert_allclose(stream.poses.at(stamp_ns + 500_000)[:3, :3], np.eye(3), atol=1e-6)
    assert stream.counts["low_confidence"] == stream.poses.counts["unusable"] == 1
    with pytest.raises(RuntimeError, match="not streaming"):
        tracker.sensor.stop()


def test_without_a_t265_the_cure_is_told():
    pytest.importorskip("pyrealsense2", exc_type=ImportError)

    class Nothing:
        def query_devices(self):
            return []

    with pytest.raises(SourceError, match=r"before 2.55; or send its poses as lines"):
        T265("t265", Nothing())
