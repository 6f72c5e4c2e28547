"""What there is to tell about the updates of a ``learn``: that there will be none, or that they will take days."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable
from itertools import pairwise

from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_dreamer_urlb.algorithm.advice import NoUpdateWarning
from sb3_dreamer_urlb.algorithm.collecting import CollectingAlgorithm

#: hours that a ``learn`` on a CPU may still take without a word
LONG = 24.0
#: rollouts with updates of which the fastest sets the pace, after the first, in which kernels are compiled: callbacks may
#: evaluate or save in the others
PACED = 4


class UpdatesDue:
    """Watches one ``learn``: warns at once if it will end within the warm-up of its phase, and soon if it will take days.

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

    def paced(self, update: Callable[[int, int], None]) -> Callable[[int, int], None]:
        """The updates of a rollout, by whose pace a long ``learn`` on a CPU is told: there other sizes may be meant.

        :param update: what the training loop calls
        :return: what it is to call in its place
        """
        model, times, steps = self.model, list[float](), list[int]()

        def updating(collected: int, ahead: int) -> None:
            before = model._n_updates
            update(collected, ahead)
            if len(times) > PACED or model._n_updates == before or model.device.type != "cpu":
                return
            times.append(time.monotonic())
            steps.append(model.num_timesteps)
            if len(times) > PACED:
                between = zip(pairwise(times), pairwise(steps), strict=True)
                self._tell_if_long(min((end - begin) / max(last - first, 1) for (begin, end), (first, last) in between))

        return updating

    def _tell_if_long(self, seconds: float) -> None:
        """
        :param seconds: an agent step, updates included
        """
        left = self.total_timesteps - self.model.num_timesteps
        if (hours := left * seconds / 3600) > LONG:
            preset = getattr(self.model, "preset", None)
            warnings.warn(
                f"At its pace so far this learn() will take another {hours:.0f} hours for {left} agent steps, on a CPU. A "
                f"GPU, fewer updates (train_freq), or a preset smaller than {preset!r} take less."
            )

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
