"""The acting step as a file that needs neither this package nor Python: TorchScript, or ONNX.

One step of ``predict(deterministic=True)``: encode the observation, one posterior step, the actor's most likely action. What
``predict`` keeps in ``state`` and draws from a generator are inputs and outputs here, so the file itself remembers nothing.
"""

from __future__ import annotations

import copy
import importlib.util
import logging
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.folders import check_file, made_folder
from sb3_dreamer_urlb.spaces.observations import DictObservations
from sb3_dreamer_urlb.types import LatentState, Observation
from sb3_dreamer_urlb.version import how_to_install

#: what follows the observations, in this order
MEMORY = ("stoch", "deter", "last_action", "is_first", "uniforms")
OUTPUTS = ("action", "next_stoch", "next_deter", "next_last_action")
#: what ``torch.onnx`` writes with
ONNX_PACKAGES = ("onnx", "onnxscript")
#: the least in which it writes every operator used here
OPSET = 18


class ActingStep(nn.Module):
    """Observation, memory and uniform numbers → action and memory, a copy of what the policy does now.

    Inputs, all with leading n, named in :attr:`input_names`:

    - observations as the policy's space has them (images channels first, before scaling): ``observation``, or
      ``observation_<name>`` for each of a Dict, in the space's order
    - ``stoch`` (n, S·K), ``deter`` (n, D), ``last_action`` (n, A), float: what the last step gave; zeros at the beginning
    - ``is_first``, bool (n,): an episode begins, the memory is forgotten
    - ``uniforms``, float (n, S) in [0, 1): one for each categorical of the posterior, which is drawn by inverting its
      cumulative distribution. Any will do; those of ``predict`` come from :meth:`uniforms`

    Outputs, named in :data:`OUTPUTS`: the action in the environment's space, (n, …), and the next ``stoch``, ``deter`` and
    ``last_action``.

    It stands on the CPU, wherever the policy is, so that files run anywhere.

    :param policy: acts with its actor, and follows a fixed skill if any
    :raises ValueError: for what is no policy of DreamerV2's, or if something else acts: a planner, random actions, or skills
        that change
    """

    def __init__(self, policy: DreamerPolicy):
        super().__init__()
        if not isinstance(policy, DreamerPolicy):
            kind = f"{type(policy).__module__}.{type(policy).__qualname__}"
            raise ValueError(f"ActingStep exports a policy of DreamerV2's, model.policy of a DreamerV2; got {kind}.")
        if policy.planner is not None:
            raise ValueError(
                "The exported step acts with the actor, but this policy has a planner, which is not exported: take one "
                "without it, DreamerV2.load(path, planner=None)."
            )
        agent = policy.agent
        if agent.acts_randomly():
            raise ValueError("This policy explores with random actions: there is nothing to export before fine_tune().")
        if agent.skills is not None and not agent.skills.is_fixed:
            raise ValueError("This policy still follows changing skills: export it when fine-tuning has chosen one.")
        self._policy = [policy]  # in a list, so that torch does not take its weights for ours
        self.world_model = _frozen(agent.world_model)
        # Only the encoder and the RSSM are run.
        self.world_model.decoder, self.world_model.reward = nn.Identity(), nn.Identity()
        self.world_model.discount_logit = None
        self.actor = _frozen(agent.actor)
        self.to_space = _ToSpace(policy.action_space)
        self.skill: th.Tensor | None
        self.register_buffer("skill", None if agent.skills is None else agent.skills.sample(1, None).cpu())
        parts = policy.observations.parts if isinstance(policy.observations, DictObservations) else None
        self.keys = None if parts is None else tuple(parts)
        names = ["observation"] if self.keys is None else [f"observation_{key}" for key in self.keys]
        self.input_names = (*names, *MEMORY)

    def forward(self, *inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor, th.Tensor, th.Tensor]:
        """One step; see the class for inputs and outputs."""
        *seen, stoch, deter, last_action, is_first, uniforms = inputs
        observation: Observation = seen[0] if self.keys is None else dict(zip(self.keys, seen, strict=True))
        model = self.world_model
        embed = model.encoder(model.preprocess(observation))
        logits, deter = model.rssm.posterior(LatentState(stoch, deter), last_action, embed, is_first)
        latent = LatentState(_draw(logits, uniforms), deter)
        skill = None if self.skill is None else self.skill.expand(deter.shape[0], -1)
        action = self.actor(latent.feature, skill).mode
        return self.to_space(action), latent.stoch, latent.deter, action

    def initial(self, n: int = 1) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
        """``stoch``, ``deter`` and ``last_action`` of n agents that have seen nothing yet: zeros."""
        latent = self.world_model.rssm.initial(n)
        return latent.stoch, latent.deter, latent.deter.new_zeros(n, self.actor.action_size)

    def uniforms(self, steps: Sequence[int] | np.ndarray) -> th.Tensor:
        """What ``predict(deterministic=True)`` draws from, float (n, S).

        :param steps: observations since each environment's episode began, 0 at its first
        """
        (policy,) = self._policy
        counts = np.asarray(steps, np.int64).reshape(-1)
        variables, _ = self.world_model.rssm.logits_shape
        generator = policy._generator_of((counts,), np.zeros(len(counts), bool))
        return th.rand((len(counts), variables), generator=generator, device=policy.device).cpu()

    def example(self, n: int = 2) -> tuple[th.Tensor, ...]:
        """Inputs of the right shapes and types, one environment a row."""
        (policy,) = self._policy
        space = policy.observation_space
        seen = [space] if self.keys is None else [space.spaces[key] for key in self.keys]  # type: ignore[attr-defined]
        observations = [_example_of(part, n) for part in seen]
        return (*observations, *self.initial(n), th.ones(n, dtype=th.bool), self.uniforms([0] * n))


