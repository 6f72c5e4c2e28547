"""Files and number formats with every kind of observation and action."""

from __future__ import annotations

from collections import OrderedDict

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from snapshot_files import change_data
from space_kinds import ACTIONS, IMAGE, OBSERVATIONS, VECTOR
from tiny import infer
from torch import nn

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback, SnapshotError
from sb3_dreamer_urlb.planning import CategoricalDynaMPC, DynaMPC, PlannerConfig
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.snapshots import bounded_json, values
from sb3_dreamer_urlb.world_model.convolution import convolve

KINDS = {
    **{name: OBSERVATIONS[name] for name in ("grey image", "float image", "vector", "discrete", "multi-binary", "dict")},
    "depth": ("CnnPolicy", spaces.Box(0, 9000, (1, 16, 16), np.uint16), {"normalize_images": False}),
    "odd names": ("MultiInputPolicy", spaces.Dict({"!": VECTOR, "a/b": spaces.Discrete(3), "": VECTOR, "ä.b": IMAGE}), {}),
    "unsorted": ("MultiInputPolicy", spaces.Dict(OrderedDict(z=spaces.Discrete(3), a=VECTOR)), {}),
}


def through_json(value):
    return values.decode(bounded_json.parse(bounded_json.dump(values.encode(value))))


def rows(buffer):
    """All that finished episodes hold, bit for bit."""
    return [[(name, part.dtype, part.shape, part.tobytes()) for name, part in e.columns.items()] for e in buffer.episodes]


@pytest.mark.parametrize("name", KINDS)
def test_a_run_comes_back(tiny_model, tmp_path, name):
    policy, space, policy_kwargs = KINDS[name]

    def make_env():
        return CounterEnv([8, 5], observation_space=space, action_space=spaces.MultiDiscrete([2, 3], start=[0, 7]))

    model = tiny_model(make_env(), policy=policy, policy_kwargs=policy_kwargs, planner="dyna_mpc")
    model.learn(30, RunCheckpointCallback(tmp_path / "run", every_frames=10))
    assert model._n_updates > 0
    model.save_replay_buffer(tmp_path / "replay")
    model.policy.save(tmp_path / "policy")
    resumed = DreamerV2.resume(tmp_path / "run", make_env(), device="cpu")
    other = tiny_model(make_env(), policy=policy, policy_kwargs=policy_kwargs, planner="dyna_mpc")
    other.load_replay_buffer(tmp_path / "replay")
    model.replay_buffer.close_streams()  # what a file brings back is ended
    for its in (resumed, other):
        assert rows(its.replay_buffer) == rows(model.replay_buffer) and len(its.replay_buffer.episodes) > 3
    assert type(resumed.policy) is type(model.policy) and resumed.action_space == model.action_space
    assert resumed.observation_space == model.observation_space
    loaded = type(model.policy).load(tmp_path / "policy", device="cpu")
    expected = model.policy.state_dict()
    for its in (resumed.policy, loaded):
        assert all(th.equal(value, expected[key]) for key, value in its.state_dict().items())
        assert isinstance(its.planner, CategoricalDynaMPC) and its.planner.classes == (2, 3)
    resumed.learn(10, RunCheckpointCallback(tmp_path / "run"), reset_num_timesteps=False)
    assert resumed.num_timesteps >= 40 and resumed._n_updates > model._n_updates


@pytest.mark.parametrize(
    "space",
    [
        spaces.Discrete(3, start=-4),
        spaces.MultiDiscrete([2, 3], start=[5, -1]),
        spaces.MultiDiscrete(np.array([[2, 3], [4, 2]]), dtype=np.int32),
        spaces.MultiBinary([2, 3]),
        KINDS["unsorted"][1],
        KINDS["odd names"][1],
    ],
    ids=str,
)
def test_spaces_come_back(space):
    back = through_json(space)
    assert back == space and back.dtype == space.dtype
    if isinstance(space, spaces.Dict):
        assert list(back.spaces) == list(space.spaces)


def test_a_discrete_space_of_another_type_comes_back():
    try:
        space = spaces.Discrete(3, dtype=np.uint8)
    except TypeError:
        pytest.skip("this Gymnasium knows int64 only")
    assert through_json(space) == space


@pytest.mark.parametrize("change", [
    lambda space: space.update(n=0),
    lambda space: space.update(n=2.5),
    lambda space: space.update(dtype="object"),
    lambda space: space.update({"!": "Dict", "parts": [[3, {"!": "Discrete", "n": 3, "start": 0}]]}),
    lambda space: space.update({"!": "Dict", "parts": [3]}),
    lambda space: space.update({"!": "Dict", "parts": [["a", 3]]}),
    lambda space: space.update({"!": "MultiDiscrete", "nvec": [2, -1]}),
    lambda space: space.update(n=10**40),
])  # fmt: skip
def test_spaces_that_do_not_fit(tiny_model, tmp_path, change):
    tiny_model(CounterEnv(8, observation_space=spaces.Discrete(4)), policy="MlpPolicy").save(tmp_path / "m")
    bad = change_data(tmp_path / "m.zip", tmp_path / "bad.zip", lambda data: change(data["observation_space"]))
    with pytest.raises(SnapshotError, match="is refused"):
        DreamerV2.load(bad, device="cpu")


