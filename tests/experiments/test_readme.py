"""What the README shows runs as it stands there."""

import re
from pathlib import Path

import matplotlib

README = Path(__file__).parents[2] / "README.md"


def test_the_readmes_python_runs():
    matplotlib.use("agg")
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    assert len(blocks) == 2
    names: dict = {"__name__": "readme"}
    for block in blocks:
        exec(compile(block, "README.md", "exec"), names)
    data = names["data"]
    assert data.sizes["episode"] == 100 and data.sizes["time"] == 10
    first, last = (float(data.entropy.isel(time=t).mean()) for t in (0, -1))
    assert last < first / 2


def test_every_path_that_the_readme_names_is_there():
    for path in re.findall(r"\]\(([^)]+)\)", README.read_text()):
        assert (README.parent / path).exists(), path
