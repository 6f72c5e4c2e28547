"""What a reader of a shared model wants to know: what it is, what it reached, and how it was made."""

from __future__ import annotations

import json
import re
import sys
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import stable_baselines3
import torch as th

from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.hub.algorithms import SharedAlgorithm, algorithm_of
from sb3_dreamer_urlb.hub.repositories import MISSING_HUB
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.planning import planner_name
from sb3_dreamer_urlb.snapshots import values
from sb3_dreamer_urlb.version import __version__, how_to_install

#: folders of absolute paths, and of those in somebody's home: /home/me/ of /home/me/logs
PRIVATE_FOLDERS = re.compile(r"(?<![\w./\\~-])(?:~|[A-Za-z]:)?[/\\](?:[^\s'\"/\\]+[/\\])+")
#: a Python that ran a module, with its options
PYTHON = re.compile(r"^.*?python[\w.]*(?: -[^m\s]\S*)*(?= -m )")
FROM_SCRATCH = "none, learnt from scratch"
#: say something about the machine, or have a line of their own
NOT_LISTED = ("verbose", "tensorboard_log", "stats_window_size", "seed", "intrinsic_reward", "planner")


@dataclass(frozen=True)
class ModelFacts:
    """What the card states, and ``config.json`` in a form for programs.

    :param env_id: of the environment that it was evaluated in
    :param domain: of the task, None where the environment does not tell
    :param method: of exploration in pre-training
    :param phase: that the model is in
    :param pretrained_frames: environment frames of the pre-training, None where the snapshot is too old to know
    :param frames: environment frames of the present phase
    :param action_repeat: frames an agent step
    :param planner: that acts in fine-tuning, or None
    :param seed: None for a run without
    :param command: that made it, None if nobody said
    :param algorithm: name of its class
    """

    env_id: str
    domain: str | None
    method: str
    phase: str
    pretrained_frames: int | None
    frames: int
    action_repeat: int
    planner: str | None
    seed: int | None
    command: str | None
    algorithm: str


@dataclass(frozen=True)
class Evaluation:
    """Undiscounted returns of whole episodes, by SB3's ``evaluate_policy``.

    :param mean_reward: of the returns
    :param std_reward: of the returns
    :param n_eval_episodes: how many
    :param is_deterministic: without exploration
    :param eval_datetime: ISO 8601
    """

    mean_reward: float
    std_reward: float
    n_eval_episodes: int
    is_deterministic: bool
    eval_datetime: str

    @property
    def text(self) -> str:
        """As the Hub's leaderboards read it."""
        return f"{self.mean_reward:.2f} +/- {self.std_reward:.2f}"


def facts_about(model: AgentAlgorithm, env_id: str, command: str | None) -> ModelFacts:
    """What a model knows about itself.

    :param model: trained
    :param env_id: of the environment that it was evaluated in
    :param command: that made it
    """
    reward = model.intrinsic_reward
    name = reward if isinstance(reward, str) else getattr(reward, "__name__", type(reward).__name__)
    exploring = model.phase == PRETRAINING
    known = exploring or reward is None or model.pretrained_frames > 0
    return ModelFacts(
        env_id=env_id,
        domain=model.domain,
        method=FROM_SCRATCH if reward is None else name,
        phase=model.phase,
        pretrained_frames=(model.phase_frames if exploring else model.pretrained_frames) if known else None,
        frames=model.phase_frames,
        action_repeat=model.action_repeat,
        planner=planner_name(getattr(model, "planner", None)),
        seed=model.seed,
        command=None if command is None else without_private_paths(command),
        algorithm=algorithm_of(model).name,
    )


def without_private_paths(text: str) -> str:
    """For everybody to read: ``/home/me/.venv/bin/python -m`` is ``python -m``, of other absolute paths the last part stays.

    :param text: a command, or a value of an argument
    """
    return PRIVATE_FOLDERS.sub("", PYTHON.sub("python", text))


