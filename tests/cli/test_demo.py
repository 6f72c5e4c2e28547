"""The demonstration and its command line."""

from __future__ import annotations

import re
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from sb3_dreamer_urlb import DreamerV2, __main__
from sb3_dreamer_urlb.cli import demo_agents, pace, side_by_side
from sb3_dreamer_urlb.cli.demo_agents import Agent
from sb3_dreamer_urlb.cli.demo_pictures import curves, film
from sb3_dreamer_urlb.cli.pace import Pace
from sb3_dreamer_urlb.cli.side_by_side import PRETRAINED, SCRATCH, SHIPPED, DemoConfig, run_demo
from sb3_dreamer_urlb.evaluation.rows import read_rows
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize


def test_everything_promised_is_written(tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    means = run_demo(DemoConfig(out, "walker-run", 1000, 1000, episodes=1, preset="tiny"))
    assert {path.name for path in out.iterdir()} == {
        *("scratch", "pretrained", "exploration"),
        *("learning_curves.png", "agents.gif", "compare.html", "compare.png", "compare.pdf"),
    }
    for name, folder in ((SCRATCH, "scratch"), (PRETRAINED, "pretrained")):
        returns = demo_agents.episodes(out / folder)
        assert len(returns) == 1 and means[name] == pytest.approx(np.mean(returns))
        rows = read_rows(out / folder / "rows.csv").rows
        assert [(row.task, row.planner, row.finetune_frames) for row in rows] == [
            ("run", "none", 1000),
            ("run", "dyna_mpc", 1000),
        ]
        assert [row.pretrain_frames for row in rows] == [1000 * (name == PRETRAINED)] * 2
    assert [row.keep_actor for row in rows] == [True] * 2
    tuned = DreamerV2.load(out / "pretrained" / "finetuned.zip", device="cpu")
    assert (tuned.phase, tuned.phase_frames, tuned.pretrained_frames) == ("finetuning", 1000, 1000)
    with Image.open(out / "agents.gif") as picture:
        assert picture.n_frames > 10 and picture.width == 2 * demo_agents.FILM_SIDE
    printed = capsys.readouterr().out
    assert all(text in printed for text in (SCRATCH, PRETRAINED, "Dyna-MPC", "random actions", "compare.html", "walker run"))
    # The training episode of both agents was told while they learnt.
    assert re.search(r"^ +1000 +\d+ +\d+$", printed, re.MULTILINE)


def test_the_agent_that_ships_explored_without_a_reward():
    assert SHIPPED.stat().st_size < 4e6
    model = DreamerV2.load(SHIPPED, device="cpu")
    assert (model.preset, model.intrinsic_reward, model.phase, model.phase_frames) == (
        side_by_side.PRESET,
        "lbs",
        "pretraining",
        40_000,
    )
    env = demo_agents.make_env("urlb/walker-flip-v0", statistics=beside(SHIPPED))
    assert env.obs_rms.count > 20_000 and env.training and not env.norm_reward


def test_the_shipped_agent_learns_another_task(tmp_path, monkeypatch):
    """Its actor and world model are kept; the statistics of its observations go on."""
    monkeypatch.setattr(demo_agents, "_play", lambda *_: None)
    agent = Agent(tmp_path / "agent", "urlb/walker-flip-v0", 1000, 0, side_by_side.PRESET, SHIPPED, 1)
    finished = demo_agents.learn_task(agent)
    before, after = (DreamerV2.load(path, device="cpu") for path in (SHIPPED, finished))
    assert after.phase == "finetuning" and after._n_updates == before._n_updates  # a warm-up
    for part in ("world_model.rssm", "actor"):
        pairs = zip(before.policy.agent.get_submodule(part).parameters(),
                    after.policy.agent.get_submodule(part).parameters(), strict=True)  # fmt: skip
        assert all((one == other).all() for one, other in pairs)
    count = load_vec_normalize(beside(SHIPPED), demo_agents.make_env(agent.env_id).venv).obs_rms.count
    moved = load_vec_normalize(beside(finished), demo_agents.make_env(agent.env_id).venv).obs_rms.count
    assert moved >= count + 500


def test_without_a_renderer_only_the_film_is_missing(tmp_path, monkeypatch, capsys):
    original = demo_agents.make_env

    def blind(*args, filmed=False, **kwargs):
        if filmed:
            raise demo_agents.RenderingBackendError("nothing draws here")
        return original(*args, **kwargs)

    monkeypatch.setattr(demo_agents, "make_env", blind)
    demo_agents.learn_task(Agent(tmp_path, "urlb/walker-stand-v0", 1000, 0, "tiny", None, 1))
    assert (tmp_path / "rows.csv").exists() and not (tmp_path / "film.npy").exists()
    assert "No film: nothing draws here" in capsys.readouterr().out


def test_what_an_agent_dies_of_is_told(tmp_path):
    agents = {SCRATCH: Agent(tmp_path, "urlb/walker-run-v0", 1000, 0, "tiny")}

    class Dead:
        def done(self):
            return True

        def result(self):
            raise OSError("no space left on device")

    with pytest.raises(OSError, match="no space left"):
        side_by_side._watch([Dead()], agents, pace.Left(float, 0.0, 1000))


def test_what_is_left_is_told_while_they_learn(tmp_path, monkeypatch, capsys):
    """Ten seconds an episode; two are left, and five seconds after them."""
    clock, played = iter([0.0, 10.0, 20.0]), iter([[1.0], [1.0, 2.0], [1.0, 2.0, 3.0], [1.0, 2.0, 3.0]])

    class Working:
        def done(self):
            self.looks = getattr(self, "looks", 0) + 1
            return self.looks > 6  # two calls a look

        def result(self):
            return tmp_path

    monkeypatch.setattr(side_by_side, "time", SimpleNamespace(monotonic=lambda: next(clock), sleep=lambda _: None))
    monkeypatch.setattr(demo_agents, "episodes", lambda folder: next(played))
    agents = {SCRATCH: Agent(tmp_path, "urlb/walker-run-v0", 5000, 0, "tiny")}
    side_by_side._watch([Working()], agents, pace.Left(lambda frames: frames / 1000, 0.5, 5000))
    lines = capsys.readouterr().out.splitlines()
    assert [line.split() for line in lines] == [
        ["1000", "1"],
        ["2000", "2", "about", "35", "seconds"],
        ["3000", "3", "about", "25", "seconds"],
    ]


def test_half_written_episodes_are_not_read(tmp_path):
    assert demo_agents.episodes(tmp_path) == []
    (tmp_path / "monitor.csv").write_text('#{"t_start": 0}\nr,l,t\n1.5,500,1\n-2,500,2\n3')
    assert demo_agents.episodes(tmp_path) == [1.5, -2.0]


# -- how long --------------------------------------------------------------------------------------------------------------


def fitted(monkeypatch, update, **config):
    monkeypatch.setattr(pace, "measure", lambda *_: Pace(update, 0.0, 0.0, 0.0))
    monkeypatch.setattr(side_by_side, "_at_once", lambda: 2)
    return side_by_side.fitted(DemoConfig(**config))[0]


def test_a_slow_machine_takes_fewer_frames_and_says_so(monkeypatch, capsys):
    assert fitted(monkeypatch, 0.1) == DemoConfig()  # 1800 updates
    printed = capsys.readouterr().out
    assert "in place of" not in printed and "will take about 4 minutes" in printed
    slow = fitted(monkeypatch, 0.75)
    assert 20_000 * side_by_side.LEAST <= slow.finetune_frames < 20_000 and slow.finetune_frames % 1000 == 0
    printed = capsys.readouterr().out
    assert f"{slow.finetune_frames} frames in place of 20000" in printed and "would take about 29 minutes" in printed
    assert fitted(monkeypatch, 100.0).finetune_frames == 8000
    assert fitted(monkeypatch, 100.0, finetune_frames=30_000).finetune_frames == 30_000


@pytest.mark.parametrize(("episodes", "words"), [(1, "about 11 minutes"), (10, "about 43 minutes")])
def test_evaluations_count_and_what_does_not_is_named(monkeypatch, capsys, episodes, words):
    """All episodes are played at once, and a step of all is planned together."""
    monkeypatch.setattr(pace, "measure", lambda model, env, planned: Pace(0.0, {1: 1.0, 10: 4.0}[planned], 0.0, 0.0))
    monkeypatch.setattr(side_by_side, "_at_once", lambda: 2)
    side_by_side.fitted(DemoConfig(finetune_frames=1000, episodes=episodes))
    assert f"Learning and playing will take {words}; starting" in capsys.readouterr().out


def test_one_core_takes_one_agent_after_the_other(monkeypatch):
    monkeypatch.setattr(side_by_side.os, "sched_getaffinity", lambda _: {0}, raising=False)
    assert side_by_side._at_once() == 1
    monkeypatch.setattr(side_by_side.os, "sched_getaffinity", lambda _: {0, 1, 5}, raising=False)
    assert side_by_side._at_once() == 2


# -- command line ----------------------------------------------------------------------------------------------------------


def test_arguments_reach_the_demo(monkeypatch, tmp_path):
    seen = []
    monkeypatch.setattr(side_by_side, "run_demo", seen.append)
    frames = ["--pretrain-frames", "7000", "--finetune-frames", "8000"]
    arguments = ["--task", "walker-run", "--seed", "3", *frames, "--episodes", "9"]
    assert __main__.main(["demo", "--out", str(tmp_path), *arguments]) == 0
    assert __main__.main(["demo"]) == 0
    assert seen == [DemoConfig(tmp_path, "run", 8000, 7000, 9, 3), DemoConfig()]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--task", "fly"], "Unknown task 'fly'; known are stand, walk, run, flip"),
        (["--task", "quadruped-run"], "Unknown task 'quadruped-run'"),
        (["--finetune-frames", "999"], "finetune_frames must be an integer of at least 1000, got 999"),
        (["--pretrain-frames", "10"], "pretrain_frames must be an integer of at least 1000, got 10"),
    ],
)
def test_errors_are_one_line_and_status_two(tmp_path, capsys, arguments, message):
    assert __main__.main(["demo", "--out", str(tmp_path / "out"), *arguments]) == 2
    error = capsys.readouterr().err
    assert error.startswith("sb3-dreamer-urlb: ") and message in error and error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_another_preset_needs_a_pre_training():
    with pytest.raises(ValueError, match="preset='tiny' needs pretrain_frames"):
        DemoConfig(preset="tiny")


