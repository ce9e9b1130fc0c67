# SPDX-License-Identifier: Apache-2.0
"""Small images cannot ask for huge work: cameras out of proportion are refused with a reason, before anything is done.

Work is counted in blocks and pixels, not by the clock.
"""

from dataclasses import replace

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.errors import StereovoxError
from stereovox.frame import Reason
from stereovox.integrate import views
from stereovox.integrate.views import MAX_CAMERAS, PerCamera
from stereovox.mapper import GridMapper
from stereovox.maps.storage.blocks import CELLS

PIXEL = {"width": 1, "height": 1, "cx": 0.0, "cy": 0.0}


def frame_of(camera, far=True, **more):
    """An image that sees nothing up to the maximum range, and so clears everything, or a wall."""
    shape = camera.height, camera.width
    reason = np.full(shape, Reason.TOO_FAR if far else Reason.VALID, np.uint8)
    return sv.Frame(np.full(shape, 0.0 if far else 2.0, np.float32), camera, np.eye(4), reason=reason, **more)


@pytest.mark.parametrize("fx", [0.006, 1e-300, 1e7, 1e300, 10**400, np.float16(0.006), "1", None, [1]])
@pytest.mark.parametrize("fy", [0.006, 10.0])
def test_focal_lengths_that_no_camera_has(fx, fy):
    with pytest.raises(StereovoxError, match=r"fx must be a number from 0\.025 to 1e") as refused:
        sv.PinholeCamera(fx=fx, fy=fy, **PIXEL)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    "make",
    [
        lambda: sv.PinholeCamera(10**6, 10**6, 1e6, 1e6, 5e5, 5e5),
        lambda: sv.PinholeCamera(2.5, 2, 10.0, 10.0, 1.0, 1.0),
        lambda: sv.PinholeCamera(2, 2, 10.0, 10.0, 1.0, 1.0, baseline=1e300),
        lambda: sv.PinholeCamera(2, 2, 10.0, 10.0, 1.0, 1.0, binning=0),
        lambda: sv.PinholeCamera(2, 2, 10.0, 10.0, 1.0, 1.0, subpixel=np.nan),
        lambda: sv.PinholeCamera(2, 2, 0.03, 10.0, 0.5, 0.5),  # its rays are steep at the borders only
        lambda: SphericalCamera(1, 1, 4.0, 0.1, 0.0, 0.0),
        lambda: SphericalCamera(4, 4, 1e-9, 0.1, 1.5, 1.5),
        lambda: SphericalCamera(10**5, 10**5, 1e-6, 1e-6, 1.5, 1.5),
        lambda: CylindricalCamera(4, 4, 1e300, 0.1, 1.5, 1.5),
        lambda: CylindricalCamera(4, 4, 100.0, 0.1, 1.5, np.inf),
    ],
)
def test_cameras_that_cannot_be(make):
    with pytest.raises(StereovoxError) as refused:
        make()
    assert "\n" not in str(refused.value)


def test_numbers_of_a_camera_are_plain_ones():
    camera = sv.PinholeCamera(np.int16(300), np.int16(200), np.float16(150), 150, 149.5, np.float32(99.5), binning=1.0)
    assert camera == sv.PinholeCamera(300, 200, 150.0, 150.0, 149.5, 99.5)
    assert [type(n) for n in (camera.width, camera.fx, camera.cy, camera.binning)] == [int, float, float, int]


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
@pytest.mark.parametrize(
    "camera",
    [
        sv.PinholeCamera(fx=0.03, fy=0.03, **PIXEL),
        sv.PinholeCamera(fx=0.3, fy=0.3, **PIXEL),
        SphericalCamera.from_field_of_view(1, 1, 170, 359),
        SphericalCamera.from_field_of_view(24, 18, 175, 359),
        CylindricalCamera.from_field_of_view(24, 18, 0.1, 359),
        CylindricalCamera.from_field_of_view(3, 300, 175, 359),
    ],
    ids=str,
)
def test_a_small_image_tells_of_few_cells_or_nothing(integrator, camera):
    mapper = sv.Mapper(integrator=integrator, voxel_size=0.05, max_range=10.0)
    report = mapper.add(frame_of(camera))
    blocks, _ = mapper.map.storage.blocks()
    assert report.refused in (None, "bad_camera", "view_too_large")
    assert len(blocks) <= 2 * views.MIN_BLOCKS
    assert not (report.refused and len(blocks))
    assert report.refused is None or ("\n" not in report.detail and "check" in report.detail)


def test_a_pixel_that_sees_a_hall_is_refused():
    report = sv.Mapper(max_range=10.0).add(frame_of(sv.PinholeCamera(fx=0.03, fy=0.03, **PIXEL)))
    assert report.refused == "bad_camera"
    assert "1x1 pixels see 3e+09 cells up to 10 m" in report.detail


