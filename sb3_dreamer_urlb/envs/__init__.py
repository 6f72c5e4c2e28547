"""The benchmark's environments, from pixels or from states. Importing this imports neither dm_control nor OpenGL.

``registration`` names the benchmark's tasks and their gymnasium ids, ``task_names`` those of dm_control, too; ``dmc``
builds an environment from a name; ``urlb_tasks`` and ``jaco`` hold the tasks; ``control_env`` is the environment an agent
acts in, ``pixel_env`` and ``state_env`` what it sees of it, ``options`` what one can choose about it;
``rendering`` finds an OpenGL backend; ``faults`` goes on where an environment raises,
``supervisor`` where its process (``worker``) dies or hangs.
"""

from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.envs.dmc import make_control_env, make_dmc_env, make_rwrl_env, make_urlb_env
from sb3_dreamer_urlb.envs.faults import EnvironmentFaultError, FaultGuard
from sb3_dreamer_urlb.envs.options import PixelOptions
from sb3_dreamer_urlb.envs.perturbations import Perturbations
from sb3_dreamer_urlb.envs.registration import DOMAINS, PRIMAL_TASK, URLB_TASKS, env_id, register_envs
from sb3_dreamer_urlb.envs.rendering import RenderingBackendError, load_physics, load_renderer

if TYPE_CHECKING:
    from sb3_dreamer_urlb.envs.perturbation_wrapper import PerturbationWrapper
    from sb3_dreamer_urlb.envs.supervisor import SupervisedVecEnv, make_supervised_vec_env

__all__ = [
    "DOMAINS",
    "PRIMAL_TASK",
    "URLB_TASKS",
    "EnvironmentFaultError",
    "FaultGuard",
    "PerturbationWrapper",
    "Perturbations",
    "PixelOptions",
    "RenderingBackendError",
    "SupervisedVecEnv",
    "env_id",
    "load_physics",
    "load_renderer",
    "make_control_env",
    "make_dmc_env",
    "make_rwrl_env",
    "make_supervised_vec_env",
    "make_urlb_env",
    "register_envs",
]


def __getattr__(name: str) -> Any:
    if name == "PerturbationWrapper":  # and dm_control only for who perturbs
        from sb3_dreamer_urlb.envs.perturbation_wrapper import PerturbationWrapper

        return PerturbationWrapper
    # Stable-Baselines3, and torch with it, only for who asks.
    if name in ("SupervisedVecEnv", "make_supervised_vec_env"):
        from sb3_dreamer_urlb.envs import supervisor

        return getattr(supervisor, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
