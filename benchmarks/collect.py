"""Environment frames a second, by domain, rendering backend and kind of VecEnv: python benchmarks/collect.py.

The floor is dm_control alone, without this package, Gymnasium or Stable-Baselines3: one environment, two control steps and
one picture of 64×64 a loop. Rows are seconds a frame of *all* environments, so two processes that do not wait for each
other have a ratio of 0.5. Each figure stands for whole episodes: steps of a short window, and the reset spread over them.

Each backend has a server process of its own, because dm_control binds itself to one; they take turns. Wall time, for the
work is done in other processes.
"""

from __future__ import annotations

import argparse
import functools
import multiprocessing
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from common import Floor, parser, report

from sb3_dreamer_urlb.envs import DOMAINS, PRIMAL_TASK, make_control_env, make_urlb_env
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

if TYPE_CHECKING:
    from multiprocessing.connection import Connection

REPEAT, SIZE = 2, 64  # control steps an agent step, pixels
BARE = "dm_control alone"
#: dm_control's, without a display
BACKENDS = ("egl", "osmesa")


class BareLoop:
    """dm_control without anything around it.

    :param domain: its task to pre-train on is taken
    """

    num_envs = 1

    def __init__(self, domain: str):
        self.env = make_control_env(domain, PRIMAL_TASK[domain])
        self.camera = 2 if domain == "quadruped" else 0
        spec = self.env.action_spec()
        self.low, self.high = np.maximum(spec.minimum, -1), np.minimum(spec.maximum, 1)
        self.rng = np.random.default_rng(0)

    def reset(self) -> None:
        """Begin an episode."""
        self.env.reset()
        self._draw()

    def step(self) -> None:
        """One agent step."""
        action = self.rng.uniform(self.low, self.high)
        for _ in range(REPEAT):
            self.env.step(action)
        self._draw()

    def _draw(self) -> None:
        np.ascontiguousarray(self.env.physics.render(SIZE, SIZE, camera_id=self.camera))

    def close(self) -> None:
        """Free it."""
        self.env.close()


class VecLoop:
    """A VecEnv of the benchmark's environments with random actions.

    :param kind: key of ``kinds``
    :param domain: its task to pre-train on is taken
    :param n: number of environments
    """

    def __init__(self, kind: str, domain: str, n: int):
        make = functools.partial(make_urlb_env, domain, PRIMAL_TASK[domain], image_size=SIZE, action_repeat=REPEAT)
        self.num_envs = n
        self.env = kinds()[kind]([make] * n)
        self.env.action_space.seed(0)

    def reset(self) -> None:
        """Begin an episode everywhere."""
        self.env.reset()

    def step(self) -> None:
        """One agent step everywhere."""
        self.env.step(np.stack([self.env.action_space.sample() for _ in range(self.num_envs)]))

    def close(self) -> None:
        """End the processes."""
        self.env.close()


KINDS = ("DummyVecEnv", "SubprocVecEnv", "SupervisedVecEnv")


def kinds() -> dict[str, Callable[[list[Callable[[], Any]]], Any]]:
    """Name → maker of a VecEnv."""
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

    from sb3_dreamer_urlb.envs import SupervisedVecEnv

    forkserver = functools.partial(SubprocVecEnv, start_method="forkserver")
    return dict(zip(KINDS, (DummyVecEnv, forkserver, SupervisedVecEnv), strict=True))


def measure(loop: BareLoop | VecLoop, seconds: float, episode: int) -> float:
    """One window.

    :param loop: to run
    :param seconds: that the steps take, about
    :param episode: agent steps of an episode
    :return: seconds a frame over a whole episode
    """
    begin = time.perf_counter()
    loop.reset()
    reset = time.perf_counter() - begin
    loop.step()
    steps, begin = 0, time.perf_counter()
    while steps < 3 or (time.perf_counter() - begin < seconds and steps < episode - 2):
        loop.step()
        steps += 1
    step = (time.perf_counter() - begin) / steps
    return (reset + episode * step) / (loop.num_envs * episode * REPEAT)


def serve(connection: Connection) -> None:
    """A backend's process: answers calls, given as (name, arguments), with (whether it went well, result or error)."""
    th.set_num_threads(1)
    loops: dict[str, BareLoop | VecLoop] = {}

    def open_loop(row: str, kind: str, domain: str, n: int) -> None:
        loops[row] = BareLoop(domain) if kind == BARE else VecLoop(kind, domain, n)

    def measure_loop(row: str, seconds: float, episode: int) -> float:
        return measure(loops[row], seconds, episode)

    def close_loop(row: str) -> None:
        loops.pop(row).close()

    calls: dict[str, Callable[..., Any]] = {"open": open_loop, "measure": measure_loop, "close": close_loop}
    while (call := connection.recv()) is not None:
        name, *arguments = call
        try:
            connection.send((True, calls[name](*arguments)))
        except Exception as error:
            connection.send((False, f"{type(error).__name__}: {error}"))


class Backend:
    """A backend's process as the benchmark sees it.

    :param name: value of MUJOCO_GL
    """

    def __init__(self, name: str):
        self.name = name
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        before = os.environ.get("MUJOCO_GL")
        os.environ["MUJOCO_GL"] = name
        try:
            self.process = context.Process(target=serve, args=(theirs,))
            self.process.start()
        finally:
            os.environ.pop("MUJOCO_GL")
            os.environ.update({} if before is None else {"MUJOCO_GL": before})
        theirs.close()

    def __call__(self, name: str, *arguments: object) -> Any:
        """Ask.

        :raises RuntimeError: with the process's own error
        """
        self.connection.send((name, *arguments))
        well, answer = self.connection.recv()
        if not well:
            raise RuntimeError(answer)
        return answer

    def close(self) -> None:
        """End it."""
        self.connection.send(None)
        self.process.join()


