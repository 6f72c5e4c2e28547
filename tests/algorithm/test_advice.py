"""What works and is most likely not meant is told; usual usage stays silent."""

from __future__ import annotations

import re
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import yaml
from fake_envs import CounterEnv
from gymnasium import spaces
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.algorithm.advice import IMAGES, VECTORS
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.drq_v2.presets import PRESETS as DRQ_PRESETS

ROOT = Path(__file__).parents[2]
VECTOR = spaces.Box(-1, 1, (3,), np.float32)
IMAGE = spaces.Box(0, 255, (16, 16, 3), np.uint8)
#: no more networks than needed, whatever the preset
SMALL = {"policy_kwargs": {"net_arch": [4]}, "buffer_size": 600, "batch_size": 2, "device": "cpu"}
each = pytest.mark.parametrize("algorithm", [DreamerV2, DrQv2])


def told(make):
    """The model that ``make`` makes, and what it warns of."""
    with told_meanwhile() as said:
        model = make()
    return model, said


def seeing(space, length=None):
    env = CounterEnv(9, observation_space=space)
    return env if length is None else gymnasium.wrappers.TimeLimit(env, length)


# -- pictures and vectors --------------------------------------------------------------------------------------------------


@each
@pytest.mark.parametrize(
    ("space", "remedy"),
    [
        (IMAGE, 'Use "CnnPolicy" for images.'),
        (spaces.Box(0, 255, (1, 36, 36), np.uint8), 'Use "CnnPolicy" for images.'),
        (
            spaces.Box(0, 1, (3, 16, 16), np.float32),
            "Use \"CnnPolicy\" and policy_kwargs={'normalize_images': False} for images.",
        ),
        (VECTOR, None),
        (spaces.Box(0, 255, (20,), np.uint8), None),
        (spaces.Box(0, 255, (7, 7, 3), np.uint8), None),  # too small to convolve
        (spaces.Box(-np.inf, np.inf, (20, 20), np.float32), None),
        (spaces.Discrete(4), None),
    ],
)
def test_images_that_are_flattened(algorithm, space, remedy):
    _, said = told(lambda: algorithm("MlpPolicy", seeing(space), preset="tiny", device="cpu"))
    assert len(said) == (remedy is not None)
    if remedy is not None:
        assert said[0].startswith("The observation is seen as a vector of") and said[0].endswith(remedy)
        # What is proposed works, in silence.
        kwargs = {"normalize_images": False} if "normalize" in remedy else {}
        assert told(lambda: algorithm("CnnPolicy", seeing(space), preset="tiny", device="cpu", policy_kwargs=kwargs))[1] == []


@each
def test_a_policy_for_other_observations_names_the_right_ones(algorithm):
    with pytest.raises(ValueError, match=r'CnnPolicy needs image observations.* Use "MlpPolicy" for vectors'):
        algorithm("CnnPolicy", seeing(VECTOR), preset="tiny")
    with pytest.raises(ValueError, match=r'needs a Dict .* Use "CnnPolicy" for images, "MlpPolicy" for vectors|takes no Dict'):
        algorithm("MultiInputPolicy", seeing(VECTOR), preset="tiny")


@each
@pytest.mark.parametrize(("shape", "cure"), [((64, 64), "keep_dim=True"), ((4, 64, 64, 3), "leave FrameStackObservation out")])
def test_what_wrappers_made_of_a_picture(algorithm, shape, cure):
    with pytest.raises(ValueError, match=rf"CnnPolicy needs image observations.*{cure}"):
        algorithm("CnnPolicy", seeing(spaces.Box(0, 255, shape, np.uint8)), preset="tiny")


@each
@pytest.mark.parametrize(("white", "said_of"), [(0, True), (1, True), (2, False), (255, False)])
def test_pictures_of_numbers_up_to_one_are_black(algorithm, white, said_of):
    env = gymnasium.wrappers.TransformObservation(
        seeing(IMAGE, 20), lambda seen: np.full_like(seen, white), observation_space=IMAGE
    )
    _, said = told(lambda: algorithm("CnnPolicy", env, preset="tiny", device="cpu").learn(60))
    assert len(said) == said_of
    if said_of:
        assert said[0].startswith("The observation is a picture of uint8 with no number above 1: it is black")


