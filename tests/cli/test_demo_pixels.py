"""The demonstration from pixels and its command line."""

from __future__ import annotations

import dataclasses
import re

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from PIL import Image

from sb3_dreamer_urlb import DreamerV2, __main__, __version__
from sb3_dreamer_urlb.cli import demo_pixels
from sb3_dreamer_urlb.cli.demo_pixels import DemoConfig, run_demo
from sb3_dreamer_urlb.evaluation import figures, films
from sb3_dreamer_urlb.evaluation.protocol import RandomPolicy, evaluate, play_episode
from sb3_dreamer_urlb.evaluation.scores import ORACLE, normalized_score


@pytest.fixture
def fake_walker(monkeypatch):
    """Put the counting environment in the walker's place; the ids that were asked for."""
    made = []

    def make(name, **kwargs):
        made.append((name, kwargs))
        return CounterEnv(
            120, action_space=spaces.Box(-1, 1, (6,), np.float32), domain="walker", action_repeat=2, never_terminates=True
        )

    monkeypatch.setattr(demo_pixels.gymnasium, "make", make)
    return made


def check_output(out, pretrain_frames, size):
    """Every promised file is there and holds what it should."""
    assert {path.name for path in out.iterdir()} == {
        f"pretrained_{pretrain_frames}.zip",
        "finetuned.zip",
        "tensorboard",
        "learning_curve.png",
        "open_loop.gif",
        "open_loop.png",
        "agent.gif",
        "rows.csv",
        ".rows.csv.lock",
        "report.html",
    }
    assert list(out.glob("tensorboard/*/events*"))
    with Image.open(out / "learning_curve.png") as picture:
        assert picture.width > 400 and len(picture.convert("L").getcolors(256) or []) > 5
    with Image.open(out / "open_loop.gif") as picture:
        assert picture.size == (3 * 192, 192 + 2 * films.LINE) and picture.n_frames > 10
    with Image.open(out / "agent.gif") as picture:
        assert picture.n_frames > 10
    before = DreamerV2.load(out / f"pretrained_{pretrain_frames}.zip", device="cpu")
    after = DreamerV2.load(out / "finetuned.zip", device="cpu")
    assert (before.phase, before.phase_frames) == ("pretraining", pretrain_frames)
    assert after.phase == "finetuning" and after._n_updates > before._n_updates > 0 and after._planner_is_on()


def test_run_demo(tmp_path, fake_walker, capsys):
    out = tmp_path / "deep" / "out"
    result = run_demo(DemoConfig(out, "walker-walk", 480, 480, episodes=2, preset="tiny"))
    assert fake_walker == [("urlb/walker-walk-v0", {"fast_render": True, "render_mode": "rgb_array"})]
    check_output(out, 480, 16)
    # The counting environment pays 0, 1, 0.5 in turn, whatever one does.
    assert result == {"fine-tuned agent": 60.0, "random policy": 60.0, "oracle": 965}
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("fine-tuned agent", "random policy", "oracle", "open_loop.gif", "walker-walk"))


@pytest.mark.slow
def test_run_demo_on_the_real_walker(tmp_path):
    result = run_demo(DemoConfig(tmp_path, "walker-stand", 1100, 1100, episodes=1, preset="tiny"))
    check_output(tmp_path, 1100, 64)
    assert all(0 <= result[name] <= 1000 for name in result)


# -- command line ----------------------------------------------------------------------------------------------------------


