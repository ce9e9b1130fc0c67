"""Ways at one height in small made halls, and the middle of a room."""

import numpy as np
import pytest
from made_halls import hall

from stereovox import LevelPlanner, State, StereovoxError, VoxelMap, Waypoints, load_config

WALL = ((0.9, -3, -1), (1.1, 0.5, 1))
"""From one side of a hall of 3 m each way to beyond its middle: the way round is at y above 0.5."""


def test_ways_go_round_and_touch_only_what_is_free():
    voxel_map = hall(occupied=[WALL], size=3.0)
    ways = LevelPlanner(voxel_map, (0, 0, 0), 0.3)
    way = ways.path_to((2, 0, 0))
    assert way[0].tolist() == [0, 0, 0]
    assert way[-1] == pytest.approx([2, 0, 0], abs=0.1)
    assert way[:, 1].max() > 0.75
    assert (voxel_map.check_capsules(way[:-1], way[1:], 0.3) == State.FREE).all()
    assert 2.4 < np.linalg.norm(np.diff(way, axis=0), axis=1).sum() < 4.5


@pytest.mark.parametrize("what", ["occupied", "unknown", "tentative"])
def test_what_is_not_free_is_a_wall(what):
    closed = ((0.9, -3, -1), (1.1, 3, 1))
    voxel_map = hall(**{what: [closed]}, size=3.0)
    assert LevelPlanner(voxel_map, (0, 0, 0), 0.3).path_to((2, 0, 0)) is None


def test_gaps_are_as_wide_as_the_ball():
    gap = [((0.9, -3, -1), (1.1, -0.5, 1)), ((0.9, 0.5, -1), (1.1, 3, 1))]
    voxel_map = hall(occupied=gap, size=3.0)
    assert LevelPlanner(voxel_map, (0, 0, 0), 0.3).path_to((2, 0, 0)) is not None
    assert LevelPlanner(voxel_map, (0, 0, 0), 0.55).path_to((2, 0, 0)) is None


def test_heights_out_of_the_band_do_not_count():
    beam = ((0.9, -3, 0.5), (1.1, 3, 1))
    voxel_map = hall(occupied=[beam], size=3.0)
    assert LevelPlanner(voxel_map, (0, 0, 0), 0.3, half_height=0.3).path_to((2, 0, 0)) is not None
    assert LevelPlanner(voxel_map, (0, 0, 0.3), 0.3, half_height=0.3).path_to((2, 0, 0)) is None


def test_the_own_place_may_be_unknown_but_not_occupied():
    about = ((-0.4, -0.4, -1), (0.4, 0.4, 1))
    unseen = hall(unknown=[about], size=3.0)
    assert LevelPlanner(unseen, (0, 0, 0), 0.3).path_to((2, 0, 0)) is None
    assert LevelPlanner(unseen, (0, 0, 0), 0.3, own_radius=0.7).path_to((2, 0, 0)) is not None
    blocked = hall(occupied=[about], size=3.0)
    assert LevelPlanner(blocked, (0, 0, 0), 0.3, own_radius=0.7).path_to((2, 0, 0)) is None


def test_the_middle_has_the_most_room():
    voxel_map = hall(occupied=[WALL], size=3.0)
    place, room = LevelPlanner(voxel_map, (-2, -2, 0), 0.3).middle()
    assert room == pytest.approx(1.9, abs=0.2)
    assert place[0] == pytest.approx(-1.05, abs=0.3)
    assert voxel_map.nearest_obstacle(place).distance[0] >= room
    assert min(3 - np.abs(place[:2])) >= room


def test_the_middle_of_another_room_does_not_count():
    closed = ((-0.1, -3, -1), (0.1, 3, 1))
    place, _ = LevelPlanner(hall(occupied=[closed], size=3.0), (1.5, 2, 0), 0.3).middle()
    assert place[0] > 0
    assert LevelPlanner(hall(size=3.0), (50, 0, 0), 0.3).middle() is None


