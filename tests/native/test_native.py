"""Kernels of our own are torch's within roundings, and whoever cannot have them runs with torch's."""

from __future__ import annotations

import configparser
import fnmatch
import threading
import warnings

import pytest
import torch as th
import torch.nn.functional as F
from operator_calls import ROUNDING, Calls
from places import ROOT
from tape import Tape
from told import told_meanwhile
from whole_runs import crash, everything, scramble, vec_env

from sb3_dreamer_urlb import RunCheckpointCallback, native
from sb3_dreamer_urlb.native import build, ops
from sb3_dreamer_urlb.nn import activation

SPECIAL = [0.0, -0.0, float("inf"), -float("inf"), float("nan"), 1e-30, -1e-30, -100.0, 100.0]
SHAPES = [(7,), (1, 1), (7, 3), (5, 6), (40, 48), (0, 5), (3, 4, 200), (33, 1030), (2, 4001), (300, 257)]
IMAGES = [(5, 6, 7, 3), (2, 48, 9, 9), (3, 16, 1, 1), (2, 1, 5, 5)]


@pytest.fixture
def always(monkeypatch):
    """Use kernels for tiny tensors, too."""
    monkeypatch.setattr(activation, "SMALLEST_NATIVE", 0)
    monkeypatch.setattr(activation, "SMALLEST_NATIVE_LEARNING", 0)
    monkeypatch.setattr(activation, "SMALLEST_NATIVE_GRADIENT", {th.float32: 0, th.bfloat16: 0})


@pytest.fixture
def nowhere(monkeypatch):
    """A machine without a compiler."""
    monkeypatch.setattr(native, "_why_not_loaded", lambda: "no C++ compiler")
    monkeypatch.setattr(native, "_warned", set())


def _numbers(shape, dtype, seed=0):
    x = 3 * th.randn(shape, generator=th.Generator().manual_seed(seed))
    special = th.tensor(SPECIAL)[: x.numel()]
    x.view(-1)[: len(special)] = special
    x = x.to(dtype)
    return x.contiguous(memory_format=th.channels_last) if len(shape) == 4 else x


def _close(ours, exact, dtype, scale=1.0):
    """Infinite, or not a number, at the same places; and within a rounding."""
    ours = ours.double()
    finite = exact.isfinite()
    assert th.equal(ours[~finite].nan_to_num(), exact[~finite].nan_to_num()) and th.equal(ours.isnan(), exact.isnan())
    assert ((ours - exact)[finite].abs() <= ROUNDING[dtype] * exact[finite].abs().clamp(min=scale)).all()


# -- kernels ---------------------------------------------------------------------------------------------------------------


def test_elu_of_every_bfloat16_number(kernels):
    """Relative to the result down to 1e-4."""
    x = th.arange(2**16, dtype=th.int32).to(th.int16).view(th.bfloat16)
    exact = F.elu(x.double())
    ours = x.clone()
    ops.bias_elu_(ours, None)
    finite = exact.isfinite()
    assert ((ours.double() - exact).abs() <= (2.0**-8 + 5e-4) * exact.abs() + 2e-7)[finite].all()
    assert th.equal(ours[x.isnan()].isnan(), x[x.isnan()].isnan()) and th.equal(ours[x.isinf()].double(), exact[x.isinf()])


@pytest.mark.parametrize("with_bias", [False, True])
@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("shape", SHAPES + IMAGES, ids=str)
def test_elu_behind_a_bias(kernels, threads, shape, dtype, with_bias):
    x = _numbers(shape, dtype)
    columns = 1 if len(shape) == 4 else -1
    bias = th.randn(shape[columns], generator=th.Generator().manual_seed(1)).to(dtype) if with_bias else None
    by_column = bias.double().view(-1, 1, 1) if with_bias and len(shape) == 4 else bias.double() if with_bias else 0
    exact = F.elu(x.double() + by_column)
    before = x.clone()
    assert ops.bias_elu_(x, bias) is None
    _close(x, exact, dtype)
    assert th.equal(x.isnan(), before.isnan()) and x.stride() == before.stride()


