"""Which frames are refused, and what every pixel becomes."""

import numpy as np
import pytest

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.errors import FrameRefused
from stereovox.frame import Frame, Reason

CAMERA = PinholeCamera(4, 2, 50.0, 50.0, 1.5, 0.5)
CONFIG = load_config(min_range=0.5, max_range=5.0)
POSE = np.eye(4)


def frame_of(depth, **changes):
    return Frame(**{"depth": depth, "camera": CAMERA, "T_world_sensor": POSE, "name": "f7", **changes})


@pytest.mark.parametrize("far", ["measured", "reported", "infinite"])
def test_every_pixel_gets_its_value_or_its_reason(far):
    millimetres = np.array([[0, 65535, 499, 500], [1234, 5000, 5001, 20000]], np.uint16)
    image = prepare(frame_of(millimetres, depth_scale=0.001), load_config(CONFIG, **{"depth.far": far}))
    nan, near, beyond = np.nan, -np.inf, np.inf
    expected = np.array([[nan, nan, near, 0.5], [1.234, 5.0, beyond, beyond]], np.float32)
    np.testing.assert_allclose(image.depth_m, expected, rtol=1e-6)
    U, N, F, V = Reason.UNKNOWN, Reason.TOO_NEAR, Reason.TOO_FAR, Reason.VALID
    assert image.reason.tolist() == [[U, U, N, V], [V, V, F, F]]
    assert image.depth_m.dtype == np.float32


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("far", "of_infinity"), [("measured", 5), ("reported", 5), ("infinite", 3)])
def test_float_depth_that_is_no_depth_clears_only_where_the_settings_say_so(dtype, far, of_infinity):
    depth = np.array([[np.nan, np.inf, -np.inf, -1.0], [0.0, 1e-30, 2.0, 65535.0]], dtype)
    image = prepare(frame_of(depth), load_config(CONFIG, **{"depth.far": far}))
    U = Reason.UNKNOWN
    assert image.reason.tolist() == [
        [U, of_infinity, Reason.TOO_NEAR, U],
        [U, Reason.TOO_NEAR, Reason.VALID, Reason.TOO_FAR],
    ]
    assert (image.depth_m == np.inf).tolist() == (image.reason == Reason.TOO_FAR).tolist()
    assert (image.depth_m == -np.inf).tolist() == (image.reason == Reason.TOO_NEAR).tolist()


def test_the_sources_reason_comes_first():
    given = np.array([[Reason.MASKED, Reason.TOO_FAR, Reason.TOO_NEAR, 0], [5, Reason.UNMATCHED, 0, 0]], np.uint8)
    depth = np.array([[1, 0, 0, 0], [1, 1, 1, 9]], np.float32)
    image = prepare(frame_of(depth, reason=given), CONFIG)
    assert image.reason.tolist() == [[4, 3, 2, 5], [5, 1, 0, 3]]
    np.testing.assert_array_equal(image.depth_m[0], np.array([np.nan, np.inf, -np.inf, np.nan], np.float32))
    assert np.isnan(image.depth_m[1, 0])


VALUES = (0.0, np.nan, -1.0, -np.inf, np.inf, 0.2, 2.0, 50.0)


def slowly_classified(value, said, far, farthest):
    """What depth.far says in words, for one pixel of a camera that measures from 0.5 to 5 m."""
    if value == -np.inf or 0 < value < 0.5:
        own = Reason.TOO_NEAR
    elif 0.5 <= value <= 5:
        own = Reason.VALID
    elif 5 < value < np.inf or (value == np.inf and far == "infinite"):
        own = Reason.TOO_FAR
    else:
        own = Reason.UNKNOWN
    if said == Reason.VALID:
        return own
    if said != Reason.TOO_FAR:
        return said
    if own == Reason.TOO_NEAR:
        return Reason.TOO_NEAR
    believed = far != "measured" and farthest >= 5 and own != Reason.VALID
    return Reason.TOO_FAR if believed else Reason.UNKNOWN


