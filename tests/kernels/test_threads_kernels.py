"""Work on several threads: all of it is done, slips come out when all is, and threads do not pile up."""

import multiprocessing
import pickle
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from stereovox.kernels.threads import Ahead, Scratch, in_shards, run_both, shards, uninterrupted


@pytest.mark.parametrize("threads", [1, 2, 3, 16])
@pytest.mark.parametrize("length", [0, 1, 5, 100])
def test_shards_cover_everything_once(length, threads):
    done = []
    in_shards(lambda part: done.extend(range(length)[part]), shards(length, threads))
    assert sorted(done) == list(range(length))


def test_parts_run_at_the_same_time():
    meeting = threading.Barrier(3, timeout=20)
    in_shards(lambda part: meeting.wait(), shards(9, 3))  # would break if one waited for another
    assert run_both(2, lambda: 1, lambda: "two") == (1, "two")
    both = threading.Barrier(2, timeout=20)
    run_both(2, both.wait, both.wait)


def test_one_thread_runs_one_after_the_other_in_the_caller():
    here = threading.get_ident()
    assert run_both(1, threading.get_ident, threading.get_ident) == (here, here)


@pytest.mark.parametrize("culprit", [0, 1])
def test_a_slip_comes_out_when_all_parts_are_done(culprit):
    done = []

    def work(part):
        if part.start == 5 * culprit:
            raise ValueError(f"part {culprit}")
        time.sleep(0.2)
        done.append(part.start)

    with pytest.raises(ValueError, match=f"part {culprit}"):
        in_shards(work, shards(10, 2))
    assert done == [5 - 5 * culprit]

    def slip():
        raise ValueError("slip")

    calls = (slip, lambda: work(slice(1, 2)))
    with pytest.raises(ValueError, match="slip"):
        run_both(2, *(calls if culprit == 0 else calls[::-1]))
    assert done[1:] == [1]


def test_threads_do_not_pile_up():
    for threads in range(2, 9):
        for _ in range(3):
            in_shards(lambda part: time.sleep(0.001), shards(100, threads))
    ours = [thread for thread in threading.enumerate() if thread.name.startswith("stereovox")]
    assert len(ours) <= 16  # as many as were ever busy at once, and no more for each number of parts


@pytest.mark.skipif(sys.platform == "win32", reason="no fork there")
def test_a_forked_child_has_threads_of_its_own():
    in_shards(lambda part: None, shards(10, 2))  # the parent has some by now
    child = multiprocessing.get_context("fork").Process(target=in_shards, args=(lambda part: None, shards(10, 2)))
    child.start()
    child.join(20)
    hangs = child.is_alive()
    child.kill()
    assert not hangs
    assert child.exitcode == 0


def test_scratch_is_lent_to_one_at_a_time_and_used_again():
    made, lent = [], []
    scratch, meeting = Scratch(lambda: made.append([]) or made[-1]), threading.Barrier(3, timeout=10)

    def work(piece):
        lent.append(id(piece))
        meeting.wait()  # all hold theirs at the same time

    for _ in range(2):
        in_shards(lambda part: scratch.lend(work), shards(9, 3))
    assert len(made) == 3
    assert set(lent[:3]) == set(lent[3:]) == set(map(id, made))


def test_scratch_comes_back_from_work_that_fails():
    made = []
    scratch = Scratch(lambda: made.append([]) or made[-1])
    for _ in range(2):
        with pytest.raises(ZeroDivisionError):
            scratch.lend(lambda piece: 1 / 0)
    assert len(made) == 1


def test_what_was_begun_is_not_done_twice():
    done = []
    ahead = Ahead(lambda number: done.append(number) or 1 / number)
    ahead.begin(4)
    assert ahead(4) == 0.25
    assert ahead(2) == 0.5
    assert done == [4, 2]
    ahead.begin(0)
    with pytest.raises(ZeroDivisionError):
        ahead(0)


def test_what_was_begun_is_found_by_identity_and_used_once():
    """Arguments that hold arrays, as frames do, cannot be compared."""
    done = []
    ahead = Ahead(lambda one: done.append(one[0]) or one[0])
    first, second = ("first", np.zeros(3)), ("second", np.zeros(3))
    ahead.begin(first)
    ahead.begin(second)
    assert [ahead(second), ahead(first)] == ["second", "first"]
    assert sorted(done) == ["first", "second"]
    assert ahead(second) == "second"
    assert sorted(done) == ["first", "second", "second"]


def test_only_two_calls_wait_in_the_background():
    hold, done = threading.Event(), []
    ahead = Ahead(lambda item: (hold.wait(10) and done.append(item)) or item)
    items = [object() for _ in range(5)]
    for item in items:
        ahead.begin(item)
    hold.set()
    assert [ahead(item) for item in items] == items
    assert len(done) == len(items)


def test_a_copy_has_begun_nothing():
    ahead = Ahead(abs)
    ahead.begin(-1)
    assert pickle.loads(pickle.dumps(ahead))(-1) == 1


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize("fails", [False, True])
def test_ctrl_c_waits_for_the_outermost_step_and_is_not_lost_where_that_fails(fails):
    done = []

    def step():
        with uninterrupted():
            with uninterrupted():
                signal.raise_signal(signal.SIGINT)
            done.append("all")
            if fails:
                raise ValueError

    with pytest.raises(KeyboardInterrupt):
        step()
    assert done == ["all"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("obeys_signals")
def test_steps_of_other_threads_and_other_handlers_of_ctrl_c_are_left_alone():
    def handler():
        with uninterrupted():
            return signal.getsignal(signal.SIGINT)

    with ThreadPoolExecutor(1) as other:
        assert other.submit(handler).result() is signal.default_int_handler
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    assert handler() is signal.SIG_IGN
