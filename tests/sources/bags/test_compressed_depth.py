# SPDX-License-Identifier: Apache-2.0
"""Compressed depth of image_transport: PNG, RVL, packed floats, plain 16-bit PNG; made as its C++ code makes them."""

import struct

import cv2
import numpy as np
import pytest
from made_bags import Bag, camera_info, depth, header, message, stamp

from stereovox.errors import SourceError
from stereovox.sources.bags.recording import Bag as BagSource
from stereovox.sources.photos import decode_rvl

TOPIC, INFO = "/camera/depth/image_raw", "/camera/depth/camera_info"
IMAGES = {
    "usual": depth(3),
    "empty": np.zeros((6, 8), np.uint16),
    "holes": np.where(np.arange(48).reshape(6, 8) % 3, depth(1), 0).astype(np.uint16),
    "jumps": np.tile(np.array([1, 65535, 0, 0, 40000, 3, 65535, 65534], np.uint16), (6, 1)),
}


def png(pixels, form="png"):
    return cv2.imencode(f".{form}", pixels)[1].tobytes()


def rvl(pixels):
    """RVL as in rvl_codec.cpp: runs of zeros and of values, nibbles with a bit that says whether more follow."""
    values, nibbles, previous, at = [int(v) for v in pixels.ravel()], [], 0, 0

    def write(value):
        while True:
            nibble, value = value & 7, value >> 3
            nibbles.append(nibble | (8 if value else 0))
            if not value:
                return

    while at < len(values):
        for is_run in (lambda v: v == 0, lambda v: v != 0):
            end = at
            while end < len(values) and is_run(values[end]):
                end += 1
            write(end - at)
            for value in values[at:end] if values[at : at + 1] != [0] else []:
                step, previous = value - previous, value
                write((step << 1) ^ (step >> 31))
            at = end
    nibbles += [0] * (-len(nibbles) % 8)
    words = (int("".join(f"{n:x}" for n in nibbles[k : k + 8]), 16) for k in range(0, len(nibbles), 8))
    return struct.pack("<II", pixels.shape[1], pixels.shape[0]) + b"".join(struct.pack("<I", word) for word in words)


def floats(metres, farthest=10.0, steps=100.0):
    """Inverse depth in whole steps, as in codec.cpp, and the parameters that come before it."""
    a = steps * (steps + 1)
    b = 1 - a / farthest
    whole = np.where((metres > 0) & (metres < farthest), a / np.where(metres > 0, metres, 1) + b, 0).astype(np.uint16)
    return whole, struct.pack("<iff", 1, a, b)


def source(path, data, form, topic=f"{TOPIC}/compressedDepth"):
    with Bag(path / "a.bag") as bag:
        picture = message(
            "sensor_msgs/CompressedImage", header=header(stamp(0)), format=form, data=np.frombuffer(data, np.uint8)
        )
        bag.add(topic, "sensor_msgs/CompressedImage", stamp(0), picture)
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    return BagSource(bag.path)


@pytest.mark.parametrize("name", IMAGES)
@pytest.mark.parametrize("form", ["16UC1; compressedDepth rvl", "16UC1; compressedDepth png", "16UC1; compressedDepth"])
def test_whole_millimetres(tmp_path, name, form):
    content = (rvl if "rvl" in form else png)(IMAGES[name])
    frame = source(tmp_path, bytes(12) + content, form).frame(0)
    np.testing.assert_array_equal(frame.depth, IMAGES[name])
    assert (frame.depth.dtype, frame.depth_scale) == (np.uint16, 0.001)


def test_an_image_without_any_value_is_no_damage():
    """Of 640x480 pixels, RVL leaves a dozen bytes: fewer than one for each thousand."""
    empty = np.zeros((480, 640), np.uint16)
    packed = rvl(empty)
    assert len(packed) < 20
    np.testing.assert_array_equal(decode_rvl("a", packed, (640, 480)), empty)


