"""From states: how fast are the environments and the updates, and how long is a fine-tuning of 100k frames?

    python benchmarks/states.py --threads 2                                        # rates, and what follows from them
    python benchmarks/states.py --threads 2 --presets state-small --steps 5000     # and a tenth of one, from end to end

Environments: seconds an agent step (two frames), the resets of whole episodes spread over them; the floor is the same task
from states, the physics alone. Agents: an update, and the actor's choice of an action. Projected is a fine-tuning of 50 000
agent steps in the walker, S · (step + action) + U · (sample + update), without a planner; --steps also does one, so long,
and times it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import torch as th
from common import CLOCKS, Floor, interleaved, parser, report, set_threads
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.cli.pace import in_words, phase
from sb3_dreamer_urlb.envs import DOMAINS, PRIMAL_TASK, env_id
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

FRAMES = 100_000  # of a fine-tuning
EPISODES = {"jaco": 125}  # agent steps, else 500


def agent_step(env: gymnasium.Env[Any, Any], seconds: float, episode: int, clock: str) -> float:
    """Of an environment with random actions.

    :param env: to step
    :param seconds: that the window takes, about
    :param episode: agent steps of an episode
    :param clock: of ``CLOCKS``
    :return: seconds of an agent step, the reset spread over a whole episode
    """
    now = CLOCKS[clock]
    begin = now()
    env.reset()
    reset = now() - begin
    env.step(env.action_space.sample())
    steps, begin = 0, now()
    while steps < 3 or (now() - begin < seconds and steps < episode - 2):
        env.step(env.action_space.sample())
        steps += 1
    return reset / episode + (now() - begin) / steps


def make_agent(preset: str, options: argparse.Namespace) -> DreamerV2:
    """That sees the walker's states and fine-tunes."""
    env = gymnasium.make(env_id("walker", "run"), observation="state")
    return DreamerV2("MlpPolicy", env, preset=preset, intrinsic_reward=None, planner=None, device=options.device, seed=0)


def parts(model: DreamerV2) -> dict[str, Callable[[], object]]:
    """What an agent does over and over, by name."""
    seen = np.zeros((1, *(model.observation_space.shape or ())), np.float32)
    policy = model.policy
    first = th.ones(1, dtype=th.bool, device=model.device)
    state = policy.initial_state(1)

    def act() -> None:
        policy.choose(policy.observe(th.as_tensor(seen, device=model.device), state, first), deterministic=False)

    return {
        "update": lambda: model.learner.update(model.replay_buffer.sample(model.batch_size)),  # its batch included
        "action": act,
    }


def fine_tune(preset: str, steps: int, options: argparse.Namespace) -> float:
    """Seconds of the first steps of one: environment, actions, replay and updates."""
    model = make_agent(preset, options)
    began = CLOCKS[options.clock]()
    model.learn(steps)
    return CLOCKS[options.clock]() - began


def project(model: DreamerV2, step: float, seconds: dict[str, float]) -> float:
    """Of a fine-tuning of ``FRAMES``.

    :param model: whose warm-up and frequency of updates count
    :param step: seconds of the environment's
    :param seconds: of the agent's parts
    """
    amount = phase(model, FRAMES, plans=False)
    return amount.steps * (step + seconds["action"]) + amount.updates * seconds["update"]


@ending_with_its_reader()
def main() -> None:
    """Environments of each domain, then each preset."""
    choice = parser(__doc__)
    choice.formatter_class = argparse.RawDescriptionHelpFormatter
    choice.add_argument("--presets", nargs="+", default=["state-small", "state"])
    choice.add_argument("--domains", nargs="+", default=list(DOMAINS), choices=DOMAINS)
    choice.add_argument("--seconds", type=float, default=1.0, help="of an environment's window (default: %(default)s)")
    choice.add_argument(
        "--steps", type=int, default=0, help="agent steps of a fine-tuning that is really done (default: none)"
    )
    options = choice.parse_args()
    if options.quick:
        options.domains, options.presets, options.seconds, options.steps = ["walker"], ["tiny"], 0.0, 20
    options.preset = None
    set_threads(options)
    device = get_device(options.device)
    rows, floors, amounts = environments(options)
    notes = []
    more: dict[str, Any] = {}
    for preset in options.presets:
        model = make_agent(preset, options).learn(2 * 500)  # two episodes to sample from
        its = interleaved(parts(model), options, device)
        rows.update({f"{part}, {preset}": times for part, times in its.items()})
        amounts.update({f"update, {preset}": {"updates": 1.0}, f"action, {preset}": {"actions": 1.0}})
        projected = project(model, min(rows["walker, state"]), {part: min(times) for part, times in its.items()})
        more[preset] = {"projected seconds": projected}
        notes.append(f"{preset}: {FRAMES} frames of fine-tuning take {in_words(projected)} (projected)")
        if options.steps:
            taken = fine_tune(preset, options.steps, options)
            more[preset] |= {"steps": options.steps, "seconds": taken}
            notes.append(f"{preset}: {options.steps} agent steps of it took {taken:.0f} s (measured)")
    report("states", rows, floors, options, device, amounts, notes, fine_tuning=more)


def environments(
    options: argparse.Namespace,
) -> tuple[dict[str, list[float]], dict[str, Floor], dict[str, dict[str, float]]]:
    """Times, floors and amounts of every domain's rows."""
    rows: dict[str, list[float]] = {}
    floors: dict[str, Floor] = {}
    for domain in options.domains:
        episode = EPISODES.get(domain, 500)
        name = env_id(domain, PRIMAL_TASK[domain])
        envs = {f"{domain}, {kind}": gymnasium.make(name, observation=kind) for kind in ("pixels", "state")}
        for turn in range(options.repeat + 1):
            for row, env in envs.items():
                env.action_space.seed(turn)
                found = agent_step(env, options.seconds, episode, options.clock)
                rows.setdefault(row, []).extend([found] if turn else [])
        floors[f"{domain}, pixels"] = Floor(f"{domain}, state", 1)
        for env in envs.values():
            env.close()
    return rows, floors, {name: {"agent steps": 1.0} for name in rows}


if __name__ == "__main__":
    main()
