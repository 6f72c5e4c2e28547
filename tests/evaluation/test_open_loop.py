"""Pictures of what the world model expects: of whatever observations an agent takes, as long as there is an image in them."""

from __future__ import annotations

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb.evaluation import figures
from sb3_dreamer_urlb.evaluation.gifs import encode_gif
from sb3_dreamer_urlb.evaluation.protocol import play_episode

VECTOR = spaces.Box(-1, 1, (3,), np.float32)
KINDS = {
    "channels last": (spaces.Box(0, 255, (16, 20, 3), np.uint8), (16, 20)),
    "channels first": (spaces.Box(0, 255, (3, 16, 20), np.uint8), (16, 20)),
    "one channel": (spaces.Box(0, 255, (1, 17, 21), np.uint8), (17, 21)),
    "a Dict": (spaces.Dict(camera=spaces.Box(0, 255, (16, 20, 3), np.uint8), joints=VECTOR), (16, 20)),
}


def agent_in(tiny_model, space):
    policy = {spaces.Dict: "MultiInputPolicy"}.get(type(space), "CnnPolicy")
    env = CounterEnv(20, observation_space=space)
    return tiny_model(env, policy if space is not VECTOR else "MlpPolicy"), env


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_image(tiny_model, tmp_path, kind):
    space, size = KINDS[kind]
    model, env = agent_in(tiny_model, space)
    episode = play_episode(model, env, seed=np.int64(0))
    truth, predicted = figures.open_loop(model.policy, episode, start=2, steps=8)
    assert truth.shape == predicted.shape == (figures.CONTEXT + 8, *size, 3) and truth.dtype == np.uint8
    seen = episode.observations["camera"] if kind == "a Dict" else episode.observations
    if kind in ("channels last", "a Dict"):
        np.testing.assert_array_equal(truth, seen[2 : 2 + len(truth)])
    else:
        np.testing.assert_array_equal(truth[..., 0], seen[2 : 2 + len(truth), 0])
    errors, rewards = figures.open_loop_errors(model.policy, episode, 2, 8, tmp_path / "errors.png")
    assert errors.shape == rewards.shape == (figures.CONTEXT + 8,) and (tmp_path / "errors.png").exists()


def test_without_an_image_there_is_no_picture(tiny_model):
    model, env = agent_in(tiny_model, VECTOR)
    with pytest.raises(ValueError, match=r"need an agent that sees images, this one sees Box\(-1.0, 1.0, \(3,\)"):
        figures.open_loop(model.policy, play_episode(model, env), start=0, steps=3)


@pytest.mark.parametrize(
    ("start", "steps", "said"),
    [
        (-3, 5, "start must be an integer of at least 0, got -3"),
        (0, 0, "steps must be an integer of at least 1, got 0"),
        (50, 5, "Observations 50 to 55 are to be seen, the episode has 21"),
    ],
)
def test_parts_that_no_episode_has(tiny_model, start, steps, said):
    model, env = agent_in(tiny_model, KINDS["channels last"][0])
    with pytest.raises(ValueError, match=said):
        figures.open_loop(model.policy, play_episode(model, env), start, steps)


@pytest.mark.parametrize(
    ("frames", "fps", "scale", "said"),
    [
        (0, 10, 1, "at least one frame, got none"),
        (1, 0, 1, "fps must be a positive number, got 0"),
        (1, float("nan"), 1, "fps must be a positive number, got nan"),
        (1, 10, 0, "scale must be an integer of at least 1, got 0"),
    ],
)
def test_films_that_cannot_be(frames, fps, scale, said):
    with pytest.raises(ValueError, match=said):
        encode_gif(np.zeros((frames, 4, 4, 3), np.uint8), fps, scale)
