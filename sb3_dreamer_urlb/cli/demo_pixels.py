"""The demonstration from pixels: pre-train with LBS, fine-tune with Dyna-MPC, and show what came of it, on two CPU cores."""

from __future__ import annotations

import dataclasses
import math
import time
from dataclasses import dataclass
from pathlib import Path

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb.callbacks.phase_switch import PhaseSwitchCallback
from sb3_dreamer_urlb.callbacks.snapshot import SnapshotCallback
from sb3_dreamer_urlb.cli import pace
from sb3_dreamer_urlb.cli.report import write_report
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.evaluation import figures
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.append import append_row
from sb3_dreamer_urlb.evaluation.episodes import SEED, Evaluation
from sb3_dreamer_urlb.evaluation.protocol import RandomPolicy, evaluate, play_episode
from sb3_dreamer_urlb.evaluation.scores import oracle
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.number_checks import check_positive
from sb3_dreamer_urlb.words import counted

#: frames of an episode, where the environment does not say
EPISODE = 1000
#: seconds that the demonstration may take before it takes smaller numbers by itself
LIMIT = 25 * 60.0
#: the smallest share of its frames that still shows something
LEAST = 0.3


@dataclass
class DemoConfig:
    """What the demonstration does; the defaults fit into 15 minutes on two cores.

    :param out: folder that everything is written to
    :param task: fine-tuning task, ``<domain>-<task>``; the pre-training never sees its reward
    :param pretrain_frames: environment frames of pre-training
    :param finetune_frames: environment frames of fine-tuning
    :param episodes: evaluation episodes
    :param seed: of everything random
    :param preset: of the model
    :param fast_render: cheaper shadows
    :param keep_actor: fine-tune the pre-trained actor; None decides by the task, as the paper does
    :raises ValueError: for a task that has no oracle score, or a number that is not positive
    """

    out: Path = Path("demo_pixels_output")
    task: str = "walker-stand"
    pretrain_frames: int = 3000
    finetune_frames: int = 12_000
    episodes: int = 3
    seed: int = 0
    preset: str = "small"
    fast_render: bool = True
    # The paper keeps the actor for walker. After three thousand frames it has learnt little but to act narrowly: fine-tuning
    # starts better with a fresh one (docs/notes/results.md).
    keep_actor: bool | None = False

    def __post_init__(self) -> None:
        oracle(self.task)
        check_positive(self, "pretrain_frames", "finetune_frames", "episodes")


class EpisodeRecorder(BaseCallback):
    """Remembers the return of every training episode."""

    def __init__(self) -> None:
        super().__init__()
        self.points: list[figures.CurvePoint] = []

    def _on_step(self) -> bool:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        for info in self.locals["infos"]:
            if "episode" in info:
                frames = self.num_timesteps * model.action_repeat
                self.points.append(figures.CurvePoint(frames, model.phase, info["episode"]["r"]))
        return True


def run_demo(config: DemoConfig) -> dict[str, float]:
    """Run everything, write the pictures, print the table.

    :param config: what to do
    :return: mean returns of ``"fine-tuned agent"``, ``"random policy"`` and ``"oracle"``
    :raises ImportError: if the extra ``plots`` is missing
    """
    figures.check_plots_installed()
    began = time.time()
    made_folder("--out", config.out)

    env = gymnasium.make(f"urlb/{config.task}-v0", fast_render=config.fast_render, render_mode="rgb_array")
    config = fitted(config, env)
    model, recorder = _train(config, env)
    returns = evaluate(model, env, config.episodes)
    random_returns = evaluate(RandomPolicy(env.action_space, config.seed), env, config.episodes)
    result = {
        "fine-tuned agent": float(np.mean(returns)),
        "random policy": float(np.mean(random_returns)),
        "oracle": oracle(config.task),
    }
    _draw(config, model, env, recorder, result)
    _report(config, model, env, returns)
    env.close()
    _print_table(config, result, returns, random_returns, time.time() - began)
    return result


