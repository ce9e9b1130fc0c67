# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.maps import State, VoxelMap
from stereovox.products.path_check import check_path, point_along

FREE, TENTATIVE, OCCUPIED = -3.0, -1.5, 2.0


def corridor(changes, **settings):
    """Cells of 0.1 m, free from -1 to 3 m along x and 1 m aside, but for `changes`: cell -> log-odds, or None."""
    cells = {tuple(cell): FREE for cell in (np.indices((40, 20, 20)).reshape(3, -1).T - [10, 10, 10]).tolist()}
    cells.update(changes)
    known = {cell: log_odds for cell, log_odds in cells.items() if log_odds is not None}
    return VoxelMap.from_cells(load_config(voxel_size=0.1, **settings), list(known), list(known.values()))


PATH = [(0, 0, 0), (1, 0, 0), (2, 0, 0)]


def test_a_free_path_is_free_to_its_end():
    found = check_path(corridor({}), PATH, 0.3)
    assert found.free
    assert found.worst.tolist() == [State.FREE, State.FREE]
    assert found.blocked_at is None
    assert found.oldest_s is None, "the map keeps no times"


@pytest.mark.parametrize(("what", "state"), [(OCCUPIED, State.OCCUPIED), (TENTATIVE, State.TENTATIVE)])
@pytest.mark.parametrize(("y", "off"), [(0, 0.0), (2, 0.2), (-3, 0.2)])
def test_where_it_is_stopped(what, state, y, off):
    """The face of the cell stands at x = 1.5; a ball of 0.3 m touches its edge, `off` aside, that much earlier."""
    found = check_path(corridor({(15, y, 0): what}), PATH, 0.3, through_unknown=True)
    assert found.worst.tolist() == [State.FREE, state]
    assert found.blocked_at == pytest.approx(1.5 - np.sqrt(0.3**2 - off**2), abs=1e-6)
    assert not check_path(corridor({(15, y, 0): what}), PATH[::-1], 0.3).free
    np.testing.assert_allclose(point_along(PATH, found.blocked_at), [found.blocked_at, 0, 0])


def test_unknown_is_in_the_way_unless_allowed():
    voxel_map = corridor({(5, 0, 0): None, (18, 0, 0): OCCUPIED})
    found = check_path(voxel_map, PATH, 0.2)
    assert found.worst.tolist() == [State.UNKNOWN, State.OCCUPIED]
    assert found.blocked_at == pytest.approx(0.3, abs=1e-6)
    assert check_path(voxel_map, PATH, 0.2, through_unknown=True).blocked_at == pytest.approx(1.6, abs=1e-6)


def test_a_ball_that_stands_in_something_goes_nowhere():
    found = check_path(corridor({(0, 0, 0): OCCUPIED}), PATH, 0.2)
    assert found.blocked_at == 0
    assert check_path(corridor({}), [(0, 0, 0), (0, 0, 0)], 0.2).free


def test_the_oldest_evidence_is_that_of_the_cells_it_touches():
    numbers = np.random.default_rng(4)
    voxel_map = corridor({(3, 0, 0): None}, **{"map.keep_times": True})
    coords, cells = voxel_map.storage.blocks()
    times = (2**30 + numbers.integers(1, 5000, cells.shape)).astype(np.uint32)
    voxel_map.storage.set_times(coords, times, 0)
    now_ns, path = 60 * 10**9, np.array([(0, 0, 0), (1.03, 0.4, 0.2), (1.9, -0.3, 0.1)])
    found = check_path(voxel_map, path, 0.17, now_ns=now_ns)
    known, _ = voxel_map.cells()
    ages = voxel_map.age(voxel_map.centers(known), now_ns)
    for segment in range(2):
        steps = path[segment] + np.linspace(0, 1, 300)[:, None] * (path[segment + 1] - path[segment])
        low, high = known * 0.1, (known + 1) * 0.1
        away = np.array([np.linalg.norm(place - np.clip(place, low, high), axis=1) for place in steps]).min(axis=0)
        assert found.oldest_s[segment] == pytest.approx(ages[away <= 0.17].max(), abs=1e-4)
    far = check_path(voxel_map, [(-1e6, 0, 0), (1e6, 0, 0), (1e6, 5, 0)], 1e3, now_ns=now_ns)
    assert far.oldest_s[0] == pytest.approx(ages.max())
    assert np.isnan(far.oldest_s[1])
    outside = check_path(voxel_map, [(50, 0, 0), (51, 0, 0)], 0.1)
    assert np.isnan(outside.oldest_s).all()


@pytest.mark.parametrize(
    ("path", "radius", "told"),
    [([(0, 0, 0)], 0.1, "1 of them"), ([(0, 0, 0), (np.nan, 0, 0)], 0.1, "finite"), (PATH, -1, "0 m or more")],
)
def test_wrong_use_ends_in_one_line(path, radius, told):
    with pytest.raises(StereovoxError, match=told):
        check_path(corridor({}), path, radius)
