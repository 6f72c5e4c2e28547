"""Dyna-MPC for choices among classes: the Gaussian over action sequences becomes a probability for each choice.

The paper plans in boxes only; this is the cross-entropy method's usual form for classes. Everything else is
:class:`DynaMPC`.
"""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.planning.config import PlannableModel
from sb3_dreamer_urlb.planning.dyna_mpc import DynaMPC, _shifted
from sb3_dreamer_urlb.types import LatentState


class CategoricalDynaMPC(DynaMPC):
    """Refines probabilities over action sequences inside the model and acts with one of its elites.

    ``min_std`` is here the share of uniform choice that every refinement keeps (at most 1).

    :param config: hyperparameters
    :param gae_lambda: λ of the returns that rank trajectories
    :param classes: number of classes of each choice
    """

    plans_numbers, plans_choices = False, True

    def plan(
        self,
        model: PlannableModel,
        state: LatentState,
        previous_mean: th.Tensor,
        generator: th.Generator | None,
        explore: bool,
    ) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Planner.plan`; actions are one-hot, the mean holds probabilities, zeros where none are known yet."""
        probs = self._mixed(_shifted(previous_mean))
        proposals = self._actor_proposals(model, state, generator)
        trajectories = state.repeat(self.config.n_samples + proposals.shape[1])
        for _ in range(self.config.iterations):
            samples = self._draw(probs.unsqueeze(1).expand(-1, self.config.n_samples, -1, -1), generator)
            actions = th.cat([samples, proposals], 1)
            elites, weight = self._ranked(model, trajectories, actions, generator)
            # The elites' mean is how often each class is chosen.
            mean, _ = self.returned("refine", self.refine(probs, elites, weight), probs.shape, probs.shape)
            probs = self._mixed(mean)
        if explore:
            return self._draw(probs[:, 0], generator), probs
        return self._draw_elite(elites, weight, generator), probs

    def _mixed(self, probs: th.Tensor) -> th.Tensor:
        """Uniform where nothing is known, and a little everywhere: (…, A)."""
        share = min(self.config.min_std, 1.0)
        parts = []
        for part in probs.split(self.classes, -1):
            total = part.sum(-1, keepdim=True)
            uniform = th.full_like(part, 1 / part.shape[-1])
            known = th.where(total > 0, part / total.clamp(min=1e-8), uniform)
            parts.append((1 - share) * known + share * uniform)
        return th.cat(parts, -1)

    def _draw(self, probs: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """One-hot choices, (…, A)."""
        return distributions.one_hot_choices(probs, self.classes, generator)
