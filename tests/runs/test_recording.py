# SPDX-License-Identifier: Apache-2.0
"""A recording becomes a map by one call from Python, with all that `stereovox map` promises (tests/cli)."""

import inspect
import json
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import current_thread

import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main as command
from stereovox.cli import options
from stereovox.errors import SourceError
from stereovox.live import run
from stereovox.mapping import deadline
from stereovox.opening import open_stream
from stereovox.runs import engine, floor, recording, trajectory

SOURCE = "sim:room?image_width=160"
SETTINGS = {"voxel_size": 0.1, "frames": ":12"}


def same_cells(a, b):
    for mine, theirs in zip(sv.load_map(a).cells(), sv.load_map(b).cells(), strict=True):
        np.testing.assert_array_equal(mine, theirs)


class Seen:
    """Counts frames; ends the run after some."""

    def __init__(self, stop=None):
        self.reports, self._stop = [], stop

    def after(self, frame, report):
        self.reports.append((frame.stamp_ns, report))
        if len(self.reports) == self._stop:
            raise KeyboardInterrupt


class Live:
    """A camera that never ends, whose frames have a fault from one of them on."""

    name, notes, layout, length, dropped = "live", (), "", None, 3

    def __init__(self, good):
        self._frames = list(open_stream(SOURCE, ":3"))
        self.camera, self._good = self._frames[0].camera, good

    def after(self, count):
        return self

    def __iter__(self):
        for i in range(10_000):
            frame = self._frames[min(i, 2)]
            yield replace(frame, stamp_ns=i * 33_000_000, fault=None if i < self._good else "no_pose")


def test_runs_of_cameras_load_neither_slam_nor_localisation():
    """They take a second to load, and no camera needs them."""
    runs = "from stereovox.runs import engine, recording, trajectory"
    code = f"import sys; {runs}; print([name for name in sys.modules if name.startswith('stereovox.localize')])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"


def test_help_and_notebooks_see_all_options():
    for function, kind in (
        (sv.map_recording, recording.RecordingOptions),
        (sv.MapRun, recording.RecordingOptions),
        (sv.map_floor, floor.FloorOptions),
        (sv.map_live, run.LiveOptions),
        (sv.track_recording, trajectory.TrackOptions),
    ):
        shown = inspect.signature(function).parameters
        assert set(kind.names()) < set(shown)
        assert [name for name, one in shown.items() if one.kind == one.VAR_KEYWORD]
    assert {"grid", "mavlink"} < set(inspect.signature(sv.map_live).parameters)


def test_it_makes_the_map_of_the_command(tmp_path):
    seen = Seen()
    result = sv.map_recording(SOURCE, tmp_path / "a.svox", **SETTINGS, observers=[seen])
    assert command(["map", SOURCE, "--out", str(tmp_path / "b.svox"), "--voxel-size", "0.1", "--frames", ":12"]) == 0
    same_cells(tmp_path / "a.svox", tmp_path / "b.svox")
    assert result.out == tmp_path / "a.svox"
    assert [report for _, report in seen.reports] == result.reports
    assert result.summary()["frames"] == result.map.frames == 12
    assert options.CHECKPOINT_S == engine.CHECKPOINT_S


class Breaking:
    """A recording with an unreadable frame and one with a fault."""

    def __init__(self, bad):
        self._frames, self._bad = list(open_stream(SOURCE, ":8")), bad
        self.length, self.dropped, self.notes, self.layout = len(self._frames), 0, (), ""
        self.name, self.camera = "breaking", self._frames[0].camera

    def after(self, count):
        raise AssertionError("nothing to go on with")

    def frame(self, i):
        if i == self._bad:
            raise SourceError("frame 5: cannot be read")
        return replace(self._frames[i], T_world_sensor=None) if i == 2 else self._frames[i]

    def __iter__(self):
        return map(self.frame, range(self.length))


class Stateful:
    """A recording that can only be read forwards; it gives its readers data of its last frame."""

    def __init__(self):
        self._frames, self.last = list(open_stream(SOURCE, ":4")), None
        self.length, self.dropped, self.notes, self.layout = 4, 0, (), ""
        self.name, self.camera = "stateful", self._frames[0].camera

    def __iter__(self):
        for frame in self._frames:
            self.last = frame
            yield frame

    def after(self, frame, report):
        assert frame is self.last


