"""What a study returns, and how it is kept."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import xarray as xr


@dataclass
class Result:
    """Datasets and figures by file name, without ending, and a flat summary: name -> number."""

    summary: dict[str, Any] = field(default_factory=dict)
    datasets: dict[str, xr.Dataset] = field(default_factory=dict)
    figures: dict[str, Any] = field(default_factory=dict)

    def write(self, folder: Path) -> list[Path]:
        """Write summary.json, *.nc and *.png, each as a whole or not at all; return the paths."""
        import matplotlib.pyplot as plt

        folder.mkdir(parents=True, exist_ok=True)
        paths = []
        for name, data in self.datasets.items():
            paths.append(_whole(folder / f"{name}.nc", lambda path, data=data: data.to_netcdf(path, engine="h5netcdf")))
        for name, figure in self.figures.items():
            paths.append(_whole(folder / f"{name}.png", lambda path, f=figure: f.savefig(path, dpi=120, format="png")))
            plt.close(figure)
        text = json.dumps({key: _plain(value) for key, value in self.summary.items()}, indent=2) + "\n"
        paths.append(_whole(folder / "summary.json", lambda path: path.write_text(text)))
        return paths


def remembered(folder: Path, name: str, setting: Any, make: Callable[[], xr.Dataset]) -> xr.Dataset:
    """Return a part of a long study, from the folder's ``parts`` if an earlier run in it made it, or made now.

    Args:
        folder: the study's.
        name: the part's, a file's name without ending.
        setting: all that the part depends on, as text; a part of another setting is made anew.
        make: makes it.
    """
    path = folder / "parts" / f"{name}.nc"
    if path.exists():
        kept = xr.load_dataset(path, engine="h5netcdf")
        if kept.attrs.get("setting") == str(setting):
            return kept
    made = make().assign_attrs(setting=str(setting))
    path.parent.mkdir(parents=True, exist_ok=True)
    _whole(path, lambda part: made.to_netcdf(part, engine="h5netcdf"))
    return made


def _whole(path: Path, write: Any) -> Path:
    # A run that is stopped half way leaves no half file behind.
    part = path.with_name(path.name + ".part")
    try:
        write(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _plain(value: Any) -> Any:
    """A JSON value; NaN, which JSON lacks, is null."""
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
