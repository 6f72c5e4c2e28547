"""Long injections, run by ``make faults``; a part of the first one also in the normal tests."""

from __future__ import annotations

import functools
import io
import os
import shutil
import signal
import threading
from pathlib import Path

import gymnasium
import pytest
from faults import INJECTIONS
from places import ROOT, file_of
from whole_runs import everything, vec_env

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback
from sb3_dreamer_urlb.envs import make_supervised_vec_env
from sb3_dreamer_urlb.runs.run_folder import RunFolder
from sb3_dreamer_urlb.snapshots import atomic

SAVED = ("weights", "moments", "counters", "episodes")


class Killer:
    """Kills the process at one of the steps that change files.

    :param step: number of the step, counted from 0; after half of a write, before anything else
    """

    def __init__(self, step: int):
        self.left = step

    def due(self) -> bool:
        self.left -= 1
        return self.left < 0

    def before(self, function):
        """``function``, after which it may be too late."""

        @functools.wraps(function)
        def wrapped(*args, **kwargs):
            if self.due():
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*args, **kwargs)

        return wrapped

    def open(self, path, mode):
        """A file without a buffer, whose writes are steps."""
        killer = self

        class File(io.FileIO):
            def write(self, data):
                if killer.due():
                    super().write(bytes(data)[: len(data) // 2])
                    os.kill(os.getpid(), signal.SIGKILL)
                return super().write(data)

        return File(path, mode)

    def install(self):
        """For good: the process is about to die."""
        atomic.open = self.open
        for module, name in ((os, "fsync"), (os, "replace"), (Path, "unlink"), (Path, "mkdir")):
            setattr(module, name, self.before(getattr(module, name)))


def save_and_die(model, folder: Path, step: int) -> bool:
    """Write a checkpoint in a child that is killed at a step.

    :return: whether it was; False after the last step
    """
    child = os.fork()
    if child == 0:
        try:
            run = model.run_folder
            run.path = folder
            Killer(step).install()
            run.save(model)
            os._exit(0)
        finally:
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0
    return os.WIFSIGNALED(status)


def check_kills_at_write_steps(tiny_model, tmp_path, stride: int) -> int:
    """Kill a second checkpoint at every ``stride``-th step, and see what is there.

    :return: steps of the save
    """
    kwargs = {"buffer_size": 100, "intrinsic_reward": "lbs"}
    model = tiny_model(vec_env(), **kwargs).learn(80, callback=RunCheckpointCallback(tmp_path / "run"))
    old = {name: everything(model)[name] for name in SAVED}
    model.learn(40, reset_num_timesteps=False)
    new = {name: everything(model)[name] for name in SAVED}
    assert not any(old[name] == new[name] for name in SAVED)
    seen, step = [], 0
    while True:
        folder = tmp_path / f"killed-{step}"
        shutil.copytree(tmp_path / "run", folder)
        killed = save_and_die(model, folder, step)
        resumed = DreamerV2.resume(folder, vec_env(), device="cpu")
        found = {name: everything(resumed)[name] for name in SAVED}
        seen.append("new" if found == new else "old")
        assert found == (new if seen[-1] == "new" else old), f"step {step}"
        with RunFolder(folder).locked():
            assert not list(folder.glob(".*.tmp"))
        shutil.rmtree(folder)
        if not killed:
            break
        step += stride
    # First the old one, and from one moment on the new one.
    assert seen == sorted(seen, reverse=True) and seen[0] == "old" and seen[-1] == "new"
    return step


def test_kill_at_some_write_steps_of_a_checkpoint(tiny_model, tmp_path):
    assert check_kills_at_write_steps(tiny_model, tmp_path, 17) > 17


@pytest.mark.faults
def test_kill_at_every_write_step_of_a_checkpoint(tiny_model, tmp_path):
    steps = check_kills_at_write_steps(tiny_model, tmp_path, 1)
    assert steps > 30
    print(f"{steps} steps")


def resources(env) -> dict[str, list[int]]:
    """Memory in kB, open files and threads of this process and of its workers."""
    pids = [os.getpid(), *(worker.process.pid for worker in env.workers)]
    status = [Path(f"/proc/{pid}/status").read_text() for pid in pids]
    return {
        "memory": [int(text.split("VmRSS:")[1].split()[0]) for text in status],
        "files": [len(os.listdir(f"/proc/{pid}/fd")) for pid in pids],
        "threads": [int(text.split("Threads:")[1].split()[0]) for text in status],
    }


def _walker(**kwargs):
    return gymnasium.make("urlb/walker-stand-v0", image_size=16, **kwargs)


@pytest.mark.faults
@pytest.mark.timeout(1500)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_soak(tiny_model, tmp_path):
    """2000 steps in three rendering environments, one of which dies now and then: nothing piles up."""
    env = make_supervised_vec_env(_walker, 3)
    model = tiny_model(env, buffer_size=300, replay_buffer_kwargs={"max_episode_rows": 50}, gradient_steps=1)
    model.learn(600)
    first = resources(env)
    for _ in range(7):
        os.kill(env.workers[1].process.pid, signal.SIGKILL)
        model.learn(201, reset_num_timesteps=False, callback=RunCheckpointCallback(tmp_path / "run", 100))
    last = resources(env)
    assert model.num_timesteps >= 2000 and model.env_faults == 7
    assert last["threads"] == first["threads"] and threading.active_count() == 1
    # The folder's lock and the like may come; what is opened with every worker or checkpoint would be seven.
    assert all(now <= before + 3 for now, before in zip(last["files"], first["files"], strict=True))
    growth = [now - before for now, before in zip(last["memory"], first["memory"], strict=True)]
    assert growth[0] < 40_000 and all(kb < 20_000 for kb in growth[1:]), growth
    env.close()
    print(f"memory grew by {growth} kB, open files {first['files']} → {last['files']}, threads {last['threads']}")


def test_the_table_names_tests_that_exist():
    for injection, (tests, _) in INJECTIONS.items():
        for file, name in tests:
            assert f"def test_{name}" in file_of(file).read_text(), injection


def test_the_page_shows_the_table():
    page = (ROOT / "docs" / "reliability.md").read_text()
    for injection, (_, outcome) in INJECTIONS.items():
        assert f"| {injection} | {outcome} |" in page
