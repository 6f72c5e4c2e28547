"""What a user of Stable-Baselines3 takes for granted: subclasses, predictions, wrappers, networks, time limits."""

from __future__ import annotations

import copy
import pickle

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb import DreamerPolicy, DreamerV2, DrQv2, register_intrinsic_reward
from sb3_dreamer_urlb.dreamer_v2.policies import MlpPolicy
from sb3_dreamer_urlb.envs import SupervisedVecEnv
from sb3_dreamer_urlb.envs.facts import steps_an_episode
from sb3_dreamer_urlb.envs.told import STEPS, TOLD, Asked, as_received
from sb3_dreamer_urlb.intrinsic import APT
from sb3_dreamer_urlb.intrinsic.registry import make_intrinsic_reward
from sb3_dreamer_urlb.signatures import named_arguments, named_parameters

VECTOR = spaces.Box(-1, 1, (3,), np.float32)


def vector_env(**kwargs):
    return CounterEnv(8, observation_space=VECTOR, **kwargs)


# -- subclasses ------------------------------------------------------------------------------------------------------------


class Open(DreamerV2):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class Further(Open):
    """With an argument of its own, which it keeps."""

    def __init__(self, *args, further=1, **kwargs):
        super().__init__(*args, **kwargs)
        self.further = further


