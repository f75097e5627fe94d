"""Evaluating a model's laws, for one world or for many at once, in the precision that an engine asks for."""

from __future__ import annotations

import dataclasses
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.func import vmap

from apmodels.distributions import check_parameters, family, log_prob_of, tensors, unvalidated, with_tensors
from apmodels.errors import DeclarationError, ValueOutOfRange
from apmodels.evidence import Evidence
from apmodels.variables import Variable

Law = Tensor | Distribution


class Laws:
    """The laws of one model, evaluated in one floating-point type.

    A law is written for one world; :meth:`many` evaluates it for arrays of worlds by vectorising the law itself.
    """

    def __init__(self, model: Any, dtype: torch.dtype | None = None):
        self.dtype = dtype or torch.get_default_dtype()
        self.model = cast(model, self.dtype)
        self._real: dict[str, bool] = {}
        self.variables: dict[str, Variable] = dict(model.declaration.variables)
        if model.declaration.interest is not None:
            self.variables["interest"] = model.declaration.interest

    def one(self, name: str, parents: dict[str, Tensor]) -> Law:
        """Evaluate a law in one world; ``parents`` by argument name (``prev_x`` for a lagged one)."""
        variable = self.variables[name]
        with _default_dtype(self.dtype), unvalidated(), _explained(self.model, variable):
            law = _checked_type(self.model, variable, self._call(variable, parents))
        if isinstance(law, Distribution):
            check_parameters(law, f"{type(self.model).__name__}.{name}")
        return law

    def many(self, name: str, parents: dict[str, Tensor], lead: tuple[int, ...]) -> Law:
        """Evaluate a law in an array of worlds.

        Args:
            name: the variable.
            parents: argument name -> (*lead, *shape), where a dimension of ``lead`` along which the parent does
                not vary may have size 1: what does not vary is not computed again.
            lead: the shape of the array of worlds.

        Returns:
            The values (*lead, *shape), or a distribution with batch shape (*lead, ...).
        """
        variable = self.variables[name]
        template: list[Law] = []

        def parts(*values: Tensor) -> tuple[Tensor, ...]:
            law = self._call(variable, dict(zip(parents, values, strict=True)))
            template[:] = [_checked_type(self.model, variable, law)]
            if isinstance(template[0], Evidence):
                raise DeclarationError(
                    f"{type(self.model).__name__}.{name} is an Evidence, which can be scored but not drawn or tabulated"
                )
            return tuple(tensors(template[0]))

        results = self._mapped(variable, parts, list(parents.values()), lead)
        law = with_tensors(template[0], results, lead)
        if isinstance(law, Distribution):
            check_parameters(law, f"{type(self.model).__name__}.{name}")
        return law

    def score(self, name: str, parents: dict[str, Tensor], value: Tensor, lead: tuple[int, ...]) -> Tensor:
        """Return log p(value | parents), (*lead,), of a random variable; ``value`` and ``parents`` as in :meth:`many`.

        Elements that are NaN are missing, and say nothing.
        """
        variable = self.variables[name]

        def log_prob(value: Tensor, *values: Tensor) -> Tensor:
            return log_prob_of(self._call(variable, dict(zip(parents, values, strict=True))), value)

        (scores,) = self._mapped(variable, lambda *values: (log_prob(*values),), [value, *parents.values()], lead)
        return scores

    def _mapped(
        self, variable: Variable, function: Callable, values: list[Tensor], lead: tuple[int, ...]
    ) -> list[Tensor]:
        """Call a function of one world in all of them, (*lead, ...), along the dimensions in which something varies."""
        varying = [[value.shape[i] > 1 for value in values] for i in range(len(lead))]
        for dims in reversed(varying):
            if any(dims):
                function = vmap(function, in_dims=tuple(0 if varies else None for varies in dims))
        with _default_dtype(self.dtype), unvalidated(), _explained(self.model, variable):
            results = function(*(_drop_single(value, len(lead)) for value in values))
        wide = [n if any(dims) else 1 for n, dims in zip(lead, varying, strict=True)]
        kept = sum(any(dims) for dims in varying)
        return [p.reshape((*wide, *p.shape[kept:])).expand((*lead, *p.shape[kept:])) for p in results]

    def before(self, name: str) -> Any:
        """Return the value of a lagged variable before time began: a tensor, or a Variable that has it."""
        value = self.model.declaration.remembered[name]
        if isinstance(value, Variable):
            return value
        if callable(value):
            value = value(self.model)
        with _default_dtype(self.dtype):
            first = torch.as_tensor(value)
        return first.to(self.dtype) if first.is_floating_point() or self._is_real(name) else first

    def _is_real(self, name: str) -> bool:
        """Whether a variable's later values are floating-point numbers, though its first one is written whole."""
        if name not in self._real:
            self._real[name] = False
            if self.variables[name].role == "action":
                return False
            with torch.random.fork_rng(devices=[]):
                law = self._example(name)
            self._real[name] = isinstance(law, Distribution) and family(law) != "Categorical"
        return self._real[name]

    def _example(self, name: str) -> Any:
        """The law of a variable in one world at the first step."""
        variable = self.variables[name]
        values = {}
        for parent in variable.parents:
            before = self.before(parent.name) if parent.lag else None
            if isinstance(before, Tensor):
                values[parent.argument] = before
                continue
            source = parent.name if before is None else before.name
            if self.variables[source].role == "action":
                values[parent.argument] = self.variables[source].space_of(self.model).sample(())
            else:
                law = self._example(source)
                values[parent.argument] = law.sample() if isinstance(law, Distribution) else law
        # Unchecked: a whole first value may make a law that only its kind is asked of senseless.
        with _default_dtype(self.dtype), unvalidated(), _explained(self.model, variable):
            return self._call(variable, values)

    def _call(self, variable: Variable, parents: dict[str, Tensor]) -> Any:
        arguments = {parent.argument: parents[parent.argument] for parent in variable.parents}
        return variable.law(self.model, **arguments)  # type: ignore[misc]


