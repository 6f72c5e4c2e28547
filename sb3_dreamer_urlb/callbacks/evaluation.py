"""The callback that evaluates while fine-tuning, as the paper does: 10 episodes every 10k frames."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_dreamer_urlb.algorithm.environment_checks import given_env
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.append import RowsDisagree, append_row, check_can_append
from sb3_dreamer_urlb.evaluation.episodes import (
    AUTO,
    EPISODES,
    OFF,
    ON,
    PLANNERS,
    SEED,
    Evaluation,
    run_evaluation,
    without_planner,
)
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.phases import PHASES
from sb3_dreamer_urlb.signatures import WithKnownKeywords
from sb3_dreamer_urlb.spaces.comparing import check_same_spaces
from sb3_dreamer_urlb.unknown_names import UnknownNameError

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

#: two rows an evaluation: with the planner and without
BOTH = "both"
#: arguments of ``EvalCallback`` that would do nothing here
INSTEAD = {"eval_freq": "every_frames=..., which counts frames of the phase", "render": "VideoCallback films agents"}


class EvaluationCallback(WithKnownKeywords, EvalCallback):
    """Evaluate every so many frames of fine-tuning: SB3's ``evaluations.npz`` and rows of a CSV file.

    An ``EvalCallback`` of Stable-Baselines3 that counts environment frames of the phase, plays the same seeds each time,
    and leaves the random draws of the training alone. ``RunCheckpointCallback(..., evaluation=this)`` remembers it.

    :param eval_env: to play in, not the training environment; as ``EvalCallback`` takes it, or its id
    :param every_frames: of the phase
    :param n_eval_episodes: how many, the paper's 10
    :param rows: CSV file, several runs may share it; None writes none
    :param log_path: folder of ``evaluations.npz``; None writes none
    :param best_model_save_path: folder of ``best_model.zip``; None saves none
    :param planner: ``"auto"`` as the agent acts at that time, ``"on"``, ``"off"``, or ``"both"``: a row with the planner, if
        the model has one, and a row of the actor alone. ``evaluations.npz`` and ``eval/mean_reward`` have the first
    :param pretraining: evaluate while pre-training, too
    :param keep_actor: for the rows; None takes what the model knows of its own fine-tuning
    :param keep_critic: likewise
    :param columns: further columns of the rows, such as ``{"arm": "no bonus"}``
    :param seed: of the first episode
    :param kwargs: of ``EvalCallback``, but for ``eval_freq`` and ``render``
    :raises ValueError: for numbers that are not positive, and, when ``learn`` begins, for an environment that the model
        trains in or whose spaces are not the model's, rows of a model without a seed, or ``"on"`` without a planner
    """

    def __init__(
        self,
        eval_env: GymEnv | str,
        every_frames: int = 10_000,
        n_eval_episodes: int = EPISODES,
        rows: str | os.PathLike[str] | None = None,
        log_path: str | None = None,
        best_model_save_path: str | None = None,
        planner: str = AUTO,
        pretraining: bool = False,
        keep_actor: bool | None = None,
        keep_critic: bool | None = None,
        columns: dict[str, Any] | None = None,
        seed: int = SEED,
        **kwargs: Any,
    ):
        for name in kwargs.keys() & INSTEAD.keys():
            raise UnknownNameError(f"EvaluationCallback takes no {name}: {INSTEAD[name]}.")
        for name, value in (("every_frames", every_frames), ("n_eval_episodes", n_eval_episodes)):
            check_integer(name, value, 1)
        if planner not in (*PLANNERS, BOTH):
            raise ValueError(f"planner must be one of {(*PLANNERS, BOTH)}, got {planner!r}.")
        given = given_env(eval_env, "eval_env")
        if not isinstance(given, VecEnv):
            one = given if is_wrapped(given, Monitor) else Monitor(given)
            given = DummyVecEnv([lambda: one])
        super().__init__(
            given,
            n_eval_episodes=n_eval_episodes,
            log_path=None if log_path is None else os.fspath(log_path),
            best_model_save_path=None if best_model_save_path is None else os.fspath(best_model_save_path),
            **{"verbose": 0, "warn": False, **kwargs},
        )
        self.every_frames = every_frames
        self.rows = None if rows is None else Path(rows)
        self.planner = planner
        self.pretraining = pretraining
        self.keep_actor, self.keep_critic = keep_actor, keep_critic
        self.columns = dict(columns or {})
        self.seed = seed
        self._due: tuple[str, int] = ("", 0)

    @property
    def _dreamer(self) -> DreamerV2:
        return self.model  # type: ignore[return-value]

    def _init_callback(self) -> None:
        training = self.model.get_env()
        if training is not None and training.unwrapped is self.eval_env.unwrapped:
            raise ValueError("EvaluationCallback needs an environment of its own, it was given the one that is trained in.")
        normalized = [unwrap_vec_normalize(env) is not None for env in (training, self.eval_env) if env is not None]
        if len(set(normalized)) > 1:
            raise ValueError("Either both the training and the evaluation environment are in a VecNormalize, or neither is.")
        # Now, not at the first evaluation; with images as the model sees them.
        check_same_spaces(self._dreamer._wrap_env(self.eval_env), self._dreamer)
        logs = self.log_path and os.path.dirname(self.log_path)
        for name, folder in (("best_model_save_path", self.best_model_save_path), ("log_path", logs)):
            if folder:
                made_folder(name, folder)
        if self.rows is not None:
            check_can_append(self.rows)
        if self.callback_on_new_best is not None:
            self.callback_on_new_best.init_callback(self.model)
        if self.rows is not None and self.model.seed is None and "seed" not in self.columns:
            raise ValueError("Rows tell runs apart by their seed: give the model one, or columns={'seed': ...}.")
        if self.planner == ON and getattr(self.model, "planner", None) is None:
            raise ValueError(without_planner(self.model))
        self._begin_phase()
        # An evaluation that was due before the run was cut off has been.
        self._due = (self._dreamer.phase, self._dreamer.phase_frames // self.every_frames)

    def _on_step(self) -> bool:
        model = self._dreamer
        phase, number = model.phase, model.phase_frames // self.every_frames
        self._begin_phase()
        before = self._due[1]
        self._due = (phase, number)
        if number <= before or (PHASES[phase].explores and not self.pretraining):
            return True
        return self.evaluate()

    def _begin_phase(self) -> None:
        """An agent that explores is no best one of the task's: where the phase is another, all begins anew."""
        phase = self._dreamer.phase
        if self._due[0] not in ("", phase):
            self.best_mean_reward = -np.inf
        if self._due[0] != phase:
            self._due = (phase, 0)

    def evaluate(self) -> bool:
        """Evaluate now.

        :return: False to stop the training, as the callbacks below this one decide
        """
        evaluations = [
            run_evaluation(self.model, self.eval_env, self.n_eval_episodes, self.seed, planner, self.deterministic)
            for planner in self._planners()
        ]
        for evaluation in evaluations:
            self._write_row(evaluation)
        return self._log(evaluations[0])

    def _planners(self) -> tuple[str, ...]:
        if self.planner != BOTH:
            return (self.planner,)
        return (OFF,) if getattr(self.model, "planner", None) is None or PHASES[self._dreamer.phase].explores else (ON, OFF)

    def _write_row(self, evaluation: Evaluation) -> None:
        if self.rows is None:
            return
        run = self._dreamer.run_folder
        columns = {**({} if run is None else {"run_folder": run.path}), **self.columns}
        try:
            append_row(self.rows, row_of(self.model, self.eval_env, evaluation, self.keep_actor, self.keep_critic, **columns))
        except RowsDisagree as error:
            # The first result stands, and hours of training are not thrown away for the second.
            warnings.warn(str(error))

    def _log(self, evaluation: Evaluation) -> bool:
        self.evaluations_timesteps.append(self.num_timesteps)
        self.evaluations_results.append(evaluation.returns)
        self.evaluations_length.append(evaluation.lengths)
        if self.log_path is not None:
            np.savez(
                self.log_path,
                timesteps=self.evaluations_timesteps,
                results=self.evaluations_results,
                ep_lengths=self.evaluations_length,
            )
        self.last_mean_reward = evaluation.mean
        if self.verbose >= 1:
            frames = self._dreamer.phase_frames
            print(f"Evaluation after {frames} frames: return {evaluation.mean:.1f} ± {evaluation.std:.1f}")
        self.logger.record("eval/mean_reward", evaluation.mean)
        self.logger.record("eval/mean_ep_length", float(np.mean(evaluation.lengths)))
        self.logger.record("time/total_timesteps", self.num_timesteps, exclude="tensorboard")
        self.logger.dump(self.num_timesteps)
        go_on = True
        if evaluation.mean > self.best_mean_reward:
            self.best_mean_reward = evaluation.mean
            if self.best_model_save_path is not None:
                self.model.save(os.path.join(self.best_model_save_path, "best_model"))
            if self.callback_on_new_best is not None:
                go_on = self.callback_on_new_best.on_step()
        if self.callback is not None:
            go_on = go_on and self._on_event()
        return go_on
