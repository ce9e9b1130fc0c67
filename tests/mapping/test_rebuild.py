# SPDX-License-Identifier: Apache-2.0
"""A map with corrected poses is bit for bit the map of a new run with its frames at these poses."""

import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_clouds import room_cloud
from made_threads import frames_of

import stereovox as sv
from stereovox.errors import FrameRefused, MapFileError, StereovoxError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.mapping.rebuild import Rebuild
from stereovox.maps.record.kept_frames import KeptFrames
from stereovox.products.distance import DistanceField
from stereovox.products.projection import LiveProjection, project

KITCHEN = Path(__file__).resolve().parents[3] / "shared/data/sevenscenes_redkitchen"
TRUSTING = {"trust.max_disagreement": 1, "trust.max_speed_mps": 1e6, "trust.max_turn_dps": 1e9, "trust.frozen": False}
"""A new run must not refuse what the corrected one took in."""
KEEP = {"voxel_size": 0.1, "map.keep_frames": True, **TRUSTING}
WINDOW = {"window.size": [4, 4, 3], "window.trigger": 0.3}
TIMES = {"map.keep_times": True, "map.forget_s": 1.0}
MAPS = {
    "plain": {},
    "int8": {"map.cell": "int8"},
    "uint8": {"map.cell": "uint8", "map.confirm_hits": 2},
    "times": TIMES,
    "window": WINDOW,
    "fixed box": {"window.size": [4, 4, 3], "window.centre": [0, 0, 1]},
    "tiles": {**WINDOW, "window.outside": "keep"},
    "tiles and times": {**WINDOW, **TIMES, "window.outside": "keep"},
    "flight": {**WINDOW, "window.lead_s": 0.5, "window.grow_s": 0.5, "window.largest": [6, 6, 4]},
    "capped": {"max_memory": "64M"},
    "two threads": {"threads": 2},
    "ray": {"integrator": "ray"},
    "sphere": {"sphere.step_deg": 1.5},
    "coarse pixels": {"depth.downsample": 2},
}


