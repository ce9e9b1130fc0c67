# SPDX-License-Identifier: Apache-2.0
"""Maps made by many workers are those of one machine, bit for bit, however they are cut, killed and gone on with."""

import errno
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import numpy as np
import pytest
from made_clouds import room_cloud
from made_fleet import SETTINGS, alone, assert_same, recording

import stereovox as sv
from stereovox.errors import ConfigError, MapFileError, StereovoxError
from stereovox.files.places import Place
from stereovox.fleet import Recording, boxes, cluster, fleet, map_fleet, plan_fleet, recordings, recordings_of
from stereovox.fleet.recordings import boxes_with, fingerprint, local
from stereovox.mapping.deadline import Levels
from stereovox.maps.cells import pyramid
from stereovox.maps.cells.evidence import Evidence
from stereovox.maps.storage.boxes import BoxLayout
from stereovox.sources.poses.trajectory import write_trajectory

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def scheduler():
    """Return the address of a cluster of two workers in this process, which start at once."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, dashboard_address="127.0.0.1:0", silence_logs=50
    ) as cluster:
        yield cluster.scheduler_address


@pytest.fixture
def mapped(scheduler):
    """Return `map_fleet` on that cluster, with boxes of 6.4 m."""
    return partial(map_fleet, **SETTINGS, box_m=6.4, scheduler=scheduler)


def of_all(*recordings, **settings):
    """Return the blocks of one map of the frames that each recording's own mapper trusts, one after the other."""
    config = sv.load_config("default", voxel_size=0.2, **settings)
    storage, level = sv.VoxelMap(config).storage, Levels(config)("full")
    for one in recordings:
        for frame in (alone(one, **settings) if isinstance(one, str) else one).kept_frames.frames:
            image = level.prepare(frame.frame()).image
            storage.set_viewpoint(image.viewpoint)
            storage.add(level.integrator.evidence(image))
            storage.history.frames += 1
    return storage.blocks()


def test_one_recording_makes_the_map_of_one_mapper(mapped, where):
    made, own = mapped([recording(1)], where), alone(recording(1))
    assert made.boxes[0] > 3
    assert_same(made.map.storage.blocks(), own.storage.blocks())
    assert made.map.counts() == own.counts()
    assert (made.map.frames, made.map.frames_refused) == (own.frames, own.frames_refused)
    assert made.summary()["recordings"][0]["frames"] == own.frames
    assert sv.load_map(where).overview().counts() == own.counts()


def test_frames_that_are_taken_back_are_in_no_box(mapped, tmp_path):
    """The fourth frame contradicts the three before it, and the map begins anew."""
    jumping = recording(1, step=140)
    own = alone(jumping)
    assert own.frames == 3
    assert_same(mapped([jumping], tmp_path / "m.svox").map.storage.blocks(), own.storage.blocks())


def test_clouds_and_depth_images_of_several_machines_make_one_map(mapped, tmp_path):
    clouds = [room_cloud(n, 3000) for n in range(8)]
    (tmp_path / "lidar" / "velodyne").mkdir(parents=True)
    for cloud in clouds:
        numbers = np.column_stack([cloud.points, np.zeros(len(cloud.points))]).astype(np.float32)
        numbers.tofile(tmp_path / "lidar" / "velodyne" / f"{cloud.stamp_ns / 1e9:.9f}.bin")
    poses = np.array([cloud.T_world_sensor for cloud in clouds])
    write_trajectory(tmp_path / "lidar" / "poses.tum", [cloud.stamp_ns for cloud in clouds], poses, "lidar")
    both = recording(1), str(tmp_path / "lidar")
    assert alone(both[1]).frames == len(clouds)
    assert_same(mapped(both, tmp_path / "m.svox").map.storage.blocks(), of_all(*both))


@pytest.mark.parametrize("box_m", [4.8, 12.8])  # killed workers map boxes of 3.2 m
def test_the_map_does_not_depend_on_the_boxes(mapped, tmp_path, box_m):
    made = mapped([recording(1), recording(2)], tmp_path / "m.svox", box_m=box_m)
    assert_same(made.map.storage.blocks(), of_all(recording(1), recording(2)))
    other = mapped([recording(2), recording(1)], tmp_path / "n.svox", box_m=box_m)
    assert_same(other.map.storage.blocks(), of_all(recording(2), recording(1)))


