# SPDX-License-Identifier: Apache-2.0
"""One target per parser, all alike: bytes go into a file, a reader reads it, and only StereovoxError may be raised.

If plain bytes would fail at a checksum or an index, the bytes are the content behind it (a message, the cells of a map)
and the target writes a valid file around them.
"""

from __future__ import annotations

import bz2
import json
import sqlite3
import struct
import tempfile
import zlib
from collections.abc import Callable
from contextlib import closing
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from made_asl import START, asl, poses_csv, sensor_text
from made_bags import ros_bag
from made_depth import posed, sens
from made_kitti import label, packet, pose_lines, raw_calibration, single_calibration
from made_mcap import Message, Style, mcap
from made_recordings import depth_image, write_png
from made_rigs import FORWARD, eyes, recorded
from made_robot_bags import START_NS, Messages, RobotBagMaker, planar_numbers
from numcodecs import Zstd

from mutate import with_right_sums
from stereovox.config import load_config
from stereovox.errors import StereovoxError
from stereovox.evaluate.inputs import read_camera_path
from stereovox.evaluate.trajectory import read_relations
from stereovox.files.safe_io import SEAL, _digest, sealed, unsealed
from stereovox.formats import export, read_octomap
from stereovox.formats.bags import read_bag_grid, read_bag_map
from stereovox.formats.cell_size import raised
from stereovox.formats.clouds import read_cloud_map
from stereovox.formats.map_server import read_map_server, write_map_server
from stereovox.formats.points import read_npz
from stereovox.formats.scan_graph import read_scan_graph
from stereovox.maps import VoxelMap, load_map, save_boxed
from stereovox.maps.grid_map import GridMap, load_grid
from stereovox.maps.occupancy import OccupancyGrid
from stereovox.opening import open_source
from stereovox.sources import photos
from stereovox.sources.calibration.calibration_files import import_rig
from stereovox.sources.calibration.camera_file import find_camera, read_camera
from stereovox.sources.kitti.calibration import read_calibration, read_raw_calibration
from stereovox.sources.kitti.poses import read_oxts_file, read_pose_file
from stereovox.sources.kitti.tracking import read_labels
from stereovox.sources.lidar import read_velodyne
from stereovox.sources.poses.tracker import read_tracker
from stereovox.sources.rgbd.depth_files import read_depth
from stereovox.sources.rgbd.pose_files import read_poses
from stereovox.sources.rigs.pair_file import PairSettings, pair_text, read_pair
from stereovox.sources.rigs.rig_file import read_rig
from stereovox.sources.robots.bag import RobotBag
from stereovox.sources.robots.carmen import CarmenLog

MAX_FRAMES = 20
SIZE = (16, 12)
POSES = "# stamp tx ty tz qx qy qz qw\n" + "".join(f"{k / 10:.9f} {k} 0 1 0 0 0.1 1\n" for k in range(4))
KALIBR = """cam0: &left
  camera_model: pinhole
  distortion_model: radtan
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.0005]
  intrinsics: [500.0, 501.0, 322.0, 238.0]
  resolution: [640, 480]
cam1:
  <<: *left
  T_cn_cnm1: [[1, 0, 0, -0.12], [0, 1, 0, 0.0], [0, 0, 1, 0], [0, 0, 0, 1.0]]
"""
OPENCV = """%YAML:1.0
---
M1: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [500., 0., 320., 0., 500., 240., 0., 0., 1.]}
D1: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.3, 0.1, 0., 0., 0.]}
M2: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [500., 0., 320., 0., 500., 240., 0., 0., 1.]}
D2: !!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.3, 0.1, 0., 0., 0.]}
R: !!opencv-matrix {rows: 3, cols: 3, dt: d, data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]}
T: !!opencv-matrix {rows: 3, cols: 1, dt: d, data: [-0.12, 0., 0.]}
imageSize: [640, 480]
"""
PLACE = "[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]"
OPENVINS = KALIBR.replace("T_cn_cnm1: [[1, 0, 0, -0.12]", "T_imu_cam: [[1, 0, 0, 0.12]").replace(
    "cam1:", f"  T_imu_cam: {PLACE}\ncam1:"
)
ORB = f"""%YAML:1.0
Camera.type: "KannalaBrandt8"
Camera.width: 640
Camera.height: 480
Camera1.fx: 250.0
Camera1.fy: 250.0
Camera1.cx: 320.0
Camera1.cy: 240.0
Camera1.k1: 0.01
Camera2.fx: 250.0
Camera2.fy: 250.0
Camera2.cx: 320.0
Camera2.cy: 240.0
Stereo.T_c1_c2: !!opencv-matrix
   rows: 4
   cols: 4
   dt: f
   data:{PLACE.replace("1, 0, 0, 0,", "1, 0, 0, 0.1,", 1)}
"""
LENS = "image_dimension: [640, 480], distortion_type: radialtangential, focal_length: [5, 5], principal_point: [3, 2]"
OKVIS = f"""cameras:
  - {{T_SC: {PLACE}, {LENS}}}
  - {{T_SC: {PLACE.replace("1, 0, 0, 0,", "1, 0, 0, 0.1,", 1)}, {LENS}}}
"""
SENSOR = sensor_text(eyes().left, FORWARD, "equidistant")
TRUTH = "state_groundtruth_estimate0/data.csv"
TWO_VIEW = """cam0=[20 0 7.5; 0 20 5.5; 0 0 1]
cam1=[20 0 8.5; 0 20 5.5; 0 0 1]
doffs=1
baseline=193.001
width=16
height=12
ndisp=290
"""
PROFILE = """voxel_size = 0.1
max_range = 8.0
steps = [0.1, 0.1, 0.05]
[sensor]
model = "stereo"
p_free = 0.4
[window]
size = [20, 20, 5]
outside = "keep"
[map]
cell = "int8"
[sphere]
step_deg = 1.5
"""
MAP_YAML = """image: map.pgm
mode: trinary
resolution: 0.05
origin: [-1.0, -2.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
METADATA = """rosbag2_bagfile_information:
  version: 9
  storage_identifier: mcap
  relative_file_paths: [part_0.mcap]
  topics_with_message_count: []
