"""The whole flow by its Python API."""

import signal
from dataclasses import replace

import numpy as np
import pytest
from made_images import made_image

import stereovox as sv


def frame_of(image, **changes):
    depth = np.where(np.isfinite(image.depth_m), image.depth_m, 0)
    return sv.Frame(**{"depth": depth, "camera": image.camera, "T_world_sensor": image.T_world_sensor, **changes})


def wall_frame(distance=2.0, camera=None):
    camera = camera or sv.PinholeCamera(80, 60, 60.0, 60.0, 39.5, 29.5, 0.05)
    pose = np.array([[0, 0, 1, 0.03], [-1, 0, 0, 0.02], [0, -1, 0, 0.01], [0, 0, 0, 1.0]])  # looks along world x
    return sv.Frame(np.full((60, 80), distance, np.float32), camera, pose)


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_a_wall_is_found_with_free_space_before_and_unknown_behind(integrator):
    mapper = sv.Mapper("default", voxel_size=0.1, integrator=integrator)
    for _ in range(8):
        report = mapper.add(wall_frame())
    assert report.refused is None
    on_axis = np.array([[x, 0.02, 0.01] for x in (0.55, 1.05, 1.55, 2.05, 2.35, 3.0)])
    free, occupied, unknown = sv.State.FREE, sv.State.OCCUPIED, sv.State.UNKNOWN
    assert mapper.map.state(on_axis).tolist() == [free, free, free, occupied, unknown, unknown]
    assert mapper.map.frames == 8


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_nothing_clears_through_pixels_without_a_value(integrator):
    """ROG-Map#18: a wall too near for the camera must not be erased by the frames that cannot see it."""
    mapper = sv.Mapper("default", voxel_size=0.1, integrator=integrator)
    for _ in range(8):
        mapper.add(wall_frame(1.0))
    before = mapper.map.occupied()
    frame = wall_frame(4.5)
    depth = frame.depth.copy()
    depth[:, 3:] = 0  # only a sliver still has a value
    blind = sv.Frame(depth, frame.camera, frame.T_world_sensor)
    for _ in range(20):
        mapper.add(blind)
    left = {tuple(p) for p in mapper.map.occupied().round(3)}
    centre = [p for p in before if abs(p[1]) < 0.3]
    assert len(centre) > 10
    assert all(tuple(np.round(p, 3)) in left for p in centre)


def too_near_wall(nothing, far, source_reason=None, integrator="projective"):
    """Return which cells of a wall at 1 m stay occupied where the camera, too near to it, then writes `nothing`.

    A sliver of the image still has a value behind the wall, so that frames are not refused; nor does the gate ask
    whether they agree with the map.
    """
    settings = {"depth.far": far, "trust.max_disagreement": 1}
    mapper = sv.Mapper("default", voxel_size=0.1, integrator=integrator, **settings)
    for _ in range(8):
        mapper.add(wall_frame(1.0))
    before = mapper.map.occupied()
    before = before[np.abs(before[:, 1]) < 0.3]
    assert len(before) > 10
    depth = np.full((60, 80), nothing, np.float32)
    depth[:, :3] = 4.5
    said = None if source_reason is None else np.where(depth == 4.5, 0, source_reason).astype(np.uint8)
    blind = wall_frame()
    blind = sv.Frame(depth, blind.camera, blind.T_world_sensor, reason=said)
    for _ in range(30):
        assert mapper.add(blind).refused is None
    return mapper.map.state(before) == sv.State.OCCUPIED


@pytest.mark.parametrize("integrator", ["projective", "ray"])
@pytest.mark.parametrize("nothing", [np.inf, -np.inf, np.nan, 0.0])
def test_infinite_depth_at_a_wall_that_is_too_near_leaves_it_standing(integrator, nothing):
    """ROG-Map#18: cameras that write +inf (REP 117: too far) for what is too near or unmatched."""
    assert too_near_wall(nothing, "reported", integrator=integrator).all()
    assert too_near_wall(nothing, "measured", integrator=integrator).all()


def test_only_who_trusts_infinity_loses_the_wall_to_it():
    assert not too_near_wall(np.inf, "infinite").any()
    assert too_near_wall(-np.inf, "infinite").all()


def test_the_sources_word_for_too_far_clears_unless_only_what_is_measured_counts():
    assert not too_near_wall(0.0, "reported", source_reason=sv.Reason.TOO_FAR).any()
    assert too_near_wall(0.0, "measured", source_reason=sv.Reason.TOO_FAR).all()
    for reason in set(sv.Reason) - {sv.Reason.VALID, sv.Reason.TOO_FAR}:
        assert too_near_wall(0.0, "infinite", source_reason=reason).all()


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_too_far_clears_up_to_the_maximum_range_and_no_further(integrator):
    mapper = sv.Mapper("default", voxel_size=0.1, integrator=integrator, max_range=3.0)
    for _ in range(5):
        assert mapper.add(wall_frame(50.0)).refused is None
    x = np.arange(0.55, 4.0, 0.1)
    states = mapper.map.state(np.stack([x, 0 * x + 0.02, 0 * x + 0.01], axis=1))
    assert (states[x < 2.9] == sv.State.FREE).all()
    assert (states[x > 3.1] == sv.State.UNKNOWN).all()
    assert len(mapper.map.occupied()) == 0


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_a_refused_frame_changes_nothing(integrator):
    mapper = sv.Mapper("default", voxel_size=0.1, max_range=2.5, integrator=integrator)
    image = made_image(0)
    mapper.add(frame_of(image))
    before = [array.copy() for array in mapper.map.storage.blocks()]
    bad_pose = image.T_world_sensor.copy()
    bad_pose[1, 3] = np.nan
    for bad in (
        frame_of(image, T_world_sensor=bad_pose),
        frame_of(image, depth=np.zeros((3, 3), np.uint16)),
        frame_of(image, depth=np.full(image.depth_m.shape, np.nan)),
        frame_of(image, fault="unreadable"),
    ):
        report = mapper.add(bad)
        assert report.refused
        assert report.detail
        assert report.cells == 0
    after = mapper.map.storage.blocks()
    assert all((a == b).all() for a, b in zip(before, after, strict=True))
    assert mapper.map.frames == 1
    report = mapper.add(frame_of(image))
    assert report.refused is None
    assert report.match_ms == 0  # only pairs are matched


