"""What a caller gives beside a file: dictionaries extend the stored ones, another number of environments will do."""

from __future__ import annotations

import io

import pytest
from fake_envs import CounterEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback
from sb3_dreamer_urlb.replay import SequenceReplayBuffer

STORED = {
    "planner_kwargs": {"n_samples": 8, "iterations": 2, "top_k": 4, "mixture": 0.25, "horizon": 3},
    "replay_buffer_kwargs": {"sampling": "rows", "max_episode_rows": 50},
    "intrinsic_kwargs": {"k": 3},
}
CHANGES = {
    "planner_kwargs": {"iterations": 3, "mixture": 0.5},
    "replay_buffer_kwargs": {"store": "memory", "max_episode_rows": 40},
    "intrinsic_kwargs": {"k": 2},
}


class Judged(SequenceReplayBuffer):
    """A replay with an argument that no file can hold."""

    def __init__(self, *args, judge=None, **kwargs):
        super().__init__(*args, **kwargs)
        self.judge = judge


def envs(n):
    return DummyVecEnv([CounterEnv] * n)


def new_model(n=1, **kwargs):
    settings = {"preset": "tiny", "seed": 0, "device": "cpu", "planner": "dyna_mpc", **STORED, **kwargs}
    return DreamerV2("CnnPolicy", envs(n), **settings)


def file_of(save):
    file = io.BytesIO()
    save(file)
    file.seek(0)
    return file


@pytest.fixture(scope="module")
def stored():
    return file_of(new_model(intrinsic_reward="apt").save)


@settings(max_examples=15)
@given(
    st.fixed_dictionaries({}, optional={name: st.sets(st.sampled_from(sorted(part))) for name, part in CHANGES.items()}),
    st.booleans(),
)
def test_dictionaries_extend(stored, chosen, custom):
    stored.seek(0)
    given = {name: {key: CHANGES[name][key] for key in keys} for name, keys in chosen.items()}
    model = DreamerV2.load(stored, device="cpu", **({"custom_objects": given} if custom else given))
    for name, part in STORED.items():
        assert getattr(model, name) == {**part, **given.get(name, {})}
    assert (model.policy.planner.config.n_samples, model.replay_buffer.sampling) == (8, "rows")


def test_networks_keep_their_other_sizes():
    file = file_of(new_model(intrinsic_reward=None, intrinsic_kwargs=None).save)
    model = DreamerV2.load(file, device="cpu", policy_kwargs={"net_arch": [8]})
    assert model.policy.agent.world_model.sizes.deter == 8


def test_only_what_no_file_can_hold_must_be_given_again():
    def judge(episode):
        return 1.0

    kwargs = {**STORED["replay_buffer_kwargs"], "judge": judge}
    model = new_model(intrinsic_reward=None, intrinsic_kwargs=None, replay_buffer_class=Judged, replay_buffer_kwargs=kwargs)
    with pytest.warns(UserWarning, match="replay_buffer"):
        file = file_of(model.save)
    again = {"replay_buffer_class": Judged}
    with pytest.raises(ValueError, match=r"its replay_buffer_kwargs was .*judge"):
        DreamerV2.load(file, device="cpu", custom_objects=again)
    loaded = DreamerV2.load(file, device="cpu", custom_objects={**again, "replay_buffer_kwargs": {"judge": judge}})
    assert loaded.replay_buffer.judge is judge and loaded.replay_buffer.max_episode_rows == 50


@pytest.mark.parametrize(("before", "after"), [(1, 3), (3, 1), (2, 3)])
def test_another_number_of_environments(tmp_path, before, after):
    kwargs = {"intrinsic_reward": None, "intrinsic_kwargs": None}
    model = new_model(before, **kwargs).learn(52 * before, callback=RunCheckpointCallback(tmp_path / "run", 40))
    rows, open_ = model.replay_buffer.size(), sum(one is not None for one in model.replay_buffer.open)
    assert open_ == before
    replay = file_of(model.save_replay_buffer)
    loaded = DreamerV2.load(file_of(model.save), envs(after), device="cpu")
    loaded.load_replay_buffer(replay)
    resumed = DreamerV2.resume(tmp_path / "run", envs(after), device="cpu")
    for again in (loaded, resumed):
        assert again.replay_buffer.size() == rows and not any(again.replay_buffer.open)
        again.learn(32 * after, reset_num_timesteps=False)
        assert again.replay_buffer.size() == rows + after * (32 + 2) and len(again.replay_buffer.open) == after


def test_a_run_folder_extends(tmp_path):
    new_model(intrinsic_reward=None, intrinsic_kwargs=None).learn(20, callback=RunCheckpointCallback(tmp_path / "run", 20))
    model = DreamerV2.resume(tmp_path / "run", envs(1), device="cpu", planner_kwargs={"iterations": 5})
    assert model.planner_kwargs == {**STORED["planner_kwargs"], "iterations": 5}


def test_a_folder_of_logs_that_can_be_none_here_is_left_out(tmp_path):
    """Files come from other machines."""
    logs = tmp_path / "logs"
    file = file_of(new_model(intrinsic_reward="apt", tensorboard_log=str(logs)).save)
    assert DreamerV2.load(file).tensorboard_log == str(logs)
    logs.write_text("mine")
    file.seek(0)
    with pytest.warns(UserWarning, match=r"will log nowhere, unless you give another folder, .*tensorboard_log must be"):
        assert DreamerV2.load(file, env=envs(1)).learn(2).tensorboard_log is None
    file.seek(0)
    with pytest.raises(NotADirectoryError, match="tensorboard_log must be the path of a folder"):
        DreamerV2.load(file, tensorboard_log=str(logs))
    assert logs.read_text() == "mine"