"""
FLASER = b"PARAM robot_frontlaser_offset 0.1\nFLASER 3 1.0 2.0 81.9 0 0 0 0.1 0.2 0.3 976052857.3 nohost 0.1\n"
ROBOTLASER = b"ROBOTLASER1 0 -1.57 3.14 0.5 30.0 0.01 0 3 1.0 2.0 31 0 0 0 0 0 0 0 0 0 0 0 0 976052857.3 nohost 0.1\n"
IMAGE_KINDS = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/CameraInfo",
               "tf2_msgs/msg/TFMessage", "geometry_msgs/msg/PoseStamped", "nav_msgs/msg/Odometry")  # fmt: skip
ROBOT_KINDS = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/PointCloud2", "nav_msgs/msg/Odometry",
               "tf2_msgs/msg/TFMessage")  # fmt: skip


class Target(NamedTuple):
    """seeds: inputs to mutate, made in an empty folder. read: reader of a file with such bytes."""

    seeds: Callable[[Path], list[bytes]]
    read: Callable[[bytes, Path], Any]


def file_target(name: str, reader: Callable[[Path], Any], *seeds: str | bytes) -> Target:
    """Return a target whose bytes are the file `name` as it is."""

    def read(data: bytes, folder: Path) -> Any:
        (folder / name).write_bytes(data)
        return reader(folder / name)

    return Target(lambda _: [seed.encode() if isinstance(seed, str) else seed for seed in seeds], read)


def frames_of(source: Any) -> None:
    """Read the first frames; a fault must be one line, and a frame without one must have its camera's size."""
    for i in range(min(len(source), MAX_FRAMES)):
        frame = source.frame(i) if hasattr(source, "frame") else source[i]
        assert frame.fault_detail.isprintable(), "a fault of several lines"
        if frame.fault is None and hasattr(frame, "depth"):
            assert frame.depth.shape == (frame.camera.height, frame.camera.width)


# maps ---------------------------------------------------------------------------------------------------------------


@cache
def small_map() -> VoxelMap:
    cells = [(x, y, z) for x in range(-3, 9) for y in (0, 9) for z in (-1, 20)]
    made = VoxelMap.from_cells(load_config(voxel_size=0.1), cells, np.linspace(-4, 3, len(cells)))
    made.frames, made.recording = 3, "sim:room"
    return made


def saved(folder: Path) -> Path:
    """Return the small map, saved once in `folder`."""
    path = folder / "sound.svox"
    if not path.exists():
        small_map().save(path)
    return path


def read_manifest(data: bytes, folder: Path) -> None:
    path = saved(folder)
    whole = (path / "manifest.json").read_bytes()
    try:
        (path / "manifest.json").write_bytes(_resealed(data.replace(b"DATA", unsealed(whole)["data"].encode())))
        load_map(path)
    finally:
        (path / "manifest.json").write_bytes(whole)


def manifests(folder: Path) -> list[bytes]:
    whole = (saved(folder) / "manifest.json").read_bytes()
    return [whole.replace(unsealed(whole)["data"].encode(), b"DATA")]


def _resealed(data: bytes) -> bytes:
    """Give a damaged manifest its new digest, so that its reader reaches the damage."""
    begun = SEAL.match(data)
    return data if begun is None else b'{"digest": "%s", ' % _digest(data[begun.end() :]) + data[begun.end() :]


