"""Snapshots: what comes back, and what is refused: damaged files, foreign ones, and files made to run code."""

from __future__ import annotations

import encodings.cp437  # noqa: F401 - of names in zip files; code_events would see its import
import io
import json
import os
import pickle
import random
import re
import signal
import subprocess
import sys
import time
import zipfile
from collections import deque

import numpy as np
import pytest
import safetensors.torch
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT
from snapshot_files import change_data, change_header, code_events, members, write
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_dreamer_urlb import DreamerPolicy, DreamerV2, SnapshotError
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.intrinsic import DIAYN, LBS
from sb3_dreamer_urlb.planning import DynaMPC, PlannerConfig
from sb3_dreamer_urlb.snapshots import bounded_json, values
from sb3_dreamer_urlb.snapshots.atomic import written_atomically
from sb3_dreamer_urlb.snapshots.migrations import MIGRATIONS, VERSION


def halve(remaining):
    """A schedule that no file can hold."""
    return 1e-3 * remaining / 2


class Other(LBS):
    """An intrinsic reward that is not registered."""


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A model that has learnt a little, and its file."""
    model = DreamerV2(
        "CnnPolicy", CounterEnv(8), intrinsic_reward="lbs", planner="dyna_mpc", preset="tiny", seed=0, device="cpu"
    ).learn(24)
    path = tmp_path_factory.mktemp("saved") / "model.zip"
    model.save(path)
    DreamerV2.load(path)  # whatever it imports is imported
    return model, path


def load(path, **kwargs):
    return DreamerV2.load(path, device="cpu", **kwargs)


def same(one, two):
    """Whether two models have the same weights, moments and counters."""
    first, second = one.policy.state_dict(), two.policy.state_dict()
    moments = [
        [
            value
            for optimizer in model.learner.optimizers().values()
            for s in optimizer.adam.state.values()
            for value in s.values()
        ]
        for model in (one, two)
    ]
    counters = (
        "num_timesteps", "_n_updates", "phase", "phase_timesteps", "phase_updates", "phase_frames", "pretrained_frames",
        "n_envs", "seed",
    )  # fmt: skip
    return (
        all(th.equal(first[name], second[name]) for name in first)
        and len(moments[0]) == len(moments[1]) > 0
        and all(th.equal(a, b) for a, b in zip(*moments, strict=True))
        and all(getattr(one, name) == getattr(two, name) for name in counters)
    )


def refused(path, message="", **kwargs):
    """A load raises an error that names the file and gives the reason, and runs no code."""
    with code_events() as events, pytest.raises(SnapshotError, match=message or "is refused") as caught:
        load(path, **kwargs)
    assert events == []
    assert isinstance(path, io.BytesIO) or str(path) in str(caught.value)


# -- the file --------------------------------------------------------------------------------------------------------------


def test_a_file_is_json_and_safetensors(saved):
    model, path = saved
    content = members(path)
    assert set(content) == {"data", "tensors.safetensors", "manifest.json", "_stable_baselines3_version", "system_info.txt"}
    with zipfile.ZipFile(path) as file:
        assert {info.compress_type for info in file.infolist()} == {zipfile.ZIP_STORED}
    manifest, data = json.loads(content["manifest.json"]), json.loads(content["data"])
    assert manifest["version"] == VERSION and manifest["kind"] == "model"
    assert data["arguments"]["intrinsic_reward"] == "lbs" and data["counters"]["num_timesteps"] == 24
    tensors = safetensors.torch.load(content["tensors.safetensors"])
    weight = model.policy.agent.actor.body.out.weight
    assert th.equal(tensors["policy.agent.actor.body.out.weight"], weight.detach())


def test_loading_runs_no_code(saved):
    with code_events() as events:
        loaded = load(saved[1])
    assert events == [] and same(loaded, saved[0])
    with code_events() as events:
        exec("pass")
    assert events  # the watcher sees


def test_equal_models_give_equal_files(saved, tmp_path):
    loaded = load(saved[1])
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again.zip").read_bytes() == saved[1].read_bytes()


@pytest.mark.parametrize("target", ["buffer", "file", "string", "no suffix", "new folder"])
def test_where_a_model_is_saved(saved, tmp_path, target):
    model = saved[0]
    if target == "buffer":
        buffer = io.BytesIO()
        model.save(buffer)
        assert same(load(buffer), model)
    elif target == "file":
        with open(tmp_path / "m.zip", "wb") as file:
            model.save(file)
        with open(tmp_path / "m.zip", "rb") as file:
            assert same(load(file), model)
    else:
        path = {"string": str(tmp_path / "m.zip"), "no suffix": tmp_path / "m", "new folder": tmp_path / "a" / "b.zip"}[target]
        model.save(path)
        assert same(load(path), model)
        assert [file.suffix for file in tmp_path.rglob("*") if file.is_file()] == [".zip"]


def test_what_is_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="nothing"):
        load(tmp_path / "nothing")


def test_a_snapshot_is_whole(saved, tmp_path):
    for keyword in ("include", "exclude"):
        with pytest.raises(ValueError, match="always whole"):
            saved[0].save(tmp_path / "m", **{keyword: ["policy"]})


def test_a_model_that_is_not_finite_is_not_saved(tiny_model, tmp_path):
    model = tiny_model()
    model.save(tmp_path / "m")
    before = (tmp_path / "m.zip").read_bytes()
    with th.no_grad():
        model.policy.agent.critic.out.weight[0, 0] = float("nan")
    with pytest.raises(ValueError, match=r"critic\.out\.weight.*not finite"):
        model.save(tmp_path / "m")
    assert (tmp_path / "m.zip").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_print_system_info(saved, tmp_path, capsys):
    content = members(saved[1])
    path = write(tmp_path / "m.zip", {**content, "system_info.txt": b"OS: \x1b[31mred"})
    load(path, print_system_info=True)
    out = capsys.readouterr().out
    assert "OS: [31mred" in out and "\x1b" not in out and "PyTorch" in out


def test_statistics_of_episodes(tiny_model, tmp_path):
    """At most the last thousand, so that a file stays one that can be read."""
    model = tiny_model(CounterEnv(2), stats_window_size=100_000)
    model.ep_info_buffer = deque([{"r": float(i), "l": 2, "t": 0.5} for i in range(70_000)], maxlen=100_000)
    model.save(tmp_path / "m")
    loaded = load(tmp_path / "m")
    assert [info["r"] for info in loaded.ep_info_buffer] == list(range(69_000, 70_000))
    assert loaded.ep_info_buffer.maxlen == 100_000


# -- arguments -------------------------------------------------------------------------------------------------------------


ARGUMENTS = {
    "constant": {"learning_rate": ConstantSchedule(0.25)},
    "linear": {"actor_learning_rate": FloatSchedule(LinearSchedule(1e-3, 1e-4, 0.5))},
    "infinite": {"max_grad_norm": float("inf")},
    "noise": {"action_noise": NormalActionNoise(np.zeros(2), np.full(2, 0.1))},
    "process": {"action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(2), np.ones(2), 0.3, initial_noise=np.ones(2))},
    "frequency": {"train_freq": (2, "episode"), "gradient_steps": np.int64(3)},
    "class": {"intrinsic_reward": LBS},
    "hyperparameters": {"intrinsic_reward": "rnd", "intrinsic_kwargs": {"output_size": 5}},
    "instance": {"intrinsic_reward": DIAYN(skill_dim=3)},
    "kwargs": {"replay_buffer_kwargs": {"max_episode_rows": 30}, "planner_kwargs": {"momentum": 0.2}},
    "texts": {"tensorboard_log": "logs/ä", "verbose": 1, "stats_window_size": 7, "seed": None},
}


@pytest.mark.parametrize("kwargs", ARGUMENTS.values(), ids=ARGUMENTS)
def test_arguments_come_back(tiny_model, tmp_path, kwargs):
    model = tiny_model(**kwargs)
    model.save(tmp_path / "m")
    loaded = load(tmp_path / "m")
    assert loaded.train_freq == model.train_freq and loaded._stats_window_size == kwargs.get("stats_window_size", 100)
    for name in ("learning_rate", "actor_learning_rate", "action_noise", "intrinsic_reward", "max_grad_norm", "planner_kwargs",
                 "policy_kwargs", "replay_buffer_kwargs", "tensorboard_log", "verbose", "seed", "gradient_steps"):  # fmt: skip
        assert values.encode(getattr(loaded, name)) == values.encode(getattr(model, name)), name
    for remaining in (1.0, 0.7, 0.1):
        assert loaded._actor_lr_schedule(remaining) == model._actor_lr_schedule(remaining)


def test_a_function_must_be_given_again(tiny_model, tmp_path):
    tiny_model(learning_rate=halve).save(tmp_path / "m")
    refused(tmp_path / "m.zip", r"its learning_rate was test_snapshot\.halve.*custom_objects=\{'learning_rate'")
    assert load(tmp_path / "m", custom_objects={"learning_rate": halve}).lr_schedule(1) == 5e-4
    assert load(tmp_path / "m", learning_rate=0.5).lr_schedule(1) == 0.5


def test_saving_says_nothing(tiny_model, tmp_path, capsys):
    model = tiny_model(verbose=1)
    capsys.readouterr()
    model.save(tmp_path / "model")
    assert capsys.readouterr().out == ""
    assert DreamerV2.load(tmp_path / "model", device="cpu").verbose == 1


def test_an_unregistered_class_must_be_given_again(tiny_model, tmp_path):
    tiny_model(intrinsic_reward=Other).save(tmp_path / "m")
    refused(tmp_path / "m.zip", r"its intrinsic_reward was test_snapshot\.Other")
    loaded = load(tmp_path / "m", custom_objects={"intrinsic_reward": Other})
    assert type(loaded.policy.agent.intrinsic) is Other


def test_a_policy_of_ones_own_must_be_given_again(tmp_path):
    own = type("Own", (DreamerPolicy,), {})
    DreamerV2(own, CounterEnv(), preset="tiny", device="cpu").save(tmp_path / "m")
    refused(tmp_path / "m.zip", "its policy was .*Own")
    assert type(load(tmp_path / "m", custom_objects={"policy": own}).policy) is own


def test_custom_objects_replace_arguments_and_foreign_names_are_ignored(saved):
    """enjoy hands in names that only other algorithms have."""
    loaded = load(saved[1], custom_objects={"batch_size": 7, "lr_schedule": halve, "clip_range": halve})
    assert loaded.batch_size == 7 and loaded.lr_schedule is not halve


def test_an_environment_that_does_not_fit(saved):
    """The file is in order."""
    for env in (CounterEnv(size=20), CounterEnv(action_space=spaces.Box(-1, 1, (3,), np.float32))):
        with pytest.raises(ValueError, match="spaces do not match") as caught:
            load(saved[1], env=env)
        assert not isinstance(caught.value, SnapshotError)


def test_random_states(tiny_model, tmp_path):
    """A seeded model goes on where it was; an unseeded one, or a new seed, draws anew."""
    for name, seed in (("seeded", 3), ("free", None)):
        tiny_model(seed=seed).save(tmp_path / name)
    found = []
    for path, kwargs in ((tmp_path / "seeded", {}), (tmp_path / "seeded", {"seed": 4}), (tmp_path / "free", {})):
        tiny_model(seed=3)  # the states of the file
        th.rand(5), np.random.rand(5), random.random()  # noqa: NPY002
        load(path, **kwargs)
        found.append((th.rand(2), np.random.rand(), random.random()))  # noqa: NPY002
    again = []
    for _ in range(2):
        load(tmp_path / "seeded")
        again.append((th.rand(2), np.random.rand(), random.random()))  # noqa: NPY002
    assert again[0][1:] == again[1][1:] == found[0][1:] and th.equal(again[0][0], found[0][0])
    assert found[1][1:] != found[0][1:] and found[2][1:] != found[0][1:]


# -- JSON and values -------------------------------------------------------------------------------------------------------

JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**128), 2**128) | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(JSON)
def test_json_comes_back(value):
    try:
        assert bounded_json.parse(bounded_json.dump(value)) == value
    except ValueError as error:
        assert "half a character" in str(error) or "nested" in str(error)


@pytest.mark.parametrize(
    "text",
    ['{"a": 1, "a": 2}', "NaN", "[Infinity]", "-Infinity", "1e999", "1" * 65, "[" * 17 + "]" * 17, "[" * 10**5, '"\\ud800"',
     "[" + "0," * 200_001 + "0]", '"' + "a" * 70_000 + '"', "", "\xff", '{"a": 1} x'],
    ids=lambda text: text[:20],
)  # fmt: skip
def test_json_out_of_bounds(text):
    with pytest.raises(ValueError):
        bounded_json.parse(text.encode("latin-1"))


SHAPES = st.lists(st.integers(1, 3), min_size=1, max_size=3).map(tuple)


@st.composite
def boxes(draw):
    shape, dtype = draw(SHAPES), draw(st.sampled_from([np.float32, np.float64, np.uint8, np.int64]))
    generator = np.random.default_rng(draw(st.integers(0, 99)))
    if draw(st.booleans()):
        low = generator.uniform(0, 100, shape).astype(dtype)
        return spaces.Box(low, (low + generator.integers(1, 9, shape)).astype(dtype), dtype=dtype)
    unbounded = np.issubdtype(dtype, np.floating) and draw(st.booleans())
    return spaces.Box(-np.inf if unbounded else 0, np.inf if unbounded else 200, shape, dtype)


SPACES = (
    boxes()
    | st.builds(spaces.Discrete, st.integers(1, 9))
    | st.builds(spaces.MultiBinary, st.integers(1, 9))
    | st.builds(spaces.MultiDiscrete, st.lists(st.integers(1, 9), min_size=1, max_size=4))
)


@given(SPACES | st.dictionaries(st.text("abc", min_size=1), SPACES, min_size=1, max_size=3).map(spaces.Dict))
def test_spaces_come_back(space):
    back = values.decode(bounded_json.parse(bounded_json.dump(values.encode(space))))
    assert back == space and type(back) is type(space)
    if isinstance(space, spaces.Box):
        assert np.array_equal(back.low, space.low) and np.array_equal(back.high, space.high) and back.dtype == space.dtype


def test_a_planner_comes_back():
    planner = DynaMPC(PlannerConfig(horizon=3, temperature=0.25), 0.9)
    back = values.decode(values.encode(planner))
    assert back.config == planner.config and back.gae_lambda == 0.9


# -- damage ----------------------------------------------------------------------------------------------------------------


def test_damaged_files_are_refused_or_the_same(saved, tmp_path):
    """Bits flipped anywhere, bytes cut off, doubled or put before."""
    model, path = saved
    whole = path.read_bytes()
    generator = np.random.default_rng(0)
    outcomes = {"refused": 0, "same": 0}
    for i in range(400):
        content = bytearray(whole)
        kind = i % 8
        place = int(generator.integers(len(content)))
        if kind < 5:
            # Half of them where the zip keeps its own books.
            place = len(content) - 1 - int(generator.integers(900)) if i % 2 else place
            content[place] ^= 1 << int(generator.integers(8))
        elif kind == 5:
            del content[place:]
        elif kind == 6:
            del content[place : place + int(generator.integers(1, 50))]
        else:
            content[place:place] = content[place : place + 20]
        with code_events() as events:
            try:
                loaded = load(io.BytesIO(bytes(content)))
            except SnapshotError:
                outcomes["refused"] += 1
            else:
                assert same(loaded, model), (kind, place)
                outcomes["same"] += 1
        assert events == []
    assert outcomes["refused"] > 350 and sum(outcomes.values()) == 400


@pytest.mark.parametrize("size", [0, 1, 21, 22, 23, 97, 98, 99])
def test_stumps(tmp_path, saved, size):
    (tmp_path / "m.zip").write_bytes(saved[1].read_bytes()[-size:] if size else b"")
    refused(tmp_path / "m.zip")


# -- malice ----------------------------------------------------------------------------------------------------------------


class Malicious:
    """Touches a file when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.system, (f"touch {self.path}",)