def made_frames(cameras=1, each=24, apart=0.0):
    """Frames of cameras that walk past things, in order of time; some are refused."""
    frames = [frame for n in range(cameras) for frame in frames_of(n, each)]
    for n, frame in enumerate(frames):
        frame.T_world_sensor[1, 3] += apart * (n // each)
    return sorted(frames, key=lambda frame: frame.stamp_ns)


def small_room():
    return list(sv.open_source("sim:room", frames=":40:4"))


def mapped(frames, tiles=None, **settings):
    mapper = sv.Mapper("default", tiles=tiles, **{**KEEP, **settings})
    for frame in frames:
        assert mapper.add(frame).refused in (None, "unreadable")
    return mapper


def shaken(frames, seed, share, metres=0.15, radians=0.03):
    """Return the frames with a random correction of some poses, and the new poses by stamp."""
    random = np.random.default_rng(seed)
    moved, poses = [], {}
    for frame in frames:
        if not frame.fault and random.random() < share:
            T = np.eye(4)
            T[:3, :3] = rotation_matrix(random.normal(0, radians, 3))
            T[:3, 3] = random.normal(0, metres, 3)
            poses[frame.stamp_ns] = T @ frame.T_world_sensor
            frame = replace(frame, T_world_sensor=poses[frame.stamp_ns])
        moved.append(frame)
    return moved, poses


def differing(a, b):
    """Return the number of cells of two maps that differ, also in the time of their last evidence."""
    (these, cells), (those, others) = a.storage.blocks(), b.storage.blocks()
    assert np.array_equal(these, those)
    number = np.count_nonzero(cells != others)
    if a.config.map.keep_times:
        known = cells != a.storage.cell_format.unknown
        number += np.count_nonzero((a.storage.times_of(these) != b.storage.times_of(those))[known])
        assert a.storage.times_start_ns == b.storage.times_start_ns
    return number


def come_meanwhile(monkeypatch, mapper, frames):
    """Let frames arrive while poses are corrected, once others have been mapped again."""
    catch_up, coming = Rebuild.catch_up, [frames]

    def meanwhile(self):
        catch_up(self)
        for frame in coming.pop() if coming else ():
            mapper.add(frame)

    monkeypatch.setattr(Rebuild, "catch_up", meanwhile)


def is_as_new(corrected, frames, **settings):
    new = mapped(frames, **settings)
    assert sum(new.map.counts().values()) > 1000
    assert differing(corrected.map, new.map) == 0
    assert corrected.map.history.path == new.map.history.path
    assert corrected.map.history.trusted == new.map.history.trusted
    before, now = corrected.map.viewpoint, new.map.viewpoint
    assert np.array_equal(before.T_world_camera, now.T_world_camera)
    assert (before.camera, before.stamp_ns) == (now.camera, now.stamp_ns)
    assert corrected.map.storage.window_state == new.map.storage.window_state
    new.close()
    return True


@pytest.mark.parametrize("kind", MAPS)
@pytest.mark.parametrize(("seed", "share"), [(0, 0.1), (1, 0.2), (2, 1.0)])
def test_corrected_is_as_new(kind, seed, share):
    frames = made_frames()
    mapper = mapped(frames, **MAPS[kind])
    moved, poses = shaken(frames, seed, share)
    report = mapper.correct(poses)
    assert report.moved == len(poses) > 0
    assert report.ignored == 0
    assert report.all_frames
    assert is_as_new(mapper, moved, **MAPS[kind])
    mapper.close()


def made_clouds():
    """Clouds of all kinds, and depth images of a camera, in order of time."""
    clouds = [
        replace(room_cloud(n, 3000), stamp_ns=10**8 * n + 7, sensor="lidar", name=f"cloud {n}") for n in range(12)
    ]
    for n in range(0, 12, 3):
        shifts = np.linspace(0, 0.1, 3000)[:, None] * [1, 0, 0]
        clouds[n] = replace(clouds[n], points=clouds[n].points.astype(float) + shifts, origins=shifts)
        clouds[n + 1] = replace(clouds[n + 1], clear=np.float32([[2, 0, 0], [0, 1, 0.5]]), lidar=sv.Lidar(range_max=4))
    return sorted([*clouds, *frames_of(0, 12)], key=lambda frame: frame.stamp_ns)


@pytest.mark.parametrize("kind", ["plain", "int8", "times", "window", "tiles and times", "capped", "two threads"])
def test_a_map_of_clouds_that_was_saved_is_corrected_as_new(kind, tmp_path):
    frames, settings = made_clouds(), {**MAPS[kind], "voxel_size": 0.2}
    first = mapped(frames, **settings)
    first.save(tmp_path / "m.svox")
    first.close()
    again = sv.load_map(tmp_path / "m.svox")
    kept = {one.stamp_ns: one.frame() for one in again.kept_frames.frames}
    for cloud in (frame for frame in frames if isinstance(frame, sv.Cloud)):
        for field in ("points", "origins", "clear"):
            given, found = getattr(cloud, field), getattr(kept[cloud.stamp_ns], field)
            assert (given is None) == (found is None)
            assert given is None or np.array_equal(given, found)
        assert kept[cloud.stamp_ns].lidar == cloud.lidar
    mapper = sv.Mapper(again.config, resume=again, tiles=None)
    moved, poses = shaken(frames, 3, 0.3)
    assert mapper.correct(poses).moved == len(poses) > 2
    assert is_as_new(mapper, moved, **settings)
    mapper.close()


def test_a_lidar_of_numpy_numbers_is_saved_with_its_clouds(tmp_path):
    lidar = sv.Lidar(sigma=np.float32(0.03), range_max=np.float32(30))
    mapped([replace(room_cloud(0, 3000), lidar=lidar)], voxel_size=0.2).save(tmp_path / "m.svox")
    assert sv.load_map(tmp_path / "m.svox").kept_frames.frames[0].camera == lidar


def test_loops_of_clouds_are_not_sought_and_that_is_said(tmp_path):
    mapped(made_clouds(), voxel_size=0.2).save(tmp_path / "m.svox")
    with pytest.raises(StereovoxError, match=r"cloud 0: loops are searched in depth images.*stereovox remap"):
        sv.close_loops(tmp_path / "m.svox", tmp_path / "closed.svox")


@pytest.mark.parametrize("seed", range(20))
def test_twenty_random_corrections_one_after_the_other_in_a_room(seed, room):
    frames, mapper, _ = room
    moved, poses = shaken(frames, seed, share=(0.1, 0.3, 1.0)[seed % 3])
    mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in frames} | poses)
    assert is_as_new(mapper, moved, voxel_size=0.2)