PIECES = ("coords/zarr.json", "coords/c/0/0", "cells/zarr.json", "cells/c/0/0", "zarr.json")


def read_piece(data: bytes, folder: Path) -> None:
    """The first byte selects the array file that gets the others."""
    path = next(saved(folder).glob("cells-[0-9a-f]*")) / PIECES[data[0] % len(PIECES) if data else 0]
    whole = path.read_bytes()
    try:
        path.write_bytes(data[1:])
        load_map(saved(folder))
    finally:
        path.write_bytes(whole)


def pieces(folder: Path) -> list[bytes]:
    inner = next(saved(folder).glob("cells-[0-9a-f]*"))
    return [bytes([k]) + (inner / piece).read_bytes() for k, piece in enumerate(PIECES)]


def read_cells(data: bytes, folder: Path) -> None:
    """The bytes are coordinates (12 each) and cells of two kinds, in an otherwise valid folder."""
    coords = np.frombuffer(data[: len(data) // 12 * 12], "<i4").reshape(-1, 3)
    cells = np.resize(np.frombuffer(data or b"\0", np.uint8), (len(coords), 512)).astype(np.int16) * 131
    path = saved(folder)
    whole = (path / "manifest.json").read_bytes()
    manifest = unsealed(whole)
    manifest |= {"data": "cells-made", "blocks": len(coords), "checksum": [zlib.crc32(coords), zlib.crc32(cells)]}
    for name, array in (("coords", coords), ("cells", cells)):
        told = json.loads((next(path.glob("cells-[0-9a-f]*")) / name / "zarr.json").read_text())
        told["chunk_grid"]["configuration"]["chunk_shape"] = [max(1, len(array)), array.shape[1]]
        (path / "cells-made" / name / "c/0").mkdir(parents=True, exist_ok=True)
        (path / "cells-made" / name / "zarr.json").write_text(json.dumps(told | {"shape": array.shape}))
        (path / "cells-made" / name / "c/0/0").write_bytes(Zstd().encode(array.tobytes()))
    try:
        (path / "manifest.json").write_bytes(sealed(manifest))
        loaded = load_map(path)
        assert len(loaded.storage.blocks()[0]) <= len(coords)
    finally:
        (path / "manifest.json").write_bytes(whole)


def boxed(folder: Path) -> Path:
    """Return the small map in boxes, saved once in `folder`."""
    path = folder / "boxed.svox"
    if not path.exists():
        save_boxed(small_map(), path, 0.8)
    return path


def boxed_manifests(folder: Path) -> list[bytes]:
    return [(boxed(folder) / "manifest.json").read_bytes()]


def read_boxed(data: bytes, folder: Path) -> None:
    path = boxed(folder) / "manifest.json"
    whole = path.read_bytes()
    try:
        path.write_bytes(_resealed(data))
        loaded = load_map(path.parent)
        loaded.storage.blocks()
        loaded.overview(100)
    finally:
        path.write_bytes(whole)


def shards(folder: Path) -> list[bytes]:
    files = sorted(boxed(folder).glob("boxes/0/*/*/c/0/0"))[:4]
    return [bytes([n]) + file.read_bytes() for n, file in enumerate(files)]


def read_shard(data: bytes, folder: Path) -> None:
    """The first byte selects the box file that gets the others; the manifest has its correct checksum and size."""
    files = sorted(boxed(folder).glob("boxes/0/*/*/c/0/0"))
    file, path = files[data[0] % len(files) if data else 0], boxed(folder) / "manifest.json"
    whole, manifest = file.read_bytes(), path.read_bytes()
    told = unsealed(manifest)
    entry = next(one for one in told["boxes"] if one["name"].endswith(file.parts[-5]))
    entry["checksum"][("coords", "cells").index(file.parts[-4])] = zlib.crc32(data[1:])
    entry["bytes"] += len(data)
    try:
        file.write_bytes(data[1:])
        path.write_bytes(sealed(told))
        load_map(path.parent).storage.blocks()
    finally:
        file.write_bytes(whole)
        path.write_bytes(manifest)


def some_coords(_: Path) -> list[bytes]:
    return [np.array([[0, 0, 0], [1, 2, 3], [-5, 7, 100]], "<i4").tobytes()]


@cache
def small_grid() -> GridMap:
    cells = np.full((70, 65), -1, np.int8)
    cells[3:9, 5:60], cells[10, 5:60] = 0, 100
    return GridMap.from_occupancy(OccupancyGrid(cells, 0.05, (1.0, 2.0, 0.0)), load_config(dimensions=2))


def grids(folder: Path) -> list[bytes]:
    small_grid().save(folder / "a.npz")
    return [(folder / "a.npz").read_bytes()]


def read_about(data: bytes, folder: Path) -> None:
    coords, cells = small_grid().storage.tiles()
    np.savez_compressed(folder / "b.npz", about=np.frombuffer(_resealed(data), np.uint8), coords=coords, cells=cells)
    load_grid(folder / "b.npz")


def abouts(folder: Path) -> list[bytes]:
    small_grid().save(folder / "a.npz")
    with np.load(folder / "a.npz") as parts:
        return [parts["about"].tobytes()]


def trees(folder: Path) -> list[bytes]:
    for name in ("a.bt", "a.ot"):
        export(small_map(), folder / name)
    return [(folder / name).read_bytes() for name in ("a.bt", "a.ot")]


def read_tree(data: bytes, folder: Path) -> None:
    """The bytes are the nodes of a tree; title and size are correct. An odd first byte: `.ot`."""
    ot, body = bool(data and data[0] % 2), data[1:]
    nodes = len(body) // 5 if ot else 1 + sum(byte >> shift & 3 == 3 for byte in body for shift in (0, 2, 4, 6))
    nodes += 0 if ot else sum(byte >> shift & 3 in (1, 2) for byte in body for shift in (0, 2, 4, 6))
    title = "# Octomap OcTree file" if ot else "# Octomap OcTree binary file"
    (folder / "tree").write_bytes(f"{title}\nid OcTree\nsize {nodes}\nres 0.1\ndata\n".encode() + body)
    read_octomap(folder / "tree")


def bodies(folder: Path) -> list[bytes]:
    return [bytes([k]) + tree.partition(b"data\n")[2] for k, tree in enumerate(trees(folder))]


def read_yaml(data: bytes, folder: Path) -> None:
    (folder / "map.pgm").write_bytes(b"P5\n2 2\n255\n\0\xcd\xfe\xfe")
    (folder / "map.yaml").write_bytes(data)
    raised(read_map_server(folder / "map.yaml"), (0.0, 0.2))


def read_picture(data: bytes, folder: Path) -> None:
    (folder / "map.yaml").write_text(MAP_YAML.replace("trinary", "scale"))
    for fixed in {data, with_right_sums(data)}:
        (folder / "map.pgm").write_bytes(fixed)
        read_map_server(folder / "map.yaml")


def pictures(folder: Path) -> list[bytes]:
    grid = OccupancyGrid(np.array([[0, 100, -1]] * 5, np.int8), 0.05, (0, 0, 0))
    write_map_server(grid, folder / "a.pgm")
    write_map_server(grid, folder / "a.png", "scale")
    plain = b"P2\n# plain\n3 2\n255\n0 205 254 255 0 0\n"
    return [(folder / "a.pgm").read_bytes(), (folder / "a.png").read_bytes(), plain]


def exported(ending: str, folder: Path) -> list[bytes]:
    export(small_map(), folder / f"a{ending}")
    return [(folder / f"a{ending}").read_bytes()]


def read_settings(data: bytes, folder: Path) -> None:
    """The settings in an otherwise valid file of cells."""
    export(small_map(), folder / "s.npz")
    with np.load(folder / "s.npz") as parts:
        np.savez(folder / "s.npz", **(dict(parts) | {"settings": np.frombuffer(data, np.uint8)}))
    read_npz(folder / "s.npz")


def settings(_: Path) -> list[bytes]:
    return [json.dumps(small_map().config.model_dump()).encode()]


def text_points(_: Path) -> list[bytes]:
    rows = b"1 2 3\n-4 5.5 nan\n"
    ply = (
        b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty double z\nend_header\n"
    )
    pcd = b"# .PCD v0.7\nFIELDS x y z\nSIZE 4 4 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 1\nPOINTS 2\nDATA ascii\n"
    columns = np.array([1, 2, 3, 4], "<f4").tobytes() + np.array([5.0, 6.0]).tobytes()
    packed = b"\x1f" + columns  # a run of 32 bytes
    compressed = pcd.replace(b"ascii", b"binary_compressed") + struct.pack("<II", len(packed), len(columns)) + packed
    return [ply + rows, pcd + rows, compressed]


ROWS = (
    "x,y,z\n" + "".join(f"{k % 5}.5,{k // 5},0.25\n" for k in range(20)),
    "// a comment\n12\n" + "".join(f"{k} {-k} 1e1 0 0\n" for k in range(12)),
    "i;Z;Y;X [m]\n" + "".join(f"0;{k};2;{k * k}\n" for k in range(12)),
)
POSE = struct.pack("<i3di4dI", 3, 1, 0, 1, 4, 0.7, 0, 0, 0.7, 1)
GRAPHS = (
    "# scans\nNODE 0 0 1 0 0.1 0.2\n1 2 3\n 9\n2 1 0.5\nNODE 1 0 1 0 0 3\n1 1 1\n",
    struct.pack("<II", 2, 2) + struct.pack("<i3d", 3, 1, 2, 3) * 2 + POSE
    + struct.pack("<I", 1) + struct.pack("<i3d", 3, 2, 1, 0) + POSE
    + struct.pack("<I", 0),
)  # fmt: skip


def surveys(ending: str, folder: Path) -> list[bytes]:
    import laspy

    steps = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0), [1.0]), axis=-1).reshape(-1, 3)
    text = 'PROJCS["x",GEOGCS["y",UNIT["degree",0.017]],UNIT["foot",0.3048]]'
    found = []
    for version, kind in (("1.2", 3), ("1.4", 6)):
        header = laspy.LasHeader(version=version, point_format=kind)
        header.scales = [0.01] * 3
        if kind == 6:
            header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(text))
        made = laspy.LasData(header)
        made.x, made.y, made.z = steps.T
        made.write(str(folder / f"seed{ending}"))
        found.append((folder / f"seed{ending}").read_bytes())
    return found


