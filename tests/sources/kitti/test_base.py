# SPDX-License-Identifier: Apache-2.0
"""What holds for all KITTI layouts, on small recordings made in their exact format."""

from __future__ import annotations

import shutil

import made_kitti as made
import numpy as np
import pytest
from made_recordings import png_bytes

from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import inverse, transform_points
from stereovox.opening import SOURCES, open_source
from stereovox.registry import find
from stereovox.sources.lidar import LidarSource

LAYOUTS = {
    "raw grey": (made.raw, "", (0, 1)),
    "raw colour": (lambda folder: made.raw(folder, eyes=(0, 1, 2, 3)), "?camera=colour", (2, 3)),
    "tracking": (made.tracking, "", (2, 3)),
    "odometry": (made.odometry, "", (0, 1)),
    "odometry colour": (lambda folder: made.odometry(folder, eyes=(2, 3)), "", (2, 3)),
}


@pytest.fixture(params=LAYOUTS)
def layout(request, tmp_path):
    make, query, eyes = LAYOUTS[request.param]
    return open_source(f"{make(tmp_path)}{query}"), eyes


def test_frames_hold_the_pictures_and_the_pose_of_the_left_camera(layout):
    source, eyes = layout
    frames = list(source)
    assert [frame.fault for frame in frames] == [None] * 4
    for n, frame in enumerate(frames):
        for image, eye in zip((frame.left, frame.right), eyes, strict=True):
            np.testing.assert_array_equal(image, made.picture(10 * n + eye, eye > 1))
        T_cam0_left = np.eye(4)
        T_cam0_left[0, 3] = -made.OFFSETS[eyes[0]]  # camera 2 stands 6 cm left of camera 0
        np.testing.assert_allclose(frame.T_world_sensor, made.cam0_pose(n) @ T_cam0_left, atol=2e-6)
        assert frame.stamp_ns - frames[0].stamp_ns == n * 100_000_000
    camera = frames[0].pair.camera
    assert camera == source.camera
    assert frames[0].pair.eyes is None
    np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (made.F, made.F, made.CX, made.CY))
    assert (camera.width, camera.height) == made.SIZE
    assert camera.baseline == pytest.approx(made.OFFSETS[eyes[0]] - made.OFFSETS[eyes[1]])


def test_the_world_is_upright_at_the_first_frame(layout):
    T = layout[0].frame(0).T_world_sensor
    np.testing.assert_allclose(T[:3, :3], [[0, 0, 1], [-1, 0, 0], [0, -1, 0]], atol=1e-9)


def test_a_scan_falls_where_its_points_are(layout):
    source, _ = layout
    assert isinstance(source, LidarSource)
    assert source.has_lidar
    for n in range(4):
        scan = source.scan(n)
        assert scan.points.dtype == np.float32
        assert scan.stamp_ns == source.frame(n).stamp_ns
        np.testing.assert_allclose(
            transform_points(scan.T_world_lidar, scan.points)[: len(made.wall())], made.wall(), atol=1e-4
        )


def test_any_frame_can_be_asked_for_and_no_other(layout):
    source, _ = layout
    assert source.frame(-1).name == source.frame(3).name
    np.testing.assert_array_equal(source.scan(-1).points, source.scan(3).points)
    for ask in (source.frame, source.scan, source.viewpoint, source.boxes):
        with pytest.raises(IndexError):
            ask(4)


IMAGES = {
    "raw": (made.raw, "image_01/data/0000000001.png"),
    "tracking": (made.tracking, "image_03/0000/000001.png"),
    "odometry": (made.odometry, "image_1/000001.png"),
}
SPOILT = {
    "missing_file": lambda path: path.unlink(),
    "unreadable": lambda path: path.write_bytes(path.read_bytes()[:-30]),
    "bad_dtype": lambda path: path.write_bytes(png_bytes(*made.SIZE)),
    "bad_shape": lambda path: made.write_picture(path, made.picture(0, False, (8, 8))),
}


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("fault", SPOILT)
def test_a_bad_image_spoils_its_own_frame_only(tmp_path, name, fault, capfd):
    make, image = IMAGES[name]
    folder = make(tmp_path)
    SPOILT[fault](folder / image)
    frames = list(open_source(folder))
    assert [frame.fault for frame in frames] == [None, fault, None, None]
    assert str(folder / image) in frames[1].fault_detail
    assert "\n" not in frames[1].fault_detail
    assert frames[1].left.shape == (0, 0)
    assert np.isnan(frames[1].T_world_sensor).all()
    assert capfd.readouterr() == ("", "")


