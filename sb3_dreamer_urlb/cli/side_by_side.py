"""What ``sb3-dreamer-urlb demo`` does: two agents at work, their progress, and what came of it."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sb3_dreamer_urlb.cli import demo_agents, pace
from sb3_dreamer_urlb.cli.compare import compare_runs
from sb3_dreamer_urlb.cli.demo_agents import Agent
from sb3_dreamer_urlb.cli.demo_pictures import curves, film
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.envs.registration import PRIMAL_TASK, URLB_TASKS, env_id
from sb3_dreamer_urlb.evaluation.figures import check_plots_installed
from sb3_dreamer_urlb.evaluation.protocol import RandomPolicy, evaluate
from sb3_dreamer_urlb.evaluation.rows import Row, read_rows
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.number_checks import check_integer, check_positive
from sb3_dreamer_urlb.words import counted, mean_and_spread

#: the agent that ships: LBS on walker stand without its reward, 40 000 frames, seed 0
SHIPPED = Path(__file__).with_name("data") / "walker-lbs.zip"
DOMAIN, PRESET = "walker", "state-small"
#: frames of an episode
EPISODE = 1000
#: seconds that the demonstration may take before it takes smaller numbers by itself
LIMIT = 15 * 60.0
#: the smallest share of its frames that still shows something
LEAST = 0.4
#: the two agents, in the order of their columns
SCRATCH, PRETRAINED = "from scratch", "pre-trained"
#: how long two agents beside each other take where one alone takes 1: they share caches and memory (measured on two cores)
BESIDE = 1.3
#: seconds between two looks at the agents' progress
LOOK = 1.0


@dataclass
class DemoConfig:
    """What the demonstration does; the defaults fit into 15 minutes on two cores.

    :param out: folder that everything is written to
    :param task: of the walker; the pre-training never saw its reward
    :param finetune_frames: environment frames that each agent learns the task from, an episode at least
    :param pretrain_frames: of a pre-training before; 0 takes the agent that ships
    :param episodes: evaluation episodes
    :param seed: of everything random
    :param preset: of the agents; another one than the shipped agent's needs ``pretrain_frames``
    :raises ValueError: for an unknown task, or a number that is too small
    """

    out: Path = Path("demo_output")
    task: str = "flip"
    finetune_frames: int = 20_000
    pretrain_frames: int = 0
    episodes: int = 10
    seed: int = 0
    preset: str = PRESET

    def __post_init__(self) -> None:
        self.task = self.task.removeprefix(f"{DOMAIN}-")
        if self.task not in URLB_TASKS[DOMAIN]:
            raise ValueError(f"Unknown task {self.task!r}; known are {', '.join(URLB_TASKS[DOMAIN])}, of the {DOMAIN}.")
        check_positive(self, "episodes")
        check_integer("finetune_frames", self.finetune_frames, EPISODE)
        check_integer("pretrain_frames", self.pretrain_frames, EPISODE if self.pretrain_frames else 0)
        if self.preset != PRESET and not self.pretrain_frames:
            raise ValueError(f"The agent that ships has the preset {PRESET!r}: preset={self.preset!r} needs pretrain_frames.")


def run_demo(config: DemoConfig) -> dict[str, float]:
    """Let both agents learn and play, draw the pictures, print the table.

    :param config: what to do
    :return: mean return over the training episodes of both agents, by name
    :raises ImportError: if the extra ``plots`` is missing
    """
    check_plots_installed()
    began = time.time()
    made_folder("--out", config.out)
    config, left = fitted(config)
    agents = _agents(config)
    for agent in agents.values():
        _forget(agent.folder)
    # Not fork: a child that inherits a renderer hangs.
    with ProcessPoolExecutor(_at_once(), mp_context=multiprocessing.get_context("forkserver")) as pool:
        if config.pretrain_frames:
            _pretrain(config, pool)
        print(f"\nReturns of the training episodes\n{'frames':>8}{SCRATCH:>15}{PRETRAINED:>15}{'left':>20}", flush=True)
        _watch([pool.submit(demo_agents.learn_task, agent) for agent in agents.values()], agents, left)
    random = _random(config)
    _draw(config, agents, random)
    _print_table(config, agents, random, time.time() - began)
    return {name: float(np.mean(demo_agents.episodes(agent.folder))) for name, agent in agents.items()}


def _agents(config: DemoConfig) -> dict[str, Agent]:
    source = _pretraining(config).folder / "pretrained.zip" if config.pretrain_frames else SHIPPED
    shared = (env_id(DOMAIN, config.task), config.finetune_frames, config.seed, config.preset)
    return {
        SCRATCH: Agent(config.out / "scratch", *shared, None, config.episodes),
        PRETRAINED: Agent(config.out / "pretrained", *shared, source, config.episodes),
    }


def _pretraining(config: DemoConfig) -> Agent:
    task = env_id(DOMAIN, PRIMAL_TASK[DOMAIN])
    return Agent(config.out / "exploration", task, config.pretrain_frames, config.seed, config.preset)


def _forget(folder: Path) -> None:
    """What a demonstration before this one left."""
    for path in folder.glob("*"):
        path.unlink()


def _at_once() -> int:
    """One process a core that this process may use, at most one an agent."""
    return min(2, len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1)


# -- how long --------------------------------------------------------------------------------------------------------------


def fitted(config: DemoConfig, limit: float = LIMIT) -> tuple[DemoConfig, pace.Left]:
    """Say how long it will take on this machine; on a slow one take fewer frames, and say that, too.

    :param config: numbers that are not the defaults are somebody's wish, and stay
    :param limit: seconds
    :return: what to do, and what tells while it is done how long it will still take
    """
    env = demo_agents.make_env(env_id(DOMAIN, config.task))
    model = DreamerV2("MlpPolicy", env, preset=config.preset, planner="dyna_mpc", seed=config.seed, device="cpu")
    its_pace = pace.measure(model, env.venv.envs[0], config.episodes)  # type: ignore[attr-defined]
    env.close()
    changeable = config.finetune_frames == DemoConfig.finetune_frames

    def at(share: float) -> DemoConfig:
        return (
            dataclasses.replace(config, finetune_frames=1000 * round(share * config.finetune_frames / 1000))
            if changeable
            else config
        )

    episode = EPISODE // model.action_repeat
    steps = config.episodes * episode
    # Evaluations play all their episodes at once.
    played = pace.Amount(2 * steps + demo_agents.FILM_STEPS, 0, 0).seconds(its_pace) + episode * its_pace.plan
    random = steps * its_pace.step

    def learning(frames: int) -> float:
        return pace.phase(model, frames, False).seconds(its_pace)

    def seconds(share: float) -> float:
        both = (learning(at(share).finetune_frames) + played) * (BESIDE if _at_once() > 1 else 2)
        return learning(config.pretrain_frames) + both + random

    share = pace.shrink(seconds, limit, LEAST)
    chosen = at(share)
    print(f"An update takes {its_pace.update:.2f} s here; agents learn {'beside' if _at_once() > 1 else 'after'} each other.")
    if chosen != config:
        print(
            f"All of it would take {pace.in_words(seconds(1.0))}: on this machine {chosen.finetune_frames} frames in place of "
            f"{config.finetune_frames}. Give --finetune-frames yourself for the whole."
        )
    print(
        f"Learning and playing will take {pace.in_words(seconds(share))}; starting the agents and drawing come on top.",
        flush=True,
    )
    if not pace.phase(model, chosen.finetune_frames, False).updates:
        print(
            f"So few frames hold no update: agents learn from frame {model.learning_starts * model.action_repeat} on.",
            flush=True,
        )
    return chosen, pace.Left(learning, played + random, chosen.finetune_frames)


# -- while it works --------------------------------------------------------------------------------------------------------


def _pretrain(config: DemoConfig, pool: ProcessPoolExecutor) -> None:
    agent = _pretraining(config)
    _forget(agent.folder)
    print(f"LBS explores the {DOMAIN} for {agent.frames} frames, without any reward.", flush=True)
    work = pool.submit(demo_agents.explore, agent)
    told = 0
    while not work.done():
        done = 10 * len(demo_agents.episodes(agent.folder)) * EPISODE // agent.frames
        if done > told:
            print(f"  {10 * done} %", flush=True)
            told = done
        time.sleep(LOOK)
    work.result()


def _watch(work: Sequence[Future[Path]], agents: Mapping[str, Agent], left: pace.Left) -> None:
    """Print what the agents get while they learn, a line when both have come so far, and how long it will still take.

    :raises Exception: what an agent died of
    """
    told = 0
    while True:
        over = all(each.done() for each in work)
        for each in work:
            if each.done():
                each.result()
        returns = [demo_agents.episodes(agent.folder) for agent in agents.values()]
        played = min(map(len, returns))
        for at in range(told, played):
            seconds = left.seconds(played * EPISODE, time.monotonic()) if at + 1 == played and not over else None
            words = "" if seconds is None else f"{pace.in_words(seconds):>20}"
            print(f"{(at + 1) * EPISODE:>8}" + "".join(f"{each[at]:>15.0f}" for each in returns) + words, flush=True)
        told = played
        if over:
            return
        time.sleep(LOOK)


# -- what came of it -------------------------------------------------------------------------------------------------------


def _random(config: DemoConfig) -> list[float]:
    env = demo_agents.make_env(env_id(DOMAIN, config.task)).venv.envs[0]  # type: ignore[attr-defined]
    returns = evaluate(RandomPolicy(env.action_space, config.seed), env, config.episodes)
    env.close()
    return returns


def _draw(config: DemoConfig, agents: Mapping[str, Agent], random: Sequence[float]) -> None:
    returns = {name: demo_agents.episodes(agent.folder) for name, agent in agents.items()}
    caption = f"{DOMAIN} {config.task} from states, seed {config.seed}"
    curves(returns, EPISODE, float(np.mean(random)), caption, config.out / "learning_curves.png")
    films = {name: agent.folder / "film.npy" for name, agent in agents.items()}
    if all(path.exists() for path in films.values()):
        film({name: np.load(path) for name, path in films.items()}, config.out / "agents.gif")
        for path in films.values():
            path.unlink()
    compare_runs({name: [agent.folder] for name, agent in agents.items()}, config.out / "compare.html")


def _scores(agent: Agent) -> dict[str, Row]:
    """By planner."""
    return {row.planner: row for row in read_rows(agent.folder / "rows.csv").rows}


def _print_table(config: DemoConfig, agents: Mapping[str, Agent], random: Sequence[float], seconds: float) -> None:
    print(f"\n{DOMAIN} {config.task}, seed {config.seed}, {config.finetune_frames} frames: mean returns")
    print(f"{'':<34}{SCRATCH:>15}{PRETRAINED:>15}")
    means = [np.mean(demo_agents.episodes(agent.folder)) for agent in agents.values()]
    print(f"{'while learning':<34}" + "".join(f"{mean:>15.0f}" for mean in means))
    played = counted(config.episodes, "episode")
    for planner, label in (("none", "actor"), ("dyna_mpc", "Dyna-MPC")):
        rows = [_scores(agent)[planner] for agent in agents.values()]
        cells = "".join(f"{mean_and_spread(row.return_mean, row.return_std, row.episodes):>15}" for row in rows)
        print(f"{f'after learning, {played}, {label}':<34}{cells}")
    print(f"{'random actions':<34}{np.mean(random):>15.0f}")
    print("One seed of each proves nothing: docs/results.md has them all, with intervals.")
    print(f"{seconds / 60:.1f} minutes. Written to {config.out}/:")
    for path in sorted(config.out.iterdir()):
        print(f"  {path.name}{'/' if path.is_dir() else ''}")
