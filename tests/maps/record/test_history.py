# SPDX-License-Identifier: Apache-2.0
"""A map's memory of its frames is saved and loaded; a hostile file is refused in one line."""

import json
from collections import Counter

import numpy as np
import pytest
from made_manifest import manifest_in, put_manifest

import stereovox as sv
from stereovox.errors import MapFileError
from stereovox.maps.record.camera_path import CameraPath, LoopLines
from stereovox.maps.record.history import MAX_REASONS, OTHERS, History, StampedPose, Streak

POSE = tuple(float(x) / 3 for x in range(12))
FULL = History(
    7,
    Counter({"no_pose": 2, "pose_jump": 1}),
    Counter({"clock_reset": 1}),
    Counter({"full": 6, "near": 1}),
    "kitchen",
    ("frame 9", 2**62),
    {"left": StampedPose(2**62, POSE), "right": StampedPose(-5, POSE)},
    {"left": Streak("pose_jump", 2**62 + 1, StampedPose(2**62 + 9, POSE))},
    CameraPath(0.1, {"left": [StampedPose(2**62, (0.5,) * 12)], "right": []}),
    loops=LoopLines.between([[[0, 0, 0], [1, 2, 3]]], []),
    recordings=2,
)


def test_what_is_saved_comes_back_exactly():
    assert History.loaded(json.loads(json.dumps(FULL.saved()))) == FULL
    assert History.loaded(json.loads(json.dumps(History().saved()))) == History()


def test_a_copy_goes_on_by_itself():
    copy = FULL.copied()
    copy.refuse("no_pose")
    copy.trusted.clear()
    assert (FULL.refused.total(), len(FULL.trusted)) == (3, 2)


@pytest.mark.parametrize("stamp_ns", [np.zeros(2, int), np.array(5), None, "5", 1.5])
def test_a_refused_frame_may_hold_anything_as_stamp_and_name(stamp_ns):
    mapper = sv.Mapper(voxel_size=0.5)
    camera = sv.PinholeCamera(2, 2, 1, 1, 1, 1)
    frame = sv.Frame(np.ones((2, 2), np.float32), camera, np.eye(4), stamp_ns=stamp_ns, name=stamp_ns)
    assert mapper.add(frame).refused == "bad_stamp"
    assert mapper.map.history.last_frame == (stamp_ns if isinstance(stamp_ns, str) else "", 0)


def test_words_without_end_do_not_fill_the_memory():
    history = History()
    for i in range(2 * MAX_REASONS):
        history.refuse(f"{i} {500 * 'x'}")
    assert len(history.refused) == MAX_REASONS + 1
    assert history.refused[OTHERS] == MAX_REASONS
    assert History.loaded(history.saved()) == history


def test_words_that_no_terminal_shows_are_counted_the_same_after_a_save():
    history, other = History(), History()
    for reason in ("a\nb", "a\\nb", "\x1b[1m", 300 * "\n"):
        history.refuse(reason)
        other.refuse(reason)
        other = History.loaded(other.saved())
    assert other == history


def damaged(change):
    saved = json.loads(json.dumps(FULL.saved()))
    change(saved)
    return saved


