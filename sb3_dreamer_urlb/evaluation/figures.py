"""Pictures of a run: learning curve, open-loop prediction, the agent at work. Needs the extra ``plots``."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch as th

from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.evaluation.films import labelled_open_loop, truth_model_error
from sb3_dreamer_urlb.evaluation.gifs import encode_gif
from sb3_dreamer_urlb.evaluation.open_loop import dream, has_image, pictures_in, predict_open_loop
from sb3_dreamer_urlb.evaluation.protocol import PlayedEpisode
from sb3_dreamer_urlb.types import Observation
from sb3_dreamer_urlb.version import how_to_install

MISSING_PLOTS = f"Pictures need matplotlib and pillow; {how_to_install('plots')}."
__all__ = [
    "CONTEXT",
    "CurvePoint",
    "check_plots_installed",
    "labelled_open_loop",
    "learning_curve",
    "open_loop",
    "open_loop_errors",
    "truth_model_error",
    "write_gif",
]
CONTEXT = 5  # observations the model sees before it predicts on its own


def check_plots_installed() -> None:
    """
    :raises ImportError: if the extra ``plots`` is not installed, saying how to install it
    """
    try:
        import matplotlib  # noqa: F401
        import PIL  # noqa: F401
    except ImportError as error:
        raise ImportError(MISSING_PLOTS) from error


@dataclass
class CurvePoint:
    """Return of one training episode.

    :param frames: environment frames since the run began
    :param phase: in which it was played
    :param episode_return: undiscounted
    """

    frames: int
    phase: str
    episode_return: float


def learning_curve(points: Sequence[CurvePoint], levels: dict[str, float], title: str, path: str | os.PathLike[str]) -> None:
    """Episode returns over frames, one colour a phase, with horizontal lines to compare with.

    :param points: the training episodes in their order
    :param levels: label → return of each line
    :param title: above the picture
    :param path: of the PNG
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(7, 4), constrained_layout=True)
    for phase, color in (("pretraining", "tab:gray"), ("finetuning", "tab:blue")):
        chosen = [point for point in points if point.phase == phase]
        axes.plot([p.frames for p in chosen], [p.episode_return for p in chosen], "o-", color=color, label=phase, ms=4)
    for (label, value), style in zip(levels.items(), ("-", "--", ":", "-."), strict=False):
        axes.axhline(value, color="tab:red", linestyle=style, linewidth=1, label=f"{label}: {value:.0f}")
    axes.set(xlabel="environment frames", ylabel="episode return", title=title, ylim=(0, None))
    axes.legend(loc="upper left", fontsize=8)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def open_loop(policy: DreamerPolicy, episode: PlayedEpisode, start: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """What the model thinks happens: it sees a few frames, then only the actions.

    :param policy: whose world model predicts
    :param episode: what really happened
    :param start: first observation that the model sees
    :param steps: predicted steps
    :return: truth and prediction, both uint8 (CONTEXT + steps, height, width, 3); of Dicts the first image
    :raises ValueError: if the agent sees no images, or the episode is too short
    """
    truth, predicted = predict_open_loop(policy, _seen(policy, episode), episode.actions, start, CONTEXT, steps)
    return pictures_in(policy.observations, truth), pictures_in(policy.observations, predicted)


def _seen(policy: DreamerPolicy, episode: PlayedEpisode) -> Observation:
    """An episode's observations as the policy takes them, on its device.

    :raises ValueError: if there is no image in them
    """
    if not has_image(policy.observations):
        raise ValueError(f"Pictures of predictions need an agent that sees images, this one sees {policy.observation_space}.")
    seen: Observation = policy.obs_to_tensor(episode.observations)[0]
    return seen


def open_loop_errors(
    policy: DreamerPolicy, episode: PlayedEpisode, start: int, steps: int, path: str | os.PathLike[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Draw how a prediction grows worse with its horizon, and what it thought of the rewards.

    :param policy: whose world model predicts; before it has learnt a task, its rewards say nothing
    :param episode: what really happened
    :param start: first observation that the model sees
    :param steps: predicted steps
    :param path: of the PNG
    :return: root mean square error of each picture, in grey levels of 255, and the predicted rewards, float (CONTEXT + steps,)
    :raises ValueError: as :func:`open_loop`
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    truth, features = dream(policy, _seen(policy, episode), episode.actions, start, CONTEXT, steps)
    with th.no_grad():
        model = policy.agent.world_model
        predicted, seen = (pictures_in(policy.observations, part) for part in (model.decoder(features), truth))
        difference = (predicted.astype(float) - seen) ** 2
        rewards = model.reward(features).cpu().numpy().reshape(-1)
    errors = np.sqrt(difference.mean((1, 2, 3)))
    shown = np.arange(len(errors)) - CONTEXT + 1
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), constrained_layout=True)
    left.plot(shown, errors, color="tab:blue")
    left.set(xlabel="steps predicted", ylabel="error of the picture (of 255)", ylim=(0, None))
    right.plot(shown, rewards, color="tab:blue", label="predicted")
    if len(episode.rewards):
        # Reward t − 1 came with observation t.
        true = np.concatenate([[0.0], episode.rewards])[start : start + len(errors)]
        right.plot(shown, true, color="black", linewidth=1, label="true")
    right.set(xlabel="steps predicted", ylabel="reward")
    right.legend(fontsize=8)
    for axes in (left, right):
        axes.axvline(0.5, color="grey", linewidth=0.8, linestyle=":")
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return errors, rewards


def write_gif(frames: Sequence[np.ndarray] | np.ndarray, path: str | os.PathLike[str], fps: float, scale: int = 1) -> None:
    """Write an animation.

    :param frames: uint8 (height, width, 3) each
    :param path: of the GIF
    :param fps: frames a second
    :param scale: enlarge each pixel this many times
    """
    Path(path).write_bytes(encode_gif(frames, fps, scale))
