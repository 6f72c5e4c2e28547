"""Builders: from a task's name to an environment. Importing this module imports no dm_control."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from sb3_dreamer_urlb.envs import perturbations as rwrl
from sb3_dreamer_urlb.envs.domain_rewards import DomainRewards, check_domain
from sb3_dreamer_urlb.envs.options import PixelOptions, check_choice, refuse_unknown, refuse_where_nothing_is_drawn
from sb3_dreamer_urlb.envs.perturbations import Perturbations, make_perturbations
from sb3_dreamer_urlb.envs.registration import JACO_VARIANT_TASKS, URLB_TASKS, check_urlb_task, id_meaning, meant_by
from sb3_dreamer_urlb.envs.rendering import load_physics, load_renderer
from sb3_dreamer_urlb.envs.task_names import check_task, names

if TYPE_CHECKING:
    from dm_control import composer
    from dm_control.rl import control

    from sb3_dreamer_urlb.envs.control_env import ControlEnv


def make_named_env(named: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """What ``gymnasium.make`` calls for the ids that name a task.

    :param named: the id
    :param options: what the id says, and those of :func:`make_urlb_env` or, for perturbed ids, :func:`make_rwrl_env`
    :return: as those
    :raises ValueError: for options that contradict the id, and for wrong ones
    """
    meant = meant_by(named)
    is_perturbed = "level" in meant
    known = {"domain": rwrl.LIMBS, "task": ("walk",), "level": rwrl.LEVELS} if is_perturbed else names()
    for option, value in meant.items():
        given = options.setdefault(option, value)
        # What is no name at all is answered by the function that makes it, with the known ones.
        if isinstance(given, str) and given in known[option] and given != value:
            raise ValueError(
                f"{option}={given!r} contradicts the id {named}, whose {option} is {value!r}: leave it out, "
                f"or make {id_meaning({**meant, option: given}) or 'urlb/dm_control-v0, which takes domain and task'}"
            )
    return (make_rwrl_env if is_perturbed else make_dmc_env)(**options)


def make_urlb_env(
    domain: str,
    task: str,
    *,
    image_size: int = 64,
    action_repeat: int = 2,
    camera: int | str | None = None,
    reward_free: bool = False,
    fast_render: bool = False,
    render_mode: str | None = None,
    render_size: int = 256,
    observation: str = "pixels",
    perturbations: Perturbations | Mapping[str, Any] | None = None,
    domain_rewards: bool = False,
    **unknown: Any,
) -> gymnasium.Env[Any, Any]:
    """One of the twelve tasks of the benchmark. The defaults are the paper's ("Mastering the Unsupervised Reinforcement
    Learning Benchmark from Pixels", ICML 2023).

    :param domain: ``walker``, ``quadruped`` or ``jaco``
    :param task: a task of that domain, see ``URLB_TASKS``
    :param image_size: height and width of the observations in pixels
    :param action_repeat: control steps an action is held for
    :param camera: a camera's id or name; None for 2 in the quadruped (``y``), else 0 (``side``, ``front_close``)
    :param reward_free: return a reward of 0.0 and keep the task's in ``info["task_reward"]``
    :param fast_render: smaller shadow map: faster, not pixel-identical
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param render_size: height and width of what ``render()`` returns
    :param observation: ``"pixels"``, ``"state"`` or ``"both"``
    :param perturbations: of the Real-World RL suite, or their arguments by name; see
        :class:`~sb3_dreamer_urlb.envs.perturbations.Perturbations`
    :param domain_rewards: tell what each task of the domain would have paid, in ``info["domain_rewards"]``, task → reward,
        without any delay; walker and quadruped only
    :param unknown: options that there are not
    :return: observations uint8 (image_size, image_size, 3), or float32 (N,) for ``"state"``, or a Dict of both,
        ``"image"`` and ``"state"``; actions float32 (A,) in [-1, 1]. See
        :class:`~sb3_dreamer_urlb.envs.control_env.ControlEnv`, for the options
        :class:`~sb3_dreamer_urlb.envs.options.PixelOptions`
    :raises ValueError: naming a wrong option, its value and what was expected
    :raises RenderingBackendError: if pixels are wanted and MuJoCo cannot render here
    """
    check_urlb_task(domain, task)
    return make_dmc_env(
        domain,
        task,
        image_size=image_size,
        action_repeat=action_repeat,
        camera=camera,
        reward_free=reward_free,
        fast_render=fast_render,
        render_mode=render_mode,
        render_size=render_size,
        observation=observation,
        perturbations=perturbations,
        domain_rewards=domain_rewards,
        **unknown,
    )


def make_dmc_env(
    domain: str = "",
    task: str = "",
    *,
    image_size: int = 64,
    action_repeat: int = 2,
    camera: int | str | None = None,
    reward_free: bool = False,
    fast_render: bool = False,
    render_mode: str | None = None,
    render_size: int = 256,
    observation: str = "pixels",
    perturbations: Perturbations | Mapping[str, Any] | None = None,
    domain_rewards: bool = False,
    **unknown: Any,
) -> gymnasium.Env[Any, Any]:
    """Any task of dm_control's suite, any of ``dm_control.manipulation``, or one of the benchmark's.

    :param domain: a domain of the suite, ``"manipulation"``, or one of the benchmark's
    :param task: a task of that domain, e.g. ``"swingup"`` of ``"cartpole"``, ``"reach_site_vision"`` of ``"manipulation"``
    :param image_size: this and the following as in :func:`make_urlb_env`
    :param action_repeat: control steps an action is held for
    :param camera: a camera's id or name
    :param reward_free: return a reward of 0.0
    :param fast_render: faster, not pixel-identical
    :param render_mode: None, ``"rgb_array"`` or ``"human"``
    :param render_size: height and width of what ``render()`` returns
    :param observation: ``"pixels"``, ``"state"`` or ``"both"``
    :param perturbations: of the Real-World RL suite, or their arguments by name; see
        :class:`~sb3_dreamer_urlb.envs.perturbations.Perturbations`
    :param domain_rewards: tell what each task of the domain would have paid, in ``info["domain_rewards"]``, task → reward,
        without any delay; walker and quadruped only
    :param unknown: options that there are not
    :return: as :func:`make_urlb_env`
    :raises ValueError: naming a wrong option, its value and what was expected
    :raises RenderingBackendError: if pixels are wanted and MuJoCo cannot render here
    """
    refuse_unknown(unknown, "domain", "task", "perturbations", "domain_rewards")
    check_task(domain, task)
    if not isinstance(domain_rewards, bool | np.bool_):
        raise ValueError(f"domain_rewards={domain_rewards!r}: expected True or False")
    if domain_rewards:
        check_domain(domain, task)
    options = PixelOptions(
        image_size=image_size,
        action_repeat=action_repeat,
        camera=_camera(camera, domain, observation, render_mode),
        reward_free=reward_free,
        fast_render=fast_render,
        render_mode=render_mode,
        render_size=render_size,
        observation=observation,
    )
    perturbed_by = make_perturbations(perturbations)
    if perturbed_by is not None:
        perturbed_by.limb(domain)  # before anything is loaded
    make_control = functools.partial(make_control_env, domain, task)
    return _show(options, perturbed_by, domain, task, make_control, domain_rewards)


def make_rwrl_env(
    domain: str,
    task: str = "walk",
    level: str = "easy",
    *,
    hard_thigh: str = "suite",
    keep_buffers: bool = True,
    camera: int | str | None = None,
    **options: Any,
) -> gymnasium.Env[Any, Any]:
    """One of the Real-World RL suite's tasks at one of its levels, as the paper's robustness study uses them (Section
    "Real-World Reinforcement Learning Benchmark"; Appendix "RWRL settings").

    The unperturbed task is dm_control's, but that the quadruped starts upright, as in the suite.

    :param domain: ``walker`` or ``quadruped``
    :param task: ``walk``
    :param level: ``easy``, ``medium`` or ``hard``
    :param hard_thigh: range of the walker's thighs at the level hard: ``"suite"`` from 0.225, ``"paper"`` from 0.15 m; see
        :func:`~sb3_dreamer_urlb.envs.perturbations.level`
    :param keep_buffers: delay buffers survive a reset, as in the suite
    :param camera: a camera's id or name; None as in :func:`make_urlb_env`
    :param options: those of :class:`~sb3_dreamer_urlb.envs.options.PixelOptions`
    :return: as :func:`make_urlb_env`
    :raises ValueError: naming a wrong option, its value and what was expected
    :raises RenderingBackendError: if pixels are wanted and MuJoCo cannot render here
    """
    check_choice("task", task, ("walk",), "the Real-World RL suite's levels are of the task")
    perturbed_by = rwrl.level(domain, level, hard_thigh=hard_thigh, keep_buffers=keep_buffers)
    if options.get("perturbations") is not None:
        raise ValueError(
            f"perturbations={options['perturbations']!r}: the Real-World RL suite's {domain}-{task} is perturbed already, "
            f"by its level {level}; perturb urlb/{domain}-{task}-v0 instead"
        )
    if options.get("domain_rewards"):
        raise ValueError(
            f"domain_rewards={options['domain_rewards']!r}: ids of the Real-World RL suite do not tell them; "
            f"urlb/{domain}-{task}-v0 does, with perturbations={level!r} or others"
        )
    options.pop("perturbations", None)
    options.pop("domain_rewards", None)
    known = {field.name for field in dataclasses.fields(PixelOptions)}
    refuse_unknown(
        {name: value for name, value in options.items() if name not in known},
        *("domain", "task", "level", "hard_thigh", "keep_buffers"),
    )
    shown = PixelOptions(
        camera=_camera(camera, domain, options.get("observation"), options.get("render_mode")),
        **options,
    )
    return _show(shown, perturbed_by, domain, task, functools.partial(_make_rwrl_control, domain))


def _show(
    options: PixelOptions,
    perturbed_by: Perturbations | None,
    domain: str,
    task: str,
    make_control: Callable[[], control.Environment | composer.Environment],
    domain_rewards: bool = False,
) -> gymnasium.Env[Any, Any]:
    """A control environment as an agent sees it.

    :param options: how it is shown
    :param perturbed_by: what is done to it
    :param domain: of the task
    :param task: its name
    :param make_control: makes the bare environment
    :param domain_rewards: tell those of the domain's other tasks, too
    """
    if options.observation != "state":
        load_renderer()  # at once, for the one clear error; states load one when somebody renders them
    control_env = make_control()
    in_window = options.render_mode == "human"
    if in_window:
        options = dataclasses.replace(options, render_mode="rgb_array")
    is_urlb = task in URLB_TASKS.get(domain, ()) or (domain == "jaco" and task in JACO_VARIANT_TASKS)
    env = _kind_of_env(options.observation)(control_env, options, domain=domain, task=task, never_terminates=is_urlb)
    if domain_rewards:
        env.domain_rewards = DomainRewards(domain)
    if perturbed_by is not None:
        from sb3_dreamer_urlb.envs.perturbation_wrapper import perturb

        perturb(env, perturbed_by)
    return gymnasium.wrappers.HumanRendering(env) if in_window else env


def _camera(camera: int | str | None, domain: str, observation: Any, render_mode: Any) -> int | str:
    """The camera that was asked for, or the benchmark's: ``y`` of the quadruped, else the model's first.

    :raises ValueError: if one was asked for where nothing is drawn
    """
    if camera is None:
        return 2 if domain == "quadruped" else 0
    refuse_where_nothing_is_drawn("camera", camera, observation, render_mode)
    return camera


def _make_rwrl_control(domain: str) -> control.Environment:
    """The bare environment of the suite's task walk."""
    load_physics()
    from sb3_dreamer_urlb.envs.urlb_tasks import make_suite_task, make_upright_walk

    return make_upright_walk() if domain == "quadruped" else make_suite_task(domain, "walk")


