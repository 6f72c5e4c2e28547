"""How cost grows with batch size, imagination horizon, planner samples and environments: python benchmarks/curves.py.

Networks of paper size. One thing changes at a time; the points of all curves take turns. The floor of a point is the time
that its own arithmetic (matrix products and convolutions, as torch counts them) takes as big products in the same format.
With --picture FILE the curves are drawn.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from common import Floor, Product, fill_replay, interleaved, make_model, parser, report, tflop

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.learning.learner import Learner
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

#: curve → its points
POINTS: dict[str, list[int]] = {
    "sequences a batch": [2, 5, 10, 20, 35, 50],
    "imagination horizon": [5, 10, 15, 20, 30],
    "planner samples": [64, 128, 256, 512, 1024, 2048],
    "environments, planner": [1, 2, 4, 7, 10],
    "environments, actor": [1, 2, 4, 7, 10],
}
QUICK = {"planner samples": [16, 32]}
#: sequences where the batch is not what changes: a full sweep at 50 would take an hour on two cores
BATCH = 10
PAPER = {"sequences a batch": 50, "imagination horizon": 15, "planner samples": 512}
MARKED = "tab:red"


class Curves:
    """What each point runs.

    :param options: of the command line
    """

    def __init__(self, options: argparse.Namespace):
        self.precision = options.precision[0]
        self.batch = 2 if options.quick else BATCH
        self.explorer = make_model(options, precision=self.precision, intrinsic_reward="lbs")
        fill_replay(self.explorer)
        self.planner = self._planning(options)
        # Points replace the policy's.
        self.own_planner: Any = self.planner.policy.planner
        self.images = np.random.default_rng(0).integers(0, 256, (max(POINTS["environments, actor"]), 64, 64, 3), np.uint8)

    def _planning(self, options: argparse.Namespace) -> DreamerV2:
        kwargs = {"planner": "dyna_mpc", "learning_starts": 0, "planner_delay": 0}
        return make_model(options, precision=self.precision, **kwargs)

    def work(self, curve: str, point: int) -> Callable[[], object]:
        """A function that does what one point stands for."""
        makers: dict[str, Callable[[], Callable[[], object]]] = {
            "sequences a batch": lambda: self._update(self.explorer.learner, point),
            "imagination horizon": lambda: self._update(self._with_horizon(point), self.batch),
            "planner samples": lambda: self._plan(1, n_samples=point),
            "environments, planner": lambda: self._plan(point),
            "environments, actor": lambda: partial(self.explorer.predict, self.images[:point]),
        }
        return makers[curve]()

    def dtype(self, curve: str) -> th.dtype:
        """The format of a curve's products."""
        if curve in ("sequences a batch", "imagination horizon"):
            return self.explorer.learner.dtype
        return self.planner.policy.planner_dtype if curve != "environments, actor" else th.float32

    def _with_horizon(self, horizon: int) -> Learner:
        learner = self.explorer.learner
        return Learner(learner.agent, dataclasses.replace(learner.config, imagination_horizon=horizon))

    def _update(self, learner: Learner, sequences: int) -> Callable[[], object]:
        batch = self.explorer.replay_buffer.sample(sequences)
        return lambda: learner.update(batch)

    def _plan(self, environments: int, **changes: Any) -> Callable[[], object]:
        policy, own = self.planner.policy, self.own_planner
        changed = type(own)(dataclasses.replace(own.config, **changes), own.gae_lambda)

        def plan() -> None:
            policy._planner = changed
            self.planner.predict(self.images[:environments])

        return plan


def draw(times: dict[str, dict[int, float]], floors: dict[str, dict[int, float]], unit: str, path: Path) -> None:
    """A panel a curve: measured, floor, and the paper's point.

    :param times: curve → point → seconds
    :param floors: likewise
    :param unit: of the times, for the axis
    :param path: of the picture
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(1, len(times), figsize=(3.1 * len(times), 2.9), layout="constrained", squeeze=False)
    for axes, (curve, points) in zip(panels[0], times.items(), strict=True):
        axes.plot(list(points), list(points.values()), marker="o", markersize=4, label="measured")
        if any(floors[curve].values()):
            axes.plot(list(floors[curve]), list(floors[curve].values()), color="grey", linestyle=":", label="its arithmetic")
        if PAPER.get(curve) in points:
            axes.axvline(PAPER[curve], color=MARKED, linewidth=0.8, alpha=0.6, label="paper")
        axes.set(xlabel=curve, xlim=(0, None), ylim=(0, None))
        axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel(unit)
    panels[0, 0].legend(fontsize=8)
    figure.savefig(path, dpi=80)


@ending_with_its_reader()
def main() -> None:
    """Measure all points in turns."""
    choice = parser(__doc__)
    choice.set_defaults(precision=["auto"])
    choice.add_argument("--curves", nargs="+", default=list(POINTS), choices=POINTS)
    choice.add_argument("--picture", type=Path, metavar="FILE", help="draw the curves there; needs matplotlib")
    options = choice.parse_args()
    chosen = {name: QUICK.get(name, [1, 2]) if options.quick else POINTS[name] for name in options.curves}
    if options.quick and "imagination horizon" in chosen:
        chosen["imagination horizon"] = [2, 3]
    curves = Curves(options)
    device = curves.explorer.device
    work: dict[str, Callable[[], object]] = {}
    counted, floors = {}, {}
    for curve, points in chosen.items():
        product = Product(curves.dtype(curve), device)
        work.setdefault(product.name, product)
        for point in points:
            row = f"{curve}: {point}"
            work[row] = curves.work(curve, point)
            counted[row] = tflop(work[row])
            if counted[row]:
                floors[row] = Floor(product.name, counted[row] / Product.TFLOP)
    times = interleaved(work, options, device)
    notes = [f"Updates of the imagination horizon's curve have {curves.batch} sequences a batch."]
    report("curves", times, floors, options, device, notes=notes, tflop=counted)
    if options.picture:
        best = {curve: {point: min(times[f"{curve}: {point}"]) for point in points} for curve, points in chosen.items()}
        least = {
            curve: {
                point: floors[row].factor * min(times[floors[row].row]) if (row := f"{curve}: {point}") in floors else 0.0
                for point in points
            }
            for curve, points in chosen.items()
        }
        draw(best, least, "CPU seconds" if options.clock == "cpu" else "seconds", options.picture)


if __name__ == "__main__":
    main()
