# SPDX-License-Identifier: Apache-2.0
"""A pair waved in the simulated room: what is found against what is known, and what is refused."""

from __future__ import annotations

from argparse import ArgumentParser

import made_pairs as made
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.calibrate.pair import calibrate_pair
from stereovox.cli.calibrate import calibrate_pair as command
from stereovox.errors import StereovoxError
from stereovox.frame import Frame
from stereovox.opening import Selection, open_source
from stereovox.simulate.d435 import depth_camera
from stereovox.sources.base import Source
from stereovox.sources.poses.poses import Poses
from stereovox.sources.poses.tracker import on_clock

COUNT, HZ, WIDTH = 45, 12, 160
SECONDS, STAMPS = made.times(COUNT, HZ)
TRACK_SECONDS, TRACK_STAMPS = made.times(round((COUNT / HZ + 1) * 200), 200, -0.5)


class Images(Source):
    """Depth images in memory, without poses."""

    def __init__(self, images, stamps):
        self.name, self.camera = "waved", depth_camera(images[0].shape[1])
        self._images, self._stamps = images, stamps

    def __len__(self):
        return len(self._images)

    def frame(self, i):
        i = range(len(self))[i]
        return Frame(self._images[i], self.camera, np.full((4, 4), np.nan), self._stamps[i], 0.001)


def waved_images(axes=(1.0, 1.0, 1.0)):
    usual, made.WIDTH = made.WIDTH, WIDTH
    try:
        return made.depth_images([made.waved(t, axes) for t in SECONDS], 0.08 * WIDTH / 848)
    finally:
        made.WIDTH = usual


def waved_tracker(axes=(1.0, 1.0, 1.0), offset_s=made.OFFSET_S):
    cameras = [made.waved(t, axes) for t in TRACK_SECONDS]
    return on_clock(made.tracker_poses(cameras, TRACK_STAMPS, jitter=1.0), -offset_s)


@pytest.fixture(scope="module")
def images():
    return waved_images()


@pytest.fixture(scope="module")
def found(images):
    seen = []
    result = calibrate_pair(
        Images(images, STAMPS), waved_tracker(), progress=lambda frames, total: (seen.append(f) or f for f in frames)
    )
    assert len(seen) == COUNT
    return result


def rotation_error_deg(T):
    return np.degrees(Rotation.from_matrix(T[:3, :3].T @ made.T_TRACKER_CAMERA[:3, :3]).magnitude())


def test_offset_rotation_and_translation_are_found(found):
    assert abs(found.clock_offset_s - made.OFFSET_S) < 0.005
    assert rotation_error_deg(found.T_tracker_camera) < 0.5
    assert np.linalg.norm(found.T_tracker_camera[:3, 3] - made.T_TRACKER_CAMERA[:3, 3]) < 0.02


def test_the_uncertainty_covers_the_error_and_is_not_boundless(found):
    assert abs(found.clock_offset_s - made.OFFSET_S) < 6 * found.offset_std_s
    assert (np.abs(found.T_tracker_camera[:3, 3] - made.T_TRACKER_CAMERA[:3, 3]) < 6 * found.translation_std_m).all()
    assert found.offset_std_s < 0.004
    assert found.rotation_std_deg.max() < 0.6
    assert found.translation_std_m.max() < 0.025
    assert found.rotation_residual_deg < 0.3
    assert found.translation_residual_m < 0.01
    assert found.registered == COUNT - 1
    assert found.pairs > 0.9 * COUNT


def test_a_jump_and_lost_tracking_are_left_out(images):
    poses = waved_tracker()
    T, confidence = poses.T_world_body.copy(), np.full(len(poses), 3.0)
    T[500:, 0, 3] += 0.5  # at 2 s
    lost = slice(250, 280)
    T[lost, :3, 3] += 3.0
    confidence[lost] = 1
    found = calibrate_pair(Images(images, STAMPS), Poses(poses.stamps_ns, T, confidence))
    assert COUNT / 2 < found.pairs < COUNT - 1
    assert abs(found.clock_offset_s - made.OFFSET_S) < 0.005
    assert rotation_error_deg(found.T_tracker_camera) < 0.5
    assert np.linalg.norm(found.T_tracker_camera[:3, 3] - made.T_TRACKER_CAMERA[:3, 3]) < 0.02


