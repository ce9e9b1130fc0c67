# SPDX-License-Identifier: Apache-2.0
"""The comparison with other libraries: same frames and pixels, a complete result, a table people understand."""

import json
import os
import sys
import time
from dataclasses import replace
from importlib.util import find_spec
from itertools import groupby
from types import SimpleNamespace

import numpy as np
import pytest
from made_frames import CAMERA, a_frame

from stereovox.cameras.wide import SphericalCamera
from stereovox.errors import ConfigError, MissingExtra, StereovoxError
from stereovox.frame import Frame, Reason
from stereovox_lab.bench import peers as peers_module
from stereovox_lab.bench import rows as bench_module
from stereovox_lab.bench.frames import read_frames
from stereovox_lab.bench.peers import PEERS, find_peer, installed
from stereovox_lab.bench.results import comparison_table
from stereovox_lab.bench.rows import PASSES, Variant, bench, compare, format_table

ROW_KEYS = {
    "library", "voxel_size", "threads", "frames", "integrate_ms_median", "integrate_ms_p90", "integrate_ms_p99",
    "occupied", "free", "map_bytes", "cpu_share",
}  # fmt: skip
LIBRARY = {"octomap": "octomap", "octomap-rays": "octomap", "pyoctomap": "pyoctomap"}


def only_if_installed(*names):
    missing = [name for name in names if not find_spec(LIBRARY[name])]
    if missing:
        pytest.skip(f"{', '.join(missing)} not installed: pip install 'stereovox[bench]'")
    return list(names)


class Recorder:
    """A peer that needs no library and remembers what it was given."""

    made: list["Recorder"] = []  # noqa: RUF012

    def __init__(self, voxel_size):
        self.voxel_size, self.inserted = voxel_size, []
        Recorder.made.append(self)

    def insert(self, points, origin):
        self.inserted.append((points, origin))

    def counts(self):
        return 3, 4

    def bytes(self):
        return 5


@pytest.fixture
def recorder(monkeypatch):
    """Put the peer `recorder` into the registry; return all that are made."""
    monkeypatch.setattr(Recorder, "made", [])
    monkeypatch.setitem(PEERS, "recorder", "a_made_module:Recorder")
    monkeypatch.setitem(sys.modules, "a_made_module", SimpleNamespace(Recorder=Recorder))
    return Recorder.made


def test_every_library_gives_a_complete_row_with_cells_that_agree():
    names = only_if_installed(*LIBRARY)
    result = bench([a_frame(i) for i in range(6)], [0.2, 0.1], names, threads=2)
    rows = {(row["library"], row["voxel_size"]): row for row in result["rows"]}
    assert list(rows) == [(library, size) for size in (0.2, 0.1) for library in ("stereovox", *names)]
    assert result["ratio"].keys() == {"0.2", "0.1"}
    for (library, size), row in rows.items():
        assert row.keys() >= ROW_KEYS
        assert row["frames"] == 6
        assert row["threads"] == (2 if library == "stereovox" else 1)
        assert row["map_bytes"] > row["occupied"] > 20
        assert row["free"] > 20
        assert 0 < row["integrate_ms_median"] <= 1.001 * row["integrate_ms_p90"] <= 1.002 * row["integrate_ms_p99"]
        ours = rows["stereovox", size]
        assert ours["occupied"] / 2 < row["occupied"] < 2 * ours["occupied"], library
        assert ours["free"] / 2 < row["free"] < 3 * ours["free"], library  # ours leaves a margin before surfaces
        if library != "stereovox":
            ratio = row["integrate_ms_median"] / ours["integrate_ms_median"]
            assert result["ratio"][str(size)][library] == pytest.approx(ratio, rel=1e-2)
    assert all("depth_ms_median" in rows["stereovox", size] for size in (0.2, 0.1))


@pytest.mark.parametrize("name", list(LIBRARY))
def test_a_peer_counts_cells_and_not_nodes(name):
    """A full cube of 4x4x4 cells at the clamping limit is pruned to one node; it still is 64 cells."""
    only_if_installed(name)
    voxel_size = 0.25
    peer = find_peer(name)(voxel_size)
    inside = (np.stack(np.mgrid[:4, :4, :4], axis=-1).reshape(-1, 3) + 0.5) * voxel_size
    for point in inside:
        for _ in range(20):
            peer._tree.updateNode(point, True)
    peer._tree.updateNode(np.array([-3.1, 0.1, 0.1]), False)
    assert peer._tree.getNumLeafNodes() == 2
    assert peer.counts() == (64, 1)
    assert peer.bytes() > 0