def read_survey(name: str, data: bytes, folder: Path) -> None:
    file_target(name, lambda path: read_cloud_map(path, 0.5)).read(data, folder)


def meshes(kind: str, _: Path) -> list[bytes]:
    import trimesh

    made = trimesh.creation.box((2.0, 1.0, 0.6)).export(file_type=kind)
    return [made.encode() if isinstance(made, str) else made]


# bags ---------------------------------------------------------------------------------------------------------------


def read_bag(name: str, data: bytes, folder: Path) -> None:
    (folder / name).write_bytes(data)
    refused = []
    for opened in (lambda: [open_source(folder / name)], lambda: [(bag := RobotBag(folder / name)).scans, bag.frames]):
        try:
            for frames in opened():
                frames_of(frames)
        except StereovoxError as error:
            refused.append(error)
    if len(refused) == 2:
        raise refused[0]


def ros1_bags(folder: Path) -> list[bytes]:
    made = [ros_bag(folder / f"{packed}.bag", 2, packed).read_bytes() for packed in ("", "lz4", "bz2")]
    with RobotBagMaker(folder / "robot.bag") as bag:
        bag.scans(2)
        bag.tf(START_NS, "odom", "base_link", planar_numbers(1, 2, 0.1))
    return [*made, (folder / "robot.bag").read_bytes()]