@pytest.mark.parametrize("settings", [{"map.cell": "int8"}, {"map.keep_times": True}], ids=str)
def test_other_cells_and_times(mapped, tmp_path, settings):
    made = mapped([recording(1), recording(2)], tmp_path / "m.svox", **settings)
    assert_same(made.map.storage.blocks(), of_all(recording(1), recording(2), **settings))
    if "map.keep_times" in settings:
        one = mapped([recording(1)], tmp_path / "n.svox", **settings).map.storage
        coords, cells = one.blocks()
        known = cells != one.cell_format.unknown
        assert_same([one.times_of(coords)[known]], [alone(recording(1), **settings).storage.times_of(coords)[known]])


def test_recordings_are_added_and_taken_away(mapped, tmp_path):
    where = tmp_path / "m.svox"
    first = mapped([recording(1)], where)
    both = mapped([recording(1), recording(2)], where, resume=True)
    assert_same(both.map.storage.blocks(), of_all(recording(1), recording(2)))
    again = mapped([recording(1), recording(2)], where, resume=True)
    assert again.boxes == (both.boxes[0], 0)
    less = mapped([recording(1)], where, resume=True)
    assert_same(less.map.storage.blocks(), first.map.storage.blocks())
    names = Place.of(where).names("recordings/")
    assert len({name.split("/")[1] for name in names}) == 1


def test_far_away_recordings_leave_other_boxes_alone(mapped, tmp_path):
    """A second recording 100 m away: none of the boxes of the first one is mapped again."""
    frames = list(sv.open_source(recording(2)))
    far = np.array([frame.T_world_sensor for frame in frames])
    far[:, 0, 3] += 100
    write_trajectory(tmp_path / "far.tum", [frame.stamp_ns for frame in frames], far, "camera")
    there = Recording(recording(2), str(tmp_path / "far.tum"))
    first = mapped([recording(1)], tmp_path / "m.svox")
    both = mapped([recording(1), there], tmp_path / "m.svox", resume=True)
    assert both.boxes[1] == both.boxes[0] - first.boxes[0] > 0


def test_corrected_poses_make_the_map_of_remap(mapped, tmp_path):
    mapped([recording(1), recording(2)], tmp_path / "m.svox")
    poses = np.array([frame.T_world_sensor for frame in sv.open_source(recording(2))])
    poses[:, 0, 3] += 0.3
    write_trajectory(tmp_path / "new.tum", [frame.stamp_ns for frame in sv.open_source(recording(2))], poses, "camera")
    (tmp_path / "list.txt").write_text(f"'{recording(1)}'\n# moved\n'{recording(2)}' {tmp_path / 'new.tum'}\n")
    made = mapped([f"@{tmp_path / 'list.txt'}"], tmp_path / "m.svox", resume=True)
    alone(recording(2)).save(tmp_path / "two.svox")
    corrected = sv.remap(tmp_path / "two.svox", tmp_path / "new.tum", tmp_path / "moved.svox").map
    assert_same(made.map.storage.blocks(), of_all(recording(1), corrected))
    with pytest.raises(StereovoxError, match=r"m\.svox: maps in boxes do not keep .* in the fleet's list"):
        sv.remap(tmp_path / "m.svox", tmp_path / "new.tum", tmp_path / "no.svox")


def test_what_was_done_before_a_failure_stays(mapped, where, monkeypatch):
    """A store that is full after some boxes: the error is one line, and going on does the rest."""
    wrote = []

    def filling(place, name, data, write):
        if name.startswith("done/"):
            wrote.append(name)
            if len(wrote) > 2:
                raise MapFileError(f"{place}/{name}: cannot be written (No space left on device)")
        write(place, name, data)

    kind = type(Place.of(where))
    with monkeypatch.context() as patch:
        write = kind.write
        patch.setattr(kind, "write", lambda place, name, data: filling(place, name, data, write))
        with pytest.raises(MapFileError, match="No space left"):
            mapped([recording(1)], where)
    with pytest.raises(MapFileError, match="resume"):
        mapped([recording(1)], where)
    made = mapped([recording(1)], where, resume=True)
    assert 0 < made.boxes[1] <= made.boxes[0] - 2
    assert_same(made.map.storage.blocks(), alone(recording(1)).storage.blocks())
    assert not Place.of(where).names("done/")