def test_two_bindings_of_octomap_build_the_same_tree_in_one_process():
    result = bench([a_frame(i) for i in range(3)], [0.1], only_if_installed("octomap", "pyoctomap"))
    _, one, other = result["rows"]
    assert (one["occupied"], one["free"]) == (other["occupied"], other["free"])


def test_peers_get_the_points_of_the_pixels_that_count(recorder):
    frame = a_frame()
    bench([frame], [0.1], ["recorder"], max_range=1.8)
    points, origin = recorder[-1].inserted[0]
    assert origin == pytest.approx(frame.T_world_sensor[:3, 3])
    assert points.shape == (20 * 20, 3)
    assert points.dtype == np.float64
    assert points.flags.c_contiguous
    v, u = np.mgrid[20:40, 20:40].reshape(2, -1)
    slopes = (u - 31.5) / 40.0, (v - 23.5) / 40.0
    wanted = np.stack([np.full(400, 1.5), 0.02 - 1.5 * slopes[0], 1.0 - 1.5 * slopes[1]], axis=1)
    assert points == pytest.approx(wanted, abs=1e-6)


def test_peers_get_the_points_of_a_wide_camera(recorder):
    """A wide camera's depth is the distance from its x axis: the pixel is found again from the angles of its point."""
    camera = SphericalCamera.from_field_of_view(64, 48, 150, 100)
    depth = np.zeros((48, 64), np.float32)
    depth[[3, 30], [5, 60]] = 1.5, 2.5
    bench([Frame(depth, camera, a_frame().T_world_sensor)], [0.1], ["recorder"])
    points, origin = recorder[-1].inserted[0]
    z, x, y = ((points - origin) * [1, -1, -1]).T
    assert np.hypot(y, z) == pytest.approx([1.5, 2.5], abs=1e-5)
    assert np.degrees(np.arctan2(x, np.hypot(y, z))) == pytest.approx((np.array([5, 60]) - 31.5) * 150 / 64, abs=1e-3)
    assert np.degrees(np.arctan2(y, z)) == pytest.approx((np.array([3, 30]) - 23.5) * 100 / 48, abs=1e-3)


def test_stereovox_gets_no_pixel_that_peers_do_not_get(recorder):
    """Beyond the maximum range it would clear space, which no peer may; so it must not either."""
    with_strip = [a_frame(i) for i in range(6)]
    only_box = [replace(f, depth=np.where(f.depth == 1500, f.depth, 0).astype(np.uint16)) for f in with_strip]
    with_far = bench(with_strip, [0.1], ["recorder"], max_range=1.8)["rows"][0]
    without = bench(only_box, [0.1], ["recorder"], max_range=1.8)["rows"][0]
    assert without["free"] > 0
    assert (with_far["occupied"], with_far["free"]) == (without["occupied"], without["free"])


def test_pixels_the_source_masked_are_left_out_for_all(recorder):
    frame = a_frame()
    reason = np.where(frame.depth == 1500, Reason.MASKED, Reason.VALID).astype(np.uint8)
    bench([replace(frame, reason=reason)], [0.1], ["recorder"])
    points, _ = recorder[-1].inserted[0]
    assert len(points) == 48 * 60 - 25 - 400


def test_a_peer_is_timed_on_a_fresh_map_after_a_warm_up(recorder):
    bench([a_frame(i) for i in range(3)], [0.2, 0.1], ["recorder"])
    used = [(peer.voxel_size, len(peer.inserted)) for peer in recorder if peer.inserted]
    assert used == [(0.2, 1), (0.2, 3), (0.1, 1), (0.1, 3)]


def test_a_peer_stops_when_its_time_is_over_but_not_before_five_frames(recorder):
    result = bench([a_frame(i) for i in range(8)], [0.2], ["recorder"], budget_s=0.0)
    ours, peer = result["rows"]
    assert (ours["frames"], peer["frames"]) == (8, 5)
    assert "recorder at 0.2 m stopped at its time limit after 5 of 8 frames" in format_table(result)


