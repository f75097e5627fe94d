"""The joint outcomes of variables with finitely many values, and their probabilities, in a bank of worlds."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.supports import LARGEST_SUPPORT
from inference.worlds.frame import Frame


def ranged(engine: Any, name: str) -> bool:
    """Tell whether a variable has finitely many values; of a function of variables, whether all of those have."""
    if name == "interest":
        return all(ranged(engine, parent) for parent in engine.structure.interest)
    if name in engine.plan.integrated:
        return False
    node = engine.structure.nodes[name]
    return node.plan == "enumerated"


def outcomes(engine: Any, belief: Any, names: tuple[str, ...]) -> tuple[dict[str, Tensor], Tensor]:
    """Return name -> values (n, *shape) of the joint outcomes, and their log probabilities (rows, n)."""
    rows, worlds = belief.log_weights.shape
    sizes = () if belief.finite is None else belief.finite.shape[2:]
    inner = names if names != ("interest",) else engine.structure.interest
    meshed = any(name in engine.plan.finite for name in inner)
    columns, shapes = [], []
    for name in inner:
        value = _on_mesh(engine, belief, name, sizes if meshed else ())
        shapes.append((value.dtype, value.shape[2 + (len(sizes) if meshed else 0) :]))
        cells = torch.Size(sizes).numel() if meshed else 1
        wide = value.expand(rows, worlds, *(sizes if meshed else ()), *shapes[-1][1])
        columns.append(wide.reshape(rows * worlds * cells, -1).double())
    logs = belief.log_weights
    if meshed:
        logs = (logs.reshape(rows, worlds, *[1] * len(sizes)) + belief.finite).reshape(rows, -1)
    joint, groups = _joint(engine, inner, columns)
    split = joint.split([column.shape[1] for column in columns], 1)
    values = {n: p.reshape(-1, *s).to(d) for n, p, (d, s) in zip(inner, split, shapes, strict=True)}
    if names == ("interest",) and engine.model.declaration.interest is not None:
        values, moved = _function(engine, values)
        groups = moved[groups]
    count = len(next(iter(values.values())))
    probs = torch.zeros(rows, count, dtype=logs.dtype).scatter_add(1, groups.reshape(rows, -1), logs.exp())
    return values, probs.log()


def _joint(engine: Any, names: tuple[str, ...], columns: list[Tensor]) -> tuple[Tensor, Tensor]:
    """All joint outcomes, and which of them each row is; of one variable, all that its law allows, in their order."""
    table, groups = torch.unique(torch.cat(columns, 1), dim=0, return_inverse=True)
    known = engine.structure.nodes[names[0]].values if len(names) == 1 else None
    if known is None or len(known) > LARGEST_SUPPORT:
        return table, groups
    allowed = known.reshape(len(known), -1).double()
    same = (table[:, None] == allowed[None]).all(-1)
    if not bool(same.any(1).all()):
        # The value before time began may be none of the law's own.
        return table, groups
    return allowed, same.to(torch.uint8).argmax(1)[groups]


def _function(engine: Any, values: dict[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    frame = Frame({(name, 0): value[:, None] for name, value in values.items()})
    law = frame.in_all(engine.laws, "interest", (len(next(iter(values.values()))), 1))
    assert isinstance(law, Tensor)
    law = law[:, 0]
    table, groups = torch.unique(law.reshape(len(law), -1), dim=0, return_inverse=True)
    return {"interest": table.reshape(-1, *law.shape[1:])}, groups


def _on_mesh(engine: Any, belief: Any, name: str, sizes: tuple[int, ...]) -> Tensor:
    """A variable's values, (rows or 1, worlds or 1, *(sizes or 1), *shape)."""
    if name in engine.plan.finite:
        if belief.time == 0 and engine.roles[name] == "state" and name not in engine.model.declaration.remembered:
            raise ValueOutOfRange(f"{name} has no value before the first step")
        frame = Frame({(n, 0): v for n, v in belief.values.items()})
        try:
            value = engine.summed.values(frame, name, tuple(belief.log_weights.shape))
        except KeyError as missing:
            raise ValueOutOfRange(
                f"{name} depends on {missing.args[0]}, which a belief does not keep; let a state remember it"
            ) from missing
        if len(value) == 1:
            return value[None]
        return value.reshape(*belief.log_weights.shape, *value.shape[1:])
    if name not in belief.values:
        raise ValueOutOfRange(f"{name} has no value before the first step")
    value = belief.values[name]
    return value.reshape(*value.shape[:2], *[1] * len(sizes), *value.shape[2:])