def db3_bags(folder: Path) -> list[bytes]:
    with RobotBagMaker(folder / "robot.db3") as bag:
        bag.scans(2)
        bag.depth(2)
        bag.tf(START_NS, "odom", "base_link", planar_numbers(1, 2, 0.1))
    return [bag.path.read_bytes()]


@cache
def messages() -> list[tuple[str, str, bytes]]:
    """Topic, type and bytes of matching messages."""
    ros = Messages(2)
    edges = (
        (START_NS, "odom", "base_link", planar_numbers(1, 2, 0.1)),
        (START_NS, "base_link", "laser", [0.0] * 6 + [1.0]),
    )
    pixels = 1000 + np.arange(48, dtype=np.uint16).reshape(6, 8)
    made = {
        "/scan": ("sensor_msgs/LaserScan", ros.scan(START_NS, [1.0, 2.0, 3.0])),
        "/points": ("sensor_msgs/PointCloud2", ros.cloud(START_NS, [[1, 2, 0.3], [2, 1, 0.2]])),
        "/odom": ("nav_msgs/Odometry", ros.odometry(START_NS, planar_numbers(1, 2, 0.1))),
        "/tf": ("tf2_msgs/TFMessage", ros.transforms(*edges)),
        "/depth/image": ("sensor_msgs/Image", ros.image(START_NS, pixels, "optical")),
        "/depth/camera_info": ("sensor_msgs/CameraInfo", ros.camera_info(START_NS, 8, 6)),
    }
    return [(topic, kind.replace("/", "/msg/"), ros.raw(kind, message)) for topic, (kind, message) in made.items()]


def mcap_bags(folder: Path) -> list[bytes]:
    types = {topic: kind for topic, kind, _ in messages()}
    said = [Message(topic, START_NS + k, data) for k, (topic, _, data) in enumerate(messages())]
    styles = (Style(), Style("zstd", crc=True), Style("lz4", summary=False), Style(chunk=0, summary=False))
    return [mcap(folder / "a.mcap", types, said, style).read_bytes() for style in styles]


def read_message(data: bytes, folder: Path) -> None:
    """The first byte selects the message that gets the others; the file around them is valid."""
    number = data[0] % len(messages()) if data else 0
    types = {topic: kind for topic, kind, _ in messages()}
    said = [
        Message(topic, START_NS + k, data[1:] if k == number else sound)
        for k, (topic, _, sound) in enumerate(messages())
    ]
    read_bag(
        "message.mcap", mcap(folder / "made.mcap", types, said, Style(chunk=0, summary=False)).read_bytes(), folder
    )


