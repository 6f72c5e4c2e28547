"""All tasks by name, those of dm_control included, so that a wrong name is refused before MuJoCo loads."""

from __future__ import annotations

from sb3_dreamer_urlb.envs.options import check_choice
from sb3_dreamer_urlb.envs.registration import JACO_VARIANT_TASKS, URLB_TASKS

#: dm_control's suite and its manipulation tasks. dm_control can only tell them once it is imported, and MuJoCo with it.
DM_CONTROL_TASKS: dict[str, tuple[str, ...]] = {
    "acrobot": ("swingup", "swingup_sparse"),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse", "two_poles", "three_poles"),
    "cheetah": ("run",),
    "dog": ("stand", "walk", "trot", "run", "fetch"),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "fish": ("upright", "swim"),
    "hopper": ("stand", "hop"),
    "humanoid": ("stand", "walk", "run", "run_pure_state"),
    "humanoid_CMU": ("stand", "walk", "run"),
    "lqr": ("lqr_2_1", "lqr_6_2"),
    "manipulator": ("bring_ball", "bring_peg", "insert_ball", "insert_peg"),
    "pendulum": ("swingup",),
    "point_mass": ("easy", "hard"),
    "quadruped": ("walk", "run", "escape", "fetch"),
    "reacher": ("easy", "hard"),
    "stacker": ("stack_2", "stack_4"),
    "swimmer": ("swimmer6", "swimmer15"),
    "walker": ("stand", "walk", "run"),
    "manipulation": (
        "stack_2_bricks_features",
        "stack_2_bricks_vision",
        "stack_2_bricks_moveable_base_features",
        "stack_2_bricks_moveable_base_vision",
        "stack_3_bricks_features",
        "stack_3_bricks_vision",
        "stack_3_bricks_random_order_features",
        "stack_2_of_3_bricks_random_order_features",
        "stack_2_of_3_bricks_random_order_vision",
        "reassemble_3_bricks_fixed_order_features",
        "reassemble_3_bricks_fixed_order_vision",
        "reassemble_5_bricks_random_order_features",
        "reassemble_5_bricks_random_order_vision",
        "lift_brick_features",
        "lift_brick_vision",
        "lift_large_box_features",
        "lift_large_box_vision",
        "place_brick_features",
        "place_brick_vision",
        "place_cradle_features",
        "place_cradle_vision",
        "reach_duplo_features",
        "reach_duplo_vision",
        "reach_site_features",
        "reach_site_vision",
    ),
}


def known_tasks() -> dict[str, tuple[str, ...]]:
    """Domain → its tasks, the benchmark's own first."""
    known = {
        name: (*tasks, *(task for task in DM_CONTROL_TASKS.get(name, ()) if task not in tasks))
        for name, tasks in URLB_TASKS.items()
    }
    known["jaco"] += JACO_VARIANT_TASKS
    return {**DM_CONTROL_TASKS, **known}


def names() -> dict[str, set[str]]:
    """All names of domains, and those of tasks, whatever domain they are of."""
    known = known_tasks()
    return {"domain": set(known), "task": {task for tasks in known.values() for task in tasks}}


def check_task(domain: str, task: str) -> None:
    """
    :param domain: of the suite, ``"manipulation"``, or one of the benchmark's
    :param task: of that domain
    :raises ValueError: if there is no such task; it lists those there are
    """
    known = known_tasks()
    check_choice("domain", domain, sorted(known))
    check_choice("task", task, known[domain], f"{domain} has")
