# SPDX-License-Identifier: Apache-2.0
"""The page about missions shows every flight, and collisions first of all."""

import json

import pytest

from stereovox_lab.flights.campaign import summary
from stereovox_lab.report.missions import HEADS, rows_of, write_missions


@pytest.fixture
def result():
    def flight(seed, collided):
        return {"scene": "sim:hall", "seed": seed, "seconds": 20.0, "collided_s": collided, "done": collided is None,
                "metres": 7.5, "goals": 2, "clearance_m": 0.24, "coverage": [[0.0, 0.0], [20.0, 0.51]],
                "room_m": 1.25, "most_room_m": 2.0,
                "left": {"no way to it": 2, "seen from nowhere": 0} if collided is None else {}}  # fmt: skip

    flights = [flight(0, None), flight(1, 20.0)]
    return {"mission": "frontiers", "settings": {"speed": 0.6}, "maps": [], "flights": flights,
            "scenes": [summary("sim:hall", flights)]}  # fmt: skip


def test_rows_match_their_heads(result):
    told = dict(zip(HEADS, rows_of(result)[0], strict=True))
    assert (told["flights"], told["collisions"], told["ended by itself"]) == ("2", "1", "1")
    assert (told["air known: median"], told["50 % known after, s"], told["80 % known after, s"]) == ("51.0%", "20", "-")


def test_the_page_and_its_files(result, tmp_path):
    files = write_missions(tmp_path / "new", result)
    page = (tmp_path / "new/explore.html").read_text()
    assert "<b>1</b><span>collisions</span>" in page
    assert "<td>20.0</td>" in page  # when it collided
    assert json.loads((tmp_path / "new/explore.json").read_text()) == result
    assert (tmp_path / "new/coverage.png").read_bytes().startswith(b"\x89PNG")
    assert set(files) == {"html", "json", "png"}
