"""How far apart what is seen of the interest and what is seen of nothing are expected to be: d' squared."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from inference.engine import Refusal
from inference.tables.imagining import Imagination, of_pairs


def discriminability(engine: Any, belief: Any, actions: Any) -> Tensor:
    """Return sum over hypotheses i of B_i d'²(i, action) under the exact engine, (*batch, K).

    d'² is twice the divergence, nats, of the observation's law given i from the baseline that all hypotheses share:
    for Normal elements of one spread the squared distance of their means in units of that spread. Half of what is
    returned bounds the expected information from above, whatever the belief.
    """
    return of_pairs(engine, belief, actions, _expected)


def _expected(imagined: Imagination) -> Tensor:
    engine, total = imagined.engine, torch.zeros(())
    weights = imagined.logs.exp()
    for name, table in engine.tabulation.tables.items():
        shape = engine.tabulation.shapes[name]
        other = imagined.other(name)
        if other is not None:
            # d' would count what tells of that, too.
            raise Refusal(
                f"{engine.labels[name]} has no discriminability: it depends on {other}, and not only on the interest, "
                f"{', '.join(engine.structure.interest)}"
            )
        found = table.divergence(imagined.rows)
        if found is None:
            raise Refusal(
                f"{engine.labels[name]} has no discriminability: it needs elements that most hypotheses leave like a "
                "common baseline, finite or Normal ones of one spread"
            )
        total = total + (weights * 2 * found.reshape(-1, *shape)).flatten(1).sum(1)
    return total