@pytest.fixture(scope="module")
def room():
    frames = small_room()
    mapper = mapped(frames, voxel_size=0.2)
    return frames, mapper, mapper.map.snapshot()


def test_correcting_back_gives_the_first_map(room):
    frames, mapper, before = room
    mapper.correct(shaken(frames, 5, 1.0)[1])
    assert (mapper.map.storage.blocks()[0].shape != before.storage.blocks()[0].shape) or differing(mapper.map, before)
    mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in frames})
    assert differing(mapper.map, before) == 0


@pytest.mark.parametrize("kind", ["plain", "int8", "uint8", "times", "two threads", "ray", "sphere", "coarse pixels"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_only_what_moved_frames_see_is_made_anew(kind, seed):
    """Cameras at one of three places move: the cells seen by the others stay as they are."""
    frames = made_frames(cameras=3, each=16, apart=30.0)
    mapper, heard = mapped(frames, **MAPS[kind]), []
    mapper.map.listeners.append(heard.append)
    some = [frame for frame in frames if frame.sensor == "camera 1"]
    moved, poses = shaken(some, seed, 0.3)
    report = mapper.correct(poses)
    assert 0 < report.moved == len(poses) < report.mapped <= len(some)
    assert len(heard[0].uniform) == report.blocks
    assert (np.abs(0.8 * heard[0].uniform[:, 1] - 30) < 15).all()
    others = {frame.stamp_ns: frame for frame in moved}
    assert is_as_new(mapper, [others.get(frame.stamp_ns, frame) for frame in frames], **MAPS[kind])


@pytest.mark.parametrize("kind", ["plain", "int8", "times", "tiles and times", "window"])
def test_it_goes_on_as_the_new_run_does(kind):
    """Frames after the correction meet the same cells, window and gate as in a run that had these poses."""
    frames = made_frames()
    mapper = mapped(frames[:16], **MAPS[kind])
    moved, poses = shaken(frames[:16], 7, 0.5)
    mapper.correct(poses)
    for frame in frames[16:]:
        mapper.add(frame)
    assert is_as_new(mapper, [*moved, *frames[16:]], **MAPS[kind])
    mapper.close()


@pytest.mark.parametrize("kind", ["plain", "times", "tiles"])
def test_a_saved_map_is_corrected_as_well(kind, tmp_path):
    frames = made_frames()
    first = mapped(frames, **MAPS[kind])
    first.save(tmp_path / "m")
    first.close()
    for seed in (1, 2):
        saved = sv.load_map(tmp_path / "m")
        mapper = sv.Mapper(saved.config, resume=saved)
        moved, poses = shaken(frames, seed, 0.3)
        mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in frames if not frame.fault} | poses)
        assert is_as_new(mapper, moved, **MAPS[kind])
        mapper.save(tmp_path / "m")
        mapper.close()
    assert differing(sv.load_map(tmp_path / "m"), mapped(moved, **MAPS[kind]).map.snapshot()) == 0 or kind == "tiles"


def test_tiles_on_disk_change_places_and_are_removed(tmp_path):
    frames, tiles = made_frames(), tmp_path / "tiles"
    mapper = mapped(frames, tiles=tiles, **MAPS["tiles"])
    for seed in range(3):
        moved, poses = shaken(frames, seed, 1.0)
        mapper.correct(poses)
        assert is_as_new(mapper, moved, **MAPS["tiles"])
        assert len(list(tmp_path.iterdir())) == 1
    mapper.close()
    assert not list(tmp_path.iterdir())