def _argument(name, value):
    return lambda data: data["arguments"].__setitem__(name, value)


def _sizes(**sizes):
    return lambda data: data["arguments"]["policy_kwargs"].update(sizes)


def _field(name, value):
    return lambda data: data.__setitem__(name, value)


def _counter(name, value):
    return lambda data: data["counters"].__setitem__(name, value)


DATA = {
    "method": (_field("predict", "x"), "other fields.*predict"),
    "method as argument": (_argument("predict", "x"), "an argument 'predict'"),
    "private": (_argument("__class__", "x"), "an argument '__class__'"),
    "unknown tag": (_argument("learning_rate", {"!": "function", "code": "x"}), "unknown kind 'function'"),
    "serialized": (_argument("learning_rate", {":type:": "x", ":serialized:": "gASV"}), "learning_rate"),
    "tag of list": (_argument("learning_rate", {"!": ["x"]}), "unknown kind"),
    "schedule": (_argument("learning_rate", {"!": "LinearSchedule", "start": "x", "end": 0, "end_fraction": 1}), "float"),
    "text as rate": (_argument("learning_rate", "os.system"), "learning_rate"),
    "intrinsic": (_argument("intrinsic_reward", {"!": "intrinsic", "name": "os"}), "Unknown intrinsic_reward"),
    "huge network": (_sizes(deter_size=10**12), ""),
    "large network": (_sizes(hidden_size=50_000, deter_size=50_000), "model's"),
    "deep network": (_sizes(net_arch=[8] * 30), "lacks"),
    "deepest network": (_sizes(net_arch=[8] * 100_000), "more than .* parameters"),
    "policy kwargs": (_argument("policy_kwargs", [1]), "policy_kwargs"),
    "policy": (_field("policy", "os.system"), "Unknown policy"),
    "negative": (_argument("batch_size", -1), "batch_size"),
    "fraction": (_argument("batch_size", 1.5), "batch_size"),
    "gamma": (_argument("gamma", 3), "gamma"),
    "seed": (_argument("seed", -1), "seed"),
    "folder": (_argument("tensorboard_log", ["x"]), "tensorboard_log"),
    "buffer kwargs": (_argument("replay_buffer_kwargs", {"device": "x"}), ""),
    "counter": (_counter("num_timesteps", -1), "num_timesteps"),
    "counter text": (_counter("n_updates", "3"), "n_updates"),
    "counter bool": (_counter("phase_updates", True), "phase_updates"),
    "phase": (_field("phase", "x"), "phase"),
    "phase list": (_field("phase", ["x"]), "phase"),
    "envs": (_field("n_envs", 10**9), "n_envs"),
    "space": (
        _field("observation_space", {"!": "Box", "low": 0, "high": 255, "shape": [10**6] * 3, "dtype": "uint8"}),
        "shape",
    ),
    "object array": (_field("action_space", {"!": "array", "dtype": "O", "shape": [1], "values": [1]}), "array"),
    "no space": (_field("action_space", 3), ""),
    "random": (lambda data: data["random"].__setitem__("torch", "00"), ""),
    "numpy position": (lambda data: data["random"]["numpy"]["state"].__setitem__("pos", 10**6), "random states"),
    "generator": (lambda data: data["random"]["sampler"].__setitem__("bit_generator", "MT19937"), "generator"),
    "episodes": (_field("episodes", [{"r": 1}]), "episodes"),
}


