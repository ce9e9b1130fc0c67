"""Distances to surfaces: of a box by hand, of a scene by points sampled on its triangles."""

import numpy as np
import pytest

from stereovox.simulate.scene import Scene, box
from stereovox.simulate.scenes.hall import stage
from stereovox_lab.flights.clearance import Clearance


@pytest.mark.parametrize(
    ("point", "metres"),
    [((3, 0.2, 0.1), 2.0), ((2, 2, 0), np.sqrt(2)), ((2, 2, 2), np.sqrt(3)), ((0.6, 0, 0), 0.4), ((1, 1, 1), 0.0)],
)
def test_a_box(point, metres):
    clearance = Clearance(Scene([box("box", "box", (-1, -1, -1), (1, 1, 1))]))
    assert clearance.at(np.array(point, float)) == pytest.approx(metres, abs=1e-12)


def test_a_hall():
    scene = stage(plan=3).scene
    clearance, random = Clearance(scene), np.random.default_rng(0)
    weights = random.dirichlet((0.4, 0.4, 0.4), 4000)
    on_surface = np.einsum("nk,mkd->mnd", weights, scene.triangles).reshape(-1, 3)
    for _ in range(10):
        point = random.uniform([-4, -3, 0.3], [4, 3, 2.3])
        exact, sampled = clearance.at(point), np.linalg.norm(on_surface - point, axis=1).min()
        assert exact <= sampled + 1e-9
        assert exact >= sampled - 0.1
        assert clearance.at(point, 0.01) == min(0.01, exact)
