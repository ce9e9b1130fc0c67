# SPDX-License-Identifier: Apache-2.0
"""The pinhole images of wide images: they show everything seen, no finer and no more than the image needs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import load_config
from stereovox.errors import FrameRefused
from stereovox.integrate import cube_faces as faces

CONFIG = load_config()
KINDS = st.sampled_from([SphericalCamera, CylindricalCamera])


def whole_faces(camera):
    """The six uncut sides of the cube: for each the positions of its seen pixels, and their source pixels."""
    size = max(2, round(2 * max(camera.focal_px / camera.binning, 1 / camera.step_v)))
    middle = (size - 1) / 2
    pinhole = PinholeCamera(size, size, size / 2, size / 2, middle, middle)
    for forward in faces.FORWARD:
        face = faces._face(camera, pinhole, np.array(forward, float))
        v, u = np.nonzero(face.pixel >= 0)
        yield tuple(face.T_wide_face[:3, 2]), dict(zip(zip(v, u, strict=True), face.pixel[v, u], strict=True)), middle


@settings(max_examples=60, deadline=None, derandomize=True)
@given(
    KINDS, st.integers(1, 40), st.integers(1, 40), st.floats(1, 170), st.floats(1, 360), st.floats(-9, 9), st.booleans()
)
def test_no_pixel_that_sees_something_is_cut_off(kind, width, height, hfov_deg, vfov_deg, turn, aside):
    camera = kind.from_field_of_view(width, height, hfov_deg, vfov_deg)
    where = {"cv": camera.cv + turn / camera.step_v}
    if aside and hfov_deg < 80:
        where |= {"cu": -0.5} if kind is SphericalCamera else {"cx": -0.5}
    camera = kind(**{**vars(camera), **where})
    if max(camera.focal_px, 1 / camera.step_v) > 400:
        return  # the slow twin would need too much memory
    if camera.focal_px * camera.step_v > 3 or camera.focal_px * camera.step_v < 1 / 3:
        return  # sides that differ so much may be refused; see below
    cut = {tuple(face.T_wide_face[:3, 2]): face for face in faces.faces_of(camera, CONFIG)}
    for forward, whole, middle in whole_faces(camera):
        assert (forward in cut) == bool(whole)
        if whole:
            face = cut[forward]
            left, top = round(middle - face.camera.cx), round(middle - face.camera.cy)
            v, u = np.nonzero(face.pixel >= 0)
            assert dict(zip(zip(v + top, u + left, strict=True), face.pixel[v, u], strict=True)) == whole


@pytest.mark.parametrize(
    ("camera", "most"),
    [
        (SphericalCamera.from_field_of_view(640, 480, 170, 180), 2.0),
        (SphericalCamera.from_field_of_view(720, 360, 176, 360), 6.0),
        (CylindricalCamera.from_field_of_view(640, 480, 120, 180), 3.0),
        (SphericalCamera.from_field_of_view(24, 18, 0.01, 0.01), 2.0),
        (SphericalCamera.from_field_of_view(640, 480, 1e-1, 1e-1), 1.5),
        (CylindricalCamera.from_field_of_view(24, 18, 0.1, 0.1), 2.0),
    ],
    ids=str,
)
def test_faces_have_not_many_more_pixels_than_the_image(camera, most):
    made = faces.faces_of(camera, CONFIG)
    assert sum(face.pixel.size for face in made) <= most * camera.width * camera.height
    seen = np.unique(np.concatenate([face.pixel[face.pixel >= 0] for face in made]))
    columns, _ = camera.rays()
    plain = np.flatnonzero(np.abs(columns) < 0.7)  # farther out rows crowd
    wanted = (np.arange(camera.height)[:, None] * camera.width + plain).ravel()
    assert np.isin(wanted, seen).mean() > 0.999


def test_pixels_a_thousand_times_as_wide_as_high_are_refused_before_any_work(monkeypatch):
    monkeypatch.setattr(faces, "_face", None)
    with pytest.raises(FrameRefused, match="sides differ too much") as refused:
        faces.faces_of(CylindricalCamera.from_field_of_view(24, 18, 0.1, 359), CONFIG)
    assert refused.value.reason == "bad_camera"
