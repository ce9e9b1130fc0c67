# SPDX-License-Identifier: Apache-2.0
"""Recordings made to hurt: bombs, databases that compute, sizes that lie, names that lead elsewhere."""

import bz2
import sqlite3
import struct
import tracemalloc
import zlib

import lz4.frame
import numpy as np
import pytest
from backports import zstd
from made_bags import camera_info, store
from made_mcap import MAGIC, Style, chunk_record, record, text
from made_recordings import chunk, tum
from made_rigs import recorded
from made_robot_bags import START_NS, Messages, RobotBagMaker

from stereovox.calibrate.stereo import read_grey
from stereovox.errors import FrameRefused, SourceError
from stereovox.evaluate.inputs import read_camera_path
from stereovox.evaluate.trajectory import read_relations
from stereovox.opening import open_source
from stereovox.sources.bags import files
from stereovox.sources.bags.files import ALWAYS_ALLOWED, Db3File, decompress, max_unpacked
from stereovox.sources.bags.messages import Wire, ns_from_ms, read_camera_info
from stereovox.sources.bags.robot_messages import read_laser_scan, read_point_cloud
from stereovox.sources.photos import SIGNATURE, read_picture_png
from stereovox.sources.rgbd.depth_files import read_depth
from stereovox.sources.robots import carmen
from stereovox.sources.robots.carmen import CarmenLog

FLASER = b"FLASER 3 1.0 2.0 81.9 0 0 0 0.1 0.2 0.3 976052857.3 nohost 0.1\n"
PACK = {"bz2": bz2.compress, "lz4": lz4.frame.compress, "zstd": zstd.compress}


@pytest.mark.parametrize("packing", PACK)
def test_a_small_piece_that_swells_is_refused_early(packing, monkeypatch):
    monkeypatch.setattr(files, "ALWAYS_ALLOWED", 1 << 20)
    monkeypatch.setattr(files, "MAX_RATIO", 20)
    bomb = PACK[packing](bytes(60 << 20))
    assert max_unpacked(len(bomb)) < 20 << 20
    tracemalloc.start()
    with pytest.raises(ValueError, match="absurd size"):
        decompress(bomb, packing, 1 << 40)
    assert tracemalloc.get_traced_memory()[1] < 30_000_000
    tracemalloc.stop()
    assert decompress(PACK[packing](bytes(1 << 20)), packing, 1 << 40) == bytes(1 << 20)


def test_what_may_swell_how_far():
    assert max_unpacked(0) == ALWAYS_ALLOWED
    assert max_unpacked(10**6) == 10**9


def test_many_chunks_that_swell_a_little(tmp_path, monkeypatch):
    """Each alone is small enough; without an index the whole file is gone through."""
    monkeypatch.setattr(files, "ALWAYS_ALLOWED", 1 << 20)
    inner = record(200, bytes((1 << 20) - 9))
    bomb = chunk_record(inner, 0, 1, Style("zstd"))
    (tmp_path / "a.mcap").write_bytes(MAGIC + record(1, text("") + text("")) + bomb * 30)
    assert (tmp_path / "a.mcap").stat().st_size < 10_000
    with pytest.raises(SourceError, match="its chunks unpack to an absurd size"):
        open_source(tmp_path / "a.mcap")


def database(tmp_path, *statements):
    with RobotBagMaker(tmp_path / "a.db3") as bag:
        bag.depth(2)
    with sqlite3.connect(bag.path) as file:
        for statement in statements:
            try:
                file.execute(statement)
            except sqlite3.OperationalError as error:
                pytest.skip(f"this SQLite has {error}")
    file.close()
    return bag.path


ENDLESS = "WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT i AS id, 1 AS topic_id, "
COMPUTED = (
    "CREATE TABLE messages (id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER,"
    " data BLOB AS (zeroblob(100000000)))"
)


@pytest.mark.parametrize(
    "statements",
    [
        ("DROP TABLE messages", f"CREATE VIEW messages AS {ENDLESS} i AS timestamp, zeroblob(9) AS data FROM n"),
        ("ALTER TABLE topics RENAME TO t", "CREATE VIEW Topics AS SELECT * FROM t"),
        ("DROP TABLE messages", COMPUTED),
        ("DROP TABLE messages", "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)"),
    ],
)
def test_a_database_that_would_compute(tmp_path, statements):
    path = database(tmp_path, *statements)
    with pytest.raises(SourceError, match="topics or messages is not a plain table"):
        open_source(path)


def test_triggers_do_not_matter(tmp_path):
    path = database(tmp_path, "CREATE TRIGGER t AFTER INSERT ON messages BEGIN DELETE FROM messages; END")
    assert len(open_source(f"{path}?pose=fixed")) == 2


def test_a_query_that_does_not_end(tmp_path, monkeypatch):
    path = database(tmp_path)
    file = Db3File(path)
    assert file.stamps("/camera/depth/image").size == 2
    rows = file._file.rows("WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n LIMIT 9) SELECT i FROM n")
    assert len(rows) == 9
    with pytest.raises(sqlite3.OperationalError, match="interrupted"):
        file._file.rows("WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT count(*) FROM n")
    assert len(file._file.rows("SELECT 1")) == 1  # patience begins anew


def test_a_scan_of_absurdly_many_beams():
    ros = Messages(1)
    many = ros.wire("sensor_msgs/LaserScan", ros.scan(START_NS, np.ones(100_001)))
    with pytest.raises(ValueError, match="a scan of 100001 ranges"):
        read_laser_scan(many)


