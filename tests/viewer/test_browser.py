# SPDX-License-Identifier: Apache-2.0
"""The page as a person sees it: headless Chromium opens it once, and pixels and words are looked at."""

import io
import shutil
import time
from contextlib import closing

import made_along as made
import numpy as np
import pytest

import stereovox as sv
from stereovox.frame import Viewpoint
from stereovox.maps import State
from stereovox.viewer.frame import Replay
from stereovox.viewer.viewer import open_viewer

SWITCHES = (
    "no-sandbox disable-quic no-first-run disable-background-networking disable-component-update disable-sync "
    "use-gl=angle use-angle=swiftshader enable-unsafe-swiftshader ignore-gpu-blocklist"
)
FLAGS = [f"--{switch}" for switch in SWITCHES.split()]
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SIZE, WIDE, HIGH = 0.1, 900, 460
SCENE = slice(100, 360), slice(150, 520)
"""Rows and columns of the picture that no panel covers."""
PATIENCE_S = 60


@pytest.fixture(scope="module")
def page():
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as started:
        browser = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser.new_page(viewport={"width": WIDE, "height": HIGH})
        browser.close()


@pytest.fixture(scope="module")
def viewer(page):
    """A wall along x as seen from the front, with free cells before it, and a recording."""
    cells = np.argwhere(np.ones((20, 6, 16)))
    log_odds = np.where(cells[:, 1] == 5, np.where(cells[:, 0] < 10, 3.0, 1.2), -2.0)
    voxel_map = sv.VoxelMap.from_cells(
        sv.load_config(voxel_size=SIZE, max_range=4.0, **{"map.prior": 0.5}), cells, log_odds
    )
    look = np.array([[1.0, 0, 0, 1.0], [0, 0, 1, 0.3], [0, -1, 0, 0.8], [0, 0, 0, 1]])
    voxel_map.viewpoint = Viewpoint(made.CAMERA, look)
    with closing(open_viewer(voxel_map, "wall", port=0)) as one:
        Replay(one, made.Along(), voxel_map.config)
        one.server.initial_camera.position, one.server.initial_camera.look_at = (1.9, -1.7, 0.8), (1.9, 0.5, 0.8)
        one.cameras.last.value = False
        page.goto(one.url)
        until(lambda: shares(page)["drawn"] > 0.05)
        yield one


def shares(page):
    """What the scene's pixels look like: the share that is drawn, and of that the greenish, the reddish, the bluish."""
    from PIL import Image

    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)[SCENE]
    vivid = np.ptp(picture, axis=2) > 24
    red, green, blue = np.moveaxis(picture, 2, 0)
    kinds = {"drawn": vivid, "red": vivid & (red > np.maximum(green, blue)), "blue": vivid & (blue > red + 30)}
    rows = picture.shape[0] // 2
    halves = {"top": picture[:rows][vivid[:rows]], "bottom": picture[rows:][vivid[rows:]]}
    means = {name: part.mean(axis=0) if len(part) else np.zeros(3) for name, part in halves.items()}
    return {name: kind.mean() for name, kind in kinds.items()} | means


def until(holds):
    """Wait until the page shows what it should."""
    end = time.monotonic() + PATIENCE_S
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.1)


def tick(page, label):
    """Click a check box as a person does."""
    page.get_by_label(label, exact=True).click()


def test_occupied_cells_have_the_colours_of_their_heights(page, viewer):
    seen = shares(page)
    assert seen["red"] < 0.05
    assert seen["top"][1] > seen["top"][2] + 20  # viridis: yellow and green above, violet and blue below
    assert seen["bottom"][2] > seen["bottom"][1] + 10


def test_the_probability_has_other_colours(page, viewer):
    viewer.cells.colour.value = "probability"
    until(lambda: shares(page)["red"] > 0.1)
    viewer.cells.colour.value = "height"
    until(lambda: shares(page)["red"] < 0.05)


