"""Is a pre-trained world model ahead of one that has seen only the task's first episodes? Open-loop error on held-out ones.

    python benchmarks/evidence_model.py --seeds 0 1

Only where it is clearly ahead can fine-tuning profit from the model. The held-out episodes are a fresh actor's; a model sees
five observations, then follows the actions with its eyes shut. The error is the root mean square over all numbers of the
state, each in units of its standard deviation in the held-out episodes: 1 is what the mean alone would give. Beside the
pre-trained agents of results/evidence stand agents that learn the task from scratch, after some agent steps of it. Rows go
to results/evidence/open_loop.csv.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import evidence
import evidence_study as study
import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.evaluation.open_loop import predict_open_loop
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

STATES = study.SETTINGS["state"]
#: observations that a model sees; steps that it then predicts
CONTEXT, AHEAD = 5, (1, 5, 15)
EPISODES, STRIDE = 5, 20
#: agent steps of the task after which the agent from scratch is asked
STEPS = (2000, 5000, 10_000)

Episode = tuple[np.ndarray, np.ndarray]


def make_env(task: str, seed: int, snapshot: Path | None = None, training: bool = True) -> VecNormalize:
    """As in ``evidence.py``, from states."""
    env = evidence.make_env(STATES, task, seed, snapshot, training)
    assert isinstance(env, VecNormalize)
    return env


def held_out(task: str, seed: int) -> list[Episode]:
    """States as they are, float (501, N), and actions, float (500, A), of a fresh actor that draws its actions."""
    env = make_env(task, 20_000 + seed)
    actor = DreamerV2("MlpPolicy", env, preset=STATES.preset, seed=20_000 + seed, device="cpu")
    found = []
    for _ in range(EPISODES):
        seen, state, start = env.reset(), None, np.ones(1, bool)
        states, actions = [env.get_original_obs()[0]], []
        while not actions or not start[0]:
            action, state = actor.predict(seen, state, start, deterministic=False)
            seen, _, start, infos = env.step(action)
            last = infos[0].get("terminal_observation")
            states.append(env.get_original_obs()[0] if last is None else env.unnormalize_obs(last))
            actions.append(action[0])
        found.append((np.stack(states), np.stack(actions)))
    return found


def errors(model: DreamerV2, env: VecNormalize, episodes: list[Episode]) -> list[float]:
    """Of the predictions ``AHEAD`` steps after the last observation that the model saw."""
    scale = np.concatenate([states for states, _ in episodes]).std(0).clip(1e-3)
    squares: list[np.ndarray] = []
    th.manual_seed(0)
    for states, actions in episodes:
        seen = th.as_tensor(env.normalize_obs(states), dtype=th.float32)
        for start in range(0, len(actions) - CONTEXT - max(AHEAD), STRIDE):
            _, predicted = predict_open_loop(model.policy, seen, actions, start, CONTEXT, max(AHEAD))
            assert isinstance(predicted, th.Tensor)
            truth = states[start : start + len(predicted)]
            squares.append((((env.unnormalize_obs(predicted.numpy()) - truth) / scale) ** 2).mean(1))
    mean = np.sqrt(np.mean(squares, 0))
    return [float(mean[CONTEXT - 1 + ahead]) for ahead in AHEAD]


def measure(task: str, seed: int) -> list[tuple[str, int, list[float]]]:
    """Name of the agent, agent steps of the task that it has seen, errors."""
    episodes, found = held_out(task, seed), []
    source = study.snapshot_of(study.Run("lbs", "", seed))
    if source.exists():
        env = make_env(task, seed, source, training=False)
        found.append(("lbs", 0, errors(DreamerV2.load(source, env=env, device="cpu"), env, episodes)))
    env = make_env(task, 1000 + seed)
    scratch = DreamerV2("MlpPolicy", env, preset=STATES.preset, seed=seed, device="cpu")
    for steps in STEPS:
        scratch.learn(steps - scratch.num_timesteps, reset_num_timesteps=scratch.num_timesteps == 0)
        found.append(("scratch", steps, errors(scratch, env, episodes)))
    return found


@ending_with_its_reader()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--task", default="run", help="of the walker")
    parser.add_argument("--out", type=Path, default=study.ROOT / "open_loop.csv")
    options = parser.parse_args()
    th.set_num_threads(1)
    print(f"{'seed':>4} {'agent':<8} {'steps of the task':>18}" + "".join(f"{f'{ahead} ahead':>10}" for ahead in AHEAD))
    for seed in options.seeds:
        for name, steps, values in measure(options.task, seed):
            print(f"{seed:>4} {name:<8} {steps:>18}" + "".join(f"{value:>10.3f}" for value in values), flush=True)
            with open(options.out, "a", newline="") as file:
                writer = csv.writer(file)
                if file.tell() == 0:
                    writer.writerow(["task", "seed", "agent", "steps", *(f"ahead_{ahead}" for ahead in AHEAD)])
                writer.writerow([options.task, seed, name, steps, *(f"{value:.4f}" for value in values)])


if __name__ == "__main__":
    main()
