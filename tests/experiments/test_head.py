"""``apmodels head check``, with a simulated head, and with fake servos."""

import signal
import sys
import time

import cv2
import numpy as np
import pytest
from matplotlib.image import imread

from experiments import head
from hardware import PanoramaHead
from tests.experiments.test_cli import apmodels, one_sentence, start
from tests.hardware.fake_servos import FakeDynamixel, FakeFeetech, FakeMaestro


def photograph():
    """As detailed as photographs are, coarse and fine."""
    random, image = np.random.default_rng(0), np.zeros((600, 1200), np.float32)
    for cells in (8, 20, 50, 120):
        coarse = random.normal(size=(cells, 2 * cells)).astype(np.float32)
        image += cv2.resize(coarse, (1200, 600), interpolation=cv2.INTER_CUBIC)
    return np.clip(127 + 40 * image, 0, 255).astype(np.uint8)


SCENE = photograph()


class Eye:
    """A camera on fake servos; ``share`` of each motor's way turns it, and noise is all there is in the dark."""

    def __init__(self, port, share=(1.0, 1.0), dark=False):
        self.port, self.share, self.dark = port, share, dark
        self.view, self.random = PanoramaHead(SCENE, size=head.SIZE), np.random.default_rng(0)

    def read(self):
        servos = list(self.port.servos.values())[:2]
        # Where no pulse was, a hobby servo stands in the middle.
        steps = [(s.position or 6000) - (6000 if isinstance(self.port, FakeMaestro) else 2048) for s in servos]
        seen = self.view.render(np.array(steps) * 360 / 4096 * self.share)
        return np.clip((0 if self.dark else seen) + self.random.normal(0, 0.02, head.SIZE), 0, 1).astype(np.float32)

    def close(self):
        pass


@pytest.fixture
def check(monkeypatch, capsys, tmp_path):
    """Run the command in this process, with an eye on fake servos."""

    def check(kind, port, eye, *words):
        monkeypatch.setattr(head, "_camera", lambda word: eye)
        out = tmp_path / "figures" / "check.png"
        monkeypatch.setattr(
            sys, "argv", ["apmodels head", "check", kind, port.name, "--settle=0", f"--out={out}", *words]
        )
        code = head.main()
        assert imread(out).std() > 0.1
        return code, capsys.readouterr().out

    return check


def row(said, name):
    """Of the table: pixels to the right and down, and the verdict, of a motor."""
    (line,) = [line for line in said.splitlines() if line.split()[:1] == [str(name)]]
    words = line.split(maxsplit=5)
    return float(words[2]), float(words[3]), words[5].strip()


def test_a_simulated_head(tmp_path):
    code, said, complaint = apmodels(tmp_path, "head", "check", "--simulated")
    assert code == 0 and not complaint and "wrote outputs/head/check.png" in said
    assert imread(tmp_path / "outputs/head/check.png").shape[2] == 4
    # 6 degrees to the right, and 4 up, at 343 pixels a radian.
    right, down, verdict = row(said, 1)
    assert right == pytest.approx(-36, abs=4) and abs(down) < 2 and verdict == "moves the image left"
    right, down, verdict = row(said, 2)
    assert down == pytest.approx(24, abs=4) and abs(right) < 2 and verdict == "moves the image down"


@pytest.mark.parametrize(
    ("kind", "fake", "names"),
    [("--dynamixel", FakeDynamixel, (1, 2)), ("--feetech", FakeFeetech, (1, 2)), ("--maestro", FakeMaestro, (0, 1))],
)
def test_a_head_of_servos(check, kind, fake, names):
    with fake() as port:
        code, said = check(kind, port, Eye(port), "--step=-0.1")
        assert code == 0
        assert row(said, names[0])[2] == "moves the image right" and row(said, names[1])[2] == "moves the image up"
        assert not any(servo.torque for servo in port.servos.values())


@pytest.mark.parametrize(
    ("eye", "verdict"),
    [
        ({"share": (1, 0)}, "moves nothing: is it plugged in"),
        ({"dark": True}, "sees something else each time: is it dark"),
    ],
)
def test_what_is_amiss_is_said(check, eye, verdict):
    with FakeDynamixel() as port:
        code, said = check("--dynamixel", port, Eye(port, **eye))
        assert code == 1 and verdict in row(said, 2)[2]


