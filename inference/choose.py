"""Choosing an engine by its bid."""

from __future__ import annotations

from typing import Any

from apmodels import Model
from inference.engine import Engine, Refusal
from inference.exact import Exact
from inference.kalman import Kalman
from inference.particles import Particles
from inference.rao_blackwell import RaoBlackwell
from inference.variational import Variational

ENGINES: list[type[Engine]] = [Exact, Kalman, RaoBlackwell, Particles, Variational]


def bids(model: Model) -> dict[str, Any]:
    """Return every engine's bid for a model, by the engine's name, the best first."""
    if not isinstance(model, Model):
        what = f"the class {model.__name__}" if isinstance(model, type) else f"a {type(model).__name__}"
        raise Refusal(f"an engine needs a model, not {what}; write MyModel(...)")
    made = {engine.__name__: engine.bid(model.structure) for engine in ENGINES}
    return dict(sorted(made.items(), key=lambda item: -item[1].competence))


def choose(model: Model, **options: Any) -> Engine:
    """Return the engine with the highest bid, built with ``options``; Refusal, with all reasons, if none can serve."""
    name, best = next(iter(bids(model).items()))
    if not best:
        raise Refusal(f"no engine can serve {type(model).__name__}:\n{explain(model)}")
    engine = next(engine for engine in ENGINES if engine.__name__ == name)
    return engine(model, **options)


def explain(model: Model) -> str:
    """Return all bids as text, a line each, the best first."""
    rows = [f"{name:<12} {bid.competence:4.2f}  {bid.reason}" for name, bid in bids(model).items()]
    return "\n".join(rows)