class Fixing(DreamerV2):
    """With arguments that are settled."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, batch_size=3, preset="tiny", **kwargs)


class Defaults(DreamerV2):
    def __init__(self, policy="CnnPolicy", env=None, *, preset="tiny", **kwargs):
        super().__init__(policy, env, preset=preset, **kwargs)


class OpenPolicy(MlpPolicy):
    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)


class NamedPolicy(DreamerPolicy):
    def __init__(self, observation_space, action_space, lr_schedule, *args, note="", **kwargs):
        super().__init__(observation_space, action_space, lr_schedule, *args, **kwargs)


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [(Open, {"preset": "tiny"}), (Further, {"preset": "tiny", "further": 7}), (Fixing, {}), (Defaults, {})],
)
def test_a_subclass_that_hands_arguments_on_is_saved_and_loaded(kind, arguments, tmp_path):
    model = kind("CnnPolicy", CounterEnv(8), gamma=0.5, seed=0, **arguments).learn(40)
    model.save(tmp_path / "model")
    loaded = kind.load(tmp_path / "model", env=CounterEnv(8), learning_rate=0.25)
    assert type(loaded) is kind and loaded.gamma == 0.5 and loaded.learning_rate == 0.25
    assert loaded.preset == model.preset and loaded.batch_size == model.batch_size
    assert getattr(loaded, "further", None) == arguments.get("further")
    observation = np.zeros((16, 16, 3), np.uint8)
    assert np.array_equal(*(one.predict(observation, deterministic=True)[0] for one in (model, loaded)))
    loaded.learn(20)
    with pytest.raises(TypeError, match=r"unexpected keyword argument 'gama'\. Did you mean 'gamma'"):
        kind.load(tmp_path / "model", gama=0.5)


@pytest.mark.parametrize(("policy", "kwargs"), [(OpenPolicy, {}), (NamedPolicy, {"note": "mine"})])
def test_a_policy_that_hands_arguments_on(policy, kwargs, tmp_path):
    env = vector_env() if policy is OpenPolicy else CounterEnv(8)
    model = DreamerV2(policy, env, preset="tiny", policy_kwargs=kwargs).learn(30)
    model.save(tmp_path / "model")
    assert type(DreamerV2.load(tmp_path / "model", custom_objects={"policy": policy}).policy) is policy
    with pytest.raises(ValueError, match=r"Unknown policy_kwargs \['deter'\]; known are .*deter_size"):
        DreamerV2(policy, env, preset="tiny", policy_kwargs={"deter": 3})


def test_an_intrinsic_reward_that_hands_arguments_on(tmp_path):
    class OpenAPT(APT):
        def __init__(self, *args, scale=1.0, **kwargs):
            super().__init__(*args, **kwargs)
            self.scale = scale

    register_intrinsic_reward("open-apt", OpenAPT)
    for method in ("open-apt", OpenAPT(5, scale=2.0), OpenAPT(k=5)):
        kwargs = {"k": 5} if isinstance(method, str) else None
        model = DreamerV2("CnnPolicy", CounterEnv(8), preset="tiny", intrinsic_reward=method, intrinsic_kwargs=kwargs)
        model.save(tmp_path / "model")
        loaded = DreamerV2.load(tmp_path / "model").policy.agent.intrinsic
        assert loaded.k == 5 and loaded.scale == getattr(method, "scale", 1.0)
    with pytest.raises(ValueError, match=r"Unknown intrinsic_kwargs \['neighbours'\].*'k', 'scale'"):
        make_intrinsic_reward("open-apt", {"neighbours": 3})


@given(st.lists(st.booleans(), min_size=1, max_size=4), st.integers(0, 5))
def test_names_of_arguments_through_any_chain_of_constructors(opens, n_args):
    """Each class of the chain has one argument and hands the rest on, until one does not."""
    kind, wanted = object, []
    for depth, is_open in reversed(list(enumerate(opens))):
        if is_open:
            scope = {"kind": kind}
            exec(f"def __init__(self, own{depth}=0, *args, **kwargs): ...", scope)
        else:
            scope, wanted = {}, []
            exec(f"def __init__(self, own{depth}=0): ...", scope)
        kind = type(f"Kind{depth}", (kind,), {"__init__": scope["__init__"]})
        wanted = [f"own{depth}", *wanted]
    assert list(named_parameters(kind)) == wanted
    given = named_arguments(kind, range(n_args), {"by_name": "x"})
    assert given == {**dict(zip(wanted, range(n_args), strict=False)), "by_name": "x"}


def test_an_argument_that_is_kept_nowhere_is_left_out_with_a_warning(tmp_path):
    class Forgetful(DreamerV2):
        def __init__(self, *args, forgotten=1, **kwargs):
            super().__init__(*args, **kwargs)

    model = Forgetful("CnnPolicy", CounterEnv(8), preset="tiny", forgotten=2)
    with pytest.warns(UserWarning, match="no attribute 'forgotten'"):
        model.save(tmp_path / "model")
    Forgetful.load(tmp_path / "model")


# -- predictions -----------------------------------------------------------------------------------------------------------

SEEN = [spaces.Discrete(4), spaces.Discrete(3, start=-1), spaces.MultiDiscrete([2, 3]), spaces.MultiBinary(3), VECTOR]
DONE = [spaces.Discrete(3), spaces.Discrete(2, start=5), spaces.MultiDiscrete([2, 3]), spaces.Box(-1, 1, (2,), np.float32)]


@pytest.mark.parametrize("observation_space", SEEN, ids=str)
@pytest.mark.parametrize("action_space", DONE, ids=str)
@pytest.mark.parametrize("deterministic", [True, False])
def test_predict_gives_an_array_for_one_observation_and_for_several(observation_space, action_space, deterministic):
    policy = MlpPolicy(observation_space, action_space, lambda _: 0.0, 8, 8, 3, 4, 2, [8])
    observation = observation_space.sample()
    action, _ = policy.predict(observation, deterministic=deterministic)
    assert type(action) is np.ndarray and action.shape == action_space.shape and action.dtype == action_space.dtype
    assert action_space.contains(action if action.shape else action_space.dtype.type(action))
    actions, _ = policy.predict(np.stack([observation] * 3), deterministic=deterministic)
    assert type(actions) is np.ndarray and actions.shape == (3, *action_space.shape)


@pytest.mark.parametrize("planner", [None, "dyna_mpc"])
@pytest.mark.parametrize("n", [1, 3])
def test_a_deterministic_forward_pass_is_what_predict_begins_with(tiny_model, planner, n):
    model = tiny_model(env=vector_env(), policy="MlpPolicy", planner=planner)
    model.phase_timesteps = 1000
    seen = th.rand(n, 3)
    before = th.get_rng_state()
    actions = [model.policy(seen, deterministic=True), model.policy._predict(seen, deterministic=True)]
    assert th.equal(th.get_rng_state(), before)
    wanted, _ = model.predict(seen.numpy(), deterministic=True)
    assert all(np.allclose(model.policy.to_env_action(action.numpy()), wanted) for action in actions)
    drawn = [model.policy(seen) for _ in range(2)]
    assert not th.equal(*drawn)


# -- networks --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("net_arch", [[], [5], [6, 7]])
@pytest.mark.parametrize("action_space", [spaces.Discrete(3), spaces.Box(-1, 1, (2,), np.float32)], ids=str)
@pytest.mark.parametrize("seen", ["vector", "image", "dict"])
def test_hidden_layers_are_those_of_net_arch(net_arch, action_space, seen, tmp_path):
    """None: linear networks. They learn, plan, and are saved."""
    image = spaces.Box(0, 255, (16, 16, 3), np.uint8)
    space = {"vector": VECTOR, "image": image, "dict": spaces.Dict(one=VECTOR, two=image)}[seen]
    policy = {"vector": "MlpPolicy", "image": "CnnPolicy", "dict": "MultiInputPolicy"}[seen]
    env = CounterEnv(8, observation_space=space, action_space=action_space, terminates=True)
    kwargs = {"preset": "tiny", "seed": 0, "planner": "dyna_mpc", "policy_kwargs": {"net_arch": net_arch}}
    model = DreamerV2(policy, env, **kwargs)
    assert list(model.policy.net_arch) == net_arch
    assert [layer.out_features for layer in model.policy.agent.critic.dense] == net_arch
    model.learn(40)
    assert model._n_updates > 0 and model._planner_is_on()
    model.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model")
    observation = space.sample()
    assert np.array_equal(*(one.predict(observation, deterministic=True)[0] for one in (model, loaded)))


@pytest.mark.parametrize("method", [None, "disagreement"])
def test_drq_v2_may_have_no_hidden_layer(method, tmp_path):
    env = CounterEnv(8, observation_space=VECTOR, terminates=True)
    kwargs = {"preset": "tiny", "seed": 0, "intrinsic_reward": method, "policy_kwargs": {"net_arch": []}}
    model = DrQv2("MlpPolicy", env, **kwargs).learn(40)
    assert model._n_updates > 0
    model.save(tmp_path / "model")
    seen = VECTOR.sample()
    assert np.array_equal(*(one.predict(seen, deterministic=True)[0] for one in (model, DrQv2.load(tmp_path / "model"))))


def test_a_linear_actor_is_linear():
    policy = MlpPolicy(VECTOR, spaces.Box(-1, 1, (2,), np.float32), lambda _: 0.0, 8, 8, 3, 4, 2, net_arch=[])
    actor, feature = policy.agent.actor, policy.agent.world_model.sizes.feature
    one, two = th.randn(2, feature)
    means = [th.atanh(actor(x.unsqueeze(0)).mode.clamp(-0.999999, 0.999999)) for x in (one, two, (one + two) / 2)]
    assert th.allclose((means[0] + means[1]) / 2, means[2], atol=1e-4)


# -- wrappers --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(41, 40, 10), (40, 41, 3), (16, 64, 5)])
@pytest.mark.parametrize("frames", [1, 5])
def test_images_that_only_look_as_if_channels_were_last(shape, frames):
    """VecTransposeImage(skip=True) is how SB3's users say that they are first."""
    height, width, channels = shape
    env = DummyVecEnv([lambda: FakeImageEnv(2, height, width, channels, channel_first=True, discrete=False)])
    env = VecFrameStack(env, frames, channels_order="first")
    before = env.reset().shape
    env = VecTransposeImage(env, skip=True)
    model = DreamerV2("CnnPolicy", env, preset="tiny", replay_buffer_kwargs={"sampling": "rows"}).learn(30)
    assert model.observation_space.shape == before[1:] and model._last_obs.shape == before and model._n_updates > 0
    action, _ = model.predict(env.reset())
    assert action.shape == (1, *model.action_space.shape)


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("frames", [2, 3])
@pytest.mark.parametrize("seen", [VECTOR, spaces.Dict(a=VECTOR)], ids=str)
def test_frames_that_are_stacked_outside_of_vec_normalize(n_envs, frames, seen):
    """rl_zoo3's order: the replay holds what the agent saw, rewards are the environment's; terminal rows included."""
    names = list(seen.spaces) if isinstance(seen, spaces.Dict) else [None]
    makers = [lambda: CounterEnv(5, observation_space=seen, rewards=(3.0,))] * n_envs
    env = VecFrameStack(VecNormalize(DummyVecEnv(makers)), frames)
    policy = "MlpPolicy" if names == [None] else "MultiInputPolicy"
    model = DreamerV2(policy, env, preset="tiny", seed=0, replay_buffer_kwargs={"sampling": "rows"})
    given = [env.reset()]

    class Watch(BaseCallback):
        def _on_step(self):
            given.append(copy.deepcopy(self.locals["new_obs"]))
            return True

    model.learn(40, callback=Watch())
    assert model._n_updates > 0
    for episode in model.replay_buffer.episodes:
        assert set(episode.reward[1:].tolist()) == {3.0}
        for name in names:
            rows = episode.observation if name is None else episode.observation[name]
            assert rows.shape[1:] == (3 * frames,) and np.abs(rows).max() <= 10.0
            # Frames move on by one from row to row, also to the last one.
            assert np.allclose(rows[1:, : 3 * (frames - 1)], rows[:-1, 3:])
    batch = model.replay_buffer.sample(2, env=model._drawn_through())
    assert np.allclose(batch.reward[batch.reward != 0].numpy(), model.get_vec_normalize_env().normalize_reward(3.0), atol=1e-5)


