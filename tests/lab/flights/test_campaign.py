# SPDX-License-Identifier: Apache-2.0
"""Missions in several scenes: what comes of them is the same whatever the processes, and mistakes are one line."""

import numpy as np
import pytest

import stereovox as sv
from stereovox.errors import StereovoxError
from stereovox_lab import Cruise, explore
from stereovox_lab.flights.campaign import summary

SHORT = Cruise(seconds=12.0, camera_hz=5.0)


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    folder, steps = tmp_path_factory.mktemp("maps") / "new", []
    result = explore(["sim:hall?plan={seed}"], seeds=[4, 5], cruise=SHORT, maps=folder,
                        progress=lambda *step: steps.append(step))  # fmt: skip
    return result, folder, steps


def test_every_flight_is_told(told):
    result, _, steps = told
    assert [flight["seed"] for flight in result["flights"]] == [4, 5]
    assert [step[:2] for step in steps] == [(1, 2), (2, 2)]
    first, second = result["flights"]
    assert first["place"] != second["place"]
    for flight in result["flights"]:
        assert flight["coverage"][0] == [0.0, 0.0]
        assert 0.2 < flight["coverage"][-1][1] < 1
        assert flight["collided_s"] is None
        assert 0 < flight["room_m"] <= flight["most_room_m"]
        assert len(flight["path"]) == 12
        ways = np.linalg.norm(np.diff(flight["path"], axis=0), axis=1).sum()
        assert ways <= flight["metres"] + 0.05


def test_the_first_map_is_kept(told):
    result, folder, _ = told
    assert result["maps"] == [str(folder / "scene1.svox")]
    voxel_map = sv.load_map(result["maps"][0])
    assert voxel_map.state([result["flights"][0]["place"]])[0] != sv.State.OCCUPIED
    assert voxel_map.config.voxel_size == SHORT.voxel_size


def test_processes_change_nothing():
    scenes, cruise = ["sim:hall?plan={seed}"], Cruise(seconds=1.5, camera_hz=4.0)
    one, two = (explore(scenes, seeds=[4, 5], cruise=cruise, jobs=jobs) for jobs in (1, 2))
    assert one == two
    assert one["flights"][0]["coverage"][-1][1] > 0


def row(scene="a", seconds=30.0, collided=None, last=0.9, clearance=0.4):
    coverage = [[0.0, 0.0], [10.0, 0.6], [seconds, last]]
    return {"scene": scene, "seconds": seconds, "collided_s": collided, "done": collided is None, "metres": 10.0,
            "goals": 3, "clearance_m": clearance, "coverage": coverage, "room_m": 1.0, "most_room_m": 2.0,
            "left": {"no way to it": 2} if collided is None else {}}  # fmt: skip


def test_summaries_count_their_own_scene_and_its_collisions():
    rows = [row(), row(seconds=50.0), row(collided=20.0, last=0.7, clearance=0.2), row("b", last=0.65)]
    one, other = summary("a", rows), summary("b", rows)
    assert (one["flights"], one["collisions"], one["done"], one["metres"]) == (3, 1, 2, 30.0)
    assert (one["coverage_median"], one["coverage_least"], one["clearance_least_m"]) == (0.9, 0.7, 0.2)
    assert one["seconds_to_share"] == {"0.5": 10.0, "0.7": 30.0, "0.8": 50.0, "0.9": 50.0}
    assert (other["flights"], other["seconds_to_share"]["0.8"]) == (1, None)


@pytest.mark.parametrize(
    ("given", "complaint"),
    [
        ({"mission": "frontier"}, "unknown mission 'frontier' .did you mean 'frontiers'"),
        ({"seeds": []}, "seeds"),
        ({"seeds": [1, 1]}, "each once"),
        ({"seeds": [-1]}, "from 0 on"),
        ({"jobs": 0}, "jobs 0"),
        ({"scenes": []}, "scenes"),
        ({"scenes": "sim:room"}, "give a list"),
        ({"scenes": ["drive"]}, "drive: missions are flown in simulations"),
        ({"scenes": ["sim:nowhere"]}, "unknown scene .nowhere"),
        ({"scenes": ["sim:hall?plan={number}"]}, "only {seed}"),
        ({"scenes": ["sim:room?axes=optical"]}, "z is not up"),
        ({"cruise": Cruise(speed=0)}, "speed 0"),
        ({"cruise": Cruise(voxel_size=float("nan"))}, "voxel_size nan"),
        ({"cruise": Cruise(margin=-0.1)}, "margin -0.1"),
    ],
)
def test_mistakes_are_one_line(given, complaint):
    with pytest.raises(StereovoxError, match=complaint):
        explore(**given)
