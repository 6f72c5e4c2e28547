"""What a model knows about itself, for its card and for programs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.evaluation.agent_rows import changed_arguments
from sb3_dreamer_urlb.hub.algorithms import algorithm_of
from sb3_dreamer_urlb.hub.privacy import plain_for_everybody, without_private_paths
from sb3_dreamer_urlb.hub.wrappers import wrappers_of
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.planning import planner_name
from sb3_dreamer_urlb.snapshots import values
from sb3_dreamer_urlb.snapshots.model_data import describe, needed
from sb3_dreamer_urlb.snapshots.registered import registered_name, registries

FROM_SCRATCH = "none, learnt from scratch"


@dataclass(frozen=True)
class OwnPart:
    """What this package does not have, and a model learnt with.

    :param kind: its class
    :param registered_as: the name it goes by in the model's file; None where no file can hold it
    :param instance: whether what no file can hold was an object of the class
    """

    kind: str
    registered_as: str | None
    instance: bool = False


@dataclass(frozen=True)
class ModelFacts:
    """What the card states, and ``config.json`` in a form for programs.

    :param env_id: of the environment that it was evaluated in
    :param domain: of the task, None where the environment does not tell
    :param method: of exploration in pre-training
    :param phase: that the model is in
    :param pretrained_frames: environment frames of the pre-training, None where the snapshot is too old to know
    :param frames: environment frames of the present phase
    :param action_repeat: frames an agent step
    :param planner: that acts in fine-tuning, or None
    :param seed: None for a run without
    :param command: that made it, None if nobody said
    :param algorithm: name of its class
    :param env_kwargs: what ``gymnasium.make`` was told beside the id, as JSON
    :param wrappers: around the environment, innermost first, as calls
    :param own_parts: by constructor argument, a planner of one's own, say
    """

    env_id: str
    domain: str | None
    method: str
    phase: str
    pretrained_frames: int | None
    frames: int
    action_repeat: int
    planner: str | None
    seed: int | None
    command: str | None
    algorithm: str
    env_kwargs: dict[str, Any]
    wrappers: list[str]
    own_parts: dict[str, OwnPart]


def facts_about(model: AgentAlgorithm, env_id: str, command: str | None, env: VecEnv) -> ModelFacts:
    """What a model knows about itself.

    :param model: trained
    :param env_id: of the environment that it was evaluated in
    :param command: that made it
    :param env: that it was evaluated in
    """
    spec = env_attribute(env, "spec", None)
    reward = model.intrinsic_reward
    name = reward if isinstance(reward, str) else getattr(reward, "__name__", type(reward).__name__)
    exploring = model.phase == PRETRAINING
    known = exploring or reward is None or model.pretrained_frames > 0
    return ModelFacts(
        env_id=env_id,
        domain=model.domain,
        method=FROM_SCRATCH if reward is None else name,
        phase=model.phase,
        pretrained_frames=(model.phase_frames if exploring else model.pretrained_frames) if known else None,
        frames=model.phase_frames,
        action_repeat=model.action_repeat,
        planner=planner_name(getattr(model, "planner", None)),
        seed=model.seed,
        command=None if command is None else without_private_paths(command),
        algorithm=algorithm_of(model).name,
        env_kwargs={} if spec is None or spec.id != env_id else environment_arguments(spec),
        wrappers=wrappers_of(model.get_env() or env),
        own_parts=own_parts(model),
    )


def environment_arguments(spec: EnvSpec) -> dict[str, Any]:
    """What somebody else must tell ``gymnasium.make`` beside the id; not how to draw it.

    :param spec: of the environment
    :return: as JSON
    """
    found: dict[str, Any] = plain_for_everybody(changed_arguments(spec))
    return found


def own_parts(model: AgentAlgorithm) -> dict[str, OwnPart]:
    """By argument, what another machine has not, and needs to load the model.

    :param model: any
    """
    data = describe(model, None)
    stored = {"policy": data["policy"], **data["arguments"]}
    customs = {name: values.contains_custom(values.decode(stored[name])) for name in needed(data) if name in stored}
    found = {name: OwnPart(its.description, None, its.instance) for name, its in customs.items() if its is not None}
    for argument, registry in registries().items():
        name = registered_name(stored.get(argument))
        kind = None if name is None else registry.kinds.get(name)
        if kind is not None and not kind.__module__.startswith("sb3_dreamer_urlb."):
            found[argument] = OwnPart(f"{kind.__module__}.{kind.__qualname__}", name)
    return found
