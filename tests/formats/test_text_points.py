# SPDX-License-Identifier: Apache-2.0
"""Text of scanners: `.ptx` with a matrix for each scan, VeloView's columns, units in a heading."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.errors import MapFileError
from stereovox.formats import import_map
from stereovox.formats.clouds import read_cloud
from stereovox.formats.text_points import read_text_points

POINTS = np.random.default_rng(8).uniform(1, 4, (12, 3)).round(4)


def ptx(points, T, columns=3):
    """Return a scan as Leica writes it: rows x y z 1 times a matrix whose last row moves; every fifth without echo."""
    rows = [f"{columns}\n{(len(points) + 3) // columns}"]
    rows += [" ".join(map(str, row)) for row in [T[:3, 3], *T[:3, :3].T, *T.T]]
    lines = [f"{x} {y} {z} 0.5 10 20 30" for x, y, z in points]
    for k in (0, 5, 10):
        lines.insert(k, "0 0 0 0.500000 0 0 0")
    return "\n".join([*rows, *lines]) + "\n"


def motion(vector, place):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(vector).as_matrix(), place
    return T


@pytest.mark.parametrize("name", ["a.ptx", "renamed.txt"])
def test_scans_of_a_ptx_are_in_one_frame(tmp_path, name):
    poses = [motion([0.1, -0.4, 1.2], [5, -2, 0.5]), motion([0, 0, -2], [100, 3, 1])]
    (tmp_path / name).write_text("".join(ptx(POINTS, T) for T in poses))
    found = read_text_points(tmp_path / name)
    expected = np.concatenate([POINTS @ T[:3, :3].T + T[:3, 3] for T in poses])
    np.testing.assert_allclose(found.xyz, expected, atol=1e-9)
    assert "PTX, 2 scans, 24 points" in read_cloud(tmp_path / name).holds
    assert import_map(tmp_path / name, voxel_size=0.05).counts()["occupied"] == len(
        np.unique(np.floor(expected / 0.05), axis=0)
    )


@pytest.mark.parametrize("wrong", ["cut off", "transposed", "scaled"])
def test_a_damaged_ptx_is_refused(tmp_path, wrong):
    T = motion([0.1, -0.4, 1.2], [5, -2, 0.5])
    T = {"cut off": T, "transposed": T.T, "scaled": np.diag([2.0, 2, 2, 1])}[wrong]
    text = ptx(POINTS, T)
    (tmp_path / "a.ptx").write_text("\n".join(text.splitlines()[:-2]) if wrong == "cut off" else text)
    with pytest.raises(MapFileError, match="holds 13" if wrong == "cut off" else "matrix of a scan"):
        read_text_points(tmp_path / "a.ptx")


HEADINGS = {
    "VeloView": ('"intensity","laser_id","azimuth","distance_m","adjustedtime","timestamp","Points_m_XYZ:0",'
                 '"Points_m_XYZ:1","Points_m_XYZ:2"', 6, 1.0),
    "VeloView before": ('"Points:0","Points:1","Points:2","intensity"', 0, 1.0),
    "capitals in millimetres": ("Time;Range (mm);X1 (mm);Y1 (mm);Z1 (mm)", 2, 0.001),
    "a name before them": ("name,x [cm],y [cm],z [cm]", 1, 0.01),
}  # fmt: skip


@pytest.mark.parametrize("name", HEADINGS)
def test_columns_and_units_by_a_heading(tmp_path, name):
    heading, at, metres = HEADINGS[name]
    mark = ";" if ";" in heading else ","
    width = len(heading.split(mark))
    rows = []
    for k, point in enumerate(POINTS):
        row = ["tree" if heading.startswith("name") else str(k + 0.5)] * width
        row[at : at + 3] = [f"{value / metres:.6f}" for value in point]
        rows.append(mark.join(row))
    (tmp_path / "a.csv").write_text("\n".join([heading, *rows]))
    cloud = read_cloud(tmp_path / "a.csv")
    np.testing.assert_allclose(cloud.xyz * (cloud.metres[0] if cloud.metres else 1), POINTS, atol=1e-6)
    bounds = import_map(tmp_path / "a.csv", voxel_size=0.1).bounds()
    np.testing.assert_allclose(bounds, [POINTS.min(axis=0), POINTS.max(axis=0)], atol=0.11)