@pytest.mark.parametrize("far", ["measured", "reported", "infinite"])
@pytest.mark.parametrize("farthest", [np.inf, 5.0, 4.0, np.nan])
def test_every_value_under_every_word_of_the_source(far, farthest):
    """Whatever a source says: nothing but what is known to be too far becomes so, as it alone clears."""
    depth = np.repeat(np.array(VALUES, np.float32), len(Reason)).reshape(len(VALUES), -1)
    said = np.tile(np.array(Reason, np.uint8), (len(VALUES), 1))
    camera = PinholeCamera(depth.shape[1], depth.shape[0], 50.0, 50.0, 1.5, 0.5)
    frame = frame_of(depth, camera=camera, reason=said, farthest=farthest)
    image = prepare(frame, load_config(CONFIG, **{"depth.far": far}))
    wanted = [
        [slowly_classified(v, w, far, farthest) for v, w in zip(*row, strict=True)]
        for row in zip(depth, said, strict=True)
    ]
    assert image.reason.tolist() == wanted
    special = {Reason.TOO_NEAR: -np.inf, Reason.TOO_FAR: np.inf, Reason.VALID: 2.0}
    np.testing.assert_array_equal(image.depth_m, [[special.get(why, np.nan) for why in row] for row in wanted])


def mirrored():
    return np.diag([-1.0, 1, 1, 1])


def with_entry(value):
    pose = np.eye(4)
    pose[0, 3] = value
    return pose


GOOD = np.full((2, 4), 2.0, np.float32)
REFUSALS = [
    ("bad_dtype", {"depth": GOOD.astype(int)}),
    ("bad_dtype", {"depth": GOOD.astype(complex)}),
    ("bad_dtype", {"depth": [[1.0]]}),
    ("bad_shape", {"depth": GOOD.T}),
    ("bad_shape", {"depth": np.empty((0, 0), np.float32)}),
    ("bad_shape", {"depth": np.zeros((2, 4, 3), np.float32)}),
    ("bad_scale", {"depth_scale": 0.0}),
    ("bad_scale", {"depth": GOOD.astype(np.uint16), "depth_scale": float("nan")}),
    ("bad_reason", {"reason": np.zeros((1, 1), np.uint8)}),
    ("bad_reason", {"reason": np.full((2, 4), 9, np.uint8)}),
    ("bad_reason", {"reason": np.full((2, 4), -1, np.int64)}),
    ("bad_reason", {"reason": np.zeros((2, 4))}),
    ("bad_reason", {"reason": [[0] * 4] * 2}),
    ("bad_scale", {"depth_scale": None}),
    ("bad_scale", {"farthest": "far"}),
    ("pose_not_finite", {"T_world_sensor": with_entry(np.nan)}),
    ("pose_not_finite", {"T_world_sensor": with_entry(np.inf)}),
    ("pose_too_far", {"T_world_sensor": with_entry(1e6)}),
    ("pose_not_rigid", {"T_world_sensor": mirrored()}),
    ("pose_not_rigid", {"T_world_sensor": np.diag([1.1, 1, 1, 1])}),
    ("pose_not_rigid", {"T_world_sensor": np.zeros((4, 4))}),
    ("pose_not_rigid", {"T_world_sensor": np.eye(3)}),
    ("no_pose", {"T_world_sensor": None}),
    ("no_valid_depth", {"depth": GOOD * np.nan}),
    ("no_valid_depth", {"depth": GOOD * 0}),
    ("unreadable", {"fault": "unreadable", "fault_detail": "f7: cut short"}),
]


@pytest.mark.parametrize(("reason", "changes"), REFUSALS)
def test_refused_with_one_clear_line(reason, changes):
    with pytest.raises(FrameRefused) as caught:
        prepare(frame_of(**{"depth": GOOD, **changes}), CONFIG)
    assert caught.value.reason == reason
    assert "f7" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_view_of_nothing_but_far_is_kept():
    assert (prepare(frame_of(GOOD * 100), CONFIG).reason == Reason.TOO_FAR).all()


def test_rotations_of_few_digits_are_made_rigid():
    pose = np.eye(4)
    pose[:3, :3] += 4e-4 * np.random.default_rng(0).normal(size=(3, 3))
    T = prepare(frame_of(GOOD, T_world_sensor=pose), CONFIG).T_world_sensor
    np.testing.assert_allclose(T[:3, :3].T @ T[:3, :3], np.eye(3), atol=1e-12)


def test_the_frame_itself_is_left_alone():
    depth = GOOD.copy()
    depth[0, 0] = np.nan
    before = depth.copy()
    prepare(frame_of(depth), CONFIG)
    np.testing.assert_array_equal(depth, before)
