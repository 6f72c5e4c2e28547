"""Whatever save writes, load reads; what it could not read is not written, and the old file stays."""

from __future__ import annotations

import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback, SnapshotError


@pytest.mark.parametrize("part", ["policy", "policy.agent.actor", "policy.agent.world_model"])
def test_a_compiled_policy_is_saved_as_if_it_were_not(tiny_model, tmp_path, weights, part):
    model = tiny_model()
    before = weights(model.policy)
    *path, name = part.split(".")
    owner = model
    for step in path:
        owner = getattr(owner, step)
    setattr(owner, name, th.compile(getattr(owner, name)))
    model.save(tmp_path / "m")
    assert weights(DreamerV2.load(tmp_path / "m", device="cpu").policy) == before
    model.set_parameters(tmp_path / "m")


@pytest.mark.parametrize(
    ("break_", "message"),
    [
        (lambda model: setattr(model.policy.agent, "more", th.nn.Linear(2, 2)), "it has a tensor 'policy.agent.more.bias'"),
        (
            lambda model: setattr(model.policy.agent.actor, "to", th.nn.Identity()) or delattr(model.policy.agent, "critic"),
            "lacks",
        ),
        (lambda model: setattr(model, "domain", ("a", 1)), "its domain is no text"),
        (lambda model: setattr(model, "phase_timesteps", -1), "its counter phase_timesteps"),
    ],
)
def test_what_could_not_be_read_leaves_the_old_file(tiny_model, tmp_path, break_, message):
    model = tiny_model()
    model.save(tmp_path / "m")
    old = (tmp_path / "m.zip").read_bytes()
    break_(model)
    with pytest.raises(ValueError, match=f"The model is not saved, for its file would be refused: .*{message}"):
        model.save(tmp_path / "m")
    assert (tmp_path / "m.zip").read_bytes() == old


def test_saving_draws_nothing(tiny_model, tmp_path):
    """Or a run with snapshots would be another than one without."""
    model = tiny_model()
    before = th.get_rng_state(), model.replay_buffer.rng.bit_generator.state
    model.save(tmp_path / "m")
    assert th.equal(before[0], th.get_rng_state()) and before[1] == model.replay_buffer.rng.bit_generator.state


def test_a_model_without_its_replay_is_saved(tiny_model, tmp_path):
    """To be small in memory, say."""
    model = tiny_model().learn(12)
    model.replay_buffer = None
    model.save(tmp_path / "m")
    del model.replay_buffer
    model.save(tmp_path / "m")
    assert DreamerV2.load(tmp_path / "m", CounterEnv(), device="cpu").learn(12).num_timesteps == 12


def test_what_no_file_can_hold_is_said_when_saving(tiny_model, tmp_path):
    model = tiny_model(learning_rate=lambda _: 1e-3)
    with pytest.warns(UserWarning, match=r"No file can hold this model's learning_rate: .*custom_objects"):
        model.save(tmp_path / "m")
    assert DreamerV2.load(tmp_path / "m", custom_objects={"learning_rate": 1e-3}, device="cpu").learning_rate == 1e-3


# -- who is to blame -------------------------------------------------------------------------------------------------------


def test_an_environment_that_does_not_fit_is_no_bad_file(tiny_model, tmp_path):
    tiny_model().save(tmp_path / "m")
    with pytest.raises(ValueError, match="Observation spaces do not match") as caught:
        DreamerV2.load(tmp_path / "m", CounterEnv(size=32), device="cpu")
    assert not isinstance(caught.value, SnapshotError)


def test_a_folder_says_what_to_call(tiny_model, tmp_path):
    tiny_model().learn(12, callback=RunCheckpointCallback(tmp_path / "run", 4))
    with pytest.raises(IsADirectoryError, match=r"the algorithm's resume\("):
        DreamerV2.load(tmp_path / "run")


def test_observations_for_predict(tiny_model):
    model = tiny_model()
    image = model.observation_space.sample()
    mirrored = model.predict(image[:, :, ::-1], deterministic=True)[0]
    assert (mirrored == model.predict(image[:, :, ::-1].copy(), deterministic=True)[0]).all()
    env = DummyVecEnv([lambda: CounterEnv(observation_space=spaces.Discrete(3, start=1))])
    discrete = tiny_model(env, "MlpPolicy")
    for wrong in (0, 4):
        with pytest.raises(ValueError, match=f"must be in Discrete.*got {wrong}"):
            discrete.predict(wrong)
    discrete.predict(3)


def test_spaces_without_numbers_or_without_bounds(tiny_model):
    most = float(th.finfo(th.float32).max)
    with pytest.raises(ValueError, match="The observation space holds no number"):
        tiny_model(CounterEnv(observation_space=spaces.Box(0, 1, (0,))), "MlpPolicy")
    with pytest.raises(ValueError, match="The action space holds no number"):
        tiny_model(CounterEnv(action_space=spaces.Box(0, 1, (0,))))
    with pytest.raises(ValueError, match="finite bounds"):
        tiny_model(CounterEnv(action_space=spaces.Box(-most, most, (2,))))
