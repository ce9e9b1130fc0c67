# SPDX-License-Identifier: Apache-2.0
"""Every row of Table 4.2 and 4.3 is timed; how long they take is not tested."""

import pytest

from stereovox_lab.papers.chien import timing as told
from stereovox_lab.papers.chien.timing import CONDITIONS, STEPS, processor, time_tables


@pytest.fixture(scope="module")
def tables():
    return time_tables(frames=6)


def test_every_row_of_the_thesis_is_there(tables):
    steps, conditions = tables
    assert [row.row for row in steps] == list(STEPS)
    assert [row.row for row in conditions] == list(CONDITIONS)
    assert [row.thesis_ms for row in STEPS if row.thesis_ms] == [5.48, 19.16, 21.79, 10.49, 9.77]
    assert [row.thesis_ms for row in CONDITIONS if row.thesis_ms] == [52.075, 40.205, 51.384, 28.475, 36.517, 665.32]


def test_rows_count_frames_and_times(tables):
    for row in (*tables[0], *tables[1]):
        assert row.frames == (2 if getattr(row.row, "views", ()) else 6)  # views: every fifth frame
        assert 0 < row.ms["median"] <= row.ms["max"]
        assert row.mean_ms > 0
    assert processor()


def test_the_chapter_compares_with_the_thesis(tables):
    chapter = told.chapter(*tables)
    assert len(chapter.claims) == 11
    full = next(claim for claim in chapter.claims if claim.text.startswith("Full resolution"))
    assert (full.thesis, full.holds) == ("665.32 ms", None)
    assert "665.32" in str(chapter.sheets[1].rows)
    assert chapter.shown[0].png.startswith(b"\x89PNG")