SCANS = {
    "raw": (made.raw, "velodyne_points/data/0000000002.bin"),
    "tracking": (made.tracking, "velodyne/0000/000002.bin"),
    "odometry": (made.odometry, "velodyne/000002.bin"),
    "stereo2015": (lambda folder: made.stereo2015(folder, (1, 2, 3)), "velodyne/000003.bin"),
}


@pytest.mark.parametrize("name", SCANS)
@pytest.mark.parametrize(
    ("reason", "spoil"),
    [
        ("missing_file", lambda path: path.unlink()),
        ("unreadable", lambda path: path.write_bytes(path.read_bytes()[:-7])),
        ("unreadable", lambda path: path.write_bytes(b"")),
    ],
)
def test_a_bad_scan_is_refused_in_one_line_and_the_frame_stays(tmp_path, name, reason, spoil):
    make, scan = SCANS[name]
    folder = make(tmp_path)
    spoil(folder / scan)
    source = open_source(folder)
    with pytest.raises(FrameRefused, match=scan) as refused:
        source.scan(2)
    assert refused.value.reason == reason
    assert "\n" not in str(refused.value)
    assert source.frame(2).fault is None
    assert len(source.scan(1).points)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    drive = made.raw(tmp_path)
    made.write_scan(
        drive / "velodyne_points/data/0000000000.bin", np.array([[1, 2, 3], [np.nan, 0, 0], [np.inf, 0, 0]])
    )
    np.testing.assert_array_equal(open_source(drive).scan(0).points, [[1, 2, 3]])


def test_a_recording_without_scans_says_so_and_is_of_use_without(tmp_path):
    drive = made.raw(tmp_path)
    shutil.rmtree(drive / "velodyne_points")
    source = open_source(drive)
    assert not source.has_lidar
    assert source.scan(0) is None
    assert source.frame(0).fault is None


def test_raw_poses_come_from_the_best_file_there_is_or_from_the_one_named(tmp_path):
    drive = made.raw(tmp_path, eyes=(0, 1))
    for name, step in {"poses_ins.txt": 1.0, "poses_refined.txt": 2.0, "mine.txt": 3.0}.items():
        straight = [made.motion([0, 0, 0], [0, 0, step * n]) for n in range(4)]
        (drive / name).write_text("".join(made.row(T[:3]) + "\n" for T in straight))

    def ahead(query: str) -> float:
        return open_source(f"{drive}{query}").viewpoint(3).T_world_camera[0, 3]

    by_oxts = made.cam0_pose(3)[0, 3]
    found = [ahead(query) for query in ("", "?poses=ins", "?poses=oxts", "?poses=mine.txt", f"?poses={drive}/mine.txt")]
    np.testing.assert_allclose(found, [6, 3, by_oxts, 9, 9], atol=1e-6)
    (drive / "poses_refined.txt").unlink()
    assert ahead("") == pytest.approx(3)
    (drive / "poses_ins.txt").unlink()
    assert ahead("") == pytest.approx(by_oxts)


def test_raw_stamps_are_exact_to_the_nanosecond(tmp_path):
    drive = made.raw(tmp_path, count=1)
    (drive / "image_00/timestamps.txt").write_text("2011-09-26 14:05:35.913420801\n")
    assert open_source(drive).frame(0).stamp_ns == 1317045935913420801


