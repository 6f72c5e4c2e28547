"""``resume="auto"``, VecNormalize's statistics, counters and evaluations of resumed runs, and runs that environments end."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from snapshot_files import change_data, change_header
from stable_baselines3.common.callbacks import CallbackList, CheckpointCallback, ConvertCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from whole_runs import RepeatingEnv, crash, everything, scramble, vec_env

from sb3_dreamer_urlb import DreamerV2, EvaluationCallback, PhaseSwitchCallback, RunCheckpointCallback, SnapshotError
from sb3_dreamer_urlb.envs import EnvironmentFaultError, FaultGuard
from sb3_dreamer_urlb.runs import evaluation_history
from sb3_dreamer_urlb.runs.run_folder import SNAPSHOT

# -- resume="auto" ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["first", "last", "inner"])
def test_the_same_script_goes_on(tiny_model, tmp_path, order):
    """Twice cut off, in either phase; wherever the callback stands in the list. Steps and schedules are the whole run's."""
    total, rate = 240, lambda remaining: 1e-4 + 1e-3 * remaining

    def run(folder, until=None):
        scramble()
        model = tiny_model(vec_env(), intrinsic_reward="lbs", learning_rate=rate, verbose=0)
        keep, switch = RunCheckpointCallback(tmp_path / folder, 20, resume="auto"), PhaseSwitchCallback(120)
        callbacks = {"first": [keep, switch], "last": [switch, keep], "inner": [CallbackList([switch]), CallbackList([keep])]}
        if until is None:
            return model.learn(total, callback=callbacks[order])
        crash(model, until, total, callbacks[order])
        return model

    expected = everything(run("whole"))
    run("cut", 81)
    run("cut", 161)
    model = run("cut")
    assert (model.num_timesteps, model.phase, model.phase_timesteps) == (total, "finetuning", 120)
    found = everything(model)
    assert {name for name in expected if found[name] != expected[name]} == set()
    # A finished run has nothing left to do.
    again = run("cut")
    assert again.num_timesteps == total and everything(again)["weights"] == expected["weights"]


