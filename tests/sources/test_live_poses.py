# SPDX-License-Identifier: Apache-2.0
"""Poses that arrive while others ask for them: interpolated between neighbours, never guessed."""

import threading
from contextlib import suppress
from time import monotonic

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stereovox.errors import FrameRefused
from stereovox.sources.poses import live_poses
from stereovox.sources.poses.live_poses import LivePoses
from stereovox.sources.poses.poses import Poses

MS = 1_000_000


def pose(x=0.0, yaw_deg=0.0):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler("z", yaw_deg, degrees=True).as_matrix()
    T[0, 3] = x
    return T


def filled(*stamped):
    poses = LivePoses("tracker")
    for ms, T in stamped:
        poses.add(ms * MS, T)
    return poses


def refused(poses, ms, wait_s=0.0):
    with pytest.raises(FrameRefused) as found:
        poses.at(ms * MS, wait_s)
    return found.value


def test_a_pose_between_two_is_what_a_recording_would_say():
    stamps, poses = [10, 15, 30], [pose(0.01, 1), pose(0.02, 4), pose(0.1, 9)]
    live, recorded = filled(*zip(stamps, poses, strict=True)), Poses([s * MS for s in stamps], poses)
    for ms in (10, 11, 15, 22, 29.5, 30):
        np.testing.assert_array_equal(live.at(int(ms * MS)), recorded.at(int(ms * MS)))


def test_the_order_of_arrival_does_not_matter():
    one, other = filled((10, pose(0.1)), (20, pose(0.2)), (30, pose(0.4))), filled(
        (10, pose(0.1)), (30, pose(0.4)), (20, pose(0.2))
    )  # fmt: skip
    np.testing.assert_array_equal(one.at(16 * MS), other.at(16 * MS))
    assert other.counts["late"] == 1


def test_nothing_is_extrapolated():
    poses = filled((10, pose()), (20, pose(0.01)))
    assert refused(poses, 21).reason == "no_pose"
    assert "less than 0.1 s after" in str(refused(poses, 21))
    assert "less than 0.1 s before" in str(refused(poses, 9))


def test_gaps_are_not_bridged():
    poses = filled((0, pose()), (150, pose(0.01)))
    assert refused(poses, 20).reason == "no_pose"
    np.testing.assert_array_equal(poses.at(150 * MS), pose(0.01))


def test_jumps_are_not_bridged_but_poses_on_either_side_count():
    poses = filled((0, pose()), (10, pose(0.01)), (20, pose(3.0)), (30, pose(3.01)))
    assert refused(poses, 15).reason == "pose_jump"
    assert poses.at(5 * MS)[0, 3] == pytest.approx(0.005)
    assert poses.at(25 * MS)[0, 3] == pytest.approx(3.005)
    assert poses.counts["jumps"] == 1
    assert refused(filled((0, pose()), (10, pose(yaw_deg=30))), 5).reason == "pose_jump"


@pytest.mark.parametrize("bad", [np.full((4, 4), np.nan), 2 * np.eye(4), np.eye(3), np.diag([1.0, 1, -1, 1])])
def test_a_pose_that_cannot_be_used_refuses_what_needs_it(bad):
    poses = filled((0, pose()), (10, bad), (20, pose(0.01)), (30, pose(0.02)))
    assert {refused(poses, ms).reason for ms in (5, 10, 15)} == {"bad_pose_file"}
    assert poses.at(25 * MS)[0, 3] == pytest.approx(0.015)
    assert poses.counts["unusable"] == 1


def test_without_any_pose_the_reason_is_told():
    poses = LivePoses("tracker")
    assert "tracker: no pose has arrived yet" in str(refused(poses, 0))
    poses.end("the server hung up")
    assert "tracker: the server hung up" in str(refused(poses, 0))


def test_other_clocks_are_told_with_the_offset_that_would_do():
    poses = filled((0, pose()), (10, pose()))
    assert "clocks differ; give clock_offset_s (about 1699999999.990" in str(refused(poses, 1_700_000_000_000))


def test_a_waiting_thread_gets_the_pose_as_soon_as_it_is_there():
    poses, found = filled((0, pose())), []
    thread = threading.Thread(target=lambda: found.append(poses.at(5 * MS, 30.0)))
    thread.start()
    poses.add(10 * MS, pose(0.1))
    thread.join(10.0)
    assert found[0][0, 3] == pytest.approx(0.05)


