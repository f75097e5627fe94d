"""Learning by counting: a parameter that outcomes select from."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from apmodels import DeclarationError, Model, ValueOutOfRange
from apmodels.distributions import base_of, family, tensors
from apmodels.laws import Laws
from apmodels.simulation import Values, Worlds

SAME = 1e-9
FAMILIES = ("Bernoulli", "Categorical", "Poisson")


def counted(model: Model, name: str, known: Values, prior: float = 0.0) -> Any:
    """Return the most probable value of a field from which outcomes select, or None where it is no such field.

    Args:
        model: the model.
        name: a field: probabilities, rows of probabilities, or rates.
        known: records in which every random variable that the field bears on is given, and all that bears on it.
        prior: pseudo-counts of every outcome.
    """
    value = torch.as_tensor(getattr(model, name)).double()
    hidden = [node.name for node in model.structure.hidden if node.random]
    if not all(n in known for n in hidden):
        return None
    tallies, kinds = torch.zeros(0), set()
    try:
        laws = [_laws(model, name, other, known) for other in _telling(value)]
    except (ValueOutOfRange, DeclarationError):
        return None
    for child in laws[0]:
        (first, y), (second, _) = laws[0][child], laws[1][child]
        if family(first[0]) not in FAMILIES:
            pairs = zip(
                (t for law in first for t in tensors(law)), (t for law in second for t in tensors(law)), strict=True
            )
            if all(torch.equal(a, b) for a, b in pairs):
                continue
            return None
        index, row = _selected(first, second, _telling(value))
        if index is None:
            return None
        if row == 0:
            continue
        kinds.add(family(first[0]))
        found = _tally(index, y, value, row, family(first[0]))
        tallies = found if not len(tallies) else tallies + found if tallies.shape == found.shape else tallies
    if len(kinds) != 1:
        return None
    return _most_probable(tallies + prior, kinds.pop(), value, getattr(model, name))


def _telling(value: Tensor) -> list[Tensor]:
    """Two values of the field in which all components differ."""
    made = []
    for seed in (0, 1):
        flat = torch.rand(value.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        made.append(flat / flat.sum(-1, keepdim=True) if _is_rows(value) else flat)
    return made


def _is_rows(value: Tensor) -> bool:
    return value.dim() > 0 and bool(((value.sum(-1) - 1).abs() < 1e-5).all()) and bool((value >= 0).all())


def _laws(model: Model, name: str, value: Tensor, known: Values) -> dict[str, tuple[list, Tensor]]:
    """The law of every random variable in every step, and its outcomes, (steps, rows, ...)."""
    scorer = _Noting(Laws(model.replace(**{name: value}), torch.float64), known)
    return scorer.run(model)


class _Noting(Worlds):
    """Worlds that are given, and note their laws."""

    def __init__(self, laws: Laws, known: Values):
        nodes = laws.model.structure.nodes
        timed = next(n for n in laws.model.observation_names)
        self.batched = known[timed].dim() - len(nodes[timed].shape) == 2
        self.record = {n: (v if self.batched else v[None]) for n, v in known.items()}
        self.noted: dict[str, tuple[list, list]] = {}
        self.at = 0
        self.static_values = {n: self.record[n] for n in laws.model.declaration.names["static"] if n in self.record}
        super().__init__(laws, len(self.record[timed]))

    def run(self, model: Model) -> dict[str, tuple[list, Tensor]]:
        steps = self.record[model.observation_names[0]].shape[1]
        for t in range(steps):
            self.at = t
            self.step({name: self.record[name][:, t] for name in model.action_names})
        return {name: (laws, torch.stack(values)) for name, (laws, values) in self.noted.items()}

    def _draw(self, variable: Any, values: Values) -> Tensor:
        law = self.law(variable, values)
        if not isinstance(law, Distribution):
            return law
        static = variable.role == "static"
        value = self.static_values[variable.name] if static else self.record[variable.name][:, self.at]
        laws, outcomes = self.noted.setdefault(variable.name, ([], []))
        laws.append(law)
        outcomes.append(value.double())
        return value


def _selected(first: list, second: list, values: list[Tensor]) -> tuple[Tensor | None, int]:
    """Which component each outcome's law selects, (steps, rows, elements); its row's length, 0 if it selects none."""
    chosen = [torch.stack([_probability(law) for law in laws]) for laws in (first, second)]
    moved = (chosen[0] - chosen[1]).abs() > 0
    if not bool(moved.any()):
        return torch.zeros(0), 0
    row = chosen[0].shape[-1]
    options = [value.reshape(-1, row) for value in values]
    if options[0].shape[-1] != row:
        return None, 0
    close = [(c[..., None, :] - o).abs().amax(-1) <= SAME for c, o in zip(chosen, options, strict=True)]
    match = close[0] & close[1]
    found = match.any(-1)
    if bool((moved.any(-1) & ~found).any()):
        return None, 0
    return torch.where(found, match.to(torch.uint8).argmax(-1), -1), row


def _probability(law: Any) -> Tensor:
    base, _ = base_of(law)
    kind = family(law)
    values = base.rate if kind == "Poisson" else base.probs
    return values.reshape(len(values), -1, values.shape[-1] if kind == "Categorical" else 1)


def _tally(index: Tensor, y: Tensor, value: Tensor, row: int, kind: str) -> Tensor:
    """Counts (components, outcomes): of 0 and 1, of categories, or the sum and the number."""
    y = y.reshape(index.shape)
    told = (index >= 0) & ~torch.isnan(y)
    index, y = index[told], y[told]
    if kind == "Poisson":
        outcomes = torch.stack([y, torch.ones_like(y)], -1)
    else:
        outcomes = torch.nn.functional.one_hot(y.long(), 2 if kind == "Bernoulli" else row).double()
    zero = torch.zeros(value.numel() // row, outcomes.shape[-1], dtype=torch.float64)
    return zero.index_add(0, index, outcomes)


def _most_probable(tallies: Tensor, kind: str, value: Tensor, before: Any) -> Any:
    """The share of each outcome; what was never met stays as it was."""
    if kind == "Categorical":
        total = tallies.sum(-1, keepdim=True)
        found = torch.where(total > 0, tallies / total.clamp(min=1e-300), value.reshape(tallies.shape))
    else:
        pair = tallies[:, 0] / tallies[:, 1] if kind == "Poisson" else tallies[:, 1] / tallies.sum(-1)
        found = torch.where(tallies.sum(-1) > 0, pair, value.reshape(-1))
    found = found.reshape(value.shape).to(torch.get_default_dtype())
    return found if isinstance(before, Tensor) else float(found)
