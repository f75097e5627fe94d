"""A head of a camera and motors: who is closed when, and what it learns of itself."""

import cv2
import numpy as np
import pytest
import torch

from apmodels import LearningToLook
from hardware import Body, CameraError, Dynamixel, MotorError, PanoramaHead, PanTiltCamera
from inference import RaoBlackwell
from tests.hardware.fake_servos import FakeDynamixel


class Eye:
    """Gives an image, or a complaint."""

    def __init__(self, image=None):
        self.image, self.closed, self.fails = np.full((3, 4), 0.5) if image is None else image, 0, None

    def read(self):
        if self.fails is not None:
            raise self.fails
        return self.image

    def close(self):
        self.closed += 1


@pytest.fixture
def port():
    with FakeDynamixel() as port:
        yield port


def drive(port):
    return Dynamixel(port.name, patience=0.2)


def torques(port):
    return [servo.torque for servo in port.servos.values()]


def test_a_head_is_a_body(port):
    eye = Eye()
    with PanTiltCamera(eye, drive(port), settle=0) as head:
        assert isinstance(head, Body) and head.motors == 2 and head.size == (3, 4)
        image = head.step([0.2, -0.1])
        assert isinstance(image, torch.Tensor) and image.dtype == torch.float32 and image.shape == (3, 4)
        assert port.servos[1].position == pytest.approx(2048 + 137, abs=35)
        head.reset(3)
        assert [servo.goal for servo in port.servos.values()] == [2048, 2048]
        assert torques(port) == [1, 1] and not eye.closed
    assert torques(port) == [0, 0] and eye.closed
    with pytest.raises(MotorError, match="closed"):
        head.step([0, 0])


@pytest.mark.parametrize("error", [CameraError("gone"), KeyboardInterrupt()])
def test_a_head_that_sees_nothing_lets_go(port, error):
    eye = Eye()
    head = PanTiltCamera(eye, drive(port), settle=0)
    head.step([0, 0])
    eye.fails = error
    with pytest.raises(type(error)):
        head.step([0.1, 0])
    assert torques(port) == [0, 0]
    eye.fails = None
    head.step([0, 0])
    assert torques(port) == [1, 1]
    head.close()
    assert torques(port) == [0, 0]


def test_with_closes_both_whatever_happens(port):
    eye = Eye()
    with pytest.raises(ZeroDivisionError), PanTiltCamera(eye, drive(port), settle=0) as head:
        head.step([0, 0])
        raise ZeroDivisionError
    assert torques(port) == [0, 0] and eye.closed == 1


@pytest.mark.parametrize("image", [np.zeros((3, 4, 3)), np.zeros(0)])
def test_a_head_that_cannot_be_made_closes_both(port, image):
    eye, motors = Eye(image), drive(port)
    with pytest.raises(CameraError, match=r"\(rows, columns\)"):
        PanTiltCamera(eye, motors)
    assert eye.closed == 1 and motors.bus.closed
    with pytest.raises(CameraError, match="settles"):
        PanTiltCamera(Eye(), drive(port), settle=-1)


class Scenery:
    """What a camera on the fake servos would see of a panorama."""

    def __init__(self, port, size):
        random = np.random.default_rng(0)
        image = np.zeros((500, 1000), np.float32)
        for cells in (8, 20, 50):
            coarse = random.normal(size=(cells, 2 * cells)).astype(np.float32)
            image += cv2.resize(coarse, (1000, 500), interpolation=cv2.INTER_CUBIC)
        self.port, self.view = port, PanoramaHead(np.clip(127 + 60 * image, 0, 255).astype(np.uint8), size=size)

    def angles(self):
        return np.array([(servo.position - 2048) * 360 / 4096 for servo in self.port.servos.values()])

    def read(self):
        return self.view.render(self.angles())

    def close(self):
        pass


def test_a_head_learns_what_its_motors_do(port):
    size, scenery = (60, 80), Scenery(port, (60, 80))
    # As many degrees a unit as there are: the second motor turns the other way.
    with PanTiltCamera(scenery, Dynamixel(port.name, unit=[60, -40], patience=0.2), settle=0) as head:
        engine = RaoBlackwell(LearningToLook(view=size, field=(180, 240), slip=5.0), particles=1)
        belief, place, random = engine.start(), np.zeros(2), np.random.default_rng(1)
        pixels, commands = [], []
        for movement in range(13):
            goal = random.uniform(-0.4, 0.4, 2) if movement else place
            before = scenery.angles()
            command, place = goal - place, goal
            image = head.step(command)
            pixels.append(scenery.view.flow(before, scenery.angles()))
            commands.append(command)
            belief = engine.update(belief, torch.as_tensor(command, dtype=torch.float32), image)
    u, m = np.stack(commands)[1:], np.stack(pixels)[1:]
    seen = np.isfinite(m).all(1)
    best = np.linalg.lstsq(u[seen], m[seen], rcond=None)[0].T
    learned = belief.marginal("actuation").mean.numpy()
    assert np.linalg.norm(learned - best) < 0.08 * np.linalg.norm(best)
    # To the right: what is seen goes left. Down, by a unit below 0: what is seen goes up.
    assert learned[0, 0] < -60 and learned[1, 1] < -40