@pytest.mark.parametrize("dtype", ROUNDING)
def test_every_number_that_is_none_stays_so(kernels, dtype):
    """Whatever its lowest bits are."""
    bits = th.tensor([0x7F800001, 0x7FC00001, 0x7FC001FF, -1, -0x3FFFFF]) if dtype == th.float32 else th.tensor([0x7FC1, -1])
    x = bits.to({th.float32: th.int32, th.bfloat16: th.int16}[dtype]).view(dtype).repeat(9)
    ops.bias_elu_(x, None)
    assert x.isnan().all()
    assert ops.elu_backward(th.ones_like(x), x, False)[0].isnan().all()


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("shape", SHAPES + IMAGES, ids=str)
def test_gradient_of_elu_and_of_its_bias(kernels, threads, shape, dtype):
    y = F.elu(_numbers(shape, dtype)).nan_to_num(posinf=1.0)
    grad = _numbers(shape, dtype, 2).nan_to_num(posinf=1.0, neginf=-1.0)
    exact = grad.double() * (y.double().clamp(max=0) + 1)
    alone, none = ops.elu_backward(grad, y, False)
    out, sums = ops.elu_backward(grad, y, True)
    _close(out, exact, dtype, 1e-30)
    assert th.equal(alone, out) and none.shape == (0,) and out.stride() == y.stride() and out.dtype == dtype
    rows = [i for i in range(len(shape)) if i != (1 if len(shape) == 4 else len(shape) - 1)]
    expected, size = (exact.sum(rows), exact.abs().sum(rows)) if rows else (exact, exact.abs())
    # Summed before they are rounded to the short format.
    assert sums.dtype == th.float32 and ((sums - expected).abs() <= 1e-6 * size + 1e-12).all()


@pytest.mark.parametrize("dtype", ROUNDING)
def test_gradients_that_are_no_numbers(kernels, dtype):
    y, grad = F.elu(_numbers((3, 9), dtype)), _numbers((3, 9), dtype, 2).flip(0)
    exact = grad.double() * (y.double().clamp(max=0) + 1)
    out, sums = ops.elu_backward(grad, y, True)
    _close(out, exact, dtype, 1e-30)
    assert th.equal(sums.isnan(), exact.sum(0).isnan()) and sums.isnan().any() and sums.isfinite().any()


def test_gradients_that_lie_otherwise_in_memory(kernels):
    y, grad = th.rand(4, 3, 5, 5).contiguous(memory_format=th.channels_last) - 0.5, th.randn(4, 3, 5, 5)
    expected = ops.elu_backward(grad.contiguous(memory_format=th.channels_last), y, True)
    for other in (grad, grad.transpose(2, 3).contiguous().transpose(2, 3)):
        assert all(map(th.equal, ops.elu_backward(other, y, True), expected))
    assert th.equal(ops.elu_backward(th.ones(()).expand(2, 3), th.ones(2, 3), True)[1], th.full((3,), 2.0))


@pytest.mark.parametrize(
    "call, error, words",
    [
        (lambda: ops.bias_elu_(th.ones(3, dtype=th.float64), None), TypeError, "float32 and bfloat16, got torch.float64"),
        (lambda: ops.bias_elu_(th.ones(4, 4)[:, ::2], None), ValueError, "one after the other, got .* strides"),
        (lambda: ops.bias_elu_(th.ones(4, 4), th.ones(3)), ValueError, r"a bias for .* \(4, 4\) .* cannot be .* \(3,\)"),
        (lambda: ops.bias_elu_(th.ones(4, 4), th.ones(4, dtype=th.bfloat16)), ValueError, "a bias for .* cannot be torch.bfl"),
        (lambda: ops.bias_elu_(th.ones(4, 4), th.ones(8)[::2]), ValueError, "a bias for .* cannot be"),
        (lambda: ops.bias_elu_(th.ones(2, 3, 4, 5), th.ones(3)), ValueError, "a bias for .* channels last"),
        (
            lambda: ops.elu_backward(th.ones(3), th.ones(4), False),
            ValueError,
            r"a gradient of .* \(4,\) .* cannot be .* \(3,\)",
        ),
        (lambda: ops.elu_backward(th.ones(2, 3, 4, 5), th.ones(2, 3, 4, 5), True), ValueError, "no sums of .* channels last"),
    ],
)
def test_what_kernels_do_not_take(kernels, call, error, words):
    with pytest.raises(error, match=words):
        call()


