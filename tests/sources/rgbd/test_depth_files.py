# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import struct
import sys

import cv2
import numpy as np
import pytest
from made_depth import camera_text, check, matrix_line, posed, render, units

from stereovox.errors import FrameRefused, MissingExtra
from stereovox.opening import open_source
from stereovox.sources.rgbd.depth_files import common_depth_size, depth_size, read_depth

SIZE, K = (160, 120), (130.0, 130.0, 79.5, 59.5)
DEPTH = render(posed()[0], K, SIZE)
MM = units(DEPTH, 1000)


def opencv(image):
    def write(path):
        assert cv2.imwrite(str(path), image)

    return write


def plain_pgm(path):
    path.write_text(f"P2\n# plain\n160 120\n65535\n{' '.join(map(str, MM.ravel()))}\n")


def exr(**channels):
    def write(path):
        import OpenEXR

        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(path))

    return write


def bytes_of_floats(order):
    """float32 as the four bytes of RGBA; `order`: which byte of the float each channel of OpenCV's BGRA gets."""
    return DEPTH.view(np.uint8).reshape(120, 160, 4)[..., order].copy()


def carla():
    code = np.rint(DEPTH.astype(float) / 1000 * (256**3 - 1)).astype(np.uint32)
    return np.stack([code >> 16, code >> 8 & 255, code & 255], axis=-1).astype(np.uint8)  # BGR


def carla_with_alpha():
    return np.concatenate([carla(), np.full((120, 160, 1), 255, np.uint8)], axis=2)


MILLIMETRES = {
    "a.png": opencv(MM),
    "a.pgm": opencv(MM),
    "plain.pgm": plain_pgm,
    "a.tiff": opencv(MM),
    "a.npy": lambda path: np.save(path, MM),
    "channel.npy": lambda path: np.save(path, MM[..., None]),
    "big_endian.npy": lambda path: np.save(path, MM.astype(">u2")),
    "int32.npy": lambda path: np.save(path, MM.astype(np.int32)),
    "a.npz": lambda path: np.savez_compressed(path, MM),
    "named.npz": lambda path: np.savez(path, depth=MM, colour=np.zeros(3)),
}
METRES = {
    "f.tiff": opencv(DEPTH),
    "f.pfm": opencv(DEPTH),
    "f.npy": lambda path: np.save(path, DEPTH),
    "f64.npy": lambda path: np.save(path, DEPTH.astype(float)),
    "f16.npy": lambda path: np.save(path, DEPTH.astype(np.float16)),
    "rtabmap.png": opencv(bytes_of_floats([0, 1, 2, 3])),
    "rgba.png": opencv(bytes_of_floats([2, 1, 0, 3])),
    "carla.png": opencv(carla()),
    "carla_alpha.png": opencv(carla_with_alpha()),
    "z.exr": exr(Z=DEPTH),
    "y.exr": exr(Y=DEPTH),
    "half.exr": exr(Z=DEPTH.astype(np.float16)),
    "grey.exr": exr(R=DEPTH, G=DEPTH, B=DEPTH),
    "named.exr": exr(R=DEPTH * 0, **{"depth.Z": DEPTH}),
}


@pytest.mark.parametrize("name", MILLIMETRES)
def test_whole_numbers_stay_as_they_are(tmp_path, name):
    MILLIMETRES[name](tmp_path / name)
    found = read_depth(tmp_path / name, SIZE)
    np.testing.assert_array_equal(found, MM)
    assert found.dtype == np.uint16
    assert depth_size(tmp_path / name) == SIZE


@pytest.mark.parametrize("name", METRES)
def test_floats_are_metres(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    METRES[name](tmp_path / name)
    found = read_depth(tmp_path / name, SIZE)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, DEPTH, atol=2e-3 if "16" in name or "half" in name else 1e-4)


@pytest.mark.parametrize("name", [*MILLIMETRES, *METRES])
def test_a_folder_of_them_is_a_recording(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    (tmp_path / "depth").mkdir()
    for k in range(3):
        {**MILLIMETRES, **METRES}[name](tmp_path / f"depth/{k}.{name.rpartition('.')[2]}")
    (tmp_path / "poses.txt").write_text(matrix_line(posed()[0]) * 3)
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text(K))
    near = 200 if "16" in name or "half" in name else 1000
    check(open_source(tmp_path), [posed()[0]] * 3, near, K)


