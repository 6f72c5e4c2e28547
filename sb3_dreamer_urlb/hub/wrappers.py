"""The wrappers of an environment as a model card shows them."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.envs.wrappers import Around, put_around
from sb3_dreamer_urlb.hub.privacy import plain_for_everybody
from sb3_dreamer_urlb.snapshots import values


def wrappers_of(env: VecEnv) -> list[str]:
    """As calls, innermost first; ``...`` stands for arguments that are no plain values, or that nobody recorded.

    :param env: that the model learnt in
    """
    return [_as_call(each) for each in put_around(env)]


def _as_call(wrapper: Around) -> str:
    if wrapper.kwargs is None:
        return f"{wrapper.kind}(env, ...)"
    told = [f"{name}={_shown(value)}" for name, value in wrapper.kwargs.items()]
    return f"{wrapper.kind}({', '.join(['env', *told])})"


def _shown(value: Any) -> str:
    if isinstance(value, dict) and all(isinstance(one, str | int | float | None) for one in value.values()):
        return repr(plain_for_everybody(value))
    plain = values.encode_or_describe(value)
    return repr(plain_for_everybody(plain)) if isinstance(plain, str | int | float | list | None) else "..."
