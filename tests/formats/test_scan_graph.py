# SPDX-License-Identifier: Apache-2.0
"""OctoMap's scan graphs, text and binary: what rays pass is free, what they hit occupied, what lies behind unknown."""

import struct

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.errors import MapFileError
from stereovox.formats import import_map
from stereovox.maps import State

POSES = [((0.5, -0.2, 0.3), (0.0, 0.0, 0.0)), ((0.4, 0.6, 0.2), (0.2, -0.3, 1.2))]
"""Places and roll, pitch, yaw of the sensor."""
WALL = np.stack(np.meshgrid([3.05], np.arange(-1, 1, 0.03), np.arange(-0.5, 0.5, 0.03), indexing="ij"), -1).reshape(
    -1, 3
)


def turned(angles):
    return Rotation.from_euler("xyz", angles)


def seen():
    """Each scan's points in the frame of its sensor."""
    return [turned(angles).inv().apply(WALL - place) for place, angles in POSES]


def text_graph():
    lines = ["# a comment"]
    for (place, angles), points in zip(POSES, seen(), strict=True):
        lines += [f"NODE {' '.join(map(repr, (*place, *angles)))}", " skipped", ""]
        lines += [f"{x!r} {y!r} {z!r}" for x, y, z in points.tolist()]
    return "\n".join([*lines, ""]).encode()


def binary_graph():
    data = struct.pack("<I", len(POSES))
    for number, ((place, angles), points) in enumerate(zip(POSES, seen(), strict=True)):
        x, y, z, w = turned(angles).as_quat()
        data += struct.pack("<I", len(points)) + b"".join(struct.pack("<i3d", 3, *point) for point in points)
        data += struct.pack("<i3d", 3, *place) + struct.pack("<i4d", 4, w, x, y, z) + struct.pack("<I", number)
    edge = struct.pack("<2I", 0, 1) + struct.pack("<i3di4d", 3, 0, 0, 0, 4, 1, 0, 0, 0) + struct.pack("<d", 1)
    return data + struct.pack("<I", 1) + edge


@pytest.mark.parametrize("make", [text_graph, binary_graph])
def test_walls_are_occupied_and_the_way_there_is_free(tmp_path, make):
    (tmp_path / "a.graph").write_bytes(make())
    made = import_map(tmp_path / "a.graph", voxel_size=0.1)
    assert (made.state(WALL) == State.OCCUPIED).all()
    for place, _ in POSES:
        half = (WALL + place) / 2
        assert (made.state(half) == State.FREE).all()
        assert made.state(place)[0] == State.FREE
        assert (made.state(WALL + (WALL - place) * 0.1) == State.UNKNOWN).all()
    assert made.counts()["tentative"] == 0
    assert made.history.imported.holds == f"OctoMap scan graph, 2 scans, {2 * len(WALL):,} points"
    assert made.history.imported.notes == ()
    suggested = import_map(tmp_path / "a.graph")
    assert "(--voxel-size overrides)" in suggested.history.imported.notes[0]
    assert suggested.voxel_size in (0.05, 0.1)


def test_a_cell_that_one_scan_hits_and_another_passes_is_tentative(tmp_path):
    rows = "NODE 0 0 0 0 0 0\n1.05 0.05 0.05\n" + "NODE 0 0 0 0 0 0\n2.05 0.05 0.05\n"
    (tmp_path / "a.graph").write_text(rows)
    made = import_map(tmp_path / "a.graph", voxel_size=0.1)
    states = made.state([[1.05, 0.05, 0.05], [2.05, 0.05, 0.05], [0.5, 0.03, 0.03]])
    assert states.tolist() == [State.TENTATIVE, State.OCCUPIED, State.FREE]


@pytest.mark.parametrize(
    ("content", "options", "said"),
    [
        (b"", {}, "not an OctoMap scan graph, or damaged"),
        (b"\x02\0\0\0", {}, "damaged"),
        (b"\xff" * 400, {}, "damaged"),
        (struct.pack("<2I", 1, 0) + struct.pack("<i3di4dI", 3, 0, 0, 0, 4, 0, 0, 0, 0, 0), {}, "pose"),
        (b"NODE 1 2 3\n1 2 3\n", {}, "is not NODE x y z roll pitch yaw"),
        (b"NODE 0 0 0 0 0 0\n1 2\n", {}, "fewer than three numbers"),
        (b"NODE 0 0 0 0 0 0\n1 2 wide\n", {}, "wide"),
        (b"NODE 0 0 0 0 0 nan\n1 2 3\n", {}, "pose"),
        (b"NODE 0 0 0 0 0 0\n", {}, "hold no point"),
        (b"NODE 0 0 0 0 0 0\n1 2 3\n", {}, "type: stereovox import a.graph MAP --voxel-size 0.05"),
        (b"NODE 0 0 0 0 0 0\n9e8 2 3\n", {"voxel_size": 1e-3}, "give a larger --voxel-size"),
        (b"NODE 0 0 0 0 0 0\n9e6 2 3\n", {"voxel_size": 1.0}, "give a larger --voxel-size"),
    ],
)
def test_damaged_graphs_end_in_one_line(tmp_path, content, options, said):
    (tmp_path / "a.graph").write_bytes(content)
    with pytest.raises(MapFileError) as error:
        import_map(tmp_path / "a.graph", **options)
    assert said in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 'a.graph'}: ")
    assert len(str(error.value)) <= 300


def test_a_graph_cut_off_is_refused(tmp_path):
    whole = binary_graph()
    for length in range(1, len(whole) - 120, 9973):
        (tmp_path / "a.graph").write_bytes(whole[:length])
        with pytest.raises(MapFileError):
            import_map(tmp_path / "a.graph", voxel_size=0.1)
