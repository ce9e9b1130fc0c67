# SPDX-License-Identifier: Apache-2.0
"""Files of other programs that were made to hurt: pictures and trees that claim more than there is."""

import struct
import tracemalloc
import zlib

import pytest

from stereovox.errors import MapFileError
from stereovox.formats import map_server, octomap, read_octomap
from stereovox.formats.map_server import read_map_server

YAML = "image: {}\nresolution: 0.05\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"


def refusal(read, path):
    tracemalloc.start()
    try:
        with pytest.raises(MapFileError) as caught:
            read(path)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 30_000_000
    assert str(caught.value).isprintable()
    return str(caught.value)


def picture(folder, data):
    (folder / "map.pgm").write_bytes(data)
    (folder / "map.yaml").write_text(YAML.format("map.pgm"))
    return folder / "map.yaml"


def png(width, height, data):
    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(data, 9)) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"P5 65536 65536 255\n" + bytes(100), "65536 x 65536 pixels"),
        (b"P5 16000 16000 255\n" + bytes(100), "fewer than 16000 x 16000 pixels"),
        (b"P5 999999999 999999999 255\n", "pixels"),
        (b"P2 16000 16000 255\n" + b"0 " * 100, "fewer than 16000 x 16000 pixels"),
        (b"P5 -1 -1 255\n", "not a PGM's"),
        (png(5000, 5000, bytes(5001 * 100)), "a map has 1 to 4194304"),
        (png(2**31 - 1, 2**31 - 1, b""), "damaged or not a picture"),
    ],
)
def test_a_picture_that_claims_too_much(tmp_path, data, said):
    assert said in refusal(read_map_server, picture(tmp_path, data))


def test_a_large_picture_may_be_as_large_as_its_file_allows(tmp_path, monkeypatch):
    monkeypatch.setattr(map_server, "PIXELS_OF_ANY", 100)
    monkeypatch.setattr(map_server, "PIXELS_A_BYTE", 10)
    whole = png(40, 20, bytes(41 * 20))
    assert 10 * len(whole) > 600
    assert "800 pixels" not in refusal(read_map_server, picture(tmp_path, png(400, 20, bytes(401 * 20))))
    monkeypatch.setattr(map_server, "PIXELS_A_BYTE", 20)
    assert read_map_server(picture(tmp_path, whole)).cells.shape == (20, 40)


@pytest.mark.parametrize("image", ["/dev/zero", "/proc/self/environ", "..", "."])
def test_an_image_may_be_anywhere_but_must_be_a_picture(tmp_path, image):
    """Absolute names and `..` are allowed, as in ROS; what is no picture is refused without a word of what is in it."""
    (tmp_path / "map.yaml").write_text(YAML.format(image))
    assert "PATH" not in refusal(read_map_server, tmp_path / "map.yaml")


@pytest.mark.parametrize(
    "line",
    [
        "origin: &a [*a, *a, *a]",
        "a0: &a0 [1, 2]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}]\n" for k in range(1, 30)) + "origin: *a29",
        "origin: [.nan, 0, 0]",
        "origin: [.inf, 0, 0]",
        "origin: !!python/object/apply:os.system ['false']",
        "resolution: .nan",
        "resolution: -1",
        "occupied_thresh: 1e400",
        "free_thresh: 0.9",
        f"negate: {'9' * 400}",
        "image: 5",
    ],
)
def test_a_yaml_that_lies(tmp_path, line):
    path = picture(tmp_path, b"P5 2 2 255\n\0\0\0\0")
    assert read_map_server(path).cells.shape == (2, 2)
    path.write_text(path.read_text() + line + "\n")
    refusal(read_map_server, path)


def tree(path, body, size, res="0.1", tail=b""):
    head = f"# Octomap OcTree binary file\nid OcTree\nsize {size}\nres {res}\ndata\n"
    path.write_bytes(head.encode() + body + tail)
    return path


@pytest.mark.parametrize("res", ["0", "-0.1", "nan", "inf", "1e-300", "1e300", "", "0.1 0.1", "0x1"])
def test_a_tree_without_a_size_of_cells(tmp_path, res):
    refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 1), 2, res))


@pytest.mark.parametrize("size", ["0", "1", "3", "-2", "9" * 15, "9" * 30, "2.0", "٢"])
def test_a_tree_whose_size_lies(tmp_path, size):
    refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 1), size))


def test_a_tree_that_claims_the_whole_world(tmp_path):
    said = refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 1), 2))
    assert "its nodes expand to up to 3.52e+13 cells" in said
    whole = b"# Octomap OcTree file\nid OcTree\nsize 1\nres 0.1\ndata\n" + struct.pack("<fB", 1.0, 0)
    (tmp_path / "a.ot").write_bytes(whole)
    assert "its nodes expand to up to" in refusal(read_octomap, tmp_path / "a.ot")


def test_a_tree_deeper_than_sixteen_levels(tmp_path):
    assert "more than 16 levels" in refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 3) * 17, 18))


def test_trees_of_too_many_nodes_are_not_unfolded(tmp_path, monkeypatch):
    monkeypatch.setattr(octomap, "MAX_NODES", 10)
    assert "nodes are more than 10" in refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 3) * 11, 12))
    monkeypatch.setattr(octomap, "MAX_BYTES", 50)
    assert "holds more than 50 bytes" in refusal(read_octomap, tree(tmp_path / "a.bt", struct.pack("<H", 3) * 11, 12))


@pytest.mark.parametrize("length", [0, 10, 60, 75, 76, 78])
def test_a_tree_that_was_cut_off(tmp_path, length):
    whole = tree(tmp_path / "a.bt", struct.pack("<HHH", 3, 3, 1), 4).read_bytes()
    (tmp_path / "a.bt").write_bytes(whole[:length])
    refusal(read_octomap, tmp_path / "a.bt")