def test_boxes_that_are_gone_are_mapped_again(mapped, tmp_path, monkeypatch):
    """A box of the map that was removed, and word of a box that was swept since."""
    monkeypatch.setattr(pyramid, "SMALL", 100)
    where = tmp_path / "m.svox"
    made, place = mapped([recording(1)], where), Place.of(where)
    levels = made.map.manifest.levels
    assert sum(map(len, levels)) > 1
    gone = made.map.manifest.boxes[2], levels[0][0]
    for entry in gone:
        place.remove(place.names(f"{entry.name}/cells/"))
    again = mapped([recording(1)], where, resume=True)
    assert (again.boxes[1], again.map.manifest.levels) == (1, levels)
    assert_same(sv.load_map(where).storage.blocks(), alone(recording(1)).storage.blocks())
    inputs = next(name for name, box in made.map.manifest.extra["fleet"]["boxes"].items() if box == gone[0].box)
    word = json.dumps(boxes.saved(boxes.DoneBox(gone[0]._replace(name=f"{gone[0].name[:-16]}{16 * '0'}"), 1.0)))
    place.remove(["manifest.json", *place.names(f"{gone[0].name}/")])
    place.write(f"done/{inputs}.json", word.encode())
    assert mapped([recording(1)], where, resume=True).boxes[1] == made.boxes[0]
    assert_same(sv.load_map(where).storage.blocks(), alone(recording(1)).storage.blocks())


def test_levels_of_boxes_that_stay_are_not_made_again(mapped, tmp_path, monkeypatch):
    monkeypatch.setattr(pyramid, "SMALL", 100)
    made = mapped([recording(1)], tmp_path / "m.svox")
    monkeypatch.setattr(fleet, "write_parent", None)
    again = mapped([recording(1)], tmp_path / "m.svox", resume=True)
    assert again.map.manifest.levels == made.map.manifest.levels != []


def test_a_broken_recording_is_told_and_left_out(mapped, tmp_path):
    (tmp_path / "broken").mkdir()
    (tmp_path / "broken/depth.txt").write_text("nothing\n")
    made = mapped([recording(1), tmp_path / "broken", "sim:nowhere"], tmp_path / "m.svox")
    assert_same(made.map.storage.blocks(), alone(recording(1)).storage.blocks())
    reports = made.recordings
    assert [bool(one.error) for one in reports] == [False, True, True]
    assert len(made.summary()["doubts"]) == 2
    assert "\n" not in "".join(one.error for one in reports)
    with pytest.raises(StereovoxError, match="not one recording could be used"):
        mapped(["sim:nowhere"], tmp_path / "n.svox", voxel_size=0.1)
    assert not (tmp_path / "n.svox").exists()  # the next run may have other settings


def test_a_map_of_no_fleet_is_left_alone(mapped, where):
    sv.save_boxed(alone(recording(2)), where, 3.2)
    before = sv.load_map(where).storage.blocks()
    for resume in (False, True):
        with pytest.raises(MapFileError, match="no fleet made"):
            mapped([recording(1)], where, resume=resume)
    assert_same(sv.load_map(where).storage.blocks(), before)


def test_a_recording_that_may_not_be_read_is_told_and_left_out(mapped, tmp_path, monkeypatch):
    mapped_alone = recordings._mapped_alone

    def refused(one, *given):
        if one.where == recording(2):
            raise PermissionError(errno.EACCES, "Permission denied", "poses.txt")
        return mapped_alone(one, *given)

    monkeypatch.setattr(recordings, "_mapped_alone", refused)
    made = mapped([recording(1), recording(2)], tmp_path / "m.svox")
    assert made.recordings[1].error == "poses.txt: Permission denied; check that you may read it"
    assert_same(made.map.storage.blocks(), alone(recording(1)).storage.blocks())


@pytest.mark.parametrize("system", [True, False])
def test_a_worker_without_room_does_not_leave_recordings_out(mapped, tmp_path, monkeypatch, system):
    def full(one, layout, folder, notes):
        if system:
            raise OSError(errno.ENOSPC, "No space left on device", str(folder))
        raise MapFileError(f"{folder}/map: cannot save the map (No space left on device)")

    monkeypatch.setattr(recordings, "_mapped_alone", full)
    with pytest.raises(StereovoxError, match=r"stereovox-.*No space left on device") as error:
        mapped([recording(1)], tmp_path / "m.svox")
    assert "cluster" not in str(error.value)
    assert "not one recording" not in str(error.value)