def refused(said, depth, poses, **options):
    with pytest.raises(StereovoxError, match=said) as caught:
        calibrate_pair(depth, poses, **options)
    assert "\n" not in str(caught.value)


def test_turning_about_one_axis_only_is_refused():
    axes = (0.0, 1.0, 0.0)
    refused("one axis only", Images(waved_images(axes), STAMPS), waved_tracker(axes))


def test_hardly_turning_is_refused():
    axes = (0.02, 0.02, 0.02)
    refused("motion: too small", Images(waved_images(axes), STAMPS), waved_tracker(axes))


def test_a_tracker_of_another_recording_is_refused(images):
    random = np.random.default_rng(8)
    angles = np.cumsum(np.cumsum(random.standard_normal((900, 3)), axis=0), axis=0) * 2e-4
    T = np.tile(np.eye(4), (900, 1, 1))
    T[:, :3, :3] = Rotation.from_rotvec(angles).as_matrix()
    refused("clocks", Images(images, STAMPS), Poses(TRACK_STAMPS[:900], T))


def test_clocks_may_be_searched_in_a_range_only(images):
    refused("clocks", Images(images, STAMPS), waved_tracker(), guess_s=0.0, within_s=100.0)


def test_too_few_usable_images_are_refused(images):
    empty = [np.zeros_like(image) for image in images]
    refused("only 0 of 45 depth images", Images(empty, STAMPS), waved_tracker())
    refused("only 9 of 10", Selection(Images(images, STAMPS), ":10"), waved_tracker())


def test_the_command_writes_a_pair_that_maps(tmp_path, images, capsys):
    usual, made.WIDTH = made.WIDTH, WIDTH
    try:
        folder = made.write_depth(tmp_path / "flight", images, STAMPS)
    finally:
        made.WIDTH = usual
    poses = on_clock(waved_tracker(), made.OFFSET_S)
    (folder / "tracker.txt").write_text(made.tracker_lines(poses, confidence=[3] * len(poses)))
    (folder / "pair.toml").write_text("depth_scale = 0.001\nbaseline = 0.05\nmax_speed_mps = 8\n")
    parser = ArgumentParser()
    command.add_arguments(parser)
    out = tmp_path / "other" / "pair.toml"
    out.parent.mkdir()
    result = command.run(parser.parse_args([str(folder), "--out", str(out)]))
    assert result["clock_offset_s"] == pytest.approx(made.OFFSET_S, abs=0.005)
    assert "standard deviation" in capsys.readouterr().err
    source = open_source(out.parent)
    assert len(source) == COUNT
    for i in (0, 20, 44):
        frame = source.frame(i)
        assert frame.fault is None
        np.testing.assert_allclose(frame.T_world_sensor[:3, 3], made.waved(SECONDS[i])[:3, 3], atol=0.03)
    assert "max_speed_mps = 8.0" in out.read_text()


def test_the_command_says_what_is_missing(tmp_path):
    parser = ArgumentParser()
    command.add_arguments(parser)
    with pytest.raises(StereovoxError, match=r"neither pair\.toml nor tracker\.txt"):
        command.run(parser.parse_args([str(tmp_path)]))
    (tmp_path / "tracker.txt").write_text("0 0 0 0 0 0 0 1\n")
    with pytest.raises(StereovoxError, match="--within -1"):
        command.run(parser.parse_args([str(tmp_path), "--within=-1"]))
    with pytest.raises(StereovoxError, match="no depth images"):
        command.run(parser.parse_args([str(tmp_path)]))


def test_a_second_of_images_is_told_to_be_too_short(tmp_path, images):
    usual, made.WIDTH = made.WIDTH, WIDTH
    try:
        folder = made.write_depth(tmp_path / "flight", images[:13], STAMPS[:13])
    finally:
        made.WIDTH = usual
    poses = on_clock(waved_tracker(), made.OFFSET_S)
    (folder / "tracker.txt").write_text(made.tracker_lines(poses, confidence=[3] * len(poses)))
    parser = ArgumentParser()
    command.add_arguments(parser)
    with pytest.raises(StereovoxError, match=r"^flight: 13 images in 1\.0 s are too few; record for ten seconds"):
        command.run(parser.parse_args([str(folder)]))