# -- time limits -----------------------------------------------------------------------------------------------------------

gymnasium.register("OfTimeLimits-v0", entry_point=CounterEnv, kwargs={"length": None})


class Told(gymnasium.Wrapper):
    """A wrapper that tells its own number."""

    def __init__(self, env, steps):
        super().__init__(env)
        self.max_episode_steps = steps

    def step(self, action):
        return self.env.step(action)


COUNT = st.none() | st.integers(2, 60)


@given(COUNT, COUNT, st.lists(st.tuples(st.sampled_from([TimeLimit, Told]), st.integers(2, 60)), max_size=3), st.booleans())
def test_an_episode_is_as_long_as_the_smallest_of_all_limits(own, spec, wrappers, monitored):
    env = gymnasium.make("OfTimeLimits-v0", max_episode_steps=spec)
    if own is not None:
        env.unwrapped.max_episode_steps = own
    for wrapper, steps in wrappers:
        env = wrapper(env, steps)
    env = Monitor(env) if monitored else env
    limits = [limit for limit in (own, spec, *(steps for _, steps in wrappers)) if limit is not None]
    assert steps_an_episode(DummyVecEnv([lambda: env])) == min(limits, default=None)


def from_another_process(env, name):
    """What comes through the pipe of a worker, without one."""
    assert is_wrapped(env, Asked)
    return as_received(pickle.loads(pickle.dumps(env.get_wrapper_attr(TOLD)))[name])


