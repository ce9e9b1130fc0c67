# SPDX-License-Identifier: Apache-2.0
"""The poses that a run uses, for all possible arguments."""

from dataclasses import replace

import made_asl
import made_kitti
import made_rigs
import numpy as np
import pytest
from made_recordings import seven_scenes
from made_unposed import ROOM, room, unposed

from stereovox.errors import NoPoses, SourceError, StereovoxError
from stereovox.opening import open_images, open_source
from stereovox.runs import pose_choice
from stereovox.runs.pose_choice import choose_poses
from stereovox.sources.latest import LatestStream


def test_poses_that_are_there_are_used_unless_said_otherwise(tmp_path):
    where = unposed(tmp_path, 3, poses=True)
    assert choose_poses(where, None, None)[1:] == ("given", "")
    assert choose_poses(where, None, "given")[1:] == ("given", "")
    chosen = choose_poses(where, "1:", "track")
    assert chosen[1:] == ("track", "")
    assert [bool(np.isfinite(frame.T_world_sensor).all()) for frame in chosen.source] == [False, False]


def test_without_poses_the_camera_is_tracked_and_why_is_said(tmp_path):
    where = unposed(tmp_path, 3)
    chosen = choose_poses(str(where), ":2", None)
    assert (chosen.poses, chosen.source.length) == ("track", 2)
    assert "has depth images (3) but no poses" in chosen.why
    with pytest.raises(NoPoses, match="no poses; write poses"):
        choose_poses(where, None, "given")


def test_bad_poses_are_an_error_and_no_reason_to_track(tmp_path):
    where = unposed(tmp_path, 3, poses=True)
    (where / "groundtruth.txt").write_text("yesterday 0 0 0 0 0 0 1\n")
    with pytest.raises(SourceError, match=r"groundtruth\.txt:1: 'yesterday' is not a time in seconds"):
        choose_poses(where, None, None)


def test_a_folder_of_recordings_is_still_none_itself(tmp_path):
    seven_scenes(tmp_path / "depth_scan")
    with pytest.raises(SourceError, match="did you mean") as caught:
        choose_poses(tmp_path, None, None)
    assert not isinstance(caught.value, NoPoses)


def test_a_layout_whose_files_of_poses_are_all_missing(tmp_path):
    where = seven_scenes(tmp_path, 4)
    for file in where.glob("*.pose.txt"):
        file.unlink()
    chosen = choose_poses(where, None, None)
    assert (chosen.poses, "none of the frames inspected has a pose" in chosen.why) == ("track", True)
    assert [frame.depth.size > 0 for frame in chosen.source] == [True] * 4


PAIRS = {"raw": made_kitti.raw, "odometry": made_kitti.odometry, "rig": made_rigs.recorded, "asl": made_asl.asl}
WAYS = ("oxts", "poses", "groundtruth")
"""What names of files and folders with poses begin with, or hold."""


@pytest.mark.parametrize("name", PAIRS)
def test_stereo_recordings_without_poses(tmp_path, name):
    where = PAIRS[name](tmp_path / "drive")
    with_poses = [frame.left for frame in open_source(where) if not frame.fault]
    for path in sorted(tmp_path.rglob("*"), reverse=True):
        if any(way in path.name for way in WAYS):
            path.rename(path.with_name("away"))
    chosen = choose_poses(where, None, None)
    assert (chosen.poses, bool(chosen.why)) == ("track", True)
    found = [frame for frame in chosen.source if not frame.fault]
    assert len(found) >= len(with_poses) > 0
    assert all(np.isnan(frame.T_world_sensor).all() for frame in found)
    assert np.array_equal(found[0].left, with_poses[0])
    for poses in ("given", "both"):
        with pytest.raises(NoPoses):
            choose_poses(where, None, poses)


class Camera:
    """A live camera."""

    name, notes, layout, length, dropped = "live", (), "", None, 0

    def __init__(self, posed):
        self.posed, self.camera = posed, room(1)[0].camera


@pytest.mark.parametrize("posed", [True, False])
def test_a_live_camera_says_whether_it_knows_where_it_is(monkeypatch, posed):
    opened = []
    monkeypatch.setattr(pose_choice.opening, "open_stream", lambda *_: opened.append(1) or LatestStream(Camera(posed)))
    chosen = choose_poses("realsense:", None, None)
    assert (chosen.poses, bool(chosen.why), len(opened)) == ("given" if posed else "track", not posed, 1)


def test_streams_of_ones_own(tmp_path):
    images, simulated = open_images(unposed(tmp_path, 2)), open_source(ROOM, ":2")
    assert choose_poses(images, None, None).poses == "track"
    assert choose_poses(simulated, None, None).poses == "given"
    assert choose_poses(simulated, None, "track") == (simulated, "track", "")
    assert choose_poses(images, None, "given") == (images, "given", "")


def test_one_frame_with_a_pose_is_enough(tmp_path):
    class Rarely(type(open_source(ROOM))):
        def frame(self, i):
            frame = super().frame(i)
            return frame if i == 9 else replace(frame, fault="no_pose", fault_detail=f"nothing at {i}")

    assert choose_poses(Rarely(f"{ROOM.replace('=240', '=10')}"), None, None).poses == "given"


def test_an_unknown_choice_is_one_line():
    with pytest.raises(
        StereovoxError, match=r"^poses 'gven' is unknown \(did you mean 'given'\?\); give given, track or both$"
    ):
        choose_poses(ROOM, None, "gven")


def test_named_poses_that_fit_no_image_are_an_error_that_says_why(tmp_path):
    """Tracking instead would hide the cause. A limit can be set, and who asks for tracking gets it."""
    where = unposed(tmp_path, 4, poses=True)
    lines = [line for line in (where / "groundtruth.txt").read_text().splitlines() if not line.startswith("#")]
    (where / "groundtruth.txt").unlink()
    first, last = lines[0].split(), lines[-1].split()
    first[0], last[0] = (f"{float(line[0]) + off:.6f}" for line, off in ((first, -0.3), (last, 0.4)))
    (where / "slam.txt").write_text("\n".join(" ".join(line) for line in (first, last)) + "\n")
    with pytest.raises(StereovoxError, match=r"the nearest is .* s away.*correct \?poses=, or give --poses track"):
        choose_poses(f"{where}?poses=slam.txt", None, None)
    assert choose_poses(f"{where}?poses=slam.txt&max_gap=2", None, None).poses == "given"
    tracked = choose_poses(f"{where}?poses=slam.txt", None, "track")
    assert tracked.source.frame(0).fault is None  # the poses are not read: the image is
    assert tracked.source.frame(0).depth.size
