# SPDX-License-Identifier: Apache-2.0
"""The own matcher takes 32 disparities at once with AVX2 and 16 with NEON: read in the machine code made for them.

A loop that numba's promotions or checks keep from that still gives the right numbers, many times as slowly.
"""

import re

import pytest
from machine_code import NEOVERSE_N1, ZEN_3, listings

MODULE = "stereovox.depth.stereo._semiglobal"
ONE_PAIR = """
import numpy as np
from stereovox.config import load_config
from stereovox.depth.stereo.semiglobal import Census

image = np.zeros((20, 40), np.uint8)
Census(load_config(**{"stereo.disparities": 64, "stereo.speckle_size": 0}).stereo)(image, image)
"""
WANTED = {
    "enter": (8, 1, "vpsubusb", "uqsub"),
    "leave": (1, 2, "vpsubw", "usubw"),
    "smooth": (1, 4, "vpmulld", "mul"),
    "downward": (4, 1, "vpminub", "umin"),
    "sideways": (8, 1, "vpminub", "umin"),
    "choose": (4, 2, "vpminuw", "umin"),
}
"""What each kernel does with a disparity: how often, with a number of how many bytes, by which instruction of AVX2 and
of NEON."""
REGISTERS = {ZEN_3: (32, "ymm"), NEOVERSE_N1: (16, r"v\d+\.(?:16b|8h|4s)")}
"""Bytes of a vector, and how it is written."""
BLOCK = 64
"""Disparities that a loop takes in one go, in as many instructions as it takes."""


@pytest.fixture(scope="module")
def made():
    return dict(zip(REGISTERS, listings(ONE_PAIR, [f"{MODULE}:{name}" for name in WANTED], REGISTERS), strict=True))


@pytest.mark.parametrize("kernel", WANTED)
@pytest.mark.parametrize("processor", REGISTERS, ids=lambda processor: processor.cpu)
def test_disparities_are_computed_at_once(made, processor, kernel):
    (size, register), (times, number, avx, neon) = REGISTERS[processor], WANTED[kernel]
    instruction = avx if processor is ZEN_3 else rf"{neon}2?"  # 2: of the upper half of a vector
    found = re.findall(rf"^\s+{instruction}\s.*{register}", made[processor][f"{MODULE}:{kernel}"], re.MULTILINE)
    assert len(found) >= times * BLOCK * number // size
