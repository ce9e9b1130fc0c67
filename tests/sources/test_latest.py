"""The newest frames of a camera that does not wait. No clock: camera and map tell each other when to go on."""

import threading
import weakref

import numpy as np
import pytest

import stereovox as sv
from stereovox.cameras.pinhole import PinholeCamera
from stereovox.errors import SourceError
from stereovox.opening import Stream, open_stream
from stereovox.sources.base import Excerpt
from stereovox.sources.latest import LatestStream

CAMERA = PinholeCamera(8, 6, 6.0, 6.0, 3.5, 2.5)


class Camera(Stream):
    """Delivers numbers when the test says so; `closed` once it has been stopped."""

    name, camera, notes = "fake:", CAMERA, ("a note",)

    def __init__(self, error=None):
        self.go, self.closed, self.delivered, self._error = threading.Semaphore(0), threading.Event(), 0, error
        self._done = threading.Semaphore(0)

    def deliver(self, count):
        """Let the camera take so many frames, and wait until it has handed them over."""
        for _ in range(count):
            self.go.release()
        for _ in range(count):
            assert self._done.acquire(timeout=30)

    def __iter__(self):
        try:
            while True:
                assert self.go.acquire(timeout=30)
                if self._error is not None and self.delivered == 3:
                    raise self._error
                self.delivered += 1
                yield self.delivered
                self._done.release()  # asked for the next: this one was taken over
        finally:
            self.closed.set()


def threads():
    return [thread for thread in threading.enumerate() if thread.name == "stereovox-camera"]


def started(camera, waiting=2):
    """Return a `Latest` and its iterator after the first frame."""
    latest = sv.Latest(camera, waiting)
    frames = iter(latest)
    camera.go.release()
    assert next(frames) == 1
    assert camera._done.acquire(timeout=30)
    return latest, frames


def stop(camera, frames):
    camera.go.release()  # what it takes last, so that the test need not wait for it
    frames.close()
    assert camera.closed.wait(30)
    assert not threads()


def test_a_slow_map_gets_the_newest_frames_in_order_and_the_oldest_are_dropped():
    camera = Camera()
    latest, frames = started(camera)
    camera.deliver(100)
    assert latest.dropped == 98
    assert [next(frames), next(frames)] == [100, 101]
    camera.deliver(1)
    assert next(frames) == 102
    assert latest.dropped == 98
    stop(camera, frames)


def test_a_quick_map_gets_every_frame():
    camera = Camera()
    latest, frames = started(camera)
    for number in range(2, 50):
        camera.deliver(1)
        assert next(frames) == number
    assert latest.dropped == 0
    stop(camera, frames)


@pytest.mark.parametrize("waiting", [1, 5])
def test_no_more_frames_are_kept_than_may_wait(waiting):
    class Image(np.ndarray):
        pass

    images = [np.zeros(4).view(Image) for _ in range(40)]
    alive = [weakref.ref(image) for image in images]
    handed_over, end = threading.Event(), threading.Event()

    def camera():
        while images:
            yield images.pop()
        handed_over.set()
        end.wait(30)

    latest = sv.Latest(camera(), waiting)
    frames = iter(latest)
    taken = [next(frames)]
    assert handed_over.wait(30)
    assert sum(one() is not None for one in alive) <= waiting + 2  # and: the one in my hand, the one in the camera's
    end.set()
    taken += list(frames)
    assert len(taken) <= waiting + 1
    assert latest.dropped + len(taken) == 40


def test_the_end_of_the_camera_is_the_end_of_the_frames_and_none_is_lost_there():
    latest = sv.Latest(iter(range(2)))
    assert list(latest) == [0, 1]
    assert list(latest) == []
    assert not threads()


def test_what_the_camera_raises_comes_after_the_frames_before_it():
    camera = Camera(SourceError("fake: pulled out; plug it in again"))
    _, frames = started(camera)
    camera.deliver(2)
    camera.go.release()
    assert [next(frames), next(frames)] == [2, 3]
    with pytest.raises(SourceError, match="pulled out"):
        next(frames)
    assert camera.closed.is_set()
    assert not threads()


def test_a_camera_that_cannot_start_says_so():
    class Broken(Camera):
        def __iter__(self):
            raise SourceError("fake: no such mode")

    with pytest.raises(SourceError, match="no such mode"):
        next(iter(sv.Latest(Broken())))


def test_a_map_that_stops_stops_the_camera_and_it_can_start_again():
    camera = Camera()
    for first in (1, 3):
        frames = iter(sv.Latest(camera))
        camera.go.release()
        assert next(frames) == first
        camera.closed.clear()
        stop(camera, frames)
        camera.delivered = first + 1
        while camera.go.acquire(blocking=False):
            pass


def test_ctrl_c_in_the_map_stops_the_camera():
    camera = Camera()

    def mapping():
        for _ in sv.Latest(camera):
            camera.go.release()
            raise KeyboardInterrupt

    camera.go.release()
    with pytest.raises(KeyboardInterrupt):
        mapping()
    assert camera.closed.wait(30)
    assert not threads()


def test_live_streams_are_read_so_and_tell_what_was_dropped(monkeypatch):
    camera = Camera()

    class Fake:
        @classmethod
        def recognises(cls, where):
            return where.startswith("fake:")

        def __new__(cls, where):
            return camera

    monkeypatch.setattr("stereovox.opening._live_class", lambda where: Fake if Fake.recognises(where) else None)
    stream = open_stream("fake:")
    assert isinstance(stream, LatestStream)
    assert (stream.name, stream.camera, stream.notes, stream.length) == ("fake:", CAMERA, ("a note",), None)
    some = open_stream("fake:", ":3")
    assert isinstance(some, Excerpt)
    frames = iter(some)
    camera.go.release()
    assert next(frames) == 1
    assert camera._done.acquire(timeout=30)
    camera.deliver(6)
    assert some.dropped == 4
    camera.go.release()
    assert list(frames) == [6, 7]  # three that were taken, not three that were delivered
    assert camera.closed.wait(30)
    assert stream.dropped == 0


def test_a_recording_drops_nothing():
    assert open_stream("sim:room").dropped == 0
