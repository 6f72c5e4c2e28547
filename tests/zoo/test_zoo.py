"""rl_zoo3's commands with DreamerV2: the YAML files, and each command at tiny size."""

from __future__ import annotations

import copy
import itertools
import os
import re
import shlex
import subprocess
import sys
import warnings
import zipfile
from pathlib import Path
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import rl_zoo3.utils
import yaml
from fake_envs import CounterEnv
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from places import PYTHONPATH, ROOT
from rl_zoo3.exp_manager import ExperimentManager
from snapshot_files import code_events
from stable_baselines3.common import utils
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from zoo_commands import CHEAP, CONFIGS, FLIP, STAND, TINY, TRAIN, latest_run, model_in, train

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.envs import DOMAINS, PRIMAL_TASK, URLB_TASKS, SupervisedVecEnv, env_id
from sb3_dreamer_urlb.hub.privacy import without_private_paths
from sb3_dreamer_urlb.zoo import configs, mistakes, pretraining, registration
from sb3_dreamer_urlb.zoo import hub as zoo_hub
from sb3_dreamer_urlb.zoo.__main__ import COMMANDS, main
from sb3_dreamer_urlb.zoo.callbacks import RunSnapshotCallback

METHODS = ("lbs", "plan2explore", "icm", "rnd", "apt", "diayn", "aps", "random")
OTHERS = ("scratch", "finetune")
FILES = [f"{folder}{name}.yml" for folder in ("", "small/") for name in (*METHODS, *OTHERS)]
VECTORS = "vectors.yml"


def entries(file: str) -> dict[str, dict]:
    """What rl_zoo3 reads from a configuration."""
    return yaml.safe_load((CONFIGS / file).read_text())


def leaves(value):
    """All scalars inside nested lists and dictionaries."""
    if isinstance(value, dict | list):
        for inner in value.values() if isinstance(value, dict) else value:
            yield from leaves(inner)
    else:
        yield value


# -- the files -------------------------------------------------------------------------------------------------------------


def test_there_are_no_other_files():
    found = sorted(path.relative_to(CONFIGS).as_posix() for path in CONFIGS.rglob("*.*"))
    elsewhere = ("drq_v2/", "rwrl/", "states/")  # have tests of their own
    assert [name for name in found if not name.startswith(elsewhere)] == sorted([*FILES, VECTORS])


@pytest.mark.parametrize("file", FILES)
def test_every_file_has_all_twelve_tasks(file):
    tasks = [env_id(domain, task) for domain, tasks in URLB_TASKS.items() for task in tasks]
    assert sorted(entries(file)) == sorted(tasks) and set(tasks) <= set(gymnasium.registry)
    # The comment in the files says that all tasks run alike.
    [entry] = {yaml.dump(entry): entry for entry in copy.deepcopy(entries(file)).values()}.values()
    for value in leaves(entry):
        # YAML's 3e-4 is a string.
        assert not (isinstance(value, str) and re.fullmatch(r"[-+\d.eE]+", value)), value
    if Path(file).stem in METHODS:
        assert entry["intrinsic_reward"] == Path(file).stem
    assert entry.get("preset", "small" if "finetune" in file and "small/" in file else "paper") == (
        "small" if file.startswith("small/") else "paper"
    )


@pytest.mark.parametrize("folder", ["", "small/"])
def test_the_methods_files_differ_in_nothing_but_the_method(folder):
    def comparable(method):
        read = entries(f"{folder}{method}.yml")
        for entry in {id(entry): entry for entry in read.values()}.values():  # one, under twelve names
            entry["intrinsic_reward"] = "any"
            # Without its pre-trained actor a skill means nothing.
            dropped = {"keep_actor": False} if folder and method not in ("diayn", "aps") else {}
            switch = entry["callback"][1]["sb3_dreamer_urlb.PhaseSwitchCallback"] if folder else {}
            assert {name: switch.pop(name) for name in ("keep_actor",) if name in switch} == dropped
        return read

    first = comparable("lbs")
    for method in METHODS:
        other = comparable(method)
        assert other == first and list(other) == list(first)


@pytest.mark.parametrize("folder", ["", "small/"])
def test_frames_of_the_phases(folder):
    """Fine-tuning, from-scratch runs and the second phase of a whole run are equally long; the paper's are the paper's."""
    whole, scratch, finetune = (entries(f"{folder}{name}.yml")[STAND] for name in ("lbs", "scratch", "finetune"))
    [snapshots, switch] = rl_zoo3.utils.get_callback_list(whole)
    frames = 2 * whole["n_timesteps"]
    assert frames - switch.pretrain_frames == 2 * scratch["n_timesteps"] == 2 * finetune["n_timesteps"]
    assert snapshots.frames[-1] == switch.pretrain_frames
    if not folder:
        assert (switch.pretrain_frames, frames, len(snapshots.frames)) == (2_000_000, 2_100_000, 4)


@pytest.mark.parametrize("file", FILES)
def test_the_constructors_take_what_every_file_says(file, monkeypatch):
    for preset in ("paper", "small"):
        monkeypatch.setitem(PRESETS, preset, PRESETS["tiny"])
    for entry in entries(file).values():
        callbacks = rl_zoo3.utils.get_callback_list(entry)
        arguments = {name: value for name, value in entry.items() if name not in ("callback", "n_timesteps")}
        model = DreamerV2(env=CounterEnv(), device="cpu", **arguments)
        assert model.phase == ("pretraining" if arguments.get("intrinsic_reward") else "finetuning")
        assert len(callbacks) == {"scratch": 0, "finetune": 1}.get(Path(file).stem, 2)
        with pytest.raises(TypeError, match="pretrain_frames"):
            DreamerV2(env=CounterEnv(), device="cpu", pretrain_frames=3, **arguments)


