"""Recorded updates, observations and plans: the same as without recording, bit for bit.

Nobody has run these graphs on a GPU yet. A tape of operator calls stands in for CUDA's graphs here (tape.py), and the last
tests look for what only a GPU would notice: waiting for the device, and copies from the host.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import math
import pickle

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from tape import CannotRecord, TapeBackend, refusal
from told import told_meanwhile
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.agent import PlannedAgent
from sb3_dreamer_urlb.dreamer_v2 import policies
from sb3_dreamer_urlb.intrinsic import LBS
from sb3_dreamer_urlb.intrinsic.registry import registered_intrinsic_rewards
from sb3_dreamer_urlb.learning import base, graphs
from sb3_dreamer_urlb.learning.graphs import WARM_UPS, Recorder
from sb3_dreamer_urlb.nn import precision
from sb3_dreamer_urlb.snapshots import model as model_snapshot

#: their search for neighbours looks at the distances on the host
WAITING = ("apt", "aps")


@pytest.fixture
def taped(monkeypatch):
    """Let ``compile="cuda_graphs"`` record on tapes."""

    def make(compile, device):
        return TapeBackend() if compile == "cuda_graphs" else None

    for module in (base, policies):
        monkeypatch.setattr(module, "make_backend", make)
    # What plans on CUDA; a CPU's own form keeps weights where no tape can follow.
    monkeypatch.setattr(policies, "planned", PlannedAgent)


def with_skill(its, batch):
    skills = its.agent.skills
    if skills is None:
        return batch
    return dataclasses.replace(batch, skill=skills.draw(batch.reward.numel()).view(*batch.reward.shape, -1))


def shuffled(batch, i):
    """Another batch of the same shape."""
    return graphs.map_tensors(lambda tensor: tensor.roll(i, 0), batch)


# -- updates ---------------------------------------------------------------------------------------------------------------


def run_updates(its, batch, updates=9):
    """Updates with a schedule, copies of the critic and one bad batch; all their metrics."""
    th.manual_seed(1)
    batch = with_skill(its, batch)
    found = []
    for i in range(updates):
        its.model_optimizer.set_learning_rate(1e-3 / (1 + i))
        rows = shuffled(batch, i)
        if i == updates - 3:
            rows.action[1, 2, 0] = math.nan
        found.append(its.update(rows))
    return [{name: value.item() for name, value in metrics.items()} for metrics in found]


@pytest.mark.parametrize("method", [None, *registered_intrinsic_rewards()])
def test_recorded_updates_are_the_same(learner, batch, taped, weights, method):
    plain = learner(method, target_update_interval=2)
    th.manual_seed(0)
    recorded = learner(method, target_update_interval=2, compile="cuda_graphs")
    recorded.agent.load_state_dict(plain.agent.state_dict())
    backend = recorded.recorder.backend
    expected = run_updates(plain, batch)
    with told_meanwhile() as said:
        found = run_updates(recorded, batch)
    assert str(found) == str(expected)  # as text, because NaN is not NaN
    assert weights(recorded.agent) == weights(plain.agent)
    for name, optimizer in recorded.optimizers().items():
        its = plain.optimizers()[name]
        assert str(optimizer.state_dict()["state"]) == str(its.state_dict()["state"])
        assert optimizer.learning_rate == its.learning_rate
    assert recorded.guard.total() == plain.guard.total() == 1
    assert recorded.updates == plain.updates == 9
    if method in WAITING:
        [text] = said
        assert "The update runs without CUDA graphs, slower: aten.index" in text
        assert recorded.recorder.backend is None
    else:
        assert said == [] and len(backend.tapes) == 1 and recorded.recorder.recordings == 1


def test_an_update_is_recorded_anew_when_it_changes(learner, batch, taped):
    its = learner("diayn", compile="cuda_graphs")
    backend, batch = its.recorder.backend, with_skill(its, batch)

    def tapes_after(change=lambda: None, rows=batch):
        change()
        for _ in range(WARM_UPS + 2):
            its.update(rows)
        return len(backend.tapes)

    assert tapes_after() == 1 == tapes_after()
    small = graphs.map_tensors(lambda tensor: tensor[:2], batch)
    assert tapes_after(rows=small) == 2
    assert tapes_after(lambda: its.agent.skills.fix(th.eye(50)[3]), small) == 3
    assert tapes_after(lambda: its.agent.skills.fix(th.eye(50)[4]), small) == 3  # the same buffer
    adam = its.model_optimizer.adam
    assert tapes_after(lambda: adam.load_state_dict(copy.deepcopy(adam.state_dict())), small) == 4
    state = {name: value + 0 for name, value in its.agent.state_dict().items()}
    assert tapes_after(lambda: its.agent.load_state_dict(state), small) == 4  # copied to where the weights are
    assert its.recorder.recordings == 1


def test_a_method_that_changes_in_python_is_not_recorded(learner, batch, taped, monkeypatch):
    monkeypatch.setattr(LBS, "graph_safe", False)
    with told_meanwhile() as said:
        its = learner("lbs", compile="cuda_graphs")
        for _ in range(WARM_UPS + 2):
            its.update(batch)
    [text] = said
    assert "The update runs without CUDA graphs, slower: LBS.graph_safe is False" in text and its.recorder.recordings == 0
    learner("lbs")  # eager anyway: nothing to warn about


def test_metrics_outlive_the_next_update(learner, batch, taped):
    its = learner(compile="cuda_graphs")
    for _ in range(WARM_UPS + 1):
        first = its.update(batch)
    before = {name: value.item() for name, value in first.items()}
    second = its.update(shuffled(batch, 1))
    assert {name: value.item() for name, value in first.items()} == before
    assert second["image_loss"] != first["image_loss"]


# -- acting ----------------------------------------------------------------------------------------------------------------


class Choices(CounterEnv):
    """With two choices for an action."""

    def __init__(self):
        super().__init__()
        self.action_space = spaces.MultiDiscrete([3, 2])


CASES = {
    "actor": {},
    "dyna_mpc": {"planner": "dyna_mpc", "learning_starts": 0, "planner_delay": 0},
    "mppi": {"planner": "mppi", "learning_starts": 0, "planner_delay": 0},
    "choices": {"planner": "dyna_mpc", "learning_starts": 0, "planner_delay": 0, "env": Choices()},
    "skills": {"intrinsic_reward": "diayn"},
    "random": {"intrinsic_reward": "random"},
}


def act(model, deterministic, steps=WARM_UPS + 3):
    """Predict for a while, with an episode that begins in the middle; all that was handed out."""
    th.manual_seed(2)
    images = np.random.default_rng(0).integers(0, 256, (steps, 2, *model.observation_space.shape), np.uint8)
    state, found = None, []
    for t, image in enumerate(images):
        action, state = model.predict(image, state, np.array([t == 4, False]), deterministic=deterministic)
        found.append((action, *state))
    return found, th.rand(())


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_recorded_actions_are_the_same(tiny_model, taped, case, deterministic):
    plain, recorded = (tiny_model(compile=compile, **CASES[case]) for compile in ("eager", "cuda_graphs"))
    (expected, random), (found, random_too) = act(plain, deterministic), act(recorded, deterministic)
    assert random == random_too  # the global generator is where it was, too
    for ours, theirs in zip(found, expected, strict=True):
        assert all(np.array_equal(one, other) for one, other in zip(ours, theirs, strict=True))
    observing, choosing = recorded.policy._recorded()
    assert observing.recordings == 1
    assert choosing.recordings == (case != "random")


def test_acting_follows_the_weights(tiny_model, taped):
    """A recording reads the weights where they are, whoever changed them."""
    plain, recorded = (tiny_model(compile=compile) for compile in ("eager", "cuda_graphs"))
    act(recorded, True)
    with th.no_grad():
        for model in (plain, recorded):
            for parameter in model.policy.parameters():
                parameter.mul_(1.5)
    (expected, _), (found, _) = act(plain, True), act(recorded, True)
    assert all(np.array_equal(ours[0], theirs[0]) for ours, theirs in zip(found, expected, strict=True))
    assert recorded.policy._recorded()[0].recordings == 1
    for model in (plain, recorded):
        state = {name: value / 2 for name, value in model.policy.state_dict().items()}
        model.policy.load_state_dict(state, assign=True)  # elsewhere
    (expected, _), (found, _) = act(plain, True), act(recorded, True)
    assert all(np.array_equal(ours[0], theirs[0]) for ours, theirs in zip(found, expected, strict=True))
    assert recorded.policy._recorded()[0].recordings == 2


def test_each_number_of_environments_has_a_recording_and_few_are_kept(tiny_model, taped):
    model = tiny_model(compile="cuda_graphs")
    for n in (1, 2, 1, 2, 3, 4, 5, 6):
        for _ in range(WARM_UPS + 1):
            model.predict(np.zeros((n, *model.observation_space.shape), np.uint8))
    observing, _ = model.policy._recorded()
    assert observing.backend.warm_ups == 2 * 6 * WARM_UPS and observing.recordings == policies.KEPT_RECORDINGS


# -- a run -----------------------------------------------------------------------------------------------------------------


def test_a_recorded_run_is_the_same_and_so_is_its_snapshot(tiny_model, taped, tmp_path, weights):
    kwargs = {
        "intrinsic_reward": "lbs",
        "planner": "dyna_mpc",
        "train_freq": 2,
        "target_update_interval": 3,
        "learning_rate": lambda progress: 1e-3 * progress,
    }
    models = {}
    for compile in ("eager", "cuda_graphs"):
        model = models[compile] = tiny_model(CounterEnv(8), compile=compile, **kwargs)
        model.learn(60)
        model.fine_tune()
        model.learn(60)
        assert model.learner.updates > 2 * WARM_UPS
        model.save(tmp_path / compile)
    plain, recorded = models.values()
    assert weights(recorded.policy) == weights(plain.policy)
    assert recorded.learner.recorder.recordings == 1 and plain.learner.recorder.recordings == 0
    assert all(recorder.recordings for recorder in recorded.policy._recorded())
    tensors = [model_snapshot._all_tensors(model) for model in models.values()]
    assert tensors[0].keys() == tensors[1].keys()
    assert all(th.equal(value, tensors[1][name]) for name, value in tensors[0].items())
    custom = {"learning_rate": 1e-3}
    loaded = DreamerV2.load(tmp_path / "cuda_graphs", CounterEnv(8), custom_objects=custom, device="cpu")
    assert loaded.compile == "cuda_graphs" and weights(loaded.policy) == weights(plain.policy)
    loaded.learn(40)
    assert loaded.learner.recorder.recordings == 1


def test_a_model_that_records_can_be_copied(tiny_model, taped, weights):
    model = tiny_model(CounterEnv(8), compile="cuda_graphs", train_freq=2)
    model.learn(60)
    assert model.learner.recorder.recordings == 1
    for twin in (copy.deepcopy(model.policy), pickle.loads(pickle.dumps(model.policy))):
        assert weights(twin) == weights(model.policy)
        assert twin._recorders[0].recordings == 0 and twin._recorders[0].function.__self__ is twin
        # It acts with its own weights.
        with th.no_grad():
            twin.agent.actor.body.out.bias.add_(1)
        image = np.zeros((1, *model.observation_space.shape), np.uint8)
        for _ in range(WARM_UPS + 2):
            changed, same = (policy.predict(image, deterministic=True)[0] for policy in (twin, model.policy))
        assert not np.array_equal(changed, same)
        assert twin._recorders[0].recordings == 1


# -- the recorder ----------------------------------------------------------------------------------------------------------


def sums():
    """A function with a memory of its own, and a recorder of it."""
    total = th.zeros(2)

    def add(inputs, generator, times=1):
        total.add_(inputs["x"], alpha=times)
        return {"total": total, "draw": th.rand(2, generator=generator)}

    return total, add, Recorder(add, TapeBackend(), lambda: [total], "Adding")


def test_a_recorder_does_what_its_function_does():
    (total, _, recorder), (other, add, _) = sums(), sums()
    for i in range(WARM_UPS + 3):
        inputs = {"x": th.full((2,), float(i))}
        mine, its = (th.Generator().manual_seed(i) for _ in range(2))
        found, expected = recorder(inputs, mine, (3,)), add(inputs, its, 3)
        assert th.equal(found["total"], expected["total"]) and th.equal(found["draw"], expected["draw"])
        assert th.equal(th.rand(2, generator=mine), th.rand(2, generator=its))  # both go on
    assert th.equal(total, other) and recorder.recordings == 1 and recorder.backend.warm_ups == WARM_UPS


def test_recording_itself_does_nothing():
    total, _, recorder = sums()
    inputs = {"x": th.ones(2)}
    for _ in range(WARM_UPS + 1):  # the last one records, and replays once
        recorder(inputs)
    assert total.tolist() == [WARM_UPS + 1] * 2


def test_what_cannot_be_recorded_runs_with_one_warning():
    def wait(inputs, generator):
        return inputs * 2 if float(inputs.sum()) > 0 else inputs

    recorder = Recorder(wait, TapeBackend(), list, "Waiting")
    with told_meanwhile() as said:
        found = [recorder(th.full((2,), x)).tolist() for x in (1.0, -1.0) * (WARM_UPS + 2)]
    [text] = said
    assert text.startswith("Waiting runs without CUDA graphs, slower: aten._local_scalar_dense")
    assert found == [[2.0, 2.0], [-1.0, -1.0]] * (WARM_UPS + 2)


def test_work_found_waiting_while_it_warms_up_is_not_recorded():
    class Watchful(TapeBackend):
        waits_in: int

        def warm_up(self, work):
            super().warm_up(work)
            return work(), "particles.py:116 waits for the device" if self.warm_ups == self.waits_in else None

    for call, refused in ((1, False), (WARM_UPS, True)):  # what torch sets up once does not matter
        recorder = Recorder(lambda inputs, generator: inputs * 2, Watchful(), list, "Waiting")
        recorder.backend.waits_in = call
        backend = recorder.backend
        with told_meanwhile() as said:
            for _ in range(WARM_UPS + 2):
                assert recorder(th.ones(2)).tolist() == [2, 2]
        assert (len(said) == 1) == refused and (backend.tapes == []) == refused
        assert not refused or "slower: particles.py:116 waits" in said[0]


def test_what_always_changes_is_not_recorded_again_and_again():
    _, _, recorder = sums()
    with told_meanwhile() as said:
        for times in range(2 * graphs.MAX_SITUATIONS):
            recorder({"x": th.ones(2)}, None, (times,))
    [text] = said
    assert f"changed {graphs.MAX_SITUATIONS} times" in text and recorder.backend is None


def test_only_trees_of_tensors_are_recorded():
    with pytest.raises(TypeError, match="dataclasses of them, are recorded; got float"):
        graphs.map_tensors(th.clone, {"x": [1.0]})


# -- the choice ------------------------------------------------------------------------------------------------------------


def test_which_backend():
    assert graphs.make_backend("eager", "cuda") is None and graphs.make_backend("auto", "cpu") is None
    assert isinstance(graphs.make_backend("auto", "cuda"), graphs.CudaGraphs)
    assert isinstance(graphs.make_backend("cuda_graphs", "cuda:0"), graphs.CudaGraphs)


def test_without_a_gpu_graphs_are_refused_with_a_reason_and_learning_goes_on(tiny_model):
    with told_meanwhile() as said:
        model = tiny_model(CounterEnv(8), compile="cuda_graphs", train_freq=2)
        model.learn(40)
    [text] = [text for text in said if "CUDA" in text]
    assert "needs a CUDA device, the networks are on 'cpu'" in text
    assert model.learner.updates > 0


def test_an_unknown_way(tiny_model):
    with pytest.raises(ValueError, match=r"compile must be one of \('auto', 'eager', .*got 'fast'"):
        tiny_model(compile="fast")


# -- what only a GPU would notice ------------------------------------------------------------------------------------------


def test_the_tape_refuses_what_a_gpu_would():
    for work in (
        lambda x: x.sum().item(),
        lambda x: x[x > 0],
        lambda x: x.nonzero(),
        lambda x: x.index_put_((x > 0,), th.zeros(())),
        lambda x: x + th.tensor([1.0, 2.0]),
    ):
        with pytest.raises(CannotRecord):
            TapeBackend().record(lambda work=work: work(th.ones(2)), None)


class OnDevice(TorchDispatchMode):
    """Finds what waits, and what comes from the host: the meta device stands in for the GPU."""

    def __enter__(self):
        self._patch = pytest.MonkeyPatch()
        for name in ("tensor", "as_tensor", "from_numpy"):
            # Made on the host, and copied without a call that the mode sees.
            self._patch.setattr(th, name, self._made_on_the_host)
        return super().__enter__()

    def __exit__(self, *error):
        self._patch.undo()
        super().__exit__(*error)

    def _made_on_the_host(self, *_, **__):
        raise AssertionError("made on the host")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        assert (why := refusal(func, args)) is None, why
        result = func(*args, **(kwargs or {}))
        leaves = th.utils._pytree.tree_leaves((args, kwargs, result))
        found = [leaf for leaf in leaves if isinstance(leaf, th.Tensor) and leaf.device.type == "cpu"]
        # A scalar on the host that is an operand goes along with the launch; a copy of it would wait.
        copies = any(name in str(func) for name in ("copy", "lift", "where", "empty", "zeros", "ones", "full", "arange"))
        assert not found or (not copies and all(leaf.dim() == 0 for leaf in found)), f"{func} has tensors of the host"
        return result


class NoAdam:
    """torch's fused one does not know the meta device."""

    def __init__(self, parameters, **_):
        self.param_groups, self.state = [{"params": list(parameters)}], {}

    def step(self):
        assert self.found_inf.device.type == "meta"

    def zero_grad(self, set_to_none):
        pass


