"""The counts that bear on the hypotheses: a sufficient statistic, derived from which components outcomes select.

For "is anybody answering me?" these are the counts of sounds and silences while an answer could have come and while
none could, beside the time since the last call (thesis eq. 4.52).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values
from inference.worlds.frame import Frame

# So many states of what is known are looked through.
MOST = 4096


class Statistic(NamedTuple):
    """What a belief about the hypotheses depends on: ``known`` states (*batch, *shape), and ``counts``.

    ``counts`` (*batch, K, outcomes) are of what ``labels`` say: a variable's component, under a hypothesis.
    """

    known: Values
    counts: Tensor
    labels: tuple[str, ...]


def statistic(engine: Any, belief: Any) -> Statistic:
    """Return the smallest set of counts from which all hypotheses' own follow, and that tell them apart."""
    parts, labels = [], []
    for i, block in enumerate(engine.tallies):
        prior = block.start(Frame(hypotheses_of(engine, belief)))
        added = (belief.counts[i] - prior).expand(
            len(belief.log_weights), belief.log_weights.shape[1], *prior.shape[2:]
        )
        for hypothesis, component in _basis(engine, belief, i, prior):
            parts.append(added[:, hypothesis, component])
            labels.append(_label(engine, belief, block, hypothesis, component))
    if not parts:
        raise ValueOutOfRange(f"nothing that {type(engine.model).__name__} counts bears on its hypotheses")
    counts = torch.stack(parts, 1)
    single = belief.batch is None
    known = {name: value[0] if single else value for name, value in belief.known.items()}
    return Statistic(known, counts[0] if single else counts, tuple(labels))


def hypotheses_of(engine: Any, belief: Any) -> dict:
    """Return the hypotheses' values, as a frame wants them."""
    names = (*engine.plan.worlds, *engine.plan.computed)
    return {(name, 0): belief.values[name] for name in names if engine.roles[name] == "static"}


def _basis(engine: Any, belief: Any, index: int, prior: Tensor) -> list[tuple[int, int]]:
    """The (hypothesis, component) pairs whose counts are enough, those with the fewest kinds of outcome first."""
    signatures = _signatures(engine, belief, index)
    worlds = signatures.shape[1]
    kinds = signatures[bearing(signatures, prior.expand(1, worlds, *prior.shape[2:])[0])]
    pairs = sorted(
        {(h, int(c)) for row in kinds for h, c in enumerate(row.tolist()) if c >= 0}, key=lambda p: (-p[0], p[1])
    )
    rows = {pair: (kinds[:, pair[0]] == pair[1]).double() for pair in pairs}
    chosen: list[tuple[int, int]] = []
    for pair in sorted(pairs, key=lambda pair: float(rows[pair].sum())):
        tried = torch.stack([rows[other] for other in [*chosen, pair]])
        if int(torch.linalg.matrix_rank(tried)) == len(tried):
            chosen.append(pair)
    return sorted(chosen, key=lambda pair: (pair[1], pair[0]))


def bearing(signatures: Tensor, prior: Tensor) -> Tensor:
    """Which signatures (K, hypotheses) hold a component that does not go the same way under all hypotheses."""
    uniform = (signatures == signatures[:, :1]).all(1)
    tells = torch.zeros(len(signatures), dtype=torch.bool)
    for k, row in enumerate(signatures):
        for component in row.unique().tolist():
            held = (signatures == component).any(1)
            alike = component < 0 or bool((prior[:, component] == prior[:1, component]).all())
            tells[k] |= not bool(uniform[held].all()) or not alike
    return tells


def _signatures(engine: Any, belief: Any, index: int) -> Tensor:
    """The component that an outcome selects under each hypothesis, in every reachable context, (K, hypotheses)."""
    block = engine.tallies[index]
    found: set[tuple[int, ...]] = set()
    for context in _contexts(engine):
        values = {key: value[:, None] for key, value in context.items()} | hypotheses_of(engine, belief)
        for child in block.selected:
            selected, _ = block.selected[child](Frame(values))
            wide = selected.expand(selected.shape[0], belief.log_weights.shape[1], -1)
            found |= {tuple(row) for row in wide.movedim(1, 2).reshape(-1, wide.shape[1]).tolist()}
    return torch.tensor(sorted(found))


def _contexts(engine: Any) -> list[dict]:
    """Everything known by (name, lag), for every state of it that actions can lead to."""
    actions = actions_of(engine)
    outcomes = {name: engine.structure.nodes[name].values for name in engine.known.kept}
    waiting = [engine.known.first(1)]
    seen: set[tuple] = set()
    found = []
    while waiting:
        kept = waiting.pop()
        mark = tuple(tuple(value.flatten().tolist()) for value in kept.values())
        if mark in seen:
            continue
        seen.add(mark)
        if len(seen) > MOST:
            raise ValueOutOfRange(f"what is known takes more than {MOST} values; bound it, with clamp say")
        for action in actions:
            known, context = engine.known.move(kept, action, 1)
            found.append(context)
            sensed = [name for name in engine.known.kept if name in engine.model.observation_names]
            for choice in _sensed(sensed, outcomes):
                waiting.append({name: (known | action | choice)[name] for name in engine.known.kept})
    return found


def actions_of(engine: Any) -> list[Values]:
    """Return every action, (1, *shape) by name; ValueOutOfRange where they have no list."""
    values = {name: space.values() for name, space in engine.spaces.items() if space.size}
    if len(values) < len(engine.spaces):
        raise ValueOutOfRange(
            f"{type(engine.model).__name__} has an action that is a continuum; its counts have no list"
        )
    return _sensed(list(values), values)


def _sensed(names: list[str], values: dict) -> list[Values]:
    picked: list[Values] = [{}]
    for name in names:
        if values[name] is None:
            raise ValueOutOfRange(f"{name} is remembered, and has no list of values")
        picked = [{**some, name: value[None]} for some in picked for value in values[name]]
    return picked


def _label(engine: Any, belief: Any, block: Any, hypothesis: int, component: int) -> str:
    for name in block.names:
        if component < block.components(name):
            break
        component -= block.components(name)
    where = f"{name}[{component}]" if block.components(name) > 1 else name
    named = [f"{n}={belief.values[n][0, hypothesis].tolist()}" for n in engine.plan.worlds]
    return f"{where} if {', '.join(named)}" if named else where