@each
def test_planes_whose_space_ends_at_one_are_what_they_say(algorithm):
    board = spaces.Box(0, 1, (8, 8, 12), np.uint8)
    assert told(lambda: algorithm("MlpPolicy", seeing(board, 20), preset="tiny", device="cpu").learn(60))[1] == []


def test_a_black_picture_among_others_is_named():
    both = spaces.Dict({"board": spaces.Box(0, 1, (8, 8, 3), np.uint8), "camera": IMAGE})
    env = gymnasium.wrappers.TransformObservation(
        seeing(both, 20), lambda _: {name: np.ones_like(part.sample()) for name, part in both.items()}, observation_space=both
    )
    _, said = told(lambda: DreamerV2("MultiInputPolicy", env, preset="tiny", device="cpu").learn(60))
    assert [text.split(" is a picture")[0] for text in said if "black" in text] == ["Observation 'camera'"]


# -- presets ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("algorithm", "preset"), [*((DreamerV2, name) for name in PRESETS), *((DrQv2, name) for name in DRQ_PRESETS)]
)
@pytest.mark.parametrize(("policy", "space", "sees"), [("CnnPolicy", IMAGE, IMAGES), ("MlpPolicy", VECTOR, VECTORS)])
def test_a_preset_for_something_else(algorithm, preset, policy, space, sees, tmp_path):
    kwargs = {**SMALL, "policy_kwargs": {"net_arch": [4], "cnn_depth": 2}}
    model, said = told(lambda: algorithm(policy, seeing(space), preset=preset, **kwargs))
    made_for = algorithm.presets_made_for.get(preset, (sees,))
    assert len(said) == (sees not in made_for)
    if said:
        assert said[0].startswith(
            f"preset={preset!r} is made for {made_for[0]}, and this agent sees {sees}. Made for {sees}: '"
        )
        proposed = re.findall(r"'([\w-]+)'", said[0].split("Made for")[1])
        for other in proposed:
            assert told(lambda other=other: algorithm(policy, seeing(space), preset=other, **kwargs))[1] == []
    # It was said once: a file does not repeat it.
    model.save(tmp_path / "model")
    assert told(lambda: algorithm.load(tmp_path / "model", env=seeing(space), device="cpu"))[1] == []


def test_pictures_among_others_count():
    env = seeing(spaces.Dict(image=IMAGE, state=VECTOR))
    assert told(lambda: DreamerV2("MultiInputPolicy", env, preset="small", **SMALL))[1] == []
    assert "sees images" in told(lambda: DreamerV2("MultiInputPolicy", env, preset="state", **SMALL))[1][0]
    env = seeing(spaces.Dict(a=VECTOR, b=VECTOR))
    assert told(lambda: DreamerV2("MultiInputPolicy", env, preset="state", **SMALL))[1] == []


def test_the_documentation_and_the_configurations_pair_presets_and_policies_so():
    pairs = []
    pages = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").glob("*.ipynb")]
    for page in pages:
        pairs += re.findall(r'(DreamerV2|DrQv2)\(\s*\\?"(\w+)\\?"[^\n]*?preset=\\?"([\w-]+)', page.read_text())
    for file in (ROOT / "zoo_configs").rglob("*.yml"):
        algorithm = "DrQv2" if "drq_v2" in file.parts else "DreamerV2"
        for settings in yaml.safe_load(file.read_text()).values():
            if "preset" in settings:
                pairs.append((algorithm, settings["policy"], settings["preset"]))
    assert len(pairs) > 40
    for algorithm, policy, preset in pairs:
        made_for = {"DreamerV2": DreamerV2, "DrQv2": DrQv2}[algorithm].presets_made_for
        sees = {"CnnPolicy": IMAGES, "MlpPolicy": VECTORS}[policy]
        assert sees in made_for.get(preset, (sees,)), (algorithm, policy, preset)


