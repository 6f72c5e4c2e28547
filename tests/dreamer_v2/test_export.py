"""The exported acting step does what ``predict(deterministic=True)`` does, with TorchScript and with ONNX."""

from __future__ import annotations

import importlib.util

import numpy as np
import onnxruntime
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.dreamer_v2 import export
from sb3_dreamer_urlb.dreamer_v2.export import OUTPUTS, ActingStep, to_onnx, to_torchscript

KINDS = {
    "images": ("CnnPolicy", {}),
    "vectors": ("MlpPolicy", {"observation_space": spaces.Box(-1, 1, (3,)), "action_space": spaces.Discrete(4, start=2)}),
    "both": (
        "MultiInputPolicy",
        {
            "observation_space": spaces.Dict(
                image=spaces.Box(0, 255, (16, 20, 3), np.uint8), which=spaces.Discrete(3, start=2), flags=spaces.MultiBinary(2)
            ),
            "action_space": spaces.Box(-2, 3, (2, 2)),
        },
    ),
    "bytes": ("MlpPolicy", {"observation_space": spaces.Box(-1, 1), "action_space": spaces.Box(3, 200, (2,), np.uint8)}),
    "choices": (
        "MlpPolicy",
        {"observation_space": spaces.MultiDiscrete([2, 3]), "action_space": spaces.MultiDiscrete([2, 3, 2], start=[0, 4, 1])},
    ),
}
#: where the third environment's episodes begin, while the first two go on
BEGINS = (0, 7, 8)


@pytest.fixture
def make(tiny_model):
    """A model whose actor and posterior tell states apart, as a fresh one's hardly do."""

    def model(kind, **kwargs):
        policy, env = KINDS[kind]
        made = tiny_model(CounterEnv(**env), policy, **kwargs)
        for net in (made.policy.agent.actor, made.policy.agent.world_model.rssm.post_logits):
            for parameter in net.parameters():
                parameter.data.mul_(4)
        return made

    return model


def assert_acts_alike(model, step, exported, n, length=15):
    """Through an episode and the beginning of others.

    :param exported: from inputs as tensors to outputs as arrays
    """
    space = model.policy.observation_space
    space.seed(0)
    state, memory = None, [part.numpy() for part in step.initial(n)]
    counts, seen_actions = np.zeros(n, np.int64), set()
    for t in range(length):
        starts = np.array([t == 0 or (i == 2 and t in BEGINS) for i in range(n)])
        counts[starts] = 0
        drawn = [space.sample() for _ in range(n)]
        if step.keys is None:
            observation = np.stack(drawn)
            seen = [observation]
        else:
            observation = {key: np.stack([one[key] for one in drawn]) for key in step.keys}
            seen = list(observation.values())
        expected, state = model.predict(observation, state, starts, deterministic=True)
        action, *memory = exported([*seen, *memory, starts, step.uniforms(counts).numpy()])
        assert action.dtype == expected.dtype and action.shape == expected.shape
        if np.issubdtype(expected.dtype, np.integer):
            assert np.array_equal(action, expected)
        else:
            assert np.allclose(action, expected, atol=1e-5)
        for mine, theirs in zip(memory, state, strict=False):
            assert mine.dtype == theirs.dtype and np.allclose(mine, theirs, atol=1e-5)
        counts += 1
        seen_actions.add(expected.tobytes())
    assert len(seen_actions) > 1


def torchscript(path):
    exported = th.jit.load(path)
    return lambda inputs: [part.numpy() for part in exported(*map(th.as_tensor, inputs))]


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("kind", KINDS)
def test_torchscript_acts_as_predict(make, tmp_path, kind, n):
    model = make(kind)
    step = ActingStep(model.policy)
    to_torchscript(step, tmp_path / "step.pt")
    assert_acts_alike(model, step, torchscript(tmp_path / "step.pt"), n)


@pytest.mark.parametrize("kind", ["images", "vectors", "both"])
def test_onnx_acts_as_predict(make, tmp_path, capfd, kind):
    model = make(kind)
    step = ActingStep(model.policy)
    to_onnx(step, tmp_path / "step.onnx")
    assert "torchvision" not in "".join(capfd.readouterr())  # which the exporter misses and nobody needs
    assert [file.name for file in tmp_path.iterdir()] == ["step.onnx"]
    session = onnxruntime.InferenceSession(tmp_path / "step.onnx")
    assert tuple(part.name for part in session.get_inputs()) == step.input_names
    assert tuple(part.name for part in session.get_outputs()) == OUTPUTS
    for n in (1, 3):
        assert_acts_alike(model, step, lambda inputs: session.run(None, dict(zip(step.input_names, inputs, strict=True))), n)


def test_layers_that_are_fast_here_are_not_written_down(tiny_model, tmp_path):
    """Wide layers take ways of our own on this machine: a file must hold plain operators, for any number of environments."""
    model = tiny_model(CounterEnv(size=64), policy_kwargs={"cnn_depth": 40})
    step = ActingStep(model.policy)
    to_torchscript(step, tmp_path / "step.pt")
    for n in (1, 3):
        assert_acts_alike(model, step, torchscript(tmp_path / "step.pt"), n, length=4)


def test_a_fixed_skill_is_followed(make, tmp_path):
    model = make("images", intrinsic_reward="diayn")
    with pytest.raises(ValueError, match="skill"):
        ActingStep(model.policy)
    model.fix_skill(1)
    step = ActingStep(model.policy)
    to_torchscript(step, tmp_path / "step.pt")
    assert_acts_alike(model, step, torchscript(tmp_path / "step.pt"), 3)


def test_a_step_is_a_copy(make):
    model = make("images")
    step = ActingStep(model.policy)
    example = step.example(1)
    before = [part.clone() for part in step(*example)]
    for parameter in model.policy.parameters():
        parameter.data.add_(1)
    assert all(map(th.equal, before, step(*example)))
    assert not any(parameter.requires_grad for parameter in step.parameters())


@pytest.mark.parametrize("arguments", [{"planner": "dyna_mpc"}, {"intrinsic_reward": "random"}])
def test_what_does_not_act_with_its_actor_is_refused(tiny_model, arguments):
    with pytest.raises(ValueError, match="planner=None" if "planner" in arguments else "random actions"):
        ActingStep(tiny_model(**arguments).policy)


def test_a_missing_package_is_named(make, tmp_path, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(export.importlib.util, "find_spec", lambda name: None if name == "onnxscript" else find(name))
    with pytest.raises(ImportError, match=r"onnxscript.*\[export\]"):
        to_onnx(ActingStep(make("images").policy), tmp_path / "step.onnx")
    assert not list(tmp_path.iterdir())


def test_a_loaded_model_is_exported_alike(make, tmp_path):
    model = make("vectors")
    model.save(tmp_path / "model")
    step = ActingStep(DreamerV2.load(tmp_path / "model", device="cpu").policy)
    example = step.example(3)
    assert all(map(th.equal, ActingStep(model.policy)(*example), step(*example)))