@pytest.mark.parametrize("classes", [[], [0], [2, 1.5], "ab", [True]])
def test_classes_of_a_planner_that_do_not_fit(classes):
    planner = CategoricalDynaMPC(PlannerConfig(horizon=3), 0.9, (2, 3))
    back = through_json(planner)
    assert type(back) is CategoricalDynaMPC
    assert (back.config, back.gae_lambda, back.classes) == (planner.config, 0.9, (2, 3))
    with pytest.raises(ValueError, match="it holds a"):
        values.decode({**values.encode(planner), "classes": classes})


def test_a_policy_refuses_a_planner_for_other_actions(tiny_model):
    policy = tiny_model(CounterEnv(8, action_space=spaces.Discrete(3))).policy
    for planner in (DynaMPC(PlannerConfig(), 0.9), CategoricalDynaMPC(PlannerConfig(), 0.9, (2,))):
        with pytest.raises(ValueError, match="The planner chooses among the classes"):
            type(policy)(**{**policy._get_constructor_parameters(), "planner": planner})


def test_the_replay_holds_the_types_that_the_space_declares():
    space = spaces.Dict({"a": spaces.Box(-9, 9, (2,), np.float32), "b": spaces.Discrete(9)})
    buffer = SequenceReplayBuffer(100, space, ACTIONS["box"], "cpu", batch_length=2, seed=0)
    seen = {"a": np.full((1, 2), 0.5), "b": np.array([3], np.int32)}
    for _ in range(2):
        buffer.add(seen, seen, np.zeros((1, 6)), np.zeros(1), np.array([True]), [{}])
    expected = {name: (th.from_numpy(part).dtype, part.shape[1:]) for name, part in buffer.episodes[0].columns.items()}
    assert buffer.columns() == expected and expected["observation/a"] == (th.float32, (2,))
    assert expected["observation/b"] == (th.int64, ()) and expected["action"] == (th.float32, (6,))


@pytest.mark.parametrize("name", ["dict", "odd names", "discrete", "depth"])
def test_a_replay_on_disk_holds_and_draws_the_same(tmp_path, name):
    space = KINDS[name][1]
    kwargs = {"batch_length": 3, "seed": 0, "n_envs": 1}
    on_disk = {"store": "lmdb", "path": tmp_path / "disk"}
    memory, disk = (SequenceReplayBuffer(100, space, ACTIONS["table"], "cpu", **kwargs, **more) for more in ({}, on_disk))
    space.seed(0)
    for t in range(40):
        seen = space.sample()
        seen = (
            {key: np.asarray(part)[None] for key, part in seen.items()} if isinstance(seen, dict) else np.asarray(seen)[None]
        )
        for buffer in (memory, disk):
            buffer.add(seen, seen, np.full((1, 11), t), np.full(1, t), np.array([t % 7 == 0]), [{}])
    for mine, its in zip(memory.episodes, disk.episodes, strict=True):
        mine, its = mine.rows(0, len(mine)), its.rows(0, len(its))
        assert mine.keys() == its.keys() and all(mine[key].tobytes() == its[key].tobytes() for key in mine)
    mine, its = (buffer.sample(20).observation for buffer in (memory, disk))
    parts = [(mine[key], its[key]) for key in space] if isinstance(space, spaces.Dict) else [(mine, its)]
    assert all(a.dtype == b.dtype and th.equal(a, b) for a, b in parts)


@pytest.mark.parametrize("kernel", [4, (1, 4), (3, 2)])
@pytest.mark.parametrize("kind", [nn.Conv2d, nn.ConvTranspose2d])
@pytest.mark.parametrize("shape", [(4, 9), (9, 4), (4, 4)])
def test_convolutions_of_what_is_not_square(seeded, kind, kernel, shape):
    layer, x = kind(2, 3, kernel, 2), th.randn(2, 2, *shape, requires_grad=True)
    ours, theirs = convolve(layer, x), layer(x)
    assert ours.shape == theirs.shape and th.allclose(ours, theirs, atol=1e-5)
    gradients = [th.autograd.grad(y.square().sum(), [x, layer.weight, layer.bias]) for y in (ours, theirs)]
    assert all(th.allclose(a, b, atol=1e-4) for a, b in zip(*gradients, strict=True))


@pytest.mark.parametrize("method", [None, "rnd"])
@pytest.mark.parametrize("name", ["wide image", "vector", "dict", "discrete"])
def test_short_products(tiny_model, name, method):
    policy, space, policy_kwargs = OBSERVATIONS[name]
    env = CounterEnv(8, observation_space=space, action_space=ACTIONS["multi-discrete"])
    model = tiny_model(
        env, policy=policy, policy_kwargs=policy_kwargs, intrinsic_reward=method, planner="dyna_mpc", precision="bfloat16"
    ).learn(30)
    assert model._n_updates > 0
    batch = model.replay_buffer.sample(2)
    assert all(value.dtype == th.float32 and value.isfinite() for value in model.learner.update(batch).values())
    with model.learner._products():
        posterior = infer(model.policy.agent.world_model, batch)
        dream = model.policy.agent.world_model.imagine(model.policy.agent.actor, posterior.state.flatten().detach(), 3)
    tensors = [posterior.embed, posterior.post_logits, posterior.state.deter, dream.feature, dream.action, dream.entropy]
    assert all(tensor.dtype == th.float32 for tensor in tensors)
    model.phase_timesteps = 10**6
    assert model._planner_is_on() == (method is None)
    assert env.action_space.contains(model.predict(space.sample(), deterministic=True)[0])
