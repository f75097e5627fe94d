"""Holding every engine that bids for a model against brute force; made for users' own models."""

from __future__ import annotations

import html
import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.progress import tracked
from apmodels.simulation import Values, as_given, seeded
from inference.beliefs import Marginal
from inference.brute_force.reference import WORLDS, Reference, reference
from inference.choose import ENGINES, bids
from inference.engine import Refusal

# What each engine is built with, and how far it may be off: of a probability, or of a mean in standard deviations.
OPTIONS: dict[str, dict[str, Any]] = {
    "Exact": {"dtype": torch.float64},
    "Kalman": {"dtype": torch.float64},
    "RaoBlackwell": {"particles": 20_000, "dtype": torch.float64},
    "Particles": {"particles": 20_000, "dtype": torch.float64},
    "Variational": {"dtype": torch.float64},
}
TOLERANCE = {"Exact": 1e-6, "Kalman": 1e-6, "RaoBlackwell": 0.05, "Particles": 0.05, "Variational": 0.05}
EVIDENCE = {"Exact": 1e-6, "Kalman": 1e-6, "RaoBlackwell": 0.2, "Particles": 0.2, "Variational": 0.2}


@dataclass(frozen=True)
class Row:
    """One engine on one variable: the largest error over records, what is allowed, and what went wrong, if anything."""

    engine: str
    variable: str
    error: float
    evidence_error: float
    allowed: float
    evidence_allowed: float
    trouble: str = ""

    @property
    def good(self) -> bool:
        """Whether the engine agrees with brute force."""
        return not self.trouble and self.error <= self.allowed and self.evidence_error <= self.evidence_allowed


@dataclass(frozen=True)
class Report:
    """What ``check`` found; it prints, and ``bool(report)`` tells whether all engines agree with brute force."""

    model: str
    method: str
    rows: tuple[Row, ...]
    refusals: dict[str, str]

    def __bool__(self) -> bool:
        return all(row.good for row in self.rows)

    def __str__(self) -> str:
        lines = [f"{self.model} against {self.method}", ""]
        head = ["engine", "variable", "error", "allowed", "log evidence", "allowed", ""]
        table = [head]
        for row in self.rows:
            figures = [
                f"{row.error:.2g}",
                f"{row.allowed:.2g}",
                f"{row.evidence_error:.2g}",
                f"{row.evidence_allowed:.2g}",
            ]
            verdict = "agrees" if row.good else row.trouble or "DISAGREES"
            table.append([row.engine, row.variable, *(["-"] * 4 if row.trouble else figures), verdict])
        widths = [max(len(line[i]) for line in table) for i in range(len(head))]
        lines += ["  " + "  ".join(c.ljust(n) for c, n in zip(line, widths, strict=True)).rstrip() for line in table]
        lines += ["", "errors: of a probability, or of a mean in standard deviations; of the log evidence in nats"]
        lines += [f"{name} does not bid: {reason}" for name, reason in self.refusals.items()]
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        return f"<pre>{html.escape(str(self))}</pre>"


def check(
    model: Model,
    steps: int = 3,
    records: int = 2,
    seed: int = 0,
    engines: Iterable[str] | None = None,
    worlds: int = WORLDS,
    missing: float = 0.0,
) -> Report:
    """Hold every engine that bids for a model against brute force, on short simulated records.

    Args:
        model: any model that can be simulated.
        steps: how long the records are; brute force grows with it.
        records: how many.
        seed: of the records.
        engines: names of engines; all that bid by default.
        worlds: how many are drawn where enumeration is not enough.
        missing: which share of the observations is lost.

    Returns:
        A report that prints: by engine and variable of interest the largest error, and how large it may be.
    """
    made = bids(model)
    wanted = [engine.__name__ for engine in ENGINES] if engines is None else list(engines)
    unknown = [name for name in wanted if name not in made]
    if unknown:
        raise ValueOutOfRange(f"there is no engine {unknown[0]}; there are {', '.join(made)}")
    serving = [name for name in wanted if made[name]]
    if not serving:
        raise Refusal(f"no engine can serve {type(model).__name__}: " + "; ".join(b.reason for b in made.values()))
    names = list(model.structure.interest)
    data = [simulated(model, steps, seed + i, missing) for i in range(records)]
    truths = [reference(model, *record, names, worlds) for record in tracked(data, "brute force")]
    rows = []
    for name in tracked(serving, "engines"):
        rows += compare(model, name, data, truths)
    refusals = {name: made[name].reason for name in wanted if not made[name]}
    return Report(repr(model), truths[0].method, tuple(rows), refusals)


def simulated(model: Model, steps: int, seed: int, missing: float = 0.0) -> tuple[Values, Values]:
    """Return the actions and observations of a simulated record, (steps, *shape) by name."""
    record = model.simulate(steps, seed=seed)
    seen = {}
    with seeded(seed):
        for name in model.observation_names:
            y = record[name].double()
            lost = torch.rand(steps) < missing
            seen[name] = torch.where(lost.reshape(-1, *[1] * (y.dim() - 1)), torch.nan, y)
    return {name: record[name] for name in model.action_names}, seen


def compare(
    model: Model, name: str, data: list, truths: list[Reference], options: dict[str, Any] | None = None
) -> list[Row]:
    """Return a row for every variable of interest: one engine, with other options, against what is true of records."""
    kind = next(engine for engine in ENGINES if engine.__name__ == name)
    names = list(model.structure.interest)
    errors = {variable: (0.0, 0.0) for variable in names}
    evidence, slack = 0.0, 0.0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            engine = kind(model, **OPTIONS[name] | (options or {}))
            for (actions, seen), truth in zip(data, truths, strict=True):
                belief = list(engine.filter(as_given(actions), as_given(seen)))[-1]
                evidence = max(evidence, abs(float(belief.log_evidence) - truth.log_evidence))
                slack = max(slack, truth.evidence_error)
                for variable in names:
                    error, doubt = error_of(belief, variable, truth)
                    errors[variable] = max(errors[variable][0], error), max(errors[variable][1], doubt)
    except Exception as error:
        trouble = f"FAILED: {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}"
        return [Row(name, ", ".join(names), 0.0, 0.0, 0.0, 0.0, trouble)]
    allowed, most = TOLERANCE[name], EVIDENCE[name] + 4 * slack
    return [Row(name, v, errors[v][0], evidence, allowed + 4 * errors[v][1], most) for v in names]


def error_of(belief: Any, variable: str, truth: Reference) -> tuple[float, float]:
    """Return the error of a marginal, and the reference's own standard error, on the same scale."""
    law = belief.marginal(variable)
    if variable in truth.probs:
        wanted = truth.probs[variable]
        assert isinstance(law, Marginal)
        values = belief.engine.structure.nodes[variable].values
        found = torch.stack([_probability(law, value) for value in values])
        return float((found - wanted).abs().max()), float(truth.errors[variable].max())
    mean, spread = truth.moments[variable]
    scale = torch.where(spread > 0, spread, 1.0)
    off = (law.mean.double() - mean) / scale
    return float(off.abs().max()), float((truth.errors[variable] / scale).max())


def _probability(law: Marginal, value: Tensor) -> Tensor:
    same = (law.values.double() == value.double()).reshape(len(law.values), -1).all(1)
    return law.probs.double()[same].sum()
