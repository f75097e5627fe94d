"""What docs/heads.md shows runs as it stands there, on fake servos and a fake camera."""

import re
from pathlib import Path

import numpy as np
import pytest

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


def run(monkeypatch, count):
    """Run the first blocks of the page; return their names, and the fake port."""
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 2 and len(blocks[0].splitlines()) <= 10
    monkeypatch.setattr(hardware, "OpenCVCamera", Eye, raising=False)
    with FakeDynamixel() as port:
        names: dict = {}
        for block in blocks[:count]:
            exec(compile(block.replace("/dev/ttyUSB0", port.name), PAGE.name, "exec"), names)
        assert all(servo.torques == [1, 0] * count for servo in port.servos.values())
        return names, port


def test_the_pages_first_lines_run(monkeypatch):
    names, port = run(monkeypatch, 1)
    assert names["image"].shape == (60, 80)
    # From the middle to 12 and -6 degrees.
    assert [servo.goals for servo in port.servos.values()] == [[2048, 2048, 2185], [2048, 2048, 1980]]


@pytest.mark.slow
def test_all_of_the_pages_python_runs(monkeypatch):
    names, _ = run(monkeypatch, 2)
    assert names["belief"].marginal("actuation").mean.shape == (2, 2)


def test_every_link_and_name_of_the_page_is_there():
    text = PAGE.read_text()
    for path in re.findall(r"\]\(([^)]+)\)", text):
        assert (PAGE.parent / path).exists(), path
    for path in re.findall(r"`(hardware/\w+\.py)`", text):
        assert (PAGE.parents[1] / path).exists(), path
    for name in re.findall(r"`(?:hardware\.)?([A-Z]\w+(?:Camera|Error)|Dynamixel|Feetech|Maestro|Motors)\b", text):
        assert getattr(hardware, name)