def test_a_lens_of_absurdly_many_coefficients():
    info = bytes(store().serialize_ros1(camera_info(D=(0.0,) * 65), "sensor_msgs/msg/CameraInfo"))
    with pytest.raises(ValueError, match="a lens with 65 coefficients"):
        read_camera_info(Wire(info, cdr=False))


def test_a_cloud_without_xyz_and_one_whose_size_overflows():
    ros = Messages(2)
    for change, said in (
        ({"fields": []}, "without x"),
        ({"width": 2**31, "height": 2}, "do not fit|needs"),
        ({"width": 2**32 - 1, "height": 2**32 - 1, "row_step": 2**32 - 1}, "do not fit|needs"),
        ({"width": 2**16, "height": 2**16, "point_step": 0, "row_step": 0}, "do not fit"),
    ):
        cloud = ros.cloud(START_NS, [[1, 2, 3]], **change)
        with pytest.raises(ValueError, match=said):
            read_point_cloud(ros.wire("sensor_msgs/PointCloud2", cloud))


@pytest.mark.parametrize("told", ["1e999999999", "-1e999999999999", "nan", "snan", "inf", "x", ""])
def test_milliseconds_beyond_all_bounds(told):
    assert ns_from_ms(told) is None


def png(width, height, data, bits=16):
    header = struct.pack(">IIBBBBB", width, height, bits, 0, 0, 0, 0)
    return SIGNATURE + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data, 9)) + chunk(b"IEND", b"")


def refused(path, size, reader=read_depth):
    with pytest.raises(FrameRefused) as caught:
        reader(path, size)
    return caught.value.reason


def test_a_png_that_tells_of_more_than_it_can_hold(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(png(9000, 9000, bytes(100)))
    assert refused(path, (9000, 9000)) == "unreadable"  # small enough for a header, but not for 150 bytes
    assert refused(path, (640, 480)) == "bad_shape"
    path.write_bytes(png(2**31 - 1, 2**31 - 1, b""))
    assert refused(path, (2**31 - 1, 2**31 - 1)) == "unreadable"
    path.write_bytes(png(0, 5, b""))
    assert refused(path, (0, 5)) == "unreadable"


def test_a_png_with_too_much_or_too_little_in_it(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(png(4, 2, bytes(50_000_000)))
    assert read_depth(path, (4, 2)).tolist() == [[0] * 4] * 2  # what is too much is never unpacked
    for short in (0, 1, 17):
        path.write_bytes(png(4, 2, bytes(short)))
        assert refused(path, (4, 2)) == "unreadable"
    path.write_bytes(png(4, 2, bytes(10), bits=8))
    assert refused(path, (4, 2)) == "bad_dtype"
    assert read_picture_png(path, (4, 2)).shape == (2, 4)


def test_a_packed_log_that_swells(tmp_path, monkeypatch):
    monkeypatch.setattr(carmen, "ALWAYS_ALLOWED", 1 << 16)
    path = tmp_path / "a.log.bz2"
    path.write_bytes(bz2.compress(FLASER + b"#" * (1 << 22)))
    log = CarmenLog(str(path))
    assert len(log.scans) == 1
    assert "expands to more than" in log.notes[-1]
    path.write_bytes(bz2.compress(FLASER * 3))
    assert len(CarmenLog(str(path)).notes) == 1


@pytest.mark.parametrize("stamp", ["1e999999999", "nan", "snan", "1e99999999999999999"])
def test_a_log_with_times_beyond_all_bounds(tmp_path, stamp):
    path = tmp_path / "a.log"
    path.write_bytes(FLASER + FLASER.replace(b"976052857.3", stamp.encode()))
    log = CarmenLog(str(path))
    assert len(log.scans) == 1
    assert len(log.damaged) == 1
    (tmp_path / "a.relations").write_text(f"{stamp} 2 0.1 0.2 0 0 0 0.1\n")
    with pytest.raises(SourceError, match="line 1 is not a relation"):
        read_relations(tmp_path / "a.relations")


@pytest.mark.parametrize("name", ["../secret.png", "/etc/passwd", "depth/../../secret.png"])
def test_lists_do_not_lead_out_of_their_folder(tmp_path, name):
    folder = tum(tmp_path / "walk", ["0.1"], "0.0 0 0 0 0 0 0 1\n0.2 0 0 0 0 0 0 1\n")
    (folder / "depth.txt").write_text(f"0.1 {name}\n")
    with pytest.raises(SourceError, match=r"depth.txt:1: '.*' leads out of the recording's folder"):
        open_source(folder)
    rig = recorded(tmp_path / "rig")
    (rig / "front/list.txt").write_text(f"0.1 100000000.png {name}\n")
    toml = (rig / "rig.toml").read_text()
    (rig / "rig.toml").write_text(toml.replace('name = "front"', 'name = "front"\nindex = "front/list.txt"'))
    with pytest.raises(SourceError, match=r"list.txt:1: '.*' leads out of the recording's folder"):
        open_source(rig)


def test_a_path_is_a_file_and_no_address(tmp_path):
    with pytest.raises(SourceError, match="cannot be read as poses"):
        read_camera_path("http://localhost:1/path.txt")
    (tmp_path / "a.txt.gz").write_bytes(b"\x1f\x8b" + bytes(50))  # what NumPy would unpack
    with pytest.raises(SourceError, match="cannot be read as poses"):
        read_camera_path(tmp_path / "a.txt.gz")


def test_an_image_for_calibration_that_tells_of_too_much(tmp_path):
    path = tmp_path / "left.png"
    path.write_bytes(png(30_000, 30_000, b"", bits=8))
    assert read_grey(path) is None
    path.write_bytes(png(4, 2, bytes(10), bits=8))
    assert read_grey(path).shape == (2, 4)