def test_frames_are_prepared_in_advance_on_two_threads_and_the_map_is_the_same(tmp_path, monkeypatch):
    prepared_by, plain = [], deadline.prepared

    def prepare(*given):
        prepared_by.append(current_thread())
        return plain(*given)

    monkeypatch.setattr(deadline, "prepared", prepare)
    seen = {}
    for threads in (1, 2):
        seen[threads], notes = Seen(), []
        with pytest.raises(SourceError, match="frame 5"):
            sv.map_recording(
                Breaking(5), tmp_path / f"{threads}.svox", voxel_size=0.1, threads=threads, observers=[seen[threads]],
                notify=notes.append,
            )  # fmt: skip
        assert notes[-1].startswith("stopped after 5 frames")
    assert [one.refused for _, one in seen[2].reports] == [None, None, "no_pose", None, None]
    assert [one.refused for _, one in seen[1].reports] == [one.refused for _, one in seen[2].reports]
    assert len(prepared_by) == 10
    assert set(prepared_by[:5]) == {current_thread()}
    assert prepared_by[5:].count(current_thread()) == 1  # the first: nothing was to be done before it
    same_cells(tmp_path / "1.svox", tmp_path / "2.svox")


def test_a_stream_is_not_read_ahead(tmp_path):
    stream = Stateful()
    made = sv.map_recording(stream, tmp_path / "a.svox", voxel_size=0.1, threads=2, observers=[stream])
    assert made.map.frames == 4


def test_a_frame_that_was_not_expected_is_added_all_the_same():
    mapper, (one, other) = sv.Mapper(voxel_size=0.1, threads=2), list(open_stream(SOURCE, ":2"))
    mapper.expect(other)
    assert mapper.add(one).refused is None
    assert mapper.add(other).refused is None
    assert mapper.map.frames == 2


def test_a_run_that_was_stopped_goes_on_where_it_was(tmp_path):
    told = []
    with pytest.raises(KeyboardInterrupt):
        sv.map_recording(SOURCE, tmp_path / "a.svox", **SETTINGS, observers=[Seen(stop=5)], notify=told.append)
    assert told[-1].startswith("stopped after 5 frames")
    assert sv.load_map(tmp_path / "a.svox").frames == 5
    with sv.MapRun(SOURCE, tmp_path / "a.svox", resume=True, frames=":12", notify=told.append) as going:
        assert going.remaining == 7
        assert going.mapper.config.voxel_size == 0.1  # the map's own settings
        assert len(going.finish().reports) == 7
    assert told[-1] == "continuing after frame 5"
    sv.map_recording(SOURCE, tmp_path / "whole.svox", **SETTINGS)
    same_cells(tmp_path / "a.svox", tmp_path / "whole.svox")
    again = sv.map_recording(SOURCE, tmp_path / "a.svox", resume=True, frames=":12", notify=told.append)
    assert again.reports == []
    assert "already holds all 12 frames" in told[-1]


def test_who_goes_on_without_the_kept_frames_is_told(tmp_path):
    out, told = tmp_path / "a.svox", []
    sv.map_recording(SOURCE, out, voxel_size=0.1, frames=":4", **{"map.keep_frames": True})
    sv.map_recording(SOURCE, out, resume=True, frames=":6", notify=told.append)
    assert not any("are dropped" in line for line in told)
    sv.map_recording(SOURCE, out, resume=True, frames=":8", notify=told.append, **{"map.keep_frames": False})
    assert any("the 6 frames that the map kept are dropped (map.keep_frames=false)" in line for line in told)


@pytest.mark.parametrize("how", ["damaged", "gone"])
def test_kept_frames_that_are_lost_can_be_given_up(tmp_path, how):
    """The command in the message continues the map, which then merges by adding up evidence."""
    kept = {**SETTINGS, "frames": ":6", "map.keep_frames": True}
    one, two = (sv.map_recording(SOURCE, tmp_path / name, **kept).out for name in ("a.svox", "b.svox"))
    pack = one / json.loads((one / "manifest.json").read_text())["kept_frames"]["packs"][0]
    pack.write_bytes(bytes(pack.stat().st_size)) if how == "damaged" else pack.unlink()
    cure = f"stereovox map RECORDING --out {one} --resume --set map.keep_frames=false"
    for fails in (
        lambda: sv.map_recording(SOURCE, one, resume=True, frames=":8"),
        lambda: sv.merge(sv.load_map(one), sv.load_map(two)),
    ):
        with pytest.raises(sv.StereovoxError, match=cure):
            fails()
    assert sv.map_recording(SOURCE, one, resume=True, frames=":8", **{"map.keep_frames": False}).map.frames == 8
    assert sv.merge(sv.load_map(one), sv.load_map(two)).frames == 14