def test_grey_is_preferred_and_colour_taken_where_there_is_no_grey(tmp_path):
    assert open_source(made.raw(tmp_path / "a", eyes=(0, 1, 2, 3))).frame(0).left.ndim == 2
    assert open_source(made.raw(tmp_path / "b", eyes=(2, 3))).frame(0).left.ndim == 3


def test_one_sequence_of_many_is_named_by_parameter_or_path(tmp_path):
    made.tracking(tmp_path, 2, "0000")
    training = made.tracking(tmp_path, 3, "0013")
    assert len(open_source(f"{training}?sequence=0013")) == 3
    source = open_source(training / "image_02/0000")
    assert (len(source), source.name) == (2, "kitti_tracking_0000")
    with pytest.raises(SourceError, match=r"holds sequences 0000, 0013; choose one: .*\?sequence=0000"):
        open_source(training)
    with pytest.raises(SourceError, match=r"holds sequences 0000, 0013"):
        open_source(f"{training}?sequence=7")
    with pytest.raises(SourceError, match=r"is already a sequence"):
        open_source(f"{training}/image_02/0000?sequence=0013")


def test_odometry_takes_another_pose_file(tmp_path):
    sequence = made.odometry(tmp_path)
    (tmp_path / "poses/03.txt").rename(tmp_path / "slam.txt")
    with pytest.raises(SourceError, match=r"poses/03\.txt: .*\?poses="):
        open_source(sequence)
    source = open_source(f"{sequence}?poses={tmp_path}/slam.txt")
    np.testing.assert_allclose(source.viewpoint(2).T_world_camera, made.cam0_pose(2), atol=1e-6)


def test_poses_of_other_forms_in_other_axes(tmp_path):
    sequence = made.odometry(tmp_path)
    opengl = [made.file_pose(n) @ np.diag([1.0, -1, -1, 1]) for n in range(4)]
    text = "".join(f"{n} {n} {n + 1}\n{chr(10).join(made.row(line) for line in T)}\n" for n, T in enumerate(opengl))
    (tmp_path / "trajectory.log").write_text(text)
    (tmp_path / "inverse.txt").write_text("".join(made.row(inverse(made.file_pose(n))[:3]) + "\n" for n in range(4)))
    (tmp_path / "tum.txt").write_text("".join(f"{0.1 * n} {n} 0 5 0 0 0 1\n" for n in range(4)))
    for query in ("trajectory.log&axes=opengl", "inverse.txt&invert=1"):
        source = open_source(f"{sequence}?poses={tmp_path}/{query}")
        np.testing.assert_allclose(source.viewpoint(3).T_world_camera, made.cam0_pose(3), atol=1e-5)
    source = open_source(f"{sequence}?poses={tmp_path}/tum.txt")
    np.testing.assert_allclose(source.viewpoint(3).T_world_camera[:3, 3], [0, -3, 0], atol=1e-9)
    (tmp_path / "tum.txt").write_text("70 0 0 5 0 0 0 1\n71 0 0 5 0 0 0 1\n")
    with pytest.raises(SourceError, match=r"tum\.txt: poses from 70.* no time in common"):
        open_source(f"{sequence}?poses={tmp_path}/tum.txt")


def test_odometry_without_a_list_of_times(tmp_path):
    sequence = made.odometry(tmp_path)
    (sequence / "times.txt").unlink()
    source = open_source(sequence)
    assert [frame.stamp_ns for frame in source] == [0, 100_000_000, 200_000_000, 300_000_000]
    assert "has no times.txt: assuming 10 frames a second" in source.notes[0]
    assert open_source(f"{sequence}?fps=20").stamp_ns(3) == 150_000_000
    assert open_source(f"{made.tracking(tmp_path / 't')}?fps=20").stamp_ns(3) == 150_000_000


def test_an_odometry_folder_that_lacks_its_calibration(tmp_path):
    sequence = made.odometry(tmp_path)
    for name in ("times.txt", "calib.txt"):
        (sequence / name).unlink()
    with pytest.raises(SourceError, match=r"has left images .* but no calib\.txt; copy it from the data set"):
        open_source(sequence)


