# SPDX-License-Identifier: Apache-2.0
"""When cells were seen last, and that they are forgotten, against a dictionary of cells."""

import shutil

import made_flights as made
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import ConfigError, MapFileError, StereovoxError
from stereovox.maps import State, VoxelMap, load_map, make_map
from stereovox.maps.cells.evidence import Evidence

SECOND = 1_000_000_000
WINDOW = {"window.size": [3.2, 3.2, 3.2], "window.trigger": 0.4}

WIDE = {"window.size": [9, 9, 9], "window.outside": "keep"}


def settings(**more):
    return load_config("default", voxel_size=0.1, **{"map.keep_times": True, **more})


class Slow:
    """A dictionary: cell -> stamp of its last evidence."""

    def __init__(self):
        self.stamps = {}

    def add(self, moment):
        evidence = moment.evidence
        values = [*evidence.values, *(np.full(512, value) for value in evidence.uniform_values)]
        for block, row in zip([*evidence.coords, *evidence.uniform], values, strict=True):
            x, y, z = (block * 8).tolist()
            for c in np.flatnonzero(row).tolist():
                self.stamps[x + (c >> 6), y + ((c >> 3) & 7), z + (c & 7)] = moment.viewpoint.stamp_ns


def seen(one):
    return {tuple(cell): age for cell, age in zip(one.cells()[0].tolist(), one.ages().tolist(), strict=True)}


def one_cell(value, cell=0):
    values = np.zeros((1, 512), np.int16)
    values[0, cell] = value
    return Evidence(np.zeros((1, 3), np.int32), values, np.empty((0, 3), np.int32), -300)


@pytest.mark.parametrize("more", [{}, {"map.cell": "int8"}, WIDE], ids=["int16", "int8", "window"])
def test_ages_equal_a_dictionary(more):
    one, slow = make_map(settings(**more)), Slow()
    moments = list(made.flight(1, 10, step_m=0.05, blocks=8))
    for moment in moments:
        made.fly(one, [moment])
        slow.add(moment)
    now = moments[-1].viewpoint.stamp_ns
    found = seen(one)
    assert found == pytest.approx({cell: (now - stamp) / SECOND for cell, stamp in slow.stamps.items()}, abs=0.011)
    assert len(found) > 3000
    assert len(set(np.round(list(found.values()), 2))) > 6
    cells = np.array(list(found))
    np.testing.assert_array_equal(one.age(one.centers(cells)), np.float32(list(found.values())))
    later = one.age(one.centers(cells), now + 3 * SECOND)
    np.testing.assert_allclose(later, one.age(one.centers(cells)) + 3, atol=1e-3)
    assert np.isnan(one.age([[50.0, 0, 0], [np.nan, 0, 0], [1e30, 0, 0]])).all()
    one.close()


def test_a_map_without_times_says_how_to_have_them():
    one = VoxelMap(load_config())
    for ask in (lambda: one.age([[0, 0, 0]]), one.ages, lambda: list(one.storage.timed())):
        with pytest.raises(StereovoxError, match=r"map\.keep_times = true"):
            ask()
    with pytest.raises(ConfigError, match="forget_s needs keep_times"):
        load_config(**{"map.forget_s": 3})


def test_evidence_too_weak_to_count_is_no_sign_of_life():
    one = VoxelMap(settings(**{"map.cell": "uint8"}))
    made.fly(one, [(made.at((0, 0, 0), 0), one_cell(900))])
    made.fly(one, [(made.at((0, 0, 0), SECOND), one_cell(1))])  # less than half a step of a byte
    assert one.age([0.05, 0.05, 0.05]).tolist() == [1.0]
    assert one.age([0.05, 0.05, 0.05], now_ns=0).tolist() == [0.0]


def test_times_far_from_the_first_frame_stop_at_the_end_of_what_can_be_told():
    one, day = VoxelMap(settings()), 86400 * SECOND
    made.fly(one, [(made.at((0, 0, 0), 50 * day), one_cell(900))])
    for days, wanted in ((51, 1), (422, 372), (1000, 373), (49, -1), (-74, -124), (-300, -124)):
        assert one.age([0.05, 0.05, 0.05], days * day)[0] / 86400 == pytest.approx(wanted, abs=0.6)


