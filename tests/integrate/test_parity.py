"""The ladder: NumPy reference = kernels on one thread = kernels on many threads."""

from dataclasses import replace
from itertools import product

import naive_integrators
import numpy as np
import pytest
from made_images import CAMERA, cells_of, made_image, rows_of

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.cameras.wide import CylindricalCamera, SphericalCamera
from stereovox.config import load_config
from stereovox.integrate import make_integrator
from stereovox.sensors import SENSORS, make_sensor

SIZES = [0.4, 0.1, 0.05]
WIDE = {
    "sphere": SphericalCamera.from_field_of_view(40, 30, 150, 110, 0.1),
    "cylinder": CylindricalCamera.from_field_of_view(40, 30, 120, 220, 0.1),  # its outer rows look back
}


def reference_of(reference, image, config, sensor=None):
    cells, log_odds = reference(image, config, sensor or make_sensor(config.sensor))
    return dict(zip(map(tuple, cells.tolist()), np.rint(1000 * log_odds).astype(int).tolist(), strict=True))


def share_that_differs(ours, theirs, tolerance=0):
    keys = ours.keys() | theirs.keys()
    return sum(abs(ours.get(k, 0) - theirs.get(k, 0)) > tolerance for k in keys) / len(keys)


def assert_rays_equal_their_reference(image, config, at_least):
    ours = cells_of(make_integrator(config).evidence(image))
    reference = {"ray": naive_integrators.cast_rays, "line": naive_integrators.draw_lines}[config.integrator]
    theirs = reference_of(reference, image, config)
    assert len(theirs) > at_least
    assert share_that_differs(ours, theirs, tolerance=25) < 0.002
    assert share_that_differs(ours, theirs, tolerance=2) < 0.02


@pytest.mark.parametrize("model", SENSORS)
@pytest.mark.parametrize("voxel_size", SIZES)
def test_projective_equals_its_reference(model, voxel_size):
    config = load_config(voxel_size=voxel_size, max_range=2.5, **{"sensor.model": model})
    integrator = make_integrator(config)
    for seed in range(3 if voxel_size > SIZES[-1] else 1):  # the smallest cells take longest
        image = made_image(seed)
        ours = cells_of(integrator.evidence(image))
        theirs = reference_of(naive_integrators.project, image, config)
        assert len(theirs) > 60
        # float32 against float64: a few cells project on a pixel's edge or lie on a table column's edge
        assert share_that_differs(ours, theirs, tolerance=25) < 0.002
        assert share_that_differs(ours, theirs) < 0.02


@pytest.mark.parametrize("voxel_size", SIZES)
def test_next_to_an_edge_only_a_share_counts_as_in_the_reference(voxel_size):
    config = load_config(voxel_size=voxel_size, max_range=2.5, **{"projective.edge_share": 0.25})
    image = made_image(4)
    ours = cells_of(make_integrator(config).evidence(image))
    theirs = reference_of(naive_integrators.project, image, config)
    whole = cells_of(make_integrator(load_config(config, **{"projective.edge_share": 1.0})).evidence(image))
    less = sum(whole[cell] < ours[cell] < 0 for cell in ours)
    assert 30 < less < len(ours)  # some of both kinds
    assert ours.keys() == whole.keys()
    assert share_that_differs(ours, theirs, tolerance=25) < 0.002
    assert share_that_differs(ours, theirs) < 0.02


@pytest.mark.parametrize("model", SENSORS)
def test_lone_far_pixels_mark_and_clear_as_in_the_reference(model):
    """They clear nothing as wide as a patch, yet `andert` and `valenti` mark cells next to their points."""
    config = load_config(voxel_size=0.2, max_range=10.0, **{"sensor.model": model})
    camera = PinholeCamera.from_field_of_view(160, 120, 40, baseline=0.05)
    depth = np.full((120, 160), 0.7, np.float32)
    depth[5::8, 6::8] = 7.0
    image = replace(made_image(0), depth_m=depth, camera=camera)
    ours = cells_of(make_integrator(config).evidence(image))
    theirs = reference_of(naive_integrators.project, image, config)
    assert len(theirs) > 60
    assert share_that_differs(ours, theirs, tolerance=25) < 0.002