@pytest.mark.parametrize("integrator", ["projective", "ray"])
def test_thread_count_and_a_stop_between_change_no_bit(integrator, tmp_path):
    frames = [frame_of(made_image(seed)) for seed in range(6)]
    settings = {"voxel_size": 0.05, "max_range": 2.5, "integrator": integrator}
    maps = []
    for threads in (1, 2):
        mapper = sv.Mapper("default", threads=threads, **settings)
        for frame in frames:
            mapper.add(frame)
        maps.append(mapper.map)
    halfway = sv.Mapper("default", **settings)
    for frame in frames[:3]:
        halfway.add(frame)
    halfway.map.save(tmp_path / "half.svox")
    resumed = sv.Mapper("default", resume=sv.load_map(tmp_path / "half.svox"), **settings)
    for frame in frames[3:]:
        resumed.add(frame)
    for other in (maps[1], resumed.map):
        assert all((a == b).all() for a, b in zip(maps[0].storage.blocks(), other.storage.blocks(), strict=True))


def test_ctrl_c_does_not_cut_a_frame_in_half(obeys_signals):
    mapper = sv.Mapper("default", voxel_size=0.1, **{"map.keep_frames": True})
    mapper.map.listeners.append(lambda evidence: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        mapper.add(wall_frame())
    assert (mapper.map.frames, len(mapper.map.kept_frames)) == (1, 1)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_resuming_with_another_voxel_size_is_refused():
    with pytest.raises(sv.StereovoxError, match=r"0\.1"):
        sv.Mapper("default", voxel_size=0.05, resume=sv.Mapper("default", voxel_size=0.1).map)


def test_a_user_writes_a_sensor_model_in_plain_numpy(monkeypatch):
    """What extending.md promises: a dataclass with one NumPy function, found by its name."""
    import sys
    import types
    from dataclasses import dataclass

    from stereovox.sensors import SENSORS

    @dataclass(frozen=True)
    class Careful:
        p_free: float = 0.45
        p_unknown: float = 0.5

        def probability(self, z, z_measured, sigma):
            return np.where(z < z_measured, self.p_free, np.where(z > z_measured, 0.5, 0.6))

    module = types.ModuleType("careful_sensor")
    module.Careful = Careful
    monkeypatch.setitem(sys.modules, "careful_sensor", module)
    monkeypatch.setitem(SENSORS, "careful", "careful_sensor:Careful")
    mapper = sv.Mapper("default", voxel_size=0.1, **{"sensor.model": "careful"})
    mapper.add(wall_frame())
    said = np.array([0.6, 0.45])
    with_prior = 0.1 * said / (0.1 * said + 0.9 * (1 - said))  # Bayes, with `map.prior` of the default profile
    assert mapper.map.probability([[2.05, 0.02, 0.01], [1.0, 0.02, 0.01]]) == pytest.approx(with_prior, abs=1e-3)


def test_cameras_may_change_between_frames():
    mapper = sv.Mapper("default", voxel_size=0.1)
    small = sv.PinholeCamera(8, 6, 6.0, 6.0, 3.5, 2.5, 0.05)
    mapper.add(wall_frame())
    wall = wall_frame()
    mapper.add(sv.Frame(np.full((6, 8), 2.0, np.float32), small, wall.T_world_sensor))
    mapper.add(wall)
    same = sv.Mapper("default", voxel_size=0.1)
    for camera_frame in (wall, sv.Frame(np.full((6, 8), 2.0, np.float32), small, wall.T_world_sensor), wall):
        same.add(camera_frame)
    assert all((a == b).all() for a, b in zip(mapper.map.storage.blocks(), same.map.storage.blocks(), strict=True))


def test_a_frame_that_does_not_fit_into_the_memory_is_refused_and_changes_nothing():
    mapper, frame = sv.Mapper(max_memory="40 kB", voxel_size=0.1), wall_frame()
    assert mapper.add(frame).refused is None
    before, viewpoint = mapper.map.storage.blocks(), mapper.map.viewpoint
    behind = replace(frame, T_world_sensor=np.diag([-1.0, -1, 1, 1]) @ frame.T_world_sensor, sensor="behind")
    report = mapper.add(behind)
    assert report.refused == "memory_full"
    assert "max_memory 40 kB holds" in report.detail
    assert mapper.map.viewpoint is viewpoint
    assert all((a == b).all() for a, b in zip(mapper.map.storage.blocks(), before, strict=True))
