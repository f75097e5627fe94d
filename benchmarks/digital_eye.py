"""The digital eye against the search of the whole image, on the astronaut at 1024 x 1024 (thesis ch. 5, 5.6.6)."""

from __future__ import annotations

import io
import statistics

import cv2
import numpy as np
from hydra import compose, initialize_config_module
from rich.console import Console

from experiments.find_face import Search, astronaut
from hardware import CascadeDetector, whole_image

REPEATS = 15
SHRUNK_PIXELS = 320 * 240


def measure() -> dict[str, float]:
    photo = astronaut()
    shrunk = _shrunk(photo)
    coarse = CascadeDetector(scale_factor=1.2)
    searches = {"eye": _search("photo_eye", photo), "published_eye": _search("photo_eye_published", photo)}
    times: dict[str, list[float]] = {name: [] for name in (*searches, "whole_image", "shrunk_image")}
    distances = []
    for repeat in range(REPEATS + 1):  # in turn, so that a busy machine is busy for all; the first is not counted
        now = {name: _look(search, repeat) for name, search in searches.items()}
        box, now["whole_image"] = whole_image(photo)
        _, now["shrunk_image"] = whole_image(shrunk, coarse)
        if repeat:
            distances.append(_distance(searches["eye"], box))
            for name, milliseconds in now.items():
                times[name].append(milliseconds)
    median = {name: statistics.median(values) for name, values in times.items()}
    return {f"{name}_ms": value for name, value in median.items()} | {
        "eye_vs_whole_image": median["whole_image"] / median["eye"],
        "published_eye_vs_whole_image": median["whole_image"] / median["published_eye"],
        "eye_vs_shrunk_image": median["shrunk_image"] / median["eye"],
        "distance_cells": statistics.median(distances),
        "found": statistics.fmean(distance <= 1 for distance in distances),
    }


def _search(body: str, photo: np.ndarray) -> Search:
    with initialize_config_module("conf", version_base="1.3"):
        config = compose("config", ["experiment=find_face", f"body={body}"])
    return Search(config, photo, Console(file=io.StringIO()))


def _look(search: Search, seed: int) -> float:
    """Search once, from another first fixation with every seed; return the milliseconds."""
    search.config.seed, search.box, search.closer = seed, None, 0.0
    search.look()
    return search.milliseconds


def _distance(search: Search, box: np.ndarray | None) -> float:
    """Cells between the eye's face and the whole image's; infinite where one of them found none."""
    if search.box is None or box is None:
        return float("inf")
    return float(np.linalg.norm(search.cells(search.box) - search.cells(box)))


def _shrunk(photo: np.ndarray) -> np.ndarray:
    """As many pixels as 320 x 240 has."""
    height, width = photo.shape[:2]
    scale = (SHRUNK_PIXELS / (height * width)) ** 0.5
    return cv2.resize(photo, (round(width * scale), round(height * scale)), interpolation=cv2.INTER_AREA)