@pytest.mark.parametrize("form", ["32FC1; compressedDepth png", "32FC1; compressedDepth rvl", "32FC1; compressedDepth"])
def test_packed_metres(tmp_path, form):
    metres = np.linspace(0.4, 9.9, 48, dtype=np.float32).reshape(6, 8)
    metres[0, :3] = 0, 12, 9.99
    whole, head = floats(metres)
    frame = source(tmp_path, head + (rvl if "rvl" in form else png)(whole), form).frame(0)
    assert (frame.depth.dtype, frame.depth_scale) == (np.float32, 1.0)
    assert np.isnan(frame.depth[0, :2]).all()
    seen = np.isfinite(frame.depth)
    assert seen.sum() == 46
    step = metres**2 / 10_100  # what one step of inverse depth is worth
    assert (np.abs(frame.depth - metres)[seen] <= 1.01 * step[seen]).all()


@pytest.mark.parametrize("form", ["16UC1; png compressed ", "png"])
def test_plain_png_of_a_depth_topic(tmp_path, form):
    frame = source(tmp_path, png(depth(2)), form, f"{TOPIC}/compressed").frame(0)
    np.testing.assert_array_equal(frame.depth, depth(2))


@pytest.mark.parametrize(
    ("data", "form", "topic"),
    [
        (png(depth(2).astype(np.uint8)), "png", f"{TOPIC}/compressed"),  # pixels of 8 bits
        (png(depth(2)), "png", "/camera/infra1/compressed"),  # may be a picture
        (png(depth(2).astype(np.uint8), "jpg"), "16UC1; jpeg compressed ", f"{TOPIC}/compressed"),  # which destroys it
    ],
)
def test_other_pictures_are_not_taken_for_depth(tmp_path, data, form, topic):
    with pytest.raises(SourceError, match="no depth images"):
        source(tmp_path, data, form, topic)


def test_the_better_of_several_forms_of_one_topic_is_read(tmp_path):
    with Bag(tmp_path / "a.bag") as bag:
        for suffix, form, data in (
            ("compressed", "16UC1; png compressed ", png(depth(1))),
            ("compressedDepth", "16UC1; compressedDepth rvl", bytes(12) + rvl(depth(2))),
        ):
            data = np.frombuffer(data, np.uint8)
            picture = message("sensor_msgs/CompressedImage", header=header(stamp(0)), format=form, data=data)
            bag.add(f"{TOPIC}/{suffix}", "sensor_msgs/CompressedImage", stamp(0), picture)
        bag.add(INFO, "sensor_msgs/CameraInfo", stamp(0), camera_info())
    np.testing.assert_array_equal(BagSource(bag.path).frame(0).depth, depth(2))
    chosen = BagSource(f"{bag.path}?depth={TOPIC}/compressed")
    np.testing.assert_array_equal(chosen.frame(0).depth, depth(1))


WHOLE = rvl(depth(3))


@pytest.mark.parametrize(
    ("data", "form", "why"),
    [
        (bytes(12) + WHOLE[:-4], "16UC1; compressedDepth rvl", "unreadable"),
        (bytes(12) + WHOLE[:9], "16UC1; compressedDepth rvl", "unreadable"),
        (bytes(12) + struct.pack("<II", 2**31, 2**31) + WHOLE[8:], "16UC1; compressedDepth rvl", "bad_shape"),
        (bytes(12) + WHOLE[:8] + b"\xff" * 400, "16UC1; compressedDepth rvl", "unreadable"),
        (bytes(12) + WHOLE[:8] + bytes(400), "16UC1; compressedDepth rvl", "unreadable"),
        (bytes(12) + png(depth(3))[:-9], "16UC1; compressedDepth png", "unreadable"),
        (bytes(5), "16UC1; compressedDepth rvl", "unreadable"),
        (bytes(12) + png(depth(3)), "8UC1; compressedDepth png", "bad_dtype"),
    ],
)
def test_damaged_images_are_refused(tmp_path, data, form, why):
    frame = source(tmp_path, data, form).frame(0)
    assert frame.fault == why
    assert "a.bag" in frame.fault_detail or "image 0" in frame.fault_detail


def test_any_bytes_end_in_an_image_or_a_refusal(tmp_path):
    random = np.random.default_rng(0)
    for k in range(60):
        data = bytearray(bytes(12) + WHOLE)
        for at in random.integers(20, len(data), 1 + k % 4):
            data[at] = random.integers(256)
        (tmp_path / str(k)).mkdir()
        frame = source(tmp_path / str(k), bytes(data), "16UC1; compressedDepth rvl").frame(0)
        assert frame.fault == "unreadable" or frame.depth.shape == (6, 8)
