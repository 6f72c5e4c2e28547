"""The paper's ablations as lists of runs: what is pre-trained, what is fine-tuned from it, and how."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from sb3_dreamer_urlb.callbacks.snapshot import SNAPSHOT_FRAMES
from sb3_dreamer_urlb.envs.registration import PRIMAL_TASK, URLB_TASKS, env_id
from sb3_dreamer_urlb.intrinsic import IntrinsicReward
from sb3_dreamer_urlb.intrinsic.registry import get_intrinsic_reward
from sb3_dreamer_urlb.transfer_rule import keeps_actor

#: of the ablations (paper, §4): all that have an actor to keep
METHODS = ("lbs", "icm", "plan2explore", "rnd", "apt", "diayn", "aps")
#: of the appendix on longer pre-training; the last is the paper's longest
LONGER = (*SNAPSHOT_FRAMES, 3_000_000, 4_000_000, 5_000_000)
ZERO_SHOT_PLANNER = "mppi_zero_shot"
#: in the place of a method: no pre-training at all
SCRATCH = "scratch"


@dataclass(frozen=True)
class PreTraining:
    """
    :param method: intrinsic reward, or ``SCRATCH``, whose only length is 0
    :param env: id of the environment
    :param seed: of everything
    :param lengths: environment frames at which snapshots are taken; the last ends the run
    """

    method: str
    env: str
    seed: int
    lengths: tuple[int, ...]

    @property
    def name(self) -> str:
        """Of its folder."""
        return f"{self.method}-{_short(self.env)}-{self.seed}-{self.lengths[-1]}"


@dataclass(frozen=True)
class FineTuning:
    """
    :param start: what it begins with
    :param length: of the pre-training, in environment frames
    :param env: id of the environment
    :param frames: environment frames of fine-tuning; 0 for zero-shot
    :param keep_actor: see ``fine_tune``
    :param keep_critic: likewise
    :param keep_reward: likewise
    :param planner: that acts, None for the actor
    """

    start: PreTraining
    length: int
    env: str
    frames: int
    keep_actor: bool = False
    keep_critic: bool = False
    keep_reward: bool = False
    planner: str | None = None

    @property
    def name(self) -> str:
        """Tells it from all others."""
        kept = [part for part in ("actor", "critic", "reward") if getattr(self, f"keep_{part}")]
        how = "-".join(["model", *kept, *([] if self.planner is None else [self.planner])])
        return f"{self.start.name}/{self.length}/{_short(self.env)}/{how}-{self.frames}"


def _short(env: str) -> str:
    return env.partition("/")[2].removesuffix("-v0") or env


#: of the benchmark, ``<domain>-<task>``
TASKS = tuple(f"{domain}-{task}" for domain, tasks in URLB_TASKS.items() for task in tasks)


@dataclass(frozen=True)
class Plan:
    """What of a study is done.

    :param methods: intrinsic rewards
    :param tasks: ``<domain>-<task>``
    :param seeds: how many
    :param pretrain: lengths of the pre-training, environment frames
    :param finetune: environment frames of fine-tuning
    """

    methods: tuple[str, ...] = METHODS
    tasks: tuple[str, ...] = TASKS
    seeds: int = 3
    pretrain: tuple[int, ...] = (SNAPSHOT_FRAMES[-1],)
    finetune: int = 100_000

    def __post_init__(self) -> None:
        for task in self.tasks:
            if task not in TASKS:
                raise ValueError(f"Unknown task {task!r}; known are {', '.join(TASKS)}.")
        numbers = (self.seeds, self.finetune, *self.pretrain)
        if not (self.methods and self.tasks and self.pretrain) or any(number < 1 for number in numbers):
            raise ValueError(f"A study needs methods, tasks, and positive numbers, got {self}.")

    def each(self, primal: bool = True) -> Iterator[tuple[PreTraining, str, str]]:
        """Pre-trainings with the domain and the task that they are fine-tuned on.

        :param primal: pre-train in the domain's primal task; False: in the task itself, whose reward is then known
        """
        for seed in range(self.seeds):
            for task in self.tasks:
                domain, _, name = task.partition("-")
                for method in self.methods:
                    begins = PRIMAL_TASK[domain] if primal else name
                    env = _fixed(domain, begins) if not primal else env_id(domain, begins)
                    yield PreTraining(method, env, seed, tuple(sorted(self.pretrain))), domain, name


def _fixed(domain: str, task: str) -> str:
    # The reward of Jaco's own tasks moves with the target, so that none could be known from pre-training.
    return f"urlb/jaco-{task}-fixed-v0" if domain == "jaco" else env_id(domain, task)


def known_reward(plan: Plan) -> Iterator[FineTuning]:
    """Paper, figure "reward ablation": the reward learnt while fine-tuning, and known from pre-training on."""
    for start, domain, name in plan.each(primal=False):
        for known in (False, True):
            yield FineTuning(
                start, start.lengths[-1], _fixed(domain, name), plan.finetune, keeps_actor(domain), keep_reward=known
            )


def zero_shot(plan: Plan) -> Iterator[FineTuning]:
    """Paper, figure "Zero-shot (ZS) vs fine-tuned (FT)": planning alone, at once and after fine-tuning."""
    for start, domain, name in plan.each(primal=False):
        for frames in (0, plan.finetune):
            env = _fixed(domain, name)
            yield FineTuning(start, start.lengths[-1], env, frames, keep_reward=True, planner=ZERO_SHOT_PLANNER)


def from_scratch(plan: Plan, primal: bool) -> Iterator[FineTuning]:
    """Beside any study: each task learnt at once, with no pre-training, for as many frames as the fine-tunings have.

    :param plan: whose tasks and seeds
    :param primal: see :meth:`Plan.each`
    """
    for start, domain, name in Plan((SCRATCH,), plan.tasks, plan.seeds, finetune=plan.finetune).each(primal):
        env = env_id(domain, name) if primal else _fixed(domain, name)
        yield FineTuning(PreTraining(SCRATCH, env, start.seed, (0,)), 0, env, plan.finetune)


def modules(plan: Plan) -> Iterator[FineTuning]:
    """Paper, figure "Task-aware fine-tuning": model / + actor / + critic, with and without the planner."""
    for start, domain, name in plan.each():
        for actor, critic in ((False, False), (True, False), (True, True)):
            for planner in (None, "dyna_mpc"):
                yield FineTuning(start, start.lengths[-1], env_id(domain, name), plan.finetune, actor, critic, planner=planner)


def longer(plan: Plan) -> Iterator[FineTuning]:
    """Paper, appendix on longer pre-training: fine-tuning from each of its snapshots with the full method."""
    for start, domain, name in plan.each():
        for length in start.lengths:
            yield FineTuning(start, length, env_id(domain, name), plan.finetune, keeps_actor(domain), planner="dyna_mpc")


def sparsity(plan: Plan) -> Iterator[FineTuning]:
    """Paper, appendix "On the sparsity of the Jaco tasks": with and without the actor, for three rewarded areas."""
    for start, domain, name in plan.each():
        for env in (f"urlb/{domain}-{name}{kind}-v0" for kind in ("", "-sparse", "-dense")):
            for actor in (False, True):
                yield FineTuning(start, start.lengths[-1], env, plan.finetune, actor)


@dataclass(frozen=True)
class Manifest:
    """
    :param runs: of a plan
    :param plan: the paper's
    :param figure: of ``figures`` that shows it
    :param primal: it pre-trains in the primal task, not in the task itself
    """

    runs: Callable[[Plan], Iterator[FineTuning]]
    plan: Plan
    figure: str
    primal: bool = True


#: studies with an arm that keeps the pre-trained actor, whatever the domain
ABOUT_ACTORS = ("modules", "sparsity")
_JACO = tuple(f"jaco-{task}" for task in URLB_TASKS["jaco"])
MANIFESTS: dict[str, Manifest] = {
    "known-reward": Manifest(known_reward, Plan(), "known_reward", primal=False),
    "zero-shot": Manifest(zero_shot, Plan(methods=("plan2explore",)), "zero_shot", primal=False),
    "modules": Manifest(modules, Plan(), "modules"),
    "longer": Manifest(longer, Plan(pretrain=LONGER), "longer_pretraining"),
    "sparsity": Manifest(sparsity, Plan(tasks=_JACO), "sparsity"),
}


def runs_of(name: str, plan: Plan, scratch: bool = False) -> list[FineTuning]:
    """All fine-tunings of a study, each once.

    :param name: of ``MANIFESTS``
    :param plan: what of it
    :param scratch: and beside it agents without pre-training
    :raises ValueError: for an unknown name, tasks that the study is not about, or a method without an actor that it needs
    """
    if name not in MANIFESTS:
        raise ValueError(f"Unknown study {name!r}; known are {', '.join(MANIFESTS)}.")
    others: Sequence[str] = [task for task in plan.tasks if task not in _JACO] if name == "sparsity" else ()
    if others:
        raise ValueError(f"The study {name} is about Jaco: it has no {', '.join(others)}.")
    untrained = [
        one for one in plan.methods if name in ABOUT_ACTORS and not get_intrinsic_reward(one, IntrinsicReward).trains_actor
    ]
    if untrained:
        raise ValueError(
            f"The study {name} keeps pre-trained actors: {', '.join(untrained)} trains none. Leave it out of --methods."
        )
    beside = from_scratch(plan, MANIFESTS[name].primal) if scratch else ()
    return list(dict.fromkeys([*MANIFESTS[name].runs(plan), *beside]))
