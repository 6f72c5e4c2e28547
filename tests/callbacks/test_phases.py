"""Pre-training → fine-tuning: what moves, what starts afresh, and the callbacks that do it within one ``learn``."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    ConvertCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnNoModelImprovement,
)
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from told import told_meanwhile

from sb3_dreamer_urlb import (
    DreamerPolicy,
    DreamerV2,
    FineTuneCallback,
    PhaseSwitchCallback,
    RunCheckpointCallback,
    SnapshotCallback,
)
from sb3_dreamer_urlb.callbacks.placing import BetweenRolloutsCallback
from sb3_dreamer_urlb.dreamer_v2.kept_parts import TRANSFER
from sb3_dreamer_urlb.transfer_rule import ACTOR_CHOICE, CRITIC_CHOICE, FRESH, KEPT, keeps_actor


def vec_env(n_envs=1, length=8, **attributes):
    return DummyVecEnv([lambda: Monitor(CounterEnv(length, **attributes))] * n_envs)


@pytest.fixture
def pretrained(tiny_model):
    """Make a model that has pre-trained a little."""

    def make(env=None, steps=40, **kwargs):
        model = tiny_model(vec_env() if env is None else env, intrinsic_reward="lbs", planner="dyna_mpc", **kwargs)
        return model.learn(steps)

    return make


def parts(model, weights):
    """The bytes of each part of an agent whose method has no skills."""
    agent = model.policy.agent
    return {name: weights(agent.get_submodule(name)) for name in TRANSFER if name != "intrinsic"}


# -- the table -------------------------------------------------------------------------------------------------------------


def test_the_table_names_every_part_of_the_agent(pretrained):
    names = set(pretrained().policy.agent.state_dict())
    assert all(name.startswith(tuple(f"{part}." for part in TRANSFER)) for name in names)


def test_the_papers_table():
    assert {name.split(".")[-1]: rule for name, rule in TRANSFER.items()} == {
        "encoder": KEPT,
        "rssm": KEPT,
        "decoder": KEPT,
        "discount_logit": KEPT,
        "reward": FRESH,
        "actor": ACTOR_CHOICE,
        "critic": CRITIC_CHOICE,
        "slow_critic": CRITIC_CHOICE,
        "reward_normalizer": FRESH,
        "intrinsic": KEPT,
    }


@pytest.mark.parametrize("keep_actor", [True, False])
@pytest.mark.parametrize("keep_critic", [True, False])
@pytest.mark.parametrize("through_a_file", [True, False])
def test_transfer(pretrained, weights, tmp_path, keep_actor, keep_critic, through_a_file):
    model = pretrained()
    before = parts(model, weights)
    if through_a_file:
        model.save(tmp_path / "snapshot")
        model = DreamerV2.load(tmp_path / "snapshot", env=vec_env(), device="cpu")
    model.fine_tune(keep_actor=keep_actor, keep_critic=keep_critic)
    kept = {KEPT: True, FRESH: False, ACTOR_CHOICE: keep_actor, CRITIC_CHOICE: keep_critic}
    after = parts(model, weights)
    for name in before:
        rule = TRANSFER[name]
        same = [before[name][tensor] == after[name][tensor] for tensor in before[name]]
        # No tensor of a fresh part equals the old one, not only some.
        assert all(same) if kept[rule] else not any(same), name
    assert model.policy.agent.intrinsic is None
    agent = model.policy.agent
    if not keep_critic:
        assert weights(agent.critic) == weights(agent.slow_critic)


@pytest.mark.parametrize(("domain", "kept"), [("walker", True), ("quadruped", True), ("jaco", False), (None, True)])
@pytest.mark.parametrize("new_env", [True, False])
def test_the_task_decides_about_the_actor(pretrained, weights, domain, kept, new_env):
    attributes = {} if domain is None else {"domain": domain}
    env = vec_env(**attributes)
    model = pretrained(vec_env(domain="jaco" if kept else "walker") if new_env else env)
    before = weights(model.policy.agent.actor)
    model.fine_tune(env if new_env else None)
    assert (weights(model.policy.agent.actor) == before) == kept == keeps_actor(domain)


def test_a_jaco_snapshot_fine_tuned_without_an_environment(pretrained, weights, tmp_path):
    """The snapshot knows its domain: the actor goes, as it would with an environment."""
    pretrained(vec_env(domain="jaco")).save(tmp_path / "snapshot")
    model = DreamerV2.load(tmp_path / "snapshot", device="cpu")
    before = weights(model.policy.agent.actor)
    model.fine_tune()
    assert weights(model.policy.agent.actor) != before


def test_everything_else_starts_afresh(pretrained):
    model = pretrained()
    old_replay, old_agent, updates = model.replay_buffer, model.policy.agent, model._n_updates
    assert old_agent.reward_normalizer.momentum == 0.95 and old_agent.reward_normalizer.scale != 1
    assert model.learner.config.ent_coef == 0.0 and not model.learner.config.reward_trains_model
    model.fine_tune()
    assert (model.phase, model.phase_timesteps, model.phase_updates, model.learner.updates) == ("finetuning", 0, 0, 0)
    assert model.learner.config.ent_coef == 1e-4 and model.learner.config.reward_trains_model
    assert set(model.learner.optimizers()) == {"model_optimizer", "actor_optimizer", "critic_optimizer"}
    assert not any(optimizer.state_dict()["state"] for optimizer in model.learner.optimizers().values())
    assert model.replay_buffer is not old_replay and model.replay_buffer.size() == 0
    assert model.replay_buffer.phase == "finetuning"
    assert model.policy.agent.reward_normalizer.momentum == 1 and model.policy.agent.reward_normalizer.scale == 1
    # The new optimisers train the new networks.
    trained = {id(p) for optimizer in model.learner.optimizers().values() for p in optimizer.parameters}
    assert trained == {id(p) for p in model.policy.agent.parameters() if p.requires_grad}
    model.learn(40)
    assert model.phase_timesteps == 40 and model._n_updates == updates + model.phase_updates > updates


def test_fine_tuning_acts_with_the_actor_from_its_first_step(pretrained, monkeypatch):
    model = pretrained()
    model.fine_tune()
    monkeypatch.setattr(model.action_space, "sample", lambda: pytest.fail("a uniform action"))
    before = model._n_updates
    model.learn(8)
    assert model._n_updates == before  # learning_starts = 10
    model.learn(12)
    assert model._n_updates > before


def test_planner_plans_only_after_its_delay_in_fine_tuning(pretrained, monkeypatch):
    model = pretrained(steps=60)
    assert not model._planner_is_on()
    model.fine_tune()
    steps = []
    planner = type(model.policy.planner)
    original = planner.plan
    monkeypatch.setattr(planner, "plan", lambda *args, **kw: steps.append(model.phase_timesteps) or original(*args, **kw))
    model.predict(np.zeros((16, 16, 3), np.uint8))
    assert steps == []
    model.learn(24)
    assert steps == list(range(14, 24))  # learning_starts 10, planner_delay 4
    model.predict(np.zeros((16, 16, 3), np.uint8))
    assert len(steps) == 11


def test_pretraining_never_plans_and_its_rewards_do_not_reach_the_agent(tiny_model, weights):
    def learn(scale):
        env = vec_env(rewards=[scale, -scale])
        model = tiny_model(env, intrinsic_reward="lbs", planner="dyna_mpc", planner_delay=0, max_grad_norm=1e9)
        return model.learn(60)

    small, large = learn(0.1), learn(5.0)
    first, second = (parts(model, weights) for model in (small, large))
    differing = {name for name in first if first[name] != second[name]}
    assert differing == {"world_model.reward"}


def test_fine_tuning_twice_or_from_scratch_is_refused(pretrained, tiny_model):
    model = pretrained()
    model.fine_tune()
    for its, message in ((model, r"'pretraining'.*'finetuning'"), (tiny_model(), "never pre-trained")):
        with pytest.raises(ValueError, match=message):
            its.fine_tune()


def test_one_snapshot_fine_tuned_twice_keeps_the_same(pretrained, weights, tmp_path):
    pretrained().save(tmp_path / "snapshot")
    found = []
    for _ in range(2):
        model = DreamerV2.load(tmp_path / "snapshot", env=vec_env(), device="cpu")
        model.fine_tune(keep_actor=True)
        found.append(parts(model, weights))
    kept = [name for name in found[0] if TRANSFER[name] in (KEPT, ACTOR_CHOICE)]
    assert all(found[0][name] == found[1][name] for name in kept)


def test_a_fine_tuned_model_is_saved_and_loaded_as_such(pretrained, weights, tmp_path):
    model = pretrained()
    frames = model.phase_frames
    model.fine_tune()
    model.learn(24).save(tmp_path / "finetuned")
    loaded = DreamerV2.load(tmp_path / "finetuned", env=vec_env(), device="cpu")
    assert loaded.phase == "finetuning" and loaded.policy.agent.intrinsic is None and loaded._planner_is_on()
    assert loaded.pretrained_frames == frames > 0
    assert weights(loaded.policy) == weights(model.policy)
    loaded.learn(24)


def test_fine_tuning_in_another_number_of_environments(pretrained, tmp_path):
    """As in SB3, only ``load`` changes the number; a refusal leaves the model as it was."""
    model = pretrained()
    model.save(tmp_path / "snapshot")
    agent, replay = model.policy.agent, model.replay_buffer
    with pytest.raises(AssertionError, match=r"number of environments.* 3 != 1"):
        model.fine_tune(vec_env(3))
    assert (model.phase, model.policy.agent, model.replay_buffer) == ("pretraining", agent, replay)
    model = DreamerV2.load(tmp_path / "snapshot", env=vec_env(3), device="cpu")
    model.fine_tune()
    model.learn(60)
    assert model.replay_buffer.n_envs == 3 and model._n_updates > 0 and len(model.replay_buffer.episodes) >= 6


def test_fine_tuning_with_another_action_space_is_refused(pretrained):
    with pytest.raises(ValueError, match="spaces do not match"):
        pretrained().fine_tune(vec_env(action_space=spaces.Box(-1, 1, (3,), np.float32)))


# -- PhaseSwitchCallback ---------------------------------------------------------------------------------------------------


class Recorder(BaseCallback):
    """The phase and its frames at each step."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def _on_step(self):
        self.seen.append((self.model.phase, self.model.phase_frames))
        return True


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("other", [False, True])
@pytest.mark.parametrize("length", [8, None])
def test_switch_within_one_learn(tiny_model, weights, n_envs, other, length):
    """Frames are agent steps × action repeat; the switch comes at the end of a rollout."""
    env = vec_env(n_envs, 8, action_repeat=2, rewards=[0.0])
    target = vec_env(n_envs, length, action_repeat=3, rewards=[1.0]) if other else None
    model = tiny_model(env, intrinsic_reward="lbs", planner="dyna_mpc")
    recorder = Recorder()
    model.learn(80, callback=[recorder, PhaseSwitchCallback(76, target)])
    pretraining = [frames for phase, frames in recorder.seen if phase == "pretraining"]
    finetuning = [frames for phase, frames in recorder.seen if phase == "finetuning"]
    rollout = 4 * n_envs  # agent steps
    last = -(-38 // rollout) * rollout * 2
    assert pretraining == list(range(2 * n_envs, last + 1, 2 * n_envs))
    repeat = 3 if other else 2
    assert finetuning == list(range(repeat * n_envs, repeat * (80 - last // 2) + 1, repeat * n_envs))
    assert model.num_timesteps == 80 and model.get_env().num_envs == n_envs
    if other:
        assert model.get_env().get_attr("action_repeat") == [3] * n_envs
        assert all(set(e.reward.tolist()) == {0.0, 1.0} for e in model.replay_buffer.episodes)
    # The replay's episodes begin with a reset, as the agent's memory does.
    for episode in model.replay_buffer.episodes:
        assert not episode.action[0].any() and len(episode) == 9


def test_the_agents_memory_is_reset_at_the_switch(tiny_model, monkeypatch):
    model = tiny_model(vec_env(2), intrinsic_reward="lbs")
    first = []
    original = DreamerPolicy.observe

    def spy(self, observation, state, is_first, generator=None):
        first.append((self.agent.intrinsic is None, is_first.tolist(), float(state.latent.deter.abs().sum())))
        return original(self, observation, state, is_first, generator)

    monkeypatch.setattr(DreamerPolicy, "observe", spy)
    model.learn(80, callback=PhaseSwitchCallback(30))
    switch = [tuned for tuned, *_ in first].index(True)
    assert switch == 16 and first[switch][1:] == ([True, True], 0.0)


def test_the_kept_weights_at_the_switch_are_the_last_of_pretraining(tiny_model, weights, monkeypatch):
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    taken = {}
    original = DreamerV2.fine_tune

    def spy(self, *args):
        before = parts(self, weights)
        original(self, *args)
        after = parts(self, weights)
        taken.update({name: before[name] == after[name] for name in before})

    monkeypatch.setattr(DreamerV2, "fine_tune", spy)
    model.learn(80, callback=PhaseSwitchCallback(40, keep_actor=False, keep_critic=True))
    assert {name for name, same in taken.items() if same} == {
        name for name in taken if TRANSFER[name] in (KEPT, CRITIC_CHOICE)
    }


def test_a_switch_is_found_again_by_repeated_learns_and_after_loading(tiny_model, tmp_path):
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    phases = []
    for _ in range(4):
        model.learn(16, callback=PhaseSwitchCallback(32))
        phases.append((model.phase, model.phase_timesteps))
    assert phases == [("pretraining", 16), ("pretraining", 32), ("finetuning", 16), ("finetuning", 32)]
    model = tiny_model(vec_env(), intrinsic_reward="lbs").learn(16)
    model.save(tmp_path / "half")
    model = DreamerV2.load(tmp_path / "half", env=vec_env(), device="cpu")
    model.learn(24, callback=PhaseSwitchCallback(32))
    assert (model.phase, model.phase_timesteps) == ("finetuning", 8)


def test_a_switch_does_nothing_to_a_run_without_pretraining(tiny_model):
    with pytest.warns(UserWarning, match="nothing to switch: with intrinsic_reward=None"):
        model = tiny_model(vec_env()).learn(40, callback=PhaseSwitchCallback(8))
    assert model.phase_timesteps == 40


@pytest.mark.parametrize(("frames", "told"), [(1000, True), (33, True), (32, False), (20, False)])
def test_a_learn_that_ends_before_the_switch_says_so(tiny_model, frames, told):
    model = tiny_model(vec_env(action_repeat=2), intrinsic_reward="lbs")
    with told_meanwhile() as said:
        model.learn(16, callback=PhaseSwitchCallback(frames))
    messages = [text for text in said if "PhaseSwitchCallback" in text]
    said = f"ends after 32 frames of pre-training, and PhaseSwitchCallback switches after pretrain_frames={frames}"
    assert len(messages) == told and all(said in message for message in messages)


@pytest.mark.parametrize("phase", ["finetuning", "finetune", None])
def test_a_phase_is_not_assigned(tiny_model, tmp_path, phase):
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    with pytest.raises(AttributeError, match=r"phase cannot be assigned, got .*'pretraining'\. fine_tune\(\)"):
        model.phase = phase
    model.phase = "pretraining"  # as it is
    model.learn(16).save(tmp_path / "model")
    assert DreamerV2.load(tmp_path / "model").phase == "pretraining"


def test_switch_announces_itself(tiny_model, capsys):
    tiny_model(vec_env(), intrinsic_reward="lbs").learn(16, callback=PhaseSwitchCallback(8, verbose=1))
    assert "after 8 frames" in capsys.readouterr().out


@pytest.mark.parametrize("kwargs", [{}, {"train_freq": (1, "episode")}])
def test_switch_beside_an_evaluation(tiny_model, kwargs):
    model = tiny_model(vec_env(), intrinsic_reward="lbs", planner="dyna_mpc", **kwargs)
    evaluation = EvalCallback(vec_env(), eval_freq=20, n_eval_episodes=1, verbose=0)
    model.learn(80, callback=[evaluation, PhaseSwitchCallback(40)])
    assert model.phase == "finetuning" and evaluation.n_calls == 80


UNFIT = {
    "number": (lambda: vec_env(2), AssertionError),
    "actions": (lambda: vec_env(action_space=spaces.Box(-1, 1, (3,), np.float32)), ValueError),
    "images": (lambda: vec_env(size=20), ValueError),
}


@pytest.mark.parametrize(("make_env", "error"), UNFIT.values(), ids=UNFIT)
def test_an_environment_that_does_not_fit_is_refused(tiny_model, make_env, error):
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    with pytest.raises(error):
        model.learn(60, callback=PhaseSwitchCallback(20, make_env()))
    assert model.phase == "pretraining" and model.num_timesteps == 0


def test_a_learn_that_ends_with_the_pre_training_keeps_it(tiny_model, tmp_path):
    """What is saved is the pre-trained agent with its replay; the next learn begins with the switch."""
    model = tiny_model(vec_env(), intrinsic_reward="lbs").learn(32, callback=PhaseSwitchCallback(32))
    assert (model.phase, model.phase_frames, model.replay_buffer.phase) == ("pretraining", 32, "pretraining")
    model.save(tmp_path / "end")
    model = DreamerV2.load(tmp_path / "end", env=vec_env(), device="cpu")
    recorder = Recorder()
    model.learn(8, callback=[recorder, PhaseSwitchCallback(32)])
    assert recorder.seen == [("finetuning", frames) for frames in range(1, 9)]


# -- FineTuneCallback ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep_actor", [None, False])
def test_fine_tuning_by_callback_is_fine_tuning(tiny_model, weights, tmp_path, capsys, keep_actor):
    """The same agent as after the call, and episodes that begin with a reset."""
    tiny_model(vec_env(2), intrinsic_reward="lbs").learn(40).save(tmp_path / "pretrained")
    agents = []
    for by_callback in (False, True):
        model = DreamerV2.load(tmp_path / "pretrained", env=vec_env(2), device="cpu")
        callback = [Recorder(), FineTuneCallback(keep_actor)]
        if not by_callback:
            model.fine_tune(keep_actor=keep_actor)
            callback.pop()
        model.learn(8, callback=callback)
        assert callback[0].seen == [("finetuning", frames) for frames in (2, 4, 6, 8)]
        assert all(not episode.action[0].any() for episode in model.replay_buffer.open)
        agents.append(parts(model, weights))
    # Fresh heads are drawn from the global generator, which a load seeds.
    assert agents[0] == agents[1]
    assert "40 frames of pre-training with 'lbs'" in capsys.readouterr().out


def test_fine_tuning_by_callback_goes_on_after_loading(tiny_model, tmp_path):
    model = tiny_model(vec_env(), intrinsic_reward="lbs").learn(16)
    model.learn(12, callback=FineTuneCallback(verbose=0)).save(tmp_path / "half")
    model = DreamerV2.load(tmp_path / "half", env=vec_env(), device="cpu")
    model.learn(8, callback=FineTuneCallback(verbose=0))
    assert (model.phase, model.phase_timesteps) == ("finetuning", 20)


@pytest.mark.parametrize("method", ["lbs", None])
def test_fine_tuning_by_callback_needs_pre_training(tiny_model, method):
    with pytest.raises(ValueError, match="pre-trained model, this one has seen 0 frames"):
        tiny_model(vec_env(), intrinsic_reward=method).learn(8, callback=FineTuneCallback())


# -- SnapshotCallback ------------------------------------------------------------------------------------------------------


def test_snapshots_at_exact_frames(tiny_model, tmp_path, weights):
    model = tiny_model(vec_env(action_repeat=2), intrinsic_reward="lbs")
    folder = tmp_path / "new" / "snapshots"
    model.learn(60, callback=[SnapshotCallback(folder, [50, 26, 80, 500]), PhaseSwitchCallback(80)])
    assert {path.name for path in folder.iterdir()} == {f"snapshot_{frames}.zip" for frames in (26, 50, 80)}
    for frames in (26, 50, 80):
        loaded = DreamerV2.load(folder / f"snapshot_{frames}.zip", device="cpu")
        assert loaded.phase == "pretraining" and loaded.phase_frames == frames
        assert loaded.policy.agent.intrinsic is not None


def test_snapshots_of_a_resumed_run_come_once(tiny_model, tmp_path):
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    model.learn(16, callback=SnapshotCallback(tmp_path, [8, 24], name_prefix="a"))
    (tmp_path / "a_8.zip").unlink()
    model.save(tmp_path / "half")
    for _ in range(2):
        loaded = DreamerV2.load(tmp_path / "half", env=vec_env(), device="cpu")
        loaded.learn(16, callback=SnapshotCallback(tmp_path, [8, 24], name_prefix="a"))
    assert {path.name for path in tmp_path.iterdir()} == {"half.zip", "a_24.zip"}


def test_several_snapshots_due_at_one_step_are_all_saved(tiny_model, tmp_path):
    model = tiny_model(vec_env(3), intrinsic_reward="lbs")
    model.learn(12, callback=SnapshotCallback(tmp_path, [1, 2, 3, 5]))
    assert {path.name for path in tmp_path.iterdir()} == {f"snapshot_{frames}.zip" for frames in (1, 2, 3, 5)}


def test_a_snapshot_is_fine_tuned_by_the_papers_flow(tiny_model, tmp_path):
    """Pre-train with snapshots, load one, fine-tune it on a task."""
    tiny_model(vec_env(domain="walker"), intrinsic_reward="lbs").learn(40, callback=SnapshotCallback(tmp_path, [32]))
    model = DreamerV2.load(tmp_path / "snapshot_32", env=vec_env(domain="walker"), planner="dyna_mpc", device="cpu")
    model.fine_tune()
    model.learn(40)
    assert model._planner_is_on() and model.phase_updates > 0
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())


@pytest.mark.parametrize("frames", [100, [0], ["5"]])
def test_bad_frames_of_snapshots(frames, tmp_path):
    with pytest.raises(ValueError, match="sequence of positive integers"):
        SnapshotCallback(tmp_path, frames)


# -- the best model --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("listed", [False, True], ids=["flat", "in lists"])
def test_an_agent_that_explored_is_no_best_one_of_the_task(tiny_model, tmp_path, listed):
    stop = StopTrainingOnNoModelImprovement(max_no_improvement_evals=3)
    evaluation = EvalCallback(
        vec_env(), callback_after_eval=stop, n_eval_episodes=1, eval_freq=10, best_model_save_path=str(tmp_path), warn=False,
        verbose=0,
    )  # fmt: skip

    def exploring_pays(locals_, _):
        if locals_["self"].num_timesteps == 30:
            evaluation.best_mean_reward = stop.last_best_mean_reward = 1e9
        return True

    callbacks = [PhaseSwitchCallback(40), evaluation]
    model = tiny_model(vec_env(), intrinsic_reward="lbs", learning_starts=0)
    given = [CallbackList(callbacks[:1]), CallbackList([CallbackList(callbacks[1:])])] if listed else callbacks
    model.learn(80, callback=[ConvertCallback(exploring_pays), *given])
    assert model.num_timesteps == 80 and evaluation.best_mean_reward < 1e9
    assert DreamerV2.load(tmp_path / "best_model.zip").phase == "finetuning"


# -- where callbacks are given ---------------------------------------------------------------------------------------------

BETWEEN_ROLLOUTS = {
    "PhaseSwitchCallback": lambda folder: PhaseSwitchCallback(40),
    "RunCheckpointCallback": lambda folder: RunCheckpointCallback(folder),
}


@pytest.mark.parametrize("listed", [False, True], ids=["alone", "in a list"])
@pytest.mark.parametrize("which", BETWEEN_ROLLOUTS)
def test_what_would_hear_nothing_below_events_is_refused_there(tiny_model, tmp_path, which, listed):
    callback = BETWEEN_ROLLOUTS[which](tmp_path)
    below = CallbackList([callback]) if listed else callback
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    with pytest.raises(ValueError, match=rf"{which} must be given to learn\(\) itself.*: EveryNTimesteps calls it only"):
        model.learn(120, callback=EveryNTimesteps(10, below))


def test_all_that_act_between_rollouts_are_refused_there():
    def subclasses(kind):
        yield from (sub for one in kind.__subclasses__() for sub in (one, *subclasses(one)))

    def overrides(kind):
        return any(getattr(kind, name) is not getattr(BaseCallback, name) for name in ("_on_rollout_start", "_on_rollout_end"))

    needing = {
        kind for kind in subclasses(BaseCallback) if kind.__module__.startswith("sb3_dreamer_urlb.") and overrides(kind)
    }
    assert needing == {PhaseSwitchCallback, RunCheckpointCallback}
    assert all(issubclass(kind, BetweenRolloutsCallback) for kind in needing)