@dataclass(frozen=True)
class Row:
    """What a row is, by its name."""

    backend: Backend
    kind: str
    domain: str
    n: int

    def __str__(self) -> str:
        return f"{self.domain}, {self.backend.name}, {BARE if self.kind == BARE else f'{self.n} in {self.kind}'}"


def working(names: list[str], domain: str) -> tuple[list[Backend], list[str]]:
    """Those that can draw here, and why others cannot."""
    backends, missing = [], []
    for name in names:
        backend = Backend(name)
        try:
            backend("open", "try", BARE, domain, 1)
            backend("measure", "try", 0.0, 3)
            backend("close", "try")
            backends.append(backend)
        except (RuntimeError, EOFError) as error:
            missing.append(f"{name} cannot draw here: {error}")
            backend.close()
    return backends, missing


def sweep(rows: list[Row], options: argparse.Namespace, episode: int) -> dict[str, list[float]]:
    """Seconds a frame of some rows that take turns."""
    times: dict[str, list[float]] = {str(row): [] for row in rows}
    for row in rows:
        row.backend("open", str(row), row.kind, row.domain, row.n)
    for turn in range(options.repeat + 1):
        for row in rows:
            found = row.backend("measure", str(row), options.seconds, episode)
            times[str(row)] += [found] if turn else []
    for row in rows:
        row.backend("close", str(row))
    return times


def draw(times: dict[str, list[float]], path: Path) -> None:
    """Frames a second over the number of environments, a panel a domain.

    :param times: rows of the table
    :param path: of the picture
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    # domain → (backend, kind) → n → frames a second
    found: dict[str, dict[tuple[str, str], dict[int, float]]] = {}
    for row, seconds in times.items():
        domain, backend, what = row.split(", ")
        n, kind = (1, BARE) if what == BARE else (int(what.split()[0]), what.split()[-1])
        found.setdefault(domain, {}).setdefault((backend, kind), {})[n] = 1 / min(seconds)
    figure, panels = pyplot.subplots(1, len(found), figsize=(3.4 * len(found), 3), layout="constrained", squeeze=False)
    colours = dict(zip((*KINDS, BARE), ("tab:blue", "tab:orange", "tab:green", "grey"), strict=True))
    styles = dict(zip(BACKENDS, ("-", "--"), strict=True))
    for axes, (domain, lines) in zip(panels[0], found.items(), strict=True):
        for (backend, kind), points in lines.items():
            style = {"color": colours[kind], "linestyle": styles.get(backend, ":")}
            if kind == BARE:
                axes.axhline(points[1], linewidth=0.8, label=f"{kind}, {backend}", **style)
            else:
                axes.plot(sorted(points), [points[n] for n in sorted(points)], marker="o", label=f"{kind}, {backend}", **style)
        axes.set(title=domain, xlabel="environments", ylim=(0, None), xticks=range(1, 1 + max(map(max, lines.values()))))
        axes.grid(alpha=0.3)
    panels[0, 0].set_ylabel("frames a second")
    panels[0, -1].legend(fontsize=6)
    figure.savefig(path, dpi=80)


@ending_with_its_reader()
def main() -> None:
    """Sweep over domains and numbers of environments; backends and kinds take turns."""
    choice = parser(__doc__)
    choice.add_argument("--domains", nargs="+", default=list(DOMAINS), choices=DOMAINS)
    choice.add_argument("--backends", nargs="+", default=list(BACKENDS), help=f"default: {' '.join(BACKENDS)}")
    choice.add_argument("--environments", nargs="+", type=int, default=[1, 2, 3, 4])
    choice.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    choice.add_argument("--seconds", type=float, default=0.4, help="of a window (default: 0.4)")
    choice.add_argument("--picture", type=Path, metavar="FILE", help="draw the rates there; needs matplotlib")
    options = choice.parse_args()
    if options.quick:
        options.domains, options.environments, options.seconds = options.domains[:1], options.environments[:1], 0.0
    options.clock, options.preset = "wall", None
    backends, missing = working(options.backends, options.domains[0])
    times: dict[str, list[float]] = {}
    floors = {}
    try:
        for domain in options.domains:
            episode = {"jaco": 125}.get(domain, 500)
            for n in options.environments:
                bare = [Row(backend, BARE, domain, 1) for backend in backends]
                vectorised = [Row(backend, kind, domain, n) for kind in options.kinds for backend in backends]
                for name, found in sweep(bare + vectorised, options, episode).items():
                    times.setdefault(name, []).extend(found)
                floors.update({str(row): Floor(str(Row(row.backend, BARE, domain, 1)), 1) for row in vectorised})
    finally:
        for backend in backends:
            backend.close()
    if not times:
        raise SystemExit("\n".join(missing))
    rendering = {name: os.environ.get(name) for name in ("LP_NUM_THREADS", "OMP_NUM_THREADS")}
    amounts = {row: {"frames": 1.0} for row in times}
    report("collect", times, floors, options, th.device("cpu"), amounts, missing, **rendering)
    if options.picture:
        draw(times, options.picture)


if __name__ == "__main__":
    main()