# -- episodes and the replay -----------------------------------------------------------------------------------------------


@each
@pytest.mark.parametrize(
    ("steps", "rows", "pieces", "warns"),
    [(29, 30, {}, False), (30, 30, {}, True), (None, 30, {}, False), (30, 30, {"max_episode_rows": 20}, False)],
)
def test_a_replay_smaller_than_an_episode(algorithm, steps, rows, pieces, warns, tmp_path):
    model, said = told(
        lambda: algorithm(
            "MlpPolicy", seeing(VECTOR, steps), preset="tiny", device="cpu", buffer_size=rows, replay_buffer_kwargs=pieces
        )
    )
    message = "buffer_size=30 holds no whole episode, only the last rows of one: the environment's have up to 30 steps"
    assert [text.startswith(message) for text in said] == [True] * warns
    # Later environments are looked at alike, and files with another size.
    if not pieces:
        assert len(told(lambda: model.set_env(seeing(VECTOR, 50)))[1]) == 1
        model.save(tmp_path / "model")
        assert told(lambda: algorithm.load(tmp_path / "model", env=seeing(VECTOR, 50), device="cpu", buffer_size=51))[1] == []


def test_what_is_held_then_is_what_the_warning_says():
    env = gymnasium.wrappers.TimeLimit(CounterEnv(None, observation_space=VECTOR), 50)
    with pytest.warns(UserWarning, match="holds no whole episode"):
        model = DreamerV2("MlpPolicy", env, preset="tiny", device="cpu", buffer_size=20, learning_starts=1000)
    model.learn(150)
    assert 0 < model.replay_buffer.finished_rows <= 20 and model.replay_buffer.longest <= 20


# -- ends of episodes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("terminates", "learns", "warns"), [(True, False, True), (True, True, False), (False, False, False)])
def test_ends_that_the_agent_learns_nothing_of_are_told(terminates, learns, warns):
    env = CounterEnv(3, observation_space=VECTOR, terminates=terminates)
    model = DreamerV2("MlpPolicy", env, preset="tiny", discount_head=learns, **SMALL)
    with told_meanwhile() as said:
        model.learn(4)
    assert any("no discount head" in one for one in said) is warns


def test_ends_of_the_second_phase_are_told_where_the_first_had_none():
    def env(**which):
        return CounterEnv(3, observation_space=VECTOR, **which)

    model = DreamerV2("MlpPolicy", env(never_terminates=True), preset="tiny", intrinsic_reward="lbs", **SMALL)
    with told_meanwhile() as said:
        model.learn(4)
        assert not any("no discount head" in one for one in said)
        model.fine_tune(env(terminates=True))
        model.learn(4)
    assert any("no discount head" in one for one in said)


# -- rewards ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "then_fine_tunes", "warns"),
    [
        ({}, False, True),
        ({"intrinsic_reward": "lbs"}, False, False),
        ({"intrinsic_reward": "lbs"}, True, True),
        ({"intrinsic_reward": "icm", "learn_task_reward": True}, False, True),
    ],
)
def test_rewards_that_an_environment_hides_are_told_where_they_are_learnt(kwargs, then_fine_tunes, warns):
    env = CounterEnv(3, observation_space=VECTOR, reward_free=True)
    model = DreamerV2("MlpPolicy", env, preset="tiny", **SMALL, **kwargs)
    with told_meanwhile() as said:
        model.learn(8)
        if then_fine_tunes:
            model.fine_tune()
            model.learn(8)
    assert sum("reward_free=True" in one for one in said) == warns


def test_a_task_without_rewards_says_so():
    for free in (False, True):
        env = gymnasium.make("urlb/walker-run-v0", observation="state", reward_free=free)
        assert env.get_wrapper_attr("reward_free") is free
