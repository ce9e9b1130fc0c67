# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import threading
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.frame import Frame
from stereovox.opening import SOURCES, Selection, Source, open_images, open_source, parse_slice
from stereovox.sources.base import AHEAD, MEMBERS, Stream, kind_of, prefetch, stream_of


class Counting(Source):
    """Ten frames whose stamp is their number."""

    def __init__(self):
        self.name, self.camera = "counting", PinholeCamera(4, 3, 5, 5, 2, 1)

    def __len__(self):
        return 10

    def frame(self, i):
        i = range(10)[i]
        return Frame(np.ones((3, 4), np.uint16), self.camera, np.eye(4), stamp_ns=i)


@pytest.mark.parametrize("text", ["0:10:3", "2:", ":4", ":", "::2", "-3:", "::-1", "9:2:-3", " 1 : 5 ", "5:100"])
def test_a_selection_is_what_python_slices(text):
    expected = list(range(10))[slice(*(int(part) if part.strip() else None for part in text.split(":")))]
    source = Selection(Counting(), text)
    assert [frame.stamp_ns for frame in source] == expected
    assert len(source) == len(expected)
    assert source.frame(-1).stamp_ns == expected[-1]
    assert (source.name, source.camera.width) == ("counting", 4)
    with pytest.raises(IndexError):
        source.frame(len(expected))


@pytest.mark.parametrize("text", ["", "5", "a:b", "1:2:3:4", "::0", "1.5:", "1-5", "0:10:3:"])
def test_other_text_is_an_error_with_an_example(text):
    with pytest.raises(SourceError, match="A:B:S"):
        parse_slice(text)


@pytest.mark.parametrize("text", ["10:", "5:5", "3:1", "0:5:-1"])
def test_an_empty_selection_is_an_error(text):
    with pytest.raises(SourceError, match=f"'{text}' selects none of the 10 frames of counting"):
        Selection(Counting(), text)


def test_selections_can_be_selected_from():
    assert [frame.stamp_ns for frame in Selection(Selection(Counting(), "::2"), "1:3")] == [2, 4]


def test_a_source_can_be_run_through_twice():
    source = Counting()
    assert [f.stamp_ns for f in source] == [f.stamp_ns for f in source] == list(range(10))


@pytest.mark.parametrize("count", [0, 1, AHEAD, 3 * AHEAD])
def test_prefetch_reads_each_item_once_and_keeps_the_order(count):
    begun = []
    assert list(prefetch(lambda i: begun.append(i) or i * i, count)) == [i * i for i in range(count)]
    assert begun == list(range(count))


def test_prefetch_reads_in_the_background_but_not_too_far():
    begun, ahead_reached = [], threading.Event()

    def read(i):
        begun.append(i)
        if i == 3:
            ahead_reached.set()
        return i, threading.current_thread()

    items = prefetch(read, 100, ahead=3)
    first, thread = next(items)
    assert first == 0
    assert thread is not threading.current_thread()
    assert ahead_reached.wait(10)
    items.close()
    assert max(begun) == 3


def test_prefetch_stops_with_its_consumer():
    before = set(threading.enumerate())
    begun = []
    for item in prefetch(lambda i: begun.append(i) or i, 1000):
        if item == 2:
            break
    else:
        pytest.fail("never reached")
    assert max(begun) <= 2 + AHEAD
    assert not {t for t in set(threading.enumerate()) - before if t.name.startswith("stereovox-source")}


def test_what_goes_wrong_in_the_background_is_raised_in_its_turn():
    def read(i):
        if i == 2:
            raise RuntimeError("disk on fire")
        return i

    seen = []
    with pytest.raises(RuntimeError, match="disk on fire"):
        seen.extend(prefetch(read, 10))
    items = prefetch(read, 10)
    assert [next(items), next(items)] == [0, 1]
    with pytest.raises(RuntimeError):
        next(items)


class Foreign:
    """A class of another package that knows nothing of ours; it has a length, and a note that changes."""

    name, camera, unit = "foreign", Counting().camera, None

    def __init__(self):
        self.dropped = 0

    def __iter__(self):
        yield from Counting()


class ForeignRecording(Foreign):
    """One whose frames can be read in any order."""

    posed = False

    def __len__(self):
        return 10

    def frame(self, i):
        return Counting().frame(i)


def test_what_a_foreign_source_lacks_is_as_for_any_stream():
    own = Foreign()
    stream = stream_of(own)
    assert {name for name in MEMBERS if hasattr(Stream, name) and not hasattr(stream, name)} == set()
    assert (stream.name, stream.camera, stream.length, stream.notes, stream.posed) == (
        "foreign",
        own.camera,
        None,
        (),
        True,
    )
    assert (stream.imu(), stream.after(3), len(list(stream))) == (None, stream, 10)
    own.dropped = 7
    assert stream.dropped == 7  # its own, as it is now
    assert not isinstance(stream, Source)
    assert stream_of(stream) is stream


def test_a_foreign_recording_is_read_in_any_order():
    source = stream_of(ForeignRecording())
    assert isinstance(source, Source)
    assert (source.length, source.posed, source.gravity(), source.up) == (10, False, None, None)
    assert source.frame(4).stamp_ns == 4
    np.testing.assert_array_equal(source.pose(4), np.eye(4))
    assert [frame.stamp_ns for frame in source.after(8)] == [8, 9]


def test_a_foreign_recording_need_only_know_its_length_and_its_frames():
    own = SimpleNamespace(name="foreign", camera=Counting().camera, length=10, frame=Counting().frame)
    assert [frame.stamp_ns for frame in stream_of(own)] == list(range(10))
    assert len(stream_of(own)) == 10


@pytest.mark.parametrize("bad", [42, None, [1, 2], object()])
def test_what_is_no_source_is_one_line(bad):
    with pytest.raises(SourceError, match="give the name of a camera or recording, or a Stream"):
        stream_of(bad)


def test_a_foreign_class_that_is_registered_gets_what_it_lacks(monkeypatch):
    monkeypatch.setitem(SOURCES, "foreign", f"{__name__}:Registered")
    source = open_source("foreign:", "2:5")
    assert [frame.stamp_ns for frame in source] == [2, 3, 4]
    assert isinstance(open_images("foreign:"), Source)
    assert kind_of(Counting) is Counting


class Registered(ForeignRecording):
    """One that stereovox opens by its name."""

    def __init__(self, where):
        super().__init__()

    @staticmethod
    def recognises(where):
        return where == "foreign:"


def test_a_frame_without_a_pose_has_none_in_any_source():
    class Lost(Counting):
        def frame(self, i):
            frame = super().frame(i)
            return frame if i else replace(frame, fault="no_pose", fault_detail="nobody knows")

    with pytest.raises(FrameRefused, match="nobody knows"):
        Lost().pose(0)
    np.testing.assert_array_equal(Selection(Lost(), "1:").pose(0), np.eye(4))