def test_the_file_for_vectors():
    """Both tasks at full size: what the file says is what the constructor takes."""
    read = entries(VECTORS)
    assert sorted(read) == ["CartPole-v1", "Pendulum-v1"]
    for task, entry in read.items():
        entry = dict(entry)
        assert entry.pop("n_timesteps") <= 50_000 and entry.pop("normalize") is True and entry["preset"] == "vector"
        assert entry.pop("checkpoint") == {"every_frames": 1000}
        for value in leaves(entry):
            assert not (isinstance(value, str) and re.fullmatch(r"[-+\d.eE]+", value)), value
        model = DreamerV2(env=gymnasium.make(task), device="cpu", **entry)
        assert model.replay_buffer.sampling == "rows" and model.replay_buffer.can_sample() is False
        assert model.learner.config.actor_gradient == {"CartPole-v1": "reinforce", "Pendulum-v1": "dynamics"}[task]


def test_the_page_names_what_exists():
    page = (ROOT / "docs" / "zoo.md").read_text().replace(" \\\n    ", " ")
    assert all(f"`{env_id(domain, task)}`" in page for domain, task in PRIMAL_TASK.items())
    commands = re.findall(r"^python -m sb3_dreamer_urlb\.zoo (\w+) (-.*)$", page, re.MULTILINE)
    assert {command for command, _ in commands} == set(COMMANDS)
    for command, options in commands:
        assert set(re.findall(r"(?:--env|-e) (\S+)", options)) < set(gymnasium.registry)
        # Neither a run that goes on nor a task that is found needs a file.
        found = any(f"--env {task} " in options for task in entries(VECTORS)) or re.search(r"-i \S+_1$", options)
        named = command == "train" and not found
        [algorithm] = re.findall(r"(?:--algo|-a) (\S+)", options)
        files = [Path(configs.resolve(name, algorithm)) for name in re.findall(r"-conf (\S+)", options)]
        assert [path.is_file() for path in files] == [True] * named
    [own] = yaml.safe_load(re.search(r"```yaml\n(.*?)```", page, re.DOTALL)[1]).values()
    assert own["learning_rate"] == 1e-4 and len(rl_zoo3.utils.get_callback_list(own)) == 3


# -- the commands ----------------------------------------------------------------------------------------------------------

CHEAP_WALKERS = f"""
import gymnasium
import sb3_dreamer_urlb
for name in ({STAND!r}, {FLIP!r}):
    gymnasium.registry[name].entry_point, gymnasium.registry[name].kwargs = "fake_envs:CounterEnv", {CHEAP!r}
"""


def in_a_process(arguments: list[str], folder: Path, tests: bool = True) -> str:
    """Run Python with this checkout; gives what it printed."""
    paths = [PYTHONPATH if tests else str(ROOT)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *arguments], cwd=folder, env=env, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_command_line_from_pre_training_to_a_film(tmp_path):
    """As a user types it: three processes, in a folder that is not the repository's."""
    (tmp_path / "custom_envs.py").write_text(CHEAP_WALKERS)
    command = ["-m", "sb3_dreamer_urlb.zoo"]
    common = ["--eval-freq", "-1", "-n"]
    pretrain = [*TRAIN, "--env", STAND, "-conf", str(CONFIGS / "lbs.yml"), *common, "40", "-P", "-params", *TINY]
    printed = in_a_process([*command, *pretrain], tmp_path)
    assert "40/40" in printed
    snapshot = "logs/dreamerv2/urlb-walker-stand-v0_1/snapshots/snapshot_80.zip"
    finetune = [*TRAIN, "--env", FLIP, "-conf", str(CONFIGS / "finetune.yml"), "-i", snapshot, *common, "40"]
    printed = in_a_process([*command, *finetune], tmp_path)
    assert "Fine-tuning what 80 frames of pre-training with 'lbs' left." in printed
    model = model_in(tmp_path / "logs/dreamerv2/urlb-walker-flip-v0_1", FLIP)
    assert (model.phase, model.phase_timesteps, model.planner) == ("finetuning", 40, "dyna_mpc")
    film = ["record_video", "--algo", "dreamerv2", "--env", FLIP, "-f", "logs", "-n", "5"]
    in_a_process([*command, *film], tmp_path)
    [path] = (tmp_path / "logs").rglob("*.mp4")
    assert path.stat().st_size > 0


def test_rl_zoo3_itself_in_the_repository(tmp_path):
    """The literal command, on a real environment, without a configuration named."""
    options = ["--env", STAND, "-n", "8", "--eval-freq", "-1", "-f", str(tmp_path), "-params", *TINY]
    printed = in_a_process(["-m", "rl_zoo3.train", *TRAIN[1:], *options], ROOT, tests=False)
    assert "zoo_configs/lbs.yml" in printed
    model = model_in(latest_run(STAND, tmp_path))
    assert (model.phase, model.phase_timesteps, model.observation_space.shape) == ("pretraining", 8, (3, 64, 64))


@pytest.mark.parametrize("task", ["CartPole-v1", "Pendulum-v1"])
def test_tasks_seen_as_vectors_find_their_file(zoo, task, capsys):
    zoo(*TRAIN, "--env", task, "-n", "30", "--eval-freq", "-1", "-params", "preset:'tiny'", "train_freq:5")
    assert VECTORS in capsys.readouterr().out
    folder = latest_run(task)
    assert (folder / task / "vecnormalize.pkl").is_file() and model_in(folder, task).phase_timesteps == 30


