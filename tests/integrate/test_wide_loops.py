# SPDX-License-Identifier: Apache-2.0
"""Hot loops compute on whole vectors on any processor: read in the machine code made for it.

A loop that looks something up between its products is compiled one lane at a time for processors without fast gathers.
"""

import pytest
from machine_code import NEOVERSE_N1, SKYLAKE_512, ZEN_3, arithmetic, listings_alone, loops

LANES = {ZEN_3: 8, SKYLAKE_512: 16, NEOVERSE_N1: 4}
RAYS = ["stereovox.integrate._ray:cast", "stereovox.integrate._ray:draw"]
EVALUATE, WEIGH = "stereovox.integrate._projective:evaluate", "stereovox.integrate._hits:weigh"
SCATTER, DENOISE = "stereovox.integrate._hits:scatter", "stereovox.depth._denoise:denoise"
ONE_IMAGE = """
from made_images import made_image
from stereovox.config import load_config
from stereovox.depth.prepare import denoise
from stereovox.integrate import make_integrator

denoise(made_image(5).depth_m, made_image(5).camera, load_config(voxel_size=0.02, **{"depth.keep_lines": True}))
for integrator in ("ray", "line", "projective"):
    make_integrator(load_config(voxel_size=0.1, max_range=2.5, integrator=integrator)).evidence(made_image(5))
"""
DIVISIONS_A_CALL = 2
"""Cells a metre, and the depth where `passed` changes."""
PRODUCTS_A_ROW = 40
"""Those of each row's rays; a loop over 32 lanes that is not wide has as many again, or remains a loop."""
PRODUCTS_IN_STEP = 3
"""The directions of one ray in `in_step`, which goes on where signs differ."""


@pytest.fixture(scope="module")
def made():
    kernels = [*RAYS, EVALUATE, WEIGH, SCATTER, DENOISE]
    return dict(zip(LANES, listings_alone(ONE_IMAGE, kernels, LANES), strict=True))


@pytest.mark.parametrize("kernel", RAYS)
@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_all_lanes_are_computed_at_once(made, processor, kernel):
    found = arithmetic(made[processor][kernel])
    assert found.lanes == LANES[processor]
    assert found.wide_divisions > 0
    assert found.wide_products >= 20
    assert found.single_divisions <= DIVISIONS_A_CALL
    assert found.single_products <= PRODUCTS_A_ROW


@pytest.mark.parametrize("kernel", RAYS)
@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
def test_no_loop_computes_lane_by_lane(made, processor, kernel):
    for loop in loops(made[processor][kernel]):
        found = arithmetic(loop)
        assert found.single_products <= PRODUCTS_IN_STEP, loop


def loops_of(text, least_products):
    """Return the arithmetic of the innermost loops that multiply at least so often."""
    counts = [arithmetic(loop) for loop in loops(text)]
    return [one for one in counts if one.wide_products + one.single_products >= least_products]


@pytest.mark.parametrize("processor", LANES, ids=lambda processor: processor.cpu)
@pytest.mark.parametrize(
    ("kernel", "products", "divisions"),
    [(EVALUATE, 4, 1), (WEIGH, 12, 0), (WEIGH, 4, 2), (SCATTER, 6, 0)],
    ids=["places in the image", "centres of hits", "footprints of hits", "cells of pixels"],
)
def test_cells_and_pixels_are_computed_in_whole_vectors(made, processor, kernel, products, divisions):
    """What remains of a row, or runs where memory might overlap, is a loop of its own and may go one by one."""
    found = [one for one in loops_of(made[processor][kernel], products) if one.lanes == LANES[processor]]
    assert any(one.wide_products >= products and one.wide_divisions >= divisions for one in found), found


@pytest.mark.parametrize("processor", [ZEN_3, SKYLAKE_512], ids=lambda processor: processor.cpu)
def test_denoising_averages_in_whole_vectors(made, processor):
    """Not on AArch64, for which LLVM judges the two divisions cheaper one by one."""
    widest = max(loops_of(made[processor][DENOISE], 20), key=lambda one: one.wide_products)
    assert widest.lanes == LANES[processor]
    assert widest.wide_divisions >= 2
    assert widest.single_divisions == widest.single_products == 0