def test_arguments_reach_the_demo(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(demo_pixels, "run_demo", seen.append)
    arguments = ["--task", "walker-run", "--seed", "3", "--pretrain-frames", "7", "--finetune-frames", "8", "--episodes", "9"]
    assert __main__.main(["demo-pixels", "--out", str(tmp_path), *arguments, "--preset", "tiny"]) == 0
    assert __main__.main(["demo-pixels"]) == 0
    assert seen == [DemoConfig(tmp_path, "walker-run", 7, 8, 9, 3, "tiny"), DemoConfig()]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "walker-fly"], "Unknown task 'walker-fly'; known are"),
        (["--preset", "huge"], "Unknown preset 'huge'; known are"),
        (["--pretrain-frames", "0"], "pretrain_frames must be positive|frames must be positive"),
    ],
)
def test_errors_are_one_line_and_status_two(fake_walker, tmp_path, capsys, arguments, message):
    assert __main__.main(["demo-pixels", "--out", str(tmp_path / "out"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-dreamer-urlb: ") and re.search(message, error) and error.count("\n") == 1


def test_less_than_an_episode_is_enough(fake_walker, tmp_path, capsys):
    run_demo(DemoConfig(tmp_path, "walker-walk", 10, 10, episodes=1, preset="tiny"))
    assert (tmp_path / "report.html").exists() and "mean return of 1 episode\n" in capsys.readouterr().out


@pytest.mark.parametrize("number", [{"episodes": 0}, {"finetune_frames": -5000}])
@pytest.mark.filterwarnings("ignore")
def test_numbers_that_make_no_sense_are_refused_at_once(fake_walker, tmp_path, monkeypatch, number):
    monkeypatch.setattr(demo_pixels, "_train", lambda *_: pytest.fail("it trained"))
    with pytest.raises(ValueError, match=f"got {next(iter(number.values()))}|{next(iter(number))}"):
        demo_pixels.run_demo(demo_pixels.DemoConfig(out=tmp_path / "out", preset="tiny", **number))


@pytest.mark.parametrize(
    "arguments", [[], ["play"], ["demo-pixels", "--seed", "x"], ["demo-pixels", "--episodes", "0"], ["demo", "--seed", "-1"]]
)
def test_a_wrong_command_line_is_refused(arguments, capsys):
    with pytest.raises(SystemExit) as error:
        __main__.main(arguments)
    assert error.value.code == 2 and "usage: sb3-dreamer-urlb" in capsys.readouterr().err


def test_the_version_is_told(capsys):
    with pytest.raises(SystemExit, match=r"^0$"):
        __main__.main(["--version"])
    assert capsys.readouterr().out == f"sb3_dreamer_urlb {__version__}\n"


def test_missing_plots_are_told_before_any_training(fake_walker, tmp_path, monkeypatch, capsys):
    def missing():
        raise ImportError(figures.MISSING_PLOTS)

    monkeypatch.setattr(figures, "check_plots_installed", missing)
    assert __main__.main(["demo-pixels", "--out", str(tmp_path / "out")]) == 2
    assert "pip install" in capsys.readouterr().err and not (tmp_path / "out").exists() and fake_walker == []


# -- evaluation ------------------------------------------------------------------------------------------------------------


def test_play_episode(tiny_model):
    env = CounterEnv(9, rewards=[1.0])
    episode = play_episode(tiny_model(env), env, seed=0, render=True)
    assert episode.observations.shape == (10, 16, 16, 3) and episode.actions.shape == (9, 2)
    assert np.array_equal(episode.actions, env.received[-1]) and episode.total_reward == 9
    assert len(episode.frames) == 9 and play_episode(tiny_model(env), env).frames == []


def test_evaluate_uses_the_same_seeds_for_everyone(monkeypatch):
    env, seeds = CounterEnv(3), []
    original = env.reset
    monkeypatch.setattr(env, "reset", lambda *, seed=None, options=None: seeds.append(seed) or original(seed=seed))
    assert evaluate(RandomPolicy(env.action_space), env, 3) == [1.5] * 3
    evaluate(RandomPolicy(env.action_space), env, 3)
    assert seeds == [1000, 1001, 1002] * 2


def test_random_policy_is_seeded():
    space = spaces.Box(-1, 1, (2,), np.float32)
    drawn = [[RandomPolicy(space, seed).predict(np.zeros(1))[0] for _ in range(3)] for seed in (1, 1, 2)]
    assert np.array_equal(drawn[0], drawn[1]) and not np.array_equal(drawn[0], drawn[2])


def test_open_loop_predicts_without_seeing(tiny_model):
    """The first frames are inferred from observations, the later ones follow from the actions alone."""
    env = CounterEnv(40)
    model = tiny_model(env)
    episode = play_episode(model, env)

    def predict():
        th.manual_seed(0)
        return figures.open_loop(model.policy, episode, start=10, steps=20)

    truth, predicted = predict()
    assert truth.shape == predicted.shape == (25, 16, 16, 3) and predicted.dtype == np.uint8
    assert np.array_equal(truth, episode.observations[10:35])
    episode.observations[10 + figures.CONTEXT :] = 0
    assert np.array_equal(predict()[1], predicted)
    episode.observations[10 : 10 + figures.CONTEXT, 4:] = 255
    assert not np.array_equal(predict()[1], predicted)


def test_open_loop_predicts_from_the_actions(tiny_model):
    env = CounterEnv(40)
    model = tiny_model(env)
    world_model = model.policy.agent.world_model
    with th.no_grad():
        world_model.rssm.input.weight[:, -2:] *= 20  # actions matter, and pictures show it
        world_model.decoder.input.weight *= 20
    episode = play_episode(model, env)

    def predict(changed=None):
        played = dataclasses.replace(episode, actions=episode.actions.copy())
        if changed is not None:
            played.actions[changed] = -np.sign(played.actions[changed])
        th.manual_seed(0)
        return figures.open_loop(model.policy, played, start=10, steps=20)[1]

    border = 10 + figures.CONTEXT  # the first observation that is not shown; the action before led to it
    same = [np.array_equal(*pair) for pair in zip(predict(), predict(border - 1), strict=True)]
    assert all(same[: figures.CONTEXT]) and not same[figures.CONTEXT]
    same = [np.array_equal(*pair) for pair in zip(predict(), predict(border), strict=True)]
    assert all(same[: figures.CONTEXT + 1]) and not same[figures.CONTEXT + 1]
    assert np.array_equal(predict(), predict(9 + 20 + figures.CONTEXT))  # leads past the end


def test_three_panels():
    truth, model = np.full((2, 4, 5, 3), 200, np.uint8), np.full((2, 4, 5, 3), 100, np.uint8)
    panels = figures.truth_model_error(truth, model)
    assert panels.shape == (2, 4, 15, 3) and panels.dtype == np.uint8
    assert panels[0, 0, [0, 5, 10], 0].tolist() == [200, 100, 178]


def test_a_labelled_film():
    truth, model = (np.full((7, 16, 24, 3), level, np.uint8) for level in (200, 100))
    film = figures.labelled_open_loop(truth, model, context=2, start=30)
    assert film.shape == (7, 16 * 8 + 2 * films.LINE, 3 * 192, 3) and film.dtype == np.uint8
    panels = film[:, films.LINE : -films.LINE]
    assert np.array_equal(panels[:, ::8, ::8], figures.truth_model_error(truth, model))
    above, below = film[:, : films.LINE], film[:, -films.LINE :]
    assert all(above[0, :, i * 192 : (i + 1) * 192].any() for i in range(3)) and (above == above[0]).all()
    assert len({line.tobytes() for line in below}) == 7  # each its step


def test_errors_over_the_horizon(tiny_model, tmp_path):
    env = CounterEnv(40)
    model = tiny_model(env)
    episode = play_episode(model, env)
    assert episode.rewards.tolist() == [(0.0, 1.0, 0.5)[i % 3] for i in range(40)] and episode.total_reward == sum(
        episode.rewards
    )
    th.manual_seed(0)
    errors, rewards = figures.open_loop_errors(model.policy, episode, 10, 20, tmp_path / "errors.png")
    th.manual_seed(0)
    truth, predicted = figures.open_loop(model.policy, episode, 10, 20)
    assert errors == pytest.approx(np.sqrt(((truth.astype(float) - predicted) ** 2).mean((1, 2, 3))))
    assert rewards.shape == (25,) and np.isfinite(rewards).all()
    with Image.open(tmp_path / "errors.png") as picture:
        assert picture.width > 800 and len(picture.convert("L").getcolors(256) or []) > 5


def test_scores():
    assert len(ORACLE) == 12 and all(f"urlb/{task}-v0" in gymnasium.registry for task in ORACLE)
    assert normalized_score("walker-stand", 909) == 1