def test_frames_of_reduced_quality_keep_it():
    frames = made_frames()
    mapper = sv.Mapper("default", **{**KEEP, "deadline_ms": 1e9})
    scheduler = mapper._deadline._scheduler
    for n, frame in enumerate(frames):
        scheduler.level = n % 3
        mapper.add(frame)
    assert {frame.quality for frame in mapper.map.kept_frames.frames} == {"full", "near", "coarse"}
    before = mapper.map.snapshot()
    mapper.correct(shaken(frames, 0, 1.0)[1])
    mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in frames})
    assert differing(mapper.map, before) == 0


def test_with_a_budget_the_map_is_that_of_the_kept_frames():
    frames = made_frames()
    mapper = mapped(frames, **{"map.frames_budget": "40 kB"})
    kept = mapper.map.kept_frames
    stamps = {frame.stamp_ns for frame in kept.frames}
    assert kept.bytes <= 40_000
    assert 2 < len(stamps) < mapper.map.frames
    moved, poses = shaken(frames, 0, 1.0)
    report = mapper.correct(poses)
    assert not report.all_frames
    assert report.moved == len(stamps)
    assert report.ignored == len(poses) - len(stamps)
    new = mapped([frame for frame in moved if frame.stamp_ns in stamps])
    assert differing(mapper.map, new.map) == 0


def test_the_gate_compares_with_the_corrected_poses():
    frames = [frame for frame in made_frames(each=12) if not frame.fault]
    far = np.eye(4)
    far[0, 3] = 30.0
    settings = {"trust.max_speed_mps": 40.0, "trust.max_turn_dps": 1500.0}
    mapper = mapped(frames[:8], **settings)
    there = [replace(frame, T_world_sensor=far @ frame.T_world_sensor) for frame in frames]
    assert mapper.add(there[8]).refused == "pose_jump"
    mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in there[:8]})
    assert mapper.add(there[9]).refused is None
    assert mapper.add(frames[10]).refused == "pose_jump"


def test_listeners_hear_what_changed():
    frames = made_frames()
    mapper = mapped(frames)
    live = LiveProjection(mapper.map, (0.0, 1.0), floor=0.0)
    live.grid()
    before = dict(zip(map(tuple, mapper.map.storage.blocks()[0].tolist()), mapper.map.storage.blocks()[1], strict=True))
    heard = []
    mapper.map.listeners.append(heard.append)
    mapper.correct(shaken(frames, 0, 0.1)[1])
    after = dict(zip(map(tuple, mapper.map.storage.blocks()[0].tolist()), mapper.map.storage.blocks()[1], strict=True))
    changed = {b for b in before.keys() | after if not np.array_equal(before.get(b), after.get(b))}
    (evidence,) = heard
    assert changed
    assert changed <= set(map(tuple, evidence.uniform.tolist()))
    assert not evidence.uniform_values.any()
    grid, new = live.grid(), project(mapper.map, (0.0, 1.0), floor=0.0)
    row, column = (round((a - b) / 0.1) for a, b in zip(new.origin[1::-1], grid.origin[1::-1], strict=True))
    shown = grid.cells[row : row + new.cells.shape[0], column : column + new.cells.shape[1]]
    assert np.array_equal(shown, new.cells)
    assert np.count_nonzero(grid.cells != -1) == np.count_nonzero(new.cells != -1)


def test_nothing_is_shown_any_longer_where_nothing_was_seen():
    """If all frames move far, blocks vanish."""
    frames = made_frames()
    mapper = mapped(frames)
    live = LiveProjection(mapper.map, (0.0, 1.0), floor=0.0)
    live.grid()
    far = np.eye(4)
    far[:3, 3] = 3.0, 1.0, 0.0
    mapper.correct({f.stamp_ns: far @ f.T_world_sensor for f in frames})
    grid, new = live.grid(), project(mapper.map, (0.0, 1.0), floor=0.0)
    assert np.count_nonzero(grid.cells != -1) == np.count_nonzero(new.cells != -1) > 100


@pytest.mark.parametrize("metres", [0.15, 2.0])
def test_a_distance_field_follows(metres):
    frames = made_frames()
    mapper = mapped(frames)
    field = DistanceField(mapper.map, [-1, -2, -1], [3, 2, 1])
    moved, poses = shaken(frames, 0, 0.1 if metres < 1 else 1.0, metres)
    mapper.correct(poses)
    assert field.update() > 0
    new = DistanceField(mapped(moved).map, [-1, -2, -1], [3, 2, 1])
    assert np.array_equal(field.metres, new.metres)