def test_what_kills_workers_is_named(scheduler):
    def dies(task):
        raise distributed.KilledWorker(task, SimpleNamespace(address=""), 20)

    with distributed.Client(scheduler) as client:
        run = cluster.Cluster(client)
        with pytest.raises(StereovoxError, match="that had 'drives/a' died"):
            list(run.results(dies, {"drives/a": (f"dies-{run._name}-drives/a",)}))


def test_damage_of_what_is_kept_is_told_with_the_cure(mapped, tmp_path):
    mapped([recording(1)], tmp_path / "m.svox")
    (tmp_path / "m.svox/manifest.json").unlink()
    for kind in ("seen.npy", "manifest.json", "frames-*"):
        whole = {file: file.read_bytes() for file in (tmp_path / "m.svox/recordings").glob(f"*/{kind}")}
        for file, data in whole.items():
            file.write_bytes(data[:-9] if kind == "frames-*" else b"")
        with pytest.raises(MapFileError, match=r"recordings/\w+: is damaged [^;]*; remove it and run again with --res"):
            mapped([recording(1)], tmp_path / "m.svox", resume=True)
        for file, data in whole.items():
            file.write_bytes(data)
    shutil.rmtree(tmp_path / "m.svox/recordings")
    mapped([recording(1)], tmp_path / "m.svox", resume=True)
    assert_same(sv.load_map(tmp_path / "m.svox").storage.blocks(), alone(recording(1)).storage.blocks())


def test_a_bit_that_flips_in_what_frames_see_is_told(mapped, tmp_path):
    """It would take a frame out of a box, or put it into another one."""
    mapped([recording(1)], tmp_path / "m.svox")
    (seen,) = (tmp_path / "m.svox/recordings").glob("*/seen.npy")
    content = bytearray(seen.read_bytes())
    content[-16] ^= 1
    seen.write_bytes(content)
    with pytest.raises(MapFileError, match=r"recordings/\w+: is damaged .*; remove it and run again with --resume"):
        mapped([recording(1)], tmp_path / "m.svox", resume=True)


def test_a_recording_that_breaks_later_is_not_taken_away_unasked(mapped, tmp_path):
    shutil.copytree(recording(2), tmp_path / "drive")
    made = mapped([recording(1), tmp_path / "drive"], tmp_path / "m.svox")
    before = made.map.storage.blocks()
    shutil.rmtree(tmp_path / "drive")
    with pytest.raises(StereovoxError, match="is in the map and cannot be used now"):
        mapped([recording(1), tmp_path / "drive"], tmp_path / "m.svox", resume=True)
    assert_same(sv.load_map(tmp_path / "m.svox").storage.blocks(), before)
    mapped([recording(1)], tmp_path / "m.svox", resume=True)
    assert_same(sv.load_map(tmp_path / "m.svox").storage.blocks(), alone(recording(1)).storage.blocks())


def test_two_fleets_of_one_cluster_write_their_own_maps(mapped, tmp_path):
    """The same recordings at the same time: none takes the other's boxes for done."""
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda name: mapped([recording(1)], tmp_path / name), ["m.svox", "n.svox"]))
    for one in both:
        assert_same(one.map.storage.blocks(), alone(recording(1)).storage.blocks())


def test_two_fleets_do_not_write_one_map(mapped, where):
    with (
        fleet.only_writer_at(Place.of(where)),
        ThreadPoolExecutor(1) as other,
        pytest.raises(MapFileError, match="another") as refused,
    ):
        other.submit(mapped, [recording(1)], where).result()
    assert "s3:" not in where or f"process {os.getpid()} on {socket.gethostname()})" in str(refused.value)


