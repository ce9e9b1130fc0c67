# SPDX-License-Identifier: Apache-2.0
"""Clouds and meshes of other programs: kinds, units, origins, what the map remembers, and mistakes in one line."""

import os
import struct

import numpy as np
import pytest
import trimesh

import stereovox as sv
from stereovox.errors import MapFileError, StereovoxError
from stereovox.formats import UNREADABLE, import_map
from stereovox.maps import VoxelMap
from stereovox.maps.record.history import Imported

WALL = np.stack(np.meshgrid(np.arange(0, 2, 0.02), [0.31], np.arange(0, 1, 0.02), indexing="ij"), -1).reshape(-1, 3)
UTM = np.array([512_345.0, 5_403_210.0, 100.0])
FAR_BOUNDS = UTM + np.array([[0, 0.3, 0], [2, 0.35, 1]])


def pcd(points, width=None, height=1, viewpoint="0 0 0 1 0 0 0"):
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {width or len(points)}\n"
    head += f"HEIGHT {height}\nVIEWPOINT {viewpoint}\nPOINTS {len(points)}\nDATA binary\n"
    return head.encode() + np.asarray(points, "<f8").tobytes()


def las(path, points, version="1.2", vlrs=(), point_format=3):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(version=version, point_format=point_format)
    header.scales, header.offsets = [0.001] * 3, np.floor(points.min(axis=0))
    header.vlrs.extend(vlrs)
    made = laspy.LasData(header)
    made.x, made.y, made.z = np.asarray(points, float).T
    made.write(str(path))
    return path


def wkt(text):
    return pytest.importorskip("laspy").vlrs.known.WktCoordinateSystemVlr(text)


def notes(made):
    return " | ".join(made.history.imported.notes)


def size_and_bounds(made, size):
    assert made.voxel_size == size
    np.testing.assert_allclose(made.bounds(), [[0, 0.3, 0], [2, 0.35, 1]], atol=1e-9)


@pytest.mark.parametrize("kind", ["pcd", "xyz", "csv", "txt", "pts", "las", "laz"])
def test_a_cell_size_is_suggested_for_each_kind(tmp_path, kind):
    path, rows = tmp_path / f"wall.{kind}", [" ".join(f"{x:.4f}" for x in point) for point in WALL]
    match kind:
        case "pcd":
            path.write_bytes(pcd(WALL))
        case "las" | "laz":
            las(path, WALL)
        case "csv":
            path.write_text("i,Z,X [m],y,\n" + "".join(f"7,{z:.4f},{x:.4f},{y:.4f},\n" for x, y, z in WALL))
        case "pts":
            path.write_text(f"{len(rows)}\n" + "\n".join(f"{row} 12 0 0 255" for row in rows))
        case "txt":
            path.write_text("//X;Y;Z\n# a comment\n\n" + "\n".join(row.replace(" ", ";") for row in rows))
        case _:
            path.write_text("\n".join(rows))
    made = import_map(path)
    size_and_bounds(made, 0.05)
    assert made.counts() == {"free": 0, "tentative": 0, "occupied": 40 * 20}
    assert made.history.imported.file == path.name
    assert "5,000 points" in made.history.imported.holds
    assert "cells of 0.05 m, since its points are about 0.02 m apart (--voxel-size overrides)" in notes(made)
    assert import_map(path, voxel_size=0.5).voxel_size == 0.5


def test_what_was_imported_is_saved_and_told(tmp_path, capsys):
    (tmp_path / "wall.pcd").write_bytes(pcd(WALL))
    from stereovox.cli import main

    assert main(["import", str(tmp_path / "wall.pcd"), str(tmp_path / "m")]) == 0
    assert "--voxel-size overrides" in capsys.readouterr().err
    assert sv.load_map(tmp_path / "m").history.imported == import_map(tmp_path / "wall.pcd").history.imported
    assert main(["info", str(tmp_path / "m")]) == 0
    told = capsys.readouterr().err
    assert told.startswith("imported from wall.pcd (PCD, 5,000 points)\n  cells of 0.05 m, since ")
    assert not any(word in told for word in ("frames", "projective", "depth up to"))


