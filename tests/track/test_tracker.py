# SPDX-License-Identifier: Apache-2.0
"""Tracking of small simulated depth images: right poses with honest covariances, or the word that it is lost."""

from dataclasses import replace
from functools import lru_cache
from threading import current_thread

import numpy as np
import pytest
from made_tracks import STEP_NS, aside, covered, hall, seen, simulated, track, tracker

from stereovox.errors import StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.simulate.scene import Scene, box, cylinder
from stereovox.track.fit import Fit, Limits
from stereovox.track.surfaces import Surfaces
from stereovox.track.tracker import FOLLOWING, FOUND, POSE_FAULTS, RETURNING, _doubt, _open

METRES, DEGREES = 0.02, 0.5
"""Bounds of the errors of 25 images."""
BAYS = hall([(3 * k - 6, 0.12 * k) for k in range(6)])
"""No two of which are alike."""


@lru_cache(maxsize=8)
def frames(scene, first=0, last=25, seed=0):
    source = simulated(scene, seed)
    return [source.frame(i) for i in range(first, last)]


def at_even_times(taken):
    """Return frames with stamps of an even rate."""
    return [replace(frame, stamp_ns=i * STEP_NS) for i, frame in enumerate(taken)]


def test_a_clock_that_goes_back_does_not_say_that_a_loss_was_short():
    taken, by = at_even_times(frames("room")[:8]), tracker(frames("room")[0].T_world_sensor)
    track([*taken, replace(taken[-1], stamp_ns=0)], by)
    assert by._back is FOUND


@pytest.mark.parametrize("scene", ["apartment", "room"])
def test_poses_are_right_and_errors_are_as_their_covariances_say(scene):
    nees = []
    for seed in range(3):
        found = track(frames(scene, seed=seed))
        assert found.lost == [0]
        assert np.all(found.errors() < (METRES, DEGREES))
        nees.extend(found.nees())
    assert 0.1 < np.mean(nees) < 2
    assert np.max(nees) < 6


def test_way_and_turn_are_those_of_the_camera():
    """Not only the errors are small: the camera did move, by far more than they."""
    found = track(frames("apartment"))
    first, last = found.found[1].T_world_sensor, found.found[-1].T_world_sensor
    assert np.linalg.norm(last[:3, 3] - first[:3, 3]) > 1.0
    assert np.degrees(np.arccos((np.trace(first[:3, :3].T @ last[:3, :3]) - 1) / 2)) > 50


def test_the_same_frames_give_the_same_poses_and_the_poses_they_bring_are_not_used():
    taken = frames("room")[:12]
    one = track(taken)
    wrong = [replace(frame, T_world_sensor=np.full((4, 4), np.nan)) for frame in taken]
    again = [tracker(taken[0].T_world_sensor)] * 12
    for first, other in zip(one.found, (by.add(frame) for by, frame in zip(again, wrong, strict=True)), strict=True):
        assert np.array_equal(first.T_world_sensor, other.T_world_sensor)
        assert np.array_equal(first.covariance, other.covariance)
        assert first.lost == other.lost


def test_what_is_expected_is_seen_in_the_background_and_poses_are_the_same(monkeypatch):
    taken, by, threads = frames("room")[:12], tracker(frames("room")[0].T_world_sensor), []
    see = Surfaces.see

    def noted(self, frame):
        threads.append(current_thread())
        return see(self, frame)

    monkeypatch.setattr(Surfaces, "see", noted)
    for frame, ahead, first in zip(taken, [*taken[1:], taken[0]], track(taken).found, strict=True):
        by.expect(ahead)
        by.expect(replace(ahead, sensor="another"))
        other = by.add(frame)
        assert np.array_equal(first.T_world_sensor, other.T_world_sensor)
        assert np.array_equal(first.covariance, other.covariance)
        assert first.lost == other.lost
    elsewhere = sum(thread is not current_thread() for thread in threads[12:])
    assert elsewhere >= 10  # all but the first two; none before there was a frame
    assert len(threads) - 12 in (12, 13)  # each once, and the one that never came


@pytest.mark.parametrize("fault", sorted(POSE_FAULTS))
def test_what_is_wrong_with_a_pose_does_not_matter_for_an_image(fault):
    taken = [replace(frame, fault=fault, fault_detail="no pose near") for frame in frames("room")[:3]]
    assert track(taken).lost == [0]


def test_without_a_start_the_first_camera_looks_along_x_and_level():
    taken, by = frames("apartment")[:4], tracker()
    T = [by.add(frame).T_world_sensor for frame in taken]
    assert T[0][:3, :3] == pytest.approx(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]))
    assert T[0][:3, 3] == pytest.approx(0)
    moved = np.linalg.inv(taken[0].T_world_sensor) @ taken[3].T_world_sensor
    assert np.linalg.inv(T[0]) @ T[3] == pytest.approx(moved, abs=0.01)


