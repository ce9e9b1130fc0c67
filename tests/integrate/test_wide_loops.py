# SPDX-License-Identifier: Apache-2.0
"""All integrators compute on whole vectors on any processor: read in the machine code made for it.

A loop that looks something up between its products is compiled one lane at a time for processors without fast gathers.
"""

import pytest
from machine_code import NEOVERSE_N1, SKYLAKE_512, ZEN_3, arithmetic, listings, loops

LANES = {ZEN_3: 8, SKYLAKE_512: 16, NEOVERSE_N1: 4}
KERNELS = ["stereovox.integrate._ray:cast", "stereovox.integrate._ray:draw"]
EVALUATE, WEIGH = "stereovox.integrate._projective:evaluate", "stereovox.integrate._hits:weigh"
ONE_IMAGE = """
from made_images import made_image
from stereovox.config import load_config
from stereovox.integrate import make_integrator

for integrator in ("projective", "ray", "line"):
    make_integrator(load_config(voxel_size=0.1, max_range=2.5, integrator=integrator)).evidence(made_image(5))
"""
DIVISIONS_A_CALL = 2
"""Cells a metre, and the depth where `passed` changes."""
PRODUCTS_A_ROW = 40
"""Those of each row's rays; a loop over 32 lanes that is not wide has as many again, or remains a loop."""
PRODUCTS_IN_STEP = 3
"""The directions of one ray in `in_step`, which goes on where signs differ."""
DIVISIONS_OF_A_HIT = 3
"""Depth to pixels, the step between samples, and the share of them."""
MARKED_CELL = 2, 10
"""Divisions and products of `marked`, which few sensor models need, cell by cell."""


@pytest.fixture(scope="module")
def made():
    return dict(zip(LANES, listings(ONE_IMAGE, [*KERNELS, EVALUATE, WEIGH], LANES), strict=True))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_all_lanes_are_computed_at_once(made, processor, kernel):
    found = arithmetic(made[processor][kernel])
    assert found.lanes == LANES[processor]
    assert found.wide_divisions > 0
    assert found.wide_products >= 20
    assert found.single_divisions <= DIVISIONS_A_CALL
    assert found.single_products <= PRODUCTS_A_ROW


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_no_loop_computes_lane_by_lane(made, processor, kernel):
    for loop in loops(made[processor][kernel]):
        found = arithmetic(loop)
        assert found.single_products <= PRODUCTS_IN_STEP, loop


@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_cells_of_a_layer_are_evaluated_at_once(made, processor):
    text = made[processor][EVALUATE]
    found = arithmetic(text)
    assert found.lanes == LANES[processor]
    assert found.wide_divisions > 0
    assert found.wide_products >= 20
    divisions, products = MARKED_CELL
    assert found.single_divisions <= divisions
    for loop in loops(text):
        assert arithmetic(loop).single_products <= products, loop


@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_hits_are_weighed_many_at_once(made, processor):
    """What is left over, less than a vector, is weighed one by one; so there are as many single divisions as loops."""
    found = arithmetic(made[processor][WEIGH])
    assert found.lanes == LANES[processor]
    assert found.wide_divisions >= DIVISIONS_OF_A_HIT
    assert found.wide_products >= 20
    assert found.single_divisions <= DIVISIONS_OF_A_HIT + 1