def test_bad_frames_are_left_out_for_all_and_counted(recorder):
    far = a_frame(1, wall=9.0)
    far.depth[20:40, 20:40] = 0
    crooked = replace(a_frame(2), T_world_sensor=np.diag([1.0, 1.0, 3.0, 1.0]))
    result = bench([far, a_frame(0), crooked], [0.2], ["recorder"])
    assert (result["frames"], result["frames_refused"]) == (1, 2)
    assert [row["frames"] for row in result["rows"]] == [1, 1]
    assert "2 frames were refused, first: frame 1: no depth up to 5 m" in format_table(result).splitlines()


def test_frames_limit_and_progress(recorder):
    told = []
    frames = (a_frame(i) for i in range(1000))
    result = bench(frames, [0.2], ["recorder"], frames_limit=4, progress=lambda *done: told.append(done))
    assert result["frames"] == 4
    assert next(frames).stamp_ns == 4
    texts = list(dict.fromkeys(text for _, _, text in told))
    reading, warming = "reading frames", "stereovox at 0.2 m, warming up"
    assert texts == [
        f"{reading}: compiling, if need be", reading, f"{warming}: compiling, if need be", warming,
        "stereovox at 0.2 m, timing", "recorder at 0.2 m",
    ]  # fmt: skip
    assert told[-1][:2] == (4, 4)


def test_slips_of_the_user_are_one_line_before_any_frame_is_read():
    def unread():
        raise AssertionError("a frame was asked for")
        yield

    with pytest.raises(ConfigError, match=r"unknown peer 'octomop' \(did you mean 'octomap'\?\)$"):
        bench(unread(), [0.1], ["octomop"])
    with pytest.raises(ConfigError, match="voxel_size"):
        bench(unread(), [0.1, -1.0], [])
    with pytest.raises(ConfigError, match="threads"):
        bench(unread(), [0.1], [], threads=0)
    with pytest.raises(StereovoxError, match=r"^no voxel size"):
        bench(unread(), [], [])


@pytest.mark.parametrize(("name", "package"), [("octomap", "octomap-python"), ("pyoctomap", "pyoctomap")])
def test_a_library_that_is_missing_is_named_with_the_cure(monkeypatch, name, package):
    def missing(module):
        raise ModuleNotFoundError(module)

    monkeypatch.setattr(peers_module, "import_module", missing)
    with pytest.raises(MissingExtra, match=rf"^{package} is not installed; run: pip install 'stereovox\[bench\]'$"):
        bench([a_frame()], [0.1], [name])


def test_no_usable_frame_is_one_line():
    blind = replace(a_frame(), depth=np.zeros((48, 64), np.uint16))
    with pytest.raises(StereovoxError, match=r"not one frame can be used \(frame 0: no pixel"):
        bench([blind, blind], [0.1], [])
    with pytest.raises(StereovoxError, match="the source is empty"):
        bench([], [0.1], [])


def made_result():
    rows = []
    for size, ours_ms in ((0.2, 0.5), (0.05, 2.0)):
        for library, ms, frames in (("stereovox", ours_ms, 50), ("octomap", 21.0, 50), ("slow", 1.0, 7)):
            rows.append(
                {"library": library, "voxel_size": size, "threads": 1, "frames": frames, "integrate_ms_median": ms,
                 "integrate_ms_p90": 2 * ms, "integrate_ms_p99": 3 * ms,
                 "occupied": 1234567, "free": 20, "map_bytes": 2_500_000,
                 **({"integrator": "projective"} if library == "stereovox" else {})}
            )  # fmt: skip
    ratio = {"0.2": {"octomap": 42.0, "slow": 2.0}, "0.05": {"octomap": 10.5, "slow": 0.5}}
    return {"source": "kitchen", "image": "640x480", "frames": 50, "frames_refused": 0, "first_refusal": "",
            "max_range": 5.0, "budget_s": 60.0, "rows": rows, "ratio": ratio}  # fmt: skip


