"""Expected information under a bank of worlds (thesis eq. 5.4).

In closed form where what is of interest is Gaussian and so is all that is seen; as a sum over the outcomes of what is
seen where these are few; as an average over imagined observations, with common random numbers, else.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from apmodels.simulation import Values, seeded
from inference.answers.draws import draw_values
from inference.answers.outcomes import outcomes, ranged
from inference.engine import Refusal
from inference.tables.imagining import choices
from inference.tables.table import FEW_OUTCOMES
from inference.worlds.gaussian_block import predicted
from inference.worlds.step import BankBelief, Step, drawn, even, pick_rows, take_rows, take_worlds

# How many numbers are held at a time, and how many draws stand for a belief that has no other form.
CHUNK, DRAWS = 4_000_000, 1024


def information_gain(engine: Any, belief: Any, actions: Any, samples: int, seed: int) -> Tensor:
    """Return I(interest; next observation | action), nats, (*batch, K)."""
    return _each(engine, belief, actions, seed, lambda chosen: _gain(engine, belief, chosen, samples).clamp(min=0))


def expectation(
    engine: Any, belief: Any, worth: Callable[[Tensor], Tensor], actions: Any, samples: int, seed: int
) -> Tensor:
    """Return E[worth(the next belief about the interest) | action], (*batch, K); Refusal where that is no list."""
    names = engine.names(None)
    for name in names:
        if not ranged(engine, name):
            raise Refusal(f"{name} has no finite list of values, so there is no list of their probabilities")

    def expected(chosen: Values) -> Tensor:
        step, known = _moved(engine, belief, chosen)
        return _ahead(
            engine, belief, step, known | chosen, samples, lambda after: worth(outcomes(engine, after, names)[1])
        )

    return _each(engine, belief, actions, seed, expected)


def imagine(engine: Any, belief: Any, actions: Values, samples: int, seed: int) -> tuple[Values, Tensor]:
    """Return observations (B, S, *shape) by name, and how probable each is, (B, S); see ``Engine.imagine``."""
    rows = len(belief.log_weights)
    with seeded(seed):
        step, known = _moved(engine, belief, actions)
        found = _all_outcomes(engine)
        count = 0 if found is None else len(next(iter(found.values())))
        if found is None or count > samples:
            seen = imagined(engine, step, belief.log_weights, samples)
            seen = {name: v.reshape(rows, samples, *v.shape[2:]) for name, v in seen.items()}
            return seen, torch.full((rows, samples), 1 / samples, dtype=engine.dtype)
    seen = {name: v.to(engine.dtype).expand(rows, *v.shape) for name, v in found.items()}
    index = torch.arange(rows).repeat_interleave(count)
    part = {name: v.flatten(0, 1)[:, None] for name, v in seen.items()}
    context = {name: v[index] for name, v in (known | actions).items()}
    after = _after(engine, take_belief(belief, index), take_rows(step, index), context, part)
    return seen, after.log_evidence.exp().reshape(rows, count)


def _each(engine: Any, belief: Any, actions: Any, seed: int, answer: Callable[[Values], Tensor]) -> Tensor:
    """Return what each of K actions is answered, (rows,), as (*batch, K)."""
    acts = choices(engine, actions)
    many = len(next(iter(acts.values()))) if acts else 1
    found = []
    for k in range(many):
        chosen = {
            name: value[k : k + 1].expand(len(belief.log_weights), *value.shape[1:]) for name, value in acts.items()
        }
        # The same seed for every action: differences between actions are much surer than the answers themselves.
        with seeded(seed):
            found.append(answer(chosen))
    answers = torch.stack(found, 1)
    return answers[0] if belief.batch is None else answers


def _gain(engine: Any, belief: Any, actions: Values, samples: int) -> Tensor:
    names = engine.names(None)
    valued = (*engine.plan.worlds, *engine.plan.computed)
    single = belief.log_weights.shape[1] == 1
    function = names == ("interest",) and engine.model.declaration.interest is not None
    finite = all(ranged(engine, name) for name in names)
    if not finite and not function and single and all(name in engine.plan.integrated for name in names):
        step, known = _moved(engine, belief, actions)
        if _closed(engine, names):
            before, after = (
                _believed(engine, belief, step, known | actions, _blank(engine, len(belief.log_weights), fill), names)
                for fill in (torch.nan, 0.0)
            )
            return before - after
        return _expected(engine, belief, actions, samples, names)
    if finite:
        return _expected(engine, belief, actions, samples, names)
    if not function and all(name in valued for name in names):
        return _between_worlds(engine, belief, actions, samples)
    from inference.particles import Particles

    loose = Particles(engine.model, particles=DRAWS, dtype=engine.dtype, guided=False)
    values = draw_values(engine, belief, DRAWS, int(torch.randint(2**31, ())))
    values = {name: value for name, value in values.items() if name in (*loose.plan.worlds, *loose.plan.computed)}
    weights = torch.zeros(len(belief.log_weights), DRAWS, dtype=engine.dtype).log_softmax(1)
    parts = {"gaussian": (), "fields": (), "counts": (), "finite": None, "past": None}
    cloud = replace(belief, engine=loose, log_weights=weights, values=values, **parts)
    if function:
        return _of_function(loose, cloud, actions, samples)
    return _between_worlds(loose, cloud, actions, samples)


def _closed(engine: Any, names: tuple[str, ...]) -> bool:
    """Whether how much is learned does not depend on what is seen."""
    kinds = {engine.owner.get(name, ("none", 0))[0] for name in engine.model.observation_names}
    return kinds <= {"gaussian", "field"} and not engine.plan.counted and not engine.plan.finite


def _moved(engine: Any, belief: Any, actions: Values) -> tuple[Step, Values]:
    step, known = engine.step_of(belief, actions)
    engine.move(step)
    return step, known


def _blank(engine: Any, rows: int, fill: float) -> Values:
    shown = engine.shown.items()
    return {name: torch.full((rows, 1, *shape), fill, dtype=engine.dtype) for name, shape in shown}


def _believed(engine: Any, belief: Any, step: Step, known: Values, seen: Values, names: tuple[str, ...]) -> Tensor:
    """The entropy of some variables after something was seen, (rows,)."""
    after = _after(engine, belief, step, known, seen)
    return engine.entropy(replace(after, batch=len(after.log_weights)), names)


def _after(engine: Any, belief: Any, step: Step, known: Values, seen: Values) -> BankBelief:
    step = take_rows(step, torch.arange(step.lead[0]))
    engine.sense(step, seen)
    weights = belief.log_weights + step.score
    rows = len(weights)
    evidence = torch.zeros(rows, dtype=engine.dtype)
    blank = replace(belief, batch=rows, log_evidence=evidence, known={})
    # An outcome that cannot happen has no belief, and no weight.
    gone = ~torch.isfinite(weights.logsumexp(1))
    weights = torch.where(gone[:, None], belief.log_weights - 1e30, weights)
    return engine.made(blank, step, {name: v for name, v in known.items() if name in engine.known.kept}, weights, seen)


def _expected(engine: Any, belief: Any, actions: Values, samples: int, names: tuple[str, ...]) -> Tensor:
    """H(interest) - E H(interest | observation), (rows,)."""
    step, known = _moved(engine, belief, actions)
    before = _believed(engine, belief, step, known | actions, _blank(engine, len(belief.log_weights), torch.nan), names)
    after = _ahead(engine, belief, step, known | actions, samples, lambda later: engine.entropy(later, names))
    return before - after


def _ahead(engine: Any, belief: Any, step: Step, given: Values, samples: int, worth: Callable[[Any], Tensor]) -> Tensor:
    """E[worth(belief after the observation)], (rows,); ``given`` is all that is known after the action."""
    rows, worlds = belief.log_weights.shape
    found = _all_outcomes(engine)
    seen = found if found is not None else imagined(engine, step, belief.log_weights, samples)
    count = len(next(iter(seen.values()))) if found is not None else samples
    size = max(1, CHUNK // max(1, rows * worlds))
    total = torch.zeros(rows, dtype=engine.dtype)
    for some in torch.arange(count).split(size):
        index = torch.arange(rows).repeat_interleave(len(some))
        wide, wider = take_rows(step, index), take_belief(belief, index)
        if found is not None:
            part = {n: v[some].to(engine.dtype).repeat(rows, *[1] * (v.dim() - 1))[:, None] for n, v in seen.items()}
        else:
            part = {n: v.reshape(rows, samples, *v.shape[2:])[:, some].flatten(0, 1)[:, None] for n, v in seen.items()}
        context = {n: v[index] for n, v in given.items()}
        after = _after(engine, wider, wide, context, part)
        worths = worth(after).reshape(rows, len(some))
        weight = after.log_evidence.exp().reshape(rows, len(some)) if found is not None else 1 / samples
        total = total + (weight * torch.nan_to_num(worths)).sum(1)
    return total


def _all_outcomes(engine: Any) -> Values | None:
    """All joint outcomes of what is seen, (outcomes, *shape) by name, where they are few."""
    values = {name: engine.structure.nodes[name].values for name in engine.model.observation_names}
    if any(value is None for value in values.values()):
        return None
    sizes = [len(value) for value in values.values()]
    if torch.Size(sizes).numel() > FEW_OUTCOMES:
        return None
    picks = torch.cartesian_prod(*[torch.arange(n) for n in sizes]).reshape(-1, len(sizes))
    return {name: value[picks[:, i]] for i, (name, value) in enumerate(values.items())}


def imagined(engine: Any, step: Step, log_weights: Tensor, samples: int) -> Values:
    """Draw observations from their predictive law, (rows, samples, *shape) by name."""
    chosen = even(log_weights, samples)
    return _imagined(engine, take_worlds(step, chosen), (len(log_weights), samples))


def _imagined(engine: Any, step: Step, lead: tuple[int, int]) -> Values:
    """Draw an observation in every world, (rows, worlds, *shape) by name."""
    seen: Values = {}
    for i, block in enumerate(engine.gaussians):
        if block.seen:
            belief = block.advance(step.gaussian[i], step.frame)
            flat = drawn(predicted(belief, block.view(step.frame)), lead)
            for name in block.seen:
                width = torch.Size(engine.shown[name]).numel()
                seen[name], flat = flat[..., :width].reshape(*lead, *engine.shown[name]), flat[..., width:]
    for i, block in enumerate(engine.images):
        seen |= block.imagine(step.fields[i], step.frame, lead)
    if engine.summed is not None:
        seen |= engine.summed.imagine(step.finite, step.frame, lead)
    for name in engine.model.observation_names:
        kind, at = engine.owner.get(name, ("", 0))
        if kind == "count":
            value = engine.tallies[at].draw(step.counts[at], step.frame, name, lead, engine.laws)
            seen[name] = value.to(engine.dtype)
        elif not kind:
            seen[name] = step.frame.draw(engine.laws, name, lead)[1].to(engine.dtype)
    return seen


def _between_worlds(engine: Any, belief: Any, actions: Values, samples: int) -> Tensor:
    """E[log p(y | world) - log p(y)]: what is seen tells of the worlds, which have values of the interest, (rows,)."""
    step, _ = _moved(engine, belief, actions)
    rows, worlds = belief.log_weights.shape
    chosen = even(belief.log_weights, samples)
    seen = _imagined(engine, take_worlds(step, chosen), (rows, samples))
    size = max(1, CHUNK // max(1, rows * worlds))
    total = torch.zeros(rows, dtype=engine.dtype)
    for some in torch.arange(samples).split(size):
        index = torch.arange(rows).repeat_interleave(len(some))
        wide = take_rows(step, index)
        engine.sense(wide, {name: value[:, some].flatten(0, 1)[:, None] for name, value in seen.items()})
        score = wide.score.reshape(rows, len(some), worlds)
        whole = (belief.log_weights[:, None] + score).logsumexp(2)
        total = total + (score.gather(2, chosen[:, some, None])[..., 0] - whole).sum(1)
    return total / samples


def _of_function(engine: Any, belief: Any, actions: Values, samples: int) -> Tensor:
    """The same of a function of variables: the worlds with one value of it are taken together."""
    from inference.answers.draws import interest_of

    step, _ = _moved(engine, belief, actions)
    rows, worlds = belief.log_weights.shape
    values = {name: value for (name, lag), value in step.frame.values.items() if not lag}
    value = interest_of(engine, values, step.lead)
    if value.is_floating_point():
        return _between_worlds(engine, belief, actions, samples)
    flat = value.reshape(rows * worlds, -1)
    table, groups = torch.unique(flat, dim=0, return_inverse=True)
    groups = groups.reshape(rows, worlds)
    found = _all_outcomes(engine)
    count = len(next(iter(found.values()))) if found is not None else samples
    seen = found if found is not None else imagined(engine, step, belief.log_weights, samples)
    prior = _grouped(belief.log_weights, groups, len(table))
    total = torch.zeros(rows, dtype=engine.dtype)
    size = max(1, CHUNK // max(1, rows * worlds))
    for some in torch.arange(count).split(size):
        index = torch.arange(rows).repeat_interleave(len(some))
        wide = take_rows(step, index)
        if found is not None:
            part = {n: v[some].to(engine.dtype).repeat(rows, *[1] * (v.dim() - 1))[:, None] for n, v in seen.items()}
        else:
            part = {n: v[:, some].flatten(0, 1)[:, None] for n, v in seen.items()}
        engine.sense(wide, part)
        joint = _grouped(belief.log_weights[index] + wide.score, groups[index], len(table))
        whole = joint.logsumexp(1, keepdim=True)
        after = (joint - whole).clamp(min=-1e30)
        entropy = -(after.exp() * after).sum(1).reshape(rows, len(some))
        weight = whole[:, 0].exp().reshape(rows, len(some)) if found is not None else 1 / samples
        total = total + (weight * entropy).sum(1)
    return -torch.xlogy(prior.exp(), prior.exp()).sum(1) - total


def _grouped(logs: Tensor, groups: Tensor, count: int) -> Tensor:
    top = logs.amax(1, keepdim=True)
    sums = torch.zeros(len(logs), count, dtype=logs.dtype).scatter_add(1, groups, (logs - top).exp())
    return sums.log() + top


def take_belief(belief: BankBelief, index: Tensor) -> BankBelief:
    """Return a belief of other rows; only its weights, which is all that is asked for."""
    return replace(belief, batch=len(index), log_weights=pick_rows(belief.log_weights, index).expand(len(index), -1))