@pytest.mark.usefixtures("obeys_signals")
@pytest.mark.parametrize(
    ("where", "number"),
    [("folder", signal.SIGINT), ("s3", signal.SIGTERM), ("folder", signal.SIGHUP)],
    indirect=["where"],
)
def test_a_fleet_that_is_told_to_end_gives_the_map_to_the_next(mapped, where, monkeypatch, number):
    before = signal.getsignal(number)

    def told(*words):
        os.kill(os.getpid(), number)
        time.sleep(5)

    with monkeypatch.context() as patched:
        patched.setattr(fleet, "_boxes", told)
        with pytest.raises(KeyboardInterrupt) as stopped:
            mapped([recording(1)], where)
    assert stopped.value.args == (number,)
    assert signal.getsignal(number) == before
    assert_same(mapped([recording(1)], where, resume=True).map.storage.blocks(), alone(recording(1)).storage.blocks())


def test_ctrl_c_at_a_terminal_is_one_line(tmp_path, obeys_signals):
    """A terminal sends it to the workers as well."""
    words = "fleet", recording(1), "--out", "m.svox", "--voxel-size", "0.2", "--box", "1.6", "--workers", "1"
    with subprocess.Popen(
        [sys.executable, "-m", "stereovox", *words],
        cwd=tmp_path, stderr=subprocess.PIPE, text=True, start_new_session=True,
    ) as run:  # fmt: skip
        while run.poll() is None and not list((tmp_path / "m.svox").glob("done/*")):
            time.sleep(0.05)
        os.killpg(run.pid, signal.SIGINT)
        said = run.communicate()[1]
    assert run.returncode == 130
    assert "Traceback" not in said
    assert said.endswith("stereovox: stopped\n")


@pytest.mark.parametrize(
    ("error", "said"), [(ValueError("bad\nbyte"), r"ValueError: bad\\nbyte"), (MemoryError(), "too little memory")]
)
def test_a_recording_whose_reader_fails_is_named_and_left_out(mapped, tmp_path, monkeypatch, error, said):
    class Failing(recordings.MapRun):
        def __enter__(self):
            if self._source == recording(2):
                raise error
            return super().__enter__()

    monkeypatch.setattr(recordings, "MapRun", Failing)
    made = mapped([recording(1), recording(2)], tmp_path / "m.svox")
    assert made.map.frames == 6
    assert re.search(said, made.summary()["doubts"][0])
    assert made.summary()["doubts"][0].startswith(recording(2))


def test_more_boxes_than_a_map_may_have_are_told_before_they_are_mapped(mapped, tmp_path, monkeypatch):
    monkeypatch.setattr(fleet, "MAX_BOXES", 3)
    monkeypatch.setattr(fleet, "map_box", None)
    with pytest.raises(StereovoxError, match="larger boxes"):
        mapped([recording(1)], tmp_path / "m.svox")


def test_recordings_of_an_object_store(mapped, s3, tmp_path):
    folder = Path(recording(1))
    local = mapped([folder], tmp_path / "m.svox")
    place = Place.of(f"{s3}/recordings-{os.getpid()}")
    for file in sorted(folder.rglob("*")):
        if file.is_file():
            place.write(f"{folder.name}/{file.relative_to(folder)}", file.read_bytes())
    stored = mapped([f"{place}/{folder.name}"], tmp_path / "n.svox")
    assert_same(stored.map.storage.blocks(), local.map.storage.blocks())
    assert stored.map.frames == 6
    again = mapped([f"{place}/{folder.name}/"], tmp_path / "n.svox", resume=True)
    assert (again.recordings[0].seconds, again.boxes[1]) == (0, 0)  # it is the same one


def test_what_cannot_be_used_of_an_object_store_is_named_as_there(mapped, s3, tmp_path):
    """Many recordings in place of one, poses that are none, and a bucket that is not there."""
    above = f"{s3}/{uuid4().hex}"
    for file in filter(Path.is_file, Path(recording(1)).rglob("*")):
        Place.of(above).write(f"city/drive/{file.relative_to(recording(1))}", file.read_bytes())
    Place.of(above).write("new.tum", b"")
    wrong = [f"{above}/city", Recording(f"{above}/city/drive", f"{above}/new.tum"), "s3://no-such-bucket/drive"]
    made = mapped([recording(2), *wrong], tmp_path / "m.svox")
    said = [one.error for one in made.recordings]
    assert said[:2] == ["", f"no recording itself; did you mean {above}/city/drive?"]
    assert said[2].startswith(f"{above}/new.tum: holds no pose")
    assert said[3] == "s3://no-such-bucket: there is no such bucket; check the name, or create it"
    assert all(f"{above}/city/drive/camera.toml" in one.notes[0] for one in made.recordings[2:3])