def test_it_gives_up_after_the_wait():
    poses, begin = filled((0, pose())), monotonic()
    assert refused(poses, 5, 0.05).reason == "no_pose"
    assert monotonic() - begin >= 0.05


def test_nobody_waits_for_a_stream_that_has_ended():
    poses, found = filled((0, pose())), []
    thread = threading.Thread(target=lambda: found.append(refused(poses, 5, 60.0)))
    thread.start()
    poses.end("unplugged")
    thread.join(10.0)
    assert not thread.is_alive()
    assert "unplugged" in str(found[0])
    assert poses.is_final(10**18)
    poses.resume()
    assert not poses.is_final(10**18)


def test_threads_add_and_ask_at_once():
    """Two writers and three readers; every answer is the one truth, however the threads take turns."""
    poses, wrong = LivePoses(max_speed_mps=1e3, clock=lambda: 0.0), []  # all at once: no clock that was set back
    together = threading.Barrier(2)

    def write(first):
        for k in range(first, 2000, 2):
            if k % 100 == first:  # a writer that is 1 s behind would be one whose clock was set back
                together.wait(60.0)
            poses.add(k * MS, pose(k * 0.001))

    def read(seed):
        for ms in np.random.default_rng(seed).uniform(0, 1990, 300):
            T = poses.at(int(ms * MS), 30.0) if ms > 1 else pose(ms * 0.001)
            if abs(T[0, 3] - int(ms * MS) / MS * 0.001) > 0.11:
                wrong.append(ms)

    threads = [threading.Thread(target=write, args=(k,)) for k in (0, 1)]
    threads += [threading.Thread(target=_forgiving(read), args=(seed,)) for seed in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert not any(thread.is_alive() for thread in threads)
    assert not wrong
    assert poses.added == len(poses) == 2000
    assert poses.at(1_000_500_000)[0, 3] == pytest.approx(1.0005)


def _forgiving(read):
    """One writer may be far ahead of the other: then a gap is refused, which is right."""

    def run(seed):
        with suppress(FrameRefused):
            read(seed)

    return run


def test_the_memory_is_bounded(monkeypatch):
    monkeypatch.setattr(live_poses, "KEPT", 200)
    poses = LivePoses()
    for k in range(600):
        poses.add(k * MS, pose())
    assert 100 <= len(poses) <= 200
    assert poses.newest_ns == 599 * MS


def test_a_clock_that_was_set_back_drops_what_came_before():
    poses = filled((5000, pose()), (5010, pose()))
    poses.add(0, pose(1.0))
    poses.add(10 * MS, pose(1.01))
    assert poses.at(5 * MS)[0, 3] == pytest.approx(1.005)
    assert len(poses) == 2
    assert poses.counts["clock_reset"] == 1


def test_the_first_of_several_with_one_stamp_counts():
    poses = filled((10, pose(0.1)), (10, pose(0.2)))
    assert poses.at(10 * MS)[0, 3] == 0.1
    assert poses.counts["repeated"] == 1


def test_who_listens_hears_of_each_pose():
    poses, heard = LivePoses(), []
    poses.listen(lambda: heard.append(len(poses)))
    poses.add(0, pose())
    poses.end("over")
    assert heard == [1, 1]


@pytest.mark.parametrize("back_ms", [30, 400, 900])
def test_a_clock_that_is_set_back_by_little_never_mixes_with_what_came_before(back_ms):
    now = [0.0]
    poses, true = LivePoses(clock=lambda: now[0]), {}
    for k in range(60):
        now[0] = 0.01 * k
        poses.add(10 * k * MS, pose(0.01 * k))
    for k in range(60, 70):
        now[0] = 0.01 * k
        poses.add((10 * k - back_ms) * MS, pose(0.01 * k))
        true[10 * k - back_ms] = 0.01 * k
    assert poses.counts["clock_reset"] == 1
    for ms, x in true.items():
        assert poses.at(ms * MS)[0, 3] == pytest.approx(x)
    assert poses.newest_ns == (690 - back_ms) * MS


def test_a_pose_that_is_overtaken_is_no_clock_that_is_set_back():
    poses = filled(*((t, pose(t / 1000)) for t in (0, 20, 10, 40, 30, 60, 50)))
    for ms in (70, 110, 120, 130, 80, 90, 95, 100, 140):  # several that were held up come at once
        poses.add(ms * MS, pose(ms / 1000))
    assert not poses.counts["clock_reset"]
    assert poses.at(97 * MS)[0, 3] == pytest.approx(0.097)
    assert poses.at(55 * MS)[0, 3] == pytest.approx(0.055)