def test_scenes_of_stereo_2015_stand_each_in_its_own_world(tmp_path):
    training = made.stereo2015(tmp_path, (2, 7))
    made.write_picture(training / "image_2/000007_10.png", made.picture(1, True, (62, 22)))
    made.write_picture(training / "image_3/000007_10.png", made.picture(2, True, (62, 22)))
    source = open_source(training)
    assert "single scenes" in source.notes[0]
    first, second = source
    assert (first.fault, second.fault) == (None, None)
    np.testing.assert_array_equal(first.T_world_sensor, second.T_world_sensor)
    np.testing.assert_allclose(first.T_world_sensor[:3, 3], [0, made.OFFSETS[2], 0], atol=1e-12)
    assert (second.pair.camera.width, first.pair.camera.width, source.camera.width) == (62, 64, 64)
    assert first.stamp_ns != second.stamp_ns
    moving = source.moving(0)
    assert moving[:, 20:30].all()
    assert moving.sum() == 10 * made.SIZE[1]


def test_scenes_may_have_the_three_calibration_folders(tmp_path):
    training = made.stereo2015(tmp_path, (2,))
    expected = open_source(training).scan(0).T_world_lidar
    (training / "calib/000002.txt").unlink()
    with pytest.raises(SourceError, match=r"calib/000002\.txt: no such file, nor .*calib_cam_to_cam/000002\.txt"):
        open_source(training)
    made.raw_calibration(tmp_path / "day")
    for kind in ("cam_to_cam", "velo_to_cam", "imu_to_velo"):
        (training / f"calib_{kind}").mkdir()
        (tmp_path / f"day/calib_{kind}.txt").rename(training / f"calib_{kind}/000002.txt")
    np.testing.assert_allclose(open_source(training).scan(0).T_world_lidar, expected, atol=1e-9)


def test_boxes_of_tracking_follow_the_object(tmp_path):
    source = open_source(made.tracking(tmp_path))
    for n in range(4):
        (box,) = source.boxes(n)
        assert (box.kind, box.track, box.size) == ("Van", 2, (3.9, 1.6, 1.5))
        middle = transform_points(made.cam0_pose(n), [made.car_corner(n) - [0, 0.75, 0]])[0]
        np.testing.assert_allclose(box.T_world_box[:3, 3], middle, atol=1e-6)
        ahead, left, up = made.cam0_pose(n)[:3, :3] @ np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
        np.testing.assert_allclose(box.T_world_box[:3, :3], np.stack([ahead, left, up]), atol=1e-6)


def test_without_labels_a_note_says_what_it_means(tmp_path):
    training = made.tracking(tmp_path)
    (training / "label_02/0000.txt").unlink()
    source = open_source(training)
    assert source.boxes(0) == ()
    assert "objects are not annotated" in source.notes[0]


