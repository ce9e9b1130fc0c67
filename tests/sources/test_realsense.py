# SPDX-License-Identifier: Apache-2.0
"""A live camera through the same code as a real one, without hardware: pyrealsense2's software device."""

from __future__ import annotations

import sys
from itertools import dropwhile, islice

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="pyrealsense2 has no wheel for this Python", exc_type=ImportError)

from made_realsense import FPS, HEIGHT, UNIT, WIDTH, SoftwareCamera, depth, picture, stamp_ns  # noqa: E402

from stereovox.cli import main, recordings  # noqa: E402
from stereovox.errors import FrameRefused, MissingExtra, SourceError  # noqa: E402
from stereovox.maps import load_map  # noqa: E402
from stereovox.opening import Excerpt, open_source, open_stream  # noqa: E402
from stereovox.sources.realsense import realsense  # noqa: E402
from stereovox.sources.realsense.realsense import RealSense  # noqa: E402

STILL = "realsense:?pose=fixed"


class Context:
    """What `rs.context()` would list."""

    def __init__(self, *cameras):
        self._cameras = cameras

    def query_devices(self):
        return [camera.device for camera in self._cameras]


@pytest.fixture
def camera(monkeypatch):
    camera = SoftwareCamera(rs)
    monkeypatch.setattr(rs, "context", lambda: camera)
    return camera


def number(frame):
    return int(frame.name.rpartition(" ")[2])


def test_frames_come_as_the_camera_took_them(camera):
    stream = open_stream(STILL)
    assert (stream.name, stream.length, stream.notes) == ("realsense:042", None, ())
    told = stream.camera
    assert (told.width, told.height, told.fx, told.fy) == (WIDTH, HEIGHT, 24.0, pytest.approx(25.6))
    assert (told.cx, told.cy, told.baseline) == (15.5, 12.0, pytest.approx(0.05))
    with camera.sending():
        frames = list(islice(stream, 5))
    numbers = [number(frame) for frame in frames]
    assert numbers == sorted(set(numbers))
    for k, frame in zip(numbers, frames, strict=True):
        np.testing.assert_array_equal(frame.depth, depth(k))
        assert frame.depth.dtype == np.uint16
        assert frame.stamp_ns == stamp_ns(k)
        assert type(frame.stamp_ns) is int
        assert frame.depth_scale == pytest.approx(UNIT)
        np.testing.assert_array_equal(frame.T_world_sensor, np.eye(4))
        assert frame.fault is None


def test_without_a_pose_the_depth_is_there_and_says_how_to_get_one(camera):
    with camera.sending():
        frame = next(iter(open_stream("realsense:042")))
    assert frame.fault == "no_pose"
    assert "?pose=fixed" in frame.fault_detail
    assert "pair.toml" in frame.fault_detail
    assert frame.depth.shape == (HEIGHT, WIDTH)


def pictured(stream):
    """Frames and their pictures, from the first on: the depth camera may be quicker than the colour camera."""
    return dropwhile(lambda pair: pair[1] is None, ((frame, pixels_of(frame)) for frame in islice(stream, 100)))


def pixels_of(frame):
    try:
        return frame.photo.pixels()
    except FrameRefused:
        return None


@pytest.mark.parametrize("form", ["yuyv", "rgb8"])
def test_pictures_come_with_the_depth_images_of_their_time(camera, form):
    camera.add_pictures(getattr(rs.format, form))
    stream = open_stream("realsense:")
    assert stream.notes == ()
    with camera.sending():
        pairs = list(islice(pictured(stream), 6))
    with pytest.raises(RuntimeError, match="not streaming"):
        camera.colour.stop()
    for frame, pixels in pairs:
        grey = pixels if form == "yuyv" else pixels[..., 1]
        np.testing.assert_array_equal(grey, picture(number(frame)))
        assert pixels_of(frame) is pixels  # kept for those who ask again, also after the camera's end
        assert (frame.photo.camera.width, frame.photo.camera.fx) == (WIDTH, 24.0)
        np.testing.assert_allclose(frame.photo.T_sensor_camera[:3, 3], [0.015, 0, 0])


def test_of_pictures_at_other_times_the_nearest_is_taken_and_none_that_is_far(camera):
    camera.add_pictures(rs.format.yuyv, late_ns=-25_000_000)  # the next one is 8 ms after its depth image
    with camera.sending():
        for frame, pixels in islice(pictured(open_stream("realsense:")), 3):
            np.testing.assert_array_equal(pixels, picture(number(frame) + 1))
    camera.late_ns = -1_000_000_000
    with camera.sending():
        for frame in islice(open_stream("realsense:"), 3):
            with pytest.raises(FrameRefused, match="no picture within 20 ms"):
                frame.photo.pixels()