def test_a_plan_looks_where_the_run_reads(s3, tmp_path):
    """Also into object stores, and at files of poses; what cannot be read is a doubt."""
    folder, above = Path(recording(1)), f"{s3}/{uuid4().hex}"
    for file in filter(Path.is_file, folder.rglob("*")):
        Place.of(above).write(f"drive/{file.relative_to(folder)}", file.read_bytes())
    stored, here = (plan_fleet([one], **SETTINGS) for one in (f"{above}/drive", folder))
    assert (stored.frames, stored.boxes, stored.bytes) == (here.frames, here.boxes, here.bytes)
    assert "doubts" not in stored.summary()
    unposed = Recording(recording(2), str(tmp_path / "gone.tum"))
    plan = plan_fleet([folder, unposed, f"{above}/gone"], **SETTINGS)
    assert plan.frames == here.frames
    assert [re.sub(r".*gone", "gone", line) for line in plan.summary()["doubts"]] == [
        "gone.tum: No such file or directory; give a readable file",
        "gone: no such recording in the store; check the name",
    ]  # fmt: skip


@pytest.mark.slow
def test_killed_workers_change_nothing(tmp_path):
    """Two processes, of which one after another is killed while boxes are mapped; the nannies start new ones."""
    psutil = pytest.importorskip("psutil")
    killed = []

    def kill(done, total, doing):
        if doing == "boxes" and done and len(killed) < 3:
            workers = [one for one in psutil.Process().children(recursive=True) if "spawn_main" in " ".join(cmd(one))]
            busy = sorted(workers, key=lambda one: -sum(one.cpu_times()[:2]))
            killed.append(busy[0].pid)
            busy[0].send_signal(signal.SIGKILL)

    def cmd(process):
        try:
            return process.cmdline()
        except psutil.Error:
            return []

    wanted = of_all(recording(1), recording(2))  # first, or each new process would compile the kernels for itself
    made = map_fleet([recording(1), recording(2)], tmp_path / "m.svox", **SETTINGS, box_m=3.2, workers=2, progress=kill)
    assert len(killed) == 3
    assert_same(made.map.storage.blocks(), wanted)


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"window.size": [5, 5, 5]}, "window.size"), ({"max_memory": "1 GB"}, "max_memory"),
        ({"deadline_ms": 20}, "deadline_ms"), ({"map.keep_times": True, "map.forget_s": 5}, "map.forget_s"),
    ],
    ids=str,
)  # fmt: skip
def test_settings_that_boxes_cannot_have_are_named(tmp_path, settings, named):
    with pytest.raises(ConfigError, match=named):
        map_fleet([recording(1)], tmp_path / "m.svox", **SETTINGS, **settings)


def test_a_map_is_gone_on_with_as_it_was_made(mapped, scheduler, tmp_path):
    made = mapped([recording(1)], tmp_path / "m.svox")
    again = map_fleet([recording(1)], tmp_path / "m.svox", resume=True, scheduler=scheduler)
    assert again.boxes == (made.boxes[0], 0)
    for other in ({"voxel_size": 0.1}, {"box_m": 3.2}):
        with pytest.raises(MapFileError, match="made with other settings"):
            mapped([recording(1)], tmp_path / "m.svox", resume=True, **other)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fleet, "survey", None)  # another first recording may suggest other settings
        both = [recording(2), recording(1)]
        map_fleet(both, tmp_path / "m.svox", resume=True, scheduler=scheduler, box_m=6.4, voxel_size=0.2)
    (tmp_path / "m.svox/fleet.json").write_text("{}")
    with pytest.raises(MapFileError, match=r"fleet\.json: is damaged"):
        mapped([recording(1)], tmp_path / "m.svox", resume=True)


