"""``enjoy`` says when no episode came to its end; rl_zoo3 ends without a word then."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from stable_baselines3.common.vec_env import VecEnv


@dataclass
class Played:
    """What was played.

    :param steps: of every environment
    :param episodes: that were finished, of all environments
    """

    steps: int = 0
    episodes: int = 0

    def counting(self, make: Callable[..., VecEnv]) -> Callable[..., VecEnv]:
        """rl_zoo3's ``create_test_env``, whose environments' steps are counted here.

        :param make: the original
        """

        @functools.wraps(make)
        def create_test_env(*args: Any, **kwargs: Any) -> VecEnv:
            env = make(*args, **kwargs)
            step = env.step

            def counted(actions: Any) -> Any:
                result = step(actions)
                self.steps += 1
                self.episodes += int(result[2].sum())
                return result

            env.step = counted  # type: ignore[method-assign]
            return env

        return create_test_env

    def complaint(self) -> str | None:
        """What to say of it, None where an episode was finished or nothing was played."""
        if self.episodes or not self.steps:
            return None
        return f"no episode was finished in {self.steps} steps, so there is no return to tell: -n gives more steps"