@pytest.mark.parametrize("more", [{}, WIDE], ids=["unbounded", "window"])
def test_cells_are_forgotten_in_time_and_no_others(more):
    forget_s = 4.0
    one, slow = make_map(settings(**{"map.forget_s": forget_s, **more})), Slow()
    before = late = 0
    for moment in made.flight(2, 30, step_m=0.1, blocks=4):
        made.fly(one, [moment])
        slow.add(moment)
        now = moment.viewpoint.stamp_ns
        ages = {cell: (now - stamp) / SECOND for cell, stamp in slow.stamps.items()}
        found = seen(one)
        gap = (now - before) / SECOND
        assert all(ages[cell] <= forget_s * 9 / 8 + gap + 0.02 for cell in found), "too late"
        assert found.keys() >= {cell for cell, age in ages.items() if age <= forget_s}, "too early"
        late += sum(ages[cell] > forget_s for cell in found)
        slow.stamps = {cell: slow.stamps[cell] for cell in found}  # what is forgotten starts anew
        before = now
    assert late, "or blocks are all looked at in every frame"


def test_what_is_forgotten_starts_from_the_prior_and_is_never_free():
    one = VoxelMap(settings(**{"map.forget_s": 1.0}))
    made.fly(one, [(made.at((0, 0, 0), 0), one_cell(9000)), (made.at((0, 0, 0), SECOND), one_cell(-1000, cell=5))])
    place = [[0.05, 0.05, 0.05]]
    for tenths in range(11, 30):
        made.fly(one, [(made.at((0, 0, 0), tenths * SECOND // 10), one_cell(-1, cell=5))])
        assert one.state(place)[0] in (State.OCCUPIED, State.UNKNOWN)
        if tenths >= 12:
            assert one.state(place)[0] == State.UNKNOWN
            assert np.isnan(one.age(place)).all()
    assert one.state([[0.05, 0.05, 0.55]])[0] == State.FREE, "seen all the time"
    made.fly(one, [(made.at((0, 0, 0), 3 * SECOND), one_cell(500))])
    np.testing.assert_allclose(one.log_odds(place), np.log(1 / 9) + 0.5, atol=1e-3)


def test_a_clock_that_was_reset_makes_cells_of_the_other_time_unknown():
    one = VoxelMap(settings(**{"map.forget_s": 1.0}))
    made.fly(one, [(made.at((0, 0, 0), 1000 * SECOND), one_cell(9000))])
    made.fly(one, [(made.at((9, 0, 0), t * SECOND // 10), one_cell(9000, cell=7)) for t in range(5)])
    assert one.state([[0.05, 0.05, 0.05], [0.05, 0.05, 0.75]]).tolist() == [State.UNKNOWN, State.OCCUPIED]


def test_free_blocks_without_numbers_are_forgotten_too():
    one = VoxelMap(settings(**{"map.forget_s": 1.0}))
    free = Evidence(np.empty((0, 3), np.int32), np.empty((0, 512), np.int16), np.zeros((1, 3), np.int32), -30000)
    made.fly(one, [(made.at((0, 0, 0), 0), free), (made.at((0, 0, 0), SECOND // 2), one_cell(-1000))])
    assert one.counts()["free"] == 512
    made.fly(one, [(made.at((0, 0, 0), SECOND * 13 // 10), one_cell(-1000, cell=1))])
    assert one.counts()["free"] == 2
    made.fly(one, [(made.at((0, 0, 0), 9 * SECOND), one_cell(0))])
    assert one.memory_bytes == VoxelMap(settings()).memory_bytes, "neither cells nor times are kept"


@pytest.mark.parametrize("outside", ["drop", "keep"])
def test_times_leave_with_their_cells(outside):
    one = make_map(settings(**WINDOW, **{"window.outside": outside, "map.forget_s": 100.0}))
    made.fly(one, [(made.at((0, 0, 0), 0), one_cell(9000))])
    place = [[0.05, 0.05, 0.05]]
    made.fly(one, [(made.at((30, 0, 0), SECOND), one_cell(0))])
    assert len(one.storage._times) == 0
    np.testing.assert_array_equal(one.age(place), [1.0 if outside == "keep" else np.nan])
    made.fly(one, [(made.at((0, 0, 0), 5 * SECOND), one_cell(0))])
    np.testing.assert_array_equal(one.age(place), [5.0 if outside == "keep" else np.nan])
    assert one.memory_bytes == make_map(one.config).memory_bytes
    one.close()


def test_cells_on_disk_are_forgotten_wherever_they_are_asked_for(tmp_path):
    one = make_map(settings(**WINDOW, **{"window.outside": "keep", "map.forget_s": 10.0}), tiles=tmp_path / "tiles")
    place = [[0.05, 0.05, 0.05]]
    made.fly(one, [(made.at((0, 0, 0), 0), one_cell(9000)), (made.at((30, 0, 0), SECOND), one_cell(0))])
    assert one.state(place)[0] == State.OCCUPIED
    one.save(tmp_path / "early")
    one.storage.set_viewpoint(made.at((30, 0, 0), 11 * SECOND))
    assert one.state(place)[0] == State.UNKNOWN
    assert one.counts()["occupied"] == 0
    one.save(tmp_path / "late")
    assert load_map(tmp_path / "early").counts()["occupied"] == 1
    assert load_map(tmp_path / "late").counts()["occupied"] == 0
    one.storage.set_viewpoint(made.at((0, 0, 0), 11 * SECOND))
    assert len(one.storage._pool) == len(one.storage._times) == 0
    one.storage.set_viewpoint(made.at((30, 0, 0), 2 * SECOND))  # not even where the clock goes back
    assert one.state(place)[0] == State.UNKNOWN
    one.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["early", "late"]


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize("clock", [(11, 30, 12, 12.5), (11, 3, 11, 11.5)], ids=["back", "back and on"])
def test_what_was_over_on_disk_stays_so_when_the_clock_is_set_back(tmp_path, clock, saved):
    config = settings(**WINDOW, **{"window.outside": "keep", "map.forget_s": 5.0})
    one = made.fly(make_map(config), [made.Moment(made.at((0, 0, 0), 10 * SECOND), one_cell(3000))])
    for n, place in enumerate((20, 20, 20, 0)):
        one.storage.set_viewpoint(made.at((place, 0, 0), round(clock[n] * SECOND)))
        assert (one.state([[0.05, 0.05, 0.05]]) == State.UNKNOWN) == (n > 0), n
        if saved:
            one.save(tmp_path / "m")
            one.close()
            one = make_map(config, load_map(tmp_path / "m"))
    assert not len(one.cells()[0])
    one.close()


def test_times_are_saved_and_checked(tmp_path):
    one = made.fly(VoxelMap(settings()), made.flight(3, 6))
    one.save(tmp_path / "m")
    made.assert_same(load_map(tmp_path / "m"), one)
    data = next((tmp_path / "m").glob("cells-*"))
    shutil.rmtree(data / "times" / "c")
    with pytest.raises(MapFileError, match="checksum"):
        load_map(tmp_path / "m")
    shutil.rmtree(data / "times")
    with pytest.raises(MapFileError, match="damaged map"):
        load_map(tmp_path / "m")


@pytest.mark.parametrize("placed", [True, False])
def test_a_window_gives_its_times_to_a_map_without_one(placed):
    earlier = made.fly(VoxelMap(settings()), made.flight(4, 8))
    rolling = make_map(settings(**WINDOW, **{"window.outside": "keep"}), earlier)
    if placed:
        made.fly(rolling, made.flight(5, 6))
    made.assert_same(make_map(settings(), rolling), rolling)
    assert np.isfinite(rolling.ages()).all()
    rolling.close()