def test_one_run_through_both_phases_with_all_savers(zoo, capsys):
    savers = ["--eval-freq", "30", "--eval-episodes", "1", "--save-freq", "20", "--save-replay-buffer"]
    run = train(zoo, STAND, 60, "lbs", *savers, params=TINY)
    model = model_in(run)
    assert (model.phase, model.phase_timesteps) == ("finetuning", 20)
    assert {path.name for path in (run / "snapshots").iterdir()} == {"snapshot_40.zip", "snapshot_80.zip"}
    saved = {path.name for path in run.iterdir()}
    assert {"best_model.zip", "evaluations.npz", "replay_buffer.pkl", "rl_model_20_steps.zip", "0.monitor.csv"} <= saved
    # All episodes earn the same here: without a new beginning the agent that explored would stay the best.
    assert DreamerV2.load(run / "best_model.zip").phase == "finetuning"
    model.load_replay_buffer(run / "replay_buffer.pkl")
    assert model.replay_buffer.phase == "finetuning"

    # It goes on, with its replay.
    capsys.readouterr()
    run = train(zoo, STAND, 8, "lbs", "-i", f"{run}/urlb-walker-stand-v0.zip", params=TINY)
    assert "Loading replay buffer" in capsys.readouterr().out
    assert (model_in(run).phase, model_in(run).phase_timesteps) == ("finetuning", 28)


def test_a_pre_training_goes_on_and_ends_where_it_was_told(zoo):
    run = train(zoo, STAND, 24, "lbs", "--save-replay-buffer", params=TINY)
    assert model_in(run).phase_frames == 48
    run = train(zoo, STAND, 16, "lbs", "-i", f"{run}/urlb-walker-stand-v0.zip", "--save-replay-buffer", params=TINY)
    # The last step of the run was the last of the pre-training: what is saved is the pre-trained agent.
    assert (model_in(run).phase, model_in(run).phase_frames) == ("pretraining", 80)
    # Snapshots that were due before are not due again.
    assert {path.name for path in (run / "snapshots").iterdir()} == {"snapshot_80.zip"}
    run = train(zoo, STAND, 8, "lbs", "-i", f"{run}/urlb-walker-stand-v0.zip", params=TINY)
    assert (model_in(run).phase, model_in(run).phase_frames) == ("finetuning", 16)


def test_replay_of_another_phase_is_left_out(zoo):
    run = train(zoo, STAND, 60, "lbs", "--save-freq", "20", "--save-replay-buffer", params=TINY)
    early = f"{run}/rl_model_20_steps.zip"
    with pytest.warns(UserWarning, match="a fine-tuning begins with an empty replay buffer"):
        tuned = train(zoo, FLIP, 8, "finetune", "-i", early)
    assert (model_in(tuned, FLIP).phase, model_in(tuned, FLIP).phase_timesteps) == ("finetuning", 8)
    with pytest.warns(UserWarning, match=r"begins empty: .* filled in the phase 'finetuning', the model is in 'pretraining'"):
        resumed = train(zoo, STAND, 8, "lbs", "-i", early, params=TINY)
    assert (model_in(resumed).phase, model_in(resumed).phase_timesteps) == ("pretraining", 28)


def refused(capsys, call, *arguments, **keywords) -> str:
    """The line that a mistake costs."""
    capsys.readouterr()
    with pytest.raises(SystemExit, match=r"^2$"):
        call(*arguments, **keywords)
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("python -m sb3_dreamer_urlb.zoo train: ")
    return line


def test_mistakes_are_named(zoo, monkeypatch, capsys):
    run = train(zoo, STAND, 8, "lbs", params=TINY)
    snapshot = f"{run}/urlb-walker-stand-v0.zip"
    line = refused(capsys, train, zoo, STAND, 8, "small/lbs", "-i", snapshot)
    assert "preset='tiny', the configuration says 'small'" in line
    line = refused(capsys, train, zoo, STAND, 8, "scratch", "-i", snapshot)
    assert "intrinsic_reward='lbs', the configuration says None" in line
    assert "FineTuneCallback needs a pre-trained model" in refused(capsys, train, zoo, FLIP, 8, "finetune", params=TINY[:1])
    monkeypatch.setattr("sb3_dreamer_urlb.zoo.configs.folder", lambda: Path("nowhere"))
    assert "Name a configuration with -conf" in refused(capsys, zoo, *TRAIN, "--env", STAND)
    with pytest.raises(SystemExit):
        main(["dance"])


@pytest.mark.parametrize("steps", ["0", "-5"])
def test_a_run_of_no_steps_is_refused(zoo, capsys, steps):
    line = refused(capsys, zoo, *TRAIN, "--env", STAND, "-conf", "lbs", f"-n={steps}", "-params", *TINY)
    assert f"-n/--n-timesteps must be at least 1, got {steps}" in line


def test_the_command_of_a_run_can_be_pasted_into_a_shell(zoo, monkeypatch):
    given = [
        sys.executable,
        "-m",
        "sb3_dreamer_urlb.zoo",
        "train",
        "-params",
        "preset:'tiny'",
        "checkpoint:dict(every_frames=9)",
    ]
    monkeypatch.setattr(sys, "orig_argv", given)
    run = train(zoo, STAND, 8, "lbs", params=TINY)
    assert shlex.split((run / STAND.replace("/", "-") / "command.txt").read_text()) == given
    assert sys.orig_argv == given


@pytest.mark.parametrize(
    ("option", "said"), [("--seed=x", "argument --seed: invalid int value: 'x'"), ("--sede=1", "arguments: --sede=1")]
)
def test_a_wrong_option_is_not_hidden_by_all_the_others(zoo, capsys, option, said):
    capsys.readouterr()
    with pytest.raises(SystemExit, match=r"^2$"):
        train(zoo, STAND, 8, "lbs", option)
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line and "zoo train --help lists" in line


SWITCH = "sb3_dreamer_urlb.PhaseSwitchCallback"