def test_the_table_shows_our_row_first_and_how_many_times_faster():
    text = format_table(made_result())
    lines = text.splitlines()
    assert lines[0] == "kitchen: 50 frames of 640x480, depth up to 5 m"
    head = next(line for line in lines if line.startswith("voxel"))
    start = lines.index(next(line for line in lines if line.startswith("0.2 m")))
    assert [line.split()[0] for line in lines[start + 1 : start + 3]] == ["octomap", "slow"]
    assert lines[start].split()[2:] == [
        "stereovox", "1", "50", "0.50", "1.00", "1.50", "1,234,567", "20", "2.5"
    ]  # fmt: skip
    assert "42 x faster" in lines[start + 1]
    end = head.index("stereovox is") + len("stereovox is")
    assert lines[start + 1][:end].endswith(" 42 x faster")
    assert "2.0 x faster" in lines[start + 2]
    assert text.count("2.0 x slower") == 1
    assert text.count("stopped at its time limit after 7 of 50 frames") == 2
    assert all(len(line) <= 120 for line in lines)


def test_a_result_without_peers_is_a_table_too():
    result = bench([a_frame()], [0.2], [])
    assert result["ratio"] == {"0.2": {}}
    table = comparison_table(result)
    assert "stereovox is" not in table.head
    assert [len(row) for row in table.groups[0]] == [len(table.head)]
    assert [row["library"] for row in result["rows"]] == ["stereovox"]


def test_variants_are_rows_of_their_own_and_make_the_same_map():
    ways = [Variant(threads=2), Variant("ray"), Variant("ray", 2)]
    result = bench([a_frame(i) for i in range(3)], [0.2, 0.1], [], variants=ways)
    assert [(row["library"], row["threads"]) for row in result["rows"]] == [("stereovox", 1)] * 2
    rows = [(row["library"], row["integrator"], row["threads"], row["voxel_size"]) for row in result["variants"]]
    names = [("stereovox", "projective", 2), ("stereovox-ray", "ray", 1), ("stereovox-ray", "ray", 2)]
    assert rows == [(*name, size) for size in (0.2, 0.1) for name in names]
    for one, two in zip(result["rows"], result["variants"][::3], strict=True):
        assert (one["occupied"], one["free"]) == (two["occupied"], two["free"])
    lines = format_table(result).splitlines()
    block = lines[lines.index(next(line for line in lines if line.startswith("0.1 m"))) :][:4]
    assert [line.split()[-9:-7] for line in block] == [["1", "3"], ["2", "3"], ["1", "3"], ["2", "3"]]
    assert "stereovox-ray" in block[2]


def test_the_first_variant_is_what_peers_are_compared_with(recorder):
    """Whatever its integrator: first in the table, the peer's ratio is to it."""
    recording = read_frames([a_frame(i) for i in range(2)], Variant().config(0.2))
    ways = [Variant("ray"), Variant("ray", 2), Variant(), Variant(threads=2)]
    result = compare(recording, [0.2], {"recorder": Recorder}, ways)
    names = ["stereovox-ray", "stereovox-ray", "stereovox", "stereovox", "recorder"]
    (rows,) = comparison_table(result).groups
    assert [row[1:3] for row in rows] == list(zip(names, "12121", strict=True))
    assert rows[0][0] == "0.2 m"
    ours, peer = result["rows"]
    ratio = peer["integrate_ms_median"] / ours["integrate_ms_median"]
    assert result["ratio"]["0.2"]["recorder"] == pytest.approx(ratio, abs=1e-3, rel=1e-2)


def test_stereovox_is_timed_before_and_after_each_peer(recorder):
    """So that a machine that slows down in between slows both."""
    told = []
    frames = [a_frame(i) for i in range(2)]
    for name in ("second", "third", "fourth"):
        PEERS[name] = PEERS["recorder"]
    try:
        result = bench(
            frames, [0.2], ["recorder", "second", "third", "fourth"], progress=lambda *done: told.append(done[2])
        )
    finally:
        for name in ("second", "third", "fourth"):
            del PEERS[name]
    timing, warming = "stereovox at 0.2 m, timing", "stereovox at 0.2 m, warming up"
    assert told[:3] == ["reading frames: compiling, if need be", *2 * ["reading frames"]]
    order = [text for text, _ in groupby(told[3:])]
    assert order == [
        f"{warming}: compiling, if need be", warming,
        timing, "recorder at 0.2 m", timing, "second at 0.2 m", timing, "third at 0.2 m", timing, "fourth at 0.2 m",
        timing,
    ]  # fmt: skip
    assert result["rows"][0]["passes"] == 5
    assert result["rows"][0]["frames"] == 2


