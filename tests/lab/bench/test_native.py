# SPDX-License-Identifier: Apache-2.0
"""Peers in C++: what an adapter is given, what becomes of its errors, and that ours fit the header."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import build_peers
import numpy as np
import pytest
from made_frames import CAMERA, a_frame

from stereovox.cameras.wide import SphericalCamera
from stereovox.errors import MissingExtra, StereovoxError
from stereovox_lab.bench import native
from stereovox_lab.bench.frames import read_frames
from stereovox_lab.bench.peers import PEERS, find_peer
from stereovox_lab.bench.results import comparison_table
from stereovox_lab.bench.rows import Variant, bench, compare

COMPILER = shutil.which("c++") or shutil.which("g++")
NAMES = ("octomap-cpp", "bonxai", "ufomap", "wavemap-cpp")
TOY = """
// A "library" that adds up what it is given: occupied cells are points, free ones those beyond the range.
#include "peer.h"
#include <cmath>
#include <stdexcept>
struct Toy { double size, range, sum; int64_t points, far; int64_t loaded, loaded_far; };
static Toy& of(void* map) { return *static_cast<Toy*>(map); }
static void take(Toy& toy) { toy.points += toy.loaded - toy.loaded_far; toy.far += toy.loaded_far; }
extern "C" {
const char* peer_about() { return "a toy"; }
void* peer_new(double size, double range) {
  void* made = nullptr;
  peer::guarded([&] {
    if (size == 0.375) throw std::runtime_error("no cells\\n of 0.375 m");
    made = new Toy{size, range, 0, 0, 0, 0, 0};
  });
  return made;
}
void peer_free(void* map) { delete &of(map); }
int peer_load(void* map, const double* points, int64_t count, const double* origin) {
  return peer::guarded([&] {
    Toy& toy = of(map);
    toy.loaded = count; toy.loaded_far = 0; toy.sum = 0;
    for (int64_t i = 0; i < count; ++i) {
      double square = 0;
      for (int k = 0; k < 3; ++k) square += std::pow(points[3 * i + k] - origin[k], 2);
      toy.sum += std::sqrt(square);
      toy.loaded_far += toy.range > 0 && std::sqrt(square) > toy.range;
    }
    if (count == 7) throw std::runtime_error("seven points");
  });
}
int peer_insert(void* map) { return peer::guarded([&] { take(of(map)); }); }
int peer_load_image(void* map, const float* depth, int width, int height, const double* lens, const double* pose) {
  return peer::guarded([&] {
    Toy& toy = of(map);
    toy.loaded = toy.loaded_far = 0;
    toy.sum = lens[0] + 1000 * lens[3] + 1e6 * pose[3];  // fx, cy, x
    for (int i = 0; i < width * height; ++i) {
      toy.loaded += depth[i] > 0;
      toy.loaded_far += toy.range > 0 && depth[i] > toy.range;
    }
  });
}
int peer_insert_image(void* map) { return peer::guarded([&] { take(of(map)); }); }
int peer_load_cloud(void* map, const double* points, int64_t count, const double* pose, const double* turning) {
  return peer::guarded([&] {
    Toy& toy = of(map);
    toy.loaded = count, toy.loaded_far = 0;
    toy.sum = points[3 * count - 1] + 1000 * pose[7] + 1e6 * turning[3];  // last z, y, directions
  });
}
int peer_insert_cloud(void* map) { return peer::guarded([&] { take(of(map)); }); }
int peer_log_odds(void* map, const double* points, int64_t count, float* log_odds) {
  for (int64_t i = 0; i < count; ++i) log_odds[i] = static_cast<float>(points[3 * i + 1]) + of(map).points;
  return 0;
}
int peer_cells(void* map, int64_t* occupied, int64_t* free) {
  *occupied = of(map).points; *free = of(map).far;
  return 0;
}
int64_t peer_bytes(void* map) { return static_cast<int64_t>(std::llround(of(map).sum)); }
}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder where all peers are the toy."""
    if not COMPILER:
        pytest.skip("no C++ compiler")
    made = tmp_path_factory.mktemp("peers")
    (made / "toy.cpp").write_text(TOY)
    include = f"-I{build_peers.ADAPTERS}"
    words = [COMPILER, "-std=c++17", "-fPIC", "-shared", "-Wall", "-Werror", include, str(made / "toy.cpp"), "-o"]
    subprocess.run([*words, str(made / "bonxai.so")], check=True)
    for name in NAMES:
        if name != "bonxai":
            shutil.copy(made / "bonxai.so", made / f"{name}.so")
    return made


@pytest.fixture
def built(folder, monkeypatch):
    monkeypatch.setenv(native.FOLDER, str(folder))
    return folder


@pytest.mark.parametrize("name", NAMES)
def test_every_peer_in_c_gives_a_row(name, built):
    result = bench([a_frame(i) for i in range(3)], [0.2], [name], max_range=1.8)
    row = result["rows"][1]
    assert (row["library"], row["frames"], row["occupied"], row["free"]) == (name, 3, 3 * 400, 0)
    assert row["integrate_ms_median"] > 0


def test_points_and_origin_arrive_as_they_are(built):
    peer = find_peer("bonxai")(0.1)
    points, origin = np.array([[4.0, 1, 1], [1, 1, 13]]), np.array([1.0, 1.0, 1.0])
    peer.insert(np.asfortranarray(points), origin)
    assert peer.counts() == (2, 0)
    assert peer.bytes() == 3 + 12
    assert peer.about() == "a toy"
    call = peer.prepared(points, origin)
    assert peer.counts() == (2, 0)
    call()
    assert peer.counts() == (4, 0)
    peer.reach(5.0)
    peer.insert(points, origin)
    assert peer.counts() == (1, 1)


def test_images_lens_and_pose_arrive_as_they_are(built):
    peer = find_peer("wavemap-cpp")(0.1)
    depth_m = np.zeros((48, 64))
    depth_m[3, 5] = 1.0
    T = np.eye(4)
    T[0, 3] = 7.0
    peer.insert_image(depth_m, CAMERA, T)
    assert peer.counts() == (1, 0)
    assert peer.bytes() == round(CAMERA.fx + 1000 * CAMERA.cy + 7e6)
    with pytest.raises(StereovoxError, match=r"^wavemap-cpp is compared on pinhole cameras only"):
        peer.insert_image(depth_m, SphericalCamera.from_field_of_view(64, 48, 150, 100), T)


def test_clouds_arrive_as_they_are_and_places_are_asked_for(built):
    peer, T = find_peer("wavemap-cpp")(0.1), np.eye(4)
    T[1, 3] = 3.0
    points = np.array([[1.0, 2, 3], [4, 5, 6]], np.float32)
    peer.prepared_cloud(points, T, (-0.4, 0.1, 64, 2048))()
    assert peer.counts() == (2, 0)
    assert peer.bytes() == 6 + 3000 + 2048e6
    assert peer.log_odds(points).tolist() == [4.0, 7.0]


def test_pixels_beyond_the_range_clear_where_they_are_kept(built):
    """The frame shows 400 pixels at 1.5 m before a wall at 2.5 m."""
    frames, config = [a_frame(i) for i in range(2)], Variant().config(0.2, 1.8)
    read = read_frames(frames, config, far=True)
    far = int((frames[0].depth > 1800).sum())
    assert read.far_share == pytest.approx(far / frames[0].depth.size)
    kinds = {name: find_peer(name) for name in ("bonxai", "wavemap-cpp")}
    for recording, beyond in ((read, far), (read.without_far(config), 0)):
        result = compare(recording, [0.2], kinds, [Variant()], 1.8)
        ours, *theirs = result["rows"]
        assert [(row["occupied"], row["free"]) for row in theirs] == [(800, 2 * beyond)] * 2
        assert ("free where beyond" in comparison_table(result).title) == bool(beyond)
        if beyond:
            cleared = ours["free"]
    assert cleared > 2 * ours["free"]


def test_a_peer_that_cannot_clear_is_left_out_and_named():
    config = Variant().config(0.2, 1.8)
    read = read_frames([a_frame()], config, far=True)

    class Blind:
        def __init__(self, voxel_size):
            pass

        insert = counts = bytes = None

    result = compare(read, [0.2], {"blind": Blind}, [Variant()], 1.8)
    assert [row["library"] for row in result["rows"]] == ["stereovox"]
    assert "blind cannot clear along such pixels and is left out." in comparison_table(result).text()


def test_errors_of_a_library_are_one_line(built):
    with pytest.raises(StereovoxError, match=r"^bonxai: no cells of 0\.375 m$"):
        find_peer("bonxai")(0.375)
    with pytest.raises(StereovoxError, match=r"^bonxai: seven points$"):
        find_peer("bonxai")(0.1).insert(np.ones((7, 3)), np.zeros(3))


def test_an_adapter_that_is_not_built_is_named_with_the_cure(monkeypatch, tmp_path):
    monkeypatch.delenv(native.FOLDER, raising=False)
    cure = "run benchmarks/build_peers.py and set STEREOVOX_PEERS to its --out"
    with pytest.raises(MissingExtra, match=rf"^bonxai: STEREOVOX_PEERS is not set; {cure}$"):
        find_peer("bonxai")(0.1)
    monkeypatch.setenv(native.FOLDER, str(tmp_path))
    with pytest.raises(MissingExtra, match=f"there is no {re.escape(str(tmp_path))}/bonxai.so; {cure}"):
        find_peer("bonxai")(0.1)
    (tmp_path / "ufomap.so").write_bytes(b"no library")
    with pytest.raises(MissingExtra, match=r"^ufomap: .* cannot be used"):
        find_peer("ufomap")(0.1)


def test_a_library_without_the_functions_is_named(folder, monkeypatch, tmp_path):
    (tmp_path / "other.cpp").write_text('extern "C" int another() { return 1; }')
    target = tmp_path / "bonxai.so"
    subprocess.run([COMPILER, "-shared", "-fPIC", str(tmp_path / "other.cpp"), "-o", str(target)], check=True)
    monkeypatch.setenv(native.FOLDER, str(tmp_path))
    with pytest.raises(MissingExtra, match="peer_about"):
        find_peer("bonxai")(0.1)


def test_adapters_and_peers_go_by_the_same_names():
    assert set(build_peers.LIBRARIES) == set(NAMES) <= set(PEERS)
    for name, library in build_peers.LIBRARIES.items():
        text = (build_peers.ADAPTERS / library.adapter).read_text()
        assert all(f"{function}(" in text for function in find_peer(name).functions if function != "peer_error")


def test_what_cannot_be_built_is_told_and_the_rest_is_built(tmp_path):
    """Without checkouts, and with one that is not what it should be."""
    (tmp_path / "bonxai").mkdir()
    script = Path(build_peers.__file__)
    words = [sys.executable, str(script), str(tmp_path), "--out", str(tmp_path / "out"), "bonxai", "ufomap"]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 2
    assert f"bonxai: not built: {tmp_path}/bonxai has no bonxai_map/src/probabilistic_map.cpp" in done.stderr
    assert f"ufomap: not built: no ufomap in {tmp_path}; clone it there" in done.stderr


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (file := tmp_path / "file").touch()
    words = [sys.executable, build_peers.__file__, str(tmp_path), "--out", str(file)]
    done = subprocess.run(words, capture_output=True, text=True)
    assert done.returncode == 2
    assert done.stderr.splitlines()[-1].endswith(f"--out {file}: File exists; name a folder that can be written")


def test_a_library_is_built_from_its_checkout(tmp_path, monkeypatch):
    """A made library: a header, a source, and an adapter that calls it."""
    if not COMPILER:
        pytest.skip("no C++ compiler")
    source = tmp_path / "src" / "Made"
    (source / "code").mkdir(parents=True)
    (source / "made.h").write_text("const char* made();\n")
    (source / "code/made.cpp").write_text('#include "made.h"\nconst char* made() { return "made"; }\n')
    body = TOY.replace('return "a toy"', "return made()").replace(
        '#include "peer.h"', '#include "peer.h"\n#include "made.h"'
    )
    adapters = tmp_path / "adapters"
    shutil.copytree(build_peers.ADAPTERS, adapters)
    (adapters / "bonxai.cpp").write_text(body)
    monkeypatch.setattr(build_peers, "ADAPTERS", adapters)
    monkeypatch.setitem(
        build_peers.LIBRARIES, "bonxai", build_peers.Library("bonxai.cpp", "made", (".",), ("code/*.cpp",))
    )
    build_peers.build("bonxai", tmp_path / "src", tmp_path, "native", COMPILER)
    monkeypatch.setenv(native.FOLDER, str(tmp_path))
    assert find_peer("bonxai")(0.1).about() == "made"
    (source / "code/made.cpp").write_text("const char* made() { return 1 }\n")
    with pytest.raises(build_peers.CannotBuildError, match=r"(?s)failed:.*made\.cpp.*error"):
        build_peers.build("bonxai", tmp_path / "src", tmp_path, "native", COMPILER)
