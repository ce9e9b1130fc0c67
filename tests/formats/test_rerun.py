# SPDX-License-Identifier: Apache-2.0
"""Recordings for the Rerun viewer hold the cells, the path, and each frame; a run that is stopped keeps them."""

import sys

import made_along as made
import numpy as np
import pytest

import stereovox as sv
from stereovox.cli import main
from stereovox.cli.look.live_page import rerun_of
from stereovox.errors import MissingExtra
from stereovox.formats import export
from stereovox.frame import UpdateReport

SOURCE = made.Along()


@pytest.fixture(scope="module")
def mapper():
    one = sv.Mapper(voxel_size=0.2, max_range=4.0)
    for i in range(4):
        one.add(SOURCE.frame(i))
    return one


def chunks(path):
    """All rows of a recording: by place in it, a list of tables, the times when they were written left out."""
    reader = pytest.importorskip("rerun.chunk").RrdReader(str(path))
    found = {}
    for chunk in reader.stream():
        found.setdefault(chunk.entity_path, []).append(_values(chunk.to_record_batch()))
    return found


def _values(table):
    return {name: table[name].to_pylist() for name in table.column_names if ":" in name}


def column(tables, name):
    return [value for table in tables for key, values in table.items() if key.endswith(name) for value in values]


def test_a_map_becomes_boxes_a_path_and_cameras(mapper, tmp_path):
    pytest.importorskip("rerun")
    export(mapper.map, tmp_path / "map.rrd")
    found = chunks(tmp_path / "map.rrd")
    centres = np.array(column(found["/world/occupied"], "Boxes3D:centers")[0])
    assert np.allclose(centres, mapper.map.occupied(), atol=1e-5)
    assert np.allclose(column(found["/world/occupied"], "Boxes3D:half_sizes")[0], 0.1)
    way = np.array(column(found["/world/path"], "LineStrips3D:strips")[0][0])
    assert np.allclose(way[:, 0], [0, 0.2, 0.4, 0.6])
    assert len(column(found["/world/camera"], "Transform3D:translation")) == 4


def test_frames_are_written_as_they_come_also_when_the_run_is_stopped(mapper, tmp_path):
    pytest.importorskip("rerun")

    def stopped():
        with rerun_of(mapper, str(tmp_path / "run.rrd")) as log:
            for i in range(3):
                log.after(SOURCE.frame(i), UpdateReport())
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        stopped()
    found = chunks(tmp_path / "run.rrd")
    assert len(column(found["/world/camera/depth"], "DepthImage:buffer")) == 3
    assert column(found["/world/occupied"], "Boxes3D:centers")


def test_clouds_are_written_as_points_in_the_world(mapper, tmp_path):
    pytest.importorskip("rerun")
    T = np.eye(4)
    T[:3, 3] = 1, 2, 3
    with rerun_of(mapper, str(tmp_path / "run.rrd")) as log:
        log.after(sv.Cloud(np.array([[2.0, 0, 0], [0, 3.0, 0], [np.nan] * 3]), T), UpdateReport())
    found = chunks(tmp_path / "run.rrd")
    points = np.array(column(found["/world/cloud"], "Points3D:positions")[0])
    assert np.allclose(points, [[3, 2, 3], [1, 5, 3]])


def test_the_command_writes_one_beside_the_map(tmp_path):
    pytest.importorskip("rerun")
    words = ["--out", str(tmp_path / "room.svox"), "--frames", ":2", "--voxel-size", "0.3"]
    assert main(["map", "sim:room", *words, "--rerun", str(tmp_path / "room.rrd")]) == 0
    assert len(column(chunks(tmp_path / "room.rrd")["/world/camera/depth"], "DepthImage:buffer")) == 2


def test_without_rerun_the_install_line_is_said(mapper, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(MissingExtra, match=r"pip install 'stereovox\[rerun\]'"):
        export(mapper.map, tmp_path / "map.rrd")
    assert not list(tmp_path.iterdir())