@pytest.mark.parametrize(
    ("known", "inlier_share", "words"),
    [
        (0.19, 1.0, "19% of what it sees is known, 20% is needed"),
        (1.0, 0.59, "59% of what is known lies where it should, 60% is needed"),
        (0.21, 0.61, ""),
    ],
)
def test_what_must_be_known_and_where_it_should_be_while_following(known, inlier_share, words):
    assert _doubt(Fit(np.eye(4), np.eye(6), known, inlier_share), FOLLOWING) == words
    assert _doubt(Fit(np.eye(4), np.eye(6), known, inlier_share), RETURNING)  # to come back takes more


@pytest.mark.parametrize(
    ("axis", "deviation", "is_open"), [(1, 0.02, True), (1, 0.01, False), (4, 0.03, True), (4, 0.01, False)]
)
def test_a_pose_is_open_where_one_direction_of_it_is(axis, deviation, is_open):
    """Also one that is oblique to the axes."""
    spread = np.full(6, 0.001)
    spread[axis] = deviation
    turn = np.kron(np.eye(2), rotation_matrix([0.5, 0.3, -0.7]))
    covariance = turn @ np.diag(spread**2) @ turn.T
    assert bool(_open(Fit(np.eye(4), covariance, 1, 1), (np.radians(1), 0.02))) == is_open


def test_the_first_image_is_lost_and_lost_ones_have_no_covariance():
    found = track(frames("apartment")[:3])
    assert "first image" in found.found[0].lost
    assert np.all(np.isinf(found.found[0].covariance))
    assert np.all(np.linalg.eigvalsh(found.found[1].covariance) > 0)


def test_frames_of_another_sensor_are_lost_and_disturb_nothing():
    taken = frames("room")[:10]
    other = [replace(frame, sensor="rear") for frame in frames("apartment")[:10]]
    mixed = [frame for both in zip(taken, other, strict=True) for frame in both]
    found = track(mixed)
    assert found.lost == [0, *range(1, 20, 2)]
    assert "is tracked, not rear" in found.found[1].lost
    alone = track(taken)
    for one, both in zip(alone.found, found.found[::2], strict=True):
        assert np.array_equal(one.T_world_sensor, both.T_world_sensor)


def test_before_a_board_that_fills_the_view_it_is_lost():
    """All of it stands where the image before saw free space, so that nothing is left to be laid onto that."""
    first = at_even_times(frames("room")[:1])[0]
    flat = [np.full_like(first.depth, round(metres / first.depth_scale)) for metres in (2.5, 1.0, 1.0)]
    found = track([replace(first, depth=depth, stamp_ns=k * STEP_NS) for k, depth in enumerate(flat)])
    assert found.lost == [0, 1, 2]


def test_behind_a_finger_it_is_lost_and_found_again_where_it_is():
    taken = frames("apartment")
    found = track([*taken[:6], *map(covered, taken[6:11]), *taken[11:]])
    assert set(range(6, 11)) <= set(found.lost)
    assert set(range(18, 25)) <= set(found.tracked)
    assert np.all(found.errors() < (METRES, DEGREES))
    assert all(one.lost for one in found.found[11:14])  # a view that is found again counts only after some


@pytest.mark.parametrize("wall", ["wall", "wall?tilt=20&turn=15", "wall?distance=0.7"])
def test_before_a_bare_wall_every_frame_is_lost(wall):
    assert track(frames(wall, last=8)).tracked == []


@pytest.mark.parametrize("speed", [0, 1])
def test_in_an_endless_corridor_every_frame_is_lost(speed):
    """No end of it is within the range of the camera."""
    assert track(frames(f"aisle?length=60&speed={speed}", last=10)).tracked == []


def test_along_a_bare_wall_with_a_floor_it_is_lost_after_the_last_thing():
    """What holds the pose leaves the view; the tracker does not slide on."""
    thing = box("box", "box", (1.8, -0.5, 0), (2.4, 0.2, 1.0))
    bare = Scene([*hall([]).solids, thing])
    found = track(seen(bare, aside(70, (0, 0.1, 0))))
    assert found.tracked
    assert found.tracked[-1] < 45
    assert set(range(45, 70)) <= set(found.lost)
    assert np.all(found.errors() < (0.1, 1))


@pytest.mark.parametrize("there", [60, 120, 150, 250])
def test_after_a_jump_to_a_place_never_seen_it_is_lost_and_stays_so(there):
    """Rooms of one apartment are alike: rectangular, with much the same sizes."""
    taken = at_even_times(frames("apartment")[:10] + frames("apartment", there, there + 14))
    found = track(taken)
    assert set(range(10, 24)) <= set(found.lost)
    assert not any(one.lost.startswith("found again") for one in found.found)


