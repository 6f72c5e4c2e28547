"""What DIAYN and APS share: a space of skills, and the choice of one of them for a task (docs/algorithm.md, "Skills")."""

from __future__ import annotations

from abc import abstractmethod

import torch as th

from sb3_dreamer_urlb.behavior.actor_critic import Actor, CategoricalActor
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.skills import Skills
from sb3_dreamer_urlb.types import Posterior, SequenceBatch


class SkillReward(IntrinsicReward):
    """An intrinsic reward for following skills. Fine-tuning keeps the module, to choose a skill by what it learnt.

    :param skills: what conditions actor and critic
    """

    skills: Skills

    def __init__(self, skills: Skills):
        super().__init__()
        self.skills = skills

    @abstractmethod
    def choose_skill(self, actor: Actor | CategoricalActor, posterior: Posterior, batch: SequenceBatch) -> th.Tensor:
        """The skill that serves the task best, float (W,).

        :param actor: pre-trained
        :param posterior: states inferred for the batch
        :param batch: of the task, with its rewards, (B, T, …)
        """
