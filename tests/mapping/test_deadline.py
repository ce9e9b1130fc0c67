"""The deadline scheduler chooses the quality level of each frame."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox import mapper as mapper_module
from stereovox.config import load_config
from stereovox.mapping import deadline as deadline_module
from stereovox.mapping.deadline import MAX_PATIENCE, PATIENCE, Scheduler, quality_levels
from stereovox.simulate.scene import Scene, box

DEADLINE = 20.0


def run(frames, costs, on=None):
    """Return the level of each frame, -1 for skipped ones, if level k takes `costs[k]` milliseconds."""
    on, steps = on or Scheduler(len(costs), DEADLINE), []
    for _ in range(frames):
        out = on.skips()
        steps.append(-1 if out else on.level)
        if not out:
            on.record(costs[on.level])
    return steps


def too_slow(steps, costs):
    return sum(step >= 0 and costs[step] > DEADLINE for step in steps)


def test_what_is_in_time_is_looked_at_in_full():
    assert set(run(1000, [20.0, 10.0, 5.0])) == {0}


def test_an_overrun_goes_down_at_once_and_the_first_frame_of_each_way_does_not_count():
    assert run(8, [21.0, 22.0, 5.0]) == [0, 0, 1, 1, 2, 2, 2, 2]


def test_a_single_slow_frame_costs_eight_frames():
    on = Scheduler(3, DEADLINE)
    run(100, [5.0, 3.0, 2.0], on)
    on.record(50.0)
    steps = run(100, [5.0, 3.0, 2.0], on)
    assert steps == [1] * (PATIENCE + 1) + [0] * (99 - PATIENCE)  # one more: the first on that way does not count


def test_a_way_that_stays_too_slow_is_tried_less_and_less_often():
    steps = np.array(run(20_000, [25.0, 15.0, 5.0]))
    tries = np.flatnonzero(steps == 0)
    gaps = np.diff(tries[tries > 2])
    assert gaps[:6].tolist() == [n + 1 for n in (16, 32, 64, 128, 128, 128)]
    assert set(gaps[5:]) == {MAX_PATIENCE + 1}
    assert (steps == 0).mean() < 0.01
    assert 2 not in steps


def test_a_way_that_lasts_again_is_tried_soon_after_the_next_overrun():
    on = Scheduler(3, DEADLINE)
    run(5000, [25.0, 15.0, 5.0], on)
    run(3 * MAX_PATIENCE, [15.0, 12.0, 5.0], on)
    on.record(50.0)
    assert run(20, [15.0, 12.0, 5.0], on) == [1] * PATIENCE + [0] * (20 - PATIENCE)


@pytest.mark.parametrize("cost", [20.5, 24.0, 30.0, 33.0, 40.0])
def test_on_the_last_way_frames_are_left_out_as_time_wants(cost):
    steps = run(2000, [100.0, 50.0, cost])[10:]
    left_out = [step < 0 for step in steps]
    assert not any(a and b for a, b in pairwise(left_out))
    spent = cost * (len(steps) - sum(left_out))
    assert spent <= DEADLINE * len(steps) + 2 * DEADLINE
    assert spent >= DEADLINE * len(steps) - 4 * DEADLINE  # and no more than that


def test_at_most_every_other_frame_is_left_out():
    left_out = [step < 0 for step in run(2000, [900.0, 900.0, 900.0])]
    assert 0.49 < np.mean(left_out) <= 0.5
    assert not any(a and b for a, b in pairwise(left_out))


costs = st.lists(st.floats(0.1, 60), min_size=3, max_size=3).map(lambda found: sorted(found, reverse=True))


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(costs, st.integers(1, 400)), max_size=5), costs)
def test_in_the_long_run_no_more_time_is_taken_than_there_is(before, now):
    on = Scheduler(3, DEADLINE)
    for load, frames in before:
        run(frames, load, on)
    run(2 * MAX_PATIENCE, now, on)  # it finds its way
    steps = run(2000, now, on)
    if now[-1] <= DEADLINE:
        assert too_slow(steps, now) <= 2 + 2 * 2000 / MAX_PATIENCE
        assert -1 not in steps
        best = next(k for k, cost in enumerate(now) if cost <= DEADLINE)
        assert np.mean(np.array(steps) == best) > 0.95
    else:
        assert sum(now[step] for step in steps if step >= 0) <= 2000 * max(DEADLINE, now[-1] / 2) + 4 * DEADLINE


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(costs, st.integers(1, 400)), max_size=5))
def test_when_the_load_is_gone_all_is_looked_at_in_full_again(before):
    on = Scheduler(3, DEADLINE)
    for load, frames in before:
        run(frames, load, on)
    steps = run(2 * MAX_PATIENCE + 10, [19.0, 12.0, 5.0], on)
    assert steps[-1] == 0
    assert set(run(500, [19.0, 12.0, 5.0], on)) == {0}


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.1, 60), min_size=50, max_size=500))
def test_whatever_frames_take_it_never_goes_to_and_fro(times):
    on, steps = Scheduler(3, DEADLINE), []
    for milliseconds in times:
        if not on.skips():
            steps.append(on.level)
            on.record(milliseconds)
    ups = np.flatnonzero(np.diff(steps) < 0)
    assert (np.diff(steps) >= -1).all()
    assert (np.diff(ups) >= PATIENCE).all()


def stage(*things):
    """Return a frame of a camera at the origin that faces along x a wall 4 m away and `things`."""
    camera = sv.PinholeCamera.from_field_of_view(120, 90, 70, 0.05)
    scene = Scene([box("wall", "wall", (4, -6, -4), (4.2, 6, 4)), *things])
    pose = np.array([[0, 0, 1, 0.013], [-1, 0, 0, 0.021], [0, -1, 0, 0.007], [0, 0, 0, 1.0]])
    columns, rows = camera.ray_slopes()
    rays = np.stack(np.broadcast_arrays(columns[None, :], rows[:, None], np.float32(1)), -1).reshape(-1, 3)
    depth = scene.cast(pose[:3, 3], rays @ pose[:3, :3].T).reshape(90, 120)
    return sv.Frame(np.where(np.isfinite(depth), depth, 0), camera, pose)


def said(way, frame):
    """Return {block: (512,) evidence} of a frame at one level."""
    evidence = way.integrator.evidence(way.depth.image(way.depth.matched(frame)))
    found = {tuple(c): v.astype(int) for c, v in zip(evidence.coords.tolist(), evidence.values.copy(), strict=True)}
    return {
        **found,
        **{tuple(c): np.full(512, v) for c, v in zip(evidence.uniform.tolist(), evidence.uniform_values, strict=True)},
    }


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_near_says_of_what_is_near_what_full_says_and_of_the_rest_nothing(integrator):
    """Also for things exactly at its limit, 2.5 m, at which a camera of shorter range would clear them."""
    things = [box("post", f"post {x}", (x, y, -1), (x + 0.03, y + 0.03, 1)) for x, y in ((1.5, 0.5), (2.48, 0.0))]
    things += [box("wall", "at the limit", (2.52, -1.2, -1), (2.7, -0.6, 1))]
    frame = stage(*things)
    full, near, _ = quality_levels(load_config(voxel_size=0.1, integrator=integrator, **{"ray.update": "once"}))
    in_full, in_short = said(full, frame), said(near, frame)
    marks = clears = 0
    for block, values in in_short.items():
        whole = in_full.get(block, np.zeros(512, int))
        assert not ((values < 0) & (whole >= 0)).any()
        assert not ((values > 0) & (whole <= 0)).any()
        marks, clears = marks + (values > 0).sum(), clears + (values < 0).sum()
    assert marks > 20
    assert 0.05 < clears / sum((values < 0).sum() for values in in_full.values()) < 0.5


def test_coarse_keeps_a_thin_post_that_stands_near():
    frame = stage(box("post", "post", (1.45, 0.11, -2), (1.46, 0.12, 2)))  # a pixel wide
    coarse = quality_levels(load_config(voxel_size=0.1))[2]
    depth = coarse.depth.image(frame).depth_m
    assert depth.shape == (45, 60)
    assert (depth < 2).any(axis=1).all()
    mapper = sv.Mapper(voxel_size=0.1)
    for _ in range(5):
        mapper.map.add(coarse.integrator.evidence(coarse.depth.image(frame)))
    assert (mapper.map.state([[1.45, 0.15, z] for z in (-0.45, 0.05, 0.45)]) == sv.State.OCCUPIED).all()


def test_pairs_are_matched_at_half_the_resolution_on_the_coarse_way():
    _, near, coarse = quality_levels(load_config())
    assert near.depth._pipeline._stereo.config.halve is None
    assert coarse.depth._pipeline._stereo.config.halve is True


class Clock:
    """A mapper's clock; each reading takes half of a frame."""

    def __init__(self, monkeypatch):
        self.now, self.frame_ms = 0.0, 0.0
        for module in (deadline_module, mapper_module):
            monkeypatch.setattr(module, "perf_counter", self)

    def __call__(self):
        self.now += self.frame_ms / 2 / 1e3
        return self.now


