"""All rows of a GPU in one table: python benchmarks/gpu.py, under 9 minutes, no network; paper size unless told otherwise.

Updates and planned actions with CUDA graphs against this package's own eager mode, whether both do the same, peak memory of
pre-training and fine-tuning, and both phases measured whole on a task of the benchmark. --device cpu --preset tiny runs
every line of this script; its numbers mean nothing then.
"""

from __future__ import annotations

import argparse
import functools
import gc
import json
import math
import statistics
import time
import traceback
import warnings
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import gymnasium
import numpy as np
import torch as th
from common import NoiseImages, machine

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.learning.graphs import WARM_UPS
from sb3_dreamer_urlb.learning.learner import Learner
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.types import SequenceBatch

MODES = {"eager": "eager", "graphs": "cuda_graphs"}
PHASES = {"pre-training (LBS)": "lbs", "fine-tuning": None}
PRETRAINING_FRAMES, FINETUNING_FRAMES = 2_000_000, 100_000


@dataclass
class Row:
    """A line of the table.

    :param name: what was measured
    :param value: in ``unit``
    :param unit: s, frames/s, GB, …
    :param ratio: to what ``compared`` says, None without
    :param compared: what with
    :param target: bound of the value, or of the ratio; in words
    :param met: whether it was kept; None where there is none
    """

    name: str
    value: float
    unit: str
    ratio: float | None = None
    compared: str = ""
    target: str = ""
    met: bool | None = None