@given(COUNT, st.lists(st.tuples(st.sampled_from([TimeLimit, Told]), st.integers(2, 60)), max_size=3))
def test_so_it_is_in_other_processes_with_and_without_a_spec(own, wrappers):
    for make in (CounterEnv, lambda: gymnasium.make("OfTimeLimits-v0")):
        env = make()
        if own is not None:
            env.unwrapped.max_episode_steps = own
        for wrapper, steps in wrappers:
            env = wrapper(env, steps)
        limits = [limit for limit in (own, *(steps for _, steps in wrappers)) if limit is not None]
        assert from_another_process(Monitor(env), STEPS) == min(limits, default=None)


def short_env():
    return TimeLimit(TimeLimit(TimeLimit(CounterEnv(), 9), 5), 7)


@pytest.mark.parametrize("vec_env", [lambda fns: SubprocVecEnv(fns, start_method="forkserver"), SupervisedVecEnv])
def test_time_limits_of_environments_in_other_processes(vec_env):
    env = vec_env([short_env])
    try:
        assert steps_an_episode(env) == 5
    finally:
        env.close()


def test_a_sequence_longer_than_the_limit_of_make_is_refused():
    env = gymnasium.make("OfTimeLimits-v0", max_episode_steps=5)
    with pytest.raises(ValueError, match=r"batch_length=16 is longer than any episode: .* after 5 steps"):
        DreamerV2("CnnPolicy", env, preset="tiny", batch_length=16)
