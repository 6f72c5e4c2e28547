"""Compare this package with the authors' implementation: ``python tests/helpers/golden.py FILE...``.

The form of the files: tests/golden/README.md.

Takes any file of that form: sizes, seeds and method come from the file. Prints one line a file with the worst error per
group and exits with 1 beyond 1e-4 relative on outputs or 2e-5 absolute on weights.

Sampling is made deterministic from here: the package's two draw functions are replaced while a case runs.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from unittest import mock

import numpy as np
import torch as th
from gymnasium import spaces
from places import TESTS

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.behavior import actor_critic
from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward
from sb3_dreamer_urlb.intrinsic.skills import Skills
from sb3_dreamer_urlb.learning.learner import Learner, LearnerConfig
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.planning import DynaMPC, PlannerConfig
from sb3_dreamer_urlb.planning.prepared import native_parts
from sb3_dreamer_urlb.planning.prepared.agent import planned
from sb3_dreamer_urlb.spaces.observations import Images
from sb3_dreamer_urlb.types import LatentState, SequenceBatch
from sb3_dreamer_urlb.world_model.world_model import WorldModel

RELATIVE, ABSOLUTE = 1e-4, 2e-5
# A mean of both signs may come out near zero, and its rounding error does not shrink with it.
SMALLEST_METRIC = 1e-3
# The authors' name of each method, ours, and where its hyperparameters stand in the file's configuration.
METHODS: dict[str, tuple[str | None, dict[str, str]]] = {
    "dreamer": (None, {}),
    "lbs_dreamer": ("lbs", {}),
    "plan2explore": ("plan2explore", {}),
    "icm_dreamer": ("icm", {}),
    "rnd_dreamer": ("rnd", {"output_size": "rnd_rep_dim"}),
    "apt_dreamer": ("apt", {"k": "knn_k"}),
    "diayn_dreamer": ("diayn", {"skill_dim": "skill_dim"}),
    "aps_dreamer": ("aps", {"skill_dim": "skill_dim", "k": "knn_k"}),
}
METRICS = {
    "kl_loss": "kl_loss",
    "observation_loss": "image_loss",
    "reward_loss": "reward_loss",
    "model_kl": "kl",
    "prior_ent": "prior_entropy",
    "post_ent": "posterior_entropy",
    "model_grad_norm": "model_grad_norm",
    "diayn_acc": "intrinsic_accuracy",
    "actor_loss": "actor_loss",
    "actor_grad_norm": "actor_grad_norm",
    "critic_loss": "critic_loss",
    "critic_grad_norm": "critic_grad_norm",
    "reward_mean": "imagined_reward",
    "reward_std": "imagined_reward_std",
    "reward_normed_mean": "normalized_reward",
    "critic_target": "critic_target",
    "actor_ent": "actor_entropy",
    "critic": "critic",
}
# Metrics of the authors that this package does not log: a constant, and two that follow from others compared here.
UNLOGGED = {"actor_ent_scale", "reward_normed_std", "critic_slow"}
# With successor features the authors log the mean of ψ under this name, not of the value ψ · w.
UNLOGGED_OF_SUCCESSOR_FEATURES = {"critic"}
# What the authors call the intrinsic module in their metrics, and what they put before those of a skill's behaviour.
INTRINSIC_METRIC = re.compile(r"^(lbs|disagreement|icm|rnd|diayn|aps)_(loss|grad_norm)$")
SKILL_PREFIX = "skill_"
MODULES = [
    (r"^encoder\.conv(\d+)", r"world_model.encoder.convs.\1"),
    (r"^decoder\.in\.", "world_model.decoder.input."),
    (r"^decoder\.deconv(\d+)", r"world_model.decoder.deconvs.\1"),
    (r"^rssm\.in\.", "world_model.rssm.input."),
    (r"^rssm\.", "world_model.rssm."),
    (r"^reward\.", "world_model.reward."),
    (r"^actor\.(dense|out\.)", r"actor.body.\1"),
    (r"^target_critic\.", "slow_critic."),
    (r"^lbs\.", "intrinsic.surprise."),
    (r"^p2e\.model(\d+)", r"intrinsic.models.\1"),
    (r"^icm\.forward\.", "intrinsic.forward_model."),
    (r"^rnd\.(predictor|target)\.conv(\d+)", r"intrinsic.\1.encoder.convs.\2"),
    (r"^rnd\.(predictor|target)\.dense", r"intrinsic.\1.head.dense"),
    (r"^diayn\.", "intrinsic."),
    (r"^aps\.", "intrinsic."),
    (r"\.dense(\d+)\.", r".dense.\1."),
]


class Worst:
    """The worst error seen in each group of quantities."""

    def __init__(self) -> None:
        self.errors: defaultdict[str, float] = defaultdict(float)

    def relative(self, group: str, ours: th.Tensor, theirs: np.ndarray, least: float = 1e-8) -> None:
        """Largest difference in units of the largest magnitude of the reference, or of ``least`` if that is larger."""
        difference = self._difference(ours, theirs)
        self._note(group, difference / max(float(np.abs(theirs).max()), least))

    def absolute(self, group: str, ours: th.Tensor, theirs: np.ndarray) -> None:
        """Largest difference."""
        self._note(group, self._difference(ours, theirs))

    @staticmethod
    def _difference(ours: th.Tensor, theirs: np.ndarray) -> float:
        mine = ours.detach().double().numpy()
        if mine.size != theirs.size:
            raise ValueError(f"shape {mine.shape} against the reference's {theirs.shape}")
        return float(np.abs(mine.reshape(theirs.shape) - theirs).max())

    def _note(self, group: str, error: float) -> None:
        # NaN must not hide behind max().
        self.errors[group] = max(self.errors[group], error if np.isfinite(error) else float("inf"))

    def passed(self) -> bool:
        """Whether every group is within its tolerance."""
        return all(error <= (ABSOLUTE if group == "weights" else RELATIVE) for group, error in self.errors.items())


class Case:
    """One golden file and the agent that it describes.

    :param path: of the ``.npz``
    :param compile: whose kernels the learner uses
    """

    def __init__(self, path: str, compile: str = "eager"):
        with np.load(path) as archive:
            self.data = {name: archive[name] for name in archive.files}
        self.config = json.loads(bytes(self.data["config"]).decode())
        self.size = self.config["size"]
        if self.config["agent"] not in METHODS:
            raise ValueError(f"{path}: method {self.config['agent']!r} is not one of {sorted(METHODS)}")
        self.agent = self._make_agent()
        self.learner = Learner(self.agent, self._learner_config(compile))
        self._load_weights()

    def _make_agent(self) -> Agent:
        size, (method, hyperparameters) = self.size, METHODS[self.config["agent"]]
        net_arch = [size["units"]] * size["layers"]
        world_model = WorldModel(
            observations=Images(spaces.Box(0, 255, self.data["update0.in.observation"].shape[2:], np.uint8)),
            action_size=size["act"],
            cnn_depth=size["depth"],
            deter_size=size["deter"],
            hidden_size=size["hidden"],
            stoch_variables=size["stoch"],
            stoch_classes=size["classes"],
            net_arch=net_arch,
            gamma=self.config["discount"],
            discount_head=False,
        )
        known = {**size, **self.config}
        kwargs = {ours: known[theirs] for ours, theirs in hyperparameters.items()}
        intrinsic = make_intrinsic_reward(method, kwargs)
        if self.config["fine_tune"] and intrinsic is not None and intrinsic.skills is None:
            intrinsic = None
        agent = Agent(world_model, net_arch, intrinsic, explores=not self.config["fine_tune"])
        agent.reward_normalizer.momentum = self.config["reward_norm"]["momentum"]
        return agent

    def _learner_config(self, compile: str) -> LearnerConfig:
        config = self.config
        return LearnerConfig(
            learning_rate=config["model_lr"],
            actor_learning_rate=config["actor_lr"],
            critic_learning_rate=config["critic_lr"],
            adam_eps=config["adam_eps"],
            max_grad_norm=config["grad_clip"],
            weight_decay=config["weight_decay"],
            free_nats=config["kl_free"],
            kl_balance=config["kl_balance"],
            imagination_horizon=self.size["imag"],
            gae_lambda=config["lam"],
            target_update_interval=config["slow_target_update"],
            ent_coef=config["actor_ent"],
            reward_trains_model="reward" in config["grad_heads"],
            compile=compile,
        )

    def parameter(self, name: str) -> th.Tensor:
        """Our parameter with the reference's ``name``."""
        for pattern, ours in MODULES:
            name = re.sub(pattern, ours, name)
        return self.agent.state_dict(keep_vars=True)[name]

    def named(self, prefix: str) -> Iterator[tuple[str, np.ndarray]]:
        """The file's entries below ``prefix``, without it."""
        for name, value in self.data.items():
            if name.startswith(prefix):
                yield name[len(prefix) :], value

    def _load_weights(self) -> None:
        missing = {name for name, _ in self.agent.named_parameters()}
        if self.config["fine_tune"]:
            missing = {name for name in missing if not name.startswith("intrinsic.")}
        with th.no_grad():
            for name, value in self.named("init."):
                parameter = self.parameter(name)
                parameter.copy_(th.as_tensor(value))
                missing -= {ours for ours, held in self.agent.state_dict(keep_vars=True).items() if held is parameter}
        if missing:
            raise ValueError(f"the file has no initial weights for {sorted(missing)}")

    def batch(self, update: int) -> SequenceBatch:
        """The batch of one update."""
        entry = {name: th.as_tensor(value) for name, value in self.named(f"update{update}.in.")}
        return SequenceBatch(
            entry["observation"],
            entry["action"],
            entry["reward"].squeeze(-1),
            entry["is_first"].bool(),
            entry["is_terminal"].squeeze(-1).bool(),
            entry.get("skill"),
        )

    def imagination_skill(self, update: int) -> th.Tensor | None:
        """The skills that the dreams of one update follow."""
        given = self.data.get(f"update{update}.in.imagination_skill")
        return None if given is None else th.as_tensor(given)