@pytest.mark.parametrize(("change", "message"), DATA.values(), ids=DATA)
def test_fields_that_do_not_fit(saved, tmp_path, change, message):
    refused(change_data(saved[1], tmp_path / "m.zip", change), message)


WEIGHT = "policy.agent.actor.body.out.weight"
HEADERS = {
    "huge shape": (lambda h: h[WEIGHT].__setitem__("shape", [2**40, 2**20]), "do not fill"),
    "another shape": (lambda h: h[WEIGHT].__setitem__("shape", h[WEIGHT]["shape"][::-1]), "model's"),
    "negative shape": (lambda h: h[WEIGHT].__setitem__("shape", [-2, -8]), "shape"),
    "another type": (lambda h: h[WEIGHT].__setitem__("dtype", "I32"), "model's"),
    "unknown type": (lambda h: h[WEIGHT].__setitem__("dtype", "OBJ"), "dtype"),
    "overlap": (lambda h: h[WEIGHT].__setitem__("data_offsets", [0, 64]), ""),
    "another name": (lambda h: h.__setitem__("policy.forward", h.pop(WEIGHT)), "lacks"),
    "one more": (lambda h: h.__setitem__("predict", {"dtype": "F32", "shape": [0], "data_offsets": [0, 0]}), "'predict'"),
    "metadata": (lambda h: h.__setitem__("__metadata__", {"a": "b"}), "__metadata__"),
}