def test_a_slow_variant_is_not_repeated(monkeypatch):
    monkeypatch.setattr(bench_module, "ENOUGH_S", 1e-9)
    assert bench([a_frame()], [0.2], [])["rows"][0]["passes"] == 1
    monkeypatch.undo()
    assert bench([a_frame()], [0.2], [])["rows"][0]["passes"] == PASSES


def test_what_is_done_is_handed_over_after_each_voxel_size(recorder):
    recording = read_frames([a_frame(i) for i in range(2)], Variant().config(0.2))
    seen = []

    def so_far(result):
        seen.append([(row["library"], row["voxel_size"]) for row in result["rows"]])
        if len(seen) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare(recording, [0.2, 0.1, 0.05], {"recorder": find_peer("recorder")}, [Variant()], so_far=so_far)
    both = [("stereovox", 0.2), ("recorder", 0.2), ("stereovox", 0.1), ("recorder", 0.1)]
    assert seen == [both[:2], both]


def test_a_result_names_the_machine():
    result = bench([a_frame()], [0.2], [])
    assert result["machine"].keys() >= {"cpu", "cores", "numpy", "numba", "python"}
    assert result["machine"]["numpy"] == np.__version__
    assert f"numpy {np.__version__}" in format_table(result)


def test_the_markdown_table_holds_what_the_text_holds():
    result = made_result()
    lines = comparison_table(result).markdown().splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("|")]
    assert rows[2] == ["0.2 m", "stereovox", "1", "50", "0.50", "1.00", "1.50", "", "1,234,567", "20", "2.5"]
    assert len({len(row) for row in rows}) == 1
    assert len(rows) == 2 + 6
    assert lines[0] == "## kitchen: 50 frames of 640x480, depth up to 5 m"


class TakesImages:
    """A peer that wants depth images."""

    seen: list[tuple] = []  # noqa: RUF012

    def __init__(self, voxel_size):
        pass

    def insert_image(self, depth_m, camera, T_world_camera):
        TakesImages.seen.append((depth_m, camera, T_world_camera))

    def counts(self):
        return 1, 2

    def bytes(self):
        return 3


def test_a_peer_may_take_images(monkeypatch):
    monkeypatch.setattr(TakesImages, "seen", [])
    monkeypatch.setitem(sys.modules, "a_made_module", SimpleNamespace(TakesImages=TakesImages))
    frame = a_frame()
    row = bench([frame], [0.2], ["a_made_module:TakesImages"])["rows"][1]
    assert (row["library"], row["occupied"], row["free"], row["map_bytes"]) == ("a_made_module:TakesImages", 1, 2, 3)
    depth_m, camera, T = TakesImages.seen[-1]
    wanted = np.where(frame.depth < 5000, frame.depth / 1000, 0)
    assert depth_m.dtype == np.float32
    assert ((depth_m == 0) == (wanted == 0)).all()
    assert depth_m == pytest.approx(wanted, abs=0.15)  # denoised, as for all
    assert camera is CAMERA
    assert pytest.approx(frame.T_world_sensor) == T


@pytest.mark.parametrize(
    ("name", "said"),
    [("no_such_module:Toy", "No module named 'no_such_module'"), ("math:Toy", "no attribute 'Toy'"), (":Toy", "Empty")],
)
def test_a_class_that_is_not_there_is_one_line(name, said):
    with pytest.raises(ConfigError, match=f"^peer '{name}': .*{said}.*; write module:Class") as error:
        find_peer(name)
    assert "\n" not in str(error.value)


def a_peer(**changes):
    """Return a class of a peer that works, but for what is changed; None takes a method away."""
    methods = {
        "__init__": lambda self, voxel_size: None,
        "insert": lambda self, points, origin: None,
        "counts": lambda self: (1, 2),
        "bytes": lambda self: 3,
    }
    return type("Toy", (), {name: method for name, method in (methods | changes).items() if method})


def fails(*_):
    raise RuntimeError("no more\n  of this")


