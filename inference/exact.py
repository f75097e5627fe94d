"""The exact engine: every hidden variable has finitely many values, and all of them are weighed (thesis eq. 5.11)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from pyro.distributions import Categorical
from pyro.distributions.torch import MixtureSameFamily  # type: ignore[attr-defined]
from torch import Tensor

from apmodels import Model, ValueOutOfRange
from apmodels.distributions import tensors, with_tensors
from apmodels.simulation import Values
from apmodels.structure import Structure
from apmodels.variables import Variable
from inference.beliefs import FiniteBelief, Marginal
from inference.engine import Bid, Engine
from inference.records.finite_record import along
from inference.records.record import Record
from inference.tables.best_guess import best_guess
from inference.tables.discriminability import discriminability
from inference.tables.imagining import Worth, expectation, imagine, information_gain
from inference.tables.layout import Layout
from inference.tables.projections import Projections
from inference.tables.slices import Axis, Context, Slice, contract
from inference.tables.table import Rows
from inference.tables.tabulation import Tabulation
from inference.worlds.known import Known

# So many numbers of a batch are weighed at a time; more would not stay in a processor's cache, and take longer.
CHUNK = 1 << 18


class Exact(Engine):
    """Enumerates the hidden values: exact beliefs for models in which all that is hidden is finite.

    Laws are tabulated once over hidden values and contexts (actions, known states) when a context is first met;
    :meth:`prepare` tabulates all actions at once. Elements of an observation that no hypothesis distinguishes
    from the common baseline are never scored.
    """

    def __new__(cls, model: Model, dtype: torch.dtype | None = None) -> Any:
        """Make the engine; one that counts, where something is known by counting."""
        from inference.counting import Counting

        if cls is Exact and isinstance(model, Model) and Counting.bid(model.structure):
            return Counting(model, dtype)
        return super().__new__(cls)

    def __init__(self, model: Model, dtype: torch.dtype | None = None):
        super().__init__(model, dtype)
        self.known = Known(self.laws, self.structure)
        self.layout = Layout(self.laws, self.structure)
        self.tabulation = Tabulation(self.laws, self.layout)
        self.projections = Projections(self.laws, self.structure, self.layout)

    @classmethod
    def bid(cls, structure: Structure) -> Bid:
        """Serve models whose hidden variables are all finite, or known by counting."""
        from inference.counting import Counting

        if structure.planned("counted"):
            return Counting.bid(structure)
        for node in structure.hidden:
            if node.plan != "enumerated":
                return Bid(0.0, f"{node.name} is {node.plan}, not enumerated: {node.why}")
        for arrow in structure.arrows:
            parent, child = structure.nodes[arrow.parent], structure.nodes[arrow.child]
            if arrow.lag == 0 and parent.role == child.role == "observation":
                return Bid(0.0, f"{child.name} depends on {parent.name}, an observation of the same step")
            if child.role == "observation" and child.family == "Evidence":
                return Bid(0.0, f"{child.name} is an Evidence, which has no table")
        sizes = [len(node.values) for node in structure.hidden if node.values is not None]
        return Bid(1.0, f"all that is hidden is finite: {' x '.join(map(str, sizes)) or 'nothing'} values")

    def start(self, batch: int | None = None) -> FiniteBelief:
        """Return the prior: statics by their laws, states at their values before time began."""
        if batch is not None and batch < 1:
            raise ValueOutOfRange(f"a batch of {batch} beliefs is empty; give 1 or more, or None")
        rows = 1 if batch is None else batch
        log_probs = self._prior().expand(rows, *self.layout.sizes).contiguous()
        known = self.known.first(rows)
        evidence = torch.zeros(() if batch is None else rows, dtype=self.dtype)
        return FiniteBelief(self, batch, 0, evidence, known, log_probs)

    def _prior(self) -> Tensor:
        """Log probabilities before the first step, (1, *sizes or 1)."""
        layout = self.layout
        mesh = Slice(self.laws, layout.spent + layout.axes, {})
        log_probs = torch.zeros((1,) * (1 + len(mesh.axes)), dtype=self.dtype)
        for axis in layout.spent + layout.statics:
            log_probs = log_probs + mesh.transition(axis)
        for axis in layout.states:
            log_probs = log_probs + self._before(mesh, axis)
        gone = list(range(1, 1 + len(layout.spent)))
        return log_probs.logsumexp(gone) if gone else log_probs

    def update(self, belief: FiniteBelief, action: Any, observation: Any) -> FiniteBelief:
        """Return the belief after one more action and observation (thesis eqs 5.11 and 5.12)."""
        count = len(belief.log_probs)
        actions = self._actions(action, count)
        seen = self._observations(observation, count)
        known, context = self.know(belief, actions)
        rows = self.tabulation.rows(context, count)
        step = max(1, CHUNK // belief.log_probs[0].numel())
        if count <= step:
            log_probs, evidence = self._weighed(belief.log_probs, rows, seen)
        else:
            spans = [slice(first, first + step) for first in range(0, count, step)]
            # Of more than one belief the rows are a tensor, and no slice.
            each = torch.as_tensor(rows)
            pieces = [self._weighed(belief.log_probs[s], each[s], {n: y[s] for n, y in seen.items()}) for s in spans]
            log_probs, evidence = map(torch.cat, zip(*pieces, strict=True))
        evidence = belief.log_evidence + (evidence[0] if belief.batch is None else evidence)
        kept = self.known.keep(known | actions, seen) if self.known.kept else {}
        return FiniteBelief(self, belief.batch, belief.time + 1, evidence, kept, log_probs)

    def _weighed(self, before: Tensor, rows: Rows, seen: Values) -> tuple[Tensor, Tensor]:
        """Log probabilities (B, *sizes) after what was seen (B, elements) in contexts rows, and log evidence (B,)."""
        count = len(before)
        evidence: Tensor | float | None = None
        early: list[Tensor] = []
        late: list[Tensor] = []
        for name, table in self.tabulation.tables.items():
            y = table.read(seen[name], self.labels[name])
            ratio, base = table.score(rows, y)
            evidence = base if evidence is None else evidence + base
            if name in self.tabulation.late:
                late.append(_shaped(ratio, self.tabulation.now_shapes[name]))
            else:
                early.append(_shaped(ratio, self.tabulation.shapes[name]))
        log_probs, shift = self.predict(before, rows, early)
        weights = sum(late, start=log_probs)
        weights = weights if weights.dim() == 2 else weights.reshape(count, -1)
        log_probs = weights.log_softmax(1)
        # Normalising lowers every log weight by the log of their sum, the largest too.
        total = weights.amax(1) - log_probs.amax(1)
        if not math.isfinite(float((total if count == 1 else total.sum()).detach())):
            raise ValueOutOfRange(f"{type(self.model).__name__} gives what was observed no probability at all")
        log_probs = self.layout.padded(_shaped(log_probs, self.layout.present_sizes))
        evidence = total + evidence if shift is None else total + evidence + shift  # type: ignore[operator]
        return log_probs, evidence

    def along(self, record: Record, batch: int | None) -> Sequence[FiniteBelief]:
        """Return the beliefs along a record, of many steps at once where nothing stands against it."""
        return along(self, record, batch)

    def forecast(self, belief: FiniteBelief, action: Any) -> Any:
        """Return the predictive distribution of the next observation, a mixture over the hidden values."""
        count = len(belief.log_probs)
        _, context = self.know(belief, self._actions(action, count))
        rows = self.tabulation.rows(context, count)
        mesh = Slice(self.laws, self.layout.step_axes, context)
        joint = self.joint(belief.log_probs, rows)
        made = {}
        for name in self.tabulation.tables:
            law = mesh.distribution(name)
            lead = law.batch_shape[1 : 1 + len(mesh.axes)]
            weights = _summed_to(joint, (count, *lead))
            flat = torch.Size(lead).numel()
            parts = [
                p.expand(count, *p.shape[1:]).reshape(count, flat, *p.shape[1 + len(lead) :]) for p in tensors(law)
            ]
            components = with_tensors(law, parts, (count, flat), 1 + len(lead))
            weights = weights.reshape(count, flat)
            if belief.batch is None:
                components = with_tensors(components, [p[0] for p in parts], (flat,), 2)
                weights = weights[0]
            made[name] = MixtureSameFamily(Categorical(weights), components, validate_args=False)
        return next(iter(made.values())) if len(made) == 1 else made

    def gain(self, belief: FiniteBelief, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return the expected information about the interest, nats, (*batch, K) (thesis eq. 5.4)."""
        return information_gain(self, belief, actions, samples, seed)

    def expect(
        self, belief: FiniteBelief, worth: Worth, actions: Any = None, samples: int = 64, seed: int = 0
    ) -> Tensor:
        """Return the expectation of a function of the next belief about the interest, (*batch, K)."""
        return expectation(self, belief, worth, actions, samples, seed)

    def imagine(self, belief: FiniteBelief, action: Any, samples: int = 64, seed: int = 0) -> tuple[Values, Tensor]:
        """Return what may be seen next, (B, S, *shape) by name, and how probable each is, (B, S)."""
        return imagine(self, belief, self._actions(action, len(belief.log_probs)), samples, seed)

    def best_guess(self, belief: FiniteBelief, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return how probable the interest's most probable value is expected to be, (*batch, K)."""
        return best_guess(self, belief, actions, samples, seed)

    def discriminability(self, belief: FiniteBelief, actions: Any = None) -> Tensor:
        """Return the expected squared distance, d'², between what is seen and what is not about, (*batch, K)."""
        return discriminability(self, belief, actions)

    def prepare(self) -> Exact:
        """Tabulate the laws for every action now, and return self."""
        spaces = [(name, self.model.space(name)) for name in self.model.action_names]
        others = [name for name, lag in self.layout.keys if lag or name not in dict(spaces)]
        if others or any(space.size is None for _, space in spaces):
            raise ValueOutOfRange(f"{type(self.model).__name__} has contexts that cannot be listed beforehand")
        if spaces:
            values = torch.cartesian_prod(*[torch.arange(space.size or 0) for _, space in spaces])
            values = values.reshape(-1, len(spaces))
            self.tabulation.find({(name, 0): s.values()[values[:, i]] for i, (name, s) in enumerate(spaces)})
        return self

    def marginal(self, belief: FiniteBelief, name: str) -> Marginal:
        """Return the distribution of a hidden variable over its values."""
        values, log_probs = self.projections.marginal(belief.log_probs, (name,))
        return Marginal(_single(belief, log_probs), values[name])

    def entropy(self, belief: FiniteBelief, names: str | tuple[str, ...] | None = None) -> Tensor:
        """Return the joint entropy of variables in nats, (*batch,)."""
        return _single(belief, self.projections.entropy(belief.log_probs, self.names(names)))

    def most_probable(self, belief: FiniteBelief, name: str | None = None) -> Tensor:
        """Return the most probable value of a variable, (*batch, *shape); the first of several."""
        names = self.names(name)
        if len(names) != 1:
            raise ValueOutOfRange(f"the interest is {names}; name one variable")
        values, log_probs = self.projections.marginal(belief.log_probs, names)
        return _single(belief, values[names[0]][log_probs.argmax(-1)])

    # Knowing and predicting.

    def know(self, belief: FiniteBelief, actions: Values) -> tuple[Values, Context]:
        """Move the known states on; return them and everything known by (name, lag)."""
        return self.known.move(belief.known, actions, len(belief.log_probs))

    def _before(self, mesh: Slice, axis: Axis) -> Tensor:
        if axis.name not in self.model.declaration.remembered:
            return torch.tensor(-math.log(axis.size), dtype=self.dtype)
        before = self.laws.before(axis.name)
        here = mesh.along(axis, axis.values)
        there = mesh.value(before.name) if isinstance(before, Variable) else before.to(here.dtype)
        same = here == there
        same = same.flatten(1 + len(mesh.axes)).all(-1) if same.dim() > 1 + len(mesh.axes) else same
        return same.to(self.dtype).log()

    def predict(self, log_probs: Tensor, rows: Rows, early: list[Tensor]) -> tuple[Tensor, Tensor | None]:
        """Return log p(statics, states now, early observations), up to a factor exp(shift), and shift (B,)."""
        if not self.layout.states:
            return log_probs, None
        shift = torch.zeros(len(log_probs), dtype=self.dtype)
        past = self._past(log_probs)
        # Each combination of statics by itself, so that an unlikely one is not lost in single precision.
        gone = tuple(range(1 + len(self.layout.statics), past.dim()))
        top = past.amax(gone, keepdim=True).clamp(min=torch.finfo(self.dtype).min)
        factors = [(past - top).exp()]
        for ratio in early:
            most = ratio.flatten(1).amax(1)
            factors.append((ratio - most.reshape(-1, *[1] * (ratio.dim() - 1))).exp())
            shift = shift + most
        factors += self.tabulation.transitions(rows)
        result = contract(factors, len(self.layout.statics), len(self.layout.previous))
        top = top.reshape(*top.shape[: 1 + len(self.layout.statics)], *[1] * len(self.layout.states))
        return result.log() + top, shift

    def _past(self, log_probs: Tensor) -> Tensor:
        """The belief with dimensions (B, statics, previous, 1 for each state now)."""
        kept = {axis.name for axis in self.layout.previous}
        first = 1 + len(self.layout.statics)
        gone = [first + i for i, axis in enumerate(self.layout.states) if axis.name not in kept]
        past = log_probs.logsumexp(gone) if gone else log_probs
        return past.reshape(*past.shape, *[1] * len(self.layout.present))

    def joint(self, log_probs: Tensor, rows: Rows) -> Tensor:
        """p(statics, states before, states now), (B, statics, previous, states)."""
        joint = self._past(log_probs).exp()
        for factor in self.tabulation.transitions(rows):
            joint = joint * factor
        return joint


def _shaped(values: Tensor, shape: tuple[int, ...]) -> Tensor:
    """(B, H) as (B, *shape)."""
    return values if len(shape) == 1 else values.reshape(len(values), *shape)


def _single(belief: FiniteBelief, value: Tensor) -> Tensor:
    return value[0] if belief.batch is None else value


def _summed_to(joint: Tensor, shape: tuple[int, ...]) -> Tensor:
    dims = [i for i, (n, wanted) in enumerate(zip(joint.shape, shape, strict=True)) if n != wanted]
    return joint.sum(dims, keepdim=True) if dims else joint
