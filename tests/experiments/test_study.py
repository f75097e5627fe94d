"""Long studies go on where they were stopped."""

import numpy as np
import pytest
import xarray as xr

from experiments.study import remembered


class Maker:
    def __init__(self, value=1.0, fails=False):
        self.value, self.fails, self.made = value, fails, 0

    def __call__(self):
        self.made += 1
        if self.fails:
            raise KeyboardInterrupt
        return xr.Dataset({"a": (("x",), np.full(3, self.value)), "b": (("x",), np.array([True, False, True]))})


def test_a_part_is_made_once_for_a_setting(tmp_path):
    make = Maker(2.0)
    first, second = (remembered(tmp_path, "one", ["seed", 3], make) for _ in range(2))
    assert make.made == 1 and first.identical(second)
    assert second.b.dtype == bool
    assert float(remembered(tmp_path, "one", ["seed", 4], Maker(5.0)).a[0]) == 5
    assert float(remembered(tmp_path, "two", ["seed", 4], Maker(6.0)).a[0]) == 6


def test_what_is_stopped_leaves_nothing_half_done(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        remembered(tmp_path, "one", 0, Maker(fails=True))
    assert not list(tmp_path.rglob("*.nc*"))
    (tmp_path / "parts").mkdir()
    assert float(remembered(tmp_path, "one", 0, Maker(7.0)).a[0]) == 7