@pytest.mark.parametrize(
    ("toy", "said"),
    [
        (a_peer(insert=None), "peer 'toys:Toy' has no insert; it needs insert or insert_image, counts and bytes"),
        (a_peer(counts=None, bytes=None), "peer 'toys:Toy' has no counts and no bytes; "),
        (3, "peer 'toys:Toy' is not a class but int; write module:Class"),
        (a_peer(__init__=lambda self: None), "peer 'toys:Toy' cannot be made: TypeError: "),
        (a_peer(__init__=fails), "peer 'toys:Toy' cannot be made: RuntimeError: no more of this"),
    ],
    ids=["no insert", "no counts", "no class", "no argument", "fails"],
)
def test_a_peer_that_cannot_be_used_is_one_line_before_the_work(toy, said, monkeypatch):
    def unread():
        raise AssertionError("a frame was asked for")
        yield

    monkeypatch.setitem(sys.modules, "toys", SimpleNamespace(Toy=toy))
    with pytest.raises(ConfigError) as error:
        bench(unread(), [0.1], ["toys:Toy"])
    assert str(error.value).startswith(said)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("class Toy\n", "SyntaxError: "),
        ("import sys\nsys.exit(4)\n", "SystemExit: 4"),
        ("1 / 0\n", "ZeroDivisionError: "),
    ],
)
def test_a_module_that_cannot_be_imported_is_one_line(code, said, monkeypatch, tmp_path):
    (tmp_path / "a_bad_toy.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ConfigError, match=f"^peer 'a_bad_toy:Toy': {said}") as error:
        find_peer("a_bad_toy:Toy")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("toy", "said"),
    [
        (a_peer(insert=fails), "RuntimeError: no more of this"),
        (a_peer(insert=lambda self, points: None), "TypeError: "),
        (a_peer(counts=lambda self: 7), "TypeError: "),
        (a_peer(counts=lambda self: (1, None)), "TypeError: "),
        (a_peer(bytes=fails), "RuntimeError: no more of this"),
    ],
    ids=["insert fails", "wrong arguments", "one count", "no count", "bytes fails"],
)
def test_a_peer_that_fails_is_one_line_with_its_name(toy, said, monkeypatch):
    monkeypatch.setitem(sys.modules, "toys", SimpleNamespace(Toy=toy))
    with pytest.raises(StereovoxError, match=f"^peer 'toys:Toy' at 0.1 m: {said}") as error:
        bench([a_frame()], [0.1], ["toys:Toy"])
    assert "\n" not in str(error.value)


def test_numbers_of_numpy_become_plain_ones(monkeypatch):
    toy = a_peer(counts=lambda self: np.array([5, 6]), bytes=lambda self: np.uint32(7))
    monkeypatch.setitem(sys.modules, "toys", SimpleNamespace(Toy=toy))
    row = json.loads(json.dumps(bench([a_frame()], [0.1], ["toys:Toy"])))["rows"][1]
    assert (row["occupied"], row["free"], row["map_bytes"]) == (5, 6, 7)


def test_another_package_adds_a_peer_by_an_entry_point(monkeypatch):
    entry = SimpleNamespace(name="theirs", load=lambda: Recorder)
    groups = {"stereovox.peers": [entry]}
    monkeypatch.setattr("stereovox.registry.entry_points", lambda group: groups.get(group, []))
    assert find_peer("theirs") is Recorder
    with pytest.raises(ConfigError, match="did you mean 'theirs'"):
        find_peer("their")


def test_libraries_that_are_missing_are_told_with_what_to_install(monkeypatch):
    for module in ("octomap", "pywavemap"):
        monkeypatch.setitem(sys.modules, module, None)
    here, missing = installed(["octomap", "wavemap"])
    assert here == []
    assert missing == [
        "octomap: octomap-python is not installed; run: pip install 'stereovox[bench]'",
        "wavemap: pywavemap is not installed; run: pip install "
        "'git+https://github.com/ethz-asl/wavemap#subdirectory=library/python'",
    ]
    text = format_table({**made_result(), "not_installed": missing})
    assert "without wavemap: pywavemap is not installed; run: pip install 'git+" in text


