"""The state of every source of randomness of a model: torch, numpy, python, sampler of the replay, action space."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import torch as th

from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm


def generator_state(generator: np.random.Generator) -> dict[str, Any]:
    """Of numpy's own kind of generator, as JSON."""
    state: dict[str, Any] = _plain(dict(generator.bit_generator.state))
    return state


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else value


def capture(model: SavedAlgorithm) -> dict[str, Any]:
    """All states, as JSON."""
    version, internal, gauss = random.getstate()
    return {
        "torch": th.get_rng_state().numpy().tobytes().hex(),
        "cuda": th.cuda.get_rng_state(model.device).numpy().tobytes().hex() if model.device.type == "cuda" else None,
        "numpy": _plain(np.random.get_state(legacy=False)),  # noqa: NPY002  (SB3 draws from the global one)
        "python": [version, list(internal), gauss],
        # Who only wants to save may have dropped the replay.
        "sampler": None if (buffer := getattr(model, "replay_buffer", None)) is None else generator_state(buffer.rng),
        "action_space": generator_state(model.action_space.np_random),
    }


class RandomStates:
    """States read from a file: all tried on throw-away generators first, then set all together.

    :param states: what :func:`capture` gave
    :raises ValueError: if they fit no generator of this machine
    """

    def __init__(self, states: dict[str, Any]):
        names = {"torch", "cuda", "numpy", "python", "sampler", "action_space"}
        if not isinstance(states, dict) or set(states) != names:
            raise ValueError("its random states are damaged")
        self.torch = _bytes(states["torch"])
        self.cuda = None if states["cuda"] is None else _bytes(states["cuda"])
        self.numpy = states["numpy"]
        version, internal, gauss = states["python"]
        self.python = (version, tuple(internal), gauss)
        self.sampler, self.action_space = states["sampler"], states["action_space"]
        self._try()

    def _try(self) -> None:
        th.Generator().set_state(self.torch)
        random.Random().setstate(self.python)
        state = self.numpy["state"]
        # numpy takes any position and would read beyond its memory.
        if type(state["pos"]) is not int or not 0 <= state["pos"] <= 624 or len(state["key"]) != 624:
            raise ValueError("its random states are damaged")
        np.random.RandomState().set_state(self.numpy)
        set_generator(np.random.default_rng(), self.action_space)
        if self.sampler is not None:
            set_generator(np.random.default_rng(), self.sampler)

    def apply(self, model: SavedAlgorithm) -> None:
        """Set the global generators, and the model's."""
        th.set_rng_state(self.torch)
        if self.cuda is not None and model.device.type == "cuda":
            th.cuda.set_rng_state(self.cuda, model.device)
        np.random.set_state(self.numpy)  # noqa: NPY002
        random.setstate(self.python)
        if self.sampler is not None:
            set_generator(model.replay_buffer.rng, self.sampler)
        set_generator(model.action_space.np_random, self.action_space)


def set_generator(generator: np.random.Generator, state: Any) -> None:
    """Set numpy's own kind of generator, PCG64.

    :raises ValueError: if the state is not one of such a generator
    """
    kind = type(generator.bit_generator).__name__
    if kind != "PCG64" or not isinstance(state, dict) or state.get("bit_generator") != kind:
        raise ValueError("its random states are of another kind of generator")
    generator.bit_generator.state = state


def _bytes(text: Any) -> th.Tensor:
    return th.frombuffer(bytearray(bytes.fromhex(text)), dtype=th.uint8)