LIES = {
    "negative frames": lambda s: s.update(frames=-1),
    "frames as text": lambda s: s.update(frames="7"),
    "no number of refusals": lambda s: s.pop("frames_refused"),
    "refusals that do not add up": lambda s: s.update(frames_refused=4),
    "a list for a history": lambda s: s.update(history=[]),
    "a text for counts": lambda s: s["history"].update(refused="none"),
    "a count below zero": lambda s: s["history"]["settled"].update(clock_reset=-1),
    "a count that is true": lambda s: s["history"]["quality"].update(full=True),
    "counts without end": lambda s: s["history"].update(quality={str(i): 1 for i in range(10_000)}),
    "no quality": lambda s: s["history"].pop("quality"),
    "sensors without end": lambda s: s["history"].update(trusted={str(i): {} for i in range(1000)}),
    "a long name": lambda s: s["history"]["trusted"].update({"x" * 1000: {"stamp_ns": 0, "pose": [0.0] * 12}}),
    "a sensor that is a number": lambda s: s["history"]["trusted"].update(left=5),
    "eleven numbers": lambda s: s["history"]["trusted"]["left"].update(pose=[0.0] * 11),
    "a pose with NaN": lambda s: s["history"]["trusted"]["left"].update(pose=[float("nan")] * 12),
    "a pose that is true": lambda s: s["history"]["trusted"]["left"].update(pose=[True] * 12),
    "a pose of text": lambda s: s["history"]["trusted"]["left"].update(pose=["0"] * 12),
    "a pose far away": lambda s: s["history"]["trusted"]["left"].update(pose=[1e300] * 12),
    "a pose of huge numbers": lambda s: s["history"]["trusted"]["left"].update(pose=[10**400] * 12),
    "a stamp beyond int64": lambda s: s["history"]["trusted"]["left"].update(stamp_ns=2**63),
    "a stamp with a fraction": lambda s: s["history"]["trusted"]["left"].update(stamp_ns=1.5),
    "somebody waits who was never there": lambda s: s["history"]["trusted"].pop("left"),
    "waiting for a number": lambda s: s["history"]["waiting"]["left"].update(why=5),
    "a path of text": lambda s: s.update(camera_path="home"),
    "a path with half a pose": lambda s: s["camera_path"]["stops"]["left"].update(poses="AAAA"),
    "a path of no base64": lambda s: s["camera_path"]["stops"]["left"].update(poses="?"),
    "a path with NaN": lambda s: s["camera_path"]["stops"]["left"].update(poses="AADAfwAAwH8AAMB/" * 4),
    "a path without end": lambda s: s["camera_path"]["stops"]["left"].update(stamps_ns="AAAA" * 999_999),
    "a path without spacing": lambda s: s["camera_path"].update(spacing=0),
    "no recordings": lambda s: s.update(recordings=0),
    "loops of text": lambda s: s.update(loops="many"),
    "loops without those that were refused": lambda s: s["loops"].pop("refused"),
    "more loops than lines": lambda s: s["loops"]["closed"].update(number=2),
    "a loop with half a place": lambda s: s["loops"]["closed"].update(ends="AAAA"),
    "half a try": lambda s: s["history"].update(unconfirmed=0.5),
    "no beginning": lambda s: s["history"]["waiting"]["left"].pop("since_ns"),
}


@pytest.fixture(scope="module")
def saved_map(tmp_path_factory):
    folder = tmp_path_factory.mktemp("history") / "map"
    camera = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5, 0.05)
    mapper = sv.Mapper(voxel_size=0.25)
    mapper.add(sv.Frame(np.full((12, 16), 2.0, np.float32), camera, np.eye(4), sensor="left"))
    mapper.map.save(folder)
    return folder


@pytest.mark.parametrize("lie", LIES)
def test_what_cannot_have_been_saved_is_refused_in_one_line(lie, saved_map):
    file = saved_map / "manifest.json"
    manifest = manifest_in(file)
    try:
        put_manifest(file, {**manifest, **damaged(LIES[lie])})
        with pytest.raises(MapFileError) as refused:
            sv.load_map(saved_map)
    finally:
        put_manifest(file, manifest)
    assert "\n" not in str(refused.value)
    assert len(str(refused.value)) < 500
    assert sv.load_map(saved_map).history.trusted.keys() == {"left"}


def test_info_tells_it(saved_map, capsys):
    from stereovox.cli import main

    loaded = sv.load_map(saved_map)
    loaded.history = FULL.copied()
    loaded.save(saved_map)
    assert main(["info", str(saved_map), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["frames"], told["frames_refused"], told["recording"]) == (7, 3, "kitchen")
    assert told["refused"] == {"no_pose": 2, "pose_jump": 1}
    assert told["settled"] == {"clock_reset": 1}
    assert told["quality"] == {"full": 6, "near": 1}
    assert told["loops"] == {"closed": 1, "refused": 0}
    assert told["last_stamps_ns"] == {"left": 2**62, "right": -5}
    assert main(["info", str(saved_map)]) == 0
    text = "".join(capsys.readouterr())
    assert "2 x no_pose" in text
    assert "loops: 1 closed, 0 refused" in text
    assert "left" in text