def metadata(algorithm: SharedAlgorithm, facts: ModelFacts, evaluation: Evaluation) -> str:
    """The YAML that the Hub reads: tags, and the return as its leaderboards expect it.

    :param algorithm: the model's
    :param facts: about the model
    :param evaluation: its return
    :raises ImportError: if huggingface_hub is not installed
    """
    try:
        from huggingface_hub import EvalResult, ModelCardData
    except ImportError as error:
        raise ImportError(MISSING_HUB) from error
    result = EvalResult(
        task_type="reinforcement-learning",
        task_name="reinforcement-learning",
        dataset_type=facts.env_id,
        dataset_name=facts.env_id,
        metric_type="mean_reward",
        metric_name="mean_reward",
        metric_value=evaluation.text,
        verified=False,
    )
    tags = [facts.env_id, "deep-reinforcement-learning", "reinforcement-learning", "stable-baselines3", "sb3_dreamer_urlb"]
    tags.append(algorithm.tag)
    if facts.domain:
        tags.append(facts.domain)
    if facts.method != FROM_SCRATCH:
        tags.append(facts.method)
    data = ModelCardData(
        library_name="stable-baselines3",
        pipeline_tag="reinforcement-learning",
        tags=tags,
        model_name=algorithm.name,
        eval_results=[result],
    )
    return str(data.to_yaml())


def model_card(
    model: AgentAlgorithm, facts: ModelFacts, evaluation: Evaluation, repo_name: str, normalized: bool, filmed: bool
) -> str:
    """The README.md of a repository.

    :param model: trained
    :param facts: about it
    :param evaluation: its return
    :param repo_name: where it will be found, ``"./"`` for the folder that the card lies in
    :param normalized: there is a ``vec_normalize.json``
    :param filmed: there is a ``replay.mp4``
    """
    rows = {
        "environment": f"`{facts.env_id}`",
        "domain": facts.domain or "not stated by the environment",
        "method of pre-training": facts.method if facts.method == FROM_SCRATCH else f"`{facts.method}`",
        "phase": "pre-training: the task's reward was not used" if facts.phase == PRETRAINING else "trained on the task",
        "frames": frames_text(facts),
        "planner": f"`{facts.planner}`" if facts.planner else "none",
        "seed": "none" if facts.seed is None else str(facts.seed),
        "return": f"{evaluation.text} (mean and standard deviation of {evaluation.n_eval_episodes} "
        f"{'deterministic' if evaluation.is_deterministic else 'stochastic'} episodes)",
    }
    algorithm = algorithm_of(model)
    table = "\n".join(f"| {name} | {value} |" for name, value in rows.items())
    command = f"```sh\n{facts.command}\n```" if facts.command else "The command was not recorded."
    hyperparameters = json.dumps(changed_arguments(model), indent=1, ensure_ascii=False)
    return f"""---
{metadata(algorithm, facts, evaluation).rstrip()}
---

# {algorithm.name} in `{facts.env_id}`

{algorithm.about}, trained with sb3_dreamer_urlb, {algorithm.name} for
[Stable-Baselines3](https://github.com/DLR-RM/stable-baselines3).
{"`replay.mp4` shows it at work." if filmed else ""}

| | |
|---|---|
{table}

## Use it

sb3_dreamer_urlb {__version__} or later; {how_to_install("hub").replace("pip", "`pip")}`.
{"Then, in this folder:" if repo_name == "./" else "Then:"}

```python
{usage(facts, repo_name, normalized)}
```

Files are JSON and safetensors: loading them runs no code.

## Made with

{command}

sb3_dreamer_urlb {__version__}, Stable-Baselines3 {stable_baselines3.__version__}, \
torch {th.__version__}, gymnasium {gymnasium.__version__}, Python {sys.version.split()[0]}.

Hyperparameters that differ from the defaults, which are the benchmark's
([ICML 2023](https://masteringurlb.github.io/)):

```json
{hyperparameters}
```
"""


