"""The best evaluation so far, which each phase has its own of: an agent that explores is no best one of the task's."""

from __future__ import annotations

import numpy as np
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    EvalCallback,
    EventCallback,
    StopTrainingOnNoModelImprovement,
)


def forget_best(callback: BaseCallback | None) -> None:
    """Let evaluations of Stable-Baselines3 begin anew, and what hangs on their best one.

    :param callback: of ``learn``; those in it and below it, too
    """
    if isinstance(callback, CallbackList):
        for one in callback.callbacks:
            forget_best(one)
    if isinstance(callback, EvalCallback):
        callback.best_mean_reward = -np.inf
        forget_best(callback.callback_on_new_best)
    if isinstance(callback, EventCallback):
        forget_best(callback.callback)
    if isinstance(callback, StopTrainingOnNoModelImprovement):
        callback.last_best_mean_reward, callback.no_improvement_evals = -np.inf, 0