def test_names_of_recordings(tmp_path):
    for name in ("b", "a", "c d"):
        (tmp_path / name).mkdir()
    assert [one.where for one in recordings_of([f"{tmp_path}/*", recording(1)])] == [
        *(str(tmp_path / name) for name in ("a", "b", "c d")), recording(1),
    ]  # fmt: skip
    for wrong, said in (
        (["a", "a"], "twice"),
        ([], "no recording"),
        ([f"{tmp_path}/x*"], "nothing has"),
        (["@no"], "list"),
    ):
        with pytest.raises(StereovoxError, match=said):
            recordings_of(wrong)
    (tmp_path / "link").symlink_to(tmp_path / "a")
    for names in ([f"{tmp_path}/*"], [tmp_path / "a", f"{tmp_path}/b/../a/"]):
        with pytest.raises(StereovoxError, match=rf"is named twice, also as {tmp_path}/a;"):
            recordings_of(names)
    assert len(recordings_of([f"{recording(1)}?depth=/a", f"{recording(1)}?depth=/b"])) == 2
    (tmp_path / "list.txt").write_text("a b c\n")
    for one in (recording(1), Path(recording(1)), Recording(recording(1))):
        assert recordings_of(one) == [Recording(recording(1))]
    with pytest.raises(StereovoxError, match=r"list\.txt:1: 3 words"):
        recordings_of([f"@{tmp_path / 'list.txt'}"])


def test_names_in_a_list_count_from_where_it_is(tmp_path, monkeypatch):
    (tmp_path / "list.txt").write_bytes("\ufeffdrives/a ../poses/a.tum\r\nsim:room\ns3://city/b\n/c\n".encode())
    names = ["drives/a", "sim:room", "s3://city/b", "/c"]
    monkeypatch.chdir(tmp_path)
    assert [one.where for one in recordings_of(["@list.txt"])] == names
    (tmp_path / "below").mkdir()
    monkeypatch.chdir(tmp_path / "below")
    found = recordings_of(["@../list.txt"])
    assert [one.where for one in found] == ["../drives/a", *names[1:]]
    assert found[0].poses == "../../poses/a.tum"


def test_patterns_leave_out_what_lies_beside_recordings(tmp_path):
    """Calibrations of KITTI, and the map itself, whole or begun; not a file that may be a broken recording."""
    (tmp_path / "drive").mkdir()
    (tmp_path / "calib_cam_to_cam.txt").write_text("K_00: 1\n")
    (tmp_path / "empty.bag").write_text("")
    sv.VoxelMap.from_cells(sv.load_config(), [[0, 0, 0]], [1.0]).save(tmp_path / "city.svox")
    (tmp_path / "begun.svox").mkdir()
    (tmp_path / "begun.svox/fleet.json").write_text("{}")
    assert [Path(one.where).name for one in recordings_of([f"{tmp_path}/*"])] == ["drive", "empty.bag"]
    with pytest.raises(StereovoxError, match="no recording has such a name"):
        recordings_of([f"{tmp_path}/calib*"])


def test_no_scheduler_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "PATIENCE_S", 0.5)
    with pytest.raises(StereovoxError, match="no Dask scheduler answers"):
        map_fleet([recording(1)], tmp_path / "m.svox", **SETTINGS, scheduler="tcp://127.0.0.1:9")
    assert not (tmp_path / "m.svox").exists()  # the next run begins anew


@pytest.mark.parametrize("workers", [0, -1])
def test_workers_that_cannot_be_are_told(tmp_path, workers):
    with pytest.raises(StereovoxError, match=f"{workers} workers: give 1 or more"):
        map_fleet([recording(1)], tmp_path / "m.svox", **SETTINGS, workers=workers)
    assert not (tmp_path / "m.svox").exists()


def test_workers_of_another_version_are_named(mapped, tmp_path, monkeypatch):
    """They would end at the first task, and nobody would say so."""
    monkeypatch.setattr(cluster, "__version__", "9.9")
    with pytest.raises(StereovoxError, match=rf"this worker has {sv.__version__}, here is 9\.9; install"):
        mapped([recording(1)], tmp_path / "m.svox")
    without = SimpleNamespace(run=lambda *given, **how: {"tcp://a": OSError(), "tcp://b": ImportError("stereovox")})
    with pytest.raises(StereovoxError, match="tcp://b: this worker has no stereovox"):
        cluster._check_workers(without, "tcp://s", print)


def test_a_scheduler_without_workers_is_told():
    said = []
    with (
        distributed.LocalCluster(n_workers=0, processes=False, dashboard_address="127.0.0.1:0") as local,
        cluster.cluster(local.scheduler_address, None, said.append),
    ):
        assert "has no workers yet; waiting" in said[0]