class Benchmark:
    """Measures the rows one after the other; one that fails does not end the others.

    :param options: of the command line
    """

    def __init__(self, options: argparse.Namespace):
        self.options = options
        self.device = th.device(options.device)
        self.rows: list[Row] = []
        self.notes: list[str] = []
        self.started = time.perf_counter()

    def run(self) -> None:
        """Everything, the most important first."""
        for precision in self.options.precision:
            for phase in PHASES:
                self._try(self.updates, phase, precision)
            self._try(self.agreement, precision)
            self._try(self.actions, precision)
        for phase in PHASES:
            self._try(self.memory, phase)
        if not self.options.skip_runs:
            self._try(self.whole_runs)

    def _try(self, measure: Callable[..., None], *what: str) -> None:
        used = time.perf_counter() - self.started
        label = " ".join([measure.__name__, *what])
        if used > self.options.budget:
            self.notes.append(f"{label}: left out, {used:.0f} s of {self.options.budget:.0f} s were used")
            return
        try:
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                measure(*what)
            fallbacks = {str(warning.message) for warning in caught if "graphs" in str(warning.message)}
            self.notes += [f"{label}: {message}" for message in sorted(fallbacks)]
        except Exception as error:
            traceback.print_exc()
            self.notes.append(f"{label}: failed, {type(error).__name__}: {str(error).splitlines()[0] if str(error) else ''}")
        gc.collect()  # models hold themselves in circles, and with them their memory
        if self.device.type == "cuda":
            th.cuda.empty_cache()

    # -- models and times --------------------------------------------------------------------------------------------------

    def model(self, compile: str, precision: str, **kwargs: object) -> DreamerV2:
        """A model on images of noise."""
        options = {"preset": self.options.preset, "device": self.device, "seed": 0}
        return DreamerV2("CnnPolicy", NoiseImages(), compile=compile, precision=precision, **options, **kwargs)

    def learner(self, compile: str, precision: str, phase: str) -> tuple[Learner, list[SequenceBatch]]:
        """A learner, and three batches of noise."""
        model = self.model(compile, precision, intrinsic_reward=PHASES[phase])
        lead, chance = (model.batch_size, model.batch_length), np.random.default_rng(0)
        is_first = np.zeros(lead, bool)
        is_first[:, 0] = True
        batches = []
        for _ in range(3):
            images = chance.integers(0, 256, (*lead, 3, 64, 64), np.uint8)
            action = chance.uniform(-1, 1, (*lead, 6)).astype(np.float32)
            columns = (images, action, chance.random(lead, np.float32), is_first, np.zeros(lead, bool))
            batches.append(SequenceBatch(*(th.from_numpy(column).to(self.device) for column in columns)))
        return model.learner, batches

    def seconds(self, work: Callable[[], object], repeat: int, warm_ups: int = WARM_UPS + 2) -> list[float]:
        """Time of each repetition, the device's work included."""
        times = []
        for i in range(warm_ups + repeat):
            self.wait()
            begin = time.perf_counter()
            work()
            self.wait()
            times.append(time.perf_counter() - begin)
            # Enough is enough on a slow machine.
            if i > warm_ups and sum(times[warm_ups:]) > self.options.seconds:
                break
        return times[warm_ups:]

    def wait(self) -> None:
        """For the device."""
        if self.device.type == "cuda":
            th.cuda.synchronize(self.device)

    def pair(self, name: str, times: dict[str, list[float]], at_most: float, at_least: float | None = None) -> None:
        """Rows of eager and of graphs."""
        eager, graphs = (statistics.median(times[mode]) for mode in MODES)
        speed_up = eager / graphs
        met = graphs <= at_most and (at_least is None or speed_up >= at_least)
        target = f"≤ {1000 * at_most:g} ms" + ("" if at_least is None else f" and ≥ {at_least:g} × eager")
        self.rows.append(Row(f"{name}, graphs", 1000 * graphs, "ms", speed_up, "times as fast as eager", target, met))
        self.rows.append(Row(f"{name}, eager", 1000 * eager, "ms"))

    # -- what is measured --------------------------------------------------------------------------------------------------

    def updates(self, phase: str, precision: str) -> None:
        """An update, eager and recorded."""
        times = {}
        for mode, compile in MODES.items():
            learner, batches = self.learner(compile, precision, phase)
            times[mode] = self.seconds(functools.partial(learner.update, batches[0]), self.options.repeat)
        self.pair(f"update, {phase}, {precision}", times, 0.020, 15)

    def agreement(self, precision: str) -> None:
        """The same seeds, eager and recorded: losses and weights after some updates."""
        found = []
        for compile in MODES.values():
            learner, batches = self.learner(compile, precision, "pre-training (LBS)")
            th.manual_seed(1)
            metrics = {}
            for i in range(WARM_UPS + 7):
                metrics = learner.update(batches[i % len(batches)])
            weights = th.cat([value.double().flatten().cpu() for value in learner.agent.state_dict().values()])
            found.append((weights, {name: float(value) for name, value in metrics.items()}))
        (eager, losses), (recorded, its) = found
        apart = float((recorded - eager).norm() / eager.norm())
        worst = max(its, key=lambda name: _apart(its[name], losses[name]))
        # Kernels that add in any order differ by rounding, which draws of classes turn into other draws now and then.
        limit = 1e-4 if precision == "float32" else 1e-3
        name = f"{WARM_UPS + 7} updates, graphs and eager, {precision}"
        self.rows.append(Row(f"{name}: weights apart", apart, "‖Δ‖/‖w‖", target=f"≤ {limit:g}", met=apart <= limit))
        differ = _apart(its[worst], losses[worst])
        self.rows.append(
            Row(f"{name}: {worst} apart, the worst metric", differ, "relative", target="≤ 0.1", met=differ <= 0.1)
        )

    def actions(self, precision: str) -> None:
        """A planned action of one and ten environments, and one of the actor alone."""
        images = np.random.default_rng(0).integers(0, 256, (10, 64, 64, 3), np.uint8)
        planning = {"planner": "dyna_mpc", "learning_starts": 0, "planner_delay": 0}
        for name, n, kwargs, at_most in (
            ("planned action, 1 environment", 1, planning, 0.003),
            ("planned action, 10 environments", 10, planning, math.inf),
            ("actor alone, 1 environment", 1, {}, 0.001),
        ):
            times = {}
            for mode, compile in MODES.items():
                model = self.model(compile, precision, **kwargs)
                _, memory = model.predict(images[:n])
                times[mode] = self.seconds(functools.partial(model.predict, images[:n], memory), 5 * self.options.repeat)
            self.pair(f"{name}, {precision}", times, at_most)
            if not math.isfinite(at_most):
                self.rows[-2].target, self.rows[-2].met = "", None

    def memory(self, phase: str) -> None:
        """Peak memory of updates, recorded."""
        if self.device.type != "cuda":
            self.notes.append(f"memory {phase}: only on CUDA")
            return
        th.cuda.reset_peak_memory_stats(self.device)
        learner, batches = self.learner("cuda_graphs", self.options.precision[-1], phase)
        for _ in range(WARM_UPS + 3):
            learner.update(batches[0])
        self.wait()
        for name, peak in (
            ("allocated", th.cuda.max_memory_allocated(self.device)),
            ("reserved", th.cuda.max_memory_reserved(self.device)),
        ):
            self.rows.append(Row(f"peak memory {name}, {phase}, {self.options.precision[-1]}", peak / 1e9, "GB"))

    def whole_runs(self) -> None:
        """Pre-training, then fine-tuning with Dyna-MPC, environment included; frames a second once both have begun."""
        precision = self.options.precision[-1]
        env = self._environment()
        try:
            model = DreamerV2(
                "CnnPolicy", env, compile="auto", precision=precision, preset=self.options.preset, device=self.device, seed=0,
                intrinsic_reward="lbs", planner="dyna_mpc", learning_starts=self.options.starts,
                planner_delay=0, buffer_size=20_000, **json.loads(self.options.kwargs),
            )  # fmt: skip
            repeat = model.action_repeat
            rate = self._frames_a_second(model, repeat)
            hours = PRETRAINING_FRAMES / rate / 3600
            row = Row(f"pre-training, {precision}, environment included", rate, "frames/s", target="≥ 450", met=rate >= 450)
            row.ratio, row.compared = hours, "hours for 2M frames"
            self.rows.append(row)
            model.fine_tune()
            rate = self._frames_a_second(model, repeat)
            minutes = FINETUNING_FRAMES / rate / 60
            row = Row(f"fine-tuning, Dyna-MPC, {precision}, environment included", rate, "frames/s", target="≤ 10 min")
            row.ratio, row.compared, row.met = minutes, "minutes for 100k frames, projected", minutes <= 10
            self.rows.append(row)
        finally:
            env.close()

    def _environment(self) -> gymnasium.Env:
        if self.options.env == "noise":
            return NoiseImages()
        import sb3_dreamer_urlb.envs  # noqa: F401  (registers the tasks)

        return gymnasium.make(self.options.env)

    def _frames_a_second(self, model: DreamerV2, repeat: int) -> float:
        """Sustained: once updates and planner are recorded."""
        # Whole episodes: nothing is learnt from an open one.
        model.learn(self.options.warm_steps, reset_num_timesteps=False)
        self.wait()
        begin, steps = time.perf_counter(), model.phase_timesteps
        while time.perf_counter() - begin < self.options.run_seconds:
            model.learn(self.options.chunk, reset_num_timesteps=False)
        self.wait()
        return repeat * (model.phase_timesteps - steps) / (time.perf_counter() - begin)


