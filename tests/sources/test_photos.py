# SPDX-License-Identifier: Apache-2.0
"""Pictures next to depth images: decoding, which belongs to which, whose camera it is; by layout."""

import numpy as np
import pytest
from made_depth import camera_text, matrix_line, posed, render, tum_line, units, write
from PIL import Image

from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import FrameRefused, SourceError
from stereovox.geometry.se3 import rotation_matrix
from stereovox.opening import open_images, open_source
from stereovox.sources.bags.writer import BagWriter
from stereovox.sources.photos import decode_photo, nearest_in_time, photo_size, read_photo, registered

COUNT, SIZE = 4, (64, 48)
"""SIZE: that of the small images of `made_depth`, (width, height)."""
STAMPS = [f"{100 + k / 30:.6f}" for k in range(COUNT)]


def picture(k, size=SIZE):
    """Return RGB (height, width, 3) that is grey 10 (k + 1) in its left half, and twice that in its right."""
    image = np.full((size[1], size[0], 3), 10 * (k + 1), np.uint8)
    image[:, size[0] // 2 :] *= 2
    return image


def save(path, k, size=SIZE):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture(k, size)).save(path)
    return path


def pixels(photo):
    return photo.pixels() if callable(photo.pixels) else photo.pixels


def check(source, late=()):
    for k in range(COUNT):
        photo = source.frame(k).photo
        if k in late:
            assert photo is None
            continue
        grey = pixels(photo)
        assert grey.shape == (photo.camera.height, photo.camera.width)
        assert abs(int(grey[5, 5]) - 10 * (k + 1)) <= 2  # a JPEG is not exact
        assert abs(int(grey[5, -5]) - 20 * (k + 1)) <= 2


def depth_folder(folder, names):
    poses = posed(COUNT)
    for name, T in zip(names, poses, strict=True):
        write(folder / "depth" / f"{name}.png", units(render(T), 5000))
    (folder / "groundtruth.txt").write_text("\n".join(tum_line(s, T) for s, T in zip(STAMPS, poses, strict=True)))
    (folder / "camera-intrinsics.txt").write_text(camera_text())
    return folder


@pytest.mark.parametrize("listed", ["rgb.txt", "associations.txt", ""])
@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_a_tum_folder(tmp_path, listed, suffix):
    """Pictures are some milliseconds off; one is missing."""
    folder = depth_folder(tmp_path, STAMPS)
    times = [f"{float(s) + 0.007:.6f}" for s in STAMPS]
    for k in (0, 1, 3):
        save(folder / "rgb" / f"{times[k]}{suffix}", k)
    if listed == "rgb.txt":
        (folder / listed).write_text("# colour\n" + "\n".join(f"{times[k]} rgb/{times[k]}{suffix}" for k in (3, 0, 1)))
    elif listed:
        rows = [f"{times[k]} rgb/{times[k]}{suffix} {STAMPS[k]} depth/{STAMPS[k]}.png" for k in range(COUNT)]
        (folder / listed).write_text("\n".join(rows))
    for source in (open_source(folder), open_images(folder)):
        if listed == "associations.txt":  # names the missing one too
            with pytest.raises(FrameRefused, match="put it back"):
                pixels(source.frame(2).photo)
            assert pixels(source.frame(3).photo)[5, 5] == pytest.approx(40, abs=2)
        else:
            check(source, late=[2])
        assert source.frame(0).photo.camera.fx == source.camera.fx
        assert np.array_equal(source.frame(0).photo.T_sensor_camera, np.eye(4))


def test_a_list_of_pictures_that_leads_out_of_the_folder_is_not_followed(tmp_path):
    folder = depth_folder(tmp_path / "walk", STAMPS)
    save(tmp_path / "secret.png", 0)
    (folder / "associations.txt").write_text("\n".join(f"{s} ../secret.png {s} depth/{s}.png" for s in STAMPS))
    assert [frame.photo for frame in open_source(folder)] == [None] * COUNT


def test_pictures_of_twice_the_size_have_a_camera_of_twice_the_size(tmp_path):
    folder = depth_folder(tmp_path, STAMPS)
    for k, stamp in enumerate(STAMPS):
        save(folder / "rgb" / f"{stamp}.png", k, (128, 96))
    source = open_source(folder)
    check(source)
    camera = source.frame(0).photo.camera
    assert (camera.width, camera.fx, camera.cx) == (128, 2 * source.camera.fx, 2 * source.camera.cx + 0.5)


def test_a_seven_scenes_folder_has_a_colour_camera_beside_the_depth_camera(tmp_path):
    for k, T in enumerate(posed(COUNT)):
        write(tmp_path / f"frame-{k:06}.depth.png", units(render(T), 1000))
        save(tmp_path / f"frame-{k:06}.color.jpg", k)
        np.savetxt(tmp_path / f"frame-{k:06}.pose.txt", T)
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text())
    with pytest.raises(FrameRefused, match="no camera is known for its size"):  # not of 640x480
        pixels(open_source(tmp_path).frame(0).photo)
    (tmp_path / "color-intrinsics.txt").write_text("50 0 31\n0 51 23\n0 0 1\n")
    for source in (open_source(tmp_path), open_images(tmp_path)):
        check(source)
        photo = source.frame(1).photo
        assert (photo.camera.fx, photo.camera.fy, photo.camera.cx) == (50, 51, 31)
        assert np.array_equal(photo.T_sensor_camera[:3, 3], [0.025, 0, 0])


