"""What an update costs with each exploration method, relative to LBS: ``python benchmarks/methods.py``."""

from __future__ import annotations

import json
import statistics

import torch as th
from common import make_model, parser, seconds

from sb3_dreamer_urlb.intrinsic import registered_intrinsic_rewards

REFERENCE = "lbs"


def main() -> None:
    """Time a pre-training update of each method; the methods take turns."""
    options = parser(__doc__).parse_args()
    names = [REFERENCE, *sorted(set(registered_intrinsic_rewards()) - {REFERENCE})]
    rows: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(options.repeat):
        for name in names:
            # One model at a time: eight of paper size would not fit into every machine.
            model = make_model(options, intrinsic_reward=name)
            model.learn(max(2 * model.batch_length, 200))
            batch = model.replay_buffer.sample(model.batch_size)
            rows[name] += seconds(lambda model=model, batch=batch: model.learner.update(batch), 1, model.device, options.clock)
    median = {name: statistics.median(times) for name, times in rows.items()}
    if options.json:
        print(json.dumps({"benchmark": "methods", "preset": options.preset, "threads": th.get_num_threads(), "seconds": rows}))
        return
    print(f"{options.preset}, {th.get_num_threads()} threads, torch {th.__version__}")
    print(f"{'method':<14}{'÷ lbs':>7}{'seconds':>10}")
    for name in sorted(names, key=lambda name: median[name]):
        print(f"{name:<14}{median[name] / median[REFERENCE]:>7.2f}{median[name]:>10.3f}")


if __name__ == "__main__":
    main()
