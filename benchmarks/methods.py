"""What an update costs with each exploration method, relative to LBS: python benchmarks/methods.py."""

from __future__ import annotations

import statistics
from functools import partial

from common import fill_replay, machine, make_model, parser, seconds, write_json
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb.intrinsic.registry import registered_intrinsic_rewards
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

REFERENCE = "lbs"


@ending_with_its_reader()
def main() -> None:
    """Time a pre-training update of each method; the methods take turns."""
    options = parser(__doc__).parse_args()
    names = [REFERENCE, *sorted(set(registered_intrinsic_rewards()) - {REFERENCE})]
    rows: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(options.repeat):
        for name in names:
            # One model at a time: eight of paper size would not fit into every machine.
            model = make_model(options, intrinsic_reward=name)
            fill_replay(model)
            batch = model.replay_buffer.sample(model.batch_size)
            rows[name] += seconds(partial(model.learner.update, batch), 1, model.device, options.clock)
    median = {name: statistics.median(times) for name, times in rows.items()}
    about = machine(options, get_device(options.device))
    if write_json({"benchmark": "methods", **about, "seconds": rows}, options):
        return
    print(f"methods: {', '.join(f'{key} {value}' for key, value in about.items())}")
    print(f"{'method':<14}{'÷ lbs':>7}{'seconds':>10}")
    for name in sorted(names, key=lambda name: median[name]):
        print(f"{name:<14}{median[name] / median[REFERENCE]:>7.2f}{median[name]:>10.3f}")


if __name__ == "__main__":
    main()
