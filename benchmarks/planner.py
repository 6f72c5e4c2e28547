"""An action against the machine's limit, with and without the planner: python benchmarks/planner.py, paper size.

The floor of a planned action is the time that the authors' arithmetic, 195 GFLOP, takes as big products, in bfloat16 where the
machine multiplies that well; that of ten environments is one environment.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch as th
from common import Floor, Product, interleaved, make_model, parser, report, set_threads
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb.output_reader import ending_with_its_reader

TFLOP = 0.195


@ending_with_its_reader()
def main() -> None:
    """Time ``predict`` on one and on ten environments, with Dyna-MPC in each format and with the actor."""
    options = parser(__doc__).parse_args()
    images = np.random.default_rng(0).integers(0, 256, (10, 64, 64, 3), np.uint8)
    work: dict[str, Callable[[], object]] = {}
    floors = {}
    set_threads(options)
    big = Product(th.bfloat16, get_device(options.device))
    for precision, compile in product(options.precision, options.compile):
        model = make_model(
            options, precision=precision, planner="dyna_mpc", learning_starts=0, planner_delay=0, compile=compile
        )
        kind = ", ".join([precision, *([compile] if len(options.compile) > 1 else [])])
        one, ten = (f"Dyna-MPC, {environments}, {kind}" for environments in ("1 environment", "10 environments"))
        work[one] = partial(model.predict, images[:1])
        work[ten] = partial(model.predict, images)
        if options.preset == "paper":
            floors[one] = Floor(big.name, TFLOP / Product.TFLOP, 1.0)
        floors[ten] = Floor(one, 1.0, 8.0)
    work[big.name] = big
    actor = make_model(options)
    work["actor, 1 environment"] = lambda: actor.predict(images[:1])
    work["actor, 10 environments"] = lambda: actor.predict(images)
    report("action", interleaved(work, options, model.device), floors, options, model.device)


if __name__ == "__main__":
    main()
