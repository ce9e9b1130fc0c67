# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import json

import numpy as np
import pytest
from made_depth import matrix_line, posed, tum_line
from scipy.spatial.transform import Rotation

from stereovox.descriptions import describe
from stereovox.errors import FrameRefused, SourceError
from stereovox.sources.poses.poses import Poses
from stereovox.sources.rgbd.pose_files import (
    ImagePoses,
    image_numbers,
    in_optical_axes,
    number_in,
    read_pose,
    read_poses,
)

ROWS = ["".join(" ".join(map(str, row)) + "\n" for row in T) for T in posed()]
LOG = "".join(f"{k} {k} {k + 1}\n{rows}" for k, rows in enumerate(ROWS))
FORMS = {
    "12 numbers": "".join(matrix_line(T, 3) for T in posed()),
    "16 numbers": "# world from camera\n" + "".join(map(matrix_line, posed())),
    "commas and a heading": "a,b,c\n" + "".join(matrix_line(T).replace(" ", ",") for T in posed()),
    "7 numbers": "".join(tum_line("", T) for T in posed()),
    "4x4 below each other": "\n".join(ROWS),
    "3x4 below each other": "".join("\n".join(row.splitlines()[:3]) + "\n" for row in ROWS),
    "log": LOG,
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_of_one_pose_for_each_image(tmp_path, form):
    (tmp_path / "p.txt").write_text(FORMS[form])
    found = read_poses(tmp_path / "p.txt")
    assert isinstance(found, ImagePoses)
    assert len(found) == 4
    for i, T in enumerate(posed()):
        np.testing.assert_allclose(found.at(i), T, atol=1e-9)


def test_tum_lines_have_times(tmp_path):
    (tmp_path / "p.txt").write_text("".join(tum_line(k / 2, T) for k, T in enumerate(posed())))
    found = read_poses(tmp_path / "p.txt")
    assert isinstance(found, Poses)
    np.testing.assert_allclose(found.at(1_500_000_000), posed()[3], atol=1e-9)


@pytest.mark.parametrize("shape", [(4, 4), (16,), (3, 4), (12,)])
def test_arrays(tmp_path, shape):
    rows = 3 if np.prod(shape) == 12 else 4
    np.save(tmp_path / "p.npy", np.stack([T[:rows].reshape(shape) for T in posed()]))
    np.testing.assert_allclose(read_poses(tmp_path / "p.npy").at(2), posed()[2])
    (tmp_path / "p.npy").write_bytes((tmp_path / "p.npy").read_bytes()[:100])
    with pytest.raises(SourceError, match="not an array of poses"):
        read_poses(tmp_path / "p.npy")


def test_open3ds_json_is_world_to_camera_and_column_by_column(tmp_path):
    cameras = [{"extrinsic": np.linalg.inv(T).T.ravel().tolist()} for T in posed()]
    (tmp_path / "p.json").write_text(json.dumps({"parameters": cameras}))
    np.testing.assert_allclose(read_poses(tmp_path / "p.json").at(3), posed()[3], atol=1e-9)


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"parameters": 3}', '{"parameters": [{"extrinsic": [1, 2]}]}', "1"])
def test_other_json_is_refused(tmp_path, text):
    (tmp_path / "p.json").write_text(text)
    with pytest.raises(SourceError, match=r"p\.json: not "):
        read_poses(tmp_path / "p.json")


def test_a_folder_is_read_by_the_numbers_in_names(tmp_path):
    for k, T in zip([30, 4, 100, 7], posed(), strict=True):
        np.savetxt(tmp_path / f"{k}.txt", T)
    (tmp_path / "8.txt").write_text("1 2 3")
    found = read_poses(tmp_path)
    assert isinstance(found, ImagePoses)
    assert found.numbers == [4, 7, 8, 30, 100]
    chosen = found.of([100, 5, 8, 30])
    np.testing.assert_allclose(chosen.at(0), posed()[2])
    np.testing.assert_allclose(chosen.at(3), posed()[0])
    assert reason(chosen, 1) == "no_pose"
    assert reason(chosen, 2) == "bad_pose_file"
    with pytest.raises(SourceError, match="holds no usable pose"):
        found.of([1, 2])


