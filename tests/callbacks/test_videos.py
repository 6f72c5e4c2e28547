"""Films in TensorBoard: the agent, and what its world model predicts with its eyes shut."""

from __future__ import annotations

import io
import warnings

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv, UndrawnEnv
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from PIL import Image
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dreamer_urlb import PhaseSwitchCallback, VideoCallback
from sb3_dreamer_urlb.evaluation import recording
from sb3_dreamer_urlb.evaluation.films import LINE
from sb3_dreamer_urlb.evaluation.open_loop import image_of, pictures, predict_open_loop

ID, OTHER = "test/Counter-v0", "test/OtherCounter-v0"


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Counting environments that gymnasium knows by name."""
    for name, length in ((ID, 12), (OTHER, 9)):
        kwargs = {"length": length, "action_repeat": 2, "render_mode": None}
        monkeypatch.setitem(gymnasium.registry, name, EnvSpec(name, "fake_envs:CounterEnv", kwargs=kwargs))


def films(folder):
    """Everything among TensorBoard's images: tag → [(step, frames as an array)]."""
    found = {}
    for run in folder.iterdir():
        events = EventAccumulator(str(run), size_guidance={"images": 0})
        events.Reload()
        for tag in events.Tags()["images"]:
            for event in events.Images(tag):
                with Image.open(io.BytesIO(event.encoded_image_string)) as gif:
                    frames = []
                    for i in range(gif.n_frames):
                        gif.seek(i)
                        frames.append(np.asarray(gif.convert("RGB")))
                assert (event.width, event.height) == (frames[0].shape[1], frames[0].shape[0])
                found.setdefault(tag, []).append((event.step, np.stack(frames)))
    return found


def test_films_in_tensorboard_at_the_chosen_interval(tiny_model, tmp_path):
    model = tiny_model(gymnasium.make(ID), intrinsic_reward="lbs", tensorboard_log=str(tmp_path))
    model.learn(48, VideoCallback(video_freq=20, context=3, horizon=6))
    found = films(tmp_path)
    assert {tag: [step for step, _ in shown] for tag, shown in found.items()} == {
        "video/agent": [20, 40],
        "video/open_loop": [20, 40],
    }
    # The whole episode, as the environment draws it; then truth, model and error side by side.
    agent, open_loop = found["video/agent"][0][1], found["video/open_loop"][0][1]
    assert agent.shape == (12, 6 * 32 + 2 * LINE, 6 * 32, 3)  # enlarged and labelled
    drawn = agent[:, LINE:-LINE]
    assert [int(frame[30, 30, 0]) for frame in drawn[:3]] == [0, 3, 6]
    assert (drawn[:, ::6, ::6].repeat(6, 1).repeat(6, 2) == drawn).all()
    # Both lines have text, and the lower one counts.
    assert min(agent[:, :LINE].max(), agent[:, -LINE:].max()) > 200
    assert (agent[0, :LINE] == agent[1, :LINE]).all() and (agent[0, -LINE:] != agent[1, -LINE:]).any()
    assert open_loop.shape == (9, 12 * 16 + 2 * LINE, 12 * 48, 3)


