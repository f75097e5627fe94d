"""The structure of a model: its variables, the kind of every arrow, and what must be sampled.

It is read from signatures and by probing the laws, and it is all that engines ever look at.

Kinds of arrow, parent -> child:

========== ======================================================================================
given      the parent is known: an action, a past observation, or a deterministic function of those
finite     the parent has finitely many values
selects    the child's probability *is* one component of a Beta, Dirichlet or Gamma parent
affine     a Gaussian (or deterministic) child, whose mean is affine in the parent, its spread constant
moves      affine, by ``shift`` or ``window``: means and variances move alike
nonlinear  anything else
========== ======================================================================================

One rule decides what is sampled: a variable is sampled only if some child depends on it nonlinearly, or if its
own family has no algebra; all the rest is enumerated or integrated.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from torch import Tensor

from apmodels.distributions import family
from apmodels.probing import Probe
from apmodels.supports import limits_of, support_of
from apmodels.variables import Parent, Variable

GAUSSIAN = ("Normal", "MultivariateNormal")
CONJUGATE = {"Beta": "Bernoulli", "Dirichlet": "Categorical", "Gamma": "Poisson"}


@dataclass(frozen=True)
class Node:
    """One variable: its role, its family (or 'deterministic'), its shape in one world, and how it is handled.

    ``values`` are a finite variable's values (size, *shape), None where they are a continuum or not yet known.
    ``plan`` is one of given, known, observed, enumerated, counted, integrated, sampled; ``why`` is its reason.
    """

    name: str
    role: str
    family: str
    shape: tuple[int, ...]
    values: Tensor | None
    plan: str
    why: str
    # The constraint on every element, of a random variable that cannot have all real values; else None.
    limits: Any = None

    @property
    def random(self) -> bool:
        """Whether the variable is drawn from a distribution."""
        return self.family not in ("deterministic", "action")

    @property
    def hidden(self) -> bool:
        """Whether an agent must infer it."""
        return self.plan in ("enumerated", "counted", "integrated", "sampled")


@dataclass(frozen=True)
class Arrow:
    """One dependence: the parent, how many steps ago, the child, the kind and its reason.

    ``first``: the parent is what the child's own parent was before time began. ``smooth``: False where the child
    changes in steps, so that no gradient says which way.
    """

    parent: str
    lag: int
    child: str
    kind: str
    why: str
    first: bool = False
    smooth: bool = True


@dataclass(frozen=True)
class Structure:
    """The nodes in the order in which they happen, and the arrows."""

    model: str
    nodes: dict[str, Node]
    arrows: tuple[Arrow, ...]
    interest: tuple[str, ...]

    @cached_property
    def hidden(self) -> list[Node]:
        """The variables that an agent must infer."""
        return [node for node in self.nodes.values() if node.hidden]

    def planned(self, *plans: str) -> list[Node]:
        """Return the nodes with one of these plans, in order."""
        return [node for node in self.nodes.values() if node.plan in plans]

    def into(self, child: str) -> list[Arrow]:
        """Return the arrows into a variable."""
        return [arrow for arrow in self.arrows if arrow.child == child]

    def out_of(self, parent: str) -> list[Arrow]:
        """Return the arrows out of a variable."""
        return [arrow for arrow in self.arrows if arrow.parent == parent]


def read(model: Any) -> Structure:
    """Read a model's structure by probing its laws at random worlds, jointly."""
    return _Reader(model).structure()


