# SPDX-License-Identifier: Apache-2.0
"""Images that cannot be pictures of anything are refused before they become evidence; those of odd scenes are not."""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.rigs import StereoPair
from stereovox.config import load_config
from stereovox.depth import DepthPipeline
from stereovox.depth.prepare import prepare
from stereovox.depth.quality import BEND_SIGMA, BEND_SLACK, ROWS, counted
from stereovox.errors import FrameRefused
from stereovox.frame import Reason
from stereovox.sensors.noise import RangeNoise

CAMERA = sv.PinholeCamera(160, 120, 120.0, 120.0, 79.5, 59.5, 0.05)
WIDE = sv.CylindricalCamera.from_field_of_view(160, 120, 100.0, 120.0, 0.1)
CONFIG = load_config(**{"depth.denoise": False})
PIXELS = 120 * 160


def frame_of(depth, camera=CAMERA, **changes):
    return sv.Frame(np.asarray(depth, np.float32), camera, np.eye(4), **changes)


def why(frame, **settings):
    try:
        DepthPipeline(load_config(CONFIG, **settings)).image(frame)
    except FrameRefused as refused:
        return refused.reason
    return ""


def slanted(camera=CAMERA):
    """A floor that rises towards a wall, with the noise of a stereo camera."""
    v, u = np.mgrid[:120, :160]
    depth = np.minimum(0.8 / np.maximum((v - 50) / 120, 1e-3), 3 + 0.004 * u)
    return depth + np.random.default_rng(0).normal(0, 0.08 / (120 * 0.05), depth.shape) * depth**2


def naive_counts(depth_m, noise):
    """The same in plain Python: rows one by one, pixels one by one."""
    looked = saying = compared = even = 0
    for row in depth_m[:: max(1, len(depth_m) // ROWS)].astype(float):
        looked += len(row)
        saying += sum(d > 0 for d in row)
        for a, b, c in zip(row, row[1:], row[2:], strict=False):
            if all(np.isfinite(d) and d > 0 for d in (a, b, c)):
                compared += 1
                sigma = (noise.s0 + noise.s1 * b + noise.s2 * b * b) / b**2  # of the inverse depth
                even += abs(1 / a - 2 / b + 1 / c) <= BEND_SIGMA * sigma + BEND_SLACK / b
    return looked, saying, compared, even


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
@pytest.mark.parametrize("seed", range(4))
def test_counts_are_those_of_plain_python(camera, seed):
    random = np.random.default_rng(seed)
    depth = slanted() * random.choice([1, 1, 1, 1.03, 1.5], (120, 160))
    depth.flat[random.choice(PIXELS, 4000)] = random.choice([0, np.nan, 9.0, 0.01], 4000)
    image = prepare(frame_of(depth, camera), CONFIG)
    expected = naive_counts(image.depth_m, RangeNoise.of(CONFIG.noise, camera))
    assert 0 < expected[3] < expected[2] < expected[1] < expected[0]
    found = counted(image, CONFIG)
    assert found[:3] == expected[:3]
    assert abs(found[3] - expected[3]) <= 2  # float32 at the very limit


@pytest.mark.parametrize("camera", [CAMERA, WIDE])
def test_depths_of_no_surface_are_refused(camera):
    random = np.random.default_rng(1)
    noise, good = random.uniform(0.2, 6.0, (120, 160)), slanted()
    assert why(frame_of(good, camera)) == ""
    assert why(frame_of(noise, camera)) == "no_surfaces"
    assert why(frame_of(random.permutation(good.ravel()).reshape(good.shape), camera)) == "no_surfaces"
    assert why(frame_of(noise, camera), **{"trust.min_surface_share": 0}) == ""


def test_half_an_image_without_value_and_open_air_are_fine():
    good, random = slanted(), np.random.default_rng(2)
    assert why(frame_of(np.where(np.arange(160) < 80, np.nan, good))) == ""
    assert why(frame_of(np.where(random.random(good.shape) < 0.5, np.nan, good))) == ""
    assert why(frame_of(np.full((120, 160), 80.0))) == ""  # all too far
    assert why(frame_of(np.full((120, 160), 0.15))) == ""  # before a wall


def test_a_handful_of_pixels_is_refused():
    depth = np.zeros((120, 160), np.float32)
    depth.flat[[100, 5000, 9000, 15000]] = 2.0
    assert why(frame_of(depth)) == "too_few_values"
    assert why(frame_of(depth), **{"trust.min_valid_share": 0}) == ""
    depth[50, :100] = 2.0  # 0.5 % of them, in a row that no sample may pass over
    assert why(frame_of(depth)) == ""


def test_masked_pixels_are_none_of_those_that_say_nothing():
    reason = np.full((120, 160), Reason.MASKED, np.uint8)
    reason[60:64, 60:100] = Reason.UNKNOWN
    reason[60, 60:64] = Reason.VALID
    assert why(frame_of(np.full((120, 160), 2.0), reason=reason)) == ""
    reason[reason == Reason.MASKED] = Reason.UNKNOWN
    assert why(frame_of(np.full((120, 160), 2.0), reason=reason)) == "too_few_values"


def test_whole_numbers_need_their_unit():
    millimetres = (1000 * slanted()).astype(np.uint16)
    frame = sv.Frame(millimetres, CAMERA, np.eye(4))
    with pytest.raises(FrameRefused, match=r"uint16 and has no depth_scale.*depth_scale=0\.001") as refused:
        prepare(frame, CONFIG)
    assert refused.value.reason == "bad_scale"
    assert why(replace(frame, depth_scale=0.001)) == ""
    assert sv.Frame(slanted(), CAMERA, np.eye(4)).depth_scale == 1.0


@pytest.mark.parametrize(
    ("scale", "cure"),
    [(1000.0, "millimetres"), (0.001, "metres already"), (1.0, None), (10.0, None), (0.1, None)],
)
def test_depths_that_are_no_metres_are_refused_with_the_cure(scale, cure):
    frame = frame_of(slanted() * scale)
    if cure is None:
        assert why(frame) in ("", "no_surfaces")
        return
    with pytest.raises(FrameRefused, match=cure) as refused:
        prepare(frame, CONFIG)
    assert refused.value.reason == "bad_units"
    mapper = sv.Mapper(voxel_size=0.1)
    for _ in range(5):
        mapper.add(frame_of(np.full((120, 160), 1.5)))
    before = mapper.map.storage.blocks()[1].tobytes()
    assert mapper.add(frame).refused == "bad_units"
    assert mapper.map.storage.blocks()[1].tobytes() == before


def test_a_street_seen_by_a_map_that_ends_near_is_no_matter_of_units():
    street = frame_of(np.linspace(15, 80, PIXELS).reshape(120, 160))
    assert why(street, max_range=5.0) == ""
    assert why(street, max_range=1.0) == ""


GREY = np.random.default_rng(3).integers(20, 200, (120, 160), np.uint8)


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (GREY // 64, "too_dark"),
        (GREY | 252, "overexposed"),
        (np.where(np.arange(160) < 110, GREY, 255).astype(np.uint8), ""),  # a third is sky
    ],
)
def test_pairs_without_light_or_with_too_much_are_refused(image, reason):
    pair = sv.StereoFrame(GREY, image, StereoPair(CAMERA), np.eye(4))
    for frame in (pair, replace(pair, left=image, right=GREY)):
        assert dark(frame) == reason
    assert dark(pair, **{"trust.max_unexposed_share": 1}) == ""


def dark(frame, **settings):
    try:
        DepthPipeline(load_config(CONFIG, **settings)).matched(frame)
    except FrameRefused as refused:
        return refused.reason
    return ""