def test_the_open_loop_film_shows_truth_model_and_error(tiny_model, tmp_path):
    model = tiny_model(gymnasium.make(ID), tensorboard_log=str(tmp_path))
    with th.no_grad():  # decoded pictures are one colour, whatever was seen
        for parameter in model.policy.agent.world_model.decoder.parameters():
            parameter.zero_()
    model.learn(8, VideoCallback(video_freq=8, context=3, horizon=6))
    [(_, frames)] = films(tmp_path)["video/open_loop"]
    truth, predicted, error = np.split(frames[:, LINE:-LINE][:, ::12, ::12].astype(int), 3, 2)
    assert (predicted == 128).all()
    counted = 7 * np.arange(1, 10) % 256  # picture 0 was the reset before the run, to see whether there are pictures
    assert np.abs(truth[:, 5, 5, 0] - counted).max() <= 4  # a palette has 256 colours
    assert np.abs(error[:, 5, 5, 0] - ((counted - 128) // 2 + 128)).max() <= 4


def test_learning_is_the_same_with_and_without_films(tiny_model, weights, tmp_path):
    def learnt(callback):
        model = tiny_model(gymnasium.make(ID), planner="dyna_mpc", planner_delay=1)
        return weights(model.learn(40, callback).policy)

    callback = VideoCallback(video_freq=7, deterministic=False, context=2, horizon=3, folder=tmp_path / "films")
    assert learnt(None) == learnt(callback)
    names = {path.name for path in (tmp_path / "films").iterdir()}
    assert {"agent_7.gif", "open_loop_7.gif", "agent_35.gif"} <= names and len(names) == 10


def test_the_planner_acts_in_the_film(tiny_model, tmp_path, monkeypatch):
    model = tiny_model(gymnasium.make(ID), planner="dyna_mpc", planner_delay=0, learning_starts=4)
    planned = []
    plan = type(model.policy.planner).plan
    monkeypatch.setattr(
        type(model.policy.planner), "plan", lambda self, *args, **kwargs: (planned.append(1), plan(self, *args, **kwargs))[1]
    )
    callback = VideoCallback(video_freq=1000, video_length=5, folder=tmp_path)
    model.learn(30, callback)
    before = len(planned)
    assert before > 0 and not list(tmp_path.iterdir())
    callback.film()
    assert len(planned) == before + 5 and list(tmp_path.glob("agent_*.gif"))


def test_the_film_is_of_the_present_phases_environment(tiny_model, tmp_path):
    model = tiny_model(gymnasium.make(ID), intrinsic_reward="lbs", tensorboard_log=str(tmp_path))
    switch = PhaseSwitchCallback(pretrain_frames=48, env=gymnasium.make(OTHER))
    model.learn(60, [switch, VideoCallback(video_freq=24)])
    assert [len(frames) for _, frames in films(tmp_path)["video/agent"]] == [12, 9]


@pytest.mark.parametrize("n_envs", [1, 2])
def test_vectors_are_filmed_without_an_open_loop(tiny_model, tmp_path, n_envs):
    vectors = {"observation_space": spaces.Box(-1, 1, (3,), np.float32)}
    train = VecNormalize(make_vec_env(lambda: CounterEnv(8, **vectors), n_envs))
    model = tiny_model(train, "MlpPolicy", tensorboard_log=str(tmp_path))
    model.learn(20, VideoCallback(CounterEnv(8, **vectors), video_freq=10))
    assert {tag: [len(frames) for _, frames in shown] for tag, shown in films(tmp_path).items()} == {"video/agent": [8, 8]}


def test_what_is_played_is_normalised_as_in_training(tiny_model):
    space = spaces.Box(-1, 1, (3,), np.float32)
    model = tiny_model(VecNormalize(make_vec_env(lambda: CounterEnv(8, observation_space=space), 1)), "MlpPolicy").learn(16)
    model.get_vec_normalize_env().obs_rms.mean[:] = 50
    env = recording.env_to_play_in(model, CounterEnv(8, observation_space=space))
    played = recording.record(model, env, 5)
    assert len(played.actions) == 5 and len(played.observations) == 6 and played.observations.max() < -5
    assert env.obs_rms is not model.get_vec_normalize_env().obs_rms


def test_of_dicts_the_image_is_shown(tiny_model, tmp_path):
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "image": spaces.Box(0, 255, (16, 20, 1), np.uint8)})
    model = tiny_model(CounterEnv(8, observation_space=space), "MultiInputPolicy", tensorboard_log=str(tmp_path))
    env = CounterEnv(8, observation_space=space, render_mode=None)
    model.learn(8, VideoCallback(env, video_freq=8, context=2, horizon=3))
    found = films(tmp_path)
    # Without a render mode the agent's own view is the film; one channel is shown as grey.
    assert found["video/agent"][0][1].shape == (8, 160 + 2 * LINE, 200, 3) and found["video/open_loop"][0][1].shape == (
        5,
        160 + 2 * LINE,
        600,
        3,
    )


