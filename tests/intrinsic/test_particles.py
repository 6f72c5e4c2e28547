"""knn_distances against the direct form: all differences, their norms, topk."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from places import ROOT
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from sb3_dreamer_urlb.intrinsic import particles as module
from sb3_dreamer_urlb.intrinsic.particles import knn_distances

BENCHMARK = ROOT / "benchmarks" / "particles.py"
GROUPED = 2100  # enough particles for the search by groups, which needs 4 × 32 × (k + 4), and no multiple of 32
EXACT = {"rtol": 1e-6, "atol": 0.0}  # another processor may sum in another order
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not th.cuda.is_available(), reason="no GPU"))]


def _direct(particles, k):
    """A row at a time, so that it fits at any size."""
    return th.stack([(row - particles).norm(dim=-1).topk(k, largest=False).values for row in particles])


def _gradient(distances, particles, weights):
    (gradient,) = th.autograd.grad((distances * weights).sum(), particles)
    return gradient


def _clouds():
    """Particles that are easy and hard to search by a matrix product: (GROUPED, 20) each."""
    noise, centres = th.randn(GROUPED, 20), th.randn(21, 1, 20).expand(-1, GROUPED // 21, -1).reshape(GROUPED, 20)
    return {
        "normal": noise,
        "few dimensions": noise[:, :2].contiguous(),
        "far from the origin": 1000 + noise,
        "tight clusters": centres + 1e-4 * noise,
        "all but one in a cluster": th.cat([100 * th.ones(1, 20), 1e-4 * noise[1:]]),
        "duplicates": centres.contiguous(),
        "all the same": th.ones(GROUPED, 20),
        "huge": 1e15 * noise,
        "small": 1e-15 * noise,
    }


@given(st.data())
def test_distances_and_gradients_equal_the_direct_form(data):
    n = data.draw(st.integers(1, 40), "n")
    d = data.draw(st.integers(1, 6), "d")
    k = data.draw(st.integers(1, n), "k")
    chunk_size = data.draw(st.none() | st.integers(1, n + 1), "chunk_size")
    distinct = data.draw(st.integers(1, n), "distinct particles")
    th.manual_seed(data.draw(st.integers(0, 1000), "seed"))
    which = th.randint(distinct, (n,))
    particles = th.randn(distinct, d)[which].requires_grad_()
    weights = th.randn(n, k)

    ours, direct = knn_distances(particles, k, chunk_size), _direct(particles, k)

    th.testing.assert_close(ours, direct, **EXACT)
    # which of several duplicates is the neighbour is open, so what matters is the gradient of all of them together
    total = lambda x: th.zeros(distinct, d).index_add_(0, which, _gradient(x, particles, weights))  # noqa: E731
    th.testing.assert_close(total(ours), total(direct), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("matmul", ["highest", "medium"])  # medium: bfloat16 products where the processor has them
@pytest.mark.parametrize("name", ["normal", *sorted(set(_clouds()) - {"normal"})])
def test_large_and_ill_conditioned_clouds_equal_the_direct_form(seeded, device, matmul, name):
    particles = _clouds()[name].to(device)
    before = th.get_float32_matmul_precision()
    th.set_float32_matmul_precision(matmul)
    try:
        ours = knn_distances(particles, 12)
    finally:
        th.set_float32_matmul_precision(before)
    th.testing.assert_close(ours, _direct(particles, 12), **EXACT)


@pytest.mark.parametrize(
    ("name", "precisions"),
    [
        ("normal", [th.float32]),
        ("few dimensions", [th.float32]),
        ("far from the origin", [th.float32]),
        ("tight clusters", [th.float32, th.float64]),
    ],
)
def test_only_particles_that_need_it_are_searched_twice(seeded, monkeypatch, name, precisions):
    searches = []

    class Search(module._Search):
        def __init__(self, particles, count, precision):
            super().__init__(particles, count, precision)
            searches.append(precision)

    monkeypatch.setattr(module, "_Search", Search)
    knn_distances(_clouds()[name], 12)
    assert searches == precisions


@pytest.mark.parametrize("device", DEVICES)
def test_gradients_of_many_particles_equal_the_direct_form(seeded, device):
    particles = th.randn(GROUPED, 20, device=device, requires_grad=True)
    weights = th.randn(GROUPED, 12, device=device)
    ours = _gradient(knn_distances(particles, 12), particles, weights)
    th.testing.assert_close(ours, _gradient(_direct(particles, 12), particles, weights))


def test_newer_precision_settings_are_no_obstacle(seeded):
    particles = th.randn(GROUPED, 20)
    program = (
        "import torch as th; from sb3_dreamer_urlb.intrinsic.particles import knn_distances;"
        "th.backends.cuda.matmul.fp32_precision = 'tf32'; th.manual_seed(0);"
        "print(knn_distances(th.randn(2100, 20), 12).double().sum().item())"
    )
    printed = subprocess.run([sys.executable, "-c", program], check=True, stdout=subprocess.PIPE, text=True).stdout
    assert float(printed) == pytest.approx(knn_distances(particles, 12).double().sum().item(), rel=1e-9)


@pytest.mark.parametrize("chunk_size", [1, 7, 2099, 2100, 10_000])
def test_the_chunk_size_changes_nothing(seeded, chunk_size):
    particles = th.randn(GROUPED, 4, requires_grad=True)
    one, other = knn_distances(particles, 12), knn_distances(particles, 12, chunk_size)
    assert th.equal(one, other)
    weights = th.randn_like(one)
    th.testing.assert_close(_gradient(one, particles, weights), _gradient(other, particles, weights))


def test_gradcheck(seeded):
    particles = th.randn(9, 3, dtype=th.float64, requires_grad=True)
    # column 0, the zero, has no derivative
    assert th.autograd.gradcheck(lambda x: knn_distances(x, 4, chunk_size=2)[:, 1:], particles)


def test_a_distance_of_zero_has_a_gradient_of_zero(seeded):
    particles = th.randn(3, 5).repeat(4, 1).requires_grad_()
    distances = knn_distances(particles, 4)
    assert th.equal(distances, th.zeros(12, 4))
    assert th.equal(_gradient(distances, particles, th.ones(12, 4)), th.zeros(12, 5))


@pytest.mark.parametrize("name", ["normal", "duplicates", "all the same", "tight clusters"])
def test_a_particle_is_its_own_nearest(seeded, name):
    particles = _clouds()[name]
    _, neighbours = module._neighbours(particles, 3, chunk_size=100)
    assert th.equal(neighbours[:, 0], th.arange(GROUPED))
    assert all(len(set(row)) == 3 for row in neighbours.tolist())


def test_nothing_to_learn_from_under_no_grad(seeded):
    particles = th.randn(10, 3, requires_grad=True)
    with th.no_grad():
        assert not knn_distances(particles, 3).requires_grad
    assert not knn_distances(particles.detach(), 3).requires_grad
    assert knn_distances(particles, 3).requires_grad


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_particles_that_are_not_finite_show_and_do_not_crash(seeded, bad):
    particles = th.randn(2050, 3)  # 30 columns of padding, which nothing keeps from being chosen
    particles[5, 1] = bad
    assert not knn_distances(particles, 12)[5].isfinite().all()


@pytest.mark.parametrize("k", [-1, 0, 6])
def test_k_out_of_range(k):
    with pytest.raises(ValueError, match=f"k is {k} and there are 5 particles" if k > 0 else f"at least 1, got {k}"):
        knn_distances(th.zeros(5, 2), k)


def test_other_bad_arguments():
    with pytest.raises(ValueError, match=r"not of shape \(2, 5, 3\)"):
        knn_distances(th.zeros(2, 5, 3), 2)
    with pytest.raises(ValueError, match="at least 1, not 0"):
        knn_distances(th.zeros(5, 3), 2, chunk_size=0)


class _Largest(TorchDispatchMode):
    """Remembers the largest tensor that any operation returns."""

    def __init__(self):
        super().__init__()
        self.numbers, self.operations = 0, set()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        # a view of few numbers, expanded, takes no memory: what counts is the storage
        sizes = [x.untyped_storage().nbytes() // x.element_size() for x in tree_leaves(result) if isinstance(x, th.Tensor)]
        self.numbers = max([self.numbers, *sizes])
        self.operations.add(func.overloadpacket.__name__)
        return result


@pytest.mark.parametrize("name", ["normal", "tight clusters"])
def test_the_whole_matrix_is_never_built(seeded, name):
    n, chunk_size = 6000, 64
    particles = _clouds()[name].repeat(3, 1)[:n] + 1e-5 * th.randn(n, 20)
    particles.requires_grad_()
    with _Largest() as largest:
        knn_distances(particles, 12, chunk_size).sum().backward()
    assert {"mm", "index_add_"} <= largest.operations  # forward and backward were seen
    assert chunk_size * n <= largest.numbers < 1.01 * chunk_size * n


def test_the_default_chunk_bounds_the_memory_too(seeded):
    particles = th.randn(6000, 20, requires_grad=True)
    with _Largest() as largest:
        knn_distances(particles, 12).sum().backward()
    assert largest.numbers < 1.01 * module._CHUNK_NUMBERS["cpu"] < 6000 * 6000 / 4


@pytest.mark.slow
def test_memory_at_paper_size():
    command = [sys.executable, BENCHMARK, "--only", "ours", "--sizes", "40000", "--repeat", "1", "--json"]
    printed = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout
    assert json.loads(printed)["bytes"] < 500e6
