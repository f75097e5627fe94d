"""What docs/heads.md shows runs as it stands there, on fake servos and a fake camera."""

import re
from pathlib import Path

import numpy as np

import hardware
from tests.hardware.fake_servos import FakeDynamixel

PAGE = Path(__file__).parents[2] / "docs" / "heads.md"


class Eye:
    def __init__(self, source, size):
        self.size, self.random = size, np.random.default_rng(0)

    def read(self):
        return self.random.random(self.size, np.float32)

    def close(self):
        pass


def test_the_pages_python_runs(monkeypatch):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 2 and len(blocks[0].splitlines()) <= 10
    monkeypatch.setattr(hardware, "OpenCVCamera", Eye, raising=False)
    with FakeDynamixel() as port:
        names: dict = {}
        for block in blocks:
            exec(compile(block.replace("/dev/ttyUSB0", port.name), PAGE.name, "exec"), names)
        assert names["image"].shape == (60, 80)
        assert names["belief"].marginal("actuation").mean.shape == (2, 2)
        assert [servo.torques for servo in port.servos.values()] == [[1, 0, 1, 0]] * 2
        # To the middle, to 12 and -6 degrees; then all four commands.
        assert 2048 + 137 in port.servos[1].goals and 2048 - 68 in port.servos[2].goals


def test_every_link_and_name_of_the_page_is_there():
    text = PAGE.read_text()
    for path in re.findall(r"\]\(([^)]+)\)", text):
        assert (PAGE.parent / path).exists(), path
    for path in re.findall(r"`(hardware/\w+\.py)`", text):
        assert (PAGE.parents[1] / path).exists(), path
    for name in re.findall(r"`(?:hardware\.)?([A-Z]\w+(?:Camera|Error)|Dynamixel|Feetech|Maestro|Motors)\b", text):
        assert getattr(hardware, name)