def test_recorders_see_the_operators(kernels):
    x = th.randn(100)
    before = x.clone()
    with Tape() as tape:
        ops.bias_elu_(x, None)
    tape.undo()
    assert th.equal(x, before)
    tape.replay()
    assert th.allclose(x, F.elu(before), atol=1e-6) and len(tape.calls) == 1


# -- ELU of the networks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("shape", [(20, 1000), (6, 8, 20, 21)], ids=str)
def test_activation_uses_them(kernels, always, shape, dtype):
    x = _numbers(shape, dtype, 3).nan_to_num()
    slope = th.randn(x.shape, generator=th.Generator().manual_seed(4)).to(dtype)
    results = []
    for compile in ("eager", "native"):
        for grad in (th.empty_like(x).copy_(slope), slope.contiguous()):
            leaf = x.clone().requires_grad_()
            with native.using(compile, "cpu"), Calls() as calls:
                with th.no_grad():
                    plain = activation.elu_(x.clone())
                y = activation.elu_(leaf * 1)
                (found,) = th.autograd.grad(y, leaf, grad)
            assert th.equal(y, plain)
            ours = {name: count for name, count in calls.counts.items() if name.startswith("sb3_dreamer_urlb")}
            # A gradient that lies otherwise in memory is torch's.
            fits = grad.stride() == y.stride()
            names = {"sb3_dreamer_urlb.bias_elu_.default": 2, "sb3_dreamer_urlb.elu_backward.default": 1}
            assert ours == ({} if compile == "eager" else names if fits else {"sb3_dreamer_urlb.bias_elu_.default": 2})
            results.append((y, found))
    for theirs, ours in zip(results[:2], results[2:], strict=True):
        _close(ours[0], theirs[0].double(), dtype)
        assert th.allclose(ours[1], theirs[1], rtol=2 * ROUNDING[dtype], atol=3 * ROUNDING[dtype] * slope.abs().max().item())


def test_small_ones_stay_with_torch(kernels):
    with native.using("native", "cpu"), Calls() as calls:
        activation.elu_(th.randn(activation.SMALLEST_NATIVE - 1))
        activation.elu_(th.randn(activation.SMALLEST_NATIVE_LEARNING - 1, requires_grad=True) * 1)
        activation.elu_(th.randn(activation.SMALLEST_NATIVE, dtype=th.float64))
    assert not any(name.startswith("sb3_dreamer_urlb") for name in calls.counts)


# -- using -----------------------------------------------------------------------------------------------------------------


def test_using_is_for_one_thread_and_for_its_block(kernels):
    assert not native.active()
    with native.using("auto", "cpu"):
        assert native.active()
        elsewhere = []
        thread = threading.Thread(target=lambda: elsewhere.append(native.active()))
        thread.start()
        thread.join()
        assert elsewhere == [False]
        for compile in ("eager", "cuda_graphs"):
            with native.using(compile, "cpu"):
                assert not native.active()
            assert native.active()
        with native.using("auto", th.device("cuda:0")):
            assert not native.active()
        with pytest.raises(ZeroDivisionError), native.using("eager", "cpu"):
            raise ZeroDivisionError
        assert native.active()
    assert not native.active()


def test_one_warning_says_why_not(nowhere):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with native.using("auto", "cpu"):
            assert not native.active()
    with pytest.warns(UserWarning, match="torch's kernels, slower: no C\\+\\+ compiler"), native.using("native", "cpu"):
        assert not native.active()
    with pytest.warns(UserWarning, match="they are for the CPU, .* on 'cuda'"), native.using("native", "cuda"):
        assert not native.active()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with native.using("native", "cpu"):
            assert not native.active()


