"""An update against the machine's limit: python benchmarks/update.py, paper size unless told otherwise (50×50, H = 15).

The floor is the time that the authors' arithmetic of an update, 2.4 TFLOP, takes as big matrix products in the same
format, or in float32 where the machine multiplies only that well.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product
from typing import Any

import torch as th
from common import Floor, Product, fill_replay, interleaved, make_model, parser, report

from sb3_dreamer_urlb.learning.learner import Learner
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.types import SequenceBatch

TFLOP = 2.4
TARGETS = {"float32": 1.0, "bfloat16": 2.0}


def parts(learner: Learner, batch: SequenceBatch) -> dict[str, Callable[[], object]]:
    """The two halves of an update by name."""

    def world_model() -> None:
        model = learner.agent.world_model
        image = model.preprocess(batch.observation)
        with learner._products():
            posterior = model.observe(image, batch.action, batch.is_first)
        learner._update_world_model(posterior, image, batch)

    with th.no_grad():
        model = learner.agent.world_model
        state = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first).state
    return {"world model": world_model, "behaviour": lambda: learner._update_behavior(state)}


@ending_with_its_reader()
def main() -> None:
    """Time a pre-training update (LBS) and a fine-tuning update in each format."""
    choice = parser(__doc__)
    choice.add_argument("--phases", nargs="+", default=["pre-training (LBS)", "fine-tuning"], choices=PHASES)
    choice.add_argument("--parts", action="store_true", help="time the world model's and the behaviour's half, too")
    options = choice.parse_args()
    work: dict[str, Callable[[], object]] = {}
    floors = {}
    for precision, compile in product(options.precision, options.compile):
        for phase in options.phases:
            model = make_model(options, precision=precision, compile=compile, **PHASES[phase])
            fill_replay(model)
            learner, batch = model.learner, model.replay_buffer.sample(model.batch_size)
            row = ", ".join([phase, precision, *([compile] if len(options.compile) > 1 else [])])
            work[row] = partial(learner.update, batch)
            if options.parts:
                work.update({f"{row}, {part}": half for part, half in parts(learner, batch).items()})
            big = Product(learner.dtype, model.device)
            work.setdefault(big.name, big)
            if options.preset == "paper":
                floors[row] = Floor(big.name, TFLOP / Product.TFLOP, TARGETS.get(precision))
    report("update", interleaved(work, options, model.device), floors, options, model.device)


PHASES: dict[str, dict[str, Any]] = {
    "pre-training (LBS)": {"intrinsic_reward": "lbs"},
    "fine-tuning": {},
    # Its planner asks no critic, so neither actor nor critic learns.
    "fine-tuning for MPPI": {"planner": "mppi"},
}

if __name__ == "__main__":
    main()