def test_volumes_are_those_of_shapes_that_are_known():
    """A right-angled pyramid, and a cylinder as long on both sides as its radius."""
    assert sv.PinholeCamera.from_field_of_view(640, 640, 90).volume(3.0) == pytest.approx(4 * 27 / 3)
    for kind in (SphericalCamera, CylindricalCamera):  # all round, but for the two cones along the x axis
        whole = kind.from_field_of_view(90, 360, 90, 360).volume(2.0)
        assert whole == pytest.approx(2 * np.pi * 8 - 2 * np.pi * 8 / 3)
        assert kind.from_field_of_view(500, 360, 175, 360).volume(2.0) == pytest.approx(2 * np.pi * 8)


def test_a_frame_that_tells_of_too_much_is_refused_and_changes_nothing(monkeypatch):
    monkeypatch.setattr(views, "MAX_BLOCKS", 20_000)
    camera = sv.PinholeCamera.from_field_of_view(64, 48, 90)
    for settings in ({}, {"integrator": "ray"}):
        mapper = sv.Mapper(voxel_size=0.02, max_range=10.0, **settings)
        report = mapper.add(frame_of(camera))
        assert report.refused == "view_too_large"
        assert f"{20_000 * CELLS:.2g} cells" in report.detail
        assert not len(mapper.map.cells()[0])
        assert mapper.add(frame_of(camera, far=False, stamp_ns=1)).refused is None, "what is near can be mapped"


def test_noise_that_reaches_farther_than_can_be_counted():
    camera = sv.PinholeCamera(8, 8, 8.0, 8.0, 3.5, 3.5, baseline=1e-9)
    mapper = sv.Mapper(integrator="ray", **{"sensor.model": "andert"})
    assert mapper.add(frame_of(camera, far=False)).refused in (None, "bad_camera")


def test_a_steep_camera_under_a_deadline_never_raises():
    """Blocks of its pixels are steeper than any pinhole: the coarse level must refuse what the full one accepts."""
    camera = sv.PinholeCamera(1, 1, 0.05, 0.05, 0.0, 0.0)
    mapper = sv.Mapper(voxel_size=0.5, deadline_ms=1e-6)
    reports = [mapper.add(frame_of(camera, far=False, stamp_ns=n)) for n in range(12)]
    assert {report.refused for report in reports} == {None, "bad_camera"}
    assert sv.Mapper(voxel_size=0.5, **{"depth.downsample": 4}).add(frame_of(camera)).refused == "bad_camera"


@pytest.mark.parametrize("mapper", [sv.Mapper, GridMapper])
def test_numbers_and_arrays_of_odd_kinds(mapper):
    camera = sv.PinholeCamera(16, 12, 12.0, 12.0, 7.5, 5.5)
    turned = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1], [0, 0, 0, 1]])
    plain = replace(frame_of(camera, far=False), T_world_sensor=turned)
    odd = replace(
        plain, reason=np.matrix(plain.reason), depth=np.matrix(plain.depth), depth_scale=np.float16(1),
        farthest=np.float16(4),
    )  # fmt: skip
    maps = [mapper(max_range=3.0) for _ in range(2)]
    for made, frame in zip(maps, (plain, odd), strict=True):
        assert made.add(frame).refused is None
    (cells, values), (odd_cells, odd_values) = (made.map.cells() for made in maps)
    assert len(cells)
    assert (cells == odd_cells).all()
    assert (values == odd_values).all()
    for scale in (np.float16(0), np.float16(np.inf), np.float16(-1)):
        assert maps[0].add(replace(odd, depth_scale=scale, stamp_ns=1)).refused == "bad_scale"
    assert maps[0].add(replace(odd, depth_scale=np.float16(np.nan), stamp_ns=1)).refused is None  # NaN: not given
    bad = np.matrix(np.full((12, 16), 9, np.uint8))
    assert maps[0].add(replace(plain, reason=bad, stamp_ns=2)).refused == "bad_reason"


def test_what_is_kept_for_cameras_is_bounded_by_their_pixels():
    made = PerCamera(lambda camera: object())
    large = [sv.PinholeCamera(4000, 3000, 4e3 + n, 4e3, 2e3, 1.5e3) for n in range(2 * MAX_CAMERAS)]
    for camera in large:
        assert made[camera] is made[camera]
        assert sum(kept.width * kept.height for kept in made._kept) <= 2**26
    alone = sv.PinholeCamera(10**4, 10**4, 1e4, 1e4, 5e3, 5e3)
    assert made[alone] is made[alone], "the present one is kept in any case"
