"""The code in README and docs runs, at a size that tests can afford."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import dreamer_v2, envs
from sb3_dreamer_urlb.envs import supervisor
from sb3_dreamer_urlb.presets import PRESETS

ROOT = Path(__file__).parent.parent
# What makes an example small: the paper's numbers of frames and steps.
SMALL = {"2_000_000": "480", "2000000": "480", "1_050_000": "360", "50_000": "120", "n_eval_episodes=10": "n_eval_episodes=1"}


def code_blocks(name: str) -> list[str]:
    """The Python blocks of a page, in their order."""
    return re.findall(r"```python\n(.*?)```", (ROOT / name).read_text(), re.DOTALL)


@pytest.fixture
def small_world(monkeypatch, tmp_path):
    """A cheap walker, the smallest networks, an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "paper", PRESETS["tiny"])
    asked = []

    def make(name, **kwargs):
        asked.append(name)
        return CounterEnv(60, action_space=spaces.Box(-1, 1, (6,), np.float32), domain="walker", action_repeat=2)

    monkeypatch.setattr(gymnasium, "make", make)
    return asked


def run(block: str, names: dict) -> dict:
    """Execute a block at small size."""
    for large, small in SMALL.items():
        block = block.replace(large, small)
    exec(compile(block, "example", "exec"), names)
    return names


def test_readme(small_world, tmp_path, capsys, monkeypatch):
    first, second = code_blocks("README.md")
    # At this size the only snapshot is the one the second example loads.
    first = first.replace('SnapshotCallback("snapshots")', 'SnapshotCallback("snapshots", [480])')
    names = run(first, {})
    assert small_world == ["urlb/walker-stand-v0", "urlb/walker-run-v0"]
    assert names["model"].phase == "finetuning" and names["model"]._planner_is_on()
    assert (tmp_path / "walker-run.zip").exists() and re.search(r"\(.*30\.0.*\)", capsys.readouterr().out)
    names = run(second, names)
    assert names["model"].phase == "finetuning" and names["model"].phase_timesteps >= 120


def test_a_run_that_goes_on(small_world, tmp_path):
    block, *_ = code_blocks("docs/reliability.md")
    model = run(block, {})["model"]
    assert model.phase == "finetuning" and model.num_timesteps >= 360
    again = run(block.replace("1_050_000", "400"), {})["model"]
    assert again is not model and again.num_timesteps >= 400 and again.phase_timesteps > model.phase_timesteps


def test_guards_and_a_replay_on_disk(small_world, tmp_path, monkeypatch):
    _, guards, disk = code_blocks("docs/reliability.md")
    asked = []
    monkeypatch.setattr(supervisor, "make_vec_env", lambda *args, **kwargs: asked.append((args, kwargs)))
    names = run(guards.replace("env = make_supervised", "other = make_supervised"), {"gymnasium": gymnasium})
    assert asked == [(("urlb/walker-run-v0", 4), {"vec_env_cls": envs.SupervisedVecEnv})]
    assert isinstance(names["env"], envs.FaultGuard)
    model = run(disk, {"DreamerV2": dreamer_v2.DreamerV2, "env": names["env"]})["model"].learn(80)
    assert model.replay_buffer.can_sample() and (tmp_path / "runs" / "walker-replay" / "finetuning" / "data.mdb").exists()


def test_an_intrinsic_reward_of_ones_own(small_world):
    [block] = [block for block in code_blocks("docs/methods.md") if "register_intrinsic_reward" in block]
    model = run(block, {"env": gymnasium.make("walker")})["model"]
    before = model.policy.agent.intrinsic.error.out.weight.clone()
    model.learn(100)
    assert model.phase_updates > 0 and not before.equal(model.policy.agent.intrinsic.error.out.weight)
    assert "intrinsic_reward" in model._metrics.sums
    assert model.policy.agent.intrinsic.gain == 2.0
    model.save("own")
    assert dreamer_v2.DreamerV2.load("own").policy.agent.intrinsic is not None


def test_cartpole(monkeypatch):
    monkeypatch.setitem(PRESETS, "vector", PRESETS["tiny"])
    [block] = code_blocks("docs/sb3.md")
    model = run(block.replace("10_000", "200").replace("batch_length=8", "batch_length=4"), {})["model"]
    assert model.num_timesteps == 200 and model._n_updates > 0 and model.discount_head


def test_every_local_link_leads_somewhere():
    for page in (ROOT / "README.md", ROOT / "SECURITY.md", *(ROOT / "docs").glob("*.md")):
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def test_logging_and_films(small_world, tmp_path, monkeypatch):
    [block] = code_blocks("docs/logging.md")
    block = block.replace("VideoCallback(video_freq=50_000)", "VideoCallback(gymnasium.make('walker'), video_freq=60)")
    names = run(block.replace("EvalCallback(eval_env", "EvalCallback(eval_env, n_eval_episodes=1"), {})
    assert names["model"].num_timesteps >= 360
    assert {"progress.csv", "progress.json"} <= {path.name for path in (tmp_path / "logs").iterdir()}
    assert "eval/mean_reward" in (tmp_path / "logs" / "progress.json").read_text()


def test_sharing(small_world, tmp_path):
    [block] = code_blocks("docs/hub.md")
    block = block.replace('"./shared/walker-run",', '"./shared/walker-run", gymnasium.make("x"), env_id="urlb/walker-run-v0",')
    names = run(block, {})
    assert Path(names["path"]) == Path("shared/walker-run/dreamerv2-urlb-walker-run-v0.zip")
    assert names["model"].phase == "finetuning" and "python train.py" in (tmp_path / "shared/walker-run/README.md").read_text()