def fitted(config: DemoConfig, env: gymnasium.Env, limit: float = LIMIT) -> DemoConfig:
    """Say how long it will take on this machine; on a slow one take fewer frames and episodes, and say that, too.

    :param config: numbers that are not the defaults are somebody's wish, and stay
    :param env: like the one to train in
    :param limit: seconds
    :return: what to do
    """
    model = _model(config, env)
    its_pace = pace.measure(model, env)
    defaults = {field.name: field.default for field in dataclasses.fields(DemoConfig)}
    names = [name for name in ("pretrain_frames", "finetune_frames") if getattr(config, name) == defaults[name]]

    def at(share: float) -> DemoConfig:
        episodes = 1 if share < 1 and config.episodes == defaults["episodes"] else config.episodes
        frames = {name: 100 * round(share * getattr(config, name) / 100) for name in names}
        return dataclasses.replace(config, **frames, episodes=episodes)

    def seconds(share: float) -> float:
        its = at(share)
        training = pace.phase(model, its.pretrain_frames, False) + pace.phase(model, its.finetune_frames, True)
        episode = getattr(env.spec, "max_episode_steps", None) or EPISODE // model.action_repeat
        # One more is filmed. The random policy costs the environment's steps only.
        shown = pace.Amount((its.episodes + 1) * episode, 0, (its.episodes + 1) * episode)
        return (training + shown).seconds(its_pace) + its.episodes * episode * its_pace.step

    share = pace.shrink(seconds, limit, LEAST)
    chosen = at(share)
    print(f"An update takes {its_pace.update:.2f} s here, a planned action {its_pace.plan:.2f} s.")
    if chosen != config:
        print(
            f"All of it would take {pace.in_words(seconds(1.0))}: on this machine {chosen.pretrain_frames} and "
            f"{chosen.finetune_frames} frames in place of {config.pretrain_frames} and {config.finetune_frames}, evaluated in "
            f"{counted(chosen.episodes, 'episode')} in place of {config.episodes}. Give the numbers yourself for the whole."
        )
    print(f"Learning and playing will take {pace.in_words(seconds(share))}; pictures come on top.", flush=True)
    return chosen


def _model(config: DemoConfig, env: gymnasium.Env, log: str | None = None) -> DreamerV2:
    return DreamerV2(
        "CnnPolicy",
        env,
        intrinsic_reward="lbs",
        planner="dyna_mpc",
        preset=config.preset,
        seed=config.seed,
        tensorboard_log=log,
    )


def _train(config: DemoConfig, env: gymnasium.Env) -> tuple[DreamerV2, EpisodeRecorder]:
    model = _model(config, env, str(config.out / "tensorboard"))
    recorder = EpisodeRecorder()
    callbacks = [
        recorder,
        SnapshotCallback(config.out, frames=[config.pretrain_frames], name_prefix="pretrained"),
        PhaseSwitchCallback(config.pretrain_frames, keep_actor=config.keep_actor),
    ]
    steps = -(-(config.pretrain_frames + config.finetune_frames) // model.action_repeat)
    print(f"Pre-training with LBS for {config.pretrain_frames} frames, then {config.finetune_frames} frames of {config.task}.")
    model.learn(steps, callback=callbacks, log_interval=1, tb_log_name="demo", progress_bar=True)
    model.save(config.out / "finetuned.zip")
    return model, recorder


def _draw(
    config: DemoConfig, model: DreamerV2, env: gymnasium.Env, recorder: EpisodeRecorder, result: dict[str, float]
) -> None:
    levels = {"evaluation after fine-tuning": result["fine-tuned agent"], "random policy": result["random policy"]}
    title = f"{config.task}: LBS pre-training, then fine-tuning with Dyna-MPC"
    figures.learning_curve(recorder.points, levels, title, config.out / "learning_curve.png")
    episode = play_episode(model, env, seed=config.seed, render=True)
    fps = env.get_wrapper_attr("metadata")["render_fps"]
    # Every second picture: half the size, same speed.
    figures.write_gif(episode.frames[:300:2], config.out / "agent.gif", fps / 2)
    truth, predicted = figures.open_loop(model.policy, episode, start=50, steps=45)
    film = figures.labelled_open_loop(truth, predicted, figures.CONTEXT, start=50)
    figures.write_gif(film, config.out / "open_loop.gif", fps / 2)
    figures.open_loop_errors(model.policy, episode, 50, 45, config.out / "open_loop.png")


def _report(config: DemoConfig, model: DreamerV2, env: gymnasium.Env, returns: list[float]) -> None:
    """The page that the demonstration ends with; a row of its evaluation stands beside the paper's numbers."""
    domain, task = config.task.split("-")
    planner = str(model.planner) if model._planner_is_on() else "none"
    played = Evaluation(returns, [], planner, math.nan, SEED)
    rows = config.out / "rows.csv"
    # Of a demonstration before this one.
    rows.unlink(missing_ok=True)
    append_row(rows, row_of(model, DummyVecEnv([lambda: env]), played, config.keep_actor, domain=domain, task=task))
    write_report(config.out, command=f"sb3-dreamer-urlb demo-pixels --task {config.task} --seed {config.seed}")


def _print_table(
    config: DemoConfig, result: dict[str, float], returns: list[float], random_returns: list[float], seconds: float
) -> None:
    several = config.episodes > 1
    spread = " (± standard deviation)" if several else ""
    played = {"fine-tuned agent": returns, "random policy": random_returns}
    spreads = {name: f"± {np.std(of):.0f}" if several else "" for name, of in played.items()}
    print(f"\n{config.task}, seed {config.seed}: mean return of {counted(config.episodes, 'episode')}{spread}")
    for name, value in result.items():
        note = spreads.get(name, "Dreamer trained for 2M frames (paper, appendix A)")
        print(f"  {name:<18}{value:>6.0f}  {note}")
    print(f"{seconds / 60:.1f} minutes. Written to {config.out}/:")
    for path in sorted(config.out.iterdir()):
        print(f"  {path.name}{'/' if path.is_dir() else ''}")
