"""Seconds per action, with and without the planner, paper size unless told otherwise: ``python benchmarks/planner.py``."""

from __future__ import annotations

import numpy as np
from common import make_model, parser, report, seconds


def main() -> None:
    """Time ``predict`` on one and on ten environments, with Dyna-MPC and with the actor, interleaved."""
    options = parser(__doc__).parse_args()
    model = make_model(options, planner="dyna_mpc", learning_starts=0, planner_delay=0)
    images = np.random.default_rng(0).integers(0, 256, (10, 64, 64, 3), np.uint8)
    rows: dict[str, list[float]] = {}
    for _ in range(options.repeat):
        for planner, name in ((True, "Dyna-MPC"), (False, "actor")):
            for n in (1, 10):
                model.planner = "dyna_mpc" if planner else None
                work = lambda n=n: model.predict(images[:n])  # noqa: E731
                rows.setdefault(f"{name}, {n} environment{'s' * (n > 1)}", []).extend(seconds(work, 1, model.device))
    report("action", rows, options, model.device)


if __name__ == "__main__":
    main()
