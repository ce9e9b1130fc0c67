# SPDX-License-Identifier: Apache-2.0
"""Shelves that look like the next ones are known to, and a wrong bay is not taken for the right one."""

import numpy as np
from made_loops import RACKS, RING, closed, errors, truths

from stereovox.correct.loops import search

BAY = 1.2
ALLOWED = 0.05
"""A drift that allows the next bay."""


def test_the_next_bays_look_the_same():
    closer = closed(RACKS, drift=ALLOWED)
    shifts = closer.repeats.shifts([closer.submaps[0].middle])
    assert len(shifts) > 5
    bays = shifts[:, 0] / BAY
    whole = (np.abs(bays - np.round(bays)) < 0.1) & (np.abs(shifts[:, 1:]) < 0.15).all(axis=1)
    assert whole.mean() > 0.8
    assert (np.abs(bays[whole]) > 0.9).all()


def test_what_is_unique_does_not_repeat():
    closer = closed(RING)
    assert sum(len(closer.repeats.shifts([submap.middle])) for submap in closer.submaps) <= 2


def test_a_wrong_bay_is_refused_and_told(monkeypatch):
    closer = closed(RACKS, drift=ALLOWED)
    truth = truths(closer, RACKS)
    assert not closer.loops or errors(closer.loops, truth).max() < 0.3
    assert sum("looks the same 1.2" in loop.why or "looks the same 1.1" in loop.why for loop in closer.refused) > 3
    monkeypatch.setattr(search, "SEEN_BY", 10**6)
    believing = closed.__wrapped__(RACKS, drift=ALLOWED)
    assert errors(believing.loops, truth).max() > 1.0