class _Reader:
    def __init__(self, model: Any):
        self.model = model
        self.variables: dict[str, Variable] = model.declaration.variables
        self.probe = Probe(model)
        self.known = self._fixpoint(self._stays_known)
        self.finite = self._fixpoint(self._stays_finite)
        self.arrows = [arrow for variable in self.variables.values() for arrow in self._arrows_into(variable)]

    def structure(self) -> Structure:
        nodes = {name: self._node(variable) for name, variable in self.variables.items()}
        interest = self.model.declaration.interest_names
        if getattr(type(self.model), "interest", None) is None:
            # Where nobody said what is of interest, all that is hidden is.
            interest = tuple(name for name in interest if nodes[name].hidden)
        return Structure(type(self.model).__name__, nodes, tuple(self.arrows), interest)

    # Which variables are known, and which have finitely many values: the largest sets that hold together.

    def _fixpoint(self, stays: Any) -> set[str]:
        members = set(self.variables)
        while True:
            kept = {name for name in members if stays(self.variables[name], members)}
            if kept == members:
                return members
            members = kept

    def _stays_known(self, variable: Variable, members: set[str]) -> bool:
        if variable.role == "action":
            return True
        if self.probe.is_random(variable.name):
            return False
        return all(p.name in members or self.variables[p.name].role == "observation" for p in _with_befores(variable))

    def _stays_finite(self, variable: Variable, members: set[str]) -> bool:
        if variable.name in self.known or variable.role == "observation":
            return variable.name in self.known
        if self.probe.is_random(variable.name):
            return support_of(self.probe.laws_of[variable.name]) is not None
        return all(p.name in members or self.variables[p.name].role == "observation" for p in _with_befores(variable))

    def _arrows_into(self, variable: Variable) -> list[Arrow]:
        arrows: list[Arrow] = []
        continuous: list[Parent] = []
        for parent in _with_befores(variable):
            if parent.name in variable.pins or parent.argument in variable.pins:
                kind = variable.pins.get(parent.argument) or variable.pins[parent.name]
                arrows.append(Arrow(parent.name, parent.lag, variable.name, kind, "pinned by the author"))
            elif parent.name in self.known:
                what = "an action" if self.variables[parent.name].role == "action" else "known"
                arrows.append(Arrow(parent.name, parent.lag, variable.name, "given", what))
            elif self.variables[parent.name].role == "observation":
                arrows.append(Arrow(parent.name, parent.lag, variable.name, "given", "observed"))
            elif parent.name in self.finite:
                arrows.append(Arrow(parent.name, parent.lag, variable.name, "finite", self._count(parent.name)))
            else:
                continuous.append(parent)
        return arrows + self._continuous_arrows(variable, continuous)

    def _continuous_arrows(self, variable: Variable, parents: list[Parent]) -> list[Arrow]:
        if not parents:
            return []
        # A variable that gives another its first value acts as that one does.
        direct = [p for p in parents if p in variable.parents]
        kinds = self.probe.kinds(variable, direct, self._conjugate_parents(variable, direct))
        arrows = []
        for p in direct:
            kind, why = kinds[p.argument]
            smooth = kind != "nonlinear" or self.probe.is_smooth(variable, p)
            arrows.append(Arrow(p.name, p.lag, variable.name, kind, why, smooth=smooth))
        for p in parents:
            if p not in direct:
                argument = next(q for q in direct if isinstance(q.before, Variable) and q.before.name == p.name)
                kind, why = kinds[argument.argument]
                why = f"the first {argument.argument}; {why}"
                arrows.append(Arrow(p.name, 0, variable.name, kind, why, first=True))
        return arrows

    def _conjugate_parents(self, variable: Variable, parents: list[Parent]) -> list[Parent]:
        child = family(self.probe.laws_of[variable.name])
        return [p for p in parents if CONJUGATE.get(self._family(p.name)) == child]

    def _family(self, name: str) -> str:
        if self.variables[name].role == "action":
            return "action"
        return family(self.probe.laws_of[name]) if self.probe.is_random(name) else "deterministic"

    def _count(self, name: str) -> str:
        values = support_of(self.probe.laws_of[name]) if self.probe.is_random(name) else None
        return f"{len(values)} values" if values is not None else "a function of finite variables"

    def _node(self, variable: Variable) -> Node:
        name = variable.name
        if variable.role == "action":
            space = self.model.space(name)
            values = space.values() if space.size else None
            return Node(name, "action", "action", space.shape, values, "given", f"chosen from {space}")
        law = self.probe.laws_of[name]
        shape = tuple(law.shape if isinstance(law, Tensor) else law.event_shape)
        values = None if isinstance(law, Tensor) else support_of(law)
        plan, why = self._plan(variable)
        return Node(name, variable.role, self._family(name), shape, values, plan, why, limits_of(law))

    def _plan(self, variable: Variable) -> tuple[str, str]:
        name = variable.name
        if variable.role == "observation":
            return "observed", "sensed at every step"
        if name in self.known:
            return "known", "a deterministic function of what is known"
        if name in self.finite:
            return "enumerated", self._count(name)
        out = [arrow for arrow in self.arrows if arrow.parent == name]
        bad = next((arrow for arrow in out if arrow.kind == "nonlinear"), None)
        if bad is not None:
            return "sampled", f"{bad.child} depends on it nonlinearly ({bad.why})"
        through = self._sampled_function_of(name, {name})
        if through is not None:
            return "sampled", f"{through} is a function of it, and must be sampled"
        own = self._family(name)
        if own in CONJUGATE and out and all(arrow.kind == "selects" for arrow in out):
            return "counted", f"conjugate: {own} counts of {CONJUGATE[own]} outcomes"
        if own in (*GAUSSIAN, "deterministic"):
            return "integrated", "Gaussian, and every child is affine in it"
        return "sampled", f"a {own} has no algebra with its children"

    def _sampled_function_of(self, name: str, met: set[str]) -> str | None:
        """Return a deterministic child that some variable depends on nonlinearly, itself or by way of another."""
        for arrow in self.arrows:
            child = arrow.child
            if arrow.parent != name or child in met or child in self.known or self.probe.is_random(child):
                continue
            out = [other for other in self.arrows if other.parent == child]
            if any(other.kind == "nonlinear" for other in out) or self._sampled_function_of(child, met | {child}):
                return child
        return None


def _with_befores(variable: Variable) -> list[Parent]:
    """The parents, and the statics that give a lagged parent its first value."""
    parents = list(variable.parents)
    names = {p.name for p in parents}
    for parent in variable.parents:
        if isinstance(parent.before, Variable) and parent.before.name not in names:
            parents.append(Parent(parent.before.name))
    return parents
