"""Callbacks that act between rollouts: below one of events, which passes on none of these, they would do nothing, silently."""

from __future__ import annotations

from typing import TYPE_CHECKING

from stable_baselines3.common.callbacks import BaseCallback

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


class BetweenRolloutsCallback(BaseCallback):
    """A callback for ``learn`` itself, alone or in a list.

    :param verbose: as Stable-Baselines3's
    :raises ValueError: when ``learn`` begins, or at the first event, for one below an ``EvalCallback``, an
        ``EveryNTimesteps`` or another callback of events
    """

    def init_callback(self, model: BaseAlgorithm) -> None:
        """As Stable-Baselines3's.

        :param model: that is trained
        """
        self._check_place()
        super().init_callback(model)

    def on_step(self) -> bool:
        """As Stable-Baselines3's."""
        # A list tells its callbacks whose they are after they have begun.
        self._check_place()
        return super().on_step()

    def _check_place(self) -> None:
        if self.parent is not None:
            me = type(self).__name__
            raise ValueError(
                f"{me} must be given to learn() itself, alone or in a list: {type(self.parent).__name__} calls it only at its "
                "events, and it would never hear where rollouts begin and end."
            )
