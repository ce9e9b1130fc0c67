# SPDX-License-Identifier: Apache-2.0
"""A short form of benchmarks/bad_images.py, and what a mapper does when a camera is knocked or the world changes."""

import tempfile
from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.geometry.se3 import look_at
from stereovox.simulate.scene import box
from stereovox_lab.checks.bad_images import Trial, bad_frames, displaced, metres, trial
from stereovox_lab.checks.lasting import FAULTS, Bad
from stereovox_lab.checks.passer_by import PasserBy

CANNOT_BE_TOLD = {"half black"}
"""What is harmless as it is."""
NOTHING = np.zeros(3)
SMALL = "sim:room?image_width=320"


@pytest.fixture(scope="module")
def frames():
    return list(sv.open_source("sim:room", frames=":50"))


@pytest.fixture(scope="module")
def found(frames):
    return trial(frames, every=16, voxel_size=0.1)


def test_no_good_frame_is_refused(found):
    assert (found["frames"], found["refused"]) == (50, {})


def test_bad_frames_are_refused_or_without_effect(found):
    assert len(found["bad"]) == 25
    shares = [row["left"] for row in found["bad"].values()]
    assert np.mean(shares) < 0.06
    for kind, row in found["bad"].items():
        assert row["frames"] == 3
        assert row["left"] == 0 or "cm" in kind or "deg" in kind
        assert row["refused"] == 1 or kind in CANNOT_BE_TOLD or "cm" in kind or "deg" in kind
    reasons = {kind: set(row["reasons"]) for kind, row in found["bad"].items()}
    assert reasons["random depth"] == reasons["pixels shuffled"] == {"no_surfaces"}
    assert reasons["frozen"] == {"frozen_image"}
    assert reasons["four pixels"] == {"too_few_values"}
    assert reasons["depth x 1000"] == {"bad_units"}
    assert reasons["mirrored"] == reasons["depth x 1.2"] == {"disagrees_with_map"}


def test_an_offer_leaves_all_as_it_was(frames):
    tried, other = Trial(voxel_size=0.2), Trial(voxel_size=0.2)
    random = np.random.default_rng(0)
    for before, frame in zip([None, *frames[:20]], frames[:21], strict=True):
        if before is not None and not frame.stamp_ns % 5:
            for _, bad in bad_frames(frame, frame, before, random):
                tried.judge(bad, frame)
        assert tried.add(frame) == other.add(frame) == ""
    assert tried.map.history == other.map.history
    assert tried.map.storage.blocks()[1].tobytes() == other.map.storage.blocks()[1].tobytes()


def test_pairs_of_images_are_spoilt_as_well():
    pairs = list(sv.open_source("sim:surround?scale=0.5", frames=":2"))
    matched = Trial(voxel_size=0.2).quality.depth.matched(pairs[1])
    kinds = dict(bad_frames(pairs[1], matched, pairs[0], np.random.default_rng(0)))
    assert {"images black", "images saturated", "images of noise", "eyes swapped"} < set(kinds)
    tried = Trial(voxel_size=0.2)
    assert tried.judge(kinds["images black"], pairs[1]).refused == "too_dark"
    assert tried.judge(kinds["images saturated"], pairs[1]).refused == "overexposed"


def knocked(frames, start, end):
    """Frames of a camera that is 20 cm and 5 degrees off from one on to another."""
    off = np.array([0.2, 0, 0]), np.radians([0, 5, 0])
    return [displaced(frame, *off) if start <= i < end else frame for i, frame in enumerate(frames)]


def test_a_knocked_camera_is_not_believed_until_it_agrees_again():
    frames = list(sv.open_source(SMALL, frames=":90"))
    mapper = sv.Mapper(voxel_size=0.1)
    told = [mapper.add(frame).refused for frame in knocked(frames, 20, 80)]
    assert told[:20] == [None] * 20
    assert "disagrees_with_map" in told[20:50]
    assert set(told[20:50]) <= {"disagrees_with_map", "frozen_image"}  # to a frozen image its pose is wrong, too
    assert set(told[52:80]) == {"camera_moved"}
    assert told[84:] == [None] * 6
    assert mapper.map.history.settled == {}


LASTING = ("depth x 0.8", "depth x 1.2", "depth x 2", "mirrored",
           "plane at 1 m", "0.3 m too far", "of another place")  # fmt: skip


@pytest.fixture(scope="module")
def small():
    return [
        replace(frame, depth=metres(frame), depth_scale=1.0)
        for frame in sv.open_source("sim:room?image_width=160", frames=":150")
    ]


@pytest.mark.parametrize("kind", LASTING)
def test_a_fault_is_not_believed_however_long_it_lasts(small, kind):
    mapper = sv.Mapper(voxel_size=0.1)
    for frame in small[:60]:
        assert mapper.add(frame).refused is None
    cells = mapper.map.storage.blocks()[1].tobytes()
    bad = Bad(small[60:], small[60:][::-1], np.random.default_rng(0))
    refused = [mapper.add(FAULTS[kind](frame, i, bad)).refused for i, frame in enumerate(small[60:])]
    assert None not in refused
    assert refused[-1] in ("contradicts_map", "camera_moved")
    assert cells == mapper.map.storage.blocks()[1].tobytes()