@pytest.mark.parametrize("there", [200, 300])
def test_long_after_the_last_image_the_camera_may_be_anywhere(there):
    """It is not taken for where it would be had it moved on evenly, though these rooms fit there."""
    found = track(frames("apartment")[:10] + frames("apartment", there, there + 4))
    assert set(range(10, 14)) <= set(found.lost)


def test_long_after_the_last_image_it_is_found_where_it_stood():
    taken = frames("apartment", last=18)
    later = [replace(frame, stamp_ns=frame.stamp_ns + 10**10) for frame in taken[10:]]
    found = track([*taken[:10], *later])
    assert found.lost == [0, *range(10, 16)]
    assert np.all(found.errors() < (METRES, DEGREES))


@pytest.mark.parametrize(("here", "there"), [("room", "apartment"), ("apartment", "room")])
def test_in_another_building_it_is_lost_and_stays_so(here, there):
    taken = at_even_times(frames(here)[:10] + frames(there)[:14])
    assert set(range(10, 24)) <= set(track(taken).lost)


def test_among_two_places_that_are_alike_it_finds_none():
    """Bays of one shape, 3 m apart: when the lens is free again, the camera may stand before the one or the other."""
    alike = seen(hall([(3 * k - 6, 0) for k in range(6)]), aside(45, (0, 0.1, 0)))
    found = track(at_even_times([*alike, *map(covered, alike[:3]), *alike[5:10]]))
    assert found.tracked == list(range(1, 45))
    assert set(range(45, 53)) <= set(found.lost)
    assert all("several places" in one.lost for one in found.found[48:])


def test_of_places_that_differ_a_little_it_finds_the_right_one():
    taken = seen(BAYS, aside(45, (0, 0.1, 0)))
    found = track(at_even_times([*taken, *map(covered, taken[:3]), *taken[5:13]]))
    assert found.tracked[:44] == list(range(1, 45))
    assert found.tracked[-1] == 55
    assert np.all(found.errors()[44:] < (0.05, 1))


@pytest.mark.parametrize("speed", [0.0, 0.05])
def test_with_a_person_over_half_the_view_the_pose_is_right_or_lost(speed):
    def person(i):
        y = 0.1 + speed * i
        return Scene([cylinder("person", "person", (0.7, y, 0), (0.7, y, 1.9), 0.7, sections=16)]) if i >= 5 else None

    crossed, empty = seen(BAYS, aside(20), moving=person), seen(BAYS, aside(20))
    hidden = [np.mean(a.depth + 50.0 < b.depth) for a, b in zip(crossed, empty, strict=True)]
    assert max(hidden) > 0.5
    found = track(crossed)
    assert found.tracked[:4] == [1, 2, 3, 4]
    assert np.all(found.errors()[:, 0] < 0.1)


@pytest.mark.parametrize(("first", "speed"), [(-1.0, 0.1), (-0.5, 0.05), (-1.5, 0.05)])
def test_somebody_who_walks_through_what_was_seen_does_not_take_the_camera_along(first, speed):
    """A fifth of the view: what stands where it was free, and what leaves most others behind, moves."""

    def person(i):
        y = first + speed * i
        return Scene([cylinder("person", "person", (1.2, y, 0), (1.2, y, 1.9), 0.45, sections=16)]) if i >= 5 else None

    found = track(seen(BAYS, aside(30), moving=person))
    assert len(found.tracked) > 20
    assert np.all(found.errors()[:, 0] < METRES)


@pytest.mark.parametrize(
    ("scene", "first"), [("room", 161), ("apartment", 216), ("apartment", 609), ("apartment", 616)]
)
def test_places_that_hold_little_give_no_wrong_pose(scene, first):
    """The finest stage of least squares lost what the coarser ones had found, and claimed a few millimetres."""
    found = track(frames(scene, first, first + 12))
    assert not found.tracked or np.all(found.errors() < (0.06, 1))


def test_a_jump_within_a_gap_is_not_followed():
    taken = frames("apartment")[:10] + frames("apartment", 300, 312)
    late = [replace(frame, stamp_ns=(i + 8 * (i > 9)) * STEP_NS) for i, frame in enumerate(taken)]
    assert set(range(10, 22)) <= set(track(late).lost)


def test_two_images_close_in_time_do_not_make_the_next_one_late():
    taken = frames("apartment")[:20]
    stamps = [i * STEP_NS - (STEP_NS - 1_000_000 if i in (8, 14) else 0) for i in range(20)]
    found = track([replace(frame, stamp_ns=stamp) for frame, stamp in zip(taken, stamps, strict=True)])
    assert len(found.lost) < 4
    assert np.all(found.errors() < (METRES, DEGREES))