def test_negative_numbers_are_no_value_and_large_ones_stay(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[-5, 65535, 7]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy", (3, 1)), [[0, 65535, 7]])
    np.save(tmp_path / "a.npy", np.array([[-5, 65536, 7]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "a.npy", (3, 1)), [[-5, 65536, 7]])


def picture(shape, dtype=np.uint8):
    return np.random.default_rng(1).integers(0, 255, shape).astype(dtype)


def smooth(channels):
    """A picture with soft shades, whose bytes count up like those of a number might."""
    v, u = np.mgrid[:120, :160]
    return np.stack([(u * 3 + v * (k + 1)) % 256 for k in range(channels)], axis=-1).astype(np.uint8)


PICTURES = {
    "grey.png": opencv(picture((120, 160))),
    "colour.png": opencv(picture((120, 160, 3))),
    "alpha.png": opencv(np.dstack([picture((120, 160, 3)), np.full((120, 160), 255, np.uint8)])),
    "smooth.png": opencv(smooth(3)),
    "smooth_alpha.png": opencv(np.dstack([smooth(3), np.full((120, 160), 255, np.uint8)])),
    "black.png": opencv(np.zeros((120, 160, 3), np.uint8)),
    "deep.png": opencv(picture((120, 160, 3), np.uint16)),
    "grey.pgm": opencv(picture((120, 160))),
    "colour.tiff": opencv(picture((120, 160, 3))),
    "bytes.npy": lambda path: np.save(path, picture((120, 160))),
    "colour.npy": lambda path: np.save(path, picture((120, 160, 3), float)),
    "row.npy": lambda path: np.save(path, np.ones(160)),
    "complex.npy": lambda path: np.save(path, np.ones((120, 160), complex)),
    "colour.exr": exr(R=DEPTH, G=DEPTH * 2, B=DEPTH * 3),
}


@pytest.mark.parametrize("name", PICTURES)
def test_a_picture_is_no_depth(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    PICTURES[name](tmp_path / name)
    assert reason(tmp_path / name) == "bad_dtype"


def reason(path, size=SIZE):
    with pytest.raises(FrameRefused) as refused:
        read_depth(path, size)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).replace(str(path), "")) <= 300
    return refused.value.reason


@pytest.mark.parametrize("name", ["a.png", "a.pgm", "a.tiff", "a.npy", "a.npz", "f.pfm", "z.exr", "rtabmap.png"])
@pytest.mark.parametrize("part", [0.1, 0.6, 0.98])
def test_a_file_that_is_cut_off_is_a_fault_without_a_word_on_the_terminal(tmp_path, name, part, capfd):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    path = tmp_path / name
    {**MILLIMETRES, **METRES}[name](path)
    path.write_bytes(path.read_bytes()[: int(part * path.stat().st_size)])
    assert reason(path) == "unreadable"
    assert capfd.readouterr().err == "" or name.endswith(".exr")  # whose library cannot be kept from it


@pytest.mark.parametrize("name", [*MILLIMETRES, "f.pfm", "z.exr", "carla.png"])
def test_another_size_is_named(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    {**MILLIMETRES, **METRES}[name](tmp_path / name)
    assert reason(tmp_path / name, (120, 160)) == "bad_shape"


@pytest.mark.parametrize(
    "data", [b"", b"P5", b"hello", b"\x93NUMPY\1", b"PK\3\4", b"II*\0", b"\x76\x2f\x31\x01", b"Pf\n"]
)
def test_nonsense_is_unreadable(tmp_path, data):
    if data.startswith(b"\x76"):
        pytest.importorskip("OpenEXR")
    (tmp_path / "a.png").write_bytes(data)
    assert reason(tmp_path / "a.png") == "unreadable"


def test_files_that_are_not_there_and_folders(tmp_path):
    (tmp_path / "folder.png").mkdir()
    assert reason(tmp_path / "none.png") == reason(tmp_path / "folder.png") == "missing_file"


def test_headers_that_claim_too_much_are_not_believed(tmp_path):
    (tmp_path / "a.pgm").write_bytes(b"P5\n100000 100000\n65535\n" + bytes(100))
    header = b"\x93NUMPY\1\0v\0{'descr': '<u2', 'fortran_order': False, 'shape': (100000, 100000), }"
    (tmp_path / "a.npy").write_bytes(header.ljust(127) + b"\n" + bytes(100))
    np.savez(tmp_path / "a.npz", a=np.array([{}], object))
    for name in ("a.pgm", "a.npy", "a.npz"):
        assert reason(tmp_path / name) == "unreadable"


@pytest.mark.parametrize("name", ["a.tiff", "z.exr"])
def test_sizes_in_headers_are_checked_before_anything_is_decoded(tmp_path, name):
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    {**MILLIMETRES, **METRES}[name](tmp_path / name)
    data = (tmp_path / name).read_bytes()
    if name == "a.tiff":
        data = data.replace(struct.pack("<HHII", 256, 4, 1, 160), struct.pack("<HHII", 256, 4, 1, 900_000))
        data = data.replace(struct.pack("<HHIHH", 256, 3, 1, 160, 0), struct.pack("<HHII", 256, 4, 1, 900_000))
    else:
        data = data.replace(struct.pack("<4i", 0, 0, 159, 119), struct.pack("<4i", 0, 0, 99_999, 99_999))
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FrameRefused, match="declares") as refused:
        read_depth(tmp_path / name, SIZE)
    assert refused.value.reason == "unreadable"


def test_the_most_frequent_size_counts(tmp_path):
    paths = []
    for k, size in enumerate([(4, 3), (4, 3), (5, 3), (4, 3)]):
        paths.append(tmp_path / f"{k}.png")
        assert cv2.imwrite(str(paths[-1]), np.ones(size[::-1], np.uint16))
    (tmp_path / "bad.png").write_bytes(b"")
    assert common_depth_size([tmp_path / "bad.png", *paths]) == (4, 3)
    assert "bad.png" in str(common_depth_size([tmp_path / "bad.png"]))
    assert common_depth_size([]) == "there is no image"


def test_without_openexr_the_line_to_install_it_is_named(tmp_path, monkeypatch):
    (tmp_path / "a.exr").write_bytes(b"\x76\x2f\x31\x01")
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(MissingExtra, match=r"stereovox\[exr\]"):
        read_depth(tmp_path / "a.exr", SIZE)