@pytest.mark.parametrize(
    ("param", "message"),
    [
        (
            "presett:'small'",
            "Unknown hyperparameter 'presett', neither of rl_zoo3's nor of dreamerv2's. Did you mean 'preset'",
        ),
        ("zzz:1", "Unknown hyperparameter 'zzz', neither of rl_zoo3's nor of dreamerv2's."),
        ("preset:tiny", "NameError: name 'tiny' is not defined. Values of -params"),
        ("batch_size:-1", "batch_size must be an integer of at least 1, got -1"),
        ("learning_rate:'fast'", "learning_rate must be a number or 'lin_' and a number, got 'fast'"),
        ("actor_learning_rate:'lin_-1'", "with 1 of the run left it gives -1.0"),
        ("n_envs:'two'", "n_envs must be an integer of at least 1, got 'two'"),
        ("frame_stack:0", "frame_stack must be an integer of at least 1, got 0"),
        ("normalize:'yes please'", "A value that is read as Python cannot be"),
        ("normalize:'True'", "normalize must be true, false, or keyword arguments of VecNormalize as a text, got"),
        ("policy:'CnnPolcy'", "Unknown policy 'CnnPolcy'"),
        (
            "polcy:'MlpPolicy'",
            "Unknown hyperparameter 'polcy', neither of rl_zoo3's nor of dreamerv2's. Did you mean 'policy'",
        ),
        ("policy:3", "policy must be the name of one, as CnnPolicy, got 3"),
        ("n_timesteps:'long'", "n_timesteps must be a positive number of agent steps, got 'long'"),
        ("n_timesteps:'1e6'", "n_timesteps: YAML reads 1e6 as text, not as a number: write 1000000."),
        ("learning_rate:'1e-4'", "learning_rate: YAML reads 1e-4 as text, not as a number: write 1.0e-4."),
        ("policy_kwargs:dict(gamma='9.9E-1')", "policy_kwargs: gamma: YAML reads 9.9E-1 as text"),
        (f"callback:[{{'{SWITCH}': dict(pretrain_frames='2e2')}}]", f"callback: {SWITCH}: pretrain_frames: YAML reads 2e2 as"),
        (
            f"callback:'{SWITCH[:-2]}'",
            "callback: sb3_dreamer_urlb has no 'PhaseSwitchCallba'. Did you mean 'PhaseSwitchCallback'",
        ),
        ("seed:5", "seed is no hyperparameter: give --seed on the command line."),
        ("tensorboard_log:'tb'", "tensorboard_log is no hyperparameter: give --tensorboard-log"),
        ("env_kwargs:3", "env_kwargs must be arguments of the environment by name, got 3."),
        ("noise_type:'normal'", "noise_type 'normal' needs noise_std"),
        ("callback:3", "callback: expected module.Class, got 3."),
        ("env_wrapper:[4.5]", "env_wrapper: expected module.Class, got 4.5."),
        (
            "env_wrapper:'stable_baselines3.common.vec_env.VecFrameStack'",
            "env_wrapper: expected a subclass of Env, got",
        ),
        ("vec_env_wrapper:'gymnasium.wrappers.ClipAction'", "vec_env_wrapper: expected a subclass of VecEnv, got gymnasium"),
        ("callback:'torch.nn.Linear'", "callback: expected a subclass of BaseCallback, got torch.nn.modules.linear.Linear."),
        ("monitor_kwargs:dict(info_keywords=3)", "monitor_kwargs: info_keywords must be a list of names, got 3."),
        ("callback:'PhaseSwitchCallback'", f"expected module.Class, got 'PhaseSwitchCallback'. Did you mean '{SWITCH}'"),
        ("callback:'sb3_dreamer.PhaseSwitchCallback'", f"No module named 'sb3_dreamer'. Did you mean '{SWITCH}'"),
        ("callback:'nowhere.Callback'", "callback: nowhere.Callback cannot be imported: No module named 'nowhere'"),
        (
            "env_wrapper:'gymnasium.wrappers.TimeLimt'",
            "env_wrapper: gymnasium.wrappers has no 'TimeLimt'. Did you mean 'TimeLi",
        ),
        ("env_wrapper:{'gymnasium.wrappers.TimeLimit': dict(max_steps=3)}", "TimeLimit; known are ['max_episode_steps']"),
        (f"callback:[{{'{SWITCH}': dict(frames=80)}}]", "Unknown arguments ['frames'] for PhaseSwitchCallback; known are ["),
        (f"callback:[{{'{SWITCH}': dict(frames=80)}}]", "Did you mean 'pretrain_frames'?"),
        (f"callback:[{{'{SWITCH}': None}}]", "callback: expected arguments of PhaseSwitchCallback by name, got None"),
        (f"callback:[{{'{SWITCH}': {{}}, 'frames': 3}}]", f"got 2 side by side: {SWITCH}, frames"),
        ("checkpoint:dict(every_frame=10)", "Unknown checkpoint ['every_frame']; known are ['every_frames', "),
        ("checkpoint:dict(every_frames='x')", "every_frames must be an integer of at least 1, got 'x'"),
        ("normalize:dict(norm_rewards=False)", "Unknown normalize ['norm_rewards']; known are ["),
        ("normalize:'dict(norm_rewards=False)'", "Did you mean 'norm_reward'"),
        ("monitor_kwargs:dict(overide=True)", "Unknown monitor_kwargs ['overide']; known are ["),
        ("replay_buffer_kwargs:dict(stor='x')", "Unknown replay_buffer_kwargs ['stor']; known are"),
    ],
)
def test_a_wrong_hyperparameter_costs_a_line(zoo, capsys, param, message):
    line = refused(capsys, train, zoo, STAND, 8, "lbs", params=[*TINY, param])
    assert message in line
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"{STAND}:\n  policy: CnnPolicy\n", f"Neither -n nor n_timesteps of {STAND} in own.yml"),
        (f"{STAND}:\n  n_timesteps: 8\n  preset: tiny\n", f"hyperparameters of {STAND} in own.yml name no policy"),
        (
            f"{STAND}:\n  policy: CnnPolicy\n  n_timestep: 8\n",
            "'n_timestep', neither of rl_zoo3's nor of dreamerv2's. Did you mean 'n_t",
        ),
        (f"{STAND}:\n  n_timesteps: 8\n  polcy: CnnPolicy\n", "Did you mean 'policy'"),
        (f"{STAND}:\n  polcy: CnnPolicy\n  zzz: 1\n", "Unknown hyperparameters 'polcy', 'zzz', neither"),
        (f"{STAND}:\n  seed: 1\n  device: cpu\n", "device, seed are no hyperparameters: give --device, --seed on the command"),
        (f"{FLIP}:\n  policy: CnnPolicy\n", f"Hyperparameters not found for dreamerv2-{STAND} in own.yml"),
        (f"{STAND}: 3\n", f"own.yml: expected hyperparameters by environment, got 3 for {STAND}"),
        ("- a\n", "own.yml: expected hyperparameters by environment, got ['a']"),
        ("", "own.yml: expected hyperparameters by environment, got None"),
        ("a: [\n", "own.yml is not YAML: while parsing a flow"),
    ],
)
def test_a_wrong_configuration_costs_a_line(zoo, capsys, text, message):
    Path("own.yml").write_text(text)
    assert message in refused(capsys, zoo, *TRAIN, "--env", STAND, "-conf", "own.yml", "--eval-freq", "-1")
    assert not Path("logs").exists()