def test_a_second_learn_counts_its_own_steps(tiny_model, tmp_path):
    callback = RunCheckpointCallback(tmp_path, resume="auto")
    tiny_model(vec_env()).learn(40, callback=callback)
    model = tiny_model(vec_env()).learn(60, callback=callback)
    assert model.num_timesteps == 60 and model.phase_timesteps == 60
    model.learn(20, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == 80
    resumed = DreamerV2.resume(tmp_path, vec_env()).learn(100, callback=callback)
    assert resumed.num_timesteps == resumed.phase_timesteps == 100


def test_a_run_of_other_arguments_is_refused(tiny_model, tmp_path):
    tiny_model(vec_env()).learn(40, callback=RunCheckpointCallback(tmp_path))
    before = (tmp_path / SNAPSHOT).read_bytes()
    auto = RunCheckpointCallback(tmp_path, resume="auto")
    with pytest.raises(ValueError, match=r"The run in .* has batch_size=\d, the model 3: with resume='auto'"):
        tiny_model(vec_env(), batch_size=3).learn(60, callback=auto)
    with pytest.raises(ValueError, match="holds another run"):
        tiny_model(vec_env()).learn(20).learn(60, callback=auto)  # it has learnt something else
    assert (tmp_path / SNAPSHOT).read_bytes() == before
    with pytest.raises(ValueError, match="resume must be 'auto' or None, got True"):
        RunCheckpointCallback(tmp_path, resume=True)
    # Where it logs is no argument of the run.
    model = tiny_model(vec_env(), tensorboard_log=str(tmp_path / "tb"), verbose=0).learn(60, callback=auto)
    assert model.num_timesteps == 60 and model.tensorboard_log == str(tmp_path / "tb")


def test_a_run_keeps_its_task(tiny_model, tmp_path):
    def env(task):
        return vec_env(domain="walker", task=task)

    def learn(task, steps):
        return tiny_model(env(task)).learn(steps, callback=RunCheckpointCallback(tmp_path, resume="auto"))

    learn("stand", 40)
    before = (tmp_path / SNAPSHOT).read_bytes()
    said = "has learnt walker-stand so far, and its environment is now of walker-run: a run keeps its task"
    with pytest.raises(ValueError, match=said):
        learn("run", 60)
    model = DreamerV2.resume(tmp_path, env("run"))
    with pytest.raises(ValueError, match=said):
        model.learn(20, callback=RunCheckpointCallback(tmp_path), reset_num_timesteps=False)
    assert (tmp_path / SNAPSHOT).read_bytes() == before
    assert learn("stand", 60).num_timesteps == 60
    # Who takes another environment himself may mean it.
    model = DreamerV2.load(tmp_path / SNAPSHOT, env=env("run"))
    with pytest.warns(UserWarning, match="its critic and its replay know the other's rewards"):
        model.learn(20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(20)


def test_exploring_is_of_no_task(tiny_model, tmp_path):
    def learn(task, steps, then):
        callbacks = [
            RunCheckpointCallback(tmp_path, resume="auto"),
            PhaseSwitchCallback(40, vec_env(domain="walker", task=then)),
        ]
        return tiny_model(vec_env(domain="walker", task=task), intrinsic_reward="lbs").learn(steps, callback=callbacks)

    learn("stand", 20, "run")
    learn("walk", 60, "run")
    assert learn("stand", 80, "run").learnt_task == "walker-run"
    with pytest.raises(ValueError, match="has learnt walker-run so far, and its environment is now of walker-flip"):
        learn("stand", 100, "flip")


def test_a_replay_without_its_checkpoint_is_not_removed(tiny_model, tmp_path):
    tiny_model(vec_env()).learn(60, callback=RunCheckpointCallback(tmp_path, 20))
    (tmp_path / SNAPSHOT).rename(tmp_path / "elsewhere.zip")
    replay = sorted((tmp_path / "replay").iterdir())
    with pytest.raises(ValueError, match=r"holds the replay of a run without its checkpoint: put snapshot\.zip back"):
        tiny_model(vec_env()).learn(60, callback=RunCheckpointCallback(tmp_path, 20))
    assert sorted((tmp_path / "replay").iterdir()) == replay
    (tmp_path / "elsewhere.zip").rename(tmp_path / SNAPSHOT)
    assert tiny_model(vec_env()).learn(80, callback=RunCheckpointCallback(tmp_path, resume="auto")).num_timesteps == 80


def test_what_is_due_every_so_many_steps_stays_so(tiny_model, tmp_path):
    def callbacks():
        evaluation = EvalCallback(vec_env(), eval_freq=30, n_eval_episodes=1, verbose=0, warn=False, log_path=str(tmp_path))
        keep = RunCheckpointCallback(tmp_path / "run", 20, evaluation=evaluation, resume="auto")
        return [CheckpointCallback(50, str(tmp_path), "at"), evaluation, keep]

    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*not of the same type.*")
        crash(tiny_model(vec_env()), 85, 160, callbacks())
        tiny_model(vec_env()).learn(160, callback=callbacks())
    assert {path.name for path in tmp_path.glob("at_*")} == {f"at_{n}_steps.zip" for n in (50, 100, 150)}
    with np.load(tmp_path / "evaluations.npz") as file:
        assert file["timesteps"].tolist() == [30, 60, 90, 120, 150] and file["results"].shape == (5, 1)


@pytest.mark.parametrize(
    "change",
    [
        {"best_mean_reward": "high"},
        {"best_mean_reward": [1.0]},
        {"n_calls": 1.5},
        {"results": [1.0]},
        {"timesteps": [[1]]},
        {"ep_lengths": 3},
        {"predict": 1},
    ],
)
def test_damaged_evaluations_are_refused(tiny_model, tmp_path, change):
    evaluation = EvalCallback(vec_env(), eval_freq=20, n_eval_episodes=1, verbose=0, warn=False)
    tiny_model(vec_env()).learn(40, callback=[evaluation, RunCheckpointCallback(tmp_path, evaluation=evaluation)])
    file = tmp_path / SNAPSHOT
    change_data(file, file, lambda data: data["run"]["evaluation"].update(change))
    with pytest.raises(SnapshotError, match="evaluation is damaged"):
        DreamerV2.resume(tmp_path, vec_env())


# Before the first evaluation, in the first phase, between the switch and the second phase's first evaluation, after that.
@pytest.mark.parametrize(("until", "remembered"), [(25, True), (45, True), (65, True), (65, False), (85, True)])
@pytest.mark.parametrize("ours", [True, False], ids=["EvaluationCallback", "EvalCallback"])
def test_evaluations_of_a_run_that_goes_on_are_those_of_a_whole_one(
    tiny_model, tmp_path, monkeypatch, until, ours, remembered
):
    if not remembered:
        monkeypatch.setattr(evaluation_history, "MAX_NUMBERS", 0)

    def callbacks(folder, n_eval_episodes=2):
        kwargs = {"n_eval_episodes": n_eval_episodes, "verbose": 0, "log_path": str(folder), "warn": False}
        if ours:
            evaluation = EvaluationCallback(vec_env(), every_frames=30, pretraining=True, **kwargs)
        else:
            evaluation = EvalCallback(vec_env(), eval_freq=30, **kwargs)
        keep = RunCheckpointCallback(folder / "run", 10, evaluation=evaluation, resume="auto")
        return evaluation, [PhaseSwitchCallback(60), evaluation, keep]

    def model():
        return tiny_model(vec_env(), intrinsic_reward="lbs")

    def of(folder):
        with np.load(folder / "evaluations.npz") as file:
            return {name: file[name].tolist() for name in file}

    scramble()
    evaluation, whole = callbacks(tmp_path / "whole")
    model().learn(130, callback=whole)
    best = evaluation.best_mean_reward
    crash(model(), until, 130, callbacks(tmp_path / "cut")[1])
    evaluation, rest = callbacks(tmp_path / "cut")
    model().learn(130, callback=rest)
    assert of(tmp_path / "cut") == of(tmp_path / "whole") and evaluation.best_mean_reward == best
    # One file has equally many episodes each: what is there stays, under another name.
    if until > 30:
        before = of(tmp_path / "cut")
        with pytest.warns(UserWarning, match="evaluations of another number of episodes than 1"):
            model().learn(190, callback=callbacks(tmp_path / "cut", n_eval_episodes=1)[1])
        with np.load(tmp_path / "cut" / "evaluations_before_1.npz") as file:
            assert {name: file[name].tolist() for name in file} == before
        assert all(len(row) == 1 for row in of(tmp_path / "cut")["results"])


# -- VecNormalize ----------------------------------------------------------------------------------------------------------


class Vectors(RepeatingEnv):
    """Every episode is the same walk through vectors that need normalising."""

    def __init__(self, parts=False, **kwargs):
        space = spaces.Box(-1e3, 1e3, (3,), np.float32)
        super().__init__(20, observation_space=spaces.Dict({"a": space, "b": space}) if parts else space, **kwargs)

    def _observation(self):
        self.frames += 1
        vector = np.array([self.frames, 50 - self.frames**1.5, 7.0], np.float32)
        return {"a": vector, "b": -vector} if isinstance(self.observation_space, spaces.Dict) else vector


def normalized(make=Vectors, n_envs=1, **kwargs):
    return VecNormalize(DummyVecEnv([lambda: Monitor(make())] * n_envs), **kwargs)


def statistics(env):
    seen = env.obs_rms if isinstance(getattr(env, "obs_rms", None), dict) else {"": getattr(env, "obs_rms", None)}
    parts = [env.ret_rms, *(part for part in seen.values() if part is not None)]
    return [(np.asarray(rms.mean).tobytes(), np.asarray(rms.var).tobytes(), float(rms.count)) for rms in parts]


NORMALIZED = {
    "vectors": ("MlpPolicy", lambda: normalized()),
    "two environments": ("MlpPolicy", lambda: normalized(n_envs=2)),
    "parts": ("MultiInputPolicy", lambda: normalized(lambda: Vectors(parts=True), norm_obs_keys=["b"])),
    "rewards of images": ("CnnPolicy", lambda: normalized(lambda: RepeatingEnv(20), norm_obs=False)),
}


@pytest.mark.parametrize(("policy", "make"), NORMALIZED.values(), ids=NORMALIZED)
def test_a_run_with_vecnormalize_goes_on_bit_for_bit(tiny_model, tmp_path, policy, make):
    def start():
        scramble()
        return tiny_model(make(), policy, intrinsic_reward="lbs")

    model = start().learn(200)
    expected, its = everything(model), statistics(model.get_vec_normalize_env())
    start().learn(80, callback=RunCheckpointCallback(tmp_path, 40))
    scramble()
    env = make()
    model = DreamerV2.resume(tmp_path, env, device="cpu")
    assert statistics(env)[0][2] > 80  # before it learns: for evaluations
    model.learn(120, reset_num_timesteps=False, callback=RunCheckpointCallback(tmp_path, 40))
    assert statistics(env) == its and env.training
    found = everything(model)
    assert {name for name in expected if found[name] != expected[name]} == set()


def test_the_statistics_of_the_tasks_environment_return_to_it(tiny_model, tmp_path):
    """A run that was cut off after the switch is resumed with the pre-training's environment."""

    def run(steps, resume):
        task = normalized(lambda: Vectors(rewards=[9.0]))
        callbacks = [PhaseSwitchCallback(60, task), RunCheckpointCallback(tmp_path, 20)]
        if resume:
            model = DreamerV2.resume(tmp_path, normalized(), device="cpu")
        else:
            model = tiny_model(normalized(), "MlpPolicy", intrinsic_reward="lbs")
        model.learn(steps, callback=callbacks, reset_num_timesteps=False)
        assert model.get_vec_normalize_env() is task
        return statistics(task)

    before = run(100, False)
    after = run(40, True)
    assert after[1][2] == before[1][2] + 40  # forty more observations, and not one of the reset


def test_an_environment_that_does_not_fit_the_statistics(tiny_model, tmp_path):
    tiny_model(normalized(), "MlpPolicy").learn(40, callback=RunCheckpointCallback(tmp_path))
    with pytest.raises(SnapshotError, match=r"its VecNormalize had the statistics .*observation.*environment has"):
        DreamerV2.resume(tmp_path, normalized(norm_obs=False))
    plain = DreamerV2.resume(tmp_path, DummyVecEnv([Vectors]))
    with pytest.raises(ValueError, match="normalises with VecNormalize, its environment is wrapped in none now"):
        plain.learn(20, callback=RunCheckpointCallback(tmp_path), reset_num_timesteps=False)
    # Loaded alone, it is a model like any other: what it sees goes on, what tasks pay begins anew.
    env = normalized()
    DreamerV2.load(tmp_path / SNAPSHOT, env=env).set_parameters(tmp_path / SNAPSHOT)
    assert env.obs_rms.count > 40 and env.ret_rms.count < 1


def test_a_checkpoint_without_statistics_warns(tiny_model, tmp_path):
    """What older versions left."""
    tiny_model(DummyVecEnv([Vectors]), "MlpPolicy").learn(40, callback=RunCheckpointCallback(tmp_path))
    model = DreamerV2.resume(tmp_path, normalized())
    with pytest.warns(UserWarning, match="holds no statistics of VecNormalize: they begin anew"):
        model.learn(20, callback=RunCheckpointCallback(tmp_path), reset_num_timesteps=False)


def test_statistics_that_are_none_are_refused(tiny_model, tmp_path):
    tiny_model(normalized(), "MlpPolicy").learn(40, callback=RunCheckpointCallback(tmp_path))
    file = tmp_path / SNAPSHOT
    good = file.read_bytes()

    def rename(header):
        header["normalization.extra.mean"] = header.pop("normalization.observation.mean")

    def shape(header):
        header["normalization.observation.mean"]["shape"] = [3, 1]

    for change in (rename, shape):
        file.write_bytes(good)
        change_header(file, file, change)
        with pytest.raises(SnapshotError, match=r"statistics|the shape \[3, 1\]"):
            DreamerV2.resume(tmp_path, normalized())


# -- counters --------------------------------------------------------------------------------------------------------------


def test_counts_of_faults_and_skipped_updates_survive(tiny_model, tmp_path):
    model = tiny_model(intrinsic_reward="lbs").learn(40)
    model.env_faults = 3
    model.learner.guard._total += 2
    model.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", env=CounterEnv(), device="cpu")
    assert (loaded.env_faults, loaded.skipped_updates) == (3, 2)
    loaded.learner.guard._total += 5
    loaded.fine_tune()
    assert loaded.skipped_updates == 7


# -- environments that are given up on -------------------------------------------------------------------------------------


class Dies(CounterEnv):
    """Raises from one step on, for ever."""

    def __init__(self, good, **kwargs):
        super().__init__(20, **kwargs)
        self.good = good

    def step(self, action):
        self.good -= 1
        if self.good < 0:
            raise RuntimeError("the simulator is gone")
        return super().step(action)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_run_that_an_environment_ends_leaves_a_checkpoint(tiny_model, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model = tiny_model(FaultGuard(Dies(90), max_faults=2), "CnnPolicy")
    with pytest.raises(
        EnvironmentFaultError, match=r"step 92.*the simulator is gone.*The last good state is in run\."
    ) as caught:
        model.learn(400, callback=RunCheckpointCallback("run", 10_000))
    assert isinstance(caught.value.__cause__, EnvironmentFaultError)
    resumed = DreamerV2.resume("run", CounterEnv(20), device="cpu")
    assert resumed.num_timesteps == 91 and resumed.env_faults == 1 and resumed._n_updates == model._n_updates > 0
    assert resumed.phase_timesteps == resumed.phase_frames == 91  # the step that failed is none
    assert resumed.replay_buffer.finished_rows > 80
    weights = zip(model.policy.state_dict().values(), resumed.policy.state_dict().values(), strict=True)
    assert all(th.equal(mine, its) for mine, its in weights)
    assert resumed.learn(20, reset_num_timesteps=False).num_timesteps == 111


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_run_without_a_folder_leaves_a_snapshot(tiny_model, tmp_path):
    model = tiny_model(FaultGuard(Dies(50), max_faults=1), tensorboard_log=str(tmp_path))
    with pytest.raises(EnvironmentFaultError, match=r"The last good state is in .*last_good_state_50\.zip"):
        model.learn(400)
    [path] = tmp_path.rglob("last_good_state_50.zip")
    assert DreamerV2.load(path).num_timesteps == 50


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_an_environment_of_the_evaluation_ends_a_run_likewise(tiny_model, tmp_path):
    evaluation = EvalCallback(Monitor(FaultGuard(Dies(30), max_faults=1)), eval_freq=25, n_eval_episodes=1, verbose=0)
    with pytest.raises(EnvironmentFaultError, match=f"The last good state is in {tmp_path}"):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*not of the same type.*")
            tiny_model(vec_env()).learn(400, callback=[evaluation, RunCheckpointCallback(tmp_path)])
    assert DreamerV2.resume(tmp_path, vec_env()).num_timesteps == 50


def test_other_errors_leave_the_last_checkpoint_alone(tiny_model, tmp_path):
    stop = ConvertCallback(lambda local, _: local["self"].num_timesteps < 50 or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        tiny_model(vec_env()).learn(400, callback=[RunCheckpointCallback(tmp_path), stop])
    assert DreamerV2.resume(tmp_path, vec_env()).num_timesteps == 0
