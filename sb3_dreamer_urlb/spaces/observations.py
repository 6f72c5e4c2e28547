"""What an agent may see: images, vectors, or several of both by name. Made from the observation space.

Each kind knows how to prepare raw observations for the networks, and how well a decoded observation fits. Nobody else looks
at the space itself. Which networks read and predict a kind, ``world_model/encoder.py`` and ``decoder.py`` say.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space, is_image_space_channels_first

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import pixel_ops
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.spaces.choices import classes_of, one_hot_numbers
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError
from sb3_dreamer_urlb.spaces.raw import Observation

IMAGE_SIZES = (16, 512)
#: of the policy, for images that are floats
FLOAT_IMAGES = {"normalize_images": False}


class Observations(ABC):
    """One kind of observation. Raw ones are what the replay holds, any leading shape (…)."""

    #: of spaces that may be meant otherwise, sentences for a warning
    doubts: Sequence[str] = ()
    #: whether there are pictures among them
    has_images = False

    @abstractmethod
    def preprocess(self, raw: Observation) -> Observation:
        """What the networks see and predict, float32 (…)."""

    @abstractmethod
    def losses(self, mean: Observation, target: Observation) -> dict[str, th.Tensor]:
        """Negative log-likelihood of what was seen, summed over an observation, averaged over them: scalars by name.

        :param mean: decoded
        :param target: preprocessed
        """

    def check(self, raw: Observation) -> None:  # noqa: B027 (most kinds take anything)
        """
        :param raw: what somebody handed to ``predict``
        :raises ValueError: if it is no such observation
        """


def _cure(space: spaces.Space[Any]) -> str:
    """What may help where pictures are wanted: wrappers that change the number of sizes are used to other agents."""
    if isinstance(space, spaces.Box) and len(space.shape) == 2:
        return "A picture has channels, if only one: GrayscaleObservation(env, keep_dim=True)."
    if isinstance(space, spaces.Box) and len(space.shape) == 4:
        return "The model remembers what it saw: leave FrameStackObservation out, or stack channels with SB3's VecFrameStack."
    return (
        'Use "MlpPolicy" for vectors, and VecNormalize(norm_obs=False) for images; for dm_control tasks '
        "gymnasium.make('urlb/<domain>-<task>-v0')."
    )


class Images(Observations):
    """Images, channels first, scaled from the space's bounds to [-0.5, 0.5].

    :param space: uint8 in [0, 255]; any other dtype and finite bounds if images are not to be normalised
    :param normalize_images: as everywhere in SB3: False for images that are floats already
    :raises UnsupportedSpaceError: if it is something else, or has a size the networks do not take
    """

    has_images = True

    def __init__(self, space: spaces.Space[Any], normalize_images: bool = True):
        if not isinstance(space, spaces.Box) or not is_image_space(space, normalized_image=not normalize_images):
            raise UnsupportedSpaceError(
                "CnnPolicy needs image observations: Box(0, 255, (height, width, channels), uint8), or floats, channels "
                f'first, with policy_kwargs={{"normalize_images": False}}, got {space}. {_cure(space)}'
            )
        low, high = float(space.low.min()), float(space.high.max())
        # ±float32.max is how an unbounded space is written by many.
        if not np.isfinite(np.float32(high) - np.float32(low)):
            raise UnsupportedSpaceError(f"Images need finite bounds, got {space}.")
        least, most = IMAGE_SIZES
        # What SB3 did not transpose has its channels last; but uint8 images it did, unless VecTransposeImage(skip=True)
        # said that they have them first, whatever their sizes look like.
        if space.dtype != np.uint8 and not is_image_space_channels_first(space):
            raise UnsupportedSpaceError(
                f"Images must have their channels first (SB3 transposes an environment's uint8 images only), got {space}. "
                "Let the environment put the channels first, or return uint8 in [0, 255]."
            )
        channels, height, width = space.shape
        if not (least <= height <= most and least <= width <= most):
            raise UnsupportedSpaceError(
                f"Images must be {least} to {most} pixels high and wide, got {height}×{width} in {space} (channels first)."
            )
        self.shape = (channels, height, width)
        self.low, self.range = low, high - low
        self.dtype = th.uint8 if space.dtype == np.uint8 else None

    def preprocess(self, raw: Observation) -> Observation:
        assert isinstance(raw, th.Tensor)
        if native.active() and raw.dtype == th.uint8 and raw.device.type == "cpu" and raw.dim() > 3 and self.low == 0:
            its: th.Tensor = pixel_ops.scale_images(_channels_somewhere(raw.flatten(0, -4)), self.range)
            return its.view(raw.shape)
        image = raw if raw.dtype == th.uint8 else raw.to(th.float32)
        if image.dim() > 3:
            # Channels last in memory, as convolutions like it; cheapest while a pixel is a byte.
            image = image.flatten(0, -4).contiguous(memory_format=th.channels_last).view(image.shape)
        return th.div(image if self.low == 0 else image - self.low, self.range).sub_(0.5)

    def losses(self, mean: Observation, target: Observation) -> dict[str, th.Tensor]:
        assert isinstance(mean, th.Tensor) and isinstance(target, th.Tensor)
        return {"image_loss": distributions.image_nll(mean, target)}

    def check(self, raw: Observation) -> None:
        assert isinstance(raw, th.Tensor)
        if self.dtype is not None and raw.dtype != self.dtype:
            raise ValueError(f"Images must be uint8 in [0, 255], got {raw.dtype}.")
        if self.dtype is None and raw.dtype == th.uint8:
            high = self.low + self.range
            raise ValueError(f"Images must be numbers in [{self.low:g}, {high:g}], as the environment gives them, got uint8.")


def _channels_somewhere(image: th.Tensor) -> th.Tensor:
    """Contiguous, with channels first or last."""
    return image if image.is_contiguous(memory_format=th.channels_last) else image.contiguous()


class Vectors(Observations):
    """Anything that flattens to a vector."""

    #: of the flattened vector
    size: int

    def losses(self, mean: Observation, target: Observation) -> dict[str, th.Tensor]:
        assert isinstance(mean, th.Tensor) and isinstance(target, th.Tensor)
        return {"vector_loss": distributions.unit_normal_nll(mean, target).sum(-1).mean()}


class Numbers(Vectors):
    """Numbers as they are (Box, MultiBinary); uint8 images divided by 255, as SB3 does.

    :param space: Box or MultiBinary
    :param normalize_images: divide images
    :raises UnsupportedSpaceError: if there are none
    """

    def __init__(self, space: spaces.Space[Any], normalize_images: bool = True):
        assert space.shape is not None
        self.shape = space.shape
        self.size = int(np.prod(self.shape))
        if self.size == 0:
            raise UnsupportedSpaceError(f"The observation space holds no number: {space}.")
        self.scale = 255.0 if normalize_images and is_image_space(space) else 1.0
        for kwargs in ({}, FLOAT_IMAGES):
            if _is_image(space, **kwargs):
                how = f" and policy_kwargs={kwargs}" if kwargs else ""
                self.doubts = [f'{_not_as_image("The observation", space)} Use "CnnPolicy"{how} for images.']
                break

    def preprocess(self, raw: Observation) -> Observation:
        assert isinstance(raw, th.Tensor)
        lead = raw.shape[: raw.dim() - len(self.shape)]
        return raw.to(th.float32).reshape(*lead, self.size) / self.scale


class Classes(Vectors):
    """Discrete and MultiDiscrete: one-hot vectors, one after the other.

    :param space: Discrete or MultiDiscrete
    :param normalize_images: unused, every kind of vector is made with it
    :raises UnsupportedSpaceError: for MultiDiscrete of several dimensions, which SB3's ``predict`` does not take
    """

    def __init__(self, space: spaces.Space[Any], normalize_images: bool = True):
        assert isinstance(space, (spaces.Discrete, spaces.MultiDiscrete)) and space.shape is not None
        if len(space.shape) > 1:
            raise UnsupportedSpaceError(f"SB3 takes MultiDiscrete observations of one dimension only, got {space}.")
        self.shape = space.shape
        self.classes = classes_of(space)
        self.start: list[int] = np.broadcast_to(space.start, self.shape).flatten().tolist()
        self.size = sum(self.classes)

    def preprocess(self, raw: Observation) -> Observation:
        assert isinstance(raw, th.Tensor)
        lead = raw.shape[: raw.dim() - len(self.shape)]
        numbers = raw.reshape(*lead, len(self.classes)).long()
        return one_hot_numbers(numbers, self.classes, self.start)


#: what each space is to ``MlpPolicy``
VECTORS: dict[type[spaces.Space[Any]], type[Numbers] | type[Classes]] = {
    spaces.Box: Numbers,
    spaces.MultiBinary: Numbers,
    spaces.Discrete: Classes,
    spaces.MultiDiscrete: Classes,
}


def vectors(space: spaces.Space[Any], normalize_images: bool = True) -> Vectors:
    """The kind of an observation space that is flattened.

    :param space: of the environment
    :param normalize_images: divide uint8 images by 255
    :raises UnsupportedSpaceError: if it cannot be flattened
    """
    for known, kind in VECTORS.items():
        if isinstance(space, known):
            return kind(space, normalize_images)
    names = ", ".join(known.__name__ for known in VECTORS)
    raise UnsupportedSpaceError(f"MlpPolicy needs one of the observation spaces {names}, got {space}.")


def _is_image(space: spaces.Space[Any], normalize_images: bool = True) -> bool:
    """Whether ``CnnPolicy`` takes it."""
    try:
        Images(space, normalize_images)
    except UnsupportedSpaceError:
        return False
    return True


def _not_as_image(what: str, space: spaces.Space[Any]) -> str:
    return f"{what} is seen as a vector of {int(np.prod(space.shape or ()))} numbers, not as an image: {space}."


def _may_be_meant_as_image(space: spaces.Space[Any]) -> bool:
    """Pixels in a shape that Stable-Baselines3 takes for no image, or numbers in an image's shape."""
    if not isinstance(space, spaces.Box):
        return False
    if space.dtype == np.uint8:
        return len(space.shape) > 1 and bool((space.low == 0).all() and (space.high == 255).all())
    sides = sorted(space.shape)
    return len(sides) == 3 and min(space.shape[0], space.shape[2]) in (1, 3, 4) and sides[1] >= IMAGE_SIZES[0]


