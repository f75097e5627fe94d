"""What is asked of a bank of worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from torch import Tensor

from apmodels import ValueOutOfRange
from apmodels.simulation import Values
from inference.answers.entropies import entropy
from inference.answers.forecasts import forecast
from inference.answers.gain import expectation, imagine, information_gain
from inference.answers.posteriors import marginal
from inference.beliefs import Marginal, Weighted
from inference.engine import Engine
from inference.worlds.step import BankBelief


class Asking(Engine):
    """The part of a bank that answers."""

    def marginal(self, belief: BankBelief, name: str) -> Any:
        """Return the distribution of a hidden variable, batch shape (*batch,)."""
        return marginal(self, belief, name)

    def entropy(self, belief: BankBelief, names: str | tuple[str, ...] | None = None) -> Tensor:
        """Return the joint entropy of variables in nats, (*batch,)."""
        found = entropy(self, belief, self.names(names))
        return found[0] if belief.batch is None else found

    def most_probable(self, belief: BankBelief, name: str | None = None) -> Tensor:
        """Return the most probable value of a variable, or its mean where it is a continuum, (*batch, *shape)."""
        names = self.names(name)
        if len(names) != 1:
            raise ValueOutOfRange(f"the interest is {names}; name one variable")
        law = self.marginal(belief, names[0])
        return law.mode if isinstance(law, (Marginal, Weighted)) else law.mean

    def gain(self, belief: BankBelief, actions: Any = None, samples: int = 64, seed: int = 0) -> Tensor:
        """Return the expected information about the interest, nats, (*batch, K) (thesis eq. 5.4)."""
        return information_gain(self, belief, actions, samples, seed)

    def expect(
        self,
        belief: BankBelief,
        worth: Callable[[Tensor], Tensor],
        actions: Any = None,
        samples: int = 64,
        seed: int = 0,
    ) -> Tensor:
        """Return the expectation of a function of the next belief about the interest, (*batch, K)."""
        return expectation(self, belief, worth, actions, samples, seed)

    def imagine(self, belief: BankBelief, action: Any, samples: int = 64, seed: int = 0) -> tuple[Values, Tensor]:
        """Return what may be seen next, (B, S, *shape) by name, and how probable each is, (B, S)."""
        return imagine(self, belief, self._actions(action, len(belief.log_weights)), samples, seed)

    def forecast(self, belief: BankBelief, action: Any) -> Any:
        """Return the predictive distribution of the next observation, a mixture over worlds; a dict of several."""
        return forecast(self, belief, action)