@pytest.fixture
def on_device(monkeypatch):
    monkeypatch.setattr(th.optim, "Adam", NoAdam)
    monkeypatch.setattr(precision, "products", lambda device, dtype: contextlib.nullcontext())


@pytest.mark.parametrize("discount_head", [False, True])
@pytest.mark.parametrize("method", [None, *sorted(set(registered_intrinsic_rewards()) - set(WAITING))])
def test_an_update_never_meets_the_host(learner, batch, on_device, method, discount_head):
    made = learner(method, discount_head)
    batch = with_skill(made, batch)
    agent = made.agent.to("meta")
    its = type(made)(agent, made.config)
    rows = graphs.map_tensors(lambda tensor: tensor.to("meta"), batch)
    with OnDevice():
        metrics = its.recorder(rows)
    assert {value.device.type for value in metrics.values()} == {"meta"}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("deterministic", [True, False])
def test_acting_never_meets_the_host(tiny_model, on_device, case, deterministic):
    model = tiny_model(**CASES[case])
    model.policy.planning = True
    policy = model.policy.to("meta")
    observation = th.zeros(2, *model.observation_space.shape, dtype=th.uint8, device="meta")
    with th.no_grad():
        state = policy.initial_state(2)
        with OnDevice():
            state = policy.observe(observation, state, th.ones(2, dtype=th.bool, device="meta"))
            state = policy.choose(state, deterministic)
    assert state.action.device.type == "meta"