class Changing(PasserBy):
    """A wall with a cupboard before it, from frame to frame there or not; the camera stands, or moves to and fro."""

    def __init__(self, moves):
        super().__init__("near", image_width=318)
        self.moves = moves

    def at(self, i, cupboard):
        solids = self._surroundings + ([box("cupboard", "cupboard", (2.2, -1, 0), (2.6, 1, 3))] if cupboard else [])
        eye = np.array([0, 0, 1.2]) + self.moves * np.sin(i / 15) * np.array([0.6, 0.4, 0])
        self.T_world_camera = look_at(eye, eye + np.array([1, 0, 0]))
        depth, reason = self._device.measure(self._rendered(solids), [0, i])
        return sv.Frame(depth, self.camera, self.T_world_camera, i * 33_333_333, 0.001, reason)


@pytest.mark.parametrize("before", [True, False])
def test_a_world_that_has_changed_is_believed_within_three_seconds(before):
    """Furniture that fills half of the view has come, or gone. What has come is near: few cells, so at once."""
    source = Changing(moves=True)
    mapper = sv.Mapper(voxel_size=0.1)
    for i in range(60):
        assert mapper.add(source.at(i, before)).refused is None
    reports = [mapper.add(source.at(i, not before)) for i in range(60, 150)]
    refused = [report.refused for report in reports]
    late = refused.index(None)
    assert 29 <= late <= 60 if before else late == 0
    assert set(refused[:late]) <= {"disagrees_with_map", "contradicts_map"}
    assert refused[late:] == [None] * (90 - late)
    assert mapper.map.history.settled.total() == before
    face = [[2.25, y, z] for y in (-0.5, 0.5) for z in (1.0, 1.5)]
    assert set(mapper.map.state(face).tolist()) == {int(sv.State.FREE if before else sv.State.OCCUPIED)}


def test_a_camera_that_stands_cannot_tell_a_change_from_a_fault():
    source = Changing(moves=False)
    mapper = sv.Mapper(voxel_size=0.1)
    for i in range(20):
        mapper.add(source.at(i, True))
    cells = mapper.map.storage.blocks()[1].tobytes()
    reports = [mapper.add(source.at(i, False)) for i in range(20, 70)]
    assert [report.refused for report in reports[31:]] == ["contradicts_map"] * 19
    assert "move the sensor" in reports[-1].detail
    assert mapper.health().refused["contradicts_map"] >= 19
    assert cells == mapper.map.storage.blocks()[1].tobytes()


WINDOWS = {
    "unbounded": {},
    "drop": {"window.size": [5.0, 5.0, 3.0], "window.trigger": 0.3},
    "keep": {"window.size": [5.0, 5.0, 3.0], "window.trigger": 0.3, "window.outside": "keep"},
}


@pytest.mark.parametrize("settings", WINDOWS.values(), ids=list(WINDOWS))
def test_a_run_with_bad_frames_may_be_split_anywhere(settings):
    frames = list(sv.open_source(SMALL, frames=":60"))
    frames[12] = replace(frames[11], T_world_sensor=frames[12].T_world_sensor, stamp_ns=frames[12].stamp_ns)
    frames[20] = replace(frames[20], depth=np.ascontiguousarray(frames[20].depth[:, ::-1]), reason=None)
    frames = knocked(frames, 30, 50)
    settings = {"voxel_size": 0.1, "trust.changed_s": 0.3, **settings}
    whole, parts = (sv.Mapper(**settings) for _ in range(2))
    reasons = set()
    with tempfile.TemporaryDirectory() as folder:
        for i, frame in enumerate(frames):
            if i in (12, 13, 21, 33, 47, 51):
                parts.map.save(f"{folder}/m")
                parts.map.close()
                parts = sv.Mapper(**settings, resume=sv.load_map(f"{folder}/m"))
            report = whole.add(frame)
            reasons.add(report.refused)
            assert parts.add(frame).refused == report.refused
    assert {"frozen_image", "disagrees_with_map"} <= reasons
    assert "camera_moved" in reasons or "window.size" in settings
    assert parts.map.history == whole.map.history
    for mine, theirs in zip(parts.map.storage.blocks(), whole.map.storage.blocks(), strict=True):
        np.testing.assert_array_equal(mine, theirs)
    parts.map.close()
    whole.map.close()


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
@pytest.mark.parametrize("more", [{}, {"sphere.step_deg": 1.0}, {"map.cell": "uint8"}, {"depth.downsample": 4}])
def test_every_way_to_evidence_is_compared(frames, integrator, more):
    mapper = sv.Mapper(voxel_size=0.2, integrator=integrator, **more)
    for frame in frames[:20]:
        assert mapper.add(frame).refused is None
    before = mapper.map.storage.blocks()[1].tobytes()
    farther = replace(frames[20], depth=1.3 * metres(frames[20]), depth_scale=1.0, reason=None)
    assert mapper.add(farther).refused == "disagrees_with_map"
    assert mapper.map.storage.blocks()[1].tobytes() == before


def test_it_can_be_switched_off(frames):
    mapper = sv.Mapper(voxel_size=0.2, **{"trust.max_disagreement": 1, "trust.frozen": False})
    for frame in frames[:20]:
        mapper.add(frame)
    assert mapper.add(displaced(frames[20], np.array([0.5, 0, 0]), NOTHING)).refused is None
    assert mapper.map.history.usual == {}
    assert mapper.map.history.looks == {}
