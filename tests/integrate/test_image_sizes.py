# SPDX-License-Identifier: Apache-2.0
"""Images of any size: very large ones give the map of smaller ones in bounded memory, single rows and columns a map."""

import tracemalloc

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.wide import SphericalCamera
from stereovox.errors import FrameRefused
from stereovox.frame import DepthImage, Reason
from stereovox.integrate import make_integrator
from stereovox.mapper import GridMapper

LOOKS_ALONG_X = np.array([[0.0, 0, 1, 0.02], [-1, 0, 0, 0.03], [0, -1, 0, 0.01], [0, 0, 0, 1]])
SMALL = (960, 540)
TIMES = 8


def scene(width, height, times):
    """A wall at 2.04 m with something nearer in each corner, and nothing known in the middle; millimetres."""
    depth = np.full((height, width), 2040, np.uint16)
    rows, columns = height // 5, width // 6
    for n, (row, column) in enumerate(((0, 0), (0, -columns), (-rows, 0), (-rows, -columns))):
        depth[row:, column:][:rows, :columns] = 1240 + 100 * n
    depth[2 * rows : 3 * rows, 3 * columns - 40 : 3 * columns + 40] = 0
    return depth.repeat(times, axis=0).repeat(times, axis=1)


def mapped(depth, **settings):
    camera = sv.PinholeCamera.from_field_of_view(depth.shape[1], depth.shape[0], 80)
    mapper = sv.Mapper(**settings)
    for n in range(2):
        frame = sv.Frame(depth, camera, LOOKS_ALONG_X, depth_scale=0.001, stamp_ns=n * 10**8)
        assert mapper.add(frame).refused is None
    return mapper.map


@pytest.mark.parametrize(
    ("integrator", "voxel_size"), [("projective", 0.1), ("projective", 1.0), ("ray", 0.25), ("ray", 1.0), ("line", 1.0)]
)
def test_an_8k_image_gives_the_map_of_a_smaller_one_in_bounded_memory(integrator, voxel_size):
    settings = {"integrator": integrator, "voxel_size": voxel_size, "depth.denoise": False}
    depth = scene(*SMALL, TIMES)
    assert depth.shape == (4320, 7680)
    tracemalloc.start()
    large = mapped(depth, **settings)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 11 * 4 * depth.size  # eleven images in metres, of which most is never touched
    small = mapped(scene(*SMALL, 1), **settings)
    everywhere = np.unique(np.concatenate([large.cells()[0], small.cells()[0]]), axis=0)
    one, other = (each.state(each.centers(everywhere)) for each in (large, small))
    assert np.count_nonzero(one != other) <= max(2, 0.03 * len(everywhere))
    assert len(everywhere) > 5
    opposite = {sv.State.FREE, sv.State.OCCUPIED}
    assert not any({a, b} == opposite for a, b in zip(one.tolist(), other.tolist(), strict=True))
    assert (large.state(large.occupied()) == sv.State.OCCUPIED).all()


CORNERS = [(1.24, 1, 1), (1.34, -1, 1), (1.44, 1, -1), (1.54, -1, -1)]


def test_no_corner_of_an_8k_image_is_lost():
    one = mapped(scene(*SMALL, TIMES), voxel_size=0.1)
    half = np.tan(np.radians(40))
    for metres, left, up in CORNERS:
        y, z = left * 0.9 * half * metres, up * 0.9 * half * 9 / 16 * metres
        at = [[metres + 0.02, 0.03 + y, 0.01 + z]]
        before = np.array([[0.6 * metres, 0.03 + 0.6 * y, 0.01 + 0.6 * z]])
        assert one.state(at) == sv.State.OCCUPIED, metres
        assert one.state(before) == sv.State.FREE, metres


def test_a_wide_image_that_is_too_fine_for_cells_is_refused_by_rays_in_one_line():
    camera = SphericalCamera(64, 64, 1 / 4000, 1 / 4000, 31.5, 31.5)
    depth = np.full((64, 64), 2.0, np.float32)
    image = DepthImage(depth, np.full(depth.shape, Reason.VALID, np.uint8), camera, LOOKS_ALONG_X)
    with pytest.raises(FrameRefused, match="use integrator projective or ray") as caught:
        make_integrator(sv.load_config(integrator="ray", voxel_size=0.5, **{"ray.update": "every"})).evidence(image)
    assert caught.value.reason == "bad_camera"


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
@pytest.mark.parametrize("size", [(1, 640), (480, 1), (1, 1), (2, 2), (1, 7680)])
@pytest.mark.parametrize("deadline", [None, 1e-6], ids=["whole", "in a hurry"])
def test_a_row_a_column_and_a_pixel_are_images(integrator, size, deadline):
    height, width = size
    focal = max(size) / 2
    camera = sv.PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    mapper = sv.Mapper(integrator=integrator, voxel_size=0.1, deadline_ms=deadline)
    for n in range(8):
        frame = sv.Frame(np.full(size, 2.04, np.float32), camera, LOOKS_ALONG_X, stamp_ns=n * 10**8)
        assert mapper.add(frame).refused in ((None,) if deadline is None else (None, "no_time", "no_valid_depth"))
    known = mapper.map.cells()[0]
    free, hit = mapper.map.free(), mapper.map.occupied()
    assert np.abs(hit[:, 0] - 2.06).max(initial=0) < 0.15
    assert free[:, 0].max(initial=0) < 2.0
    assert len(known) > 0 or deadline is not None
    if min(size) == 1 and len(free) and max(size) > 1:  # thin as it is, it sees but one layer
        across = 2 if height == 1 else 1
        assert np.ptp(np.concatenate([free, hit])[:, across]) < 0.25


@pytest.mark.parametrize("size", [(1, 640), (480, 1), (1, 1)])
def test_a_floor_takes_them_as_well_or_refuses_them_in_one_line(size):
    height, width = size
    focal = max(size) / 2
    camera = sv.PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    mapper = GridMapper("ist2019")
    report = mapper.add(sv.Frame(np.full(size, 2.04, np.float32), camera, LOOKS_ALONG_X))
    assert report.refused is None or "\n" not in report.detail
    assert len(mapper.map.free()) == 0 or np.abs(mapper.map.free()).max() < 2.2
