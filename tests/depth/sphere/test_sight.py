# SPDX-License-Identifier: Apache-2.0
"""How far one may fly: never further than anything in the cone, never where nobody has looked."""

import numpy as np
import pytest

from stereovox.config import SphereConfig
from stereovox.depth.sphere import SphereLayout, empty, gather, range_in, sight_of, stitch, surroundings
from stereovox.errors import StereovoxError
from stereovox.frame import Reason

STEP = 5


def bubble(radius=4.0, stamp_ns=10):
    """A grid whose every cell is a surface at `radius`."""
    layout = SphereLayout.of(STEP)
    return gather(radius * layout.directions().reshape(-1, 3), stamp_ns, SphereConfig(step_deg=STEP), layout)


def test_one_direction_is_its_cell():
    near = gather([[1.5, 0.02, 0.02]], 30, SphereConfig(step_deg=STEP))
    grid = stitch([bubble(), near])
    ahead = range_in(grid, (3, 0.05, 0.05))
    assert ahead is not None
    assert ahead.range_m == pytest.approx(1.5, rel=1e-3)
    assert (ahead.stamp_ns, ahead.surface, ahead.seen) == (30, True, 1.0)
    assert ahead.age_s(1_000_000_030) == pytest.approx(1.0)
    aside = range_in(grid, (0, 1, 0))
    assert aside is not None
    assert (aside.range_m, aside.stamp_ns) == (pytest.approx(4.0), 10)


@pytest.mark.parametrize("half_angle", [0.0, 3.0, 20.0, 75.0, 180.0])
def test_a_cone_holds_every_cell_that_it_touches(half_angle):
    """Against dense sampling of the cone: no sampled direction is nearer than what the cone answers."""
    random = np.random.default_rng(2)
    layout = SphereLayout.of(STEP)
    grid = gather(
        layout.directions().reshape(-1, 3) * random.uniform(1, 9, (layout.azimuths * layout.polars, 1)),
        1, SphereConfig(step_deg=STEP), layout,
    )  # fmt: skip
    for axis in [*random.normal(size=(20, 3)).tolist(), [0, 0, 1], [0, 0, -1], [-1, 0, 0]]:
        sight = range_in(grid, axis, half_angle)
        assert sight is not None
        unit = np.array(axis) / np.linalg.norm(axis)
        samples = random.normal(size=(4000, 3)) * (0.02 if half_angle < 10 else 1) + unit
        samples /= np.linalg.norm(samples, axis=1, keepdims=True)
        inside = np.degrees(np.arccos(np.clip(samples @ unit, -1, 1))) <= half_angle
        sampled = np.concatenate([samples[inside], unit[None]])
        ranges = grid.range_m.ravel()[layout.cells_of(sampled)]
        assert sight.range_m <= ranges.min() + 1e-6
        if half_angle == 180:
            assert sight.range_m == pytest.approx(float(grid.range_m.min()))


def test_unknown_is_never_free():
    grid = bubble()
    place = np.unravel_index(grid.layout.cells_of([[1, 0.02, 0.02]])[0], grid.layout.shape)
    for values, nothing in ((grid.range_m, np.nan), (grid.reason, Reason.UNKNOWN)):
        values[place] = nothing
    grid.stamp_ns[place] = empty(grid.layout).stamp_ns[place]
    assert range_in(grid, (1, 0.02, 0.02)) is None
    assert range_in(grid, (1, 0.2, 0.2), 20) is None  # one cell of the cone is enough
    assert range_in(grid, (0, 1, 0), 20) is not None
    sight = sight_of(grid, (1, 0.2, 0.2), 20)
    assert sight is not None
    assert 0.9 < sight.seen < 1
    assert range_in(grid, (1, 0.2, 0.2), 20, unseen=0.1) == sight
    assert sight_of(grid, (1, 0.02, 0.02)) is None


def test_outside_of_the_grid_is_unknown():
    layout = SphereLayout.of(STEP, (60, 120), (-45, 45))
    grid = gather(2 * layout.directions().reshape(-1, 3), 1, SphereConfig(step_deg=STEP), layout)
    assert range_in(grid, (1, 0, 0), 20) is not None
    assert range_in(grid, (1, 1, 0), 20) is None
    assert range_in(grid, (0, 0, 1)) is None
    half = sight_of(grid, (np.cos(np.pi / 4), np.sin(np.pi / 4), 0), 20)
    assert half is not None
    assert half.seen == pytest.approx(0.5, abs=0.1)
    assert surroundings(grid, 20)["back"] is None


def test_free_and_too_near():
    grid = bubble()
    grid.reason[:] = Reason.TOO_FAR
    free = range_in(grid, (0, 1, 0), 10)
    assert free is not None
    assert (free.surface, free.range_m) == (False, pytest.approx(4.0))
    place = np.unravel_index(grid.layout.cells_of([[0, 1, 0.05]])[0], grid.layout.shape)
    grid.reason[place], grid.range_m[place] = Reason.TOO_NEAR, 0
    blocked = range_in(grid, (0, 1, 0), 10)
    assert blocked is not None
    assert (blocked.surface, blocked.range_m) == (True, 0.0)


def test_the_oldest_is_told():
    young, old = bubble(4.0, stamp_ns=100), gather([[3.0, 0.3, 0.1]], 20, SphereConfig(step_deg=STEP))
    young.stamp_ns[0] = 5
    sight = range_in(stitch([young, old]), (1, 0, 0), 180)
    assert sight is not None
    assert (sight.stamp_ns, sight.oldest_ns) == (20, 5)


@pytest.mark.parametrize(
    ("direction", "angle", "message"),
    [
        ((0, 0, 0), 0, "not all zero"),
        ((1, 0), 0, "three"),
        ((np.nan, 0, 1), 0, "finite"),
        ((1, 0, 0), 200, "half angle"),
    ],
)
def test_nonsense_is_refused(direction, angle, message):
    with pytest.raises(StereovoxError, match=message):
        range_in(bubble(), direction, angle)