# -- pictures --------------------------------------------------------------------------------------------------------------


def test_curves(tmp_path):
    curves({SCRATCH: [1.0, 2.0, 3.0], PRETRAINED: [4.0] * 9}, 1000, 2.0, "walker run", tmp_path / "curves.png")
    with Image.open(tmp_path / "curves.png") as picture:
        assert picture.width > 400 and len(picture.convert("L").getcolors(256) or []) > 5


def test_films_stand_beside_each_other(tmp_path):
    panels = {name: np.full((length, 32, 48, 3), level, np.uint8) for name, length, level in (("a", 4, 20), ("b", 3, 200))}
    film(panels, tmp_path / "film.gif")
    with Image.open(tmp_path / "film.gif") as picture:
        assert picture.n_frames in (1, 3) and picture.width == 96
        pixels = np.asarray(picture.convert("L"))
    assert abs(int(pixels[-1, 5]) - 20) < 8 and abs(int(pixels[-1, 90]) - 200) < 8


@pytest.mark.parametrize(("frames", "told"), [(1000, True), (2000, True), (3000, False)])
def test_frames_that_hold_no_update(monkeypatch, capsys, frames, told):
    fitted(monkeypatch, 0.1, finetune_frames=frames)
    assert ("hold no update: agents learn from frame 2000 on" in capsys.readouterr().out) == told
