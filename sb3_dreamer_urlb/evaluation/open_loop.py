"""What the world model expects to see: it watches a few observations, then follows the actions with its eyes shut."""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.spaces.observations import DictObservations, Images, Observations
from sb3_dreamer_urlb.types import LatentState, Observation, batch_size, map_observation


@th.no_grad()
def predict_open_loop(
    policy: DreamerPolicy, seen: Observation, actions: np.ndarray, start: int, context: int, steps: int
) -> tuple[Observation, Observation]:
    """Truth and prediction of a part of one episode, see :func:`dream`: both preprocessed, float (context + steps, …)."""
    truth, features = dream(policy, seen, actions, start, context, steps)
    return truth, policy.agent.world_model.decoder(features)


@th.no_grad()
def dream(
    policy: DreamerPolicy, seen: Observation, actions: np.ndarray, start: int, context: int, steps: int
) -> tuple[Observation, th.Tensor]:
    """A part of one episode, and the model's features of it. Draws from torch's global generator.

    :param policy: whose world model predicts
    :param seen: the episode's observations as the policy takes them (images channels first), (n, …)
    :param actions: as the environment received them, (n − 1, …)
    :param start: first observation that the model sees
    :param context: observations that it sees
    :param steps: observations that it predicts after them, fewer where the episode ends
    :return: the truth, preprocessed, float (context + steps, …), and the features, float (context + steps, F)
    :raises ValueError: if the episode has no observation after the context, or for numbers that make no sense
    """
    check_integer("start", start, 0)
    check_integer("context", context, 1)
    check_integer("steps", steps, 1)
    model, device = policy.agent.world_model, policy.device
    end = min(start + context + steps, batch_size(seen))
    if end <= start + context:
        raise ValueError(f"Observations {start} to {start + context} are to be seen, the episode has {batch_size(seen)}.")
    truth = model.preprocess(map_observation(lambda part: part[start:end].to(device), seen))
    scaled = policy.actions.from_env(actions)
    # Row t holds the action that led to observation t.
    led = np.concatenate([np.zeros_like(scaled[:1]), scaled])[start:end].reshape(end - start, -1)
    action = th.as_tensor(led, dtype=th.float32, device=device)
    is_first = th.zeros(1, context, dtype=th.bool, device=device)
    is_first[:, 0] = True
    shown = map_observation(lambda part: part[None, :context], truth)
    posterior = model.observe(shown, action[None, :context], is_first)
    features = list(posterior.feature[0].unbind(0))
    state = LatentState(posterior.state.stoch[:, -1], posterior.state.deter[:, -1])
    for t in range(context, end - start):
        state = model.rssm.prior_step(state, action[None, t])
        features.append(state.feature[0])
    return truth, th.stack(features)


def has_image(observations: Observations) -> bool:
    """Whether there is an image in observations of this kind."""
    parts = observations.parts.values() if isinstance(observations, DictObservations) else [observations]
    return any(isinstance(part, Images) for part in parts)


def image_of(observations: Observations, observation: Observation) -> th.Tensor | None:
    """The image in an observation, of a Dict the first one; None where there is none.

    :param observations: of what kind it is
    :param observation: any form of it
    """
    if isinstance(observations, DictObservations):
        assert isinstance(observation, dict)
        return next((observation[key] for key, part in observations.parts.items() if isinstance(part, Images)), None)
    return observation if isinstance(observations, Images) and isinstance(observation, th.Tensor) else None


def pictures_in(observations: Observations, observation: Observation) -> np.ndarray:
    """The image in preprocessed observations, of Dicts the first one, as :func:`pictures`.

    :param observations: of what kind they are: one with an image in it
    :param observation: float, see :func:`pictures`
    """
    image = image_of(observations, observation)
    assert image is not None
    return pictures(image)


def pictures(image: Observation) -> np.ndarray:
    """Preprocessed images as pictures in colour; of stacked frames the last.

    :param image: float (n, C, height, width) in [-0.5, 0.5]
    :return: uint8 (n, height, width, 3)
    """
    assert isinstance(image, th.Tensor)
    channels = image.shape[1]
    last = image[:, -3:] if channels % 3 == 0 else image[:, -1:].expand(-1, 3, -1, -1)
    shown = (last + 0.5).clamp(0, 1) * 255
    return shown.permute(0, 2, 3, 1).round().to(th.uint8).cpu().numpy()
