# SPDX-License-Identifier: Apache-2.0
"""A map keeps within the memory it was given: it refuses what does not fit, or is a window that always does."""

import subprocess
import sys
from pathlib import Path

import made_flights as made
import numpy as np
import pytest

from stereovox.config import load_config
from stereovox.errors import ConfigError, FrameRefused
from stereovox.maps import VoxelMap, load_map, make_map
from stereovox.maps.cells.evidence import Evidence, GridEvidence
from stereovox.maps.grid_map import GridMap
from stereovox.maps.storage.window import within_memory

TIMES = {"map.keep_times": True}


def settings(max_memory="200 kB", **more):
    return load_config("default", voxel_size=0.1, max_memory=max_memory, **more)


def refusal(one, evidence):
    try:
        one.storage.check_room(evidence)
    except FrameRefused as why:
        return why
    return None


def refused(one, moments):
    """Fly as a mapper does; return the frames that were refused."""
    names = []
    for i, moment in enumerate(moments):
        before = [part.tobytes() for part in made.blocks_and_times(one)]
        why = refusal(one, moment.evidence)
        if why is None:
            made.fly(one, [moment])
        else:
            assert why.reason == "memory_full"
            assert "\n" not in str(why)
            assert [part.tobytes() for part in made.blocks_and_times(one)] == before
            names.append(i)
        assert one.memory_bytes <= one.reserved_bytes <= one.config.max_memory
    return names


@pytest.mark.parametrize(
    ("rules", "max_memory"),
    [
        ({}, "200 kB"),
        ({"map.cell": "int8"}, "100 kB"),
        (TIMES, "600 kB"),
        ({**TIMES, "map.cell": "int8"}, "500 kB"),
    ],
)
def test_what_does_not_fit_is_refused_and_what_fits_is_right(rules, max_memory):
    one = make_map(settings(max_memory, **rules))
    free = load_config(voxel_size=0.1, **rules)
    moments = list(made.flight(1, 40))
    out = refused(one, moments)
    assert 0 < len(out) < 36, "it comes back to where it was"
    assert one.reserved_bytes > 0.9 * one.config.max_memory
    whole = made.fly(VoxelMap(free), [m for i, m in enumerate(moments) if i not in out])
    made.assert_same(one, whole)
    assert whole.memory_bytes > 0.4 * one.config.max_memory


@pytest.mark.parametrize(
    "window", [{}, {"window.size": [25.6, 3.2, 3.2], "when_full": "roll"}], ids=["capped", "rolling"]
)
def test_cells_that_are_forgotten_in_a_full_map_take_no_more(window):
    one = make_map(settings("3 MB", **TIMES, **{"map.forget_s": 8.0}, **window))
    coords = np.array([(x, y, z) for x in range(-16, 16) for y in range(-2, 2) for z in range(-2, 2)], np.int32)
    if not window:
        coords = np.repeat(np.arange(one.storage._most, dtype=np.int32), 3).reshape(-1, 3)
    taken, random = one.reserved_bytes, np.random.default_rng(0)
    for second in range(40):
        values = random.integers(-300, 300, (len(coords), 512)).astype(np.int16)
        values[:, : 256 * (second > 3)] = 0  # half of each block is not seen any more
        made.fly(one, [made.Moment(made.at((0, 0, 0), second * 10**9), Evidence(coords, values, coords[:0], 0))])
        assert one.reserved_bytes == taken
    assert 0 < sum(one.counts().values()) <= 256 * len(coords)


@pytest.mark.parametrize("max_memory", ["500 MB", 500_000_000])
def test_memory_is_a_number_or_text(max_memory):
    assert load_config(max_memory=max_memory).max_memory == 500_000_000


@pytest.mark.parametrize("max_memory", ["much", 0, -1, "1 XB", 10**13])
def test_what_is_no_memory_is_one_line(max_memory):
    with pytest.raises(ConfigError, match=r"^max_memory"):
        load_config(max_memory=max_memory)
    with pytest.raises(ConfigError, match="not one block"):
        make_map(load_config(max_memory=500))


@pytest.mark.parametrize(("when_full", "outside"), [("roll", "drop"), ("spill", "keep")])
@pytest.mark.parametrize("times", [{}, TIMES], ids=["cells", "times"])
def test_a_window_takes_what_there_is_and_no_more(when_full, outside, times):
    one = make_map(settings("200 MB", when_full=when_full, **times))
    assert 0.6 * 200e6 < one.reserved_bytes <= 200e6
    assert one.storage._settings.window.outside == outside
    one.storage.set_viewpoint(made.at((3, 3, 3)))
    wide, deep, high = np.diff(one.window, axis=0)[0]
    assert wide == deep >= 2 * (5.0 + 1.0)
    assert high >= 5.0 + 2 * 1.0
    larger = make_map(settings("250 MB", when_full=when_full, **times))
    assert larger.reserved_bytes > one.reserved_bytes
    one.close()
    larger.close()


