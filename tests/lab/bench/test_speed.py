# SPDX-License-Identifier: Apache-2.0
"""The picture of a benchmark: every library is a line over its voxel sizes, ours is named first, nothing collapses."""

import warnings

import pytest

from stereovox.view.figures import blank
from stereovox_lab.bench import files
from stereovox_lab.bench.files import speed_png
from stereovox_lab.bench.machine import machine


def made(sizes, peers=("octomap", "wavemap", "pyoctomap"), name="kitchen", ours="stereovox", others=()):
    def row(library, size, ms, threads=1):
        return {"library": library, "voxel_size": size, "threads": threads, "frames": 50, "integrate_ms_median": ms,
                "map_bytes": 1e6 * ms, **({} if library in peers else {"integrator": "made"})}  # fmt: skip

    rows = [row(ours, size, 0.1 / size) for size in sizes]
    rows += [row(peer, size, (3 + n) / size) for n, peer in enumerate(peers) for size in sizes]
    variants = [row(ours, size, 0.06 / size, 2) for size in sizes]
    variants += [row(other, size, 0.05 / size) for other in others for size in sizes]
    return {"source": name, "image": "640x480", "frames": 50, "max_range": 5.0, "machine": machine(), "rows": rows,
            "variants": variants, "ratio": {}}  # fmt: skip


@pytest.fixture
def drawn(monkeypatch):
    """Return the figures that are made."""
    figures = []
    monkeypatch.setattr(files, "blank", lambda *size: figures.append(blank(*size)) or figures[-1])
    return figures


def test_every_library_is_a_line_and_ours_stands_out(drawn):
    assert speed_png(made([0.2, 0.1, 0.05])).startswith(b"\x89PNG")
    left, right = drawn[0].axes
    names = ["stereovox, 1 thread", "stereovox, 2 threads", "octomap", "wavemap", "pyoctomap"]
    lines = {line.get_label(): line for line in left.get_lines() if not line.get_label().startswith("_")}
    assert list(lines) == names
    assert list(lines["wavemap"].get_xdata()) == [0.05, 0.1, 0.2]
    assert list(lines["wavemap"].get_ydata()) == pytest.approx([80, 40, 20])
    assert [line.get_label() for line in right.get_lines()] == [names[0], *names[2:]]  # threads make the same map
    widths = [line.get_linewidth() for line in lines.values()]
    assert min(widths[:2]) > max(widths[2:])
    assert len({line.get_color() for line in lines.values()}) == 4
    assert (left.get_xscale(), left.get_yscale()) == ("log", "log")
    assert [text.get_text() for text in left.get_xticklabels()] == ["0.05", "0.1", "0.2"]
    assert {"0.5", "1", "2"} <= {text.get_text() for text in left.texts}
    assert "30 frames a second" in {text.get_text() for text in left.texts}
    assert "kitchen: 50 frames of 640x480" in drawn[0].get_suptitle()
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == names


def test_what_peers_are_compared_with_stands_out_whatever_its_integrator(drawn):
    speed_png(made([0.2, 0.1], peers=["stereovox-of-others"], ours="stereovox-ray", others=["stereovox"]))
    left, right = drawn[0].axes
    names = ["stereovox-ray, 1 thread", "stereovox-ray, 2 threads", "stereovox, 1 thread", "stereovox-of-others"]
    lines = {line.get_label(): line for line in left.get_lines() if not line.get_label().startswith("_")}
    assert list(lines) == names
    assert lines[names[0]].get_color() == files.OURS != lines[names[2]].get_color()
    assert lines[names[0]].get_zorder() > max(lines[name].get_zorder() for name in names[1:])
    assert [line.get_label() for line in right.get_lines()] == [names[0], *names[2:]]
    assert {"0.5", "1"} <= {text.get_text() for text in left.texts}


@pytest.mark.parametrize("name", ["kitchen", "price $x^b$ _{", "größe"])
def test_one_size_and_nobody_else_is_a_picture_too(name, drawn):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        speed_png(made([0.05], peers=(), name=name))
    low, high = drawn[0].axes[0].get_ylim()
    assert high > 99 * low
    assert low < 2.0 < high
