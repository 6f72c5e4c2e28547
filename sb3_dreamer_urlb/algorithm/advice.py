"""What works, and is most likely not meant: warnings when a model is made, given an environment, trained or fine-tuned."""

from __future__ import annotations

import warnings
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space

from sb3_dreamer_urlb.envs.env_steps import is_fault
from sb3_dreamer_urlb.envs.facts import steps_an_episode
from sb3_dreamer_urlb.envs.info_keys import TRUNCATED
from sb3_dreamer_urlb.replay.episode_buffer import MAX_EPISODE_ROWS

#: what presets are made for
IMAGES, VECTORS = "images", "vectors"


class NoUpdateWarning(UserWarning):
    """Networks stay as fresh as they began, or are transferred so: who means it can filter this."""


def warn_if_nothing_was_learnt(model: Any) -> None:
    """Where a fine-tuning begins with networks that are as fresh as new ones.

    :param model: that leaves its pre-training
    """
    if model._n_updates == 0:
        warnings.warn(
            f"fine_tune() keeps what a pre-training has learnt, and this one has had no update in {model.phase_frames} "
            "frames: load a pre-trained snapshot, or learn() first.",
            NoUpdateWarning,
        )


def warn_if_no_episode_fits(model: Any) -> None:
    """Where the replay is smaller than an episode, it never holds more than a piece of one.

    :param model: with its arguments and its environments
    """
    steps = steps_an_episode(model.env)
    pieces = model.replay_buffer_kwargs.get("max_episode_rows", MAX_EPISODE_ROWS)
    # An episode has one row more than steps: the reset's.
    if steps is not None and min(steps + 1, pieces) > model.buffer_size:
        warnings.warn(
            f"buffer_size={model.buffer_size} holds no whole episode, only the last rows of one: the environment's have up to "
            f"{steps} steps, which are {steps + 1} rows."
        )


def warn_if_ends_go_unheeded(dones: np.ndarray, infos: list[dict[str, Any]]) -> None:
    """Where an episode terminates, and the agent learns nothing of ends.

    :param dones: of a step, (n_envs,)
    :param infos: of the same
    """
    if any(done and not (info.get(TRUNCATED, False) or is_fault(info)) for done, info in zip(dones, infos, strict=True)):
        warnings.warn(
            "The environment ended an episode before its time limit, and the agent has no discount head: to it nothing is "
            "lost by that. Make it with discount_head=True; without, it takes what its first environment says, here "
            "never_terminates=True."
        )


def warn_of_hidden_rewards(phase: str) -> None:
    """Where an agent learns a task's reward in an environment that was made to hide it.

    :param phase: name of the phase
    """
    warnings.warn(
        f"The environment was made with reward_free=True and pays 0 always, and the agent learns its reward in {phase}: make "
        "one without for that."
    )


def warn_if_pictures_are_black(seen: Any, space: spaces.Space[Any]) -> None:
    """Where an environment gives numbers in [0, 1] as bytes, whose white is 255.

    :param seen: observations of all environments, (n_envs, …), or such by name
    :param space: of one; a Box of bytes up to 1 says what it holds
    """
    its = space.spaces if isinstance(space, spaces.Dict) else {None: space}
    for name, one in its.items():
        part = seen if name is None else seen[name]
        if is_image_space(one) and np.asarray(part).max() <= 1:
            what = "The observation" if name is None else f"Observation {name!r}"
            warnings.warn(
                f"{what} is a picture of uint8 with no number above 1: it is black to the agent. White is 255; numbers in "
                "[0, 1] are multiplied by it, or belong to a Box of float32, channels first, with "
                'policy_kwargs={"normalize_images": False}.'
            )


def warn_of_preset(preset: str, made_for: Mapping[str, Collection[str]], sees_images: bool) -> None:
    """Where a preset's numbers were found for something else than the agent sees.

    :param preset: its name
    :param made_for: names of presets, and what each is made for; those for everything are not among them
    :param sees_images: whether the agent does
    """
    seen = IMAGES if sees_images else VECTORS
    if seen not in made_for.get(preset, (seen,)):
        others = ", ".join(repr(name) for name, what in made_for.items() if seen in what)
        warnings.warn(
            f"preset={preset!r} is made for {' and '.join(made_for[preset])}, and this agent sees {seen}. "
            f"Made for {seen}: {others}."
        )
