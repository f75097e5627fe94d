"""Do all engines say the same?  Every engine that bids for a model, on records that all of them share."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from matplotlib.colors import LogNorm
from rich.console import Console
from rich.table import Table

from apmodels import ValueOutOfRange
from apmodels.errors import nearest
from apmodels.progress import progress
from experiments.agreement_models import models
from experiments.study import Result
from inference.brute_force.reference import reference
from inference.check import compare, simulated
from inference.choose import ENGINES, bids

# A quick look has fewer particles, and shorter fits.
QUICK = {"RaoBlackwell": {"particles": 4000}, "Particles": {"particles": 4000}, "Variational": {"iterations": 80}}
# What is done is kept here, so that a run that was stopped goes on.
KEPT = "agreement.part.json"
NAMES = [engine.__name__ for engine in ENGINES]


def agreement(config: Any, folder: Path, console: Console) -> Result:
    """Compare every (model, engine) pair that bids; see ``conf/experiment/agreement.yaml``."""
    made = models()
    chosen = list(made) if config.models is None else list(config.models)
    for name in chosen:
        if name not in made:
            raise ValueOutOfRange(f"there is no model {name} to agree on{nearest(name, made)}")
    if config.steps < 1 or config.records < 1 or config.worlds < 1000:
        raise ValueOutOfRange("agreement needs 1 step, 1 record and 1,000 worlds or more")
    figures = _figures(config, folder, {name: made[name] for name in chosen})
    data = _dataset(figures, chosen)
    _tell(console, figures, chosen)
    return Result(_summary(figures), {"agreement": data}, {"agreement": _draw(data)})


def _figures(config: Any, folder: Path, chosen: dict[str, Any]) -> dict[str, Any]:
    """Errors by model and engine, and each model's reference; what an earlier run has done is not done again."""
    records, worlds = (1, min(config.worlds, 100_000)) if config.quick else (config.records, config.worlds)
    setting = {"seed": config.seed, "steps": config.steps, "records": records, "worlds": worlds, "quick": config.quick}
    path = folder / KEPT
    kept = json.loads(path.read_text()) if path.exists() else {}
    figures = kept.get("figures", {}) if kept.get("setting") == setting else {}
    with progress() as bar:
        task = bar.add_task("agreeing", total=len(chosen))
        for name, model in chosen.items():
            bar.update(task, description=name)
            if name not in figures:
                figures[name] = _compared(model, setting)
                folder.mkdir(parents=True, exist_ok=True)
                path.write_text(json.dumps({"setting": setting, "figures": figures}))
            bar.advance(task)
    path.unlink(missing_ok=True)
    return figures


def _compared(model: Any, setting: dict[str, Any]) -> dict[str, Any]:
    data = [simulated(model, setting["steps"], setting["seed"] + i) for i in range(setting["records"])]
    names = list(model.structure.interest)
    truths = [reference(model, *record, names, setting["worlds"], setting["seed"]) for record in data]
    doubt = max(float(error.max()) for truth in truths for error in truth.errors.values())
    found: dict[str, Any] = {"method": truths[0].method, "reference_error": doubt, "engines": {}, "allowed": {}}
    for name, bid in bids(model).items():
        if not bid:
            continue
        rows = compare(model, name, data, truths, QUICK.get(name) if setting["quick"] else None)
        if rows[0].trouble:
            raise RuntimeError(f"{type(model).__name__} under {name}: {rows[0].trouble}")
        found["engines"][name] = [max(row.error for row in rows), rows[0].evidence_error]
        found["allowed"][name] = all(row.good for row in rows)
    return found


def _summary(figures: dict[str, Any]) -> dict[str, float]:
    summary = {}
    for model, found in figures.items():
        summary[f"{model}.reference_error"] = found["reference_error"]
        for engine, (error, evidence) in found["engines"].items():
            summary[f"{model}.{engine}.error"] = error
            summary[f"{model}.{engine}.evidence_error"] = evidence
    return summary


def _dataset(figures: dict[str, Any], chosen: list[str]) -> xr.Dataset:
    shape = (len(chosen), len(NAMES))
    values = {"error": np.full(shape, np.nan), "evidence_error": np.full(shape, np.nan)}
    for i, model in enumerate(chosen):
        for engine, (error, evidence) in figures[model]["engines"].items():
            values["error"][i, NAMES.index(engine)] = error
            values["evidence_error"][i, NAMES.index(engine)] = evidence
    variables = {name: (("model", "engine"), value) for name, value in values.items()}
    doubts = [figures[model]["reference_error"] for model in chosen]
    variables["reference_error"] = (("model",), np.array(doubts))  # type: ignore[assignment]
    coords = {"model": chosen, "engine": NAMES, "method": ("model", [figures[model]["method"] for model in chosen])}
    return xr.Dataset(variables, coords=coords)


def _tell(console: Console, figures: dict[str, Any], chosen: list[str]) -> None:
    titles = ("Largest error of the interest (! beyond what the engine is allowed)", "Of the log evidence (nats)")
    for k, title in enumerate(titles):
        table = Table(title=title, title_justify="left")
        for column in ("model", *NAMES):
            table.add_column(column, no_wrap=True)
        for model in chosen:
            found = figures[model]
            pairs = {engine: found["engines"].get(engine) for engine in NAMES}
            marks = {engine: "" if k or found["allowed"].get(engine, True) else " !" for engine in NAMES}
            table.add_row(model, *("-" if p is None else f"{p[k]:.1g}{marks[engine]}" for engine, p in pairs.items()))
        console.print(table)
    for model in chosen:
        found = figures[model]
        console.print(f"{model}: held against {found['method']}, ± {found['reference_error']:.1g}")


def _draw(data: xr.Dataset) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(11, 0.45 * data.sizes["model"] + 2), layout="constrained", sharey=True)
    titles = ("error of the interest", "error of the log evidence (nats)")
    for axis, name, title in zip(axes, ("error", "evidence_error"), titles, strict=True):
        # What is nothing but rounding is drawn as such.
        values = data[name].clip(min=1e-9).values
        image = axis.imshow(values, norm=LogNorm(1e-9, 1), cmap="viridis_r", aspect="auto")
        for (i, j), value in np.ndenumerate(data[name].values):
            text = "–" if np.isnan(value) else ("< 1e-9" if value < 1e-9 else f"{value:.1g}")
            dark = not np.isnan(value) and value > 1e-4
            axis.text(j, i, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
        axis.set_xticks(range(data.sizes["engine"]), data.engine.values, rotation=30, ha="right")
        axis.set_yticks(range(data.sizes["model"]), data.model.values)
        axis.set_title(title)
    figure.colorbar(image, ax=axes, label="largest error over records")
    return figure