@pytest.mark.parametrize(("change", "message"), HEADERS.values(), ids=HEADERS)
def test_tensors_that_do_not_fit(saved, tmp_path, change, message):
    refused(change_header(saved[1], tmp_path / "m.zip", change), message)


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_values_that_are_not_finite(saved, tmp_path, value):
    content = members(saved[1])
    tensors = safetensors.torch.load(content["tensors.safetensors"])
    tensors[WEIGHT][0, 0] = value
    path = write(tmp_path / "m.zip", {**content, "tensors.safetensors": safetensors.torch.save(tensors)})
    refused(path, "not finite")


def test_second_moments_below_zero(saved, tmp_path):
    content = members(saved[1])
    tensors = safetensors.torch.load(content["tensors.safetensors"])
    tensors["actor_optimizer.0.exp_avg_sq"] -= 1
    path = write(tmp_path / "m.zip", {**content, "tensors.safetensors": safetensors.torch.save(tensors)})
    refused(path, "negative")


@pytest.mark.parametrize(
    "member", ["data", "tensors.safetensors", "manifest.json", "_stable_baselines3_version", "system_info.txt"]
)
def test_a_pickle_in_any_member(saved, tmp_path, member):
    evil = pickle.dumps(Malicious(tmp_path / "touched"))
    content = {**members(saved[1]), member: evil}
    path = write(tmp_path / "m.zip", content, honest=member != "manifest.json")
    if member == "system_info.txt":  # a text that nobody reads
        with code_events() as events:
            load(path)
        assert events == []
    else:
        refused(path)
    assert not (tmp_path / "touched").exists()


