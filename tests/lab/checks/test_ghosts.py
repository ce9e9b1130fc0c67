"""A person who passes is forgotten within half a second, and a thin pole that is seen in one frame of three stays."""

from functools import cache

import numpy as np
import pytest

from stereovox.errors import SourceError, StereovoxError
from stereovox.frame import Reason
from stereovox.maps import State
from stereovox_lab.checks.ghosts import ghosts, passed_cells, seen_free, time_to_clear
from stereovox_lab.checks.passer_by import BEFORE, POLE, WALK_X, PasserBy

U, F, T, O = State.UNKNOWN, State.FREE, State.TENTATIVE, State.OCCUPIED  # noqa: E741
SMALL = {"image_width": 160, "pole_m": 0.04}


@cache
def scene(background):
    source = PasserBy(background, **SMALL)
    return source, [source.frame(i) for i in range(len(source))]


@cache
def truly_seen(background, i, side, max_range):
    source = scene(background)[0]
    return seen_free(source, i, (passed_cells(side) + 0.5) * side, side, max_range)


@cache
def passed(background, **changes):
    """What ghosts says; what is truly seen does not depend on the map and is found once for each scene."""

    def seen(source, i, centers, side, max_range):
        np.testing.assert_allclose(centers, (passed_cells(side) + 0.5) * side)
        return truly_seen(background, i, side, max_range)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("stereovox_lab.checks.ghosts.seen_free", seen)
        return ghosts(*scene(background), voxel_size=0.1, **changes)


@pytest.mark.parametrize("background", ["near", "far"])
def test_ghosts_are_gone_within_half_a_second(background):
    found = passed(background)
    told = found.as_dict()
    assert told["cells"] > 500
    assert told["cleared"] == 1
    assert told["gone_longest_s"] <= 0.5  # promised
    assert told["free_longest_s"] <= 0.7  # by then tentative for a while: what clears faster loses thin poles
    assert told["after_leaving_s"] <= 0.5
    assert found.left == found.unseen < 80  # only what stands at the border of the image, where no frame sees through
    assert found.number.max() > 20
    assert not found.number[-30:].any()
    assert told["static_lost"] < 0.03  # cells beside the wall that single hits made occupied


def test_nothing_is_cleared_where_the_camera_does_not_say_why_it_has_no_value():
    found = passed("silent")
    assert found.after_leaving == np.inf
    assert found.as_dict()["after_leaving_s"] is None
    assert found.left > 300
    assert found.number[-1] > 300


@pytest.mark.parametrize("background", ["near", "far", "silent"])
def test_a_pole_seen_in_one_frame_of_three_stays(background):
    found = passed(background)
    assert found.pole_lost < 0.01
    assert found.pole_free < 0.2


def test_figures_fail_where_clearing_or_keeping_breaks():
    """The same scene under models that clear hardly, and too much: the figures tell both."""
    slow = passed("near", **{"sensor.p_free": 0.48})
    assert slow.as_dict()["gone_longest_s"] > 0.5
    eager = passed("near", **{"sensor.p_free": 0.05, "sensor.passes": 1.0})
    assert eager.pole_lost > 0.2


