"""What a reader of a shared model wants to know: what it is, what it reached, and how it was made."""

from __future__ import annotations

import json
import sys
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium
import stable_baselines3
import torch as th

from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.hub.algorithms import SharedAlgorithm, algorithm_of
from sb3_dreamer_urlb.hub.facts import FROM_SCRATCH, ModelFacts
from sb3_dreamer_urlb.hub.privacy import plain_for_everybody
from sb3_dreamer_urlb.hub.repositories import MISSING_HUB
from sb3_dreamer_urlb.hub.usage import as_arguments, usage
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.snapshots import values
from sb3_dreamer_urlb.version import __version__, how_to_install
from sb3_dreamer_urlb.words import counted

#: say something about the machine, or have a line of their own
NOT_LISTED = ("verbose", "tensorboard_log", "stats_window_size", "seed", "intrinsic_reward", "planner")


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
    how = "deterministic" if evaluation.is_deterministic else "stochastic"
    rows = {
        "environment": f"`{facts.env_id}`" + (f" with `{as_arguments(facts.env_kwargs)}`" if facts.env_kwargs else ""),
        **({"wrappers": ", ".join(f"`{wrapper}`" for wrapper in facts.wrappers)} if facts.wrappers else {}),
        "domain": facts.domain or "not stated by the environment",
        "method of pre-training": facts.method if facts.method == FROM_SCRATCH else f"`{facts.method}`",
        "phase": "pre-training: the task's reward was not used" if facts.phase == PRETRAINING else "trained on the task",
        "frames": frames_text(facts),
        "planner": f"`{facts.planner}`" if facts.planner else "none",
        "seed": "none" if facts.seed is None else str(facts.seed),
        "return": f"{evaluation.text} (mean and standard deviation of "
        f"{counted(evaluation.n_eval_episodes, f'{how} episode')})",
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
            found[name] = plain_for_everybody(values.encode_or_describe(value))
    return found


def config(facts: ModelFacts, model_file: str) -> dict[str, Any]:
    """``config.json``: which file is the model, and the facts; the Hub counts downloads by it."""
    return {"library": "sb3_dreamer_urlb", "version": __version__, "model": model_file, **asdict(facts)}