def test_an_organised_cloud_with_pixels_without_depth(tmp_path):
    points = np.concatenate([WALL, np.full((600, 3), np.nan)])
    (tmp_path / "a.pcd").write_bytes(pcd(points, 100, 56, "0 0 1 0 1 0 0"))
    made = import_map(tmp_path / "a.pcd")
    size_and_bounds(made, 0.05)
    assert made.history.imported.holds == "PCD, 100 x 56, 5,000 points"
    assert "VIEWPOINT is not applied" in notes(made)
    (tmp_path / "a.pcd").write_bytes(pcd(points, 100, 56))
    assert "VIEWPOINT" not in notes(import_map(tmp_path / "a.pcd"))


def test_a_cloud_far_from_its_origin_is_moved_and_says_so(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd(WALL + UTM))
    made = import_map(tmp_path / "a.pcd")
    assert "its origin is (512300, 5403200, 0) m of the file" in notes(made)
    np.testing.assert_allclose(made.bounds() + np.array([512300, 5403200, 0]), FAR_BOUNDS)
    kept = import_map(tmp_path / "a.pcd", origin=(0, 0, 0))
    np.testing.assert_allclose(kept.bounds(), FAR_BOUNDS)
    assert "origin" not in notes(kept)
    size_and_bounds(import_map(tmp_path / "a.pcd", origin=UTM), 0.05)


def test_units(tmp_path):
    (tmp_path / "a.pcd").write_bytes(pcd(WALL * 1000))
    assert "unit unsure: 1980 long, taken as metres" in notes(import_map(tmp_path / "a.pcd"))
    made = import_map(tmp_path / "a.pcd", unit="mm")
    size_and_bounds(made, 0.05)
    assert "unsure" not in notes(made)
    assert "taken as mm" in notes(made)
    (tmp_path / "a.pcd").write_bytes(pcd(WALL / 1000))
    assert "unit unsure" in notes(import_map(tmp_path / "a.pcd"))
    (tmp_path / "a.pcd").write_bytes(pcd(WALL))
    assert "unit" not in notes(import_map(tmp_path / "a.pcd"))


FEET = 'PROJCS["x",GEOGCS["y",UNIT["degree",0.0174532925199433]],UNIT["foot",0.3048],VERT_CS["h",UNIT["metre",1]]]'


def test_a_survey_in_feet_is_made_metres(tmp_path):
    las(tmp_path / "a.las", WALL / [0.3048, 0.3048, 1], "1.4", [wkt(FEET)], 6)
    made = import_map(tmp_path / "a.las")
    size_and_bounds(made, 0.05)
    assert "unit: foot, as the file says (--unit overrides)" in notes(made)
    assert import_map(tmp_path / "a.las", unit="m").bounds()[1, 0] > 6


def test_a_survey_in_degrees_is_refused(tmp_path):
    las(tmp_path / "a.las", WALL, "1.4", [wkt('GEOGCS["WGS 84",UNIT["degree",0.0174532925199433]]')], 6)
    with pytest.raises(MapFileError, match="are degrees"):
        import_map(tmp_path / "a.las")


def test_geotiff_keys_tell_the_unit(tmp_path):
    laspy = pytest.importorskip("laspy")
    keys = laspy.vlrs.known.GeoKeyDirectoryVlr()
    entry = laspy.vlrs.known.GeoKeyEntryStruct
    keys.geo_keys = [entry(id=1024, count=1, value_offset=1), entry(id=3076, count=1, value_offset=9002)]
    keys.geo_keys_header.number_of_keys = 2
    las(tmp_path / "a.las", WALL / 0.3048, vlrs=[keys])
    size_and_bounds(import_map(tmp_path / "a.las"), 0.05)
    keys.geo_keys = [entry(id=1024, count=1, value_offset=2)]
    keys.geo_keys_header.number_of_keys = 1
    las(tmp_path / "a.las", WALL, vlrs=[keys])
    with pytest.raises(MapFileError, match="are degrees"):
        import_map(tmp_path / "a.las")