def test_ids_and_units(check):
    with FakeDynamixel(3) as port:
        eye = Eye(port)
        code, said = check("--dynamixel", port, eye, "--ids=2", "--unit=30")
        # Three degrees up.
        assert code == 0 and row(said, 2)[1] == pytest.approx(18, abs=3)
        assert not port.servos[1].torques and port.servos[2].torques == [1, 0]


def test_shift():
    # A part of a picture that is further to the right shows what there is further to the left.
    before, after = SCENE[100:340, 300:620] / 255, SCENE[110:350, 280:600] / 255
    kept = before.copy()
    pixels, alike = head.shift(before, after)
    assert pixels == pytest.approx([20, -10], abs=0.3) and alike > 0.3
    assert (before == kept).all()
    assert head.shift(np.zeros((24, 32)), np.zeros((24, 32)))[1] == 0


def test_a_motor_that_does_not_come_back():
    class Lazy(PanoramaHead):
        def step(self, action):
            return super().step(np.maximum(np.asarray(action), 0))

    lazy = Lazy(SCENE, size=head.SIZE, slip=0.0)
    movement = head.move_to_and_fro(lazy, 0, 0.05)
    assert movement.verdict == "moves the image left, and does not come back" and not movement.good


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (320, 240))
    for _ in range(3):
        writer.write(cv2.cvtColor(SCENE[100:340, 300:620], cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("", "required: check"),
        ("look", "invalid choice"),
        ("check", "--simulated is required"),
        ("check --simulated --dynamixel /dev/no", "not allowed with"),
        ("check --simulated --step 0", "not '0'"),
        ("check --simulated --out /dev/null/check.png", "cannot be written"),
        ("check --dynamixel PORT --ids 1,x", "not '1,x'"),
        ("check --dynamixel PORT --ids 1,9 --camera VIDEO", "Motor 9 on"),
        ("check --dynamixel PORT --camera VIDEO --unit 0", "A unit is not 0"),
        ("check --dynamixel PORT --camera VIDEO --settle -1", "settles for 0 seconds"),
        ("check --dynamixel PORT --camera 63", "There is no camera 63"),
        ("check --dynamixel PORT --camera no.mp4", "'no.mp4' is not there"),
        ("check --dynamixel /dev/no --camera VIDEO", "The port /dev/no is not there"),
        ("check --maestro VIDEO --camera VIDEO", "cannot be used"),
    ],
)
def test_mistakes_of_heads_are_one_sentence(monkeypatch, capsys, video, words, said):
    with FakeDynamixel() as port:
        words = [word.replace("PORT", port.name).replace("VIDEO", str(video)) for word in words.split()]
        monkeypatch.setattr(sys, "argv", ["apmodels head", *words])
        with pytest.raises(SystemExit) as left:
            head.main()
        complaint = capsys.readouterr().err
        assert left.value.code == 2 and one_sentence(complaint) and said in complaint
        assert not any(servo.torques for servo in port.servos.values())


def test_no_camera_is_one_sentence(tmp_path):
    # In a process of its own, for FFmpeg would print too, and looks only once whether it should.
    words = ["head", "check", "--dynamixel", "/dev/no", "--camera", "http://127.0.0.1:9/"]
    code, _, complaint = apmodels(tmp_path, *words)
    assert code == 2 and one_sentence(complaint) and "There is no camera http://127.0.0.1:9/" in complaint


def test_a_video_that_no_motor_moves(tmp_path, video):
    with FakeFeetech() as port:
        words = ["--feetech", port.name, "--camera", str(video), "--settle", "0"]
        code, said, complaint = apmodels(tmp_path, "head", "check", *words)
        assert code == 1 and not complaint and row(said, 1)[2].startswith("moves nothing")
        assert [servo.torques for servo in port.servos.values()] == [[1, 0], [1, 0]]


def test_a_head_that_is_interrupted(tmp_path, video):
    with FakeDynamixel() as port:
        words = ["--dynamixel", port.name, "--camera", str(video), "--settle", "60"]
        process = start(tmp_path, "head", "check", *words)
        while not all(servo.torque for servo in port.servos.values()):
            time.sleep(0.01)
            assert process.poll() is None
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
        assert process.returncode == 130 and complaint == "apmodels: interrupted\n"
        assert [servo.torques for servo in port.servos.values()] == [[1, 0], [1, 0]]
