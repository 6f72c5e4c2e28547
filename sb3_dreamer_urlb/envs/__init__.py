"""The benchmark's environments, from pixels. Importing this imports neither dm_control nor OpenGL.

``registration`` names the tasks and their gymnasium ids; ``dmc`` builds an environment from a name; ``urlb_tasks`` and
``jaco`` hold the tasks; ``pixel_env`` is the environment an agent sees, ``options`` what one can choose about it;
``rendering`` finds an OpenGL backend.
"""

from sb3_dreamer_urlb.envs.dmc import make_control_env, make_dmc_env, make_urlb_env
from sb3_dreamer_urlb.envs.options import PixelOptions
from sb3_dreamer_urlb.envs.registration import DOMAINS, PRIMAL_TASK, URLB_TASKS, env_id, register_envs
from sb3_dreamer_urlb.envs.rendering import RenderingBackendError, load_renderer

__all__ = [
    "DOMAINS",
    "PRIMAL_TASK",
    "URLB_TASKS",
    "PixelOptions",
    "RenderingBackendError",
    "env_id",
    "load_renderer",
    "make_control_env",
    "make_dmc_env",
    "make_urlb_env",
    "register_envs",
]