@cache
def map_messages() -> list[tuple[str, bytes]]:
    """Type and bytes of messages of finished maps."""
    with tempfile.TemporaryDirectory() as folder:
        export(small_map(), Path(folder) / "a.db3", (-1, 3))
        with closing(sqlite3.connect(Path(folder) / "a.db3")) as file:
            query = "SELECT type, data FROM topics JOIN messages ON topics.id = topic_id ORDER BY type"
            return file.execute(query).fetchall()


def read_map_message(data: bytes, folder: Path) -> None:
    """The first byte selects the message type of the others; the file around it is valid."""
    kind, _ = map_messages()[data[0] % len(map_messages()) if data else 0]
    path = mcap(folder / "map.mcap", {"/a": kind}, [Message("/a", START_NS, data[1:])], Style(chunk=0, summary=False))
    if kind.endswith("OccupancyGrid"):
        read_bag_grid(path)
    else:
        read_bag_map(path, 0.1 if kind.endswith("PointCloud2") else None, "/a")


def read_metadata(data: bytes, folder: Path) -> None:
    bag = folder / "bag"
    if not bag.exists():
        bag.mkdir()
        (bag / "part_0.mcap").write_bytes(mcap_bags(folder)[0])
    (bag / "metadata.yaml").write_bytes(data)
    frames_of(open_source(bag))


# images and texts -----------------------------------------------------------------------------------------------------


def read_png(reader: Callable[..., Any], data: bytes, folder: Path) -> None:
    path = folder / "a.png"
    for fixed in {data, with_right_sums(data)}:
        path.write_bytes(fixed)
        image = reader(path, SIZE)
        assert image.shape[:2] == SIZE[::-1]


def depth_pngs(folder: Path) -> list[bytes]:
    write_png(folder / "s.png", depth_image(1))
    return [(folder / "s.png").read_bytes()]


def depth_files(folder: Path) -> list[bytes]:
    """Depth as PGM, PFM, TIFF and NumPy arrays; a packed PNG has its own checksums to pass (`depth_png`)."""
    image = depth_image(1)
    for name, pixels in (("s.pgm", image), ("s.pfm", image.astype(np.float32)), ("s.tiff", image)):
        write_png(folder / name, pixels)
    np.save(folder / "s.npy", image)
    np.savez_compressed(folder / "s.npz", depth=image)
    plain = f"P2\n16 12\n65535\n{' '.join(map(str, image.ravel()))}\n".encode()
    return [(folder / f"s.{kind}").read_bytes() for kind in ("pgm", "pfm", "tiff", "npy", "npz")] + [plain]


def read_depth_file(data: bytes, folder: Path) -> None:
    (folder / "a.dat").write_bytes(data)
    assert read_depth(folder / "a.dat", SIZE).shape == SIZE[::-1]


def read_pose_text(data: bytes, folder: Path) -> None:
    """The bytes as a file of poses, and as one file of a folder of them."""
    refused = []
    for name in ("p.txt", "p.json", "p.npy"):
        (folder / name).write_bytes(data)
        try:
            found = read_poses(folder / name)
            assert len(found) > 0
        except StereovoxError as error:
            refused.append(error)
    (folder / "poses").mkdir(exist_ok=True)
    (folder / "poses/1.txt").write_bytes(data)
    try:
        read_poses(folder / "poses")
    except StereovoxError as error:
        refused.append(error)
    if len(refused) == 4:
        raise refused[0]


def pose_texts(folder: Path) -> list[bytes]:
    np.save(folder / "s.npy", np.stack([np.eye(4)] * 3))
    line = " ".join(map(str, np.eye(4).ravel()))
    table = {"parameters": [{"extrinsic": np.eye(4).ravel().tolist()}]}
    rows = "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
    texts = [POSES, f"{line}\n{line}\n", rows, json.dumps(table)]
    return [*(text.encode() for text in texts), (folder / "s.npy").read_bytes()]


def read_packed(name: str, data: bytes, folder: Path) -> None:
    """A .sens, or a SLAMBench .raw with poses next to it."""
    (folder / "camera-intrinsics.txt").write_text("20 0 7.5\n0 21 5.5\n0 0 1\n")
    (folder / "p.txt").write_text("".join(f"{k} 0 0 0 0 0 0 1\n" for k in range(2)))
    (folder / name).write_bytes(data)
    frames_of(open_source(f"{folder / name}?poses=p.txt" if name.endswith("raw") else folder / name))


def sens_files(folder: Path) -> list[bytes]:
    return [sens(folder / "s.sens", posed(2), code).read_bytes() for code in (0, 1)]


def raw_frames(_: Path) -> list[bytes]:
    head = struct.pack("<2I", *SIZE)
    return [(head + depth_image(1).tobytes() + head + bytes(3 * 16 * 12)) * 2]