class Late:
    """Made up: clears up to two sigma behind a measurement, and marks beyond that if `marks`."""

    p_free, p_unknown = 0.3, 0.5

    def __init__(self, marks):
        self.marks = marks

    def probability(self, z, z_measured, sigma):
        t = (z - z_measured) / sigma
        p = np.where(t < 2, 0.3, 0.5)
        return np.where((t > 2.5) & (t < 3.9), 0.8, p) if self.marks else p

    def hit(self, z_measured, sigma, voxel_size):
        return np.full(np.shape(z_measured), 0.9)


class Tail(Late):
    """Made up: still gives a little evidence four sigma behind a measurement, at the end of the table."""

    def probability(self, z, z_measured, sigma):
        t = (z - z_measured) / sigma
        return 0.5 - 0.2 / (1 + np.exp(2 * (t - 2.5)))


@pytest.mark.parametrize("model", [Late(False), Late(True), Tail(False)], ids=["late", "marks late", "tail"])
@pytest.mark.parametrize(("voxel_size", "max_range", "far_share"), [(0.1, 4.0, 0.0), (0.1, 4.0, 0.1), (0.05, 3.0, 0.1)])
def test_models_that_speak_of_what_lies_behind(model, voxel_size, max_range, far_share, monkeypatch):
    from stereovox.integrate import projective

    monkeypatch.setattr(projective, "make_sensor", lambda config: model)
    config = load_config(voxel_size=voxel_size, max_range=max_range, **{"noise.s2": 0.03})
    image = made_image(2, far_share=far_share)
    ours = cells_of(make_integrator(config).evidence(image))
    theirs = reference_of(naive_integrators.project, image, config, model)
    assert share_that_differs(ours, theirs, tolerance=25) < 0.002


COVERED = [
    (*how, model, voxel_size)
    for i, how in enumerate(product(["ray", "line"], ["once", "every"]))
    for j, model in enumerate(SENSORS)
    for voxel_size in (SIZES[0], SIZES[1 + (i + j) % 2])
]
"""All with the largest cells, where a cell ends far from its centre; each pair with the others, which take longest."""


@pytest.mark.parametrize(("integrator", "update", "model", "voxel_size"), COVERED)
def test_ray_and_line_equal_their_references(integrator, model, voxel_size, update):
    config = load_config(
        voxel_size=voxel_size, max_range=2.5, integrator=integrator, **{"sensor.model": model, "ray.update": update}
    )
    image = made_image(5)
    assert_rays_equal_their_reference(image, config, at_least=60)


@pytest.mark.parametrize(("model", "update"), [("stereo", "once"), ("stereo", "every"), ("valenti", "every")])
@pytest.mark.parametrize("camera", WIDE)
@pytest.mark.parametrize("integrator", ["ray", "line"])
def test_rays_of_wide_cameras_equal_their_references(integrator, camera, model, update):
    """Depth is the distance from the x axis, and rays may point sideways and back."""
    settings = {"sensor.model": model, "ray.update": update, "noise.s2": 0.01}
    config = load_config(voxel_size=0.1, max_range=2.5, integrator=integrator, **settings)
    image = made_image(5, WIDE[camera])
    assert_rays_equal_their_reference(image, config, at_least=1000)


@pytest.mark.parametrize("update", ["once", "every"])
@pytest.mark.parametrize("integrator", ["ray", "line"])
def test_rays_of_a_row_may_part_along_every_axis(integrator, update):
    """A camera that faces along an axis: rays of one row go to both sides of it."""
    config = load_config(voxel_size=0.1, max_range=2.5, integrator=integrator, **{"ray.update": update})
    image = made_image(6, replace(CAMERA, cx=19.3))
    pose = np.eye(4)
    pose[:3, 3] = np.sqrt([2e-3, 3e-3, 5e-3])
    image = replace(image, T_world_sensor=pose)
    assert_rays_equal_their_reference(image, config, at_least=1000)