def test_keys_know_what_frames_depend_on(tmp_path):
    def layout(side=64, **settings):
        return BoxLayout(sv.load_config(**{"voxel_size": 0.1, **settings}), side)

    (tmp_path / "a.txt").write_text("1")
    one = Recording(str(tmp_path))
    before = one.key(layout())
    assert before == one.key(layout(threads=2))
    others = {one.key(layout(voxel_size=0.2)), one.key(layout(128)), replace(one, poses="x.tum").key(layout())}
    (tmp_path / "a.txt").write_text("12")
    assert len({before, one.key(layout())} | others) == 5


def test_keys_know_files_behind_links(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "drive").mkdir()
    (tmp_path / "disk/a.txt").write_text("1")
    (tmp_path / "drive/depth").symlink_to(tmp_path / "disk")
    (tmp_path / "disk/back").symlink_to(tmp_path / "drive")
    before = fingerprint(str(tmp_path / "drive"))
    assert [name for name, *_ in before] == ["depth/a.txt"]
    (tmp_path / "disk/a.txt").write_text("12")
    assert fingerprint(str(tmp_path / "drive")) != before


def test_keys_know_what_objects_hold_and_only_their_own(s3):
    above = f"{s3}/{uuid4().hex}"
    place, drive = Place.of(above), f"{above}/drive1"
    place.write("drive1/a.txt", b"1")
    before = fingerprint(drive)
    place.write("drive10/b.txt", b"")
    assert fingerprint(drive) == before
    place.write("drive1/a.txt", b"2")
    assert fingerprint(drive) != before
    with pytest.raises(MapFileError, match=f"{s3}: is a bucket; name a recording in it"):
        fingerprint(s3)
    place.write("one.bag", b"1")
    assert [name for name, _ in fingerprint(f"{above}/one.bag")] == ["one.bag"]


def test_a_recording_in_a_store_may_have_objects_that_stand_for_folders(s3, tmp_path):
    above = f"{s3}/{uuid4().hex}"
    Place.of(above).write("drive/depth/a.png", b"1")
    for folder in ("drive/", "drive/depth/"):
        url = f"{os.environ['AWS_ENDPOINT_URL']}/{above.removeprefix('s3://')}/{folder}"
        urllib.request.urlopen(urllib.request.Request(url, method="PUT"))
    copy = Path(local(f"{above}/drive", tmp_path))
    assert [file.read_bytes() for file in copy.rglob("*") if file.is_file()] == [b"1"]


def test_a_recording_that_changes_meanwhile_is_mapped_all_the_same(mapped, tmp_path):
    shutil.copytree(recording(1), tmp_path / "drive")
    made = mapped(
        [tmp_path / "drive"], tmp_path / "m.svox", progress=lambda *_: (tmp_path / "drive" / "notes.txt").write_text("")
    )
    assert_same(made.map.storage.blocks(), alone(recording(1)).storage.blocks())


def test_boxes_are_those_with_evidence():
    """Against a plain set, and each box has the frames that see it, by number."""
    layout, random = BoxLayout(sv.load_config(voxel_size=0.2), 16), np.random.default_rng(0)
    parts = [[random.integers(-9, 9, (size, 3)).astype(np.int32) for size in (30, 20)] for _ in range(5)]
    rows, expected = [], {}
    for n, (mixed, free) in enumerate(parts):
        evidence = Evidence(mixed, np.ones((len(mixed), 512), np.int16), free, np.int16(-1))
        rows += [[n, *box] for box in boxes_with(layout, evidence).tolist()]
        for block in [*mixed.tolist(), *free.tolist()]:
            expected.setdefault(tuple(axis // 2 for axis in block), set()).add(n)
    random.shuffle(rows)
    found = boxes.boxes_of([("a", np.array(rows, np.int32), 5), ("b", np.array(rows, np.int32), 5)], None)
    assert {box.at: set(box.pieces[0].numbers) for box in found} == expected
    assert all(list(box.pieces[0].numbers) == sorted(box.pieces[0].numbers) for box in found)
    assert [piece.before for piece in found[0].pieces] == [0, 5]
    nothing = Evidence(parts[0][0][:0], np.ones((0, 512), np.int16), parts[0][0][:0], np.int16(-1))
    assert boxes_with(layout, nothing).shape == (0, 3)