@pytest.mark.parametrize("there", [False, True])
def test_a_start_that_is_refused_leaves_no_folder(zoo, capsys, there):
    """As the fine-tuning does that is given no snapshot, when learn() begins; what was there before stays."""
    folders = [Path("logs/dreamerv2"), Path("tb/urlb-walker-stand-v0")] if there else []
    for folder in folders:
        folder.mkdir(parents=True)
    line = refused(capsys, train, zoo, STAND, 8, "finetune", "-tb", "tb", params=TINY[:1])
    assert "FineTuneCallback needs a pre-trained model" in line
    left = {path for folder in folders for path in (folder, folder.parent)}
    assert set(Path().rglob("*")) == left


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--eval-freq", "8", "--eval-episodes", "0"), "--eval-episodes must be at least 1, got 0."),
        (("--eval-freq", "8", "--n-eval-envs", "0"), "--n-eval-envs must be at least 1, got 0."),
        (("--seed", "-7"), "--seed must be at least 0, got -7."),
        (("--num-threads", "-3"), "--num-threads must be at least 1, got -3."),
        (("-i", "own.yml"), "valid path to a .zip file"),
    ],
)
def test_options_that_rl_zoo3_does_not_check_are_refused(zoo, capsys, options, message):
    Path("own.yml").write_text("")
    with pytest.raises(SystemExit, match=r"^2$"):
        train(zoo, STAND, 8, "lbs", *options, params=TINY)
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("-w", "0", "--output", "a.png"), "--episode-window: must be an integer of at least 1, got '0'."),
        (("--output", "."), "--output must be the path of a file, got '.': that is a folder."),
    ],
)
def test_options_of_plot_are_looked_at_before_anything_is_drawn(zoo, capsys, options, message):
    with pytest.raises(SystemExit, match=r"^2$"):
        zoo("plot", "-a", "dreamerv2", "-e", STAND, "-f", "logs", *options)
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_an_error_of_another_kind_leaves_no_folder_either(tmp_path):
    with pytest.raises(KeyError), mistakes.told_in_a_line("zoo"):
        utils.configure_logger(0, str(tmp_path / "tb"), "run", True)
        raise KeyError
    assert not (tmp_path / "tb").exists()


def test_a_log_that_goes_on_is_not_taken_back(tmp_path):
    """TensorBoard's of a run that was there before."""
    with pytest.raises(SystemExit), mistakes.told_in_a_line("zoo"):
        utils.configure_logger(0, str(tmp_path / "tb"), "run", True)
        raise ValueError
    assert not (tmp_path / "tb").exists()
    utils.configure_logger(0, str(tmp_path / "tb"), "run", True).close()
    with pytest.raises(SystemExit), mistakes.told_in_a_line("zoo"):
        utils.configure_logger(0, str(tmp_path / "tb"), "run", False)
        raise ValueError
    assert [path.name for path in (tmp_path / "tb").iterdir()] == ["run_1"]


def test_an_environment_that_is_not_there_costs_a_line(zoo, capsys):
    assert f"maybe meant {STAND}" in refused(capsys, train, zoo, STAND.replace("stand", "stnd"))
    assert "No module named 'nowhere'" in refused(capsys, train, zoo, STAND, 8, "lbs", "--gym-packages", "nowhere")
    assert "--device must be" in refused(capsys, train, zoo, STAND, 8, "lbs", "--device", "gpu")
    assert "got 'cud'. Did you mean 'cuda'?" in refused(capsys, train, zoo, STAND, 8, "lbs", "--device", "cud")
    Path("file").touch()
    assert "Not a directory" in refused(capsys, train, zoo, STAND, 8, "lbs", "-f", "file", params=TINY)


def test_errors_that_nobody_expects_keep_their_traceback(zoo, monkeypatch):
    """Whatever is raised once the run collects, and what no check of arguments raises before."""
    monkeypatch.setattr("fake_envs.CounterEnv.step", raising(ValueError("of the environment")))
    with pytest.raises(ValueError, match="of the environment"):
        train(zoo, STAND, 8, "lbs", params=TINY)
    monkeypatch.setattr(DreamerV2, "_setup_model", raising(RuntimeError("of the machine")))
    with pytest.raises(RuntimeError, match="of the machine"):
        train(zoo, STAND, 8, "lbs", params=TINY)


def raising(error):
    def call(*args, **kwargs):
        raise error

    return call


def test_without_the_extra_the_command_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rl_zoo3", None)
    assert main(["train"]) == 2
    error = capsys.readouterr().err
    assert "pip install '.[zoo]'" in error