@pytest.mark.parametrize(
    "name", ["../../evil", "/tmp/evil", "data/../x", "tensors.safetensors.exe", "rows-000000.safetensors"]
)
def test_members_that_do_not_belong(saved, tmp_path, name):
    path = write(tmp_path / "m.zip", {**members(saved[1]), name: b"x"})
    refused(path, "has a member")
    assert not (tmp_path.parent / "evil").exists()


def test_the_zip_itself(saved, tmp_path):
    content = members(saved[1])
    target = tmp_path / "m.zip"
    refused(write(target, content, compression=zipfile.ZIP_DEFLATED), "compressed")
    refused(write(target, {**content, "data": b" " * (5 << 20)}), "bytes")
    with pytest.warns(UserWarning, match="Duplicate"):
        write(target, [*content.items(), ("data", content["data"])])
    refused(target, "same name")
    refused(write(target, {name: data for name, data in content.items() if name != "data"}), "lacks the members")
    refused(write(target, [(f"x{i}", b"") for i in range(20_000)], honest=False), "20000 members")
    refused(write(target, {**content, "data": b'{"a": 1, "a": 1}'}), "same key twice")
    refused(write(target, {**content, "data": b'{"a": NaN}'}), "NaN")
    refused(write(target, {**content, "data": b"[" * 100_000}), "nested|JSON")
    refused(write(target, {**content, "data": content["data"] + b" "}, honest=False), "manifest")
    # A declared size beyond what is there.
    raw = bytearray(saved[1].read_bytes())
    place = raw.rindex(b"tensors.safetensors") - 46
    raw[place + 20 : place + 28] = (2**31).to_bytes(4, "little") * 2
    target.write_bytes(raw)
    refused(target)