def test_free_cells_and_the_slice_come_when_ticked(page, viewer):
    before = shares(page)["blue"]
    tick(page, "free")
    until(lambda: viewer.cells.show[State.FREE].value)
    until(lambda: shares(page)["blue"] > before + 0.01)
    tick(page, "free")
    until(lambda: shares(page)["blue"] < before + 0.003)
    viewer.layer.across.value = "y"
    tick(page, "show")
    until(lambda: shares(page)["blue"] > before + 0.1)  # free cells of the plane stand before the wall
    tick(page, "show")
    until(lambda: shares(page)["blue"] < before + 0.05)


def test_two_clicks_measure(page, viewer):
    viewer.measure.on.value = True
    viewer.measure.text.content = "ready"  # messages are taken in order: clicks count when this is there
    page.get_by_text("ready", exact=True).wait_for()
    middle = HIGH / 2 + 6  # not between two cells
    centre = page.locator("canvas").first.bounding_box()["width"] / 2
    page.mouse.click(centre - 60, middle)
    until(lambda: len(viewer.measure.picked) == 1)
    page.mouse.click(centre - 160, middle)
    until(lambda: len(viewer.measure.picked) == 2)
    first, second = viewer.measure.picked
    assert first[1] == second[1] == pytest.approx(0.55)
    assert first[2] == second[2]
    client = next(iter(viewer.server.get_clients().values()))
    away = 0.5 - client.camera.position[1]
    metres = 100 / HIGH * 2 * np.tan(client.camera.fov / 2) * away
    assert abs(np.linalg.norm(second - first) - metres) <= SIZE
    page.get_by_text(f"{np.linalg.norm(second - first):.2f} m").first.wait_for(state="attached")
    viewer.measure.on.value = False


def test_the_timeline_changes_the_depth_image(page, viewer):
    image = page.locator('img[src^="blob:"]').first
    before = image.get_attribute("src")
    page.get_by_role("slider").first.focus()
    page.keyboard.press("ArrowLeft")
    until(lambda: image.get_attribute("src") != before)
    page.get_by_text("frame 10", exact=False).first.wait_for()


def test_both_themes_can_be_read(page, viewer):
    for dark in (True, False):
        viewer.dark.value = dark
        until(lambda dark=dark: can_be_read(page, dark))


def test_the_controls_stand_beside_the_map_and_leave_a_phone_most_of_its_screen(page, viewer):
    canvas = page.locator("canvas").first
    assert canvas.bounding_box()["width"] < page.get_by_text("colour", exact=True).first.bounding_box()["x"]
    phone = page.context.browser.new_page(viewport={"width": 390, "height": 844})
    try:
        phone.goto(viewer.url)
        name = phone.get_by_text("wall", exact=True).first
        name.wait_for()
        until(lambda: name.bounding_box()["y"] > 0.75 * 844)
        assert phone.locator("canvas").first.bounding_box()["width"] == 390
        far = as_seen(viewer, 390)
        assert far > 1.5 * np.linalg.norm(np.subtract((1.9, -1.7, 0.8), (1.9, 0.5, 0.8)))
    finally:
        phone.close()


def as_seen(viewer, width):
    """Return the distance from a page of this width to what it looks at, once it stands where it should."""
    (client,) = (one for one in viewer.server.get_clients().values() if one.camera.image_width == width)
    stands = viewer._stand(client.camera.aspect)
    until(lambda: np.linalg.norm(client.camera.position - stands) < 0.01)
    return np.linalg.norm(client.camera.position - client.camera.look_at)


def can_be_read(page, dark):
    """Tell whether a word stands out, and from what: most of its picture is the page below."""
    from PIL import Image

    picture = page.get_by_text("occupied", exact=True).first.screenshot()
    grey = np.asarray(Image.open(io.BytesIO(picture)).convert("L")).astype(int)
    return np.ptp(grey) > 60 and (np.median(grey) < 80) == dark
