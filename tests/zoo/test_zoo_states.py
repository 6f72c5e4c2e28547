"""The zoo's files for states and for perturbed tasks: what they say, and both phases through the commands."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import rl_zoo3.utils
import yaml
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from zoo_commands import CONFIGS, STAND, TRAIN, model_in, train

from sb3_dreamer_urlb import DreamerV2, envs
from sb3_dreamer_urlb.cli.tasks import tasks
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.snapshots.vec_normalize import beside
from sb3_dreamer_urlb.zoo import pretraining
from sb3_dreamer_urlb.zoo.__main__ import main

STATES = [f"states/{folder}{name}.yml" for folder in ("", "small/") for name in ("lbs", "scratch", "finetune")]
PERTURBED = [f"rwrl/{name}.yml" for name in ("walker", "quadruped", "finetune")]
VARIANTS = [task.id for task in tasks() if task.id.count("-") == 3 and "jaco" in task.id]
RWRL = {body: [f"rwrl/{body}-walk-{level}-v0" for level in ("easy", "medium", "hard")] for body in ("walker", "quadruped")}
#: keys that are rl_zoo3's or the zoo's
OWN = ("callback", "n_timesteps", "env_kwargs", "normalize", "checkpoint")
BENCHMARK = [envs.env_id(domain, task) for domain, names in envs.URLB_TASKS.items() for task in names]


def entries(file):
    return yaml.safe_load((CONFIGS / file).read_text())


def test_there_are_no_other_files():
    folders = (CONFIGS / "states", CONFIGS / "rwrl")
    found = [path.relative_to(CONFIGS).as_posix() for folder in folders for path in folder.rglob("*.*")]
    assert sorted(found) == sorted([*STATES, *PERTURBED])


@pytest.mark.parametrize("file", [*STATES, *PERTURBED])
def test_every_file_has_its_tasks_alike(file):
    bodies = [body for body in RWRL if body in file] or list(RWRL)
    expected = [name for body in bodies for name in RWRL[body]] + (BENCHMARK if file in STATES else [])
    read = entries(file)
    assert sorted(read) == sorted(expected) and set(expected) <= set(gymnasium.registry)
    [entry] = {yaml.dump(entry): entry for entry in read.values()}.values()
    if file in STATES:
        assert (entry["policy"], entry["env_kwargs"]) == ("MlpPolicy", {"observation": "state"})
        assert entry["normalize"] == {"norm_reward": False}
        # What is fine-tuned has its snapshot's preset.
        assert entry.get("preset") == (None if "finetune" in file else "state-small" if "small" in file else "state")
    else:
        assert entry == entries("finetune.yml" if "finetune" in file else "lbs.yml")["urlb/walker-stand-v0"]


@pytest.mark.parametrize("folder", ["states/", "states/small/"])
def test_frames_of_the_phases(folder):
    whole, scratch, finetune = (entries(f"{folder}{name}.yml")[BENCHMARK[0]] for name in ("lbs", "scratch", "finetune"))
    snapshots, switch = rl_zoo3.utils.get_callback_list(whole)
    assert 2 * whole["n_timesteps"] - switch.pretrain_frames == 2 * scratch["n_timesteps"] == 2 * finetune["n_timesteps"]
    assert snapshots.frames[-1] == switch.pretrain_frames


@pytest.mark.parametrize("file", STATES)
def test_the_constructor_takes_what_a_file_says(file, monkeypatch):
    for preset in ("paper", "state", "state-small"):
        monkeypatch.setitem(PRESETS, preset, PRESETS["tiny"])
    entry = {key: value for key, value in entries(file)[BENCHMARK[0]].items() if key not in OWN}
    env = gymnasium.make("urlb/walker-run-v0", observation="state")
    assert DreamerV2(env=env, device="cpu", **entry).learner is not None


@pytest.mark.parametrize("name", [*BENCHMARK, *VARIANTS, *RWRL["walker"], *RWRL["quadruped"]])
def test_every_id_has_its_bodys_unperturbed_primal_task(name):
    body = next(body for body in envs.DOMAINS if f"/{body}-" in name)
    assert pretraining.primal_id(name) == envs.env_id(body, envs.PRIMAL_TASK[body])


@pytest.mark.parametrize("name", ["CartPole-v1", "urlb/dm_control-v0", "rwrl/jaco-walk-easy-v0", "rwrl/walker-walk-worse-v0"])
def test_what_has_no_primal_task(name):
    assert pretraining.primal_id(name) is None


#: two real episodes of pre-training: a replay holds whole ones
PHASES = [
    "preset:'tiny'",
    "train_freq:50",
    "callback:[{'sb3_dreamer_urlb.zoo.callbacks.RunSnapshotCallback': dict(frames=[1000])},"
    "{'sb3_dreamer_urlb.PhaseSwitchCallback': dict(pretrain_frames=1000)}]",
]
EASY, HARD = "rwrl/walker-walk-easy-v0", "rwrl/walker-walk-hard-v0"
#: the real one, for the zoo's tests put a cheaper one in its place
WALKER_STAND = gymnasium.registry[STAND]


def statistics_of(run, name):
    env = DummyVecEnv([lambda: gymnasium.make(name, observation="state")])
    return VecNormalize.load(str(run / name.replace("/", "-") / "vecnormalize.pkl"), env)


def test_a_whole_run_then_a_fine_tuning_from_its_snapshot(zoo, monkeypatch, capsys):
    """Pre-trained unperturbed, normalised throughout, with one set of statistics: in both phases, and from the snapshot on."""
    monkeypatch.setitem(gymnasium.registry, STAND, WALKER_STAND)
    run = train(zoo, EASY, 550, "states/small/lbs", params=PHASES)
    assert f"Pre-training in {STAND}, fine-tuning in {EASY}" in capsys.readouterr().out
    model = model_in(run, EASY)
    assert (model.phase, model.phase_timesteps) == ("finetuning", 50)
    whole = statistics_of(run, EASY)
    assert 550 <= whole.obs_rms.count < 555 and not whole.norm_reward and whole.norm_obs

    snapshot = run / "snapshots" / "snapshot_1000.zip"
    evaluated = ["-i", str(snapshot), "--eval-freq", "50", "--eval-episodes", "1"]
    tuned = train(zoo, HARD, 50, "states/small/finetune", *evaluated)
    # Of training and of evaluation.
    assert capsys.readouterr().out.count(f"normalised as {beside(snapshot)} says") == 2
    its = statistics_of(tuned, HARD)
    assert 550 <= its.obs_rms.count < 555 and not its.norm_reward
    # Fifty steps more do not move the mean of 500 far; fresh statistics would be far away.
    np.testing.assert_allclose(its.obs_rms.mean, whole.obs_rms.mean, atol=0.5)

    zoo("enjoy", "--algo", "dreamerv2", "--env", HARD, "-f", "logs", "-n", "3", "--no-render")
    zoo("record_video", "--algo", "dreamerv2", "--env", HARD, "-f", "logs", "-n", "3")
    assert next(tuned.rglob("*.mp4")).stat().st_size > 0

    options = ["--env", HARD, "-conf", str(CONFIGS / "rwrl" / "finetune.yml"), "-n", "8", "-i", str(snapshot)]
    with pytest.raises(SystemExit):
        main([*TRAIN, *options, "-params", "env_kwargs:dict(observation='state')", "policy:'MlpPolicy'"])
    assert "normalize: {norm_reward: false}" in capsys.readouterr().err


def test_the_command_line_changes_what_it_names_of_a_files_arguments(zoo, monkeypatch, capsys):
    """The paper's range of thighs, from states as the file says; pre-trained unperturbed all the same."""
    monkeypatch.setitem(gymnasium.registry, STAND, WALKER_STAND)
    made = []
    make = EnvSpec.make
    monkeypatch.setattr(EnvSpec, "make", lambda spec, **kwargs: made.append((spec.id, kwargs)) or make(spec, **kwargs))
    run = train(zoo, HARD, 8, "states/small/lbs", "--env-kwargs", "hard_thigh:'paper'", params=PHASES)
    kwargs = dict(made)
    assert {name: value for name, value in kwargs[STAND].items() if name != "render_mode"} == {"observation": "state"}
    assert kwargs[HARD] | {"observation": "state", "hard_thigh": "paper"} == kwargs[HARD]
    saved = yaml.unsafe_load((run / HARD.replace("/", "-") / "config.yml").read_text())
    assert dict(saved)["env_kwargs"] == {"observation": "state", "hard_thigh": "paper"}
    zoo("enjoy", "--algo", "dreamerv2", "--env", HARD, "-f", "logs", "-n", "3", "--no-render")


def test_a_start_that_is_refused_leaves_no_run(zoo, monkeypatch, capsys):
    monkeypatch.setitem(gymnasium.registry, STAND, WALKER_STAND)
    run = train(zoo, STAND, 8, "states/small/lbs", params=PHASES)
    for wrong in ("level:'easy'", "task:'run'", "camera:'top'"):
        with pytest.raises(SystemExit, match=r"^2$"):
            train(zoo, STAND, 8, "states/small/lbs", "--env-kwargs", wrong, params=PHASES)
    with pytest.raises(SystemExit, match=r"^2$"):
        train(zoo, STAND, 8, "states/small/lbs", params=[*PHASES, "batch_size:-1"])
    assert [path for path in run.parent.iterdir() if path.is_dir()] == [run]
    zoo("enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "logs", "-n", "3", "--no-render")
