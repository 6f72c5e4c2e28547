"""Skills w: what DIAYN and APS condition the actor and the critic on (docs/algorithm.md, "Skills")."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.number_checks import check_integer


class Skills(nn.Module):
    """A space of skills, and the one that is fixed once fine-tuning has chosen it.

    :param dim: W, size of a skill
    :param interval: agent steps after which an acting agent draws a new one
    :raises ValueError: for fewer than two dimensions or an interval below one
    """

    fixed: th.Tensor

    def __init__(self, dim: int, interval: int = 50):
        super().__init__()
        for name, value, least in (("skill_dim", dim, 2), ("skill_interval", interval, 1)):
            check_integer(name, value, least)
        self.dim = dim
        self.interval = interval
        # Zeros mean that none is fixed: no skill of any space is zero.
        self.register_buffer("fixed", th.zeros(dim))
        self.is_fixed = False

    @abstractmethod
    def draw(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        """``n`` random skills, float (n, W)."""

    @abstractmethod
    def check(self, skill: th.Tensor) -> None:
        """
        :param skill: float (W,)
        :raises ValueError: if it lies outside this space
        """

    def numbered(self, number: int) -> th.Tensor:
        """The skill with a number, float (W,).

        :raises ValueError: if there is none
        """
        raise ValueError(f"These skills are vectors of {self.dim} numbers and have no numbers themselves, got {number}.")

    def sample(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        """The fixed skill ``n`` times if there is one, otherwise random ones, float (n, W)."""
        return self.fixed.expand(n, -1) if self.is_fixed else self.draw(n, generator)

    def fix(self, skill: th.Tensor | np.ndarray | None) -> None:
        """Follow one skill from now on, or random ones again.

        :param skill: float (W,), or None
        :raises ValueError: if it has another shape or lies outside this space
        """
        if skill is None:
            self.fixed.zero_()
            self.is_fixed = False
            return
        if not isinstance(skill, th.Tensor | np.ndarray | list | tuple):
            raise ValueError(f"A skill must be a vector of {self.dim} numbers, got {skill!r}.")
        skill = th.as_tensor(skill, dtype=self.fixed.dtype, device=self.fixed.device)
        if skill.shape != (self.dim,):
            raise ValueError(f"A skill must have the shape ({self.dim},), got {tuple(skill.shape)}.")
        if not bool(th.isfinite(skill).all()):
            raise ValueError(f"A skill must be finite, got {skill.tolist()}.")
        self.check(skill)
        self.fixed.copy_(skill)
        self.is_fixed = True

    def _load_from_state_dict(self, *args, **kwargs) -> None:  # type: ignore[no-untyped-def]
        super()._load_from_state_dict(*args, **kwargs)
        # A Python flag, because asking the buffer would wait for the device at every step.
        self.is_fixed = bool(self.fixed.any())


class OneHotSkills(Skills):
    """W skills, one-hot (DIAYN)."""

    def numbered(self, number: int) -> th.Tensor:
        if not 0 <= number < self.dim:
            raise ValueError(f"A skill's number must lie in [0, {self.dim - 1}], got {number}.")
        return F.one_hot(th.tensor(number), self.dim).to(self.fixed)

    def draw(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        probs = self.fixed.new_ones(n, self.dim)
        return distributions.one_hot_like(probs, distributions.draw_classes(probs, generator))

    def check(self, skill: th.Tensor) -> None:
        if not (((skill == 0) | (skill == 1)).all() and skill.sum() == 1):
            raise ValueError(f"A skill must be one-hot, got {skill.tolist()}.")


class UnitSkills(Skills):
    """Unit vectors of W dimensions (APS)."""

    def draw(self, n: int, generator: th.Generator | None = None) -> th.Tensor:
        return F.normalize(distributions.draw_normal((n, self.dim), self.fixed, generator), dim=-1)

    def check(self, skill: th.Tensor) -> None:
        if not th.isclose(skill.norm(), th.ones_like(skill[0]), atol=1e-4):
            raise ValueError(f"A skill must be a unit vector, got {skill.tolist()} of norm {float(skill.norm()):.4g}.")
