"""rl_zoo3's commands with DrQv2: its YAML files, and a run through both phases."""

from __future__ import annotations

import gymnasium
import pytest
import rl_zoo3.utils
import yaml
from fake_envs import CounterEnv
from zoo_commands import CONFIGS, FLIP, STAND, TINY

from sb3_dreamer_urlb import DrQv2
from sb3_dreamer_urlb.drq_v2.presets import PRESETS
from sb3_dreamer_urlb.envs import URLB_TASKS, env_id

FILES = [f"{folder}{name}.yml" for folder in ("", "small/") for name in ("disagreement", "scratch", "finetune")]
VECTORS = "vectors.yml"
TRAIN = ["train", "--algo", "drq_v2", "--seed", "1", "--device", "cpu", "--verbose", "0", "--eval-freq", "-1"]


def entries(file):
    return yaml.safe_load((CONFIGS / "drq_v2" / file).read_text())


def model_of(env, number):
    name = env.replace("/", "-")
    return DrQv2.load(f"logs/drq_v2/{name}_{number}/{name}.zip", device="cpu")


def test_there_are_no_other_files():
    folder = CONFIGS / "drq_v2"
    assert sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*")) == sorted([*FILES, VECTORS])


@pytest.mark.parametrize("file", FILES)
def test_every_file_has_all_twelve_tasks_alike_in_84_pixels(file):
    tasks = [env_id(domain, task) for domain, tasks in URLB_TASKS.items() for task in tasks]
    read = entries(file)
    assert sorted(read) == sorted(tasks)
    [entry] = {yaml.dump(entry): entry for entry in read.values()}.values()
    assert entry["env_kwargs"] == {"image_size": 84}


@pytest.mark.parametrize("folder", ["", "small/"])
def test_frames_of_the_phases_are_those_of_dreamer_v2(folder):
    for file, other in (("disagreement", "lbs"), ("scratch", "scratch"), ("finetune", "finetune")):
        mine = entries(f"{folder}{file}.yml")[STAND]
        theirs = yaml.safe_load((CONFIGS / f"{folder}{other}.yml").read_text())[STAND]
        assert mine["n_timesteps"] == theirs["n_timesteps"]
        if other == "lbs":
            switches = [rl_zoo3.utils.get_callback_list(entry)[1] for entry in (mine, theirs)]
            assert switches[0].pretrain_frames == switches[1].pretrain_frames


@pytest.mark.parametrize("file", FILES)
def test_the_constructor_takes_what_every_file_says(file, monkeypatch):
    for preset in ("paper", "small"):
        monkeypatch.setitem(PRESETS, preset, PRESETS["tiny"])
    entry = dict(entries(file)[STAND])
    for name in ("callback", "n_timesteps", "env_kwargs"):
        entry.pop(name, None)
    model = DrQv2(env=CounterEnv(), device="cpu", **entry)
    assert model.phase == ("pretraining" if entry.get("intrinsic_reward") else "finetuning")


def test_the_file_for_vectors():
    read = entries(VECTORS)
    assert sorted(read) == ["Pendulum-v1"]
    entry = {name: value for name, value in read["Pendulum-v1"].items() if name not in ("n_timesteps", "checkpoint")}
    assert DrQv2(env=gymnasium.make("Pendulum-v1"), device="cpu", **entry).policy.frame_stack == 1


def test_a_run_through_both_phases_that_goes_on(zoo, capsys):
    zoo(*TRAIN, "--env", STAND, "-n", "60", "-conf", "drq_v2/disagreement", "-params", *TINY)
    model = model_of(STAND, 1)
    assert (model.phase, model.phase_timesteps, model.pretrained_frames) == ("finetuning", 20, 80)
    zoo(*TRAIN, "--env", STAND, "-n", "68", "-i", "logs/drq_v2/urlb-walker-stand-v0_1")
    assert model_of(STAND, 1).phase_timesteps == 28
    zoo(*TRAIN, "--env", FLIP, "-n", "24", "-conf", "finetune",
        "-i", "logs/drq_v2/urlb-walker-stand-v0_1/snapshots/snapshot_80.zip")  # fmt: skip
    tuned = model_of(FLIP, 1)
    assert (tuned.phase, tuned.phase_timesteps, tuned.intrinsic_reward) == ("finetuning", 24, "disagreement")
    zoo("enjoy", "--algo", "drq_v2", "--env", FLIP, "-f", "logs", "-n", "25", "--device", "cpu")
    assert "Mean reward" in capsys.readouterr().out


@pytest.mark.parametrize(("task", "file"), [("Pendulum-v1", "drq_v2/vectors.yml"), (STAND, "drq_v2/disagreement.yml")])
def test_tasks_find_their_file(zoo, task, file, capsys):
    zoo(*TRAIN, "--env", task, "-n", "24", "-params", *TINY[:1], "train_freq:4")
    assert file in capsys.readouterr().out and model_of(task, 1).num_timesteps == 24


def test_the_search_tries_arguments_that_the_constructor_takes():
    import optuna

    from sb3_dreamer_urlb.zoo.sampler import sample_drq_v2_params

    study = optuna.create_study()
    found = sample_drq_v2_params(study.ask(), 2, 1, {})
    assert DrQv2("CnnPolicy", CounterEnv(), preset="tiny", device="cpu", **found).learn(8).num_timesteps == 8