def test_bad_values_are_refused():
    with pytest.raises(StereovoxError, match="not empty"):
        LevelPlanner(VoxelMap(load_config()), (0, 0, 0), 0.3)
    with pytest.raises(StereovoxError, match="give metres"):
        LevelPlanner(hall(size=1.0), (0, 0, 0), -1)
    with pytest.raises(StereovoxError, match="give a point"):
        LevelPlanner(hall(size=1.0), (0, np.nan, 0), 0.3)
    with pytest.raises(StereovoxError, match="--level"):
        LevelPlanner(hall(size=1.0, up="y"), (0, 0, 0), 0.3)


def fly(voxel_map_of, tour, start=(0.0, 0.0, 0.0), flown=1.0):
    """Fly a tour in maps that grow with the calls; return where paths ended. flown: share of each path."""
    here, ends = np.array(start), []
    for k in range(60):
        voxel_map = voxel_map_of(k, here)
        found = tour.next(voxel_map, LevelPlanner(voxel_map, here, 0.3))
        if found is None:
            return ends
        path, look_at = found
        assert look_at.shape == (3,)
        assert (voxel_map.check_capsules(path[:-1], path[1:], 0.3) == State.FREE).all()
        here = path[int(flown * (len(path) - 1))]
        ends.append(here)
    raise AssertionError("the tour does not end")


def test_a_tour_visits_its_places_in_order_and_returns():
    voxel_map = hall(occupied=[WALL], size=3.0)
    tour = Waypoints([[2, -2, 9.0], [2, 2, 0], [-2, 1, 0]])
    ends = fly(lambda k, here: voxel_map, tour)
    assert tour.reached == [True, True, True]
    assert tour.is_home
    assert tour.left == {}
    for end, goal in zip(ends, [(2, -2), (2, 2), (-2, 1), (0, 0)], strict=True):
        np.testing.assert_allclose(end[:2], goal, atol=0.3)
    stays = Waypoints([[2, -2]], home=False)
    assert len(fly(lambda k, here: voxel_map, stays)) == 1
    assert not stays.is_home


def test_a_place_behind_a_wall_is_given_up_and_the_tour_goes_on():
    closed = ((0.9, -3, -1), (1.1, 3, 1))
    tour = Waypoints([[2, 0], [-2, -1]])
    fly(lambda k, here: hall(occupied=[closed], size=3.0), tour)
    assert tour.reached == [False, True]
    assert tour.is_home
    assert tour.left == {"no path to it": 1}


def test_a_place_that_is_not_known_yet_is_approached_as_the_map_grows():
    """Two metres around the vehicle are known more with each call; a wall on the straight line has to be passed."""
    behind = ((2.0, -1.0, -1), (2.2, 3, 1))

    def grown(k, here):
        far = max(1.0, here[0] + 1.5)
        return hall(occupied=[behind], unknown=[((far, -5, -1), (5, 5, 1))], size=5.0)

    tour = Waypoints([[4, 1]])
    ends = fly(grown, tour)
    assert tour.reached == [True]
    assert tour.is_home
    assert len(ends) > 3


def test_paths_that_are_always_abandoned_are_not_tried_for_ever():
    tour = Waypoints([[2, 0]])
    ends = fly(lambda k, here: hall(size=3.0), tour, flown=0.0)
    assert tour.reached == [False]
    assert tour.left == {"paths to it abandoned": 1}
    assert tour.is_home  # it never left
    assert len(ends) == 3


@pytest.mark.parametrize(
    ("places", "near"),
    [([1, 2], 0.3), ([[1, 2], [1]], 0.3), (None, 0.3), ([[1, np.nan]], 0.3), ([[1, 2, 3, 4]], 0.3), ([[1, 2]], 0)],
)
def test_tours_that_make_no_sense_are_refused(places, near):
    with pytest.raises(StereovoxError, match="give"):
        Waypoints(places, near)