def test_enjoy_and_plot_without_a_display(zoo, capsys, monkeypatch):
    train(zoo, STAND, 45, "lbs", params=TINY)
    zoo("enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "logs", "-n", "25", "--device", "cpu")
    printed = capsys.readouterr().out
    # Two of three rewards of the counting environment are 1 and 0.5.
    assert "--no-render" in printed and "Mean reward: 10.0" in printed and "1 Episodes" in printed
    from matplotlib import pyplot as plt

    monkeypatch.setattr(plt, "show", plt.show)
    plot = ["plot", "-a", "dreamerv2", "-e", STAND, "-f", "logs", "-w", "1"]
    zoo(*plot, "--output", "curve.png")
    assert Path("curve.png").read_bytes().startswith(b"\x89PNG")
    assert [len(line.get_xdata()) for line in plt.gcf().axes[0].lines] == [2]  # episodes
    plt.close("all")
    with pytest.raises(SystemExit):
        zoo(*plot)


def test_a_run_that_is_not_there_costs_a_line(zoo, capsys):
    for command, algo in itertools.product(("enjoy", "record_video"), ("dreamerv2", "drq_v2")):
        with pytest.raises(SystemExit, match=r"^2$"):
            zoo(command, "--algo", algo, "--env", STAND, "-f", "logs")
        [line] = capsys.readouterr().err.splitlines()
        assert line.startswith(f"python -m sb3_dreamer_urlb.zoo {command}: ") and f"no run in logs/{algo}" in line
    Path("logs/dreamerv2/urlb-walker-run-v0_3").mkdir(parents=True)
    with pytest.raises(SystemExit):
        zoo("enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "logs", "--exp-id", "7")
    [line] = capsys.readouterr().err.splitlines()
    assert line.endswith("runs in logs/dreamerv2: urlb-walker-run-v0_3")


def test_plot_says_when_episodes_are_too_few(zoo, capsys, monkeypatch):
    folder = Path("logs/dreamerv2/urlb-walker-stand-v0_1")
    folder.mkdir(parents=True)
    rows = "".join(f"{i}.0,20,{i}\n" for i in range(6))
    (folder / "0.monitor.csv").write_text(f'#{{"t_start": 0.0, "env_id": "x"}}\nr,l,t\n{rows}')
    from matplotlib import pyplot as plt

    monkeypatch.setattr(plt, "show", plt.show)
    plot = ["plot", "-a", "dreamerv2", "-e", STAND, "-f", "logs", "--output", "curve.png"]
    assert main(plot) == 2 and not Path("curve.png").exists()
    error = capsys.readouterr().err
    assert "has 6 episodes, too few for a mean over 100: -w 3 takes the mean over fewer" in error
    assert main([*plot, "-w", "3"]) == 0 and Path("curve.png").exists()
    assert capsys.readouterr().err == ""
    (folder / "0.monitor.csv").write_text('#{"t_start": 0.0, "env_id": "x"}\nr,l,t\n')
    assert main([*plot, "-w", "1"]) == 2
    assert "has no episode that ended: there is nothing to draw" in capsys.readouterr().err
    plt.close("all")


@pytest.mark.parametrize("n_envs", [1, 2])
def test_optimize(zoo, monkeypatch, n_envs):
    seen = []
    learn = DreamerV2.learn
    monkeypatch.setattr(DreamerV2, "learn", lambda model, *args, **kwargs: (seen.append(model), learn(model, *args, **kwargs)))
    search = ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    study = ["--study-name", "walker", "--storage", "study.log"]
    params = [*TINY, f"n_envs:{n_envs}"]
    train(zoo, STAND, 30, "lbs", *search, *study, params=params)
    [report] = Path("logs/dreamerv2").glob("report_*.csv")
    header, *trials = report.read_text().splitlines()
    assert len(trials) == 2 and all("COMPLETE" in trial for trial in trials)
    assert "params_actor_learning_rate" in header
    # Each trial has its own numbers, and leaves no snapshots.
    assert len(seen) == 2 and not list(Path().rglob("snapshot_*"))
    assert len({model.learning_rate for model in seen}) == 2
    last = seen[1]
    model = model_in(train(zoo, STAND, 8, "lbs", *study, "--trial-id", "1", params=params))
    for name in ("actor_learning_rate", "batch_length", "gradient_steps"):
        assert getattr(model, name) == getattr(last, name)
    assert model.gradient_steps == n_envs


@pytest.mark.parametrize("domain", DOMAINS)
def test_pre_training_happens_in_the_primal_task(domain, monkeypatch, tmp_path):
    """For every task of every method's file; what follows is the task; whoever wants it otherwise can have it."""
    primal = env_id(domain, PRIMAL_TASK[domain])
    for task in URLB_TASKS[domain]:
        for file in ("lbs.yml", "small/diayn.yml", "finetune.yml", "scratch.yml"):
            for choice in ("primal", "same"):
                callbacks = rl_zoo3.utils.get_callback_list(entries(file)[env_id(domain, task)])
                name = rl_zoo3.exp_manager.EnvironmentName(env_id(domain, task))
                manager = SimpleNamespace(
                    env_name=name,
                    save_path=str(tmp_path),
                    callbacks=callbacks,
                    pretrain_env=choice,
                    optimize_hyperparameters=False,
                    env_kwargs={},
                )
                begins = pretraining.make_envs(lambda its=manager: (str(its.env_name.gym_id), its.save_path), manager)
                [fine_tunes_in] = [one.env for one in callbacks if isinstance(one, PhaseSwitchCallback)] or [None]
                moves = file in ("lbs.yml", "small/diayn.yml") and choice == "primal" and name.gym_id != primal
                own = (name.gym_id, str(tmp_path))
                assert begins == ((primal, str(tmp_path / "pretraining")) if moves else own)
                assert fine_tunes_in == (own if moves else None) and manager.env_name is name


def test_a_whole_run_moves_from_the_primal_task_to_the_task(zoo):
    """Stand pays 0, flip pays 1: each phase logs its own."""
    for name, reward in ((STAND, 0.0), (FLIP, 1.0)):
        gymnasium.registry[name].kwargs = {**CHEAP, "rewards": (reward,)}
    run = train(zoo, FLIP, 80, "lbs", params=TINY)
    assert model_in(run, FLIP).phase == "finetuning"
    paid = {folder: load_results(str(folder)).r.sum() for folder in (run, run / "pretraining")}
    assert paid[run] > 0 and paid[run / "pretraining"] == 0


def test_snapshots_need_a_run(tiny_model, tmp_path, monkeypatch):
    """Without a folder none is saved, and certainly not into the working directory."""
    monkeypatch.chdir(tmp_path)
    callbacks = [RunSnapshotCallback(frames=[8]), PhaseSwitchCallback(8)]
    tiny_model(intrinsic_reward="lbs").learn(16, callback=callbacks)
    assert not list(tmp_path.iterdir())


def test_processes_are_supervised():
    registration.register()
    for given, used in ((SubprocVecEnv, SupervisedVecEnv), (DummyVecEnv, DummyVecEnv)):
        manager = SimpleNamespace(vec_env_class=given)
        assert registration._create_envs(lambda its, n: (its.vec_env_class, n), manager, 3) == (used, 3)
    assert hasattr(ExperimentManager.create_envs, "_knows_phases")


# -- sharing ---------------------------------------------------------------------------------------------------------------

SHARE = ["--algo", "dreamerv2", "--env", STAND, "-orga", "./hub"]
NORMALISED = f"""
{STAND}:
  n_timesteps: 40
  policy: MlpPolicy
  preset: tiny
  normalize: "{{'norm_obs': True, 'norm_reward': False}}"
"""


def test_what_is_shared_names_no_folder_of_this_machine(tmp_path):
    here = {"directory": "/home/me/replays/walker", "many": [Path("/data/me/x"), "urlb/walker-run-v0", 3]}
    for name in ("config.yml", "args.yml"):
        (tmp_path / name).write_text(yaml.dump({"replay_buffer_kwargs": here, "env_kwargs": here, "seed": 1}))
    out = tmp_path / "out"
    out.mkdir()
    with pytest.warns(UserWarning, match="env_kwargs.yml names folders, .*/home/me/replays/walker"):
        files = zoo_hub._zoo_files(tmp_path, zoo_hub._saved_arguments(tmp_path), here, out)
    plain = {"directory": "walker", "many": ["x", "urlb/walker-run-v0", 3]}
    assert yaml.safe_load(files["config.yml"].read_text())["replay_buffer_kwargs"] == plain
    assert yaml.safe_load(files["args.yml"].read_text()) == {"env_kwargs": plain, "seed": 1}
    # But where the environment is made from: there it would no longer be the same.
    needed = {"directory": "/home/me/replays/walker", "many": ["/data/me/x", "urlb/walker-run-v0", 3]}
    assert yaml.safe_load(files["env_kwargs.yml"].read_text()) == needed


def test_a_run_is_shared_and_played_elsewhere(zoo, capsys):
    run = train(zoo, STAND, 60, "lbs", "--eval-freq", "30", "--eval-episodes", "1", params=TINY)
    zoo("push_to_hub", *SHARE, "-f", "logs", "-n", "6", "--n-eval-episodes", "2", "--device", "cpu")
    repository = Path("hub/dreamerv2-urlb-walker-stand-v0")
    assert {path.name for path in repository.iterdir()} == {
        "dreamerv2-urlb-walker-stand-v0.zip", "README.md", "config.json", "results.json", "replay.mp4",
        "config.yml", "args.yml", "env_kwargs.yml", "train_eval_metrics.zip",
    }  # fmt: skip
    card = (repository / "README.md").read_text()
    command = (run / STAND.replace("/", "-") / "command.txt").read_text().strip()
    assert without_private_paths(command) in card and sys.executable not in card
    assert "| frames | 80 of pre-training, then 40 on the task" in card and "10.00 +/- 0.00" in card
    assert yaml.safe_load((repository / "args.yml").read_text())["seed"] == 1
    with zipfile.ZipFile(repository / "train_eval_metrics.zip") as metrics:
        assert set(metrics.namelist()) == {"evaluations.npz", "0.monitor.csv"}

    zoo("load_from_hub", *SHARE, "-f", "elsewhere")
    assert Path("elsewhere/dreamerv2/urlb-walker-stand-v0_1/urlb-walker-stand-v0.zip").is_file()
    capsys.readouterr()
    zoo("enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "elsewhere", "-n", "21", "--device", "cpu")
    assert "Mean reward: 10.0" in capsys.readouterr().out
    fetched = "elsewhere/dreamerv2/urlb-walker-stand-v0_1"
    line = refused(capsys, train, zoo, STAND, 8, "lbs", "-i", fetched, params=TINY)
    assert f"-i {fetched}/urlb-walker-stand-v0.zip begins with it" in line
    # Another one beside it, or in its place.
    zoo("load_from_hub", *SHARE, "-f", "elsewhere")
    assert main(["load_from_hub", *SHARE, "-f", "elsewhere", "--exp-id", "2"]) == 2
    assert "--force overwrites it" in capsys.readouterr().err
    (Path("elsewhere/dreamerv2/urlb-walker-stand-v0_2") / "old").write_text("")
    zoo("load_from_hub", *SHARE, "-f", "elsewhere", "--exp-id", "2", "--force")
    assert not (Path("elsewhere/dreamerv2/urlb-walker-stand-v0_2") / "old").exists()


def test_a_normalised_run_is_shared_without_pickles(zoo, monkeypatch, capsys):
    kwargs = {**CHEAP, "observation_space": spaces.Box(-1, 1, (3,), np.float32)}
    monkeypatch.setitem(gymnasium.registry, STAND, EnvSpec(STAND, "fake_envs:CounterEnv", kwargs=kwargs))
    Path("normalised.yml").write_text(NORMALISED)
    zoo(*TRAIN, "--env", STAND, "-conf", "normalised.yml", "--eval-freq", "-1")
    zoo("push_to_hub", *SHARE, "-f", "logs", "--no-render", "--n-eval-episodes", "1")
    repository = Path("hub/dreamerv2-urlb-walker-stand-v0")
    assert not list(repository.rglob("*.pkl")) and "load_vec_normalize" in (repository / "README.md").read_text()
    Path("file").write_text("mine")
    assert main(["load_from_hub", *SHARE, "-f", "file"]) == 2
    assert "a folder of --folder must be the path of a folder, got 'file/dreamerv2/" in capsys.readouterr().err
    zoo("load_from_hub", *SHARE, "-f", "elsewhere")
    here, there = (
        VecNormalize.load(
            f"{folder}/dreamerv2/urlb-walker-stand-v0_1/urlb-walker-stand-v0/vecnormalize.pkl", make_vec_env(STAND)
        )
        for folder in ("logs", "elsewhere")
    )
    assert np.array_equal(here.obs_rms.mean, there.obs_rms.mean) and here.obs_rms.count == there.obs_rms.count > 30
    zoo("enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "elsewhere", "-n", "21", "--device", "cpu")
    (repository / "vec_normalize.json").unlink()
    assert main(["load_from_hub", *SHARE, "-f", "elsewhere"]) == 2
    assert "normalize is True" in capsys.readouterr().err


def test_mistakes_in_sharing_are_named(zoo, capsys):
    for arguments, message in (
        (["push_to_hub", *SHARE, "-f", "logs"], "folder was not found; no run in logs/dreamerv2 (-f names it)"),
        (["load_from_hub", *SHARE, "-f", "logs"], "There is no such folder: '/"),
        (["load_from_hub", *SHARE[:-1], "a/b", "-f", "logs"], "repo_id must be 'user/name'"),
    ):
        assert main(arguments) == 2
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["push_to_hub"])
    assert not Path("logs").exists()


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ("!!python/object/apply:os.system ['touch hacked']", "is refused"),
        ("env_wrapper: subprocess.Popen", "names code to run: env_wrapper='subprocess.Popen'"),
        ("vec_env_wrapper: [{os.system: {}}]", "names code to run"),
        ("frame_stack: -1", "frame_stack is -1"),
        ("frame_stack: '4'", "frame_stack is '4'"),
        ("- 1", "no values by name"),
        ("1: 2", "no values by name"),
        ("[" * 500, "is refused"),
    ],
)
def test_a_strangers_configuration_runs_nothing(tmp_path, config, message):
    path = tmp_path / "config.yml"
    path.write_text(config)
    with code_events() as events, pytest.raises(ValueError, match=message):
        zoo_hub.harmless_config(zoo_hub._read_yaml(str(path)))
    assert events == []


def test_what_is_kept_of_a_strangers_configuration():
    config = {"normalize": "__import__('os').system('touch hacked')", "callback": "os.system", "frame_stack": 4, "policy": "x"}
    assert zoo_hub.harmless_config(config) == {"normalize": True, "frame_stack": 4}
    assert zoo_hub.harmless_config({}) == {"normalize": False}


def test_films_go_into_the_runs_folder(zoo):
    film = "{'sb3_dreamer_urlb.VideoCallback': dict(video_freq=20, video_length=3)}"
    run = train(zoo, STAND, 40, "scratch", params=["preset:'tiny'", f"callback:[{film}]"])
    assert {path.name for path in (run / "videos").iterdir()} == {"agent_20.gif", "agent_40.gif"}


@pytest.mark.parametrize("there", ["no folder", "runs of another task"])
def test_plot_of_runs_that_are_not_there_costs_a_line(zoo, capsys, there):
    if there != "no folder":
        Path("logs/dreamerv2/urlb-walker-run-v0_3").mkdir(parents=True)
    with warnings.catch_warnings(), pytest.raises(SystemExit, match=r"^2$"):
        warnings.simplefilter("error")
        zoo("plot", "-a", "dreamerv2", "-e", STAND, "-f", "logs", "--output", "curve.png")
    [line] = capsys.readouterr().err.splitlines()
    assert "no run of urlb-walker-stand-v0; " in line
    assert line.endswith("no run in logs/dreamerv2 (-f names it)" if there == "no folder" else ": urlb-walker-run-v0_3")


def test_plot_draws_what_there_is_and_names_what_is_not(zoo, capsys, monkeypatch):
    from matplotlib import pyplot as plt

    folder = Path("logs/dreamerv2/my-Own-v0_1")
    folder.mkdir(parents=True)
    (folder / "0.monitor.csv").write_text('#{"t_start": 0.0, "env_id": "x"}\nr,l,t\n1.0,20,1\n2.0,20,2\n')
    monkeypatch.setattr(plt, "show", plt.show)
    zoo("plot", "-a", "dreamerv2", "-e", STAND, "my/Own-v0", "-f", "logs", "-w", "1", "--output", "curve.png")
    [line] = capsys.readouterr().err.splitlines()
    assert "no run of urlb-walker-stand-v0; " in line and Path("curve.png").exists()
    plt.close("all")


def test_enjoy_says_when_no_episode_was_finished(zoo, capsys):
    train(zoo, STAND, 20, "scratch", params=["preset:'tiny'"])
    play = ["enjoy", "--algo", "dreamerv2", "--env", STAND, "-f", "logs", "--no-render", "--device", "cpu", "-n"]
    capsys.readouterr()
    zoo(*play, "9")
    [line] = [line for line in capsys.readouterr().err.splitlines() if "episode" in line]
    assert line.startswith("python -m sb3_dreamer_urlb.zoo enjoy: no episode was finished in 9 steps")
    zoo(*play, "25")
    printed = capsys.readouterr()
    assert "1 Episodes" in printed.out and "no episode" not in printed.err