def test_pictures_of_a_lens_that_distorts_are_straightened(camera):
    camera.add_pictures(rs.format.yuyv, coefficients=[-0.3, 0.1])
    with camera.sending():
        frame, pixels = next(pictured(open_stream("realsense:")))
    assert pixels[0, 0] != picture(number(frame))[0, 0]
    middle = HEIGHT // 2, WIDTH // 2
    assert pixels[middle] == picture(number(frame))[middle]


@pytest.mark.parametrize("options", ["?photo=off", "?pose=fixed"])
def test_pictures_can_be_left_out(camera, options):
    camera.add_pictures(rs.format.yuyv)
    with camera.sending():
        assert next(iter(open_stream(f"realsense:{options}"))).photo is None


def test_a_colour_camera_whose_place_is_unknown_is_told_of_and_left_out(camera, monkeypatch):
    camera.add_pictures(rs.format.yuyv)

    def unknown(one, other):
        raise RuntimeError("Requested extrinsics are not available!")

    monkeypatch.setattr("stereovox.sources.realsense.realsense_sensor.transform_between", unknown)
    stream = open_stream("realsense:")
    assert stream.notes == ("realsense:042: its colour camera is not used (Requested extrinsics are not available!)",)
    with camera.sending():
        assert next(iter(stream)).photo is None


def test_the_camera_stops_with_its_consumer_and_starts_again(camera):
    stream = open_stream(STILL, ":3")
    assert isinstance(stream, Excerpt)
    for _ in range(2):
        with camera.sending():
            assert len(list(stream)) == 3
        with pytest.raises(RuntimeError, match="not streaming"):
            camera.sensor.stop()


def test_every_second_frame(camera):
    with camera.sending():
        assert len(list(open_stream(STILL, "2:8:2"))) == 3


@pytest.mark.parametrize("frames", ["-5:", "5:5", "::-1", "3:1"])
def test_a_live_camera_counts_forwards_only(camera, frames):
    with pytest.raises(SourceError, match="count forwards"):
        open_stream(STILL, frames)


def test_more_frames_than_can_be_counted_are_refused(camera):
    with pytest.raises(SourceError, match="give smaller ones"):
        open_stream(STILL, f":{10**20}")


def test_a_calibration_of_a_live_camera_ends_where_frames_names_no_end(camera, monkeypatch):
    monkeypatch.setattr(recordings, "LIVE_FRAMES", 5)
    for frames, count in ((None, 5), ("1:", 5), (":3", 3)):
        seen = []
        monkeypatch.setattr("stereovox.calibrate.surface.read_wall", lambda shown, *_: seen.extend(shown))  # noqa: B023
        with camera.sending():
            recordings.read_walls([STILL], [], frames)
        assert len(seen) == count


def test_a_camera_that_falls_silent_is_an_error_not_a_wait(camera, monkeypatch):
    monkeypatch.setattr(realsense, "PATIENCE_MS", 50)
    with pytest.raises(SourceError, match=r"realsense:042: no frame for 0.05 s; check cable"):
        next(iter(open_stream(STILL)))
    with pytest.raises(RuntimeError, match="not streaming"):
        camera.sensor.stop()


def test_a_camera_that_cannot_start_is_closed_again(camera, monkeypatch):
    calls = []

    class Sensor:
        def open(self, profile):
            calls.append("open")

        def start(self, queue):
            raise RuntimeError("Resource temporarily unavailable")

        def stop(self):
            raise RuntimeError("not streaming")

        def close(self):
            calls.append("close")

    stream = RealSense(STILL)
    stream._sensor = Sensor()
    with pytest.raises(SourceError, match="temporarily unavailable"):
        next(iter(stream))
    assert calls == ["open", "close"]


def test_no_camera():
    with pytest.raises(SourceError, match=r"no RealSense camera is connected; plug one .* or give a recorded"):
        RealSense("realsense:", Context())


def test_several_cameras_need_a_choice():
    context = Context(SoftwareCamera(rs, "1"), SoftwareCamera(rs, "2"))
    with pytest.raises(SourceError, match="choose one: realsense:1 or realsense:2"):
        RealSense("realsense:", context)
    assert RealSense("realsense:2?pose=fixed", context).name == "realsense:2"
    with pytest.raises(SourceError, match="realsense:3: not connected; there is realsense:1 or realsense:2"):
        RealSense("realsense:3", context)


def test_a_camera_without_depth_is_named():
    class Blind(SoftwareCamera):
        def __init__(self):
            self.device = rs.software_device()
            self.device.add_sensor("RGB Camera")

    with pytest.raises(SourceError, match="no depth sensor"):
        RealSense("realsense:", Context(Blind()))