def grey_pngs(folder: Path) -> list[bytes]:
    made = []
    for shape in ((12, 16), (12, 16, 3)):
        write_png(folder / "s.png", np.arange(np.prod(shape), dtype=np.uint8).reshape(shape))
        made.append((folder / "s.png").read_bytes())
    return made


def read_list(name: str, data: bytes, folder: Path) -> None:
    """A TUM folder with these bytes as one of its lists."""
    if not (folder / "depth").exists():
        write_png(folder / "depth/0.1.png", depth_image(1))
        (folder / "camera-intrinsics.txt").write_text("20 0 7.5\n0 21 5.5\n0 0 1\n")
        (folder / "groundtruth.txt").write_text(POSES)
        (folder / "depth.txt").write_text("0.1 depth/0.1.png\n")
    (folder / name).write_bytes(data)
    frames_of(open_source(folder))


def read_rig_folder(data: bytes, folder: Path) -> None:
    (folder / "rig.toml").write_bytes(data)
    for pair in read_rig(folder / "rig.toml").stereo_pairs(folder):
        assert pair.camera.width > 0


def rigs(folder: Path) -> list[bytes]:
    return [(recorded(folder / "rig") / "rig.toml").read_bytes()]


def read_asl(name: str, data: bytes, folder: Path) -> None:
    """A folder `mav0` with these bytes as one of its lists."""
    if not (folder / "mav0").exists():
        asl(folder)
    (folder / "mav0" / name).write_bytes(data)
    frames_of(open_source(folder))


def read_sensors(path: Path) -> None:
    """Two sensor.yaml files, the first one given."""
    path.with_name("right.yaml").write_text(sensor_text(eyes().right, FORWARD @ eyes().T_left_right, "equidistant"))
    import_rig([path, path.with_name("right.yaml")])


def read_two_view(data: bytes, folder: Path) -> None:
    """A pair with these bytes as calib.txt."""
    for name in ("im0.png", "im1.png"):
        write_png(folder / name, np.zeros((12, 16), np.uint8))
    (folder / "calib.txt").write_bytes(data)
    frames_of(open_source(folder))


def raw_files(folder: Path) -> list[bytes]:
    raw_calibration(folder)
    return [(folder / "calib_cam_to_cam.txt").read_bytes()]


def read_raw(data: bytes, folder: Path) -> None:
    if not (folder / "calib_velo_to_cam.txt").exists():
        raw_calibration(folder)
    (folder / "calib_cam_to_cam.txt").write_bytes(data)
    read_raw_calibration(folder)
    import_rig([folder / "calib_cam_to_cam.txt"], (64, 24))


def read_matrix(path: Path) -> None:
    find_camera([path.parent], SIZE, 0.05, (1.0, 1.0, 1.0, 1.0))


def read_log(path: Path) -> None:
    frames_of(CarmenLog(str(path)).scans)


CAMERA = 'width = 16\nheight = 12\nfx = 20.0\nfy = 21\ncx = 7.5\ncy = 5.5\nbaseline = 0.05\n[correction]\n' \
    'model = "thesis"\ncoefficients = [0.1, 0.2, 0.3]\n[correction.provenance]\nmade = "by hand"\n'  # fmt: skip
KITTI = single_calibration(("R_rect", "Tr_velo_cam", "Tr_imu_velo", True))
SCAN = struct.pack("<8f", 1, 2, 3, 0.5, 4, 5, 6, 0.5)

