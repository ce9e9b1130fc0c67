# SPDX-License-Identifier: Apache-2.0
"""`stereovox picture`: its views, and what it says about wrong use."""

import json

import numpy as np
import pytest

from stereovox import VoxelMap, load_config
from stereovox.cli import main


@pytest.fixture
def saved(tmp_path):
    """A map that knows no camera."""
    cells = np.argwhere(np.ones((6, 4, 5)))
    one = VoxelMap.from_cells(load_config(voxel_size=0.5, up="+z"), cells, np.where(cells[:, 0] == 5, 3.0, -1.5))
    one.save(tmp_path / "map.svox")
    return tmp_path / "map.svox"


CAMERA = ["--eye=0.2,1,1.2", "--toward=3,1,1.2"]


@pytest.mark.parametrize(
    "words", [["layer", "--at", "0.7", *CAMERA], ["axis", *CAMERA], ["space", *CAMERA], ["overview"]]
)
def test_each_view_is_written(saved, tmp_path, capsys, words):
    file = tmp_path / "map.png"
    assert main(["picture", str(saved), str(file), "--json", "--view", *words]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1]) == {"picture": str(file)}
    assert file.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("view", ["overview", "space", "layer"])
def test_a_figure_for_a_paper_is_as_wide_as_its_column(saved, tmp_path, view):
    from PIL import Image

    words = ["picture", str(saved), "--view", view, "--width-mm", "80"]
    for ending in ("png", "pdf", "svg"):
        assert main([*words[:2], str(tmp_path / f"map.{ending}"), *words[2:], "--dpi", "254"]) == 0
    picture = np.asarray(Image.open(tmp_path / "map.png").convert("RGB"))
    assert picture.shape[1] == 800
    assert (picture[0, 0] == 255).all()
    text = (tmp_path / "map.svg").read_text()
    assert 'width="226.77' in text  # 80 mm in points
    assert "<text" in text
    assert (" m</text>" if view == "space" else " [m]</text>") in text
    assert ("<image" in text) == (view != "layer")  # rectangles stay sharp
    assert b"/Type3" not in (tmp_path / "map.pdf").read_bytes()  # publishers refuse such fonts


def test_a_picture_that_is_turned_upright_says_so(saved, tmp_path, capsys):
    cells = np.argwhere(np.ones((6, 4, 5)))
    up = (0.0, -np.sin(0.5), np.cos(0.5))
    one = VoxelMap.from_cells(load_config(voxel_size=0.5, up="+z", up_direction=up), cells, np.full(len(cells), 3.0))
    one.save(tmp_path / "tilted.svox")
    page = tmp_path / "map.svg"
    for words, told in ((["tilted.svox"], True), (["tilted.svox", "--up=z"], False), ([saved.name], False)):
        assert main(["picture", str(tmp_path / words[0]), str(page), "--view", "space", *words[1:]]) == 0
        assert ("turned upright" in capsys.readouterr().err) == told
        assert ("turned upright" in page.read_text()) == told


def test_a_page_may_be_vectors_and_have_more_dots(saved, tmp_path):
    from PIL import Image

    widths = []
    for dpi in ("60", "120"):
        words = ["--view", "axis", *CAMERA, "--dpi", dpi]
        assert main(["picture", str(saved), str(tmp_path / "map.png"), *words]) == 0
        widths.append(Image.open(tmp_path / "map.png").width)
    assert 2 * widths[0] == widths[1]
    assert main(["picture", str(saved), str(tmp_path / "map.pdf"), "--view", "axis", *CAMERA]) == 0
    assert (tmp_path / "map.pdf").read_bytes().startswith(b"%PDF")


def test_rectangles_cover_just_the_chosen_cells():
    from stereovox.view.paper import runs

    chosen = np.random.default_rng(0).random((7, 9)) < 0.6
    covered = np.zeros_like(chosen)
    for corners in runs(chosen).astype(int):
        (x0, y0), (x1, y1) = corners.min(0), corners.max(0)
        assert not covered[y0:y1, x0:x1].any()
        covered[y0:y1, x0:x1] = True
    assert (covered == chosen).all()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--view", "axis", "--width-mm", "80", *CAMERA], "goes with the views overview, space, layer"),
        (["--width-mm", "5"], "--width-mm 5: give 30 to 400"),
        (["--dpi", "1"], "--dpi 1: give 20 to 2400"),
        (["--view", "axis"], "--eye=X,Y,Z --toward=X,Y,Z"),
        (["--view", "axis", "--eye=1,2"], "'1,2' is not a point"),
        (["--view", "axis", "--eye=1,2,nan", "--toward=1,2,3"], "'1,2,nan' is not a point"),
        (["--view", "axis", "--eye=1,2,3"], "needs both"),
        (["--view", "axes"], "did you mean 'axis'"),
        (["--view", "layer", "--at", "inf"], "layer at inf"),
        (["--view", "layer", "--up", "w"], "up 'w' is no axis"),
        (["--at", "1"], "--at: the view 'overview' does not use it; use it with: --view layer"),
        (["--view", "space", "--at", "1"], "--at: the view 'space' does not use it"),
        (["--eye=1,2,3"], "--eye: the view 'overview' does not use it; use it with: --view layer, --view axis, --vi"),
    ],
)
def test_mistakes_are_one_line(saved, tmp_path, capsys, words, said):
    assert main(["picture", str(saved), str(tmp_path / "map.png"), *words]) == 2
    err = capsys.readouterr().err.splitlines()
    assert len(err) == 1
    assert said in err[0]
    assert not (tmp_path / "map.png").exists()


@pytest.mark.parametrize(
    ("up", "at", "said"),
    [("z", "500", "z = 0 to 2.5 m"), ("-y", "0.1", "-y = -2 to 0 m"), ("z", "1", None), ("-y", "-0.3", None)],
)
def test_a_layer_outside_the_map_is_told(saved, tmp_path, capsys, up, at, said):
    words = ["--view", "layer", "--width-mm", "80", f"--up={up}", f"--at={at}"]
    assert main(["picture", str(saved), str(tmp_path / "map.png"), *words]) == 0
    err = capsys.readouterr().err
    assert f"outside the map ({said})" in err if said else "note:" not in err


def test_a_dark_picture_has_a_dark_page(saved, tmp_path):
    from PIL import Image

    assert main(["picture", str(saved), str(tmp_path / "map.png"), "--dark"]) == 0
    picture = np.asarray(Image.open(tmp_path / "map.png").convert("RGB"))
    assert (picture[0, 0] < 40).all()
    assert (picture > 200).all(axis=-1).mean() > 0.001