def frames_text(facts: ModelFacts) -> str:
    """Both phases in environment frames."""
    repeat = f", {facts.action_repeat} frames an agent step"
    if facts.phase == PRETRAINING:
        return f"{facts.frames:,} of pre-training{repeat}"
    on_task = f"{facts.frames:,} on the task"
    if facts.method == FROM_SCRATCH:
        return f"{on_task}{repeat}"
    before = "an unknown number" if facts.pretrained_frames is None else f"{facts.pretrained_frames:,}"
    return f"{before} of pre-training, then {on_task}{repeat}"


def usage(facts: ModelFacts, repo_name: str, normalized: bool) -> str:
    """Python that loads the model."""
    registers, known = who_registers(facts.env_id)
    env_id = json.dumps(facts.env_id)
    if not known:
        registers = ["# No package registers this environment: get its class from whoever made the model.",
                     f"from its_module import ItsClass  # {facts.env_id}"]  # fmt: skip
    if normalized:
        imports = [*registers, "from stable_baselines3.common.env_util import make_vec_env"]
        names = "load_from_hub, load_vec_normalize"
        statistics = f'load_from_hub({json.dumps(repo_name)}, "vec_normalize.json")'
        env = f"load_vec_normalize({statistics}, make_vec_env({env_id if known else 'ItsClass'}))"
    else:
        imports, names = [*(["import gymnasium"] if known else []), *registers], "load_from_hub"
        env = f"gymnasium.make({env_id})" if known else "ItsClass()"
    lines = [
        *imports,
        "",
        f"from sb3_dreamer_urlb import {facts.algorithm}",
        f"from sb3_dreamer_urlb.hub import {names}",
        "",
        f"env = {env}",
        f"model = {facts.algorithm}.load(load_from_hub({json.dumps(repo_name)}), env=env)",
    ]
    if facts.phase == PRETRAINING:
        lines += ["model.fine_tune()  # keeps what was pre-trained", "model.learn(50_000)"]
    return "\n".join(lines)


def who_registers(env_id: str) -> tuple[list[str], bool]:
    """Imports without which ``gymnasium.make`` would not know an environment, and whether there are such."""
    spec = gymnasium.registry.get(env_id)
    if spec is None:
        return [], False
    entry = spec.entry_point
    module = entry.partition(":")[0] if isinstance(entry, str) else getattr(entry, "__module__", "")
    package = module.partition(".")[0]
    if package in ("", "__main__", "builtins"):
        return [], False
    return ([] if package in ("gymnasium", "sb3_dreamer_urlb") else [f"import {package}  # registers {env_id}"]), True


def changed_arguments(model: AgentAlgorithm) -> dict[str, Any]:
    """Constructor arguments that are not the defaults, as JSON."""
    signature = type(model).argument_parameters()
    kind = type(model.policy)
    aliases = [alias for alias, known in model.policy_aliases.items() if known is kind]
    found: dict[str, Any] = {"policy": (aliases or [kind.__name__])[0]}
    for name, value in model.arguments().items():
        if name in NOT_LISTED:
            continue
        if name == "train_freq":
            value = value.frequency if value.unit.value == "step" else (value.frequency, value.unit.value)
        # None, {} and what the preset filled in compare by what they are now.
        if value != signature[name].default and not (value == {} and signature[name].default is None):
            found[name] = _for_everybody(values.encode_or_describe(value))
    return found


def _for_everybody(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _for_everybody(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_for_everybody(part) for part in value]
    return without_private_paths(value) if isinstance(value, str) else value


def config(facts: ModelFacts, model_file: str) -> dict[str, Any]:
    """``config.json``: which file is the model, and the facts; the Hub counts downloads by it."""
    return {"library": "sb3_dreamer_urlb", "version": __version__, "model": model_file, **asdict(facts)}