def _apart(one: float, other: float) -> float:
    return abs(one - other) / max(abs(other), 1e-2)


def parse(arguments: list[str] | None = None) -> argparse.Namespace:
    """The command line."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--device", default="cuda")
    options.add_argument("--preset", default="paper", help="size of the model (default: paper)")
    options.add_argument("--precision", nargs="+", default=["float32", "bfloat16"], help="formats of products to compare")
    options.add_argument("--repeat", type=int, default=20, help="timed repetitions (default: 20)")
    options.add_argument("--seconds", type=float, default=15, help="that one row's repetitions may take (default: 15)")
    options.add_argument("--budget", type=float, default=420, help="seconds after which no further row begins (default: 420)")
    options.add_argument("--env", default="urlb/walker-run-v0", help="of the whole runs, or 'noise' (default: walker run)")
    options.add_argument("--starts", type=int, default=1100, help="agent steps of the whole runs before the first update")
    options.add_argument("--warm-steps", type=int, default=1200, help="agent steps of each phase that are not timed")
    options.add_argument("--chunk", type=int, default=100, help="agent steps between two looks at the clock")
    options.add_argument("--run-seconds", type=float, default=40, help="that each phase of the whole runs is timed")
    options.add_argument("--kwargs", default="{}", help="further arguments of DreamerV2 for the whole runs, as JSON")
    options.add_argument("--skip-runs", action="store_true", help="leave the whole runs out")
    options.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options.add_argument("--save", help="file for the JSON object, besides what is printed")
    return options.parse_args(arguments)


@ending_with_its_reader()
def main(arguments: list[str] | None = None) -> int:
    """Measure and print; 2 without the device, 1 if a row failed."""
    options = parse(arguments)
    if options.device.startswith("cuda") and not th.cuda.is_available():
        print(
            f"gpu.py needs a CUDA device, and torch {th.__version__} finds none on this machine. "
            "To try the script itself: python benchmarks/gpu.py --device cpu --preset tiny --env noise"
        )
        return 2
    benchmark = Benchmark(options)
    benchmark.run()
    options.clock = "wall"
    about = {**machine(options, benchmark.device), "cuda": th.version.cuda}
    took = time.perf_counter() - benchmark.started
    rows = [asdict(row) for row in benchmark.rows]
    result = json.dumps({"benchmark": "gpu", **about, "took": took, "rows": rows, "notes": benchmark.notes})
    if options.save:
        Path(options.save).write_text(result)
    if options.json:
        print(result)
    else:
        show(benchmark, about, took)
    return int(any(": failed" in note for note in benchmark.notes))


def show(benchmark: Benchmark, about: dict[str, object], took: float) -> None:
    """The table, ratios first."""
    print(f"gpu: {', '.join(f'{key} {value}' for key, value in about.items())}; took {took:.0f} s")
    width = max((len(row.name) for row in benchmark.rows), default=0)
    for row in benchmark.rows:
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        verdict = {None: "", True: "met", False: "NOT met"}[row.met]
        aims = f"  (target {row.target}: {verdict})" if row.target else ""
        print(f"  {ratio:>8}  {row.name:<{width}}  {row.value:12.4g} {row.unit}  {row.compared}{aims}")
    for note in benchmark.notes:
        print(f"  note: {note}")


if __name__ == "__main__":
    raise SystemExit(main())