def test_large_shapes_are_refused_before_memory_is_taken(saved, tmp_path):
    """By the table, which is compared with a model without memory."""
    path = change_data(saved[1], tmp_path / "m.zip", _sizes(cnn_depth=3000, deter_size=30_000))
    code = f"""
import resource
from sb3_dreamer_urlb import DreamerV2, SnapshotError
DreamerV2.load({str(saved[1])!r}, device="cpu")
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    DreamerV2.load({str(path)!r}, device="cpu")
except SnapshotError:
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, check=True).stdout
    assert int(out) < 50_000  # kB; the networks would take gigabytes


# -- versions --------------------------------------------------------------------------------------------------------------


def with_version(path, target, version, data=None):
    content = members(path)
    manifest = json.loads(content["manifest.json"])
    manifest["version"] = version
    changed = content["data"] if data is None else json.dumps(data).encode()
    return write(target, {**content, "data": changed, "manifest.json": json.dumps(manifest).encode()})


def test_a_file_of_version_1_is_brought_up_to_date(saved, tmp_path):
    """It had no random states, no statistics of episodes and no run folders."""
    data = json.loads(members(saved[1])["data"])
    old = {name: value for name, value in data.items() if name not in ("random", "episodes", "run")}
    path = with_version(saved[1], tmp_path / "old.zip", 1, old)
    assert same(load(path), saved[0])
    refused(with_version(saved[1], tmp_path / "wrong.zip", 2, old), "other fields")
    assert set(MIGRATIONS) == set(range(1, VERSION))


def test_a_file_of_version_2_is_brought_up_to_date(saved, tmp_path):
    """It counted neither faults of environments, nor skipped updates, nor the frames of the pre-training behind it."""
    new = ("env_faults", "skipped_updates", "pretrained_frames")
    old = json.loads(members(saved[1])["data"])
    for name in new:
        old["counters"][name] = 5
    assert load(with_version(saved[1], tmp_path / "new.zip", VERSION, old)).env_faults == 5
    for name in new:
        del old["counters"][name]
    loaded = load(with_version(saved[1], tmp_path / "old.zip", 2, old))
    assert same(loaded, saved[0]) and [getattr(loaded, name) for name in new] == [0, 0, 0]
    refused(with_version(saved[1], tmp_path / "wrong.zip", VERSION, old), "pretrained_frames")


def test_a_file_of_version_3_is_brought_up_to_date(saved, tmp_path):
    """It did not say what a fine-tuning began with."""
    old = json.loads(members(saved[1])["data"])
    kept = {"actor": True, "critic": False, "reward": True}
    assert load(with_version(saved[1], tmp_path / "new.zip", VERSION, {**old, "kept": kept})).kept == kept
    for wrong in ({"actor": True}, {**kept, "actor": 1}, [True], "yes"):
        refused(with_version(saved[1], tmp_path / "wrong.zip", VERSION, {**old, "kept": wrong}), "fine-tuning kept")
    del old["kept"]
    loaded = load(with_version(saved[1], tmp_path / "old.zip", 3, old))
    assert same(loaded, saved[0]) and loaded.kept is None


def test_a_file_of_version_4_is_brought_up_to_date(saved, tmp_path):
    """It did not say which task its agent had learnt."""
    old = json.loads(members(saved[1])["data"])
    assert load(with_version(saved[1], tmp_path / "new.zip", VERSION, {**old, "learnt_task": "walker-run"})).learnt_task
    refused(with_version(saved[1], tmp_path / "wrong.zip", VERSION, {**old, "learnt_task": 3}), "learnt_task is no text")
    del old["learnt_task"]
    loaded = load(with_version(saved[1], tmp_path / "old.zip", 4, old))
    assert same(loaded, saved[0]) and loaded.learnt_task is None


@pytest.mark.parametrize("version", [VERSION + 1, 0, -1, "2", True, 2.0, None])
def test_versions_that_nobody_reads(saved, tmp_path, version):
    refused(with_version(saved[1], tmp_path / "m.zip", version), "version")


def test_files_of_another_kind(saved, tiny_model, tmp_path):
    model, path = saved
    model.policy.save(tmp_path / "policy.zip")
    model.save_replay_buffer(tmp_path / "replay.zip")
    refused(tmp_path / "policy.zip", "policy file, not a .* model file")
    refused(tmp_path / "replay.zip", "lacks|member")
    with pytest.raises(SnapshotError, match=r"model file, not a .* policy file"):
        DreamerPolicy.load(path)
    with pytest.raises(SnapshotError, match="member"):
        model.load_replay_buffer(path)


# -- Stable-Baselines3's own form ------------------------------------------------------------------------------------------


@pytest.fixture
def old_form(tiny_model, tmp_path):
    """A model, and a file of it in Stable-Baselines3's form."""
    model = tiny_model(CounterEnv(8), intrinsic_reward="lbs").learn(24)
    left_out = ["learner", "_acting_state", "_metrics", "during_learn", "run_folder"]
    BaseAlgorithm.save(model, tmp_path / "old.zip", exclude=left_out)
    return model, tmp_path / "old.zip"


def test_stable_baselines3s_own_form_is_refused_and_converted(old_form, tmp_path, capsys):
    model, old = old_form
    refused(old, "it is a pickle.*could run any code.*sb3-dreamer-urlb convert OLD NEW --trust")
    new = tmp_path / "new.zip"
    assert main(["convert", str(old), str(new)]) == 2 and not new.exists()
    assert "--trust" in capsys.readouterr().err
    assert main(["convert", str(old), str(new), "--trust"]) == 0
    assert same(load(new), model) and "24 frames" in capsys.readouterr().out
    for more in ([], ["--trust"]):
        assert main(["convert", str(new), str(tmp_path / "newer"), *more]) == 2
    assert capsys.readouterr().err.count(f"{new} is in the safe form already.") == 2


def test_models_of_other_algorithms_are_not_converted(tmp_path, capsys):
    SAC("MlpPolicy", "Pendulum-v1", device="cpu", buffer_size=10, policy_kwargs={"net_arch": [4]}).save(tmp_path / "sac.zip")
    assert main(["convert", str(tmp_path / "sac.zip"), str(tmp_path / "new.zip"), "--trust"]) == 2
    assert "sac.zip holds a model of stable_baselines3.sac.policies, not of DreamerV2." in capsys.readouterr().err


def test_converting_what_is_none(saved, tmp_path, capsys):
    assert main(["convert", str(tmp_path / "nothing.zip"), str(tmp_path / "new.zip"), "--trust"]) == 2
    assert main(["convert", str(saved[1]), str(tmp_path / "new.zip"), "--trust"]) == 2
    assert "model.zip" in capsys.readouterr().err


