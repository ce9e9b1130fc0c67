# SPDX-License-Identifier: Apache-2.0
"""The rays of a frame are bounded by the deadline, followed in parts, and reported if that is slow."""

import warnings

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.frame import Frame
from stereovox.integrate import ray

CAMERA = PinholeCamera.from_field_of_view(64, 48, 80.0)


def image_of(config):
    depth = np.full((48, 64), 4.0, np.float32) + np.random.default_rng(0).normal(0, 0.02, (48, 64)).astype(np.float32)
    return prepare(Frame(depth, CAMERA, np.eye(4)), config)


def settings(**more):
    return load_config("default", **{"voxel_size": 0.1, "max_range": 5.0, "integrator": "ray", **more})


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("kind", [ray.Ray, ray.Line])
def test_parts_make_the_same_evidence(kind, threads, monkeypatch):
    config = settings(threads=threads)
    whole = kind(config).evidence(image_of(config))
    called = []
    real = kind._kernel
    monkeypatch.setattr(kind, "_kernel", staticmethod(lambda *given: called.append(1) or real(*given)))
    monkeypatch.setattr(ray, "STEPS_AT_ONCE", 20_000)
    parts = kind(config).evidence(image_of(config))
    assert len(called) > 5
    order = [np.lexsort(one.coords.T) for one in (whole, parts)]
    np.testing.assert_array_equal(whole.coords[order[0]], parts.coords[order[1]])
    np.testing.assert_array_equal(whole.values[order[0]], parts.values[order[1]])


def test_more_work_than_the_deadline_allows_makes_larger_pixels(monkeypatch):
    monkeypatch.setattr(ray, "STEPS_PER_MS", 100)
    monkeypatch.setattr(ray, "BLOCKS_PER_MS", 1e9)
    config = settings(deadline_ms=25.0)
    made = ray.Ray(config)
    image = image_of(config)
    smaller = made._in_time(image)
    assert made._steps(smaller) <= 1.1 * 25 * ray.OVERRUN * ray.STEPS_PER_MS < made._steps(image)
    assert smaller.depth_m.shape[0] < image.depth_m.shape[0]
    assert len(made.evidence(image).coords)
    assert ray.Ray(settings())._in_time(image) is image


def test_settings_that_are_slow_are_told_once(monkeypatch):
    monkeypatch.setattr(ray, "SLOW_STEPS", 1000)
    made = ray.Ray(settings())
    image = image_of(settings())
    with pytest.warns(RuntimeWarning, match="far from real time; use integrator projective"):
        made.evidence(image)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        made.evidence(image)