def test_a_mapper_steps_down_leaves_out_and_comes_back(monkeypatch):
    clock = Clock(monkeypatch)
    mapper, frame = sv.Mapper(voxel_size=0.1, deadline_ms=10), stage()
    reports = []
    for frame_ms, count in ((5.0, 4), (15.0, 20), (5.0, 40)):
        clock.frame_ms = frame_ms
        for _ in range(count):
            before = mapper.map.storage.blocks()[1].copy()
            reports.append(mapper.add(frame))
            if reports[-1].refused:
                assert np.array_equal(before, mapper.map.storage.blocks()[1])
    ways = [report.refused or report.quality for report in reports]
    assert ways[:9] == ["full"] * 5 + ["near"] * 2 + ["coarse"] * 2
    assert "no_time" in ways[9:24]
    assert ways[-1] == "full"
    assert "deadline_ms" in next(report.detail for report in reports if report.refused)
    assert mapper.map.frames_refused == ways.count("no_time")


def test_without_a_deadline_all_is_looked_at_in_full(monkeypatch):
    clock = Clock(monkeypatch)
    clock.frame_ms = 1e6
    mapper = sv.Mapper(voxel_size=0.1)
    assert {mapper.add(stage()).quality for _ in range(5)} == {"full"}


def test_a_near_range_before_all_that_is_seen_is_refused():
    with pytest.raises(sv.StereovoxError, match=r"near_share 0\.1: leaves nothing between min_range 0\.5 and 0\.5 m"):
        sv.Mapper(deadline_ms=20, min_range=0.5, **{"pace.near_share": 0.1})
    with pytest.raises(sv.StereovoxError, match=r"between min_range 0\.5 and 0\.51 m"):  # less than half a cell
        sv.Mapper(deadline_ms=20, min_range=0.5, **{"pace.near_share": 0.102})
    sv.Mapper(min_range=0.5, **{"pace.near_share": 0.1})  # nobody asked for it
    with pytest.raises(sv.StereovoxError, match="map of a floor"):
        load_config("ist2019", deadline_ms=20)
