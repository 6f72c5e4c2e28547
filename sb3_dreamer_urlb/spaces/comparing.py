"""Whether an environment shows and takes what a model knows; where not, in which part."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.envs.facts import env_fact


def check_same_spaces(env: VecEnv, model: Any) -> None:
    """As Stable-Baselines3's ``check_for_correct_spaces``, which says neither which part differs nor what to do.

    :param env: to go on in, with images as the model sees them
    :param model: with its spaces, and the domain that it has learnt in
    :raises ValueError: naming every part that differs, and both values of it
    """
    pairs = {
        "Observation": (model.observation_space, env.observation_space),
        "Action": (model.action_space, env.action_space),
    }
    wrong = [
        f"{name} spaces do not match: {'; '.join(_differences(ours, theirs))}."
        for name, (ours, theirs) in pairs.items()
        if ours != theirs
    ]
    if not wrong:
        return
    domain = env_fact(env, "domain", None)
    if None not in (domain, model.domain) and domain != model.domain:
        wrong.append(f"The model has learnt in the domain {model.domain!r}, this is {domain!r}.")
    raise ValueError(
        f"{' '.join(wrong)} A model goes on where it sees and does the same: in another task of the same body, made with the "
        f"same options and wrappers. For this environment make a new one: {type(model).__name__}(policy, env)."
    )


def _differences(ours: spaces.Space[Any], theirs: spaces.Space[Any], part: str = "") -> Iterator[str]:
    """What differs between two spaces that are not equal, part by part."""
    of = f" of {part}" if part else ""
    if isinstance(ours, spaces.Dict) and isinstance(theirs, spaces.Dict):
        for name in sorted({*ours.spaces, *theirs.spaces}):
            mine, its = ours.spaces.get(name), theirs.spaces.get(name)
            if mine is None or its is None:
                yield f"{name!r} is the {'environment' if mine is None else 'model'}'s only"
            elif mine != its:
                yield from _differences(mine, its, repr(name))
    elif isinstance(ours, spaces.Box) and isinstance(theirs, spaces.Box) and str(ours) == str(theirs):
        # Of large ones, numpy prints the first bounds and the last.
        for name in ("low", "high"):
            mine, its = getattr(ours, name), getattr(theirs, name)
            if not np.array_equal(mine, its):
                i = tuple(np.argwhere(mine != its)[0].tolist())
                at = f"{name}[{', '.join(map(str, i))}]" if i else name
                yield f"the model's{of} is {ours} with {at} = {mine[i]}, the environment's has {its[i]} there"
    else:
        yield f"the model's{of} is {ours}, the environment's {theirs}"