def test_the_scene_is_what_it_says():
    near, far, silent = (PasserBy(background, **SMALL) for background in ("near", "far", "silent"))
    middle = BEFORE + 64
    assert near.person(BEFORE - 1) is None
    assert near.person(len(near) - 1) is None
    assert near.shows_person(middle)
    assert not near.shows_person(0)
    assert near.true_depth(middle)[45, 80] == pytest.approx(WALK_X - 0.2, abs=0.05)
    assert near.true_depth(0)[20, 80] == pytest.approx(4.0)
    assert np.isinf(far.true_depth(0)[20, 80])
    seen, unsure = far.frame(0), silent.frame(0)
    assert (seen.reason[:20, 20:140] == Reason.TOO_FAR).mean() > 0.9
    assert not (unsure.reason == Reason.TOO_FAR).any()
    assert (unsure.reason[:20, 20:140] == Reason.UNKNOWN).mean() > 0.9
    for a, b in zip((seen.depth, seen.reason), (far.frame(0).depth, far.frame(0).reason), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(SourceError, match="background=fog is unknown; use near or far or silent"):
        PasserBy("fog")


@pytest.mark.parametrize("missed", ["background", "unmatched"])
def test_the_pole_is_missed_in_two_frames_of_three(missed):
    source = PasserBy("near", missed=missed, **SMALL)
    camera = source.camera
    u = round(-POLE[1] / POLE[0] * camera.fx + camera.cx)
    images = [source.frame(i) for i in range(6)]
    shown = [image.depth[10:40, u - 3 : u + 4] for image in images]
    near = [((depth > 0) & (depth < 2000)).any() for depth in shown]
    assert near == [True, False, False] * 2
    missing = [(image.reason[10:40, u - 3 : u + 4] == Reason.UNMATCHED).mean() for image in images]
    assert (missing[1] > 0.2) == (missed == "unmatched")


def test_what_a_frame_sees_through():
    source = PasserBy("near", **SMALL)
    points = np.array(
        [[1.5, 1.0, 1.2], [3.5, 0.05, 1.2], [4.1, 0.05, 1.2], [-1.0, 0.0, 1.2], [*POLE, 1.2], [2.6, 0.0, 1.2]]
    )
    assert seen_free(source, 0, points, 0.1, 5.0).tolist() == [True, True, False, False, False, True]
    assert seen_free(source, BEFORE + 64, points, 0.1, 5.0).tolist() == [True, False, False, False, False, False]
    assert not seen_free(source, 0, points, 0.1, 3.0)[1]


@pytest.mark.parametrize(
    ("before", "states", "seen", "frames"),
    [
        (O, [F, F, F], [1, 1, 1], 1),  # the first look clears it
        (O, [O, T, F], [1, 1, 1], 3),
        (O, [O, T, F], [0, 1, 1], 2),  # the clock starts with the first look
        (O, [O, F, F], [1, 0, 0], 2),  # frames that look elsewhere count as well
        (O, [F, F, F], [0, 1, 1], np.nan),  # clear before anybody looked
        (O, [O, O, T], [1, 1, 1], np.inf),
        (O, [O, O, O], [0, 0, 0], np.nan),
        (U, [O, O, F], [0, 1, 1], 2),
        (U, [F, F, F], [1, 1, 1], np.nan),
        (U, [F, O, F], [1, 0, 1], 1),  # occupied later, cleared by the look after that
        (U, [O, F, F], [1, 1, 1], 1),  # the first look found it unknown, the second occupied
    ],
)
def test_time_to_clear_one_cell(before, states, seen, frames):
    found = time_to_clear(np.array(states)[:, None], np.array(seen)[:, None], before=[before])
    assert found.frames == pytest.approx([frames], nan_ok=True)


def test_time_to_clear_of_many_cells():
    states = np.array([[O, O, O, F], [F, T, O, F], [F, F, O, F]])
    found = time_to_clear(states, np.ones((3, 4)), before=[O, O, O, F])
    assert found.as_dict() == {"cells": 3, "cleared": 2 / 3, "median": 2.5, "p90": 2.9, "longest": 3}
    not_occupied = time_to_clear(states, np.ones((3, 4)), (State.FREE, State.TENTATIVE), [O, O, O, F])
    assert not_occupied.frames[:2].tolist() == [2, 2]
    nothing = time_to_clear(np.zeros((0, 2)), np.zeros((0, 2)))
    assert nothing.as_dict() == {"cells": 0, "cleared": None, "median": None, "p90": None, "longest": None}
    with pytest.raises(StereovoxError, match=r"\(3, 4\).*\(4, 3\)"):
        time_to_clear(states, np.ones((4, 3)))
