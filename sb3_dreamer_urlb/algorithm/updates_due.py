"""A ``learn`` without a single update teaches nothing: it is told, before it begins where that is known."""

from __future__ import annotations

import math
import warnings

from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_dreamer_urlb.algorithm.advice import NoUpdateWarning
from sb3_dreamer_urlb.algorithm.collecting import CollectingAlgorithm


class UpdatesDue:
    """Watches one ``learn``, and warns at once if it will end within the warm-up of its phase.

    :param model: about to learn
    :param total_timesteps: at which it ends, as ``num_timesteps`` counts
    """

    def __init__(self, model: CollectingAlgorithm, total_timesteps: int):
        self.model, self.total_timesteps = model, total_timesteps
        self.updates, self.steps = model._n_updates, total_timesteps - model.num_timesteps
        #: there is nothing more to say
        self.told = self.steps <= 0 or model.gradient_steps == 0
        frequency, unit = model.train_freq  # type: ignore[misc]
        if self.told or unit != TrainFrequencyUnit.STEP:
            return
        rollout = frequency * model.n_envs
        end = model.phase_timesteps + math.ceil(self.steps / rollout) * rollout
        if end <= model.learning_starts:
            self.told = True
            warning = f"This learn() will hold no update: it ends after {end} agent steps of {model.phase}, {self._warm_up}"
            warnings.warn(warning, NoUpdateWarning)

    def ended(self) -> None:
        """Warn if there was none, unless a callback ended it early."""
        model = self.model
        if self.told or model._n_updates > self.updates or model.num_timesteps < self.total_timesteps:
            return
        why = self._warm_up
        if model.phase_timesteps > model.learning_starts:
            why = f"and the replay still waits for {model.replay_buffer.waits_for}."
        warnings.warn(
            f"learn() has ended without an update, after {model.phase_timesteps} agent steps of {model.phase}, {why}",
            NoUpdateWarning,
        )

    @property
    def _warm_up(self) -> str:
        return f"and updates begin after learning_starts={self.model.learning_starts}: more steps, or fewer of those?"