class DictObservations(Observations):
    """Several observations by name. Embeddings are concatenated, losses of one kind are summed.

    :param space: Dict of images and of what :func:`vectors` takes
    :param normalize_images: see :class:`Images`
    :raises UnsupportedSpaceError: for another space, or if one of its spaces does not fit
    """

    def __init__(self, space: spaces.Space[Any], normalize_images: bool = True):
        if not isinstance(space, spaces.Dict) or len(space.spaces) == 0:
            raise UnsupportedSpaceError(
                f'MultiInputPolicy needs a Dict of observations, got {space}. Use "CnnPolicy" for images, '
                '"MlpPolicy" for vectors.'
            )
        self.parts: dict[str, Observations] = {}
        self.doubts = doubts = []
        for key, part in space.spaces.items():
            image = is_image_space(part, normalized_image=not normalize_images)
            if not image and _may_be_meant_as_image(part):
                doubts.append(
                    f"{_not_as_image(f'Observation {key!r}', part)} Images are Box(0, 255, (height, width, channels), uint8), "
                    f"or floats, channels first, with policy_kwargs={FLOAT_IMAGES}."
                )
            try:
                self.parts[key] = Images(part, normalize_images) if image else vectors(part, normalize_images)
            except UnsupportedSpaceError as error:
                raise UnsupportedSpaceError(f"Observation {key!r}: {error}") from error
        self.has_images = any(part.has_images for part in self.parts.values())

    def preprocess(self, raw: Observation) -> Observation:
        assert isinstance(raw, dict)
        prepared: dict[str, th.Tensor] = {}
        for key, part in self.parts.items():
            prepared[key] = part.preprocess(raw[key])  # type: ignore[assignment]
        return prepared

    def losses(self, mean: Observation, target: Observation) -> dict[str, th.Tensor]:
        assert isinstance(mean, dict) and isinstance(target, dict)
        total: dict[str, th.Tensor] = {}
        for key, part in self.parts.items():
            for name, loss in part.losses(mean[key], target[key]).items():
                total[name] = total[name] + loss if name in total else loss
        return total

    def check(self, raw: Observation) -> None:
        assert isinstance(raw, dict)
        missing = sorted(set(self.parts) - set(raw))
        if missing:
            raise ValueError(f"The observation lacks {missing}; it has {sorted(raw)}.")
        for key, part in self.parts.items():
            part.check(raw[key])