@pytest.mark.parametrize("maker", [pickle.dumps, "torch"])
def test_bare_pickles_are_refused(tmp_path, saved, maker):
    path = tmp_path / "model.zip"
    evil = Malicious(tmp_path / "touched")
    if maker == "torch":
        th.save(evil, path)
    else:
        path.write_bytes(maker(evil))
    refused(path, "it is a pickle")
    with code_events() as events:
        for loader in (DreamerPolicy.load, saved[0].load_replay_buffer, saved[0].set_parameters):
            with pytest.raises(SnapshotError, match="it is a pickle"):
                loader(path)
    assert events == [] and not (tmp_path / "touched").exists()


# -- set_parameters --------------------------------------------------------------------------------------------------------


def test_parameters_that_were_handed_over_are_the_receivers_own(tiny_model, weights):
    def moments(model):
        return [float(state["step"]) for adam in model.adams().values() for state in adam.state.values()]

    giver = tiny_model(seed=0).learn(40)
    given = giver.get_parameters()
    before = weights(giver.policy), moments(giver)
    receivers = [tiny_model(seed=seed) for seed in (1, 2)]
    for receiver in receivers:
        receiver.set_parameters(given)
        assert (weights(receiver.policy), moments(receiver)) == before
    receivers[0].learn(40)
    for other in (giver, receivers[1]):
        assert (weights(other.policy), moments(other)) == before
    # What was got stays as it was, so that it can be put back.
    giver.learn(40)
    assert (weights(giver.policy), moments(giver)) != before
    giver.set_parameters(given)
    assert (weights(giver.policy), moments(giver)) == before


def test_set_parameters(saved, tiny_model):
    model, path = saved
    other = tiny_model(CounterEnv(8), intrinsic_reward="lbs", seed=5)
    other.set_parameters(path)
    assert all(th.equal(value, other.policy.state_dict()[name]) for name, value in model.policy.state_dict().items())
    moments = model.learner.actor_optimizer.adam.state_dict()["state"][0]["exp_avg"]
    assert th.equal(moments, other.learner.actor_optimizer.adam.state_dict()["state"][0]["exp_avg"])
    third = tiny_model(CounterEnv(8), intrinsic_reward="lbs", seed=6)
    third.set_parameters(model.get_parameters())
    assert th.equal(third.policy.agent.actor.body.out.weight, model.policy.agent.actor.body.out.weight)


def test_set_parameters_that_do_not_all_fit(saved, tiny_model, weights):
    fine_tuning = tiny_model(CounterEnv(8), seed=5)
    before = weights(fine_tuning.policy)
    with pytest.raises(SnapshotError, match="model has not"):
        fine_tuning.set_parameters(saved[1])
    assert weights(fine_tuning.policy) == before
    fine_tuning.set_parameters(saved[1], exact_match=False)
    assert th.equal(fine_tuning.policy.agent.actor.body.out.weight, saved[0].policy.agent.actor.body.out.weight)


@pytest.mark.parametrize("exact", [True, False])
def test_set_parameters_never_changes_half_a_model(saved, tiny_model, tmp_path, weights, exact):
    content = members(saved[1])
    tensors = safetensors.torch.load(content["tensors.safetensors"])
    tensors[sorted(name for name in tensors if name.startswith("policy."))[-1]].view(-1)[0] = float("nan")
    path = write(tmp_path / "m.zip", {**content, "tensors.safetensors": safetensors.torch.save(tensors)})
    model = tiny_model(CounterEnv(8), intrinsic_reward="lbs", seed=5)
    before = weights(model.policy)
    with pytest.raises(SnapshotError, match="not finite"):
        model.set_parameters(path, exact_match=exact)
    assert weights(model.policy) == before


# -- policies and replay ---------------------------------------------------------------------------------------------------


def test_policy_files(saved, tmp_path):
    policy = saved[0].policy
    for target in (tmp_path / "policy.pth", io.BytesIO()):
        policy.save(target)
        with code_events() as events:
            loaded = DreamerPolicy.load(target, device="cpu")
        assert events == []
        assert all(th.equal(value, loaded.state_dict()[name]) for name, value in policy.state_dict().items())
        assert loaded.planner.config == policy.planner.config and type(loaded.agent.intrinsic) is LBS
    assert [file.name for file in tmp_path.iterdir()] == ["policy.pth"]


def test_a_policy_with_a_class_of_ones_own(tiny_model, tmp_path):
    tiny_model(intrinsic_reward=Other).policy.save(tmp_path / "policy")
    with pytest.raises(SnapshotError, match=r"its intrinsic was an object of the class test_snapshot\.Other"):
        DreamerPolicy.load(tmp_path / "policy")
    loaded = DreamerPolicy.load(tmp_path / "policy", custom_objects={"intrinsic": Other()})
    assert type(loaded.agent.intrinsic) is Other


