"""Names of tasks, known before dm_control is: the same as its own, and wrong ones refused with nothing loaded."""

from __future__ import annotations

import re

import gymnasium
import pytest
from without_display import run

from sb3_dreamer_urlb.envs import URLB_TASKS, load_physics, make_control_env, registration
from sb3_dreamer_urlb.envs.registration import JACO_VARIANT_TASKS
from sb3_dreamer_urlb.envs.task_names import DM_CONTROL_TASKS, check_task, known_tasks


def test_they_are_dm_controls():
    load_physics()
    from dm_control import manipulation, suite

    assert {**suite.TASKS_BY_DOMAIN, "manipulation": manipulation.ALL} == DM_CONTROL_TASKS


def test_the_benchmarks_own_are_among_them():
    known = known_tasks()
    for domain, tasks in URLB_TASKS.items():
        assert known[domain][: len(tasks)] == tasks and len(set(known[domain])) == len(known[domain])
    assert set(JACO_VARIANT_TASKS) < set(known["jaco"])
    assert all(set(tasks) <= set(known[domain]) for domain, tasks in DM_CONTROL_TASKS.items())


@pytest.mark.parametrize("domain", ["walker", "cartpole", "jaco"])
def test_what_is_known_can_be_made(domain):
    for task in known_tasks()[domain][-2:]:
        assert make_control_env(domain, task).action_spec().shape


@pytest.mark.parametrize("wrong", [None, 3, True, ["walker"], {}, b"walker", float("nan"), "Walker", "walker ", ""])
def test_what_is_no_name_is_answered_with_the_known_ones(wrong):
    with pytest.raises(ValueError, match=r"^domain=.*: expected one of acrobot, ball_in_cup, .*, walker$"):
        check_task(wrong, "run")
    with pytest.raises(ValueError, match=r"^task=.*: walker has stand, walk, run, flip$"):
        check_task("walker", wrong)


SUITE = "urlb/dm_control-v0"


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        (SUITE, {}, "domain='': expected one of acrobot, "),
        (SUITE, {"domain": "cartpole"}, "task='': cartpole has balance, balance_sparse, "),
        (SUITE, {"domain": "carpole", "task": "swingup"}, "domain='carpole': expected one of acrobot, "),
        (SUITE, {"domain": "cartpole", "task": "swing_up"}, "task='swing_up': cartpole has balance, "),
        (SUITE, {"domain": "manipulation", "task": "reach"}, "task='reach': manipulation has stack_2_bricks_features, "),
        (SUITE, {"domain": "fish", "task": "swim", "speed": 1}, "unknown option speed: known are action_repeat, "),
        (
            SUITE,
            {"domain": "fish", "task": "swim", "perturbations": {"thigh_length": 0.3}},
            "thigh_length=0.3: only the walker",
        ),
        (SUITE, {"domain": "fish", "task": "swim", "domain_rewards": True}, "domain_rewards=True: expected a task of"),
        (SUITE, {"domain": "fish", "task": "swim", "observation": "state", "image_size": 32}, "image_size=32: observation="),
        (SUITE, {"domain": "fish", "task": "swim", "observation": "states"}, "observation='states': expected one of pixels, "),
        ("rwrl/walker-walk-easy-v0", {"level": "worst"}, "level='worst': expected one of easy, medium, hard"),
        ("rwrl/walker-walk-easy-v0", {"task": "run"}, "task='run': the Real-World RL suite's levels are of the task walk"),
        ("rwrl/walker-walk-easy-v0", {"hard_thigh": "paper"}, "hard_thigh='paper': only the walker's level hard"),
        ("urlb/jaco-reach_top_left-sparse-v0", {"task": "reach_top"}, "task='reach_top': jaco has reach_top_left, "),
    ],
)
def test_wrong_combinations_cost_a_line_and_load_nothing(name, arguments, message):
    """Neither MuJoCo nor dm_control nor a library of OpenGL, GLFW included; and no other error than the one."""
    code = f"""
import sys, gymnasium, sb3_dreamer_urlb
try:
    gymnasium.make({name!r}, **{arguments!r})
except ValueError as error:
    print(error)
print([name for name in ("mujoco", "dm_control", "OpenGL", "glfw", "shimmy") if name in sys.modules])
"""
    line, loaded = run(code).split("\n")
    assert line.startswith(message) and loaded == "[]"


def test_every_message_names_what_was_given():
    with pytest.raises(ValueError, match="domain='jaco': the Real-World RL suite's levels are of walker, quadruped"):
        gymnasium.make("rwrl/walker-walk-easy-v0", domain="jaco")


#: ids that name a task
NAMED = [name for name in gymnasium.registry if name.startswith(("urlb/", "rwrl/")) and name != "urlb/dm_control-v0"]
#: what other ids say
OTHER = {"domain": ("walker", "quadruped"), "task": ("stand", "walk"), "level": ("easy", "hard")}


@pytest.mark.parametrize("name", NAMED)
def test_options_that_contradict_an_id_are_refused_with_both(name):
    meant = registration.meant_by(name)
    for option in meant:
        for value in OTHER[option]:
            if value == meant[option] or ("level" in meant and option == "task"):
                continue
            with pytest.raises(
                ValueError, match=f"{option}={re.escape(repr(value))} contradicts the id {name}, whose"
            ) as caught:
                gymnasium.make(name, observation="state", **{option: value})
            assert repr(meant[option]) in str(caught.value) and "\n" not in str(caught.value)


def test_the_id_that_was_meant_is_told():
    for name, given, told in [
        ("rwrl/walker-walk-easy-v0", {"level": "hard"}, "rwrl/walker-walk-hard-v0"),
        ("rwrl/walker-walk-easy-v0", {"domain": "quadruped"}, "rwrl/quadruped-walk-easy-v0"),
        ("urlb/walker-run-v0", {"task": "stand"}, "urlb/walker-stand-v0"),
        ("urlb/walker-run-v0", {"domain": "cheetah"}, "urlb/dm_control-v0, which takes domain and task"),
        ("urlb/jaco-reach_top_left-sparse-v0", {"task": "reach_top_left-dense"}, "urlb/jaco-reach_top_left-dense-v0"),
    ]:
        with pytest.raises(ValueError, match=f"make {told}$"):
            gymnasium.make(name, **given)


def test_options_that_say_what_the_id_says_are_taken():
    env = gymnasium.make("rwrl/walker-walk-hard-v0", domain="walker", level="hard", observation="state")
    assert (env.get_wrapper_attr("domain"), env.get_wrapper_attr("task")) == ("walker", "walk")
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.perturbed.perturbations == env.unwrapped.perturbed.perturbations


def test_ids_and_what_they_mean():
    assert registration.meant_by("urlb/walker-run-v0") == {"domain": "walker", "task": "run"}
    assert registration.meant_by("rwrl/quadruped-walk-hard-v0") == {"domain": "quadruped", "task": "walk", "level": "hard"}
    assert registration.meant_by("urlb/jaco-reach_top_left-fixed-v0") == {"domain": "jaco", "task": "reach_top_left-fixed"}
    for other in ("urlb/dm_control-v0", "CartPole-v1", "rwrl/jaco-walk-easy-v0"):
        assert registration.meant_by(other) == {}
