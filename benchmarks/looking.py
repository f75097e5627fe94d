"""Learning to look: a step of inference, all offsets at once and one by one, and shifts beside phase correlation.

One thread. The pictures are views of a photographed panorama (``make data``).
"""

from __future__ import annotations

import warnings

import cv2
import numpy as np
import torch
from torch.distributions import Normal

from apmodels import LearningToLook
from benchmarks.timing import milliseconds
from experiments import data
from hardware import PanoramaHead
from inference import RaoBlackwell
from inference.rao_blackwell import DepletionWarning
from inference.worlds.offsets import offset_scores

VIEW, FIELD = (240, 320), (720, 960)
# As many offsets as the thesis's window has at full resolution.
OFFSETS = (160, 213)
SHIFTS = ((0, 40), (40, 80), (80, 120), (120, 160), (160, 200))
TRIALS = 40


def measure() -> dict[str, float]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        return _offsets() | _step() | _particles() | _shifts()
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(-1)


def _head() -> PanoramaHead:
    return PanoramaHead(data.files("panorama", "*.jpg")[0], size=VIEW, slip=0.0)


def _offsets() -> dict[str, float]:
    """The score of an image at every offset, and at one."""
    torch.manual_seed(0)
    large = tuple(small + more - 1 for small, more in zip(VIEW, OFFSETS, strict=True))
    mean, variance = torch.rand(large), torch.where(torch.rand(large) < 0.3, 0.26, 0.012)
    row, column = 70, 100
    part = slice(row, row + VIEW[0]), slice(column, column + VIEW[1])
    seen = mean[part] + 0.1 * torch.randn(VIEW)

    def direct() -> torch.Tensor:
        return Normal(mean[part], variance[part].sqrt(), validate_args=False).log_prob(seen).sum()

    together, one = milliseconds(lambda: offset_scores(seen, mean, variance), direct, inner=5)
    found = offset_scores(seen, mean, variance)
    exact = Normal(mean[part].double(), variance[part].double().sqrt()).log_prob(seen.double()).sum()
    return {
        "all_offsets_ms": together,
        "per_offset_vs_direct": one * OFFSETS[0] * OFFSETS[1] / together,
        "difference.relative": abs(float(found[row, column]) / float(exact) - 1),
    }


def _step() -> dict[str, float]:
    """A whole step of inference, whose window has about as many offsets, in scenes of 4 and of 9 views."""
    head, still, figures = _head(), torch.zeros(2), {}
    image = head.look()
    for rows, columns in ((480, 640), FIELD):
        model = LearningToLook(view=VIEW, field=(rows, columns), gain=1.0, wear=0.1, slip=37.0)
        engine = RaoBlackwell(model, particles=1)
        belief = engine.update(engine.start(), still, image)
        (figures[f"step_ms.{rows}x{columns}"],) = milliseconds(lambda e=engine, b=belief: e.update(b, still, image))
    return {"step_ms": figures["step_ms.480x640"]} | figures


def _particles() -> dict[str, float]:
    """A step of fifty particles at half the resolution, in scenes of 9 views, once motors are known."""
    view, random = (VIEW[0] // 2, VIEW[1] // 2), np.random.default_rng(0)
    head = PanoramaHead(data.files("panorama", "*.jpg")[0], size=view, slip=2.5)
    model = LearningToLook(view=view, field=(FIELD[0] // 2, FIELD[1] // 2), gain=250.0, wear=2.5, slip=10.0)
    engine = RaoBlackwell(model, particles=50)
    belief, command = engine.start(), torch.zeros(2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DepletionWarning)
        for movement in range(15):
            command = torch.as_tensor(random.uniform(-0.2, 0.2, 2) * (movement > 0), dtype=torch.float32)
            image = head.step(command)
            before, belief = belief, engine.update(belief, command, image)
        (spent,) = milliseconds(lambda: engine.update(before, command, image))
    return {"fifty_particles_ms": spent}


def _shifts() -> dict[str, float]:
    """How often the shift between two crops of the panorama is found to two pixels, by how large it is."""
    scene, random = _head().panorama / np.float32(255), np.random.default_rng(1)
    engine = RaoBlackwell(
        LearningToLook(view=VIEW, field=FIELD, gain=1.0, wear=0.1, slip=90.0, noise=0.05), particles=1
    )
    window = cv2.createHanningWindow(VIEW[::-1], cv2.CV_64F)
    # Neither sky nor ground alone: from 40 degrees above the horizon to 40 below.
    middle = np.array([0.28, 0.72]) * scene.shape[0]
    figures = {}
    for low, high in SHIFTS:
        ours = theirs = 0
        for _ in range(TRIALS):
            way, far = random.uniform(0, 2 * np.pi), random.uniform(low, high)
            truth = np.round(far * np.array([np.cos(way), np.sin(way)])).astype(int)
            place = random.uniform(300, scene.shape[1] - 700), random.uniform(*middle) - VIEW[0] / 2
            corner = np.array(place).astype(int)
            views = []
            for column, row in (corner, corner - truth):
                crop = scene[row : row + VIEW[0], column : column + VIEW[1]]
                views.append(np.clip(crop + 0.02 * random.normal(size=VIEW), 0, 1))
            belief = engine.start()
            for view in views:
                belief = engine.update(belief, torch.zeros(2), torch.as_tensor(view, dtype=torch.float32))
            ours += np.abs(belief.values["motion"][0, 0].numpy() - truth).max() <= 2
            # It changes what it is given.
            found, _ = cv2.phaseCorrelate(*(view.copy() for view in views), window)
            theirs += np.abs(np.array(found) - truth).max() <= 2
        figures |= {f"right.{low}_{high}": ours / TRIALS, f"right.phase_correlate.{low}_{high}": theirs / TRIALS}
    return figures
