# SPDX-License-Identifier: Apache-2.0
"""The stages of a frame one by one, on a simulated image: `pytest -p benchmark benchmarks/test_kernels.py`.

Needs pytest-benchmark (`pip install 'stereovox[bench]'`). Compare two versions with `--benchmark-save` and
`--benchmark-compare`. Cells and range are the default profile's unless a test's name says otherwise.
"""

from dataclasses import replace

import numpy as np
import pytest

from stereovox import VoxelMap, load_config, open_source
from stereovox.depth import prepare
from stereovox.frame import Reason
from stereovox.integrate import make_integrator

SIZES = (0.2, 0.1, 0.05, 0.02)
POINTS = 100_000


@pytest.fixture(scope="module")
def frame():
    """A frame from the middle of the room."""
    return open_source("sim:room").frame(60)


def settings(voxel_size=0.05, **more):
    return load_config(voxel_size=voxel_size, **more)


def image_of(frame, config):
    return prepare(frame, config)


def held(evidence):
    """A copy of evidence that outlives the next call of its integrator."""
    return replace(evidence, **{name: getattr(evidence, name).copy() for name in ("coords", "values", "uniform")})


def holds(frame, config):
    """Return a map of the frame, and its evidence."""
    evidence = held(make_integrator(config).evidence(image_of(frame, config)))
    voxel_map = VoxelMap(config)
    voxel_map.add(evidence)
    return voxel_map, evidence


def test_classify(benchmark, frame):
    """Check, turn into metres, give reasons: the depth path without averaging."""
    benchmark(prepare, frame, settings(**{"depth.denoise": False}))


def test_classify_and_denoise(benchmark, frame):
    benchmark(prepare, frame, settings())


@pytest.mark.parametrize("voxel_size", SIZES)
@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_evidence(benchmark, frame, integrator, voxel_size):
    """All of an integrator: for `projective` window images, scattering hits, culling and evaluation together."""
    config = settings(voxel_size, integrator=integrator)
    benchmark(make_integrator(config).evidence, image_of(frame, config))


def test_window_images(benchmark, frame):
    """Cells so large that little but the window images is left to do."""
    config = settings(2.0)
    benchmark(make_integrator(config).evidence, image_of(frame, config))


def test_culling(benchmark, frame):
    """Nothing but free space up to the range: most boxes are found free at once, only the borders are inspected."""
    config = settings(0.02)
    image = image_of(frame, config)
    empty = replace(
        image, depth_m=np.full_like(image.depth_m, np.inf), reason=np.full_like(image.reason, Reason.TOO_FAR)
    )
    benchmark(make_integrator(config).evidence, empty)


def test_scattering_hits(benchmark, frame):
    """All pixels right in front of the camera: their cells are found, and there is little space to clear."""
    config = settings(0.02)
    image = image_of(frame, config)
    near = replace(image, depth_m=np.full_like(image.depth_m, 0.3), reason=np.zeros_like(image.reason))
    benchmark(make_integrator(config).evidence, near)


def test_evaluation(benchmark, frame):
    """A wall so noisy that nearly every block is mixed and is evaluated cell by cell."""
    config = settings(0.02, **{"noise.s0": 0.5})
    benchmark(make_integrator(config).evidence, image_of(frame, config))


@pytest.mark.parametrize("voxel_size", SIZES)
def test_adding_to_the_map(benchmark, frame, voxel_size):
    """The same evidence repeatedly, so that its free blocks reach the lower limit, as in a revisited map."""
    voxel_map, evidence = holds(frame, settings(voxel_size))
    benchmark(voxel_map.add, evidence)


@pytest.mark.parametrize("voxel_size", SIZES)
def test_adding_to_a_new_map(benchmark, frame, voxel_size):
    """Every block has to be created."""
    config = settings(voxel_size)
    _, evidence = holds(frame, config)
    benchmark.pedantic(
        lambda voxel_map: voxel_map.add(evidence), setup=lambda: ((VoxelMap(config),), {}), rounds=30, warmup_rounds=2
    )


@pytest.mark.parametrize("where", ["along a line", "anywhere"])
def test_look_up(benchmark, frame, where):
    """100,000 points across the map's box: neighbours on its diagonal, and by chance."""
    voxel_map, _ = holds(frame, settings())
    low, high = voxel_map.bounds()
    share = (
        np.linspace(0, 1, POINTS)[:, None] if where == "along a line" else np.random.default_rng(0).random((POINTS, 3))
    )
    points = low + share * (high - low)
    benchmark(voxel_map.log_odds, points)
