"""Cameras: video files that are written here, and a fake capture that buffers frames as drivers do."""

import time

import cv2
import numpy as np
import pytest

from hardware import Camera, CameraError, OpenCVCamera, VideoCamera
from hardware.camera import as_grey


def test_grey():
    frame = np.zeros((4, 6, 3), np.uint8)
    frame[:2, :, 1] = 255
    grey = as_grey(frame)
    assert grey.dtype == np.float32 and grey.shape == (4, 6)
    # Rec. 601, which OpenCV goes by.
    assert grey[0, 0] == pytest.approx(0.587, abs=2e-3) and grey[3, 0] == 0
    assert as_grey(np.full((4, 6), 255, np.uint8)).min() == 1


def test_a_size_keeps_the_middle():
    frame = np.zeros((30, 80), np.uint8)
    frame[:, 20:60] = 200
    # Of 80 columns 40 are as wide as 30 rows for 3 by 4; the rest is cut off.
    grey = as_grey(frame, (15, 20))
    assert grey.shape == (15, 20) and grey.min() == pytest.approx(200 / 255)
    assert as_grey(frame, (30, 80)).shape == (30, 80)
    assert as_grey(frame, (60, 80)).shape == (60, 80)
    assert as_grey(frame, (7, 3)).shape == (7, 3)


@pytest.fixture
def video(tmp_path):
    """Five frames, each brighter than the one before."""
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (64, 48))
    for i in range(5):
        writer.write(np.full((48, 64, 3), 50 * i, np.uint8))
    writer.release()
    return path


def test_a_video(video):
    camera = VideoCamera(video, size=(24, 32))
    assert isinstance(camera, Camera)
    frames = [camera.read() for _ in range(5)]
    assert all(frame.shape == (24, 32) and frame.dtype == np.float32 for frame in frames)
    assert [frame.mean() for frame in frames] == pytest.approx([50 * i / 255 for i in range(5)], abs=0.01)
    with pytest.raises(CameraError, match=r"video.avi' has ended, after 5 frames"):
        camera.read()
    camera.close()
    camera.close()
    with pytest.raises(CameraError, match="closed"):
        camera.read()


def test_a_video_that_begins_again(video):
    camera = VideoCamera(video, loop=True)
    frames = [camera.read() for _ in range(12)]
    assert frames[0].shape == (48, 64)
    assert [frame.mean() for frame in frames] == pytest.approx([50 * (i % 5) / 255 for i in range(12)], abs=0.01)
    camera.close()


def test_what_is_no_video(tmp_path):
    (tmp_path / "text.mp4").write_text("no video")
    for path, said in (
        (tmp_path / "no.mp4", "is not there"),
        (tmp_path, "is not there"),
        (tmp_path / "text.mp4", "not a"),
    ):
        with pytest.raises(CameraError, match=said):
            VideoCamera(path)


@pytest.mark.parametrize("size", [(0, 3), (2.5, 3), (3,)])
def test_what_is_no_size(size, video):
    with pytest.raises(CameraError, match="rows and columns"):
        VideoCamera(video, size=size)
    with pytest.raises(CameraError, match="rows and columns"):
        OpenCVCamera(0, size=size)


class Capture:
    """A camera that takes an image every period, and keeps the last four until somebody wants them."""

    def __init__(self, opened=True, period=0.02, frames=10**6):
        self.opened, self.period, self.frames = opened, period, frames
        self.begin, self.next, self.current, self.released = time.monotonic(), 0, None, False

    def isOpened(self):
        return self.opened

    def set(self, name, value):
        return False

    def get(self, name):
        return 1 / self.period

    def grab(self):
        # Older ones than four were dropped.
        self.next = max(self.next, int((time.monotonic() - self.begin) / self.period) - 4)
        if self.next >= self.frames:
            return False
        time.sleep(max(0, self.begin + (self.next + 1) * self.period - time.monotonic()))
        self.current, self.next = self.next, self.next + 1
        return True

    def retrieve(self):
        return True, np.full((3, 4, 3), self.current % 256, np.uint8)

    def began(self, image):
        """When the shutter opened for an image."""
        return self.begin + round(float(image[0, 0]) * 255) * self.period

    def release(self):
        self.released = True


@pytest.fixture
def capture(monkeypatch):
    def install(**given):
        found = Capture(**given)
        monkeypatch.setattr(cv2, "VideoCapture", lambda *_: found)
        return found

    return install


def test_a_camera_shows_what_is_seen_now(capture):
    fake = capture()
    camera = OpenCVCamera(0)
    for pause in (0, 0.005, 0.03, 0.2, 0.011):
        time.sleep(pause)
        asked = time.monotonic()
        image = camera.read()
        # The shutter opened after somebody asked, and not long after.
        assert -1e-3 < fake.began(image) - asked < 10 * fake.period
    camera.close()
    assert fake.released
    with pytest.raises(CameraError, match="closed"):
        camera.read()


def test_a_camera_that_is_unplugged(capture):
    fake = capture(frames=40)
    camera = OpenCVCamera("cam")
    with pytest.raises(CameraError, match="The camera cam gives no images; is it plugged in"):
        for _ in range(40):
            camera.read()
    assert not fake.released
    camera.close()


def test_cameras_that_are_not_there(capture):
    with pytest.raises(CameraError, match="There is no camera 63"):
        OpenCVCamera(63)
    with pytest.raises(CameraError, match=r"There is no camera http://127.0.0.1:9/video"):
        OpenCVCamera("http://127.0.0.1:9/video")
    fake = capture(opened=False)
    with pytest.raises(CameraError, match="There is no camera 0"):
        OpenCVCamera(0)
    assert fake.released
    fake = capture(frames=0)
    with pytest.raises(CameraError, match="gives no images"):
        OpenCVCamera(0)
    assert fake.released
