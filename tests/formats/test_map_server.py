"""map_server files: what ROS reads of ours, what we read of ROS's, and that nothing bad gets through."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from stereovox.cli import main
from stereovox.errors import MapFileError
from stereovox.formats import import_map
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.maps import State
from stereovox.maps.occupancy import OccupancyGrid

WILLOW = Path(__file__).resolve().parents[2] / "../shared/data/map_server/willow-2010-02-18-0.10.yaml"
HEAD = {
    "image": "map.pgm", "resolution": "0.05", "origin": "[-1.5, 2.0, 0.5]", "negate": "0",
    "occupied_thresh": "0.65", "free_thresh": "0.196",
}  # fmt: skip


def made_map(folder, pixels=None, picture=None, name="map.pgm", **says):
    """Write a .yaml, and the picture given or (height, width) pixels as a PGM, by other means than ours."""
    head = {**HEAD, "image": name, **says}
    if isinstance(picture, bytes):
        (folder / name).write_bytes(picture)
    elif picture is not None:
        picture.save(folder / name)
    else:
        height, width = np.shape(pixels)
        data = f"P5\n# CREATOR: GIMP\n{width} {height}\n255\n".encode() + np.asarray(pixels, np.uint8).tobytes()
        (folder / name).write_bytes(data)
    path = folder / "map.yaml"
    path.write_text("".join(f"{name}: {value}\n" for name, value in head.items() if value is not None))
    return path


def image_loader(pixel, mode, negate, occupied_thresh, free_thresh):
    """One pixel (channels) by the book of map_server's image_loader.cpp."""
    channels = list(map(float, pixel))
    alpha = channels[-1] if len(channels) == 4 else 255
    colours = channels if mode == "trinary" or len(channels) < 4 else channels[:3]
    average = sum(colours) / len(colours)
    if negate:
        average = 255 - average
    if mode == "raw":
        return int(average) if int(average) <= 100 else -1
    occ = (255 - average) / 255.0
    if occ > occupied_thresh:
        return 100
    if occ < free_thresh:
        return 0
    if mode == "trinary" or alpha < 1:
        return -1
    return int(99 * ((occ - free_thresh) / (occupied_thresh - free_thresh)))


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw", None])
@pytest.mark.parametrize("negate", ["0", "1", "false", "true"])
@pytest.mark.parametrize("thresholds", [(0.65, 0.196), (0.9, 0.1), (1.0, 0.0)])
def test_all_greys_mean_what_they_do_to_map_server(tmp_path, mode, negate, thresholds):
    pixels = np.arange(256).reshape(8, 32)
    says = {"occupied_thresh": thresholds[0], "free_thresh": thresholds[1]}
    grid = read_map_server(made_map(tmp_path, pixels, mode=mode, negate=negate, **says))
    wanted = [image_loader([x], mode or "trinary", negate in ("1", "true"), *thresholds) for x in range(256)]
    np.testing.assert_array_equal(grid.cells[::-1].ravel(), wanted)
    assert grid.cells.dtype == np.int8
    assert grid.resolution == 0.05
    assert grid.origin == (-1.5, 2.0, 0.5)


