# SPDX-License-Identifier: Apache-2.0
"""As a script: four threads add to one map, others ask, look and save; what each gets is the map after some frame."""

import hashlib
import sys
import tempfile
import threading
from pathlib import Path

import numpy as np

import stereovox as sv
from stereovox.geometry import se2
from stereovox.mapper import GridMapper
from stereovox.maps.grid_map import load_grid
from stereovox.products.distance import DistanceField
from stereovox.products.projection import LiveProjection, project

SENSORS = 4
CAMERA = sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.05)
MAPS = {
    "space": {},
    "times": {"map.keep_times": True, "map.forget_s": 1.0},
    "capped": {"max_memory": "64M"},
    "tiles": {"window.size": [4, 4, 3], "window.trigger": 0.3, "window.outside": "keep"},
}


MOVING = {"trust.frozen": False, "trust.max_disagreement": 1}


def frames_of(sensor, number):
    """A camera that turns and walks before walls and things at random depths; every seventh frame has a fault.

    The wall moves with it, as in a frozen image, so maps that take all frames need MOVING.
    """
    chance = np.random.default_rng(sensor)
    for k in range(number):
        depth = np.full((60, 80), 3.0, np.float32) + chance.normal(0, 0.01, (60, 80)).astype(np.float32)
        row, column = chance.integers(0, 40, 2)
        depth[row : row + 20, column : column + 20] = chance.uniform(0.8, 2.5)
        yaw = 0.05 * k + sensor * np.pi / 2
        T = se2.lifted([0.05 * k - 1, 0.3 * sensor, yaw]) @ np.array(
            [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]]
        )
        fault = "unreadable" if k % 7 == 5 else None
        yield sv.Frame(depth, CAMERA, T, stamp_ns=100_000_000 * k + sensor, sensor=f"camera {sensor}", fault=fault)


def scans_of(sensor, number):
    chance = np.random.default_rng(sensor)
    for k in range(number):
        ranges = np.repeat(chance.uniform(0.5, 4, 9), 10).astype(np.float32)
        ranges += chance.normal(0, 0.002, 90).astype(np.float32)
        pose = se2.lifted([0.05 * k, sensor, 0.1 * k])
        fault = "unreadable" if k % 7 == 5 else None
        yield sv.Scan(
            ranges, -np.pi, np.pi / 45, 0.1, 5.6, pose, stamp_ns=100_000_000 * k + sensor,
            sensor=f"lidar {sensor}", fault=fault,
        )  # fmt: skip


def digest(*arrays):
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()


def cells_of(one):
    return digest(*(one.storage.tiles() if hasattr(one.storage, "tiles") else one.storage.blocks()))


def at_work(workers, others):
    """Run the workers to their end, the others again and again meanwhile; return how often, raise what went wrong."""
    done, slips, rounds = threading.Event(), [], dict.fromkeys(others, 0)

    def work(worker):
        try:
            worker()
        except BaseException as error:
            slips.append(error)

    def again(name):
        while not done.wait(0.001) or not rounds[name]:
            others[name]()
            rounds[name] += 1

    adding = [threading.Thread(target=work, args=(worker,)) for worker in workers]
    asking = [threading.Thread(target=work, args=(lambda name=name: again(name),)) for name in others]
    for thread in asking + adding:
        thread.start()
    for thread in adding:
        thread.join()
    done.set()
    for thread in asking:
        thread.join()
    if slips:
        raise slips[0]
    return rounds


