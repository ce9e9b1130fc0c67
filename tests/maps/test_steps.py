"""Cells whose sides differ (Valenti 2018, 7.1), through the integrators, the map and its files."""

import numpy as np
import pytest
from made_images import made_image

from stereovox.cli import main
from stereovox.config import load_config
from stereovox.errors import ConfigError
from stereovox.frame import Viewpoint
from stereovox.integrate import make_integrator
from stereovox.maps import State, load_map, make_map
from stereovox.maps.storage.cubes import in_cubes

STEPS = (0.1, 0.25, 0.15)


def settings(integrator="ray", **more):
    return load_config(
        max_range=2.5,
        integrator=integrator,
        **{
            "steps": STEPS,
            "sensor.model": "constant",
            "ray.update": "once",
            "projective.full_share": 0,
            "blind_range": 0,
            **more,
        },
    )


def mapped(image, config):
    voxel_map = make_map(config)
    voxel_map.storage.set_viewpoint(Viewpoint(image.camera, image.T_world_sensor))
    voxel_map.add(make_integrator(config).evidence(image))
    return voxel_map


def points_of(image):
    """The measured points (N, 3) in the world, and the directions (N, 3) of their rays at depth 1."""
    T, slopes = image.T_world_sensor, image.camera.back_project(np.ones(image.depth_m.shape))
    valid = np.isfinite(image.depth_m)
    directions = slopes[valid] @ T[:3, :3].T
    return T[:3, 3] + image.depth_m[valid].astype(float)[:, None] * directions, directions


def cells_of(points):
    cells = np.floor(points / STEPS).astype(int)
    _, once = np.unique(cells @ [1, 10**6, 10**12], return_index=True)
    return set(map(tuple, cells[once].tolist()))


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
def test_measured_points_fall_into_their_cells(integrator):
    for seed in range(3):
        image = made_image(seed)
        voxel_map = mapped(image, settings(integrator))
        indices, log_odds = voxel_map.cells()
        prior = np.log(0.1 / 0.9)
        raised = {tuple(cell) for cell in indices[log_odds > prior].tolist()}
        wanted = cells_of(points_of(image)[0])
        assert len(wanted) > 50
        assert len(raised ^ wanted) <= 0.01 * len(wanted)  # float32 against float64 on a face


def test_rays_clear_the_cells_on_their_way():
    image = made_image(1)
    voxel_map = mapped(image, settings("ray"))
    hits, start = cells_of(points_of(image)[0]), image.T_world_sensor[:3, 3]
    some = image.depth_m > 0
    directions = image.camera.back_project(np.ones(some.shape))[some] @ image.T_world_sensor[:3, :3].T
    depth = np.minimum(image.depth_m[some].astype(float), 2.5)  # "too far" clears up to the maximum range
    shares = np.linspace(0, 1, 1500)
    crossed = set().union(*(cells_of(start + s * depth[:, None] * directions) for s in shares)) - hits
    indices, log_odds = voxel_map.cells()
    lowered = {tuple(cell) for cell in indices[log_odds < np.log(0.1 / 0.9)].tolist()}
    assert len(crossed) > 300
    assert len(crossed - lowered) <= 0.002 * len(crossed)
    assert len(lowered - crossed) <= 0.01 * len(crossed)  # samples step over corners


@pytest.mark.parametrize("integrator", ["projective", "ray", "line"])
def test_equal_steps_change_nothing(integrator):
    image = made_image(2)
    plain = mapped(image, settings(integrator, steps=None, voxel_size=0.1)).storage.blocks()
    equal = mapped(image, settings(integrator, steps=(0.1, 0.1, 0.1))).storage.blocks()
    for a, b in zip(plain, equal, strict=True):
        np.testing.assert_array_equal(a, b)


def test_projective_agrees_with_rays():
    image = made_image(3)
    projective, rays = (mapped(image, settings(name)) for name in ("projective", "ray"))
    ours, theirs = (
        {tuple(cell) for cell in each.cells()[0][each.cells()[1] < np.log(0.1 / 0.9)].tolist()}
        for each in (projective, rays)
    )
    assert len(theirs) > 300
    assert len(ours & theirs) > 0.85 * len(theirs)
    assert len(ours - theirs) < 0.15 * len(ours)


def test_places_are_in_metres(tmp_path):
    image = made_image(1)
    voxel_map = mapped(image, settings("projective", **{"map.free_below": 0.05, "map.occupied_above": 0.11}))
    occupied = voxel_map.occupied()
    np.testing.assert_allclose(np.mod(occupied, STEPS) / STEPS, 0.5)
    assert (voxel_map.state(occupied) == State.OCCUPIED).all()
    assert (voxel_map.state(occupied + np.multiply(STEPS, 0.49)) == State.OCCUPIED).all()
    assert voxel_map.voxel_size == 0.25
    low, high = voxel_map.bounds()
    assert (occupied.min(0) > low).all()
    assert (occupied.max(0) < high).all()
    voxel_map.save(tmp_path / "m.svox")
    again = load_map(tmp_path / "m.svox")
    np.testing.assert_array_equal(again.occupied(), occupied)
    with pytest.raises(ConfigError, match="made with steps"):
        make_map(settings(steps=(0.1, 0.25, 0.2)), again)


def test_a_window_of_such_cells(tmp_path):
    image = made_image(1)
    voxel_map = mapped(image, settings("ray", **{"window.size": [2.0, 2.0, 1.5], "window.trigger": 0.5}))
    whole = mapped(image, settings("ray"))
    low, high = voxel_map.window
    np.testing.assert_allclose(high - low, [2.0, 2.0, 1.5])
    indices, log_odds = whole.cells()
    centres = whole.centers(indices)
    inside = ((centres > low) & (centres < high)).all(axis=1)
    np.testing.assert_array_equal(voxel_map.cells()[0], indices[inside])
    np.testing.assert_array_equal(voxel_map.cells()[1], log_odds[inside])


def test_pictures_and_files_get_cubes(tmp_path, capsys):
    image = made_image(1)
    voxel_map = mapped(image, settings("ray", **{"map.free_below": 0.05, "map.occupied_above": 0.11}))
    cubes = in_cubes(voxel_map)
    assert cubes.voxel_size == 0.1
    centres = cubes.centers(cubes.cells()[0])
    np.testing.assert_array_equal(cubes.state(centres), voxel_map.state(centres + 1e-6))
    assert len(centres) == pytest.approx(len(voxel_map.cells()[0]) * np.prod(STEPS) / 0.1**3, rel=0.05)
    assert in_cubes(cubes) is cubes
    voxel_map.save(tmp_path / "m.svox")
    for words in (["picture", "p.png"], ["export", "m.bt"]):
        assert main([words[0], str(tmp_path / "m.svox"), str(tmp_path / words[1])]) == 0
        assert (tmp_path / words[1]).stat().st_size > 100


def test_steps_that_cannot_be():
    for steps in ((0.1, 0.1, 0.0), (0.1, 0.1, 5.0), (0.1, -1.0, 0.1)):
        with pytest.raises(ConfigError, match="steps"):
            load_config(steps=steps)
    assert load_config(steps=(0.2, 0.4, 0.2), voxel_size=0.1).voxel_size == 0.4
    assert load_config(load_config(steps=(0.2, 0.4, 0.2)), max_range=3.0).cell == (0.2, 0.4, 0.2)