class _ToSpace(nn.Module):
    """From the agent's actions, (n, A), to the action space's, (n, …): what ``Actions.to_env`` does, in torch.

    :param space: Box, Discrete or MultiDiscrete
    """

    low: th.Tensor
    high: th.Tensor
    range: th.Tensor
    start: th.Tensor

    def __init__(self, space: spaces.Space[Any]):
        super().__init__()
        assert space.shape is not None and space.dtype is not None
        self.shape, self.dtype = space.shape, _torch_dtype(space.dtype)
        self.classes: tuple[int, ...] | None = None
        if isinstance(space, spaces.Box):
            wide = space.low.dtype if space.low.dtype.kind == "f" else np.dtype(np.float64)
            low, high = th.as_tensor(space.low.astype(wide)), th.as_tensor(space.high.astype(wide))
            self.register_buffer("low", low)
            self.register_buffer("high", high)
            self.register_buffer("range", high - low)
            self.rounds = np.issubdtype(space.dtype, np.integer)
        else:
            assert isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
            counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
            self.classes = tuple(np.atleast_1d(counts).flatten().tolist())
            self.register_buffer("start", th.as_tensor(np.asarray(space.start)))

    def forward(self, action: th.Tensor) -> th.Tensor:
        if self.classes is not None:
            chosen = th.stack([part.argmax(-1) for part in action.split(self.classes, -1)], -1)
            return (chosen.reshape(-1, *self.shape) + self.start).to(self.dtype)
        scaled = self.low + 0.5 * (action.reshape(-1, *self.shape) + 1.0) * self.range
        if self.rounds:
            scaled = scaled.round()
        return th.minimum(th.maximum(scaled, self.low), self.high).to(self.dtype)


def _draw(logits: th.Tensor, uniforms: th.Tensor) -> th.Tensor:
    """One-hot draws, (n, S·K), as ``distributions.draw_classes`` makes them, in operators that every format has."""
    cdf = logits.softmax(-1).cumsum(-1)
    below = (cdf <= uniforms.unsqueeze(-1) * cdf[..., -1:]).sum(-1).clamp(max=cdf.shape[-1] - 1)
    classes = th.arange(cdf.shape[-1], device=cdf.device)
    return (below.unsqueeze(-1) == classes).to(logits.dtype).flatten(-2)


def _frozen(module: Any) -> Any:
    return copy.deepcopy(module).cpu().eval().requires_grad_(False)


def _torch_dtype(dtype: Any) -> th.dtype:
    return th.as_tensor(np.zeros((), dtype)).dtype


def _example_of(space: spaces.Space[Any], n: int) -> th.Tensor:
    """Valid observations: the first class, or the lowest number."""
    assert space.shape is not None
    if isinstance(space, spaces.Discrete | spaces.MultiDiscrete):
        value = np.broadcast_to(np.asarray(space.start), space.shape)
    else:
        value = np.zeros(space.shape)
    return th.as_tensor(np.stack([value.astype(space.dtype)] * n))


def _check_step(step: ActingStep) -> None:
    """:raises ValueError: for a model or a policy in its place"""
    if not isinstance(step, ActingStep):
        raise ValueError(f"step must be an ActingStep(model.policy) of a DreamerV2, got {type(step).__qualname__}.")


def to_torchscript(step: ActingStep, path: str | os.PathLike[str]) -> None:
    """Write a step for ``torch.jit.load``, in Python or C++.

    :param step: what to write
    :param path: of the file, taken as it is; missing folders are made
    :raises ValueError: for anything else
    :raises OSError: if a folder has its name
    """
    _check_step(step)
    path = _file_to_write(path)
    with th.no_grad(), warnings.catch_warnings():
        # Branches on sizes choose the fastest of equal ways; and torch says that it will one day write another format.
        warnings.simplefilter("ignore", th.jit.TracerWarning)  # type: ignore[attr-defined]
        warnings.simplefilter("ignore", DeprecationWarning)
        th.jit.trace(step, step.example(), check_trace=False).save(path)


def _file_to_write(path: str | os.PathLike[str]) -> str:
    check_file("path", path)
    made_folder("the folder of path", Path(path).parent)
    return os.fspath(path)


@contextmanager
def _exporter_without_remarks() -> Iterator[None]:
    """Torch's exporter warns of itself, and logs which operators of torchvision, needless here, it does not find."""
    registration = logging.getLogger("torch.onnx._internal.exporter._registration")
    before = registration.level
    registration.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        registration.setLevel(before)


def to_onnx(step: ActingStep, path: str | os.PathLike[str]) -> None:
    """Write a step for ONNX runtimes, weights in the same file; any number of environments.

    :param step: what to write
    :param path: of the file, taken as it is; missing folders are made
    :raises ImportError: without the extra ``export``
    :raises ValueError: for anything else
    :raises OSError: if a folder has its name
    """
    _check_step(step)
    if missing := [name for name in ONNX_PACKAGES if importlib.util.find_spec(name) is None]:
        raise ImportError(f"Writing ONNX needs {' and '.join(missing)}; {how_to_install('export')}.")
    path = _file_to_write(path)
    example = step.example()
    batch = th.export.Dim("n")
    with th.no_grad(), _exporter_without_remarks():
        th.onnx.export(
            step,
            example,
            path,
            input_names=list(step.input_names),
            output_names=list(OUTPUTS),
            opset_version=OPSET,
            dynamo=True,
            # One tuple, because the inputs are *inputs.
            dynamic_shapes=(tuple({0: batch} for _ in example),),
            external_data=False,
            verbose=False,
        )