def reason(poses, i):
    with pytest.raises(FrameRefused) as refused:
        poses.at(i)
    return refused.value.reason


def test_poses_beyond_the_end_and_quaternions_of_no_length(tmp_path):
    (tmp_path / "p.txt").write_text("0 0 0 0 0 0 1\n1 0 0 0 0 0 0\n")
    found = read_poses(tmp_path / "p.txt")
    assert reason(found, 1) == "bad_pose_file"
    assert reason(found, 2) == reason(found, -1) == "no_pose"


@pytest.mark.parametrize("word", ["nan", "-inf"])
def test_poses_that_are_no_numbers_are_handed_on(tmp_path, word):
    (tmp_path / "p.txt").write_text(matrix_line(np.eye(4)) + f"{word} " * 16 + "\n")
    assert not np.isfinite(read_poses(tmp_path / "p.txt").at(1)).any()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no form of poses"),
        ("\n# nothing\n", "no form of poses"),
        ("1 2 3\n", "3 numbers"),
        ("1 2 3 4\n1 2 3 4\n", "4 numbers"),
        ("1 2\n1 2 3 4 5 6 7 8\n", "2, 8 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\nx\n", "p.txt:2: "),
        ("0 0 0 0 0 0 0\n", "quaternion of length zero"),
    ],
)
def test_what_is_wrong_is_named_in_a_short_line(tmp_path, text, words):
    (tmp_path / "p.txt").write_text(text)
    with pytest.raises(SourceError, match=words) as refused:
        read_poses(tmp_path / "p.txt")
    assert str(tmp_path / "p.txt") in str(refused.value)
    assert len(str(refused.value).replace(str(tmp_path), "")) <= 300


def test_files_and_folders_that_are_not_there(tmp_path):
    for path in (tmp_path / "none.txt", tmp_path / "none.npy", tmp_path / "none.json", tmp_path):
        with pytest.raises(SourceError, match=str(path)):
            read_poses(path)
    with pytest.raises(FrameRefused) as refused:
        read_pose(tmp_path / "1.txt")
    assert refused.value.reason == "no_pose"


@pytest.mark.parametrize(
    ("stamps", "numbers"), [("0 1 5", [0, 1, 5]), ("0.5 1 5", None), ("1305031102 1305031103", None)]
)
def test_whole_small_stamps_are_numbers_of_images(tmp_path, stamps, numbers):
    (tmp_path / "p.txt").write_text("".join(tum_line(stamp, np.eye(4)) for stamp in stamps.split()))
    assert image_numbers(read_poses(tmp_path / "p.txt")) == numbers


@pytest.mark.parametrize(("axes", "forward"), [("optical", (0, 0, 1)), ("opengl", (0, 0, -1)), ("ros", (1, 0, 0))])
@pytest.mark.parametrize("inverted", [False, True])
def test_axes_and_inversion(axes, forward, inverted):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).as_matrix(), (1, 2, 3)
    found = in_optical_axes(np.linalg.inv(T) if inverted else T, axes, inverted)
    np.testing.assert_allclose(found[:3, 2], T[:3, :3] @ forward, atol=1e-12)
    np.testing.assert_allclose(found[:3, 3], T[:3, 3], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(found), 1)


def test_the_last_number_of_a_name_counts():
    assert sorted(["frame10.png", "frame9.png", "cam1_2.png", "x.png"], key=number_in) == [
        "x.png", "cam1_2.png", "frame9.png", "frame10.png",
    ]  # fmt: skip


STAMPS = [1_403_715_278_762_142_976 + k * 50_000_000 for k in range(4)]