@pytest.mark.parametrize("kind", ["plain", "tiles"])
def test_frames_may_come_while_poses_are_corrected(kind):
    frames = made_frames(each=60)
    mapper = mapped(frames[:40], **MAPS[kind])
    moved, poses = shaken(frames[:40], 0, 0.2)
    reports = []
    adding = threading.Thread(target=lambda: reports.extend(mapper.add(frame) for frame in frames[40:]))
    adding.start()
    mapper.correct(poses)
    adding.join()
    assert len(reports) == 20
    assert is_as_new(mapper, [*moved, *frames[40:]], **MAPS[kind])
    mapper.close()


@pytest.mark.parametrize("share", [0.2, 1.0])
def test_ctrl_c_while_the_result_is_put_in_place_leaves_it_whole(monkeypatch, obeys_signals, share):
    frames = made_frames()
    mapper = mapped(frames)
    moved, poses = shaken(frames, 0, share)
    replace_frames = KeptFrames.replace

    def interrupted(self, frames):
        signal.raise_signal(signal.SIGINT)
        replace_frames(self, frames)

    monkeypatch.setattr(KeptFrames, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        mapper.correct(poses)
    assert is_as_new(mapper, moved)


def test_frames_that_are_dropped_meanwhile_start_it_anew(monkeypatch):
    """With a budget, new frames may displace others that were mapped again already."""
    frames = [frame for frame in made_frames(each=40) if not frame.fault]
    mapper = mapped(frames[:6], **{"map.frames_budget": "40 kB"})
    come_meanwhile(monkeypatch, mapper, frames[6:])
    moved, poses = shaken(frames[:6], 0, 1.0)
    mapper.correct(poses)
    stamps = {frame.stamp_ns for frame in mapper.map.kept_frames.frames}
    assert len(stamps) < len(frames)
    new = mapped([frame for frame in [*moved, *frames[6:]] if frame.stamp_ns in stamps])
    assert differing(mapper.map, new.map) == 0


def test_frames_that_cannot_be_kept_meanwhile_start_it_anew(monkeypatch):
    """A part rebuilt without a new frame that was not kept would be made of other frames than the rest."""
    frames = [frame for frame in made_frames(cameras=3, each=20, apart=30.0) if not frame.fault]
    mapper = mapped(frames[:30])
    mapper.map.kept_frames.spacing = 1e3  # as after many more frames
    come_meanwhile(monkeypatch, mapper, frames[30:])
    frame = frames[4]
    T = frame.T_world_sensor.copy()
    T[2, 3] += 0.1
    assert not mapper.correct({frame.stamp_ns: T}).all_frames
    moved = [replace(one, T_world_sensor=T) if one is frame else one for one in frames[:30]]
    assert differing(mapper.map, mapped(moved).map) == 0


def test_nothing_to_do_does_nothing():
    frames = made_frames()
    mapper = mapped(frames)
    heard = []
    mapper.map.listeners.append(heard.append)
    report = mapper.correct({frame.stamp_ns: frame.T_world_sensor for frame in frames})
    assert (report.moved, report.mapped, report.blocks) == (0, 0, 0)
    assert report.ignored == sum(frame.fault is not None for frame in frames)
    assert not heard


def refused(mapper, poses, error=StereovoxError):
    before = mapper.map.snapshot()
    with pytest.raises(error) as caught:
        mapper.correct(poses)
    assert differing(mapper.map, before) == 0
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_what_cannot_be_is_refused_in_one_line_and_changes_nothing(tmp_path):
    frames = made_frames(cameras=2, each=6)
    plain = mapped(frames, **{"map.keep_frames": False})
    assert "map.keep_frames" in refused(plain, {frames[0].stamp_ns: np.eye(4)})
    mapper = mapped(frames)
    assert "none of the 1 poses" in refused(mapper, {17: np.eye(4)})
    assert "not a rigid" in refused(mapper, {frames[0].stamp_ns: 2 * np.eye(4)}, FrameRefused)
    assert "NaN" in refused(mapper, {frames[0].stamp_ns: np.full((4, 4), np.nan)}, FrameRefused)
    assert "no pose" in refused(mapper, {frames[0].stamp_ns: None}, FrameRefused)
    with mapper.map.lock:
        assert "lock" in refused(mapper, {frames[0].stamp_ns: np.eye(4)})


def test_stamps_of_several_sensors_need_their_name():
    frames = [replace(frame, stamp_ns=frame.stamp_ns // 10**6 * 10**6) for frame in made_frames(cameras=2, each=5)]
    mapper = mapped(frames)
    frame = frames[2]
    T = frame.T_world_sensor.copy()
    T[0, 3] += 0.1
    assert "name them (sensor, stamp)" in refused(mapper, {frame.stamp_ns: T})
    assert "name them (sensor, stamp)" in refused(mapper, {np.int64(frame.stamp_ns): T})
    assert mapper.correct({(frame.sensor, frame.stamp_ns): T}).moved == 1
    moved = [replace(f, T_world_sensor=T) if f is frame else f for f in frames]
    assert is_as_new(mapper, moved)
    repeated = mapped([frames[0], frames[2], replace(frames[2])], **{"trust.ordered": False})
    assert "such a map cannot be corrected" in refused(repeated, {(frame.sensor, frame.stamp_ns): T})
    assert f"('{frame.sensor}'); such a map cannot be corrected" in refused(repeated, {frame.stamp_ns: T})


def test_a_corrected_map_that_needs_too_much_memory_is_refused():
    frames = [frame for frame in made_frames(each=8) if not frame.fault]
    mapper = mapped(frames, max_memory="300 kB")
    apart = {}
    for n, frame in enumerate(frames):
        T = frame.T_world_sensor.copy()
        T[1, 3] += 20 * n
        apart[frame.stamp_ns] = T
    assert "max_memory" in refused(mapper, apart)


def test_frames_gone_from_the_disk_are_told_of(tmp_path):
    frames = made_frames(each=4)
    mapped(frames).save(tmp_path / "m")
    saved = sv.load_map(tmp_path / "m")
    for file in (tmp_path / "m").glob("frames-*"):
        file.unlink()
    mapper = sv.Mapper(saved.config, resume=saved)
    assert "reload it" in refused(mapper, shaken(frames, 0, 1.0)[1], MapFileError)


@pytest.mark.skipif(not KITCHEN.is_dir(), reason="the 7-Scenes kitchen is not here")
@pytest.mark.parametrize(("seed", "share", "settings"), [(0, 0.1, {}), (1, 1.0, {}), (2, 0.5, MAPS["window"])])
def test_in_a_real_kitchen(seed, share, settings):
    frames = list(sv.open_source(KITCHEN, frames="::10"))
    mapper = mapped(frames, **settings)
    moved, poses = shaken(frames, seed, share)
    mapper.correct(poses)
    assert is_as_new(mapper, moved, **settings)


def test_a_frame_with_two_poses_is_refused():
    frames = [frame for frame in made_frames(each=4) if not frame.fault]
    mapper = mapped(frames)
    one, other = frames[1].T_world_sensor.copy(), frames[1].T_world_sensor.copy()
    one[0, 3], other[0, 3] = one[0, 3] + 0.1, other[0, 3] + 0.5
    key = frames[1].sensor, frames[1].stamp_ns
    assert "two poses" in refused(mapper, {frames[1].stamp_ns: one, key: other})
    assert "two poses" in refused(mapper, {key: other, frames[1].stamp_ns: one})


def test_a_map_counts_as_corrected_before_its_listeners_hear_of_it():
    """Otherwise a checkpoint of another thread, or a listener that fails, leaves a map that could be continued."""
    frames = [frame for frame in made_frames(each=4) if not frame.fault]
    mapper = mapped(frames)
    mapper.map.recording = "walk"

    def fail(evidence):
        raise KeyboardInterrupt

    mapper.map.listeners.append(fail)
    with pytest.raises(KeyboardInterrupt):
        mapper.correct(shaken(frames, 0, 1.0)[1])
    assert mapper.map.recording == "walk, poses corrected"
