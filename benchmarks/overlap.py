"""What stepping and rendering during the update saves: python benchmarks/overlap.py --preset small --threads 1.

One environment in a process of its own; the two loops take turns in one run, so both do the same work. Beside the measured
ratio stands the one that follows from the parts where each process has a core for itself: with --clock cpu, parts are
CPU times, which other programs on the machine change little.
"""

from __future__ import annotations

import argparse
import functools
import json
import statistics
import time

import gymnasium
import numpy as np
import torch as th
from common import machine, parser, seconds
from stable_baselines3.common.vec_env import SubprocVecEnv

import sb3_dreamer_urlb  # noqa: F401  registers the environments
from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

WARM_UP = 80
PLAIN, OVERLAPPED, UPDATE, ACTION, STEP = "taking turns", "overlapped", "an update", "an action", "a step"


@ending_with_its_reader()
def main() -> None:
    """Time both loops by the wall clock, and their parts by the clock asked for."""
    options = parser(__doc__)
    options.add_argument("--env", default="urlb/walker-run-v0")
    options.add_argument("--train-freq", type=int, default=5)
    options.add_argument("--rollouts", type=int, default=4, help="of each turn (default: 4)")
    options = options.parse_args()
    if options.threads:
        th.set_num_threads(options.threads)
    make_env = functools.partial(gymnasium.make, options.env)
    env = SubprocVecEnv([make_env], start_method="forkserver")
    model = DreamerV2(
        "CnnPolicy", env, preset=options.preset, device=options.device, seed=0, intrinsic_reward="lbs",
        train_freq=options.train_freq, learning_starts=WARM_UP - options.train_freq, batch_length=50,
        replay_buffer_kwargs={"max_episode_rows": WARM_UP // 2 + 20},
    )  # fmt: skip
    model.learn(WARM_UP + options.train_freq)
    rows: dict[str, list[float]] = {PLAIN: [], OVERLAPPED: []}
    for turn in range(options.repeat):
        # Each goes first as often as the other.
        for name in (PLAIN, OVERLAPPED) if turn % 2 else (OVERLAPPED, PLAIN):
            model.overlap = name == OVERLAPPED
            begin = time.perf_counter()
            model.learn(options.rollouts * options.train_freq, reset_num_timesteps=False)
            rows[name].append((time.perf_counter() - begin) / options.rollouts)
    env.close()
    rows |= parts(model, make_env(), options)
    update, action, step = (min(rows[name]) for name in (UPDATE, ACTION, STEP))
    whole = update + options.train_freq * (action + step)
    pairs = [mine / its for mine, its in zip(rows[OVERLAPPED], rows[PLAIN], strict=True)]
    ratios = {
        "best": min(rows[OVERLAPPED]) / min(rows[PLAIN]),
        "median of pairs": statistics.median(pairs),
        "from the parts": 1 - min(update, step) / whole,
    }
    about = {**machine(options, model.device), "env": options.env, "train_freq": options.train_freq}
    if options.json:
        print(json.dumps({"benchmark": "overlap", **about, "ratios": ratios, "seconds": rows}))
        return
    print(f"overlap: {', '.join(f'{key} {value}' for key, value in about.items())}")
    print(f"  a rollout, overlapped ÷ taking turns: {', '.join(f'{name} {ratio:.2f}' for name, ratio in ratios.items())}")
    for name, times in rows.items():
        print(f"  {name:<13} {min(times):8.4f} s, median {statistics.median(times):.4f} of {len(times)}")


def parts(model: DreamerV2, env: gymnasium.Env, options: argparse.Namespace) -> dict[str, list[float]]:
    """An update, an action and a step by themselves, all in this process."""
    device, clock, repeat = model.device, options.clock, options.repeat
    batch = model.replay_buffer.sample(model.batch_size)
    image, _ = env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    found = {
        UPDATE: seconds(lambda: model.learner.update(batch), repeat, device, clock),
        ACTION: seconds(lambda: model.predict(image[None]), 5 * repeat, device, clock),
        STEP: seconds(lambda: env.step(action), 5 * repeat, device, clock),
    }
    env.close()
    return found


if __name__ == "__main__":
    main()