@pytest.mark.parametrize(
    ("make", "file", "text", "says"),
    [
        (made.raw, "../calib_cam_to_cam.txt", None, "calibration"),
        (made.raw, "../calib_cam_to_cam.txt", "P_rect_00: 1 2 3\n", "R_rect_00:' with 9"),
        (made.raw, "../calib_velo_to_cam.txt", None, "poses from oxts need it"),
        (made.raw, "../calib_imu_to_velo.txt", None, "poses from oxts need it"),
        (made.raw, "../calib_velo_to_cam.txt", "R: 2 0 0 0 2 0 0 0 2\nT: 0 0 0\n", "R is not a rotation"),
        (made.raw, "image_00/timestamps.txt", None, "drive's own file"),
        (made.raw, "image_00/timestamps.txt", "", "holds no time"),
        (made.raw, "image_00/timestamps.txt", "yesterday\n", "timestamps.txt:1: 'yesterday' is not a time like"),
        (
            made.raw,
            "image_00/timestamps.txt",
            "2011-09-26 13:02:25.1\n",
            "has 1 lines, but there is an image 0000000003",
        ),
        (made.raw, "poses_refined.txt", "1 0 0 0 0 1 0 0 0 0 1 0\n" * 5, "5 poses for 4 frames"),
        (made.raw, "poses_refined.txt", "", "no usable pose"),
        (made.tracking, "calib/0000.txt", None, "calibration"),
        (made.tracking, "calib/0000.txt", "P2: " + "1 " * 12, "P2 is not a projection"),
        (made.tracking, "oxts/0000.txt", None, "?poses="),
        (made.tracking, "label_02/0000.txt", "0 1 Car 0 0 0 1 2 3 4 1.5 1.6\n", "label_02/0000.txt:1: needs 17"),
        (made.tracking, "label_02/0000.txt", "0 1 Car 0 0 0 1 2 3 4 -1 1 1 0 0 5 0\n", "label_02/0000.txt:1: needs 17"),
        (made.odometry, "calib.txt", None, "calibration"),
        (made.odometry, "times.txt", "0.0\nsoon\n", "times.txt:2: 'soon'"),
        (made.odometry, "times.txt", "0.0\n", "but there is an image 000003.png"),
    ],
)
def test_what_spoils_the_whole_recording_is_one_line_with_the_file(tmp_path, make, file, text, says):
    folder = make(tmp_path)
    path = folder / file
    if text is None:
        path.unlink()
    else:
        path.write_text(text)
    with pytest.raises(SourceError) as error:
        open_source(folder)
    assert says in str(error.value)
    assert path.name in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("query", "says"),
    [
        ("?camra=grey", r"unknown parameter 'camra' \(did you mean 'camera'\?\)"),
        ("?camera=gray", r"did you mean 'grey'"),
        ("?camera=colour", r"has only grey images; leave camera= out"),
        ("?poses=nowhere.txt", r"nowhere\.txt: no such file"),
    ],
)
def test_bad_parameters_are_one_line(tmp_path, query, says):
    with pytest.raises(SourceError, match=says):
        open_source(f"{made.raw(tmp_path)}{query}")


def test_a_short_or_missing_oxts_line_spoils_its_own_frame_only(tmp_path):
    drive = made.raw(tmp_path / "raw")
    (drive / "oxts/data/0000000001.txt").write_text("49.0 8.4 110")
    (drive / "oxts/data/0000000002.txt").unlink()
    frames = list(open_source(drive))
    assert [frame.fault for frame in frames] == [None, "bad_pose_file", "bad_pose_file", None]
    assert "0000000001.txt: needs latitude" in frames[1].fault_detail
    assert "0000000002.txt: No such file" in frames[2].fault_detail
    np.testing.assert_allclose(frames[3].T_world_sensor, made.cam0_pose(3), atol=2e-6)

    training = made.tracking(tmp_path)
    lines = (training / "oxts/0000.txt").read_text().splitlines()
    (training / "oxts/0000.txt").write_text("\n".join([lines[0], lines[1][:20], lines[2]]))
    source = open_source(training)
    assert [frame.fault for frame in source] == [None, "bad_pose_file", None, "no_pose"]
    assert "oxts/0000.txt:2: needs latitude" in source.frame(1).fault_detail
    for ask in (source.scan, source.boxes, source.viewpoint):
        with pytest.raises(FrameRefused, match=r"0000\.txt:2"):
            ask(1)


def test_each_layout_is_recognised_by_one_kind_only(tmp_path):
    places = {
        "kitti_raw": made.raw(tmp_path / "a"),
        "kitti_tracking": made.tracking(tmp_path / "b"),
        "kitti_odometry": made.odometry(tmp_path / "c"),
        "kitti_stereo2015": made.stereo2015(tmp_path / "d"),
    }
    for name, place in places.items():
        for query in ("", "?anything=1"):
            kinds = [kind for kind in SOURCES if find("sources", SOURCES, kind).recognises(f"{place}{query}")]
            assert kinds == [name]


def test_the_date_folder_names_the_drive_below_it(tmp_path):
    drive = made.raw(tmp_path)
    with pytest.raises(SourceError, match=rf"did you mean {drive}"):
        open_source(drive.parent)
