"""Files that version 0.1 wrote are read as ever, and its modules are found under their old names."""

from __future__ import annotations

import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from places import TESTS

from sb3_dreamer_urlb import CnnPolicy, DreamerV2
from sb3_dreamer_urlb._moved import MOVED, ROOT

FILES = TESTS / "data" / "version-0.1"
OPTIONS = {"device": "cpu"}


def env() -> CounterEnv:
    return CounterEnv(length=12)


@pytest.mark.parametrize("name", ["pretrained", "finetuned", "skills"])
def test_a_snapshot_loads_and_goes_on(name: str) -> None:
    model = DreamerV2.load(FILES / f"{name}.zip", env=env(), **OPTIONS)
    before = model.phase_updates
    model.learn(30, reset_num_timesteps=False)
    assert model.phase_updates > before
    assert all(bool(value.isfinite().all()) for value in model.policy.state_dict().values())


def test_a_pre_trained_snapshot_is_fine_tuned() -> None:
    model = DreamerV2.load(FILES / "pretrained.zip", env=env(), **OPTIONS)
    kept = model.policy.agent.world_model.rssm.state_dict()
    model.fine_tune()
    for name, value in model.policy.agent.world_model.rssm.state_dict().items():
        assert th.equal(value, kept[name])


def test_a_policy_acts_as_its_model() -> None:
    policy = CnnPolicy.load(FILES / "policy.zip", **OPTIONS)
    model = DreamerV2.load(FILES / "pretrained.zip", **OPTIONS)
    seen, _ = env().reset()
    action, _ = policy.predict(seen, deterministic=True)
    policy.planning = False
    assert action.shape == (2,)
    np.testing.assert_array_equal(policy.predict(seen, deterministic=True)[0], model.predict(seen, deterministic=True)[0])


def test_a_replay_is_read() -> None:
    model = DreamerV2.load(FILES / "pretrained.zip", env=env(), **OPTIONS)
    model.load_replay_buffer(FILES / "replay.pkl")
    assert model.replay_buffer.can_sample()


def test_a_run_goes_on(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(FILES / "run", folder)
    model = DreamerV2.resume(folder, env(), **OPTIONS)
    assert model is not None and model.num_timesteps == 60 and model.replay_buffer.can_sample()
    model.learn(10, reset_num_timesteps=False)


@pytest.mark.parametrize("old", sorted(MOVED))
def test_old_names_of_modules_warn_and_work(old: str) -> None:
    sys.modules.pop(f"{ROOT}.{old}", None)
    with pytest.warns(DeprecationWarning, match=MOVED[old]):
        module = import_module(f"{ROOT}.{old}")
    new = import_module(f"{ROOT}.{MOVED[old]}")
    public = [name for name in vars(new) if not name.startswith("_")]
    assert public and all(getattr(module, name) is getattr(new, name) for name in public)


@pytest.mark.parametrize(
    "name", ["PhaseSwitchCallback", "FineTuneCallback", "SnapshotCallback", "SNAPSHOT_FRAMES", "TRANSFER", "transfer"]
)
def test_what_lay_in_phases_is_found_there(name: str) -> None:
    with pytest.warns(DeprecationWarning, match=name):
        assert getattr(import_module(f"{ROOT}.phases"), name) is not None


def test_the_package_itself_uses_no_old_name() -> None:
    code = (
        "import importlib, pkgutil, warnings\n"
        "warnings.filterwarnings('error', message='.*the old name ends')\n"
        "import sb3_dreamer_urlb as package\n"
        "for module in pkgutil.walk_packages(package.__path__, package.__name__ + '.'):\n"
        "    if not module.name.endswith('__main__'): importlib.import_module(module.name)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
