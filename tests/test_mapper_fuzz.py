"""Random, mostly broken frames: never a crash, never a changed map after a refusal, never a value out of range."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import stereovox as sv
from stereovox.geometry.se3 import from_quaternion

STRANGE = [0.0, -1.0, np.nan, np.inf, -np.inf, 1e-30, 1e30, 65535.0, 0.05, 2.0]


@st.composite
def frames(draw):
    width, height = draw(st.integers(1, 40)), draw(st.integers(1, 30))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    numbers = (
        draw(st.sampled_from([0.5, 20.0, 600.0, 1e5])),
        draw(st.sampled_from([0.5, 20.0, 600.0])),
        draw(st.sampled_from([0.0, width / 2, -5.0, 1e4])),
        draw(st.sampled_from([0.0, height / 2, 1e4])),
        draw(st.sampled_from([None, 0.05, 1e-6])),
    )
    try:
        camera = sv.PinholeCamera(width, height, *numbers)
    except sv.StereovoxError:
        camera = sv.PinholeCamera(width, height, 20.0, 20.0, width / 2, height / 2)
    dtype = draw(st.sampled_from([np.float32, np.float64, np.uint16, np.int32]))
    depth = rng.uniform(0.2, 6, (height, width))
    share = draw(st.sampled_from([0.0, 0.1, 1.0]))
    strange = rng.random(depth.shape) < share
    depth[strange] = rng.choice(STRANGE, strange.sum())
    with np.errstate(invalid="ignore", over="ignore"):
        depth = (depth * (1000 if np.issubdtype(dtype, np.integer) else 1)).astype(dtype)
    if draw(st.integers(0, 9)) == 0:
        depth = depth[:-1]
    pose = from_quaternion(rng.normal(size=3) * draw(st.sampled_from([0, 1, 1e4, 1e7])), rng.normal(size=4))
    if draw(st.integers(0, 9)) == 0:
        pose[draw(st.integers(0, 3)), draw(st.integers(0, 3))] = draw(st.sampled_from([*STRANGE]))
    scale = draw(st.sampled_from([0.001, 1.0, 1.0, 0.0, np.nan, 1e-12, 1e12]))
    return sv.Frame(depth, camera, pose, depth_scale=scale)


@pytest.mark.parametrize("integrator", ["projective", "ray"])
@settings(max_examples=150, deadline=None)
@given(sequence=st.lists(frames(), min_size=1, max_size=4))
def test_any_frame(integrator, sequence):
    mapper = sv.Mapper("default", voxel_size=0.25, max_range=4.0, integrator=integrator)
    for frame in sequence:
        before = mapper.map.storage.blocks()
        report = mapper.add(frame)
        if report.refused:
            after = mapper.map.storage.blocks()
            assert all((a == b).all() for a, b in zip(before, after, strict=True))
            assert report.detail
            assert "\n" not in report.detail
    _, values = mapper.map.storage.blocks()
    assert values.min(initial=0) >= -4000
    assert values.max(initial=0) <= 3500
    assert mapper.map.frames + mapper.map.frames_refused == len(sequence)
