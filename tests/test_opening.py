# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import os

import pytest
from made_recordings import depth_image, seven_scenes, tum, write_png

from stereovox import open_source as public_open_source
from stereovox.errors import SourceError
from stereovox.opening import SOURCES, open_images, open_source
from stereovox.registry import find
from stereovox.simulate.recorder import record
from stereovox.simulate.simulation import Simulation
from stereovox.sources.rgbd.layouts.seven_scenes import SevenScenes
from stereovox.sources.rgbd.layouts.tum import TumRgbd

POSES = "1 0 0 0 0 0 0 1\n"


def test_layouts_are_recognised_by_what_they_hold(tmp_path):
    scenes, recording = seven_scenes(tmp_path / "a"), tum(tmp_path / "b", ["1.0"], POSES, listed=False)
    assert isinstance(open_source(scenes), SevenScenes)
    assert isinstance(open_source(str(recording) + os.sep), TumRgbd)
    assert public_open_source is open_source


def test_frames_pick_some(tmp_path):
    source = open_source(seven_scenes(tmp_path, 5), frames="1:5:2")
    assert [os.path.basename(frame.name) for frame in source] == ["frame-000001.depth.png", "frame-000003.depth.png"]


def test_bad_frames_are_told_before_the_folder_is_looked_at():
    with pytest.raises(SourceError, match="A:B:S"):
        open_source("/no/such/folder", frames="all")


@pytest.mark.parametrize("where", ["no-such-folder", "x" * 5000, "nul\0byte", ""])
def test_a_missing_folder(where):
    with pytest.raises(SourceError, match=r": no such folder or file; check the name$") as caught:
        open_source(where)
    assert len(str(caught.value)) <= 300


def test_a_file_is_no_recording(tmp_path):
    path = tmp_path / "frame-000000.depth.png"
    path.write_bytes(b"")
    with pytest.raises(SourceError, match="is a single image"):
        open_source(path)


def test_an_unknown_folder_tells_what_it_holds_and_where_layouts_are_described(tmp_path):
    (tmp_path / "image.jpg").write_bytes(b"")
    with pytest.raises(SourceError, match=r"1 \.jpg, no depth images.*docs/recordings\.md") as caught:
        open_source(tmp_path)
    assert len(str(caught.value)) <= 300


def test_a_name_that_is_nearly_there_is_suggested(tmp_path):
    (tmp_path / "kitchen").mkdir()
    with pytest.raises(SourceError, match=r"did you mean \S*kitchen\?"):
        open_source(tmp_path / "kitchn")


def test_what_the_nearest_layout_lacks_is_named_with_the_cure(tmp_path):
    (tmp_path / "depth").mkdir()
    for stamp in ("1.0", "2.0"):
        write_png(tmp_path / "depth" / f"{stamp}.png", depth_image(0))
    with pytest.raises(SourceError, match=r"has depth images \(2\) but no poses; write poses\.txt") as caught:
        open_source(tmp_path)
    assert len(str(caught.value)) <= 300


def test_a_folder_of_recordings_points_to_the_first_of_them(tmp_path):
    seven_scenes(tmp_path / "seq-02")
    seven_scenes(tmp_path / "seq-01")
    with pytest.raises(SourceError, match=r"did you mean \S*seq-01\?"):
        open_source(tmp_path)


@pytest.mark.parametrize("name", SOURCES)
def test_every_kind_says_no_to_what_it_does_not_know(name, tmp_path):
    kind = find("sources", SOURCES, name)
    write_png(tmp_path / "other" / "1.png", depth_image(0))
    for where in (str(tmp_path), str(tmp_path / "other"), str(tmp_path / "other" / "1.png"), "nowhere", "", "\0"):
        assert kind.recognises(where) is False


def test_each_layout_is_recognised_by_one_kind_only(tmp_path):
    seven_scenes(tmp_path / "seven_scenes")
    tum(tmp_path / "tum", ["1.0"], POSES)
    places = {"seven_scenes": str(tmp_path / "seven_scenes"), "tum": str(tmp_path / "tum"), "simulation": "sim:room"}
    for name, where in places.items():
        kinds = [kind for kind in SOURCES if find("sources", SOURCES, kind).recognises(where)]
        assert [kind for kind in kinds if kind != "plain"] == [name]  # the last, for nearly any folder with depth


def test_images_of_a_camera_pair_are_opened_through_the_pair(tmp_path):
    record(Simulation("sim:box?image_width=32&frames=3"), tmp_path / "pair")
    assert len(open_images(tmp_path / "pair", "1:")) == 2
