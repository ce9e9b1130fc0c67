# SPDX-License-Identifier: Apache-2.0
"""The weight of a hit: full if much of a cell's footprint supports it, less if only a few pixels do."""

from dataclasses import replace

import naive_integrators
import numpy as np
import pytest
from made_images import cells_of, made_image

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.config import load_config
from stereovox.depth import prepare
from stereovox.frame import DepthImage, Frame
from stereovox.integrate import make_integrator
from stereovox.sensors import make_sensor

WHOLE = load_config(voxel_size=0.4, **{"projective.full_share": 0.0})
STRAIGHT = PinholeCamera(64, 48, 40.0, 40.0, 32.0, 24.0, 0.05)


def hits_of(image, integrator):
    evidence = integrator.evidence(image)
    return cells_of(replace(evidence, values=np.maximum(evidence.values, 0), uniform_values=0))


def reference_hits(image, config):
    table = naive_integrators._table(image, config, make_sensor(config.sensor))
    cells, _ = naive_integrators._distinct(naive_integrators._hit_cells(image, config))
    cells, evidence = naive_integrators._weighed(cells, image, config, table)
    thousandths = np.rint(1000 * evidence).astype(int).tolist()
    return dict(zip(map(tuple, cells.tolist()), thousandths, strict=True))


@pytest.mark.parametrize("voxel_size", [0.02, 0.1, 0.4, 1.5, 6.0])
@pytest.mark.parametrize(("model", "full_share"), [("stereo", 0.15), ("constant", 1.0)])
def test_hits_equal_the_reference(model, voxel_size, full_share):
    """From cells far below a pixel to cells that hold the camera itself."""
    more = {"sensor.model": model, "projective.full_share": full_share}
    config = load_config(voxel_size=voxel_size, max_range=2.5, **more)
    ours, theirs = {}, {}
    integrator = make_integrator(config)
    for seed in range(3 if voxel_size < 1 else 20):
        image = made_image(seed)
        ours |= {(seed, cell): value for cell, value in hits_of(image, integrator).items()}
        theirs |= {(seed, cell): value for cell, value in reference_hits(image, config).items()}
    cells = ours.keys() | theirs.keys()
    # float32 against float64: a point on a face falls to the other side, a sample into the pixel beside
    off = [abs(ours.get(cell, 0) - theirs.get(cell, 0)) for cell in cells]
    assert len(cells) >= 20
    assert np.mean(np.array(off) > 1) <= 0.01
    if voxel_size in (0.1, 0.4):
        assert len(set(theirs.values())) > 3, "all weights alike: nothing was tested"


def test_no_share_asked_for_means_every_hit_in_full():
    config = load_config(voxel_size=0.1, **{"sensor.model": "constant", "projective.full_share": 0.0})
    assert set(hits_of(made_image(3), make_integrator(config)).values()) == {847}


def straight(depth):
    """An image from a camera before the cells' corner: cell (0, 0, 2) of 0.4 m is columns 32 to 48, rows 24 to 40."""
    pose = np.eye(4)
    return DepthImage(depth.astype(np.float32), np.zeros(depth.shape, np.uint8), STRAIGHT, pose)


def wall_with(part):
    """A wall at 3 m, and before it, at 1 m, `part` of the image: (rows, columns)."""
    depth = np.full((48, 64), 3.0)
    depth[part] = 1.0
    return straight(depth)


@pytest.mark.parametrize(
    ("part", "samples"),
    [
        ((slice(24, 40), slice(32, 48)), 16),  # the whole footprint
        ((slice(24, 40), slice(32, 36)), 4),  # a quarter: one column of samples in four
        ((slice(24, 28), slice(32, 36)), 1),
        ((slice(25, 26), slice(33, 34)), 0.5),  # one pixel, between the samples: half of one counts
    ],
)
@pytest.mark.parametrize("full_share", [0.15, 0.5, 1.0])
def test_weight_by_hand(part, samples, full_share):
    more = {"sensor.model": "constant", "projective.full_share": full_share}
    integrator = make_integrator(load_config(voxel_size=0.4, **more))
    found = hits_of(wall_with(part), integrator)[0, 0, 2]
    assert found == pytest.approx(847 * np.sqrt(min(1, samples / 16 / full_share)), abs=1)


@pytest.mark.parametrize("model", ["stereo", "constant"])
def test_a_lone_wrong_pixel_is_less_than_a_surface_in_every_large_cell(model):
    more = {"sensor.model": model, "projective.full_share": 0.15}
    integrator, as_told = make_integrator(load_config(voxel_size=0.4, **more)), make_integrator(WHOLE)
    in_full = hits_of(wall_with((slice(24, 40), slice(32, 48))), as_told)[0, 0, 2]
    surface = hits_of(wall_with((slice(24, 40), slice(32, 48))), integrator)[0, 0, 2]
    for v, u in [(25, 33), (30, 34), (33, 40), (38, 46)]:
        lone = hits_of(wall_with((v, u)), integrator)[0, 0, 2]
        assert 0 < lone < 0.7 * surface
        assert hits_of(wall_with((v, u)), as_told)[0, 0, 2] == in_full


def test_a_single_pixel_is_all_that_a_small_cell_has():
    """If a cell is no larger than a pixel, one pixel is its whole footprint."""
    config = load_config(voxel_size=0.02, max_range=3.5, **{"sensor.model": "constant"})
    assert set(hits_of(wall_with((30, 40)), make_integrator(config)).values()) == {847}


def test_the_depth_of_the_centre_decides_and_not_that_of_the_pixels():
    """Points all over a cell give it the one evidence that a hit at its centre's depth has."""
    config = load_config(voxel_size=0.4, max_range=5.0, **{"projective.full_share": 0.0, "noise.s2": 0.05})
    table = naive_integrators._table(straight(np.ones((48, 64))), config, make_sensor(config.sensor))
    for distance in (2.01, 2.2, 2.39):
        image = straight(np.full((48, 64), distance))
        row = int(2.2 * table.rows_per_metre)
        assert hits_of(image, make_integrator(config))[0, 0, 5] == pytest.approx(1000 * table.hit[row], abs=1)


def test_a_point_a_hair_before_a_face_does_not_hide_the_cell_behind_it():
    """Float32 may put the point into the cell behind the face: that cell must be the one that is entered, since its
    number is remembered and a second pixel that truly lies there is passed over."""
    camera = PinholeCamera(8, 4, 1000.0, 1000.0, 0.0, 0.0, 0.05)
    pose = np.eye(4)
    pose[:3, 3] = [0.02, 0.02, 0.0137]
    face = np.float32(40 * 0.05 - 0.0137)
    config = load_config(voxel_size=0.05, max_range=5.0, **{"sensor.model": "constant", "depth.denoise": False})
    integrator, before, both_sides = make_integrator(config), face, set()
    for _ in range(41):
        depth = np.full((4, 8), np.nan, np.float32)
        depth[0, 0], depth[2, 0] = before, face + np.float32(0.02)
        evidence = cells_of(integrator.evidence(prepare(Frame(depth, camera, pose, 0), config)))
        hits = {cell for cell, value in evidence.items() if value > 0}
        assert (0, 0, 40) in hits
        assert hits <= {(0, 0, 39), (0, 0, 40)}
        both_sides.add(len(hits))
        before = np.nextafter(before, np.float32(0))
    assert both_sides == {1, 2}, "the face was not crossed: nothing was tested"


def test_nothing_seen_is_no_evidence():
    from stereovox.integrate.projective import strongest

    nothing = strongest([])
    assert len(nothing.coords) == len(nothing.uniform) == 0