@pytest.mark.parametrize("start", [np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), "x", [[1, 2], [3]]])
def test_a_start_that_is_no_rigid_motion_is_refused(start):
    with pytest.raises(StereovoxError, match="no rigid motion"):
        tracker(start)


@pytest.mark.parametrize("motion", [np.eye(3), np.full((4, 4), np.nan), np.diag([2.0, 2, 2, 1]), "x", [[1, 2], [3]]])
def test_a_motion_that_is_not_rigid_is_refused_and_changes_nothing(motion):
    taken, one, other = frames("apartment")[:4], tracker(), tracker()
    for frame in taken:
        with pytest.raises(StereovoxError, match="motion is no rigid motion"):
            one.add(frame, motion)
        assert np.array_equal(one.add(frame).T_world_sensor, other.add(frame).T_world_sensor)


def test_a_start_far_from_the_origin_is_as_good_as_any():
    taken = frames("apartment")[:8]
    far = np.array([[1.0, 0, 0, 5e5], [0, 1, 0, 4e6], [0, 0, 1, 100], [0, 0, 0, 1]])
    near, away = tracker(), tracker(far)
    for frame in taken:
        one, other = near.add(frame), away.add(frame)
        assert one.lost == other.lost
    moved = np.linalg.inv(far) @ other.T_world_sensor
    assert np.linalg.norm(moved[:3, 3]) == pytest.approx(np.linalg.norm(one.T_world_sensor[:3, 3]), abs=1e-6)


def test_a_wall_is_named_where_the_map_begins_anew():
    assert "leaves the pose open" in track(frames("wall", last=4)).found[3].lost


class Stub:
    """Evidence that knows so much of every image, and finds it where the camera stood."""

    limits = Limits(np.full(6, 0.1), (1.0, 1.0), (1.0, 1.0))
    known = 1.0

    def see(self, frame):
        return frame

    def count(self, seen):
        pass

    def forget(self):
        pass

    def fit(self, seen, expected, doubt):
        return Fit(np.eye(4), 1e-6 * np.eye(6), self.known, 1.0)

    def advance(self, seen, T):
        pass

    def learn(self, seen, T):
        pass

    def seek(self, seen, last):
        return [self.fit(seen, last, np.eye(6))]

    def doubted(self, seen, fit):
        return ""

    def ambiguous(self, seen, T, known):
        return ""

    def contradicted(self, seen, T):
        return ""


@pytest.mark.parametrize(("away", "found"), [(5, True), (40, True), (120, False)])
def test_long_after_a_loss_two_thirds_of_an_image_are_too_little_to_be_found_again(monkeypatch, away, found):
    """Of two stretches of an aisle that are alike, walls and floor are the same."""
    evidence = Stub()
    monkeypatch.setattr("stereovox.track.tracker._evidence_for", lambda frame, config: evidence)
    frame, by = frames("apartment", last=1)[0], tracker()
    for i in range(10):
        assert (i == 0) == bool(by.add(replace(frame, stamp_ns=i * STEP_NS)).lost)
    evidence.known = 0.1
    for i in range(10, 10 + away):
        assert by.add(replace(frame, stamp_ns=i * STEP_NS)).lost
    evidence.known = 0.67
    said = [by.add(replace(frame, stamp_ns=(10 + away + i) * STEP_NS)).lost for i in range(8)]
    assert ("" in said) == found
    evidence.known = 0.8
    assert "" in [by.add(replace(frame, stamp_ns=(18 + away + i) * STEP_NS)).lost for i in range(8)]


FAULTS = {
    "mirrored": lambda depth: depth[:, ::-1],
    "upside down": lambda depth: depth[::-1],
    "too far": lambda depth: (depth * 1.12).astype(depth.dtype),
    "too near": lambda depth: (depth * 0.88).astype(depth.dtype),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_images_that_are_wrong_in_the_same_way_from_now_on_are_lost(fault):
    taken = seen(BAYS, aside(26, (0, 0.03, 0)))
    wrong = [replace(frame, depth=np.ascontiguousarray(FAULTS[fault](frame.depth)), reason=None) for frame in taken]
    found = track([*taken[:16], *wrong[16:]])
    assert found.tracked[:15] == list(range(1, 16))
    assert not found.tracked[15:] or np.all(found.errors()[15:, 0] < 0.15)


def test_after_a_second_of_darkness_it_is_found_where_it_went_meanwhile():
    taken = seen(BAYS, aside(60, (0, 0.02, 0)))
    found = track([*taken[:12], *map(covered, taken[12:42]), *taken[42:]])
    assert found.lost[-1] <= 50
    assert np.all(found.errors() < (0.05, 1))
