# SPDX-License-Identifier: Apache-2.0
"""The 2-D map of a node follows its map: through a reset, a load, and a load that is refused."""

from types import SimpleNamespace
from unittest.mock import patch

import numpy as np
import pytest
from made_walks import depth_at

from stereovox import VoxelMap
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.formats.map_server import write_map_server
from stereovox.maps.occupancy import UNKNOWN, OccupancyGrid
from stereovox.products.projection import project
from stereovox.ros.mapping import Mapping
from stereovox.ros.obstacles import score_of
from stereovox.ros.options import Options

STANDS = {"scan.floor": 0.0, "scan.heights": [0.1, 0.6]}
"""The walk's images show no floor: its world stands on it."""
WINDOW = {"window.size": [2.4, 2.4, 2.4], "window.trigger": 0.3, "window.outside": "keep"}


def check_grid(mapping: Mapping) -> None:
    expected, cells = project(mapping.snapshot()()).cells, mapping.grid().cells
    (bottom, left), (top, right) = (corner(np.argwhere(cells >= 0), axis=0) for corner in (np.min, np.max))
    np.testing.assert_array_equal(cells[bottom : top + 1, left : right + 1], expected)


@pytest.mark.parametrize("settings", [{}, WINDOW, {"map.keep_times": True, "map.forget_s": 0.35}])
def test_the_grid_is_that_of_the_map(tmp_path, settings):
    mapping = Mapping(load_config(voxel_size=0.1, **STANDS, **settings))
    for k in range(5):
        assert mapping.add(depth_at(k)).refused is None
        check_grid(mapping)
    mapping.save(str(tmp_path / "five.svox"))
    mapping.reset()
    assert mapping.grid() is None
    mapping.add(depth_at(12))
    check_grid(mapping)
    mapping.load(str(tmp_path / "five.svox"))
    check_grid(mapping)
    VoxelMap.from_cells(load_config(voxel_size=0.2), [[0, 0, 0]], [2.0]).save(tmp_path / "other.svox")
    with pytest.raises(StereovoxError, match="voxel_size"):
        mapping.load(str(tmp_path / "other.svox"))
    assert mapping.add(depth_at(6)).refused is None
    assert mapping.history.frames == 6
    check_grid(mapping)
    mapping.close()


def test_what_cannot_be_saved_is_one_line(tmp_path):
    mapping = Mapping(load_config(voxel_size=0.1, **STANDS))
    mapping.add(depth_at(0))
    (tmp_path / "file").touch()
    for name in ("/proc/no/map", str(tmp_path / "file/map"), str(tmp_path / ("x" * 300)), str(tmp_path / "a\0b")):
        with pytest.raises(StereovoxError):
            mapping.save(name)
    mapping.close()


def said_by_loading(path):
    said = []
    Mapping(load_config(dimensions=2, voxel_size=0.1), notify=said.append).load(path)
    return said


def said_by_scoring(path):
    said = []
    node = SimpleNamespace(get_logger=lambda: SimpleNamespace(warning=said.append))
    with patch("stereovox.ros.obstacles.Score"):
        score_of(node, None, Options(reference=path))
    return said


@pytest.mark.parametrize("door", [said_by_loading, said_by_scoring])
@pytest.mark.parametrize("free_thresh", ["0.25", "0.196"])
def test_unknown_cells_that_a_file_makes_free_are_reported(door, free_thresh, tmp_path):
    file, cells = tmp_path / "map.yaml", np.zeros((10, 10), np.int8)
    cells[0, :3], cells[5, 5] = UNKNOWN, 100
    write_map_server(OccupancyGrid(cells, 0.1), file)
    text = file.read_text()
    assert "free_thresh: 0.196" in text
    file.write_text(text.replace("free_thresh: 0.196", f"free_thresh: {free_thresh}"))
    assert ("grey 205" in str(door(str(file)))) == (free_thresh == "0.25")