def test_damaged_surveys_end_in_one_line(tmp_path):
    for kind in ("las", "laz"):
        whole = las(tmp_path / f"a.{kind}", WALL).read_bytes()
        for data in (b"", whole[:100], whole[:230], whole[: len(whole) // 2], whole[:107] + b"\xff" * 4 + whole[111:]):
            (tmp_path / f"a.{kind}").write_bytes(data)
            with pytest.raises(MapFileError) as error:
                import_map(tmp_path / f"a.{kind}")
            assert str(error.value).startswith(f"{tmp_path / f'a.{kind}'}: ")
            assert len(str(error.value)) <= 300


def test_without_laspy_it_says_what_to_install(tmp_path, monkeypatch):
    las(tmp_path / "a.las", WALL)
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(StereovoxError, match=r"laspy is not installed; run: pip install 'stereovox\[las\]'"):
        import_map(tmp_path / "a.las")


@pytest.mark.parametrize("kind", ["ply", "stl", "obj", "off"])
def test_a_mesh_is_its_surface_not_its_corners(tmp_path, kind):
    box = trimesh.creation.box((2.0, 1.0, 0.6))
    box.apply_translation((1.01, 0.51, 0.31))
    box.export(tmp_path / f"box.{kind}")
    made = import_map(tmp_path / f"box.{kind}")
    assert made.voxel_size == 0.01
    assert "mesh, surface of 12 triangles" in made.history.imported.holds
    assert "unit unsure" in notes(made)
    coarse = import_map(tmp_path / f"box.{kind}", voxel_size=0.1)
    cells = coarse.cells_in(sv.State.OCCUPIED)
    low, high = cells.min(axis=0), cells.max(axis=0)
    on_a_face = ((cells == low) | (cells == high)).any(axis=1)
    assert on_a_face.all()
    assert len(cells) == np.prod(high - low + 1) - np.prod(high - low - 1)
    small = import_map(tmp_path / f"box.{kind}", voxel_size=0.001, unit="cm")
    assert small.bounds()[1, 0] == pytest.approx(0.021, abs=0.001)


def test_faces_of_four_corners_and_bare_corners(tmp_path):
    head = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    corners = "0.01 0.01 0.05\n0.99 0.01 0.05\n0.99 0.99 0.05\n0.01 0.99 0.05\n"
    face = "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(f"{head}{face}{corners}4 0 1 2 3\n")
    assert import_map(tmp_path / "a.ply", voxel_size=0.1).counts()["occupied"] == 100
    (tmp_path / "a.ply").write_text(f"{head}element face 0\nend_header\n{corners}")
    assert import_map(tmp_path / "a.ply", voxel_size=0.1).counts()["occupied"] == 4
    (tmp_path / "a.ply").write_text(f"{head}{face}{corners}4 0 1 2 9\n")
    with pytest.raises(MapFileError, match="not a readable mesh"):
        import_map(tmp_path / "a.ply", voxel_size=0.1)


def test_a_kitti_scan(tmp_path):
    data = np.column_stack([WALL, np.zeros(len(WALL))]).astype("<f4").tobytes()
    (tmp_path / "0.bin").write_bytes(data)
    size_and_bounds(import_map(tmp_path / "0.bin"), 0.05)
    (tmp_path / "0.bin").write_bytes(data + b"1234")
    with pytest.raises(MapFileError, match="not a whole number of points"):
        import_map(tmp_path / "0.bin")
    (tmp_path / "0.bin").write_bytes(np.full(400, 1e9, "<f4").tobytes())
    with pytest.raises(MapFileError, match="not a KITTI velodyne scan"):
        import_map(tmp_path / "0.bin")


@pytest.mark.parametrize(
    ("name", "content", "options", "said"),
    [
        ("a.xyz", b"", {}, "no line of three numbers"),
        ("a.xyz", b"1 2 3\n4 5\n", {}, "no readable points"),
        ("a.xyz", b"\xff\xfe\x00\x01", {}, "is not text"),
        ("a.csv", b"time,lat,lon\n1,2,3\n", {}, "without columns x, y and z"),
        ("a.xyz", b"1 2 3\n4 5 6\n", {}, "type: stereovox import a.xyz MAP --voxel-size 0.05"),
        ("a.xyz", b"nan 2 3\n", {"voxel_size": 1.0}, "holds no point"),
        ("a.txt", b"1311868164.3 1 2 0 0 0 0 1\n" * 3, {}, "is beyond the Earth"),
        ("a.xyz", b"1 2 3\n", {"unit": "mile"}, "--unit mile: unknown unit; give one of m, cm"),
        ("a.xyz", b"1 2 3\n", {"heights": (0, 1)}, "--heights does not apply"),
        ("a.pcd", b"version https://git-lfs.github.com/spec/v1\noid sha256:0\n", {}, "git lfs pull"),
        ("a.stl", b"solid\n", {}, "a.stl"),
        ("a.laz2", b"", {}, "did you mean '.laz'"),
        ("a.dat", b"", {}, "cannot import '.dat'; points as text end in .xyz"),
        ("a", b"", {}, "has no ending"),
        *((f"a{ending}", b"", {}, cure) for ending, cure in UNREADABLE.items()),
    ],
)
def test_mistakes_end_in_one_short_line(tmp_path, monkeypatch, name, content, options, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_bytes(content)
    with pytest.raises(StereovoxError) as error:
        import_map(name, **options)
    assert str(error.value).startswith((f"{name}: ", "--unit")), error.value
    assert said in str(error.value)
    assert len(str(error.value)) <= 300


def test_a_mesh_too_large_for_its_cells_is_refused(tmp_path):
    trimesh.creation.box((2000.0, 1000.0, 600.0)).export(tmp_path / "a.stl")
    with pytest.raises(MapFileError, match="give a larger --voxel-size"):
        import_map(tmp_path / "a.stl", voxel_size=0.001)


def test_points_in_a_bag_get_a_cell_size(tmp_path):
    from stereovox.sources.bags.writer import BagWriter

    with BagWriter(tmp_path / "a.mcap") as bag:
        bag.cloud(0, WALL.astype(np.float32), frame_id="map")
        [topic] = bag.topics if hasattr(bag, "topics") else ["/occupied_cells"]
    made = import_map(tmp_path / "a.mcap", topic=topic)
    size_and_bounds(made, 0.05)
    assert "cells of 0.05 m" in notes(made)


def test_big_and_small_numbers_of_floats(tmp_path):
    body = b"".join(struct.pack(">3d", *point) for point in WALL)
    head = f"ply\nformat binary_big_endian 1.0\nelement vertex {len(WALL)}\n"
    head += "property double x\nproperty double y\nproperty double z\nend_header\n"
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    size_and_bounds(import_map(tmp_path / "a.ply"), 0.05)


def test_long_words_of_a_file_do_not_spoil_the_map(tmp_path):
    made = VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0])
    made.history.imported = Imported("a\nb.las", "LAS", ("unit: " + "foot " * 200,))
    made.save(tmp_path / "m.svox")
    loaded = sv.load_map(tmp_path / "m.svox").history.imported
    assert loaded.notes[0].startswith("unit: foot")
    assert loaded.file == "a\\nb.las"


def test_a_doubtful_unit_is_told_also_where_the_cells_are_given(tmp_path):
    trimesh.creation.box((40, 40, 40)).export(tmp_path / "a.stl")
    assert "unit unsure: 40 long" in notes(import_map(tmp_path / "a.stl", voxel_size=1.0))
    assert notes(import_map(tmp_path / "a.stl", voxel_size=1.0, unit="m")) == ""


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes")
def test_a_pipe_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(sv.StereovoxError, match="cannot be read"):
        import_map(tmp_path / "a.ply")