def rows_of(poses, order="xyzw"):
    """Positions and quaternions of poses, as text, by scipy."""
    quaternions = [dict(zip("xyzw", Rotation.from_matrix(T[:3, :3]).as_quat(), strict=True)) for T in poses]
    return [[*map(str, T[:3, 3]), *(str(q[k]) for k in order)] for T, q in zip(poses, quaternions, strict=True)]


def timed_forms():
    """Files as their programs write them: name, heading, separator, rows; times in nanoseconds unless said."""
    xyzw, wxyz, zero = rows_of(posed()), rows_of(posed(), "wxyz"), ["0.1", "0.2", "0.3"]
    matrices = [list(map(str, T[:3].ravel())) for T in posed()]
    vectors = [[*map(str, Rotation.from_matrix(np.linalg.inv(T)[:3, :3]).as_rotvec()),
                *map(str, np.linalg.inv(T)[:3, 3])] for T in posed()]  # fmt: skip
    euroc = "#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    euroc += "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1]"
    okvis = "timestamp, p_WS_W_x, p_WS_W_y, p_WS_W_z, q_WS_x, q_WS_y, q_WS_z, q_WS_w, v_WS_W_x, v_WS_W_y, v_WS_W_z, "
    okvis += "b_g_x, b_g_y, b_g_z, b_a_x, b_a_y, b_a_z"
    aria = "graph_uid,tracking_timestamp_us,utc_timestamp_ns," + ",".join(f"t{k}_world_device" for k in "xyz")
    aria += "," + ",".join(f"q{k}_world_device" for k in "xyzw") + ",device_linear_velocity_x_device"
    echo = "%time,field.header.seq,field.header.stamp,field.header.frame_id,field.child_frame_id,"
    echo += ",".join(f"field.pose.pose.position.{k}" for k in "xyz") + ","
    echo += ",".join(f"field.pose.pose.orientation.{k}" for k in "xyzw") + ",field.pose.covariance0,"
    echo += ",".join(f"field.twist.twist.linear.{k}" for k in "xyz")
    vins = "# timestamp(s) tx ty tz qx qy qz qw Pr11 Pr12 Pr13 Pr22 Pr23 Pr33 Pt11 Pt12 Pt13 Pt22 Pt23 Pt33"
    ns, ms = list(map(str, STAMPS)), [str(stamp // 10**6) for stamp in STAMPS]
    split = [[str(stamp // 10**9), str(stamp % 10**9)] for stamp in STAMPS]
    seconds = [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in STAMPS]
    both = list(zip(ns, xyzw, wxyz, strict=True))
    return {
        "EuRoC": (euroc, ",", [[t, *w, *zero, "0.5"] for t, _, w in both]),
        "rostopic -p": (echo, ",", [[f"{t[:-8]}99999999", "7", t, "odom", "base", *q, "0.01", *zero]
                               for t, q, _ in both]),
        "AirSim": ("VEHICLE TIMESTAMP POS_X POS_Y POS_Z Q_W Q_X Q_Y Q_Z ImageFile".replace(" ", "\t"), "\t",
                   [["", t, *w, "img_0.png"] for t, w in zip(ms, wxyz, strict=True)]),
        "OpenVINS": (vins, " ", [[t, *q, *["0.01"] * 12] for t, q in zip(seconds, xyzw, strict=True)]),
        "Newer College": ("#sec,nsec,x,y,z,qx,qy,qz,qw", ",", [[*t, *q] for t, q in zip(split, xyzw, strict=True)]),
        "the same without a heading": ("", " ", [[*t, *q] for t, q in zip(split, xyzw, strict=True)]),
        "OpenVINS without its heading": ("", " ", [[t, *q, *["0.01"] * 12]
                                                   for t, q in zip(seconds, xyzw, strict=True)]),
        "OKVIS": (okvis, ", ", [[t, *q, *zero, *zero, *zero] for t, q, _ in both]),
        "Aria": (aria, ",", [["1f-2", str(int(t) // 1000), t, *q, "0"] for t, q, _ in both]),
        "TUM's columns named": ("timestamp,x,y,z,qx,qy,qz,qw", ",", [[t, *q] for t, q, _ in both]),
        "VINS": ("", ",", [[t, *w, *zero, ""] for t, _, w in both]),
        "VINS after loops": ("", ",", [[t, *w, ""] for t, _, w in both]),
        "TUM with commas": ("", ",", [[t, *q] for t, q in zip(seconds, xyzw, strict=True)]),
        "MulRan": ("", ",", [[t, *m] for t, m in zip(ns, matrices, strict=True)]),
        "ARKit": ("", " ", [[t, *v] for t, v in zip(seconds, vectors, strict=True)]),
        "TUM in nanoseconds": ("", " ", [[t, *q] for t, q, _ in both]),
        "TUM in microseconds": ("", " ", [[str(int(t) // 1000), *q] for t, q, _ in both]),
        "TUM in milliseconds": ("", " ", [[t, *q] for t, q in zip(ms, xyzw, strict=True)]),
    }  # fmt: skip


@pytest.mark.parametrize("name", timed_forms())
def test_poses_over_time_by_their_columns(tmp_path, name):
    heading, separator, rows = timed_forms()[name]
    path = tmp_path / ("poses.traj" if name == "ARKit" else "poses.csv")
    path.write_text(f"{heading}\n" * bool(heading) + "".join(f"{separator.join(row)}\n" for row in rows))
    found = read_poses(path)
    assert isinstance(found, Poses)
    np.testing.assert_allclose(found.stamps_ns, STAMPS, atol=1e6, rtol=0)
    np.testing.assert_allclose(found.T_world_body, posed(), atol=1e-8)


def test_poses_with_numbers(tmp_path):
    lines = {
        "KITTI-360": "".join(f"{7 * k} {matrix_line(T, 3)}" for k, T in enumerate(posed())),
        "its cameras": "".join(f"{7 * k} {matrix_line(T)}" for k, T in enumerate(posed())),
    }
    for name, text in lines.items():
        (tmp_path / "p.txt").write_text(text)
        found = read_poses(tmp_path / "p.txt")
        assert isinstance(found, ImagePoses), name
        assert found.numbers == [0, 7, 14, 21]
        np.testing.assert_allclose([found.at(k) for k in range(4)], posed(), atol=1e-9)
    graph = "".join(f"VERTEX_SE3:QUAT {k} {' '.join(row)}\n" for k, row in enumerate(rows_of(posed())))
    (tmp_path / "graph.g2o").write_text(f"{graph}FIX 0\nEDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {'1 ' * 21}\n")
    np.testing.assert_allclose([read_poses(tmp_path / "graph.g2o").at(k) for k in range(4)], posed(), atol=1e-8)


def test_a_confidence_is_no_nanosecond_and_seven_numbers_are_a_quaternion(tmp_path):
    (tmp_path / "t.txt").write_text("".join(f"{k}.5 {' '.join(row)} 3\n" for k, row in enumerate(rows_of(posed()))))
    found = read_poses(tmp_path / "t.txt")
    assert isinstance(found, Poses)
    assert found.stamps_ns.tolist() == [500_000_000 + k * 10**9 for k in range(4)]


@pytest.mark.parametrize("vertex", ["VERTEX_SE3:QUAT 1 0 0 0 0 0 1", "VERTEX_SE3:QUAT 1 0 0 zero 0 0 0 1"])
def test_a_damaged_vertex_of_a_graph_is_not_left_out(tmp_path, vertex):
    """The poses after it would be those of other images."""
    (tmp_path / "graph.g2o").write_text(f"VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1\n{vertex}\n")
    with pytest.raises(SourceError, match="correct"):
        read_poses(tmp_path / "graph.g2o")


def test_a_graph_is_read_in_the_order_of_its_ids(tmp_path):
    """g2o keeps vertices in a hash table and writes them in any order."""
    lines = [f"VERTEX_SE3:QUAT {7 * k} {' '.join(row)}\n" for k, row in enumerate(rows_of(posed()))]
    (tmp_path / "graph.g2o").write_text("".join(lines[k] for k in (2, 0, 3, 1)))
    found = read_poses(tmp_path / "graph.g2o")
    np.testing.assert_allclose([found.at(k) for k in range(4)], posed(), atol=1e-8)
    (tmp_path / "graph.g2o").write_text("".join([*lines, lines[1]]))
    with pytest.raises(SourceError, match="one id"):
        read_poses(tmp_path / "graph.g2o")


def test_a_heading_may_number_the_images(tmp_path):
    rows = [f"{9 * k};{';'.join(row)}\n" for k, row in enumerate(rows_of(posed(), "wxyz"))]
    (tmp_path / "poses.csv").write_text("frame;x;y;z;qw;qx;qy;qz\n" + "".join(rows))
    found = read_poses(tmp_path / "poses.csv")
    assert found.numbers == [0, 9, 18, 27]
    np.testing.assert_allclose([found.at(k) for k in range(4)], posed(), atol=1e-8)


AMBIGUOUS = {
    "time, place, angles": ("timestamp,x,y,z,roll,pitch,yaw", [1.5, 2, 3, 4, 0.1, 0.2, 0.3], "no quaternion"),
    "the same without a heading": ("", [1.5, 2, 3, 4, 0.1, 0.2, 0.3], "no quaternions"),
    "places alone": ("#timestamp [ns], p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m]", [1.5, 2, 3, 4], "no quaternion"),
    "places alone without a heading": ("", [1.5, 2, 3, 4], "do not rotate"),
    "quaternions in an unknown order": ("t x y z q[0] q[1] q[2] q[3]", [1, 2, 3, 4, 1, 0, 0, 0], "no quaternion"),
    "unknown names": ("a,b,c,d,e,f,g,h", [1, 2, 3, 4, 0, 0, 0, 1], "names no position"),
    "17 numbers": ("", list(range(17)), "do not rotate"),
    "a graph in a plane": ("VERTEX_SE2 1 2 3 0.1", [], "graph without"),
    "angles of a confidence": ("", [1.5, 2, 3, 4, 0.1, 0.2, 0.3, 1.5], "no quaternions"),
}


@pytest.mark.parametrize("name", AMBIGUOUS)
def test_columns_that_may_mean_anything_are_refused(tmp_path, name):
    """Each of them was read as poses of another form: a map of garbage without a word."""
    heading, row, said = AMBIGUOUS[name]
    rows = [[number + k * (1.1 if j else 1) for j, number in enumerate(row)] for k in range(12)] if row else []
    if "quaternions in" in name or name == "unknown names":
        rows = [row] * 12
    text = "".join(f"{' '.join(map(str, row))}\n" for row in rows)
    (tmp_path / "p.txt").write_text(
        f"{heading}\n" * bool(heading) + (text.replace(" ", ",") if "," in heading else text)
    )
    with pytest.raises(SourceError, match=said) as error:
        read_poses(tmp_path / "p.txt")
    assert ";" in str(error.value)


def test_a_path_without_quaternions_is_no_cloud(tmp_path):
    (tmp_path / "p.csv").write_text("timestamp,x,y,z,roll,pitch,yaw\n" + "1.5,2,3,4,0.1,0.2,0.3\n" * 9)
    with pytest.raises(SourceError, match="no quaternion"):
        describe(tmp_path / "p.csv")
    for name in ("graph.g2o", "a.traj"):
        rows = [
            f"{k} 0.1 0.2 0.3 {k} 2 3" if "traj" in name else f"VERTEX_SE3:QUAT {k} {k} 2 3 0 0 0 1" for k in range(9)
        ]
        (tmp_path / name).write_text("\n".join(rows))
        assert describe(tmp_path / name).kind == "poses"
