"""The list of tasks: nothing is missing, and what it says is so."""

from __future__ import annotations

import gymnasium
import pytest

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.cli.tasks import tasks


def test_every_registered_id_is_listed_once():
    registered = {name for name in gymnasium.registry if name.split("/")[0] in ("urlb", "rwrl")}
    assert {task.id for task in tasks()} == registered - {"urlb/dm_control-v0"}
    assert len(tasks()) == len({task.id for task in tasks()})


@pytest.mark.parametrize("name", ["urlb/walker-flip-v0", "urlb/jaco-reach_top_left-sparse-v0", "rwrl/quadruped-walk-easy-v0"])
def test_what_it_says_is_so(name):
    [task] = [task for task in tasks() if task.id == name]
    env = gymnasium.make(name, observation="state")
    assert env.get_wrapper_attr("domain") == task.domain and env.get_wrapper_attr("max_episode_steps") == task.steps
    assert env.get_wrapper_attr("action_repeat") * task.steps == task.frames
    assert env.action_space.shape == (task.actions,)


def test_the_command(capsys):
    assert main(["tasks", "--domain", "jaco"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("urlb/jaco-") == 16 and "walker" not in printed and "urlb/dm_control-v0" in printed
