"""What has been learned, kept: arrays and a JSON header (numpy's npz). Loading runs no code."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from apmodels import Grid, ValueOutOfRange
from inference import Engine, Refusal


def keep(path: str | Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write a header and arrays."""
    with Path(path).open("wb") as file:
        np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)  # type: ignore[arg-type]


def read(path: str | Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the header and the arrays; an empty header where there is none."""
    with np.load(path, allow_pickle=False) as kept:
        arrays = {name: kept[name] for name in kept.files}
    return json.loads(str(arrays.pop("header", "{}"))), arrays


def policy_from(path: str | Path, header: dict[str, Any], arrays: dict[str, np.ndarray]) -> Any:
    """Return the policy that a file holds."""
    made = header.get("policy")
    if made is None or made["kind"] not in POLICIES:
        raise ValueOutOfRange(f"{path} holds no policy of {', '.join(POLICIES)}")
    policy, weights = POLICIES[made["kind"]](made), torch.as_tensor(arrays["weights"])
    if weights.shape != policy.weights.shape:
        shapes = tuple(weights.shape), tuple(policy.weights.shape)
        raise ValueOutOfRange(f"{path} has weights {shapes[0]}, but its header describes {shapes[1]}")
    with torch.no_grad():
        policy.weights.copy_(weights)
    return policy


def load(path: str | Path, engine: Engine | None = None) -> Any:
    """Return the controller that a file holds, for an engine of the same model; without an engine, the policy alone."""
    from controllers.dynamic_programming import DynamicProgramming
    from controllers.policy_gradient import PolicyGradient

    header, arrays = read(path)
    if engine is None:
        if not header:
            raise Refusal(f"{path} holds a plan, which needs its engine: load(path, engine)")
        return policy_from(path, header, arrays)
    return PolicyGradient.load(engine, path) if header else DynamicProgramming.load(engine, path)


def _logistic(made: dict[str, Any]) -> Any:
    from controllers.policy_logistic import LogisticPolicy

    return LogisticPolicy(made["states"], made["actions"], made["features"])


def _convolutional(made: dict[str, Any]) -> Any:
    from controllers.policy_convolutional import ConvolutionalPolicy

    return ConvolutionalPolicy(Grid(*made["grid"]), made["width"], made["features"], spacing=made.get("spacing"))


POLICIES: dict[str, Callable[[dict[str, Any]], Any]] = {
    "LogisticPolicy": _logistic,
    "ConvolutionalPolicy": _convolutional,
}