def check(make, frames, points, load, ask, look=lambda mapper: ({}, lambda: None)):
    """Let threads loose on one mapper, and see that all any of them got is a state between two frames."""
    mapper, mine, order, states, answers = make(), threading.local(), [], [], []
    add, empty = mapper.map.add, (cells_of(mapper.map), set(ask(mapper.map, points)))

    def noted(evidence):
        changed = add(evidence)
        order.append(mine.frame)
        states.append(cells_of(mapper.map))
        answers.extend(ask(mapper.map, points))
        return changed

    mapper.map.add = noted

    def add_all(some):
        for mine.frame in some:
            assert mapper.add(mine.frame).refused == mine.frame.fault

    found, asked, saved = [], [], []

    def save():
        with tempfile.TemporaryDirectory() as folder:
            mapper.map.save(Path(folder) / "map.npz")
            one = load(Path(folder) / "map.npz")
            saved.append((one.frames, cells_of(one)))

    more, at_the_end = look(mapper)
    others = {
        "look": lambda: found.append(cells_of(mapper.map)),
        "ask": lambda: asked.extend(ask(mapper.map, points)),
        "ask more": lambda: (asked.extend(ask(mapper.map, points)), mapper.health(), mapper.map.counts()),
        "save": save,
        **more,
    }
    rounds = at_work([lambda some=some: add_all(some) for some in frames], others)
    whole = [one for some in frames for one in some]
    assert len(order) == mapper.map.frames == sum(not one.fault for one in whole)
    assert mapper.map.history.refused == {"unreadable": sum(bool(one.fault) for one in whole)}
    assert set(found) <= {empty[0], *states}, "a reader met a map that never was"
    assert set(asked) <= empty[1] | set(answers), "a query met a map that never was"
    assert set(saved) <= {(0, empty[0]), *((n, state) for n, state in enumerate(states, 1))}, "saved what never was"
    at_the_end()
    one_thread = make()
    for frame, state in zip(order, states, strict=True):
        one_thread.add(frame)
        assert cells_of(one_thread.map) == state, "the map is not that of its frames"
    for one in (mapper, one_thread):
        if hasattr(one.map, "close"):
            one.map.close()
    return rounds


def products(mapper):
    """A field of distances that one thread updates and another one asks, and a live view from above."""
    field, above = (
        DistanceField(mapper.map, (-3, -3, -1), (3, 3, 1), max_distance=1.0),
        LiveProjection(mapper.map, floor=-2.0),
    )
    somewhere = np.random.default_rng(1).uniform(-2, 2, (2000, 3))
    updated, asked = [digest(field.gradient(somewhere))], []

    def update():
        field.update()
        updated.append(digest(field.gradient(somewhere)))
        above.grid()

    def at_the_end():
        assert set(asked) <= set(updated), "a distance was that of half an update"
        update()
        anew = DistanceField(mapper.map, (-3, -3, -1), (3, 3, 1), max_distance=1.0)
        assert np.array_equal(field.metres, anew.metres)
        shown, expected = above.grid(), LiveProjection(mapper.map, floor=-2.0).grid()
        assert np.array_equal(shown.cells, expected.cells)

    return {
        "update": update,
        "distance": lambda: asked.append(digest(field.gradient(somewhere))),
        "project": lambda: mapper.map.frames and project(mapper.map, (0.0, 4.0), floor=-2.0),
    }, at_the_end


def in_space(settings, number):
    def ask(one, points):
        yield digest(one.log_odds(points))
        yield digest(one.check_boxes(points, points + 0.3))
        yield digest(one.nearest_obstacle(points, 1)[0])

    frames = [list(frames_of(sensor, number)) for sensor in range(SENSORS)]
    points = np.random.default_rng(0).uniform(-3, 3, (200, 3))
    return check(
        lambda: sv.Mapper(voxel_size=0.1, threads=2, **settings, **MOVING), frames, points, sv.load_map, ask, products
    )


def on_a_floor(number):
    def ask(one, points):
        yield digest(one.log_odds(points))
        yield digest(one.occupancy().cells)

    frames = [list(scans_of(sensor, number)) for sensor in range(SENSORS)]
    points = np.random.default_rng(0).uniform(-3, 3, (200, 2))
    return check(lambda: GridMapper(voxel_size=0.05, **MOVING), frames, points, load_grid, ask)


def many_mappers(number):
    """Several mappers with threads of their own, each in a thread: their maps are those of one after the other."""
    frames = [list(frames_of(sensor, number)) for sensor in range(SENSORS)]

    def run(some):
        mapper = sv.Mapper(voxel_size=0.05, threads=2, **MOVING)
        for frame in some:
            mapper.add(frame)
        return cells_of(mapper.map)

    expected, found = [run(some) for some in frames], {}
    at_work([lambda n=n: found.update({n: run(frames[n])}) for n in range(SENSORS)], {})
    assert [found[n] for n in range(SENSORS)] == expected


if __name__ == "__main__":
    sys.setswitchinterval(2e-5)
    for name, settings in MAPS.items():
        print(name, in_space(settings, 6 if name == "tiles" else 15), flush=True)
    print("floor", on_a_floor(20), flush=True)
    many_mappers(8)