@pytest.mark.parametrize("mode", [None, "trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", ["0", "1"])
@pytest.mark.parametrize(
    ("free_thresh", "grey", "unknown"), [(0.25, 205, 3), (0.196, 205, 3), (0.25, 205, 0), (0.25, 204, 3)]
)
def test_unknown_cells_that_the_thresholds_make_free_are_noted(tmp_path, mode, negate, free_thresh, grey, unknown):
    """205 has p = 0.196: free for nav2's free_thresh of 0.25, as ROS reads it too; negated, it is occupied."""
    pixels = np.full((10, 10), 254)
    pixels[0, :unknown] = grey
    grid = read_map_server(made_map(tmp_path, pixels, mode=mode, negate=negate, free_thresh=free_thresh))
    lost = mode in (None, "trinary") and negate == "0" and free_thresh == 0.25 and grey == 205 and unknown == 3
    assert bool(grid.note) == lost
    if lost:
        assert (grid.cells[-1, :3] == 0).all()
        assert grid.note == (
            "3% of its pixels are grey 205, which map_saver writes for unknown cells; "
            "free_thresh 0.25 makes them free: correct it to 0.196 in the .yaml"
        )


def said_by_info(path, _, capsys):
    return main(["info", str(path)]), capsys.readouterr()


def said_by_export(path, folder, capsys):
    return main(["export", str(path), str(folder / "floor.bag")]), capsys.readouterr()


def said_by_eval(path, _, capsys):
    return main(["eval", str(path), str(path)]), capsys.readouterr()


def said_by_copying(path, folder, capsys):
    return main(["import", str(path), str(folder / "copy.yaml")]), capsys.readouterr()


def said_by_raising(path, *_):
    return import_map(path, heights=(0, 1)).history.imported.notes


DOORS = said_by_info, said_by_export, said_by_eval, said_by_copying, said_by_raising


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
@pytest.mark.parametrize("free_thresh", [0.25, 0.196])
def test_who_reads_such_a_map_is_told(door, free_thresh, tmp_path, capsys):
    pixels = np.full((10, 10), 254)
    pixels[0, :3], pixels[5, 5] = 205, 0
    path = made_map(tmp_path, pixels, free_thresh=free_thresh)
    assert ("grey 205" in str(door(path, tmp_path, capsys))) == (free_thresh == 0.25)


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize(
    ("kind", "ending"), [("L", "png"), ("L", "bmp"), ("RGB", "png"), ("RGB", "bmp"), ("RGBA", "png")]
)
def test_colours_are_averaged(tmp_path, mode, kind, ending):
    rng = np.random.default_rng(0)
    pixels = rng.integers(0, 256, (9, 7, len(kind)), np.uint8)
    if kind == "RGBA":
        pixels[..., 3] = rng.choice([0, 255], (9, 7))  # ROS 1 and 2 differ on what is between
    image = Image.fromarray(pixels[..., 0] if kind == "L" else pixels)
    grid = read_map_server(made_map(tmp_path, picture=image, name=f"map.{ending}", mode=mode))
    wanted = [[image_loader(pixel, mode, False, 0.65, 0.196) for pixel in row] for row in pixels]
    np.testing.assert_array_equal(grid.cells[::-1], wanted)


@pytest.mark.parametrize(
    "image",
    [
        b"P5 3 2 255\n\x00\xcd\xfe\xfe\x00\xcd",
        b"P5\n# one\n# two\n3\n#three\n2 # four\n255\n\x00\xcd\xfe\xfe\x00\xcd and more",
        b"P2\n# text\n3 2\n255\n0 205 254\n# between\n254 0\n205\n",
        b"P2 3 2 510 0 410 508 508 0 410 7 7 7",
        b"P5 3 2 65535\n" + np.array([0, 52685, 65278, 65278, 0, 52685], ">u2").tobytes(),
        b"P2 3 2 65535 0 52685 65278 65278 0 52685",
    ],
)
def test_kinds_of_pgm(tmp_path, image):
    assert read_map_server(made_map(tmp_path, picture=image)).cells.tolist() == [[0, 100, -1], [100, -1, 0]]


def test_a_16_bit_png_is_scaled_to_greys(tmp_path):
    image = Image.fromarray(np.array([[0, 52685, 65278]], np.uint16))
    assert read_map_server(made_map(tmp_path, picture=image, name="map.png")).cells.tolist() == [[100, -1, 0]]


cells = st.builds(
    lambda seed, rows, columns: np.random.default_rng(seed).integers(-1, 101, (rows, columns)).astype(np.int8),
    st.integers(0, 1000), st.integers(1, 40), st.integers(1, 40),
)  # fmt: skip
numbers = st.floats(-1e6, 1e6, allow_subnormal=False)


@settings(max_examples=40, deadline=None)
@given(cells=cells, origin=st.tuples(numbers, numbers, numbers), resolution=st.floats(1e-5, 10), name=st.text(
    st.characters(blacklist_characters="/\0", blacklist_categories=("Cs", "Cc")), min_size=1, max_size=12))  # fmt: skip
@pytest.mark.parametrize(("mode", "negate"), [("raw", False), ("scale", False), ("scale", True)])
def test_probabilities_come_back_as_they_were(tmp_path_factory, mode, negate, cells, origin, resolution, name):
    grid = OccupancyGrid(cells, resolution, origin, 0.25, 0.6)
    path = tmp_path_factory.mktemp("map") / f"{name}.yaml"
    write_map_server(grid, path, mode, negate)
    again = read_map_server(path)
    np.testing.assert_array_equal(again.cells, cells)
    assert (again.resolution, again.origin) == (resolution, origin)
    assert mode != "raw" or (again.free_below, again.occupied_above) == (0.25, 0.6)


@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("ending", ["pgm", "png"])
def test_what_map_saver_writes(tmp_path, negate, ending):
    cells = np.array([[-1, 0, 29, 30], [50, 70, 71, 100]], np.int8)
    path = tmp_path / f"floor.{ending}"
    write_map_server(OccupancyGrid(cells, 0.05, (1.0, -2.0, 0.0)), path, negate=negate)
    assert sorted(entry.name for entry in tmp_path.iterdir()) == sorted(["floor.yaml", path.name])
    greys = np.asarray(Image.open(path)).astype(int)  # free 254, occupied 0, unknown 205; top row first
    wanted = np.array([[205, 205, 0, 0], [205, 254, 254, 205]])
    assert greys.tolist() == (255 - wanted if negate else wanted).tolist()
    assert (tmp_path / "floor.yaml").read_text().splitlines() == [
        f"image: floor.{ending}", "mode: trinary", "resolution: 0.05", "origin: [1.0, -2.0, 0.0]",
        f"negate: {int(negate)}", "occupied_thresh: 0.65", "free_thresh: 0.196",
    ]  # fmt: skip
    assert read_map_server(path).cells.tolist() == [[-1, 0, 0, -1], [-1, -1, 100, 100]]
    if ending == "pgm":
        assert path.read_bytes().startswith(b"P5\n# CREATOR: stereovox 0.050 m/pix\n4 2\n255\n")


def test_nav2_reads_ours_the_same(tmp_path):
    """nav2_map_server scales by 100 and rounds: at most one per cent next to map_server's 99 that are cut off."""
    cells = np.arange(-1, 101, dtype=np.int8)[None]
    write_map_server(OccupancyGrid(cells, 0.05), tmp_path / "map.yaml", "scale")
    red, _, _, alpha = np.moveaxis(np.asarray(Image.open(tmp_path / "map.png")).astype(float)[0], 1, 0)
    nav2 = np.where(alpha < 255, -1, np.rint((255 - red) / 254 * 100)).clip(-1, 100)
    assert np.abs(nav2 - cells[0]).max() <= 1
    assert (nav2[[0, 1, -1]] == [-1, 0, 100]).all()


def test_a_failed_write_leaves_both_older_files_whole(tmp_path, monkeypatch):
    grid = OccupancyGrid(np.zeros((2, 2), np.int8), 0.05)
    write_map_server(grid, tmp_path / "map.yaml")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(MapFileError, match="No space left"):
        write_map_server(OccupancyGrid(np.ones((3, 3), np.int8), 0.1), tmp_path / "map.yaml")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("map.tif",), "ends in .yaml, .pgm or .png"),
        (("map.yaml", "scaled"), "unknown mode 'scaled'.*did you mean 'scale'"),
        (("map.pgm", "scale"), "no grey for unknown cells; name a .png"),
        (("map.yaml", "raw", True), "leave out negate"),
        (("no/map.yaml",), "cannot be written"),
    ],
)
def test_what_cannot_be_written_is_told(tmp_path, arguments, match):
    grid = OccupancyGrid(np.full((2, 2), -1, np.int8), 0.05)
    with pytest.raises(MapFileError, match=match) as error:
        write_map_server(grid, tmp_path / arguments[0], *arguments[1:])
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())
    with pytest.raises(MapFileError, match="empty"):
        write_map_server(OccupancyGrid(np.zeros((0, 0), np.int8), 0.05), tmp_path / "map.yaml")