@pytest.mark.parametrize("member_bytes", [1, 64 << 20])
def test_replay_files(tiny_model, tmp_path, monkeypatch, member_bytes):
    from sb3_dreamer_urlb.snapshots import replay

    monkeypatch.setattr(replay, "MEMBER_BYTES", member_bytes)
    model = tiny_model(CounterEnv([7, 2, 12])).learn(40)
    model.save_replay_buffer(tmp_path / "replay")
    assert [file.name for file in tmp_path.iterdir()] == ["replay.zip"]
    assert (len(members(tmp_path / "replay.zip")) > 5) == (member_bytes == 1)
    other = tiny_model(CounterEnv([7, 2, 12]))
    with code_events() as events:
        other.load_replay_buffer(tmp_path / "replay")
    assert events == []
    model.replay_buffer.close_streams()
    before, after = model.replay_buffer, other.replay_buffer
    assert len(before.episodes) == len(after.episodes) > 3
    for one, two in zip(before.episodes, after.episodes, strict=True):
        assert list(one.columns) == list(two.columns)
        assert all(np.array_equal(rows, two.columns[name]) for name, rows in one.columns.items())
    assert (after.finished_count, after.longest, after.finished_rows) == (
        before.finished_count, before.longest, before.finished_rows,
    )  # fmt: skip
    first, second = (buffer.sample(20) for buffer in (before, after))
    assert th.equal(first.observation, second.observation) and th.equal(first.reward, second.reward)


def test_damaged_replay_files(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(7)).learn(30)
    model.save_replay_buffer(tmp_path / "replay.pkl")
    whole = (tmp_path / "replay.pkl").read_bytes()
    buffer, generator = model.replay_buffer, np.random.default_rng(0)
    for i in range(60):
        content = bytearray(whole)
        place = int(generator.integers(len(content)))
        if i % 3:
            content[place] ^= 1 << int(generator.integers(8))
        else:
            del content[place:]
        try:
            model.load_replay_buffer(io.BytesIO(bytes(content)))
        except SnapshotError:
            assert model.replay_buffer is buffer
        else:
            assert len(model.replay_buffer.episodes) == len(buffer.episodes) + 1  # the open one
            model.replay_buffer = buffer


# -- interrupted saves -----------------------------------------------------------------------------------------------------


def test_kill_in_the_middle_of_a_save_leaves_the_old_file(tmp_path, saved):
    """Saves over and over, killed at random moments: what is there loads, always."""
    path = tmp_path / "m.zip"
    code = f"""
import torch, sys
torch.set_num_threads(1)
from sb3_dreamer_urlb import DreamerV2
model = DreamerV2.load({str(saved[1])!r}, device="cpu")
while True:
    model.num_timesteps += 1
    model.save({str(path)!r})
    print("saved", flush=True)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    generator = np.random.default_rng(0)
    last = 24
    for _ in range(4):
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment)
        process.stdout.readline()
        time.sleep(generator.uniform(0.0, 0.1))
        process.send_signal(signal.SIGKILL)
        process.communicate()
        loaded = load(path)
        assert loaded.num_timesteps > last
        assert loaded.policy.state_dict().keys() == saved[0].policy.state_dict().keys()


def test_a_link_stays_one_and_its_file_is_written(tmp_path):
    (tmp_path / "there").mkdir()
    for number, target in enumerate((tmp_path / "there" / "model.zip", tmp_path / "missing.zip")):
        link = tmp_path / f"link_{number}.zip"
        link.symlink_to(target)
        for content in (b"one", b"two"):
            with written_atomically(link) as file:
                file.write(content)
            assert link.is_symlink() and target.read_bytes() == content
    assert sorted(path.name for path in tmp_path.rglob("*.zip")) == ["link_0.zip", "link_1.zip", "missing.zip", "model.zip"]


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="no file that could be replaced"), written_atomically(tmp_path / "pipe"):
        raise AssertionError("written")
    assert (tmp_path / "pipe").is_fifo() and [path.name for path in tmp_path.iterdir()] == ["pipe"]


@pytest.mark.parametrize("folder", [".", "..", "here/.."])
def test_the_current_folder_is_no_file(tiny_model, folder):
    model = tiny_model()
    for save in (model.save, model.save_replay_buffer):
        with pytest.raises(IsADirectoryError, match=f"{re.escape(repr(folder))} is a folder"):
            save(folder)


def test_an_error_in_the_middle_of_a_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), written_atomically(path) as file:
        file.write(b"new")
        1 / 0  # noqa: B018
    assert path.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 1
    with written_atomically(path) as file:
        file.write(b"new")
    assert path.read_bytes() == b"new"


def test_a_full_device(saved, tmp_path):
    """/dev/full, and a folder in the way."""
    with open("/dev/full", "wb", buffering=0) as full, pytest.raises(OSError, match="No space"):
        saved[0].save(full)
    (tmp_path / "m.zip").mkdir()
    with pytest.raises(OSError, match=r"intact.*m\.zip"):
        saved[0].save(tmp_path / "m.zip")


@pytest.mark.parametrize("method", ["icm", None])
def test_a_model_keeps_the_method_it_learnt_with(saved, method):
    with pytest.raises(ValueError, match="intrinsic_reward must be 'lbs', with which the model was trained") as caught:
        load(saved[1], intrinsic_reward=method)
    assert not isinstance(caught.value, SnapshotError)
    assert same(load(saved[1], intrinsic_reward="lbs"), saved[0])