def test_terminal_observations_belong_to_the_episode(tiny_model):
    model = tiny_model(CounterEnv(6))
    env = recording.env_to_play_in(model, CounterEnv(6))
    played = recording.record(model, env, 100)
    seen = played.observations[:, 0, 0, 0].tolist()
    assert seen == list(range(seen[0], seen[0] + 7)) and played.actions.shape == (6, 2) and played.fps == 20


def test_stacked_frames_show_the_last_one(tiny_model):
    train = VecFrameStack(DummyVecEnv([lambda: CounterEnv(12)]), 2)
    model = tiny_model(train)
    env = recording.env_to_play_in(model, VecFrameStack(DummyVecEnv([lambda: CounterEnv(12)]), 2))
    played = recording.record(model, env, 100)
    truth, _ = predict_open_loop(model.policy, played.observations, played.actions, 0, 3, 3)
    shown = pictures(image_of(model.policy.observations, truth))
    assert shown.shape == (6, 16, 16, 3) and (np.diff(shown[:, 5, 5, 0].astype(int)) == 7).all()


def test_long_pauses_between_frames_and_fast_environments(tiny_model, tmp_path):
    env = CounterEnv(40)
    env.metadata = {"render_modes": ["rgb_array"], "render_fps": 100}
    model = tiny_model(CounterEnv(40))
    model.learn(4, VideoCallback(env, video_freq=4, video_length=20, folder=tmp_path))
    with Image.open(tmp_path / "agent_4.gif") as gif:
        assert gif.n_frames == 5 and gif.info["duration"] == 40


def test_short_episodes_have_no_open_loop(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(8))
    model.learn(8, VideoCallback(CounterEnv(4), video_freq=8, context=5, folder=tmp_path))
    assert [path.name for path in tmp_path.iterdir()] == ["agent_8.gif"]


def test_with_nowhere_to_put_films_it_says_so(tiny_model):
    callback = VideoCallback(CounterEnv(), video_freq=4)
    with pytest.warns(UserWarning, match=r"tensorboard_log=.*folder="):
        tiny_model().learn(8, callback)
    assert not callback.active


def test_what_cannot_be_filmed_is_refused_before_the_run(tiny_model, tmp_path):
    vector = spaces.Box(-1, 1, (3,), np.float32)
    blind = CounterEnv(8, observation_space=vector, render_mode=None)
    cases = [
        (tiny_model(blind, "MlpPolicy"), VideoCallback(blind, folder=tmp_path), "render_mode is None, not 'rgb_array'"),
        (tiny_model(), VideoCallback(folder=tmp_path), "has no registered id: give env"),
        (tiny_model(), VideoCallback(CounterEnv(size=20), folder=tmp_path), "does not fit the model"),
        (tiny_model(), VideoCallback(UndrawnEnv(CounterEnv()), folder=tmp_path), "cannot be filmed: pygame is not installed"),
        (tiny_model(), VideoCallback(make_vec_env(CounterEnv, 2), folder=tmp_path), "One environment is needed"),
        (
            tiny_model(VecFrameStack(DummyVecEnv([lambda: gymnasium.make(ID)]), 2)),
            VideoCallback(folder=tmp_path),
            "lacks the wrappers of the training environment",
        ),
    ]
    for model, callback, message in cases:
        with pytest.raises(ValueError, match=message):
            model.learn(8, callback)
        assert model.num_timesteps == 0


@pytest.mark.parametrize("name", ["video_freq", "video_length", "context", "horizon", "open_loop_start"])
def test_numbers_that_make_no_sense(name):
    with pytest.raises(ValueError, match=rf"{name} must be an integer of at least [01], got -1"):
        VideoCallback(**{name: -1})


def test_an_id_and_other_callbacks_and_several_calls(tiny_model, tmp_path):
    model = tiny_model(gymnasium.make(ID), tensorboard_log=str(tmp_path), gradient_steps=0)
    callback = VideoCallback(ID, video_freq=10, video_length=3)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        model.learn(12, [callback, EveryNTimesteps(4, VideoCallback(ID, video_freq=100))])
        model.learn(12, callback, reset_num_timesteps=False)
    assert sorted(step for step, _ in films(tmp_path)["video/agent"]) == [10, 22]