@pytest.mark.parametrize("policy", ["MlpPolicy", "MultiInputPolicy"])
def test_preprocessing_never_meets_the_host(tiny_model, policy):
    space = spaces.MultiDiscrete([3, 2], start=[1, -1])
    kinds = {"MlpPolicy": space, "MultiInputPolicy": spaces.Dict({"a": space, "b": spaces.Box(-1, 1, (2,))})}[policy]
    observations = {"MlpPolicy": policies.MlpPolicy, "MultiInputPolicy": policies.MultiInputPolicy}[policy]
    kind = observations._observations(kinds, True)
    raw = {name: th.zeros(4, 2, device="meta") for name in ("a", "b")}
    with OnDevice():
        kind.preprocess(raw if policy == "MultiInputPolicy" else raw["a"])


def test_what_meets_the_host_is_found():
    """Else the tests above could not fail."""
    x = th.ones(3, device="meta")
    for work in (
        lambda: x + th.ones(3),
        lambda: th.zeros(()).to("meta"),
        lambda: th.tensor([1.0]).to("meta") + x,
        lambda: x.copy_(th.ones(3)),
        lambda: th.tensor(0.0, device="meta"),
        lambda: x[x > 0],
    ):
        with pytest.raises(AssertionError), OnDevice():
            work()
    with OnDevice():
        assert (x * 2 + 1).shape == (3,)