TARGETS: dict[str, Target] = {
    "config": file_target("a.toml", load_config, PROFILE),
    "camera": file_target("camera.toml", read_camera, CAMERA),
    "pair": file_target("pair.toml", read_pair, pair_text(PairSettings(T_tracker_camera=np.eye(4), baseline=0.05))),
    "rig": Target(rigs, read_rig_folder),
    "calibration": file_target("calib.yaml", lambda path: import_rig([path]), KALIBR, OPENVINS, OPENCV, ORB, OKVIS),
    "asl_sensor": file_target("sensor.yaml", read_sensors, SENSOR),
    "asl_images": Target(lambda _: [f"#ns,file\n{START},{START}.png\n".encode()], partial(read_asl, "cam0/data.csv")),
    "asl_poses": Target(lambda _: [poses_csv([START - 1, START + 1]).encode()], partial(read_asl, TRUTH)),
    "two_view": Target(lambda _: [TWO_VIEW.encode()], read_two_view),
    "intrinsics": file_target("camera-intrinsics.txt", read_matrix, "20 0 7.5\n0 21 5.5\n0 0 1\n"),
    "images_list": Target(
        lambda _: [b"# list\n0.1 depth/0.1.png\n0.2 depth/0.2.png\n"], partial(read_list, "depth.txt")
    ),
    "poses_list": Target(lambda _: [POSES.encode()], partial(read_list, "groundtruth.txt")),
    "tracker": file_target("tracker.txt", read_tracker, POSES, "".join(f"{n} 3\n" for n in POSES.splitlines()[1:])),
    "camera_path": file_target("path.txt", read_camera_path, POSES, "1 2 3\n4 5 6\n"),
    "relations": file_target("a.relations", read_relations, "1.5 2.5 0.1 0.2 0 0 0 0.1\n"),
    "kitti_poses": file_target("poses.txt", lambda path: read_pose_file(path, 5), pose_lines(3)),
    "kitti_oxts": file_target("oxts.txt", lambda path: read_oxts_file(path, 5, np.eye(4)), packet(0) + packet(1)),
    "kitti_labels": file_target("labels.txt", read_labels, label(0) + "\n" + label(1) + "\n"),
    "kitti_calibration": file_target("calib.txt", read_calibration, KITTI),
    "kitti_raw": Target(raw_files, read_raw),
    "velodyne": file_target("0.bin", read_velodyne, SCAN),
    "carmen": file_target("a.log", read_log, FLASER, ROBOTLASER, FLASER + ROBOTLASER),
    "carmen_bz2": file_target("a.log.bz2", read_log, bz2.compress(FLASER * 3)),
    "depth_png": Target(depth_pngs, partial(read_png, read_depth)),
    "depth_file": Target(depth_files, read_depth_file),
    "pose_file": Target(pose_texts, read_pose_text),
    "sens": Target(sens_files, partial(read_packed, "a.sens")),
    "slambench_raw": Target(raw_frames, partial(read_packed, "a.raw")),
    "picture_png": Target(grey_pngs, partial(read_png, photos.read_picture_png)),
    "map_manifest": Target(manifests, read_manifest),
    "map_arrays": Target(pieces, read_piece),
    "map_cells": Target(some_coords, read_cells),
    "boxed_manifest": Target(boxed_manifests, read_boxed),
    "boxed_shards": Target(shards, read_shard),
    "grid_file": Target(grids, lambda data, folder: file_target("a.npz", load_grid).read(data, folder)),
    "grid_about": Target(abouts, read_about),
    "octomap": Target(trees, lambda data, folder: file_target("a.bt", read_octomap).read(data, folder)),
    "octomap_nodes": Target(bodies, read_tree),
    "cells_npz": Target(
        partial(exported, ".npz"), lambda data, folder: file_target("a.npz", read_npz).read(data, folder)
    ),
    "cells_settings": Target(settings, read_settings),
    "points_text": Target(
        text_points,
        lambda data, folder: file_target("a.ply", lambda path: read_cloud_map(path, 0.1)).read(data, folder),
    ),
    "points_ply": Target(
        partial(exported, ".ply"), lambda data, folder: file_target("a.ply", read_cloud_map).read(data, folder)
    ),
    "points_pcd": Target(
        partial(exported, ".pcd"), lambda data, folder: file_target("a.pcd", read_cloud_map).read(data, folder)
    ),
    "points_rows": file_target("a.csv", read_cloud_map, *ROWS),
    "points_las": Target(partial(surveys, ".las"), lambda data, folder: read_survey("a.las", data, folder)),
    "points_laz": Target(partial(surveys, ".laz"), lambda data, folder: read_survey("a.laz", data, folder)),
    "mesh_ply": Target(partial(meshes, "ply"), file_target("a.ply", lambda path: read_cloud_map(path, 0.2)).read),
    "mesh_obj": Target(partial(meshes, "obj"), file_target("a.obj", lambda path: read_cloud_map(path, 0.2)).read),
    "mesh_off": Target(partial(meshes, "off"), file_target("a.off", lambda path: read_cloud_map(path, 0.2)).read),
    "mesh_stl": Target(partial(meshes, "stl"), file_target("a.stl", lambda path: read_cloud_map(path, 0.2)).read),
    "scan_graph": file_target("a.graph", lambda path: read_scan_graph(path, 0.2), *GRAPHS),
    "map_yaml": file_target("map.yaml", lambda path: read_yaml(path.read_bytes(), path.parent), MAP_YAML),
    "map_picture": Target(pictures, read_picture),
    "bag_ros1": Target(ros1_bags, partial(read_bag, "a.bag")),
    "bag_db3": Target(db3_bags, partial(read_bag, "a.db3")),
    "bag_mcap": Target(mcap_bags, partial(read_bag, "a.mcap")),
    "bag_message": Target(lambda _: [bytes([k]) + data for k, (_, _, data) in enumerate(messages())], read_message),
    "bag_map_message": Target(
        lambda _: [bytes([k]) + data for k, (_, data) in enumerate(map_messages())], read_map_message
    ),
    "bag_metadata": Target(lambda _: [METADATA.encode()], read_metadata),
}
