"""Find the face in a photograph, fixation by fixation, and race the search of the whole image (thesis 5.6)."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import xarray as xr
from hydra.utils import instantiate
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

from apmodels import DetectorSearch, ValueOutOfRange
from controllers import rollout
from experiments.study import Result
from hardware import PhotoError, PhotoEye, read_photo, whole_image

# The whole-image search takes about half a microsecond a pixel; from here on it is worth saying so.
SLOW_PIXELS = 4_000_000


def astronaut() -> np.ndarray:
    """Return scikit-image's astronaut enlarged to 1024 x 1024, uint8 RGB."""
    from skimage.data import astronaut as photo

    return cv2.resize(photo(), (1024, 1024), interpolation=cv2.INTER_CUBIC)


def find_face(config: Any, folder: Path, console: Console) -> Result:
    """Search one photograph with the eye and with the whole-image cascade; see ``conf/experiment/find_face.yaml``."""
    photo = astronaut() if config.photo is None else read_photo(str(config.photo))
    try:
        search = Search(config, photo, console)
    except PhotoError as error:
        # The eye was given pixels, and does not know where they came from.
        raise PhotoError(str(error).replace("The photo", f"'{config.photo}'", 1)) from None
    search.look()
    search.race()
    summary = search.summary()
    _tell(console, summary)
    from experiments.find_face_figure import draw

    return Result(summary, {"find_face": search.data}, {"find_face": draw(search)})


def _made(group: str, make: Any, *values: Any, **named: Any) -> Any:
    """Make what a configuration group chose; what cannot be made here is the user's to choose otherwise."""
    try:
        return make(*values, **named)
    except PhotoError:
        raise
    except (TypeError, ValueError) as error:
        raise ValueOutOfRange(f"this {group} does not serve find_face: {error}") from error


class Search:
    """One photograph, one eye, and what became of them."""

    def __init__(self, config: Any, photo: np.ndarray, console: Console):
        self.config, self.photo, self.console = config, photo, console
        self.model = instantiate(config.model)
        if not isinstance(self.model, DetectorSearch):
            raise ValueOutOfRange(
                f"find_face counts a detector's boxes, which {type(self.model).__name__} knows nothing of"
            )
        self.grid = self.model.grid
        numbers = isinstance(config.threshold, int | float) and isinstance(config.fixations, int)
        if not numbers or not 0 < config.threshold <= 1 or config.fixations < 1:
            raise ValueOutOfRange(
                "threshold must lie in (0, 1] and fixations be 1 or more, "
                f"not {config.threshold} and {config.fixations}"
            )
        if not isinstance(config.seed, int | None):
            raise ValueOutOfRange(f"seed must be a whole number, not {config.seed}")
        grid = (self.grid.rows, self.grid.columns)
        self.eye: PhotoEye = _made("body", instantiate(config.body), photo=photo, grid=grid)
        # Tables and detectors are made once and serve any number of photographs: that is not search. Nor is the
        # first update, in which torch sets itself up.
        self.engine = instantiate(config.engine)(self.model).prepare()
        self.engine.update(self.engine.start(), 0, torch.zeros(self.grid.size)).most_probable()
        self.controller = _made("controller", instantiate(config.controller), self.engine)
        self.box: np.ndarray | None = None
        self.closer = 0.0
        self.data = xr.Dataset()

    def look(self) -> None:
        """Fixate until a face is confirmed, a fixation repeats, or there are no more fixations."""
        self.data = rollout(
            self.eye, self.engine, self.controller, self.config.fixations, self.config.seed, until=self._done
        )

    def _done(self, belief: Any, action: Any) -> bool:
        looks = len(self.eye.fixations)
        cell = int(belief.most_probable())
        most = float(belief.marginal("target").probs[cell])
        row, column = divmod(int(action), self.grid.columns)
        self.console.print(
            f"fixation {looks:2d}: row {row:2d}, column {column:2d};  most probable: "
            f"row {cell // self.grid.columns:2d}, column {cell % self.grid.columns:2d} ({most:.3f});  "
            f"{self.eye.milliseconds[-1]:5.1f} ms",
            soft_wrap=True,
        )
        repeated = int(action) in self.eye.fixations[:-1]
        if most >= self.config.threshold or repeated:
            before = time.perf_counter()
            self.box = self.eye.confirm(cell)
            self.closer += time.perf_counter() - before
        return repeated or self.box is not None

    def race(self) -> None:
        """Search the whole image with the cascade at scale factor 1.1, whatever detector the eye has."""
        self.rival, self.rival_milliseconds = None, float("nan")
        if not self.config.whole_image:
            return
        columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
        with Progress(
            *columns, transient=True, console=self.console, disable=self.photo[..., 0].size < SLOW_PIXELS
        ) as bar:
            bar.add_task("searching the whole image")
            self.rival, self.rival_milliseconds = whole_image(self.photo)

    @property
    def milliseconds(self) -> float:
        """What the search took: choosing, looking, believing, and looking closer."""
        parts = [self.data[f"{part}_seconds"].sum().item() for part in ("act", "body", "update")]
        return (sum(parts) + self.closer) * 1e3

    def cells(self, box: np.ndarray) -> np.ndarray:
        """Return the (row, column) of a box's centre in cells, real numbers."""
        centre = box[:2] + box[2:] / 2
        return centre / np.array(self.photo.shape[:2]) * (self.grid.rows, self.grid.columns)

    def summary(self) -> dict[str, Any]:
        """Return the flat summary; NaN where there is no face to speak of."""
        final = self.data["marginal"].values[0, -1]
        cell = int(final.argmax())
        both = self.box is not None and self.rival is not None
        where = divmod(cell, self.grid.columns) if self.box is not None else (float("nan"),) * 2
        distance = np.linalg.norm(self.cells(self.box) - self.cells(self.rival)) if both else float("nan")  # type: ignore[arg-type]
        return {
            "found": int(self.box is not None),
            "fixations": self.data.sizes["time"],
            "row": where[0],
            "column": where[1],
            "belief": float(final[cell]),
            "milliseconds": self.milliseconds,
            "whole_image_milliseconds": self.rival_milliseconds,
            "speedup": self.rival_milliseconds / self.milliseconds,
            "distance_to_whole_image_cells": float(distance),
            "whole_image_found": int(self.rival is not None) if self.config.whole_image else float("nan"),
        }


def _tell(console: Console, summary: dict[str, Any]) -> None:
    """Say in a line what was found, and how the race went if there was one."""
    found = f"a face at row {summary['row']}, column {summary['column']}" if summary["found"] else "no face found"
    told = f"{found}, after {summary['fixations']} fixations and {summary['milliseconds']:.1f} ms"
    if np.isfinite(summary["speedup"]):
        rival = "found one" if summary["whole_image_found"] else "found none"
        told += f"; the whole-image search {rival} in {summary['whole_image_milliseconds']:.0f} ms"
        told += f" ({summary['speedup']:.1f} times as long)"
    console.print(told, soft_wrap=True)