PIXELS = np.full((4, 4), 254, np.uint8)
BAD = {
    "no_image": ({"image": None}, "has no 'image'"),
    "no_negate": ({"negate": None}, "has no 'negate'"),
    "picture_missing": ({"image": "other.pgm"}, "other.pgm: no such picture"),
    "picture_is_a_folder": ({"image": "."}, "no such picture"),
    "image_is_a_number": ({"image": "7"}, "image 7"),
    "image_with_a_zero": ({"image": '"a\\0b"'}, "give the name"),
    "resolution_0": ({"resolution": "0"}, "above 0"),
    "resolution_nan": ({"resolution": ".nan"}, "not a number"),
    "resolution_text": ({"resolution": "five"}, "not a number"),
    "resolution_huge": ({"resolution": "1" * 400}, "not a number"),
    "origin_short": ({"origin": "[1, 2]"}, "give \\[x, y, yaw\\]"),
    "origin_text": ({"origin": "[1, 2, north]"}, "origin 'north' is not a number"),
    "thresholds": ({"free_thresh": "0.7"}, "must rise"),
    "mode": ({"mode": "binary"}, "mode 'binary'"),
    "not_yaml": ({"image": "[\n}"}, "not YAML"),
    "tag": ({"image": "!!python/object/apply:os.system [ls]"}, "not YAML"),
    "deep": ({"image": "[" * 1500}, "not YAML"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_yaml_ends_in_one_line(tmp_path, name):
    says, match = BAD[name]
    path = made_map(tmp_path, PIXELS, **says)
    with pytest.raises(MapFileError, match=match) as error:
        read_map_server(path)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 600


@pytest.mark.parametrize(
    "image",
    [
        b"P5", b"P5 4 4", b"P5 4 4 255\n" + bytes(15), b"P5 0 4 255\n", b"P5 4 4 0\n" + bytes(16), b"P5 x 4 255\n",
        b"P5 4 4 70000\n" + bytes(64), b"P5 4 4 65535\n" + bytes(31), b"P5 999999999 999999999 255\n" + bytes(99),
        b"P5 16000 16000 255\n" + bytes(99), b"P2 4 4 255 " + b"1 " * 15, b"P2 2 1 255 1 x", b"P2 2 1 255 1 -1",
        b"P2 2 1 255 1 1.5", b"P2 2 1 255 \xff\xfe", b"", b"P7\n", b"\x89PNG\r\n\x1a\n", b"%!PS-Adobe\n",
        b"BM" + bytes(9), b"P6 99999 99999 255\n" + bytes(99),
    ],
)  # fmt: skip
def test_bad_pictures_end_in_one_line(tmp_path, image):
    with pytest.raises(MapFileError) as error:
        read_map_server(made_map(tmp_path, picture=image))
    assert str(error.value).startswith(str(tmp_path / "map.pgm"))
    assert "\n" not in str(error.value)


def test_damaged_pictures_never_crash(tmp_path):
    rng = np.random.default_rng(0)
    picture = Image.fromarray(rng.integers(0, 256, (20, 30, 4), np.uint8))
    for name, made in (("map.png", {"picture": picture}), ("map.pgm", {"pixels": rng.integers(0, 256, (20, 30))})):
        path = made_map(tmp_path, name=name, mode="scale", **made)
        whole = (tmp_path / name).read_bytes()
        for _ in range(60):
            data = bytearray(whole[: rng.integers(1, 2 * len(whole))])
            for place in rng.integers(0, min(len(data), 60), 2):
                data[place] ^= 1 << rng.integers(8)
            (tmp_path / name).write_bytes(data)
            line = complaint_about(path)
            assert not line or (line.startswith(str(tmp_path)) and "\n" not in line)


def complaint_about(path):
    try:
        read_map_server(path)
    except MapFileError as error:
        return str(error)
    return ""


def test_missing_files_are_told(tmp_path):
    with pytest.raises(MapFileError, match=r"map\.yaml: no such file"):
        read_map_server(tmp_path / "map.yaml")
    with pytest.raises(MapFileError, match=r"map\.pgm: no such file"):
        read_map_server(tmp_path / "map.pgm")
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255 a")
    with pytest.raises(MapFileError, match=r"map\.pgm: no map\.yaml next to it"):
        read_map_server(tmp_path / "map.pgm")
    (tmp_path / "map.yaml").write_text("a: 1\n")
    with pytest.raises(MapFileError, match=r"is not the \.yaml of a map_server map"):
        read_map_server(tmp_path / "map.yaml")


def test_paths_are_relative_to_the_yaml_or_absolute(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a").mkdir()
    path = made_map(tmp_path / "a", PIXELS)
    assert read_map_server("a/map.yaml").cells.shape == (4, 4)
    assert read_map_server("a/map.pgm").cells.shape == (4, 4)
    path.write_text(path.read_text().replace("map.pgm", str(tmp_path / "a/map.pgm")))
    assert read_map_server(path).cells.tolist() == [[0] * 4] * 4


@pytest.mark.skipif(not WILLOW.is_file(), reason="the Willow Garage map is not here (../shared/data/map_server)")
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_the_willow_map_comes_back_cell_for_cell(tmp_path, mode):
    grid = read_map_server(WILLOW)
    assert grid.cells.shape == (608, 566)
    assert dict(zip(*np.unique(grid.cells, return_counts=True), strict=True)) == {-1: 234377, 0: 109207, 100: 544}
    write_map_server(grid, tmp_path / "map.yaml", mode)
    np.testing.assert_array_equal(read_map_server(tmp_path / "map.yaml").cells, grid.cells)


@pytest.mark.parametrize("image", ["/home/robot/maps/floor.pgm", "~/maps/floor.pgm", "C:\\maps\\floor.pgm"])
def test_a_map_that_was_copied_finds_its_picture(tmp_path, image):
    """The saver wrote the path of the picture on the robot."""
    Image.fromarray(np.array([[0, 254], [205, 254]], np.uint8)).save(tmp_path / "floor.pgm")
    lines = ["resolution: 0.05", "origin: [0, 0, 0]", "negate: 0", "occupied_thresh: 0.65", "free_thresh: 0.196"]
    (tmp_path / "floor.yaml").write_text("\n".join([f"image: {image}", *lines]))
    assert (
        read_map_server(tmp_path / "floor.yaml").states == [[State.UNKNOWN, State.FREE], [State.OCCUPIED, State.FREE]]
    ).all()
    (tmp_path / "floor.pgm").unlink()
    with pytest.raises(MapFileError, match="no such picture"):
        read_map_server(tmp_path / "floor.yaml")
