"""The two phases of the benchmark, what moves from one to the other, and the callbacks that turn a run through them.

Paper §2 "Unsupervised RL" and §3 "Task-aware fine-tuning"; spec/algorithms §3 and §4.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv

from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.number_checks import is_integer

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2


@dataclass(frozen=True)
class Phase:
    """What distinguishes a phase; everything else of the algorithm is the same in both.

    :param explores: the intrinsic reward drives the actor, the task's reward does not reach the world model
    :param random_warmup: the steps before the first update act uniformly at random, otherwise with the actor
    :param plans: a planner, if one is set, acts
    :param ent_coef: entropy bonus of the actor; None takes the intrinsic reward's own
    """

    explores: bool
    random_warmup: bool
    plans: bool
    ent_coef: float | None


PRETRAINING, FINETUNING = "pretraining", "finetuning"
PHASES: dict[str, Phase] = {
    PRETRAINING: Phase(explores=True, random_warmup=True, plans=False, ent_coef=None),
    # Also a run from scratch, without pre-training: the paper's DreamerV2 baseline.
    FINETUNING: Phase(explores=False, random_warmup=False, plans=True, ent_coef=1e-4),
}

KEPT, ACTOR_CHOICE, CRITIC_CHOICE, FRESH = "kept", "kept if keep_actor", "kept if keep_critic", "fresh"
#: What a fine-tuning takes over from the pre-trained agent (spec/algorithms §4). Optimisers and replay always stay behind,
#: and so does an intrinsic reward without skills: nothing in a fine-tuning agent would take it.
TRANSFER: dict[str, str] = {
    "world_model.encoder": KEPT,
    "world_model.rssm": KEPT,
    "world_model.decoder": KEPT,
    "world_model.discount_logit": KEPT,
    "world_model.reward": FRESH,
    "actor": ACTOR_CHOICE,
    "critic": CRITIC_CHOICE,
    "slow_critic": CRITIC_CHOICE,
    "reward_normalizer": FRESH,
    # The skills of DIAYN and APS, and what APS chooses one by (spec/algorithms §6).
    "intrinsic": KEPT,
}

#: replayed states by which DIAYN and APS choose the skill for a task (spec/algorithms §6)
SKILL_STATES = 4096
#: Domains whose tasks give reward only in small regions: the pre-trained actor would drive away from them (paper §3).
SPARSE_DOMAINS = ("jaco",)


def transfer(source: Agent, target: Agent, keep_actor: bool, keep_critic: bool) -> None:
    """Copy what ``TRANSFER`` keeps from one agent into a fresh one of the same sizes.

    :param source: pre-trained
    :param target: fresh; changed in place
    :param keep_actor: see ``TRANSFER``
    :param keep_critic: see ``TRANSFER``
    """
    kept = {KEPT: True, ACTOR_CHOICE: keep_actor, CRITIC_CHOICE: keep_critic, FRESH: False}
    parts = tuple(f"{name}." for name, rule in TRANSFER.items() if kept[rule])
    state = {name: value for name, value in source.state_dict().items() if name.startswith(parts)}
    target.load_state_dict(state, strict=False)


def keeps_actor(domain: str | None) -> bool:
    """The paper's task-aware rule: keep the actor where rewards are dense, drop it where they are sparse.

    :param domain: of the fine-tuning task; None for an environment that does not tell, which counts as dense
    """
    return domain not in SPARSE_DOMAINS


class PhaseSwitchCallback(BaseCallback):
    """Turn a run from pre-training to fine-tuning inside one ``model.learn(...)``.

    The switch happens at the end of the rollout in which the phase's frames are reached, unless ``learn`` ends with it:
    then the model stays pre-trained, and the next ``learn`` begins with the switch. It depends only on the model's own phase
    and frame counter, which snapshots carry: repeated ``learn`` calls and resets are harmless.

    :param pretrain_frames: length of the pre-training in environment frames (agent steps × action repeat)
    :param env: the fine-tuning environment; None stays in the same one
    :param keep_actor: None decides by the task (paper §3): kept for walker and quadruped, dropped for jaco
    :param keep_critic: for ablations
    :param verbose: 1 prints the switch
    :raises ValueError: for a number of frames that is not positive, and, when ``learn`` begins, for an ``env`` that does
        not fit the model
    """

    def __init__(
        self,
        pretrain_frames: int = 2_000_000,
        env: GymEnv | None = None,
        keep_actor: bool | None = None,
        keep_critic: bool = False,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not is_integer(pretrain_frames) or pretrain_frames < 1:
            raise ValueError(f"pretrain_frames must be a positive integer, got {pretrain_frames!r}.")
        self.pretrain_frames = pretrain_frames
        self.env = env
        self.keep_actor = keep_actor
        self.keep_critic = keep_critic

    def _init_callback(self) -> None:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        if model.intrinsic_reward is None and model.phase != PRETRAINING:
            warnings.warn(
                "PhaseSwitchCallback has nothing to switch: with intrinsic_reward=None the model learns the task at once."
            )
        if self.env is None:
            return
        # Now, not after the 2M frames of pre-training.
        self.env = model.prepare_env(self.env)
        resumed = model.run_folder is not None and model.run_folder.resumed
        if resumed and model.phase != PRETRAINING and model.get_env() is not self.env:
            # The run was resumed after the switch, with the pre-training's environment.
            model.set_env(self.env)
            model.restart_episodes()

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        # A learn() before this one, perhaps in another process, ended with the pre-training.
        self._switch_if_due()

    def _on_rollout_end(self) -> None:
        # Between rollouts, because a rollout holds on to its environment and replay buffer. If no step is left for the
        # task, the pre-trained agent is what the caller wants to have.
        if self.model.num_timesteps < self.model._total_timesteps:
            self._switch_if_due()

    def _switch_if_due(self) -> None:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        if model.phase != PRETRAINING or model.phase_frames < self.pretrain_frames:
            return
        if self.verbose >= 1:
            print(f"Pre-training ends after {model.phase_frames} frames; fine-tuning begins.")
        model.fine_tune(self.env, self.keep_actor, self.keep_critic)
        model.restart_episodes()


class FineTuneCallback(BaseCallback):
    """Fine-tune a pre-trained snapshot from the first step of ``learn`` on: ``model.fine_tune()`` for configuration files.

    A model that is fine-tuning already, because its run was cut off, goes on.

    :param keep_actor: None decides by the task (paper §3): kept for walker and quadruped, dropped for jaco
    :param keep_critic: for ablations
    :param verbose: 1 prints what is fine-tuned
    :raises ValueError: when ``learn`` begins, for a model that was not pre-trained
    """

    def __init__(self, keep_actor: bool | None = None, keep_critic: bool = False, verbose: int = 1):
        super().__init__(verbose)
        self.keep_actor = keep_actor
        self.keep_critic = keep_critic

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        if model.phase_timesteps == 0 and (model.phase == PRETRAINING or model.intrinsic_reward is None):
            raise ValueError(
                "FineTuneCallback needs a pre-trained model, this one has seen 0 frames: "
                "load a snapshot with DreamerV2.load, or with rl_zoo3's -i."
            )
        if model.phase != PRETRAINING:
            return
        if self.verbose >= 1:
            print(f"Fine-tuning what {model.phase_frames} frames of pre-training with {model.intrinsic_reward!r} left.")
        model.fine_tune(keep_actor=self.keep_actor, keep_critic=self.keep_critic)
        model.restart_episodes()


#: when the paper saves its pre-trained agents, in environment frames
SNAPSHOT_FRAMES = (100_000, 500_000, 1_000_000, 2_000_000)


class SnapshotCallback(BaseCallback):
    """Save the pre-training agent whenever it has seen given numbers of frames (paper §2).

    Files are called ``<name_prefix>_<frames>.zip``.

    :param save_path: folder, made if it does not exist
    :param frames: when, in environment frames of the pre-training
    :param name_prefix: of the files
    :param verbose: 1 prints each path
    :raises ValueError: for numbers of frames that are not positive
    """

    def __init__(
        self,
        save_path: str | os.PathLike[str],
        frames: Sequence[int] = SNAPSHOT_FRAMES,
        name_prefix: str = "snapshot",
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not isinstance(frames, Sequence) or any(not is_integer(frame) or frame < 1 for frame in frames):
            raise ValueError(f"frames must be a sequence of positive integers, got {frames!r}.")
        self.save_path = os.fspath(save_path)
        self.frames = sorted(frames)
        self.name_prefix = name_prefix
        self.pending: list[int] = []

    def _init_callback(self) -> None:
        os.makedirs(self.save_path, exist_ok=True)
        model: DreamerV2 = self.model  # type: ignore[assignment]
        self.pending = [frame for frame in self.frames if frame > model.phase_frames]

    def _on_step(self) -> bool:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        if model.phase != PRETRAINING:
            return True
        while self.pending and model.phase_frames >= self.pending[0]:
            path = os.path.join(self.save_path, f"{self.name_prefix}_{self.pending.pop(0)}.zip")
            model.save(path)
            if self.verbose >= 1:
                print(f"Saved {path}")
        return True


def phase_ent_coef(phase: str, intrinsic: Any, chosen: float | None) -> float:
    """The actor's entropy bonus: the user's if given, otherwise the phase's, otherwise the intrinsic reward's.

    :param phase: a key of ``PHASES``
    :param intrinsic: the intrinsic reward, None without
    :param chosen: the user's
    """
    if chosen is not None:
        return chosen
    default = PHASES[phase].ent_coef
    return intrinsic.ent_coef if default is None else default