@pytest.mark.parametrize("folder", ["rgb", "color", "image"])
def test_a_plain_folder_uses_pictures_of_its_own_size_only(tmp_path, folder):
    for k, T in enumerate(posed(COUNT)):
        write(tmp_path / f"depth/{k:04}.png", units(render(T), 1000))
        save(tmp_path / folder / f"{k:04}.jpg", k)
    (tmp_path / "camera-intrinsics.txt").write_text(camera_text())
    check(open_images(tmp_path))
    (tmp_path / "poses.txt").write_text("\n".join(map(matrix_line, posed(COUNT))))
    check(open_source(tmp_path))
    for k in range(COUNT):
        save(tmp_path / folder / f"{k:04}.jpg", k, (128, 96))
    assert open_source(tmp_path).frame(0).photo is None


@pytest.mark.parametrize("suffix", [".bag", ".mcap"])
@pytest.mark.parametrize("frame_id", ["camera_depth_optical_frame", "camera_color_optical_frame"])
def test_a_bag_with_colour(tmp_path, suffix, frame_id):
    source = open_source("sim:room?photo=0.5&image_width=64&frames=40", f":{COUNT}")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_matrix([0, 0.02, 0]), (0.015, 0, 0)
    path = tmp_path / f"walk{suffix}"
    with BagWriter(path) as bag:
        if "color" in frame_id:
            bag.fixed("camera_depth_optical_frame", frame_id, T)
        for frame in source:
            bag.depth(frame)
            bag.photo(frame, frame_id=frame_id)
    found = open_images(path)
    for k in range(COUNT):
        photo = found.frame(k).photo
        assert np.array_equal(pixels(photo), pixels(source.frame(k).photo))
        assert photo.T_sensor_camera == pytest.approx(T if "color" in frame_id else np.eye(4), abs=1e-6)


def test_infrared_and_cameras_at_unknown_places_are_left_out(tmp_path):
    source = open_source("sim:room?photo=0.5&image_width=64&frames=40", f":{COUNT}")
    for topic, frame_id in (("/camera/infra1/image", "camera_depth_optical_frame"), ("/color/image", "elsewhere")):
        path = tmp_path / f"{frame_id}.mcap"
        with BagWriter(path) as bag:
            for frame in source:
                bag.depth(frame)
                bag.photo(frame, topic, frame_id)
        assert open_images(path).frame(0).photo is None


def test_a_frame_without_a_picture_has_none_to_write(tmp_path):
    frame = open_source("sim:room?image_width=64").frame(0)
    with pytest.raises(SourceError, match="has no picture"), BagWriter(tmp_path / "a.mcap") as bag:
        bag.photo(frame)


def test_damaged_pictures_are_refused_in_one_line(tmp_path):
    path = save(tmp_path / "a.jpg", 0)
    whole = path.read_bytes()
    for data in (b"", b"no picture", whole[: len(whole) // 2]):
        with pytest.raises(FrameRefused, match=r"a\.jpg: .*copy it again or remove it"):
            decode_photo(data, SIZE, "a.jpg")
    with pytest.raises(FrameRefused, match=r"^a\.jpg: 64x48 pixels, the recording has 10x10; remove it$"):
        decode_photo(whole, (10, 10), "a.jpg")
    with pytest.raises(FrameRefused, match="put it back"):
        read_photo(tmp_path / "none.jpg", SIZE)
    assert photo_size(path) == SIZE
    assert photo_size(tmp_path / "none.jpg") is None


def test_pictures_of_16_bits_keep_the_upper_eight(tmp_path):
    image = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64) * 21
    Image.fromarray(image).save(tmp_path / "a.png")
    assert np.array_equal(read_photo(tmp_path / "a.png", SIZE), image // 256)


def test_pictures_too_large_for_pillow_say_so_in_one_line(tmp_path, monkeypatch, recwarn):
    path = save(tmp_path / "a.png", 0)
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 2000)
    assert photo_size(path) == SIZE
    assert read_photo(path, SIZE).shape == SIZE[::-1]
    assert not recwarn.list


@pytest.mark.parametrize("wrong", ["clock", "shape", "damaged"])
def test_pictures_of_which_none_can_be_used_say_why(tmp_path, wrong):
    folder = depth_folder(tmp_path, STAMPS)
    for k, stamp in enumerate(STAMPS):
        later = f"{float(stamp) + (wrong == 'clock'):.6f}"
        path = save(folder / "rgb" / f"{later}.png", k, (64, 20) if wrong == "shape" else SIZE)
        if wrong == "damaged":
            path.write_bytes(b"no picture")
    source = open_source(folder)
    expected = "do they share a clock" if wrong == "clock" else r"rgb/100\.0+\.png: not read, or"
    for k in range(COUNT):
        with pytest.raises(FrameRefused, match=expected):
            pixels(source.frame(k).photo)


def test_each_image_gets_the_picture_that_is_nearest_in_time():
    random = np.random.default_rng(0)
    images, photos = (random.integers(0, 1000, n).tolist() for n in (50, 70))
    for stamp, k in zip(images, nearest_in_time(images, photos, 8), strict=True):
        away = [abs(photo - stamp) for photo in photos]
        assert min(away) > 8 if k is None else away[k] == min(away) <= 8
    assert nearest_in_time([1, 2], [], 5) == [None, None]


def test_a_registered_camera_sees_the_same_rays():
    camera = PinholeCamera(64, 48, 50, 52, 31, 23)
    double = registered(camera, (128, 96))
    assert double is not None
    assert ((-0.5 - double.cx) / double.fx) == pytest.approx((-0.5 - camera.cx) / camera.fx)
    assert ((127.5 - double.cx) / double.fx) == pytest.approx((63.5 - camera.cx) / camera.fx)
    assert registered(camera, (128, 48)) is None
