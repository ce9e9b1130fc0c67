# SPDX-License-Identifier: Apache-2.0
"""Work next to the node's thread: in order, or the newest alone, and nothing once it is dropped."""

from threading import Event

import pytest

from stereovox.ros.library import Background


@pytest.fixture
def busy():
    """A background with a task that ends when the event is set, and a list of finished tasks."""
    background, go, done = Background("test"), Event(), []

    def work(name):
        def do():
            assert go.wait(60)
            done.append(name)
            return name

        return do

    background.put(work("first"))
    yield background, work, go, done
    go.set()


def test_pieces_are_done_in_order_and_nobody_waits_meanwhile(busy):
    background, work, go, done = busy
    background.put(work("second"))
    assert background.poll() is None
    assert done == []
    go.set()
    assert [ended.result() for ended in background.rest()] == ["first", "second"]
    assert background.poll() is None


def test_the_newest_replaces_those_that_wait_and_not_the_one_that_runs(busy):
    background, work, go, _ = busy
    for name in ("second", "third"):
        background.put(work(name), newest_only=True)
    go.set()
    assert [ended.result() for ended in background.rest()] == ["first", "third"]


def test_what_is_dropped_is_not_begun_and_what_runs_is_waited_for(busy):
    background, work, go, done = busy
    background.put(work("second"))
    go.set()
    background.drop()
    assert done == ["first"]
    assert list(background.rest()) == []
    background.put(work("third"))
    assert [ended.result() for ended in background.rest()] == ["third"]


def test_errors_come_with_the_result(busy):
    background, work, go, _ = busy
    background.put(lambda: 1 // 0)
    background.put(work("third"))
    go.set()
    first, second, third = background.rest()
    assert (first.result(), third.result()) == ("first", "third")
    with pytest.raises(ZeroDivisionError):
        second.result()