@pytest.mark.parametrize("camera", WIDE)
@pytest.mark.parametrize("integrator", ["ray", "line"])
def test_wide_cameras_hit_where_their_definition_says(integrator, camera):
    """The angles of the thesis instead of `rays()`: theta from the y-z plane, phi about the x axis, down from z."""
    camera = WIDE[camera]
    config = load_config(voxel_size=0.1, max_range=2.5, integrator=integrator, **{"sensor.model": "constant"})
    config = load_config(config, **{"ray.update": "once"})
    for u, v in [(3, 2), (20, 15), (38, 28)]:
        depth = np.full((camera.height, camera.width), np.nan, np.float32)
        depth[v, u] = 2.0
        down = (v - camera.cv) * camera.step_v
        sphere = isinstance(camera, SphericalCamera)
        across = np.tan((u - camera.cu) * camera.step_u) if sphere else (u - camera.cx) / camera.fx
        point = 2.0 * np.array([across, np.sin(down), np.cos(down)]) + 0.03
        pose = np.eye(4)
        pose[:3, 3] = 0.03
        image = replace(made_image(0, camera), depth_m=depth, T_world_sensor=pose)
        found = [cell for cell, value in cells_of(make_integrator(config).evidence(image)).items() if value > 0]
        assert found == [tuple(np.floor(point / 0.1).astype(int).tolist())]


@pytest.mark.parametrize("camera", WIDE)
@pytest.mark.parametrize("integrator", ["ray", "line"])
@pytest.mark.parametrize("update", ["once", "every"])
def test_threads_change_nothing_for_wide_cameras(integrator, camera, update):
    image = made_image(2, WIDE[camera])
    outcomes = []
    for threads in (1, 2, 3):
        config = load_config(voxel_size=0.1, integrator=integrator, threads=threads, **{"ray.update": update})
        outcomes.append(rows_of(make_integrator(config).evidence(image)))
    assert np.array_equal(outcomes[0], outcomes[1])
    assert np.array_equal(outcomes[0], outcomes[2])
    assert len(outcomes[0]) > 1000


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
@pytest.mark.parametrize("model", ["stereo", "andert"])
def test_threads_change_nothing(integrator, model, monkeypatch):
    from stereovox.integrate import projective

    monkeypatch.setattr(projective, "WORTH_A_THREAD", 1)
    images = [made_image(seed) for seed in range(2)]
    outcomes = []
    for threads in (1, 2, 3):
        more = {"sensor.model": model, "projective.full_share": 0.4}  # many hits are weighed
        config = load_config(voxel_size=0.05, max_range=3.0, integrator=integrator, threads=threads, **more)
        each = make_integrator(config)
        outcomes.append([rows_of(each.evidence(image)) for image in images])
    for several in outcomes[1:]:
        assert all(np.array_equal(*pair) for pair in zip(outcomes[0], several, strict=True))


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
def test_far_from_the_origin_nothing_changes(integrator):
    """Cells are counted from the camera's block, so float32 is as good at 100 km as at the origin."""
    config = load_config(voxel_size=0.125, integrator=integrator, **{"ray.update": "once"})
    image = made_image(1)
    blocks = np.array([800_000, -700_000, 3])
    moved_pose = image.T_world_sensor.copy()
    moved_pose[:3, 3] += blocks  # a block is 1 m wide: whole blocks, exact in float64
    moved = type(image)(image.depth_m, image.reason, image.camera, moved_pose)
    here, there = (cells_of(make_integrator(config).evidence(each)) for each in (image, moved))
    back = {tuple(np.array(cell) - 8 * blocks): value for cell, value in there.items()}
    assert share_that_differs(here, back) < 0.001