def test_a_window_that_cannot_be_is_one_line_with_its_cure():
    with pytest.raises(ConfigError, match=r"covers the view needs .* allow more, or set a smaller max_range"):
        make_map(settings("1 MB", when_full="roll"))
    with pytest.raises(ConfigError, match=r"window of 20 x 20 x 20 m .* more than 1 MB; allow more max_memory"):
        make_map(settings("1 MB", **{"window.size": [20, 20, 20]}))
    with pytest.raises(ConfigError, match='only be "refuse"'):
        load_config("ist2019", max_memory="1 MB", when_full="roll")


@pytest.mark.parametrize("when_full", ["refuse", "roll", "spill"])
def test_a_run_goes_on_where_it_was(tmp_path, when_full):
    config = settings("600 kB" if when_full == "refuse" else "60 MB", max_range=1.0, when_full=when_full, **TIMES)
    moments = list(made.flight(2, 30))
    whole, half = make_map(config), make_map(config)
    out = refused(whole, moments), [*refused(half, moments[:15])]
    half.save(tmp_path / "m")
    again = make_map(config, load_map(tmp_path / "m"))
    assert [*out[1], *(15 + i for i in refused(again, moments[15:]))] == out[0]
    made.assert_same(again, whole)
    for one in (whole, half, again):
        one.close()


def test_a_map_that_is_larger_does_not_go_on_but_one_without_bounds_takes_it():
    earlier = made.fly(VoxelMap(load_config(voxel_size=0.1)), made.flight(3, 30))
    with pytest.raises(ConfigError, match="more memory than max_memory 50 kB; allow more"):
        make_map(settings("50 kB"), earlier)
    capped = make_map(settings("20 MB"), earlier)
    made.assert_same(capped, earlier)
    made.assert_same(make_map(load_config(voxel_size=0.1), capped), earlier)


def test_a_grid_refuses_what_does_not_fit():
    one = GridMap(load_config("ist2019", max_memory="1 MB"))
    for n in range(200):
        evidence = GridEvidence(np.array([[n, 0, 0]], np.int32), np.full((1, 4096), 300, np.int16))
        if why := refusal(one, evidence):
            assert why.reason == "memory_full"
            break
        one.add(evidence)
    assert 20 < n < 199
    pool = one.storage._pool
    assert pool.values.nbytes + pool.coords.nbytes + pool.table.nbytes < 1e6
    one.storage.check_room(
        GridEvidence(np.array([[0, 0, 0], [999, 0, 0]], np.int32), np.full((2, 4096), [[9], [0]], np.int16))
    )


LONG_FLIGHT = """
import resource, sys
import made_flights as made
import numpy as np
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.maps import VoxelMap, make_map
from stereovox.maps.cells.evidence import Evidence

def moments(frames):
    random = np.random.default_rng(0)
    around = np.argwhere(np.ones((8, 8, 8), bool)).astype(np.int32)
    values = random.integers(-900, 900, (512, 512)).astype(np.int16)
    for i in range(frames):
        yield made.at((0.32 * i, 0, 0), i * 10**8), Evidence(around + np.array([4 * i, 0, 0], np.int32), values,
                                                             np.empty((0, 3), np.int32), 0)

config = load_config(voxel_size=0.01, max_range=0.5, max_memory="40 MB", when_full=sys.argv[1],
                     **{"map.keep_times": True, "window.trigger": 0.1})
made.fly(VoxelMap(load_config(config, max_memory=None, when_full="refuse")), moments(2))  # kernels are loaded
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
address_space = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (address_space + 150_000_000,) * 2)
before, one, refused = peak(), make_map(config), 0
for moment in moments(400):
    try:
        made.fly(one, [moment])
    except FrameRefused:
        refused += 1
assert peak() - before < 60e6, peak() - before
if sys.argv[1] == "refuse":
    assert refused > 300, refused
    assert len(one.storage._pool) > 10_000
    plain = load_config(config, max_memory=None, when_full="refuse", **{"map.keep_times": False})
    whole = made.fly(VoxelMap(plain), moments(one.frames))
    for a, b in zip(one.storage.slabs(), whole.storage.slabs()):
        assert all((x == y).all() for x, y in zip(a, b))
else:
    assert refused == 0
one.close()
print("survived", refused)
"""


@pytest.mark.parametrize("when_full", ["refuse", "roll"])
def test_a_long_flight_survives_under_a_limit_of_the_system(when_full):
    """Without `max_memory` it would need 3 KB for each of 100,000 blocks."""
    command = [sys.executable, "-c", LONG_FLIGHT, when_full]
    done = subprocess.run(
        command, cwd=Path(__file__).parents[2] / "helpers", capture_output=True, text=True, check=False
    )
    assert done.stdout.startswith("survived"), done.stderr


def test_the_memory_that_is_told_is_enough():
    for max_range in np.arange(0.5, 8, 0.3):
        with pytest.raises(ConfigError) as refused:
            within_memory(settings("100 kB", when_full="roll", max_range=max_range))
        enough = str(refused.value).split("needs ")[1].split(";")[0]
        assert within_memory(settings(enough, when_full="roll", max_range=max_range)).window.size


@pytest.mark.parametrize("when_full", ["roll", "spill"])
def test_what_happens_when_full_needs_a_size(when_full):
    with pytest.raises(ConfigError, match=f'when_full "{when_full}" needs max_memory'):
        load_config(when_full=when_full)