def test_who_goes_on_with_a_map_in_boxes_is_said(tmp_path):
    out = tmp_path / "city.svox"
    sv.save_boxed(sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0]), out)
    with pytest.raises(sv.StereovoxError, match=rf"stereovox fleet RECORDING \.\.\. --out {out} --resume"):
        sv.map_recording(SOURCE, out, resume=True)


def test_what_is_wrong_is_said_in_one_line_and_leaves_the_map(tmp_path):
    out = tmp_path / "a.svox"
    with pytest.raises(sv.StereovoxError, match="no map to continue"):
        sv.map_recording(SOURCE, out, resume=True)
    sv.map_recording(SOURCE, out, **SETTINGS)
    for source, more, words in (
        ("sim:wall?image_width=160", {"resume": True}, "was made of"),
        (SOURCE, {"resume": True, "frames": ":5"}, "more than the 5"),
        (SOURCE, {"resume": True, "frames": "::2"}, "its frame 12 was"),
        (SOURCE, {"checkpoint_s": -1.0}, "give seconds"),
        (SOURCE, {"nonsense": 1}, "nonsense"),
        (tmp_path / "nothing", {}, "nothing"),
    ):
        with pytest.raises(sv.StereovoxError, match=words) as caught:
            sv.map_recording(source, out, **more)
        assert "\n" not in str(caught.value)
        assert sv.load_map(out).frames == 12
    with sv.MapRun(SOURCE, out, resume=True), ThreadPoolExecutor() as pool:
        other = pool.submit(sv.map_recording, SOURCE, out, **SETTINGS)
        assert "another run" in str(other.exception())


def test_a_run_says_which_map_it_replaces(tmp_path):
    notes, out = [], tmp_path / "a.svox"
    for frames in (":3", ":2"):
        sv.map_recording(SOURCE, out, voxel_size=0.1, frames=frames, notify=notes.append)
    (line,) = (note for note in notes if "replaces" in note)
    assert line == f"note: {out} replaces an older map of 3 frames made of '{sv.load_map(out).recording}'"
    sv.map_recording(SOURCE, out, voxel_size=0.1, frames=":4", resume=True, notify=notes.append)
    assert sum("replaces" in note for note in notes) == 1
    (out / "manifest.json").write_text("{")
    assert recording.replaces(out) == f"note: {out} replaces a damaged map"


def test_names_of_a_floors_map_are_refused_in_space(tmp_path):
    for name in ("a.yaml", "a.yml", "a.pgm", "a.PNG"):
        with pytest.raises(sv.StereovoxError, match=r"names a floor's map; give a map in space the ending \.svox"):
            sv.map_recording(SOURCE, tmp_path / name, **SETTINGS)
    with pytest.raises(sv.StereovoxError, match="map_floor"):
        sv.map_recording(SOURCE, tmp_path / "a.svox", dimensions=2)
    assert not list(tmp_path.iterdir())


def test_a_live_camera_that_delivers_nothing_ends(tmp_path):
    with pytest.raises(sv.StereovoxError, match="not one of 100 frames could be used; no map is written"):
        sv.map_recording(Live(0), tmp_path / "a.svox", voxel_size=0.2)
    assert not (tmp_path / "a.svox").exists()
    with pytest.raises(KeyboardInterrupt):
        sv.map_recording(Live(2), tmp_path / "a.svox", voxel_size=0.2, observers=[Seen(stop=150)])
    assert sv.load_map(tmp_path / "a.svox").frames == 2


def test_a_map_made_level_with_a_profile(tmp_path):
    """A profile keeps its sizes; the up direction is still found."""
    box = "sim:box?image_width=160"
    result = sv.map_recording(box, tmp_path / "a.svox", profile="default", level=True, voxel_size=0.4)
    assert result.map.config.up == "z"
    np.testing.assert_allclose(result.map.config.levelled_from, [0, 0, 1], atol=0.1)


@pytest.mark.usefixtures("obeys_signals")
def test_a_signal_that_comes_while_they_are_set_up_leaves_no_handler_behind(monkeypatch):
    set_handler, usual = signal.signal, [signal.getsignal(number) for number in engine._default_signals()]

    def prompt(number, handler):
        before = set_handler(number, handler)
        if handler not in (signal.SIG_IGN, *usual):
            signal.raise_signal(number)
        return before

    monkeypatch.setattr(signal, "signal", prompt)
    with pytest.raises(KeyboardInterrupt), engine.ended_in_order():
        pytest.fail("the signal came before")
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == usual


@pytest.mark.usefixtures("obeys_signals")
def test_signals_are_left_to_the_main_thread():
    with ThreadPoolExecutor(1) as other:
        assert other.submit(engine._default_signals).result() == []
