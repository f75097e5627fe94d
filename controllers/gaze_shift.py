"""Sharing a gaze shift among motors whose noise grows with what they are told (thesis sections 6.6.3 and 6.8.7)."""

from __future__ import annotations

import torch
from scipy.optimize import lsq_linear
from torch import Tensor

from apmodels import Box, ValueOutOfRange
from controllers.controller import Controller
from inference import Belief, Engine, Refusal


class GazeShift(Controller):
    """Moves what is seen to where it is wanted, by motors that are learned.

    Each motor's part is the less, the noisier it is and the less is known of it: E|m - (a + ã)u|² also has what is
    not known of a, whose entries are taken to be independent. No motor is told more than its space allows. What is seen
    40 pixels to the right of the middle is looked at by ``aim(torch.tensor([-40.0, 0.0]))``: it shall move to the left.

    Args:
        engine: of a model with a hidden variable (D, K) by which an action (K,) moves something in D directions.
        by: its name.
        noise: the standard deviation that a unit of each motor adds, (D, K), or the name of a hidden variable that is.
        goal: where to, (D,), until ``aim`` says otherwise; not at all by default.
        seed: not used; a gaze shift is not drawn.
    """

    def __init__(
        self,
        engine: Engine,
        by: str = "actuation",
        noise: Tensor | str | None = None,
        goal: Tensor | None = None,
        seed: int = 0,
    ):
        super().__init__(engine, seed)
        name, space = self.only_action()
        hidden = {node.name: node.shape for node in self.model.structure.hidden}
        for part in (by, noise):
            if isinstance(part, str) and len(hidden.get(part, ())) != 2:
                raise Refusal(f"GazeShift needs a hidden matrix by which {name} moves the gaze; {part} is none")
        if not isinstance(space, Box) or space.shape != (hidden[by][1],):
            raise Refusal(f"GazeShift needs an action of {hidden[by][1]} numbers, a motor each; {name} is {space}")
        self.space, self.by, self.noise = space, by, noise
        self._linear(name)
        self.aim(torch.zeros(hidden[by][0]) if goal is None else goal)

    def _linear(self, action: str) -> None:
        """Refuse a model whose gaze does not move by the matrix times the command."""
        nodes, random = self.model.structure.nodes, torch.Generator().manual_seed(0)
        for variable in self.model.declaration.of_role("state", "observation"):
            parents = {parent.argument: parent.name for parent in variable.parents if not parent.lag}
            if {self.by, action} <= set(parents.values()):
                values = {name: torch.rand(nodes[name].shape, generator=random) for name in (self.by, action)}
                given = {a: values[n] if n in values else torch.ones(nodes[n].shape) for a, n in parents.items()}
                law = self.engine.laws.one(variable.name, given)
                moved = law if isinstance(law, Tensor) else law.mean
                if torch.allclose(moved.float(), values[self.by] @ values[action], rtol=1e-4, atol=1e-4):
                    return
        raise Refusal(f"GazeShift needs something that moves by {self.by} times {action}; here nothing does")

    def aim(self, goal: Tensor) -> None:
        """Say by how much what is seen shall move, (*batch, D), in the units of the variable."""
        self.goal = torch.as_tensor(goal, dtype=torch.float64)

    def act(self, belief: Belief) -> Tensor:
        """Return commands, (*batch, K)."""
        law = belief.marginal(self.by)
        noise = 0.0 if self.noise is None else self.noise
        noise = belief.marginal(noise).mean if isinstance(noise, str) else torch.as_tensor(noise)
        spread = (noise.double() ** 2 + law.variance.double()).sqrt()
        return gaze_shift(law.mean, spread, self.goal, self.space.low, self.space.high).to(law.mean.dtype)