# -- on a GPU --------------------------------------------------------------------------------------------------------------


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("method", [None, *registered_intrinsic_rewards()])
def test_on_a_gpu_recorded_updates_are_the_same(learner, batch, method):
    found = []
    for compile in ("eager", "cuda_graphs"):
        th.manual_seed(0)
        made = learner(method, target_update_interval=2, compile=compile)
        its = type(made)(made.agent.to("cuda"), made.config)
        rows = graphs.map_tensors(th.Tensor.cuda, with_skill(made, batch))
        metrics = run_updates(its, rows)
        assert its.recorder.recordings == (compile == "cuda_graphs" and method not in WAITING)
        found.append((metrics, its))
    (expected, plain), (metrics, recorded) = found
    for ours, theirs in zip(metrics, expected, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-3, abs=1e-5, nan_ok=True)
    assert recorded.guard.total() == plain.guard.total() == 1
    for ours, theirs in zip(recorded.agent.state_dict().values(), plain.agent.state_dict().values(), strict=True):
        assert th.allclose(ours, theirs, atol=1e-4)


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("case", CASES)
def test_on_a_gpu_recorded_actions_are_the_same(tiny_model, case, deterministic):
    plain, recorded = (tiny_model(compile=compile, device="cuda", **CASES[case]) for compile in ("eager", "cuda_graphs"))
    (expected, _), (found, _) = act(plain, deterministic), act(recorded, deterministic)
    for ours, theirs in zip(found, expected, strict=True):
        assert all(np.allclose(one, other, atol=1e-4) for one, other in zip(ours, theirs, strict=True))
    assert recorded.policy._recorded()[1].recordings == (case != "random")
