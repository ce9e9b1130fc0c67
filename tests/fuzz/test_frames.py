# SPDX-License-Identifier: Apache-2.0
"""A short run of `fuzz/frames.py`, and that it would see what it looks for."""

import warnings
from dataclasses import replace

import pytest

import frames as fuzz
import stereovox as sv


def test_nothing_crashes_and_no_refused_frame_changes_a_map():
    tally = fuzz.run(1500, seed=7, timed_from=1500)
    assert tally.bad == []
    assert tally.changed_by_refused == 0
    assert set(tally.frames) == {"Frame", "StereoFrame", "Scan", "nonsense"}
    assert sum(tally.refused.values()) < 1200
    assert len(tally.refused) > 15


@pytest.mark.parametrize(
    ("broken", "said"),
    [
        ("changes", "changed the map"),
        ("lines", "not one line"),
        ("forgets", "counted 0 times"),
        ("dies", "ZeroDivisionError"),
        ("warns", "UserWarning"),
    ],
)
def test_what_is_wrong_is_seen(monkeypatch, broken, said):
    real = sv.Mapper.add

    def add(self, frame):
        if broken == "dies":
            raise ZeroDivisionError
        if broken == "warns":
            warnings.warn("odd", stacklevel=1)
        if broken == "forgets":
            return sv.UpdateReport(refused="why", detail="one line")
        report = real(self, None)
        self.map.frames += broken == "changes"
        return replace(report, detail="two\nlines") if broken == "lines" else report

    monkeypatch.setattr(sv.Mapper, "add", add)
    monkeypatch.setattr(fuzz, "GRIDS", {})
    monkeypatch.setattr(fuzz, "VOXELS", {"default": {}})
    assert said in fuzz.run(3, seed=1).bad[0]