def gaze_shift(
    actuation: Tensor,
    noise: Tensor,
    goal: Tensor,
    low: Tensor | float | None = None,
    high: Tensor | float | None = None,
) -> Tensor:
    """Return the commands after which the gaze is expected to be nearest its goal, in squared distance (eq. 6.67).

    u = [diag(1ᵀ(n ∘ n)) + aᵀa]⁻¹ aᵀ m: more of the surer motors, and a little less than all the way. Of motors without
    noise that can replace each other, the least of each (a pseudo-inverse).

    Args:
        actuation: a, how far a unit of each motor moves the gaze, (*batch, D, K), pixels or degrees a unit.
        noise: n, the standard deviation that a unit of each motor adds, (*batch, D, K), independent of each other's; a
            motor of infinite noise is not used.
        goal: m, where to, (*batch, D).
        low: the least command of each motor, (*batch, K) or one for all; no limit by default.
        high: the largest, likewise.

    Returns:
        Commands, (*batch, K), double precision.
    """
    a, n, m = (torch.as_tensor(value, dtype=torch.float64) for value in (actuation, noise, goal))
    if a.dim() < 2 or n.shape[-2:] != a.shape[-2:] or m.shape[-1:] != a.shape[-2:-1]:
        raise ValueOutOfRange(
            "a gaze shift needs actuation and noise (directions, motors) and a goal (directions), not "
            f"{tuple(a.shape)}, {tuple(n.shape)} and {tuple(m.shape)}"
        )
    if not bool(torch.isfinite(a).all() and torch.isfinite(m).all()) or bool(torch.isnan(n).any()):
        raise ValueOutOfRange("a gaze shift needs finite actuation and goal, and noise that is a number")
    # Who is not to be relied upon at all is not used.
    useless = torch.isinf(n).any(-2, keepdim=True)
    a, n = torch.where(useless, 0.0, a), torch.where(useless, 1.0, n)
    square = torch.diag_embed((n * n).sum(-2)) + a.mT @ a
    slope = (a.mT @ m[..., None])[..., 0]
    free = (torch.linalg.pinv(square, hermitian=True) @ slope[..., None])[..., 0]
    if low is None and high is None:
        return free
    return _bounded(a, (n * n).sum(-2).sqrt(), m, free, *_limits(low, high, free))


def expected_error(actuation: Tensor, noise: Tensor, goal: Tensor, command: Tensor) -> Tensor:
    """Return the expected squared distance from the goal after a command, (*batch,) (eq. 6.62)."""
    a, n, m, u = (torch.as_tensor(value, dtype=torch.float64) for value in (actuation, noise, goal, command))
    missed = m - (a @ u[..., None])[..., 0]
    return (missed * missed).sum(-1) + ((n * n).sum(-2) * u * u).sum(-1)


def _limits(low: Tensor | float | None, high: Tensor | float | None, free: Tensor) -> tuple[Tensor, Tensor]:
    least = torch.as_tensor(-torch.inf if low is None else low, dtype=torch.float64).expand(free.shape)
    most = torch.as_tensor(torch.inf if high is None else high, dtype=torch.float64).expand(free.shape)
    if not bool((least <= most).all()):
        raise ValueOutOfRange("a motor's least command is larger than its largest")
    return least, most


def _bounded(actuation: Tensor, spread: Tensor, goal: Tensor, free: Tensor, low: Tensor, high: Tensor) -> Tensor:
    """The best commands between limits, least squares; only those that would pass a limit are looked for."""
    found = torch.minimum(torch.maximum(free, low), high)
    motors, ways = free.shape[-1], actuation.shape[-2]
    past = (found != free).any(-1).flatten().nonzero()[:, 0].tolist()
    flat, low, high = (value.reshape(-1, motors) for value in (found, low, high))
    a = actuation.expand(*free.shape[:-1], ways, motors).reshape(-1, ways, motors)
    rows = torch.cat([a, torch.diag_embed(spread.expand(free.shape).reshape(-1, motors))], 1).numpy()
    sides = torch.nn.functional.pad(goal.expand(*free.shape[:-1], ways).reshape(-1, ways), (0, motors)).numpy()
    for i in past:
        limits = low[i].numpy(), high[i].numpy()
        flat[i] = torch.as_tensor(lsq_linear(rows[i], sides[i], limits, method="bvls", tol=1e-14).x)
    # The solver may pass a limit by a rounding, and a motor must not.
    return torch.minimum(torch.maximum(flat, low), high).reshape(found.shape)