def test_wide_and_narrow_keys_agree():
    """Cells beyond 512 from the camera need 64-bit pixel keys; the hits must not depend on it."""
    image = made_image(2)
    narrow, wide = (load_config(voxel_size=0.02, max_range=reach, **{"noise.s2": 0.0}) for reach in (5.0, 9.0))
    hits = []
    for config in (narrow, wide):
        evidence = make_integrator(config).evidence(image)
        hits.append(cells_of(replace(evidence, values=np.maximum(evidence.values, 0), uniform=evidence.uniform[:0])))
    assert hits[0].keys() == hits[1].keys()


def test_a_ray_pool_that_is_too_small_grows_and_starts_over(monkeypatch):
    from stereovox.integrate import ray

    image = made_image(4)
    for update in ("every", "once"):
        config = load_config(voxel_size=0.04, max_range=2.5, integrator="ray", **{"ray.update": update})
        enough = rows_of(make_integrator(config).evidence(image))
        pool = ray.BlockPool
        monkeypatch.setattr(ray, "BlockPool", lambda dtype, capacity, pool=pool: pool(dtype, 2))
        assert np.array_equal(rows_of(make_integrator(config).evidence(image)), enough)
        monkeypatch.undo()


def test_projective_lists_that_are_too_small_grow_and_start_over(monkeypatch):
    from stereovox.integrate import projective
    from stereovox.integrate import projective as hits

    images = [made_image(seed) for seed in range(2)]
    config = load_config(voxel_size=0.04, max_range=2.5)
    enough = [rows_of(make_integrator(config).evidence(image)) for image in images]
    pool = hits.BlockPool
    monkeypatch.setattr(hits, "BlockPool", lambda dtype, capacity: pool(dtype, 2))
    monkeypatch.setattr(projective, "ROOM", 70)
    integrator = make_integrator(config)
    for image, cells in zip(images, enough, strict=True):
        assert np.array_equal(rows_of(integrator.evidence(image)), cells)


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_one_integrator_serves_many_cameras_by_turns(integrator):
    cameras = [replace(CAMERA, fx=50.0 + n, width=CAMERA.width - n) for n in range(20)]
    images = [made_image(n, camera) for n, camera in enumerate(cameras)]
    config = load_config(voxel_size=0.1, max_range=2.5, integrator=integrator)
    each = make_integrator(config)
    for n in (0, 1, 0, 1, *range(20), 0, 7):
        assert cells_of(each.evidence(images[n])) == cells_of(make_integrator(config).evidence(images[n]))
    assert len(each._eyes._kept) <= 16  # a lens that zooms does not fill the memory


def test_odd_image_sizes():
    for width, height in [(1, 1), (7, 3), (33, 65), (130, 1)]:
        camera = PinholeCamera(width, height, 40.0, 40.0, width / 2, height / 2, 0.05)
        image = made_image(3, camera, far_share=0)
        depth = np.where(np.isfinite(image.depth_m), image.depth_m, 1.5).astype(np.float32)
        image = type(image)(depth, np.zeros_like(image.reason), camera, image.T_world_sensor)
        config = load_config(voxel_size=0.1, max_range=2.5)
        ours = cells_of(make_integrator(config).evidence(image))
        assert share_that_differs(ours, reference_of(naive_integrators.project, image, config), tolerance=25) < 0.01
    assert CAMERA.width == 64


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_a_camera_where_cells_meet_sees_all_it_should(integrator):
    """At a corner of cells a ray that goes towards smaller indices leaves its first cell at depth zero."""
    config = load_config(voxel_size=0.2, max_range=2.5, integrator=integrator, **{"sensor.model": "constant"})
    slow = {"ray": naive_integrators.cast_rays, "projective": naive_integrators.project}[integrator]
    for seed in range(3):
        image = made_image(seed)
        pose = image.T_world_sensor.copy()
        pose[:3, 3] = 0.0
        image = replace(image, T_world_sensor=pose)
        ours = cells_of(make_integrator(config).evidence(image))
        theirs = reference_of(slow, image, config)
        assert share_that_differs(ours, theirs, tolerance=25) < 0.02
