"""Functions of tensors that are called again and again: what they do is recorded once, and replayed.

A law is written for one world, and vectorising it costs more than the arithmetic that comes of it. A recording is that
arithmetic alone, for arguments of one shape, stride and type; replaying it gives the very same numbers.
"""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Hashable, Sequence
from typing import Any

import torch
from torch import Tensor

# A recording takes as long as many calls, and pays once calls have taken so many seconds.
PATIENCE = 0.5
# So many kinds of arguments are told apart.
MOST = 16

Function = Callable[..., tuple[Tensor, ...]]


class Recorder:
    """Calls a function, and replays it once it has been called for a while.

    The function must do nothing but arithmetic, and draw: one that asks for a value fails to record, and is called as
    before. What it holds besides its arguments is taken to stay as it is.
    """

    def __init__(self, function: Function):
        self.function = function
        self.spent: dict[Hashable, float] = {}
        self.replays: dict[Hashable, Callable[..., Sequence[Tensor]] | None] = {}

    def __call__(self, *arguments: Tensor) -> Sequence[Tensor]:
        """Return what the function returns."""
        kind = tuple((x.shape, x.stride(), x.dtype) for x in arguments)
        replay = self.replays.get(kind)
        if replay is not None and not any(x.requires_grad for x in arguments):
            return replay(*arguments)
        start = time.perf_counter()
        results = self.function(*arguments)
        if any(result.requires_grad for result in results):
            return results
        spent = self.spent[kind] = self.spent.get(kind, 0.0) + time.perf_counter() - start
        if spent > PATIENCE and kind not in self.replays and len(self.replays) < MOST:
            self.replays[kind] = recorded(self.function, arguments)
        return results

    def __reduce__(self) -> tuple:
        return Recorder, (self.function,)


def recorded(function: Function, arguments: Sequence[Tensor]) -> Callable[..., Sequence[Tensor]] | None:
    """Return what replays a function for arguments like these, or None where it cannot be recorded."""
    from torch.fx.experimental.proxy_tensor import make_fx

    state = torch.get_rng_state()
    try:
        module: Any = make_fx(function)(*arguments)
        _shorten(module, arguments)
        torch.set_rng_state(state)
        expected = function(*arguments)
        torch.set_rng_state(state)
        found = module.forward(*arguments)
    except Exception:
        # Whatever it was, the function is there to be called.
        return None
    finally:
        torch.set_rng_state(state)
    same = len(found) == len(expected) and all(_same(*pair) for pair in zip(found, expected, strict=True))
    return module.forward if same else None


def _same(one: Tensor, other: Tensor) -> bool:
    if one.dtype != other.dtype or one.shape != other.shape or one.stride() != other.stride():
        return False
    return torch.equal(one.nan_to_num(), other.nan_to_num()) and torch.equal(one.isnan(), other.isnan())


# Shortening a recording.

# What leaves a tensor as it is, where its shape and stride come out the same.
VIEWS = {
    "view",
    "expand",
    "reshape",
    "_unsafe_view",
    "alias",
    "detach",
    "squeeze",
    "unsqueeze",
    "permute",
    "_reshape_alias",
}


def _shorten(module: Any, arguments: Sequence[Tensor]) -> None:
    """Compute beforehand what depends on nothing, and leave out what changes nothing."""
    graph = module.graph
    calls = [node for node in graph.nodes if node.op == "call_function"]
    if any(_mutates(node) for node in calls):
        return
    values = _values(module, arguments)
    constants = {node for node in graph.nodes if node.op == "get_attr"}
    for node in calls:
        if not _random(node) and all(other in constants for other in node.all_input_nodes):
            constants.add(node)
    for node in calls:
        value = values[node]
        if node in constants:
            if isinstance(value, Tensor) and any(user not in constants for user in node.users):
                name = f"_constant_{node.name}"
                module.register_buffer(name, value, persistent=False)
                with graph.inserting_before(node):
                    node.replace_all_uses_with(graph.get_attr(name))
        elif _is_view(node):
            source = node.args[0]
            before = values[source]
            if isinstance(value, Tensor) and value.shape == before.shape and value.stride() == before.stride():
                node.replace_all_uses_with(source)
    for node in reversed(graph.nodes):
        if node.op not in ("placeholder", "output") and not node.users and not _random(node):
            graph.erase_node(node)
    graph.lint()
    module.recompile()


def _values(module: Any, arguments: Sequence[Tensor]) -> dict[Any, Any]:
    """The value of every node."""
    found: dict[Any, Any] = {}

    class Noting(torch.fx.Interpreter):
        def run_node(self, n: Any) -> Any:
            found[n] = super().run_node(n)
            return found[n]

    Noting(module, garbage_collect_values=False).run(*arguments)
    return found


def _mutates(node: Any) -> bool:
    schema = getattr(node.target, "_schema", None)
    return node.target is not operator.getitem and (schema is None or schema.is_mutable)


def _random(node: Any) -> bool:
    return torch.Tag.nondeterministic_seeded in getattr(node.target, "tags", ())


def _is_view(node: Any) -> bool:
    return getattr(node.target, "_opname", getattr(node.target, "__name__", "").split(".")[0]) in VIEWS
