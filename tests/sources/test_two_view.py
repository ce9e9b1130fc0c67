# SPDX-License-Identifier: Apache-2.0
"""Pairs of Middlebury and ETH3D: depth comes out right, whatever the offset, scale and way of writing."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from made_recordings import write_png

from stereovox.config import load_config
from stereovox.depth.stereo.pipeline import StereoDepth, rectified
from stereovox.errors import SourceError
from stereovox.opening import open_source
from stereovox.sources.rigs.two_view import TwoView

WIDTH, HEIGHT, F, BASELINE_MM = 160, 120, 100.0, 100.0
SHIFT = 8
"""Pixels between both images of everything: a wall."""


def scene(folder: Path, doffs: float = 0.0, brackets: bool = True, times: float = 1.0, **more: float) -> Path:
    """A wall at 100 px * 0.1 m / (8 + doffs) px; calib.txt is of images `times` as large."""
    pattern = np.random.default_rng(1).integers(0, 255, (HEIGHT, WIDTH + SHIFT), np.uint8)
    pattern = cv2.GaussianBlur(pattern, (0, 0), 1.2) * 3
    write_png(folder / "im0.png", np.ascontiguousarray(pattern[:, :WIDTH]))
    write_png(folder / "im1.png", np.ascontiguousarray(pattern[:, SHIFT:]))

    def camera(cx: float) -> str:
        rows = [[F * times, 0, (cx + 0.5) * times - 0.5], [0, F * times, 60 * times - 0.5], [0, 0, 1]]
        text = "; ".join(" ".join(f"{number:g}" for number in row) for row in rows)
        return f"[{text}]" if brackets else text.replace(";", "")

    values = {"doffs": doffs, "baseline": BASELINE_MM, "width": WIDTH * times, "height": HEIGHT * times, "ndisp": 30}
    lines = [f"cam0={camera(75)}", f"cam1={camera(75 + doffs)}"]
    lines += [f"{key}={value:g}" for key, value in (values | more).items()]
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    return folder


def distance_of_the_wall(where: Path | str) -> float:
    """Return the median depth of the first frame."""
    depth = StereoDepth(load_config(**{"stereo.disparities": 32}).stereo)(open_source(where).frame(0)).depth
    return float(np.nanmedian(depth))


@pytest.mark.parametrize(("doffs", "distance"), [(0.0, 1.25), (2.5, 10 / 10.5)])
def test_the_wall_is_where_the_disparity_says(tmp_path, doffs, distance):
    assert distance_of_the_wall(scene(tmp_path, doffs)) == pytest.approx(distance, abs=0.03)


def test_other_ways_of_writing(tmp_path):
    plain = open_source(scene(tmp_path / "a"))
    assert isinstance(plain, TwoView)
    camera = plain.camera
    assert (camera.fx, camera.cx, camera.cy, camera.baseline) == (100, 75, 59.5, 0.1)
    assert open_source(scene(tmp_path / "b", brackets=False)).camera == camera
    metres = open_source(scene(tmp_path / "c", baseline=0.1))
    assert metres.camera == camera
    assert "baseline=0.1 is assumed to be metres" in "\n".join(metres.notes)
    larger = open_source(scene(tmp_path / "d", times=4))
    assert larger.camera.cx == pytest.approx(75)
    assert larger.camera.fx == pytest.approx(100)
    assert "larger or smaller images" in "\n".join(larger.notes)
    path = scene(tmp_path / "e") / "calib.txt"
    path.write_text("\n".join(line for line in path.read_text().splitlines() if "width" not in line))
    assert open_source(path.parent).camera == camera


def test_many_disparities_make_the_images_smaller(tmp_path):
    source = open_source(scene(tmp_path, doffs=2.0, ndisp=250))
    assert (source.camera.width, source.camera.height) == (80, 60)
    assert "1/2 of their size so that its 252 disparities fit into 128; ?scale=1" in "\n".join(source.notes)
    assert source.camera.fx == pytest.approx(50)
    frame = rectified(source.frame(0))
    assert frame.left.shape == (60, 80)
    full = open_source(f"{tmp_path}?scale=1")
    assert full.camera.width == 160
    assert distance_of_the_wall(f"{tmp_path}?scale=0.5") == pytest.approx(1.0, abs=0.05)


def test_a_folder_of_scenes(tmp_path):
    for name in ("b", "a"):
        scene(tmp_path / name, doffs=float(name == "b"))
    (tmp_path / "notes").mkdir()
    source = open_source(tmp_path)
    assert [(frame.stamp_ns, frame.pair.name) for frame in source] == [(0, "a"), (10**9, "b")]
    assert "map one, for example --frames 0:1" in source.notes[0]
    np.testing.assert_allclose(source.frame(0).T_world_sensor[:3, 2], [1, 0, 0])


def test_transparency_is_ignored(tmp_path):
    plain = open_source(scene(tmp_path)).frame(0)
    image = np.dstack([plain.left] * 3 + [np.full_like(plain.left, 200)])
    assert cv2.imwrite(str(tmp_path / "im0.png"), image)
    np.testing.assert_array_equal(open_source(tmp_path).frame(0).left[..., 0], plain.left)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, r"calib\.txt: No such file .*; write 'cam0="),
        ("cam0=[1 2]", "baseline must be a number"),
        ("baseline=100\ncam0=[1 2]", "cam0 must be 9 numbers"),
        ("baseline=-3\ncam0=[9 0 1; 0 9 1; 0 0 1]\ncam1=[9 0 1; 0 9 1; 0 0 1]", r"calib\.txt: "),
        ("baseline=1e999", "baseline must be a number"),
    ],
)
def test_each_mistake_is_one_line(tmp_path, text, said):
    path = scene(tmp_path) / "calib.txt"
    path.unlink()
    if text is not None:
        path.write_text(text)
    with pytest.raises(SourceError, match=said) as caught:
        open_source(tmp_path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 250


def test_another_size_and_a_bad_scale(tmp_path):
    frame = open_source(scene(tmp_path, width=400)).frame(0)
    assert frame.fault == "bad_shape"
    assert "160x120 pixels, calib.txt has 400x120" in frame.fault_detail
    for text in ("2", "x"):
        with pytest.raises(SourceError, match=f"scale={text} must be a number from 0.01 to 1"):
            open_source(f"{tmp_path}?scale={text}")