FILES = ["dreamer_finetune.npz", "lbs_pretrain.npz"]
OTHERS = [f"{name}_pretrain.npz" for name in ("icm", "plan2explore", "rnd", "apt", "diayn", "aps")]


def golden_path(name: str) -> str:
    """Of a golden file: in ``$SB3_DREAMER_GOLDEN`` if set, else beside the checkout, else the tests' copy."""
    given = os.environ.get("SB3_DREAMER_GOLDEN")
    folders = [Path(given)] if given else [TESTS.parent.parent / "shared" / "golden", TESTS / "golden"]
    found = [folder / name for folder in folders if (folder / name).is_file()]
    assert found, f"{name} lies in none of {[str(folder) for folder in folders]}"
    return str(found[0])


def _most_probable(logits: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    return logits.argmax(-1) + th.arange(logits.shape[-2]) * logits.shape[-1]


def _most_probable_and_probs(logits: th.Tensor, generator: th.Generator | None = None) -> tuple[th.Tensor, th.Tensor]:
    return logits.argmax(-1), logits.float().softmax(-1)


@contextmanager
def deterministic_draws() -> Iterator[None]:
    """A categorical draw is its most probable class, an actor's draw its mean; trajectories are imagined step by step, because
    the pass that does many steps has its draws inside (tests/planning/test_native_rollout.py: it does what steps do)."""
    with (
        mock.patch.object(native_parts.NativeDynamics, "imagine", lambda *_: None),
        mock.patch.object(distributions, "draw_classes", lambda probs, generator=None: probs.argmax(-1)),
        mock.patch.object(distributions, "draw_classes_of_logits", _most_probable),
        mock.patch.object(distributions, "draw_classes_and_probs", _most_probable_and_probs),
        mock.patch.object(distributions, "draw_normal", lambda shape, like, generator=None: like.new_zeros(shape)),
    ):
        yield


def check_forward(case: Case, worst: Worst) -> None:
    """World-model outputs on the first batch with the initial weights."""
    batch, model = case.batch(0), case.agent.world_model
    with th.no_grad():
        posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
        image = model.decoder(posterior.feature)
        ours = {
            "embed": posterior.embed,
            "post_logits": posterior.post_logits,
            "post_stoch": posterior.state.stoch,
            "deter": posterior.state.deter,
            "prior_logits": posterior.prior_logits,
            "reconstruction": image[:1, 1],
            "reward": model.reward(posterior.feature),
        }
    for name, theirs in case.named("forward."):
        worst.relative("forward", ours[name], theirs)


def check_updates(case: Case, worst: Worst) -> None:
    """Losses and imagination of every update, and the weights after the last."""
    last = case.size["updates"] - 1
    successor_features = case.agent.intrinsic is not None and case.agent.intrinsic.successor_features
    unlogged = UNLOGGED | (UNLOGGED_OF_SUCCESSOR_FEATURES if successor_features else set())
    for update in range(last + 1):
        seen: dict[str, th.Tensor] = {}

        def spying_weights(discount, seen=seen):  # type: ignore[no-untyped-def]
            weight = weights(discount)
            # The file also holds the weight of z_H, which no loss uses.
            seen["weights"] = th.cat([weight, weight[-1:] * discount[-2:-1]])
            return weight

        def spying_metrics(imagination, raw_reward, reward, returns, seen=seen):  # type: ignore[no-untyped-def]
            seen.update(features=imagination.feature, actions=imagination.action, rewards=reward, targets=returns)
            return metrics_of(imagination, raw_reward, reward, returns)

        def spying_labels(posterior, batch, seen=seen):  # type: ignore[no-untyped-def]
            seen["intrinsic_reward"] = labels(posterior, batch)
            return seen["intrinsic_reward"]

        weights, metrics_of = actor_critic.discount_weights, actor_critic.behavior_metrics
        labels = case.learner.reward_source.replay_reward
        skill = case.imagination_skill(update)
        with (
            mock.patch.object(actor_critic, "discount_weights", spying_weights),
            mock.patch.object(actor_critic, "behavior_metrics", spying_metrics),
            mock.patch.object(case.learner.reward_source, "replay_reward", spying_labels),
            mock.patch.object(Skills, "sample", lambda *_, skill=skill: skill),
            mock.patch.object(Agent, "trains_behavior", lambda _: True),
        ):
            metrics = case.learner.update(case.batch(update))
        if f"update{update}.intrinsic_reward" in case.data:
            worst.relative("losses", seen["intrinsic_reward"], case.data[f"update{update}.intrinsic_reward"])
        for name, theirs in case.named(f"update{update}.imagination."):
            worst.relative("imagination", seen[name], theirs)
        for name, theirs in case.named(f"update{update}.metric."):
            name = INTRINSIC_METRIC.sub(r"intrinsic_\2", name.removeprefix(SKILL_PREFIX))
            if name not in unlogged:
                worst.relative("losses", metrics[METRICS.get(name, name)], theirs, SMALLEST_METRIC)
    for name, theirs in case.named(f"update{last}.weights."):
        worst.absolute("weights", case.parameter(name), theirs)


def check_planner(case: Case, worst: Worst, seen_as: Callable[[Agent, th.Tensor], PlannedAgent]) -> None:
    """Values, kept mean and action of the planner, step after step of one episode.

    :param seen_as: how the planner sees the agent
    """
    size, agent = case.size, case.agent
    horizon = case.data["plan0.mean"].shape[0]
    config = PlannerConfig(
        horizon, size["plan_samples"], size["plan_iters"], size["plan_topk"], size["plan_mix"], 0.5, 0.1, 0.1
    )
    planner = DynaMPC(config, case.config["lam"])
    state = agent.world_model.rssm.initial(1)
    action, mean = th.zeros(1, size["act"]), th.zeros(1, horizon, size["act"])
    for step in range(sum(name.endswith(".in.observation") and name.startswith("plan") for name in case.data)):
        given = {name: th.as_tensor(value) for name, value in case.named(f"plan{step}.")}
        values: list[th.Tensor] = []
        # The file's noise is (J, H, N, A), ours (J, n, N, H, A).
        noise = given["in.noise"].transpose(1, 2).unsqueeze(1)

        def spying_elites(actions, value, values=values):  # type: ignore[no-untyped-def]
            values.append(value)
            return DynaMPC.elites(planner, actions, value)

        with (
            th.no_grad(),
            mock.patch.object(planner, "_sampling_noise", lambda *_, noise=noise: noise),
            mock.patch.object(planner, "_exploration_noise", lambda *_, given=given: given["in.action_noise"].unsqueeze(0)),
            mock.patch.object(planner, "elites", spying_elites),
        ):
            embed = agent.world_model.encoder(agent.world_model.preprocess(given["in.observation"].unsqueeze(0)))
            is_first = th.tensor([step == 0])
            state = agent.world_model.rssm.posterior_step(LatentState(state.stoch, state.deter), action, embed, is_first)
            action, mean = planner.plan(seen_as(agent, state.deter.new_zeros(1, 0)), state, mean, None, explore=True)
        worst.relative("planner", th.stack(values), case.data[f"plan{step}.values"])
        worst.relative("planner", mean, case.data[f"plan{step}.mean"])
        # The authors return the action unclipped; this package clips it before acting and storing.
        worst.relative("planner", action, case.data[f"plan{step}.action"].clip(-1, 1))
        # The authors feed the unclipped action to their next posterior step: so does this comparison.
        action = given["action"].unsqueeze(0)


def check(path: str, compile: str = "eager") -> Worst:
    """Run every comparison that the file holds.

    :param path: of the ``.npz``
    :param compile: whose kernels run, ``"eager"`` for torch's
    :return: the worst errors
    """
    worst = Worst()
    case = Case(path, compile)
    with deterministic_draws(), native.using(compile, "cpu"):
        check_forward(case, worst)
        check_updates(case, worst)
        if "plan0.mean" in case.data:
            for seen_as in (PlannedAgent, planned):
                check_planner(case, worst, seen_as)
    return worst


def main(paths: list[str]) -> int:
    """Check every file; the exit status is 0 if all passed."""
    if not paths:
        print(__doc__)
        return 2
    failed = False
    for path in paths:
        worst = check(path)
        failed |= not worst.passed()
        errors = "  ".join(f"{group} {error:.1e}" for group, error in worst.errors.items())
        print(f"{'ok  ' if worst.passed() else 'FAIL'} {path}: {errors}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
