# SPDX-License-Identifier: Apache-2.0
import json

import pytest

from stereovox.maps import load_map
from stereovox.runs.demo import demo
from stereovox.simulate.simulation import Simulation


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The demo with every fourth frame and larger cells: 5 frames here see what 20 see there."""
    folder, steps = tmp_path_factory.mktemp("demo"), []
    source = Simulation(frames=60)
    summary = demo(
        folder / "out", voxel_size=0.1, source=source, min_frames=5, progress=lambda *step: steps.append(step)
    )
    return folder / "out", summary, steps


def test_nothing_that_enough_frames_saw_is_missing(run):
    _, summary, _ = run
    for part, pieces in (("poles", 6), ("table_edge", 4), ("door_frame", 3), ("table_legs", 4)):
        assert summary["parts"][part]["pieces"] >= pieces, "the path must show these often enough"
        assert summary["parts"][part]["missing"] == []
    assert summary["missing"] == []


def test_the_map_agrees_with_the_exact_occupancy(run):
    _, summary, _ = run
    assert summary["accuracy"]["tolerance_precision"] > 0.9
    assert summary["accuracy"]["tolerance_recall"] > 0.97
    assert summary["accuracy"]["specificity"] > 0.85


def test_files_summary_and_progress(run):
    folder, summary, steps = run
    assert sorted(path.name for path in folder.iterdir()) == ["report.html", "room.png", "room.svox"]
    assert load_map(folder / "room.svox").counts()["occupied"] == summary["occupied"]
    assert load_map(folder / "room.svox").recording == "sim:room"
    assert summary["frame_ms"]["median"] > summary["integrate_ms"]["median"] + 0.5 * summary["depth_ms"]["median"]
    assert f"<b>{summary['frame_ms']['median']:.1f} ms</b>" in (folder / "report.html").read_text()
    assert json.loads(json.dumps(summary)) == summary
    assert (summary["frames"], summary["frames_refused"]) == (60, 0)
    assert [step[0] for step in steps] == [*range(1, 61), 60]