def _kind_of_env(observation: str) -> type[ControlEnv]:
    """The class for an option ``observation``."""
    from sb3_dreamer_urlb.envs.pixel_env import PixelControlEnv
    from sb3_dreamer_urlb.envs.state_env import PixelAndStateControlEnv, StateControlEnv

    return {"pixels": PixelControlEnv, "state": StateControlEnv, "both": PixelAndStateControlEnv}[observation]


def make_control_env(domain: str, task: str) -> control.Environment | composer.Environment:
    """The bare dm_control environment of a task: without pixels, action repeat or rescaled actions.

    :param domain: as for :func:`make_dmc_env`
    :param task: as for :func:`make_dmc_env`
    :return: unseeded; its class is ``composer.Environment`` for ``jaco`` and ``manipulation``. OpenGL is loaded when somebody
        renders its physics
    :raises ValueError: if there is no such task; it lists those there are
    """
    check_task(domain, task)
    load_physics()
    from sb3_dreamer_urlb.envs.jaco import make_jaco_task, make_manipulation_task
    from sb3_dreamer_urlb.envs.urlb_tasks import make_suite_task

    if domain == "jaco":
        return make_jaco_task(task)
    if domain == "manipulation":
        return make_manipulation_task(task)
    return make_suite_task(domain, task)
