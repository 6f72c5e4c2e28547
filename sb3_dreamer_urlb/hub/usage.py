"""Python that loads a shared model."""

from __future__ import annotations

import json
from typing import Any

import gymnasium

from sb3_dreamer_urlb.hub.facts import ModelFacts, OwnPart
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.snapshots import values
from sb3_dreamer_urlb.snapshots.registered import ANOTHER, registries


def usage(facts: ModelFacts, repo_name: str, normalized: bool) -> str:
    """Python that loads the model."""
    registers, known = who_registers(facts.env_id)
    env_id = json.dumps(facts.env_id)
    if not known:
        registers = ["# No package registers this environment: get its class from whoever made the model.",
                     f"from its_module import ItsClass  # {facts.env_id}"]  # fmt: skip
    told = as_arguments(facts.env_kwargs)
    if normalized:
        imports = [*registers, "from stable_baselines3.common.env_util import make_vec_env"]
        names = "load_from_hub, load_vec_normalize"
        statistics = f'load_from_hub({json.dumps(repo_name)}, "vec_normalize.json")'
        kwargs = f", env_kwargs=dict({told})" if told else ""
        env = f"load_vec_normalize({statistics}, make_vec_env({env_id if known else 'ItsClass'}{kwargs}))"
    else:
        imports, names = [*(["import gymnasium"] if known else []), *registers], "load_from_hub"
        env = f"gymnasium.make({env_id}{', ' + told if told else ''})" if known else f"ItsClass({told})"
    lines = [
        *imports,
        "",
        f"from sb3_dreamer_urlb import {facts.algorithm}",
        f"from sb3_dreamer_urlb.hub import {names}",
        "",
        f"env = {env}",
        *(["# The model saw it through these, innermost first: put them around it, too."] if facts.wrappers else []),
        *(f"# {wrapper}" for wrapper in facts.wrappers),
        *how_to_give(facts.own_parts),
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


def as_arguments(kwargs: dict[str, Any]) -> str:
    """As Python has them in a call; ``...`` stands for what is no plain value.

    :param kwargs: as JSON
    """
    told = {name: "..." if _is_tagged(value) else repr(value) for name, value in kwargs.items()}
    return ", ".join(f"{name}={value}" for name, value in told.items())


def how_to_give(parts: dict[str, OwnPart]) -> list[str]:
    """Comments: what has to be there before the model can be loaded.

    :param parts: that this package does not have
    """
    lines = []
    for argument, part in parts.items():
        name = part.kind.rpartition(".")[2]
        if part.registered_as is None:
            how = f'load(..., custom_objects={{"{argument}": {name}{"(...)" if part.instance else ""}}})'
        else:
            how = f'{registries()[argument].register}("{part.registered_as}", {name}) first'
        other = f", or {ANOTHER[argument]}" if argument in ANOTHER else ""
        lines += [f"# Its {argument} is {part.kind}, which this package does not have:", f"# {how}{other}."]
    return lines


def _is_tagged(value: Any) -> bool:
    parts = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return (isinstance(value, dict) and values.TAG in value) or any(map(_is_tagged, parts))