def test_a_model_without_a_compiler_learns_as_ever(nowhere, tiny_model, capsys):
    """And tells those who want to know."""
    runs = []
    for compile in ("eager", "auto", "native"):
        scramble()
        with told_meanwhile() as said:
            model = tiny_model(vec_env(), compile=compile, verbose=1).learn(24)
        ours = [text for text in said if "kernels" in text]
        assert len(ours) == (compile == "native")
        runs.append(everything(model)["weights"])
        reason = "(compile='eager')" if compile == "eager" else "(no C++ compiler)"
        assert f"Kernels: torch's {reason}\n" in capsys.readouterr().out
    assert runs[0] == runs[1] == runs[2]


def test_operators_need_the_library(monkeypatch):
    monkeypatch.setattr(ops, "_functions", {})
    with pytest.raises(RuntimeError, match=r"bias_elu_float is not loaded; call it inside native.using\(\)"):
        ops.bias_elu_(th.ones(3), None)


# -- learning and acting ---------------------------------------------------------------------------------------------------


def test_updates_agree_with_torchs(kernels, always, learner, batch):
    results = {}
    for compile in ("eager", "native"):
        th.manual_seed(0)
        its = learner("lbs", compile=compile)
        with Calls() as calls:
            metrics = [{name: float(value) for name, value in its.update(batch).items()} for _ in range(2)]
        assert not native.active()
        results[compile] = metrics, {name: count for name, count in calls.counts.items() if "sb3_dreamer_urlb" in name}
    assert results["eager"][1] == {}
    assert results["native"][1]["sb3_dreamer_urlb.bias_elu_.default"] > 20
    assert results["native"][1]["sb3_dreamer_urlb.elu_backward.default"] > 20
    for found, expected in zip(results["native"][0], results["eager"][0], strict=True):
        assert found == pytest.approx(expected, rel=1e-3, abs=1e-5)


@pytest.mark.parametrize("planner", [None, "dyna_mpc"])
def test_actions_come_from_them(kernels, always, tiny_model, planner):
    found = {}
    for compile in ("eager", "native", "auto"):
        model = tiny_model(vec_env(), compile=compile, planner=planner)
        observation = model.get_env().reset()
        with Calls() as calls:
            found[compile] = model.predict(observation, deterministic=True)[0]
        assert (calls.counts["sb3_dreamer_urlb.bias_elu_.default"] > 0) == (compile != "eager")
    assert abs(found["native"] - found["eager"]).max() < 1e-3 and (found["auto"] == found["native"]).all()


def test_a_run_goes_on_bit_for_bit(kernels, always, tiny_model, tmp_path, capsys):
    def run(folder, until=None):
        scramble()
        model = tiny_model(vec_env(), compile="native", verbose=1)
        keep = RunCheckpointCallback(tmp_path / folder, 20, resume="auto")
        return model.learn(80, callback=keep) if until is None else crash(model, until, 80, [keep])

    expected = everything(run("whole"))
    assert "Kernels: native where they are faster" in capsys.readouterr().out
    run("cut", 41)
    found = everything(run("cut"))
    assert {name for name in expected if found[name] != expected[name]} == set()


# -- packaging -------------------------------------------------------------------------------------------------------------


def test_wheels_hold_the_sources():
    """Without them every installed copy would run with torch's kernels, and say nothing."""
    setup = configparser.ConfigParser()
    setup.read(ROOT / "setup.cfg")
    patterns = setup["options.package_data"]["sb3_dreamer_urlb"].split()
    sources = [path for path in build.FOLDER.iterdir() if path.suffix in (".cpp", ".h")]
    assert len(sources) >= 2
    for path in sources:
        assert any(fnmatch.fnmatch(f"native/{path.name}", pattern) for pattern in patterns), path