MODES = ((1280, 720, 30), (848, 480, 90), (848, 480, 30), (424, 240, 90))


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ("", (848, 480, 30)),
        ("?fps=90", (848, 480, 90)),
        ("?width=424", (424, 240, 90)),
        ("?height=720", (1280, 720, 30)),
    ],
)
def test_modes(options, size):
    stream = RealSense(f"realsense:{options}", Context(SoftwareCamera(rs, depth_modes=MODES)))
    assert (stream.camera.width, stream.camera.height, stream._profile.fps()) == size


def test_a_mode_that_does_not_exist_lists_those_that_do(camera):
    with pytest.raises(SourceError, match=f"no such depth mode; it has {WIDTH}x{HEIGHT} at {FPS} Hz"):
        open_stream("realsense:?width=1280&height=720")


def test_emitter_and_laser_power_are_set(camera):
    open_stream("realsense:?emitter=0&laser_power=150")
    assert camera.sensor.get_option(rs.option.emitter_enabled) == 0
    assert camera.sensor.get_option(rs.option.laser_power) == 150
    with pytest.raises(SourceError, match="laser_power must be 0 to 360"):
        open_stream("realsense:?laser_power=999")


def test_a_setting_that_the_camera_lacks():
    class Plain(SoftwareCamera):
        def __init__(self):
            self._rs = rs
            self.device = rs.software_device()
            self.sensor = self.device.add_sensor("Stereo Module")
            self._add(rs.stream.depth, 0, (WIDTH, HEIGHT, FPS), rs.format.z16, 2)
            self.sensor.add_read_only_option(rs.option.depth_units, UNIT)

    with pytest.raises(SourceError, match="no emitter to set"):
        RealSense("realsense:?emitter=1", Context(Plain()))
    stream = RealSense("realsense:", Context(Plain()))
    assert (stream.name, stream.camera.baseline) == ("realsense:unnamed", None)
    assert RealSense("realsense:?baseline=0.095", Context(Plain())).camera.baseline == 0.095


@pytest.mark.parametrize(
    "options",
    [
        *(
            "?width=wide",
            "?fps=-1",
            "?pose=moving",
            "?photo=on",
            "?colour=1",
            "?width",
            "?baseline=nan",
            "?fps=30&fps=30",
        ),
        *("?laser_power=-5", "?emitter=-2", "?width=-1"),
    ],
)
def test_bad_options_end_in_one_line(camera, options):
    with pytest.raises(SourceError) as caught:
        open_stream(f"realsense:{options}")
    assert str(caught.value).startswith(f"realsense:{options}: ")
    assert "\n" not in str(caught.value)


def test_a_live_camera_is_no_recording(camera):
    with pytest.raises(SourceError, match="no frames to go back to"):
        open_source("realsense:")


def test_without_the_library_the_cure_is_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingExtra, match=r"pip install 'stereovox\[realsense\]'"):
        open_stream("realsense:")


def mapped(capsys, *words):
    code = main(["map", *map(str, words)])
    return code, capsys.readouterr()


def test_map_follows_the_camera_and_resumes(camera, tmp_path, capsys):
    out = tmp_path / "m.svox"
    with camera.sending():
        code, said = mapped(capsys, f"{STILL}", "--out", out, "--frames", ":3", "--voxel-size", "0.1")
        assert (code, "3 frames mapped, 0 refused" in said.err) == (0, True)
        code, said = mapped(capsys, f"{STILL}", "--out", out, "--frames", ":2", "--resume")
    assert (code, "2 frames mapped, 0 refused" in said.err) == (0, True)
    assert load_map(out).frames == 5


def test_map_gives_up_on_a_camera_without_poses(camera, tmp_path, capsys):
    with camera.sending():
        code, said = mapped(capsys, "realsense:", "--out", tmp_path / "m.svox")
    assert code == 2
    assert "not one of 100 frames could be used" in said.err
    assert "?pose=fixed" in next(line for line in said.err.splitlines() if "tracked by visual odometry" in line)


def test_map_is_saved_when_the_camera_falls_silent(camera, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(realsense, "PATIENCE_MS", 300)
    send, sent = camera.send, []
    monkeypatch.setattr(camera, "send", lambda k: (send(k), sent.append(k)) if len(sent) < 40 else None)
    with camera.sending():
        code, said = mapped(capsys, STILL, "--out", tmp_path / "m.svox", "--voxel-size", "0.1")
    assert code == 2
    assert "no frame for" in said.err.splitlines()[-1]
    code = main(["info", str(tmp_path / "m.svox")])
    assert code == 0
