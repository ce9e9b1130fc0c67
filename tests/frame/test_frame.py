# SPDX-License-Identifier: Apache-2.0
"""The scale of depth images: NaN is "not given", which is 1 for floats and nothing for whole numbers."""

import copy
import pickle
from dataclasses import replace

import numpy as np
import pytest
from entrance_cases import good

import stereovox as sv
from stereovox.depth import prepare
from stereovox.errors import FrameRefused

CONFIG = sv.load_config()
WAYS = [lambda frame: frame, replace, copy.deepcopy, lambda frame: pickle.loads(pickle.dumps(frame))]


@pytest.mark.parametrize("given", [{}, {"depth_scale": np.nan}, {"depth_scale": np.float32("nan")}])
@pytest.mark.parametrize("way", WAYS)
def test_a_scale_that_is_not_given(given, way):
    frame = good("depth image")
    floats = way(sv.Frame(frame.depth, frame.camera, frame.T_world_sensor, **given))
    assert floats.depth_scale == 1.0
    assert np.nanmedian(prepare(floats, CONFIG).depth_m) == pytest.approx(1.0, abs=0.01)
    whole = way(replace(floats, depth=(1000 * frame.depth).astype(np.uint16)))
    with pytest.raises(FrameRefused, match="has no depth_scale; give metres per unit"):
        prepare(whole, CONFIG)
    assert replace(whole, depth=frame.depth).depth_scale == 1.0


def test_a_scale_that_is_given_stays():
    frame = good("depth image", depth=np.full((48, 64), 1000, np.uint16), depth_scale=0.001)
    assert replace(frame, stamp_ns=1).depth_scale == 0.001
    assert replace(good("depth image"), depth_scale=2.0, stamp_ns=1).depth_scale == 2.0