def made_wavemap(known):
    """Return what looks like pywavemap: it keeps what it is given; `known` are the log-odds of cells by index."""

    class Map:
        create = staticmethod(lambda kind: SimpleNamespace(
            kind=kind, memory_usage=77,
            get_cell_values=lambda cells: np.array([known.get(tuple(cell), 0.0) for cell in cells.tolist()]),
        ))  # fmt: skip

    class Pipeline:
        def __init__(self, voxel_map):
            self.map, self.integrators, self.ran = voxel_map, {}, []

        def clear_integrators(self):
            self.integrators = {}

        def add_integrator(self, name, settings):
            self.integrators[name] = settings

        def run_pipeline(self, names, posed):
            self.ran.append((names, posed))

    return SimpleNamespace(
        Map=Map, Pipeline=Pipeline, Pose=lambda T: T, Image=lambda pixels: pixels, PosedImage=lambda *both: both
    )


def test_wavemap_gets_the_image_its_way_and_its_cells_are_counted(monkeypatch):
    known = {(0, 0, 0): 0.5, (3, 1, 9): -0.2, (4, 1, 9): -2.0, (5, 5, 5): 1e-9}
    monkeypatch.setattr(peers_module, "import_module", lambda name: made_wavemap(known))
    allowed = os.sched_getaffinity(0)
    peer = find_peer("wavemap")(0.4)
    assert os.sched_getaffinity(0) == allowed
    depth_m = np.zeros((48, 64), np.float32)
    depth_m[3, 5] = 1.7
    T = a_frame().T_world_sensor
    peer.insert_image(depth_m, CAMERA, T)
    names, (pose, pixels) = peer._pipeline.ran[0]
    assert names == list(peer._pipeline.integrators) == ["camera"]
    assert pixels.shape == (64, 48)
    assert pixels[5, 3] == np.float32(1.7)
    assert pytest.approx(T) == pose
    settings = peer._pipeline.integrators["camera"]
    lens = {"width": 64, "height": 48, "fx": 40.0, "fy": 40.0, "cx": 31.5, "cy": 23.5}
    assert settings["projection_model"].items() >= lens.items()
    assert settings["integration_method"]["max_range"] == {"meters": 2.0}
    assert peer._map.kind["min_cell_width"] == {"meters": 0.4}
    peer.insert_image(2 * depth_m, CAMERA, T)
    assert peer._pipeline.integrators["camera"]["integration_method"]["max_range"] == {"meters": 4.0}
    assert peer.counts() == (1, 2)
    assert peer.bytes() == 77


def test_wavemap_refuses_a_wide_camera(monkeypatch):
    monkeypatch.setattr(peers_module, "import_module", lambda name: made_wavemap({}))
    camera = SphericalCamera.from_field_of_view(64, 48, 150, 100)
    with pytest.raises(StereovoxError, match="pinhole cameras only"):
        find_peer("wavemap")(0.1).insert_image(np.ones((48, 64), np.float32), camera, np.eye(4))


def test_wavemap_itself_sees_the_wall():
    pytest.importorskip("pywavemap", reason="wavemap is not on PyPI")
    ours, peer = bench([a_frame(i) for i in range(6)], [0.05], ["wavemap"])["rows"]
    assert ours["free"] / 2 < peer["free"] < 2 * ours["free"]
    assert peer["occupied"] > 20


def test_a_busy_machine_is_told():
    """A peer that waits as long as it works, as if another program had the processor."""
    calm = made_result()
    for row in calm["rows"]:
        row["cpu_share"] = 0.97
    assert "in the way" not in format_table(calm)
    calm["rows"][4]["cpu_share"], calm["rows"][0]["cpu_share"] = 0.42, 0.8
    calm["variants"] = [calm["rows"][0] | {"threads": 2, "cpu_share": 0.3}]
    worst = "octomap at 0.05 m got 42% of a processor"
    assert f"in the way of 2 of 6 rows of one thread; the worst: {worst}. Measure again." in format_table(calm)


def test_waiting_takes_no_processor(monkeypatch):
    class Waits(Recorder):
        def insert(self, points, origin):
            time.sleep(0.01)

    monkeypatch.setitem(sys.modules, "a_made_module", SimpleNamespace(Waits=Waits))
    ours, peer = bench([a_frame(i) for i in range(3)], [0.2], ["a_made_module:Waits"])["rows"]
    assert peer["cpu_share"] < 0.5
    assert ours["cpu_share"] > 0