def cast(thing: Any, dtype: torch.dtype) -> Any:
    """Return a field, or a dataclass of fields, with its floating-point tensors in ``dtype``."""
    if isinstance(thing, Tensor):
        return thing.to(dtype) if thing.is_floating_point() else thing
    if isinstance(thing, tuple) and not hasattr(thing, "_fields"):
        return tuple(cast(part, dtype) for part in thing)
    if not dataclasses.is_dataclass(thing) or isinstance(thing, type):
        return thing
    fields = [field.name for field in dataclasses.fields(thing) if field.init]
    changed = {name: cast(getattr(thing, name), dtype) for name in fields}
    if all(_same(new, getattr(thing, name)) for name, new in changed.items()):
        return thing
    return dataclasses.replace(thing, **changed)


def _same(a: Any, b: Any) -> bool:
    return a is b or (isinstance(a, tuple) and all(_same(x, y) for x, y in zip(a, b, strict=True)))


def _drop_single(value: Tensor, dims: int) -> Tensor:
    """Drop those of the first ``dims`` dimensions that have size 1."""
    kept = [n for n in value.shape[:dims] if n > 1]
    return value.reshape((*kept, *value.shape[dims:]))


def _checked_type(model: Any, variable: Variable, law: Any) -> Law:
    if isinstance(law, (bool, int, float)):
        law = torch.as_tensor(law)
    if not isinstance(law, (Tensor, Distribution)):
        raise DeclarationError(
            f"{type(model).__name__}.{variable.name} returned a {type(law).__name__}; "
            "return a distribution (a random variable) or a tensor (a deterministic one)"
        )
    if isinstance(law, Distribution) and len(law.batch_shape):
        raise DeclarationError(
            f"{type(model).__name__}.{variable.name} returned a {type(law).__name__} with batch shape "
            f"{tuple(law.batch_shape)}; a law describes one world: end it with .to_event({len(law.batch_shape)})"
        )
    return law


@contextmanager
def _default_dtype(dtype: torch.dtype) -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(dtype)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextmanager
def _explained(model: Any, variable: Variable) -> Iterator[None]:
    """Say which variable failed, in which line; and that a choice between values is written with ``where``."""
    where = f"{type(model).__name__}.{variable.name}"
    try:
        yield
    except (DeclarationError, ValueOutOfRange):
        raise
    except Exception as error:
        line = _line_in(variable.law, error)
        if "data-dependent control flow" in str(error) or ".item()" in str(error):
            raise DeclarationError(
                f"{where} branches on the value of a variable in line {line}, but a law serves many worlds at once; "
                "write where(condition, this, that) instead of if"
            ) from error
        raise DeclarationError(f"{where} failed in line {line}: {error}") from error


def _line_in(law: Callable | None, error: BaseException) -> int | str:
    code = getattr(law, "__code__", None)
    lines = [line for frame, line in traceback.walk_tb(error.__traceback__) if frame.f_code is code]
    return lines[-1] if lines else "?"
