# SPDX-License-Identifier: Apache-2.0
"""Points of `.ply` files as other makers write them: lists, other elements first, capitals, Gaussian splats."""

import struct

import numpy as np
import pytest

from stereovox.errors import MapFileError
from stereovox.formats import import_map
from stereovox.sources.point_files import read_points

POINTS = np.random.default_rng(5).uniform(-3, 3, (9, 3)).astype(np.float32)
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


def written(path, order, elements):
    """Write elements: name, properties, rows of numbers and of lists."""
    head, body = f"ply\nformat {order} 1.0\n", b""
    for name, properties, rows in elements:
        head += f"element {name} {len(rows)}\n" + "".join(f"property {text}\n" for text in properties)
        for row in rows:
            words, packed = [], b""
            for text, value in zip(properties, row, strict=True):
                kinds = [{"uchar": "B", "uint": "I", "int": "i", "float": "f"}[word] for word in text.split()[:-1][-2:]
                         if word != "list"]  # fmt: skip
                values = value if isinstance(value, list) else [value]
                if isinstance(value, list):
                    words.append(str(len(value)))
                    packed += struct.pack(f"{ORDERS[order] or '<'}{kinds[0]}", len(value))
                words += [repr(float(one)) if kinds[-1] == "f" else str(one) for one in values]
                packed += struct.pack(f"{ORDERS[order] or '<'}{len(values)}{kinds[-1]}", *values)
            body += packed if ORDERS[order] else (" ".join(words) + "\n").encode()
    path.write_bytes(head.encode() + b"end_header\n" + body)
    return path


XYZ = ["float x", "float y", "float z"]
POSED = ("camera", ["float view_px", "uchar kind"], [[0.5, 3], [1.5, 4]])
LISTED = ("notes", ["list uchar int ids", "float weight"], [[[1, 2, 3], 0.5], [[], 1.5]])


@pytest.mark.parametrize("order", ORDERS)
def test_elements_before_the_points_are_passed_over(tmp_path, order):
    rows = [list(map(float, point)) for point in POINTS]
    path = written(tmp_path / "a.ply", order, [POSED, LISTED, ("vertex", XYZ, rows)])
    np.testing.assert_allclose(read_points(path).xyz, POINTS, rtol=1e-6)


@pytest.mark.parametrize("order", ORDERS)
@pytest.mark.parametrize("place", [0, 1, 3])
def test_points_may_have_lists(tmp_path, order, place):
    """OpenMVS writes the views of each point, and their weights."""
    names = ["list uchar uint view_indices", "list uchar float view_weights"]
    rows = []
    for k, point in enumerate(POINTS):
        lists = [list(range(k % 4)), [0.25] * (k % 4)]
        rows.append([*map(float, point[:place]), *lists, *map(float, point[place:])])
    path = written(tmp_path / "a.ply", order, [("vertex", [*XYZ[:place], *names, *XYZ[place:]], rows)])
    np.testing.assert_allclose(read_points(path).xyz, POINTS, rtol=1e-6)
    content = path.read_bytes()
    path.write_bytes(content[: -len(content) // 8])
    with pytest.raises(MapFileError, match=r"cut off|are left"):
        read_points(path)


def test_capital_names(tmp_path):
    rows = [list(map(float, point)) for point in POINTS]
    path = written(tmp_path / "a.ply", "binary_little_endian", [("vertex", [text.upper().replace("FLOAT", "float")
                                                                            for text in XYZ], rows)])  # fmt: skip
    np.testing.assert_allclose(read_points(path).xyz, POINTS)
    head = "VERSION 0.7\nFIELDS X Y Z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 9\nHEIGHT 1\nPOINTS 9\nDATA binary\n"
    (tmp_path / "a.pcd").write_bytes(head.encode() + POINTS.tobytes())
    np.testing.assert_allclose(read_points(tmp_path / "a.pcd").xyz, POINTS)


OPACITIES = [0.02, 0.3, 0.49, 0.51, 0.7, 0.9, 0.999, 0.1, 0.6]


def test_haze_of_gaussian_splats_is_no_surface(tmp_path):
    """Opacities are stored as logits: most splats of a scene are nearly transparent."""
    names = [*XYZ, *(f"float {name}" for name in ("f_dc_0", "opacity", "scale_0", "rot_0"))]
    rows = [
        [*map(float, p), 0.1, float(np.log(a / (1 - a))), -4.0, 1.0] for p, a in zip(POINTS, OPACITIES, strict=True)
    ]
    path = written(tmp_path / "splats.ply", "binary_little_endian", [("vertex", names, rows)])
    found = read_points(path)
    np.testing.assert_allclose(found.xyz, POINTS[[3, 4, 5, 6, 8]])
    assert found.haze == 4
    made = import_map(path, voxel_size=0.1)
    assert "4 of 9 splats are left out" in made.history.imported.notes[-1]
    assert made.counts()["occupied"] == 5


def test_compressed_splats(tmp_path):
    """As PlayCanvas describes them: x in the upper 11 bits, y in 10, z in 11; opacity in the lowest 8 of a colour."""
    rng = np.random.default_rng(2)
    low, high = np.array([[-4.0, 0, 1], [5, 5, 5]]), np.array([[4.0, 1, 9], [6, 7, 8]])
    share = rng.uniform(0, 1, (300, 3))
    steps = np.rint(share * [2047, 1023, 2047]).astype(int)
    opacity = rng.integers(0, 256, 300)
    rows = [
        [int(x) << 21 | int(y) << 11 | int(z), 7, 9, 0x11223300 | int(a)]
        for (x, y, z), a in zip(steps, opacity, strict=True)
    ]
    ends = [f"float {end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    boxes = [[*map(float, low[k]), *map(float, high[k]), -3.0] for k in (0, 1)]
    packed = [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    path = written(tmp_path / "a.compressed.ply", "binary_little_endian",
                   [("chunk", [*ends, "float min_scale_x"], boxes), ("vertex", packed, rows),
                    ("sh", ["uchar f_rest_0"], [[3]] * 300)])  # fmt: skip
    of = np.arange(300) // 256
    expected = (low[of] + share * (high - low)[of])[opacity >= 128]
    assert read_points(path).haze == (opacity < 128).sum()
    np.testing.assert_allclose(read_points(path).xyz, expected, atol=0.006)  # half a step of 10 bits


@pytest.mark.parametrize("element", [[], [("chunk", ["float min_x"], [[1.0]])]])
def test_splats_packed_otherwise_are_refused(tmp_path, element):
    packed = [f"uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    path = written(tmp_path / "a.ply", "binary_little_endian", [*element, ("vertex", packed, [[1, 2, 3, 4]])])
    with pytest.raises(MapFileError, match="export them uncompressed"):
        read_points(path)
