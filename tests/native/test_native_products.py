"""Products on a processor's tiles are float64's within the roundings of their format, however the operands lie in memory."""

from __future__ import annotations

import ctypes
import itertools
import math
import subprocess

import pytest
import torch as th
import torch.nn.functional as F
from hypothesis import example, given
from hypothesis import strategies as st
from tiny import threads_of

from sb3_dreamer_urlb.native import build, product_ops

FORMATS = [th.float32, th.bfloat16]
#: what float32 sums of float32 products may be off, relative to the sum of magnitudes
SUMS = 2.0**-22
#: of one number
ROUNDING = {th.float32: 2.0**-23, th.bfloat16: 2.0**-8}
#: of ELU before its result is rounded, as a share of it
ELU = {th.float32: 0, th.bfloat16: 5e-4}


@pytest.fixture(scope="module", autouse=True)
def tiles(kernels):
    """One reason for all."""
    if not product_ops.available():
        pytest.skip("this processor has no tiles (AMX)")


def _numbers(*shape, dtype=th.float32, seed=0):
    return th.randn(shape, generator=th.Generator().manual_seed(seed)).to(dtype)


def _view(rows, columns, dtype, seed, stride, offset=0):
    """Rows that lie in wider ones, between numbers that would show: columns + offset ≤ stride."""
    wide = th.full((rows, stride), math.nan, dtype=dtype)
    inside = wide[:, offset : offset + columns]
    inside.copy_(_numbers(rows, columns, dtype=dtype, seed=seed))
    return inside


def _near(found, exact, magnitude, elu=False):
    """Within the rounding of float32 sums, that of the format, and ELU's (of 1, and where the format is short, its own)."""
    assert found.shape == exact.shape
    error = (found.double() - exact).abs()
    allowed = SUMS * magnitude + ROUNDING[found.dtype] * exact.abs()
    assert (error <= allowed + (ELU[found.dtype] * exact.abs() + 2e-7 if elu else 0)).all()


def _up(size):
    return -(-size // 32) * 32


#: how far it is from one row to the next, of so many numbers: as near as can be, further, and where lines of the cache begin
STRIDES = {"dense": lambda size: (size, 0), "odd": lambda size: (size + 7, 3), "lines": lambda size: (_up(size) + 32, 32)}
sizes = st.integers(1, 150)
formats = st.sampled_from(FORMATS)
strides = st.sampled_from(sorted(STRIDES))
counts = st.sampled_from([1, 2])


# -- rows · weights --------------------------------------------------------------------------------------------------------


@example(64, 32, 32, th.bfloat16, "lines", False, False, False, 1)
@example(700, 96, 150, th.bfloat16, "lines", True, True, True, 2)
@example(70, 40, 33, th.bfloat16, "lines", True, False, False, 1)  # columns behind a row that are not its own
@given(
    rows=st.integers(1, 700),
    inputs=sizes,
    outputs=sizes,
    dtype=formats,
    layout=strides,
    transposed=st.booleans(),
    with_bias=st.booleans(),
    elu=st.booleans(),
    threads=counts,
)
def test_rows_by_weights(rows, inputs, outputs, dtype, layout, transposed, with_bias, elu, threads):
    stride, offset = STRIDES[layout](inputs)
    x = _view(rows, inputs, dtype, 1, stride, offset)
    weight = _view(outputs, inputs, dtype, 2, inputs + 5, 2)
    given_weight = _view(inputs, outputs, dtype, 0, outputs + 5, 2).copy_(weight.T) if transposed else weight
    bias = _numbers(outputs, seed=3) if with_bias else None
    with threads_of(threads):
        laid = product_ops.lay_out_weights(given_weight, transposed)
        found = product_ops.rows_by_weights(x, laid, outputs, bias, elu)
    exact, magnitude = x.double() @ weight.double().T, x.double().abs() @ weight.double().abs().T
    if bias is not None:
        exact, magnitude = exact + bias.double(), magnitude + bias.double().abs()
    assert found.dtype == dtype and found.is_contiguous()
    _near(found, F.elu(exact) if elu else exact, magnitude, elu)


@pytest.mark.parametrize("depth", [32, 150, 1000])
def test_three_parts_are_as_good_as_float32(depth):
    """Numbers of all magnitudes; torch's own float32 product is the measure."""
    x, weight = (_numbers(300, depth, seed=seed) * th.exp(3 * _numbers(300, depth, seed=seed + 2)) for seed in (0, 1))
    exact, magnitude = x.double() @ weight.double().T, x.double().abs() @ weight.double().abs().T
    ours = product_ops.rows_by_weights(x, product_ops.lay_out_weights(weight, False), 300, None, False)
    gradient = product_ops.transposed_product(x.T.contiguous(), weight.T.contiguous())
    theirs = x @ weight.T
    errors = [((found.double() - exact).abs() / magnitude) for found in (theirs, ours, gradient)]
    for its in errors[1:]:
        assert its.max() <= 2 * errors[0].max() + 2.0**-24 and its.mean() <= 2 * errors[0].mean() + 2.0**-26
    # Of bfloat16's size they are not.
    assert errors[1].max() < 2.0**-20


def test_sums_do_not_depend_onthreads_of():
    x, weight = _numbers(400, 70), _numbers(50, 70, seed=1)
    found = []
    for count in (1, 2):
        with threads_of(count):
            laid = product_ops.lay_out_weights(weight, False)
            found.append(product_ops.rows_by_weights(x, laid, 50, None, False))
    assert th.equal(*found)


# -- the gradient of weights -----------------------------------------------------------------------------------------------


@example(700, 150, 40, th.float32, "odd", 2)
@example(1500, 33, 600, th.bfloat16, "dense", 2)  # more rows and columns than are laid out at a time
@example(700, 70, 1100, th.float32, "dense", 1)
@given(rows=st.integers(1, 700), m=sizes, n=sizes, dtype=formats, layout=strides, threads=counts)
def test_transposed_product(rows, m, n, dtype, layout, threads):
    left = _view(rows, m, dtype, 1, *STRIDES[layout](m))
    right = _view(rows, n, dtype, 2, *STRIDES[layout](n))
    with threads_of(threads):
        found = product_ops.transposed_product(left, right)
    assert found.dtype == th.float32
    _near(found, left.double().T @ right.double(), left.double().abs().T @ right.double().abs())


# -- layers one after the other --------------------------------------------------------------------------------------------


@example(700, [150, 100, 64, 1], th.bfloat16, "lines", True, False, 2)
@given(
    rows=st.integers(1, 300),
    widths=st.lists(sizes, min_size=2, max_size=4),
    dtype=formats,
    layout=strides,
    with_plus=st.booleans(),
    short=st.booleans(),
    threads=counts,
)
def test_chain(rows, widths, dtype, layout, with_plus, short, threads):
    """Each layer reads what the one before gave, rounded to the format."""
    x = _view(rows, widths[0], dtype, 1, *STRIDES[layout](widths[0]))
    weights = [(_numbers(n, m, seed=i) / m**0.5).to(dtype) for i, (m, n) in enumerate(itertools.pairwise(widths))]
    biases = [_numbers(n, seed=9 + i) for i, n in enumerate(widths[1:])]
    plus = _view(rows, widths[1], dtype, 4, *STRIDES[layout](widths[1])) if with_plus else None
    with threads_of(threads):
        laid = [product_ops.lay_out_weights(weight, False) for weight in weights]
        found = product_ops.chain(x, plus, laid, biases, short)
    exact = x.double()
    for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        exact = exact @ weight.double().T + bias.double() + (plus.double() if i == 0 and with_plus else 0)
        exact = F.elu(exact).to(dtype).double() if i + 1 < len(weights) else exact
    assert found.dtype == (dtype if short else th.float32) and found.shape == exact.shape
    # Where a layer's sum lies next to the middle of two numbers, ours may be rounded to the other one: a step of the format.
    layers = len(weights)
    assert ((found.double() - exact).abs() <= (layers + 1) * ROUNDING[dtype] * (1 + exact.abs()) * 4).all()
    if layers == 1 and not short:
        _near(found, exact, 4 * widths[0] ** 0.5 + exact.abs())


def test_a_chain_is_its_layers():
    x, widths = _numbers(100, 40, dtype=th.bfloat16), [40, 70, 32, 5]
    weights = [_numbers(n, m, dtype=th.bfloat16, seed=n) for m, n in itertools.pairwise(widths)]
    laid, biases = [product_ops.lay_out_weights(weight, False) for weight in weights], [_numbers(n) for n in widths[1:]]
    y = x
    for i, (its, bias) in enumerate(zip(laid, biases, strict=True)):
        y = product_ops.rows_by_weights(y, its, len(bias), bias, i < 2)
    assert th.equal(product_ops.chain(x, None, laid, biases, True), y)


# -- what is not a number --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("dtype", FORMATS)
@pytest.mark.parametrize("layout", STRIDES)
@pytest.mark.parametrize("inputs", [64, 70])
def test_what_is_not_a_number_stays_in_its_row(inputs, layout, dtype, bad):
    stride, offset = STRIDES[layout](inputs)
    x, clean = (_view(100, inputs, dtype, 1, stride, offset) for _ in range(2))
    x[40, 3], x[99, inputs - 1] = bad, bad
    others = th.ones(100, dtype=th.bool).index_fill_(0, th.tensor([40, 99]), False)
    weights = [_numbers(n, m, dtype=dtype, seed=n).abs() for m, n in ((inputs, 45), (45, 7))]
    laid, biases = [product_ops.lay_out_weights(weight, False) for weight in weights], [_numbers(45), _numbers(7)]
    for product in (
        lambda rows: product_ops.rows_by_weights(rows, laid[0], 45, biases[0], False),
        lambda rows: product_ops.chain(rows, None, laid, biases, False),
    ):
        found, expected = product(x), product(clean)
        assert expected.isfinite().all() and th.equal(found[others], expected[others])
        assert not found[~others].isfinite().any() or (bad == -math.inf and found.shape[1] == 7)
    # In the gradient of weights it stays in its column.
    found = product_ops.transposed_product(x, _numbers(100, 33, dtype=dtype))
    assert found[[3, inputs - 1]].isfinite().sum() == 0 and found[4 : inputs - 1].isfinite().all()


@pytest.mark.parametrize("dtype", FORMATS)
def test_chains_leave_nothing_behind(dtype):
    """A thread keeps the memory between layers: what is no number there meets the next chain's weights of 0."""
    found = []
    for width in (45, 64, 45):
        weights = [_numbers(n, m, dtype=dtype, seed=n) for m, n in ((40, width), (width, 7))]
        laid = [product_ops.lay_out_weights(weight, False) for weight in weights]
        x = _numbers(70, 40, dtype=dtype) if width == 45 else th.full((70, 40), math.nan, dtype=dtype)
        found.append(product_ops.chain(x, None, laid, [th.zeros(width), th.zeros(7)], False))
    assert found[0].isfinite().all() and found[1].isnan().all() and th.equal(found[0], found[2])


# -- nothing, and misuse ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", FORMATS)
def test_nothing_to_multiply(dtype):
    none, weight, bias = th.empty(0, 40, dtype=dtype), _numbers(50, 40, dtype=dtype), _numbers(50)
    laid = product_ops.lay_out_weights(weight, False)
    assert product_ops.rows_by_weights(none, laid, 50, bias, True).shape == (0, 50)
    assert product_ops.chain(none, None, [laid], [bias], True).shape == (0, 50)
    found = product_ops.transposed_product(none, th.empty(0, 50, dtype=dtype))
    assert found.shape == (40, 50) and not found.any() and found.dtype == th.float32
    # No outputs.
    x = _numbers(70, 40, dtype=dtype)
    laid = product_ops.lay_out_weights(weight[:0], False)
    assert product_ops.rows_by_weights(x, laid, 0, None, False).shape == (70, 0)
    assert product_ops.transposed_product(x, x[:, :0]).shape == (40, 0)
    assert product_ops.transposed_product(x[:, :0], x).shape == (0, 40)
    # No inputs.
    x = th.empty(70, 0, dtype=dtype)
    laid = product_ops.lay_out_weights(th.empty(50, 0, dtype=dtype), False)
    with pytest.raises(ValueError, match=r"no inputs .*\(70, 0\)"):
        product_ops.rows_by_weights(x, laid, 50, bias, False)
    with pytest.raises(ValueError, match=r"no inputs .*\(70, 0\)"):
        product_ops.chain(x, None, [laid], [bias], False)


def test_rows_and_columns_of_one():
    """torch may tell any stride of a dimension of one."""
    x, weight = _numbers(70).as_strided((70, 1), (1, 70)), _numbers(50).as_strided((50, 1), (1, 3))
    found = product_ops.rows_by_weights(x, product_ops.lay_out_weights(weight, False), 50, None, False)
    assert th.allclose(found, x * weight.T)
    row = _numbers(40).as_strided((1, 40), (1, 1))
    found = product_ops.transposed_product(row, row)
    assert th.allclose(found, row.T * row)


@pytest.mark.parametrize(
    ("words", "call"),
    [
        (
            r"rows must be contiguous, got .*32 of shape \(70, 20\) and strides \(40, 2\)",
            lambda x, laid: (x[:, ::2],),
        ),
        (r"rows must be contiguous, got .* strides \(0, 1\)", lambda x, laid: (x[:1].expand(70, -1),)),
        (r"rows must be contiguous, got .* \(2, 35, 40\)", lambda x, laid: (x.view(2, 35, 40),)),
        (r"not laid out for torch.bfloat16 of shape \(70, 40\)", lambda x, laid: (x.bfloat16(),)),
        (r"not laid out for torch.float32 of shape \(70, 32\)", lambda x, laid: (x[:, :32],)),
        ("and 70 outputs", lambda x, laid: (x, laid, 70)),
        (r"a bias for 50 outputs cannot be torch.float32 of shape \(49,\)", lambda x, laid: (x, laid, 50, th.zeros(49))),
        ("a bias for 50 outputs cannot be torch.bfloat16", lambda x, laid: (x, laid, 50, th.zeros(50).bfloat16())),
        (r"a bias for 50 outputs cannot be .* strides \(2,\)", lambda x, laid: (x, laid, 50, th.zeros(100)[::2])),
    ],
)
def test_what_products_do_not_take(words, call):
    x, laid = _numbers(70, 40), product_ops.lay_out_weights(_numbers(50, 40), False)
    given = call(x, laid)
    rows, laid, outputs, bias = (*given, *(x, laid, 50, None)[len(given) :])
    with pytest.raises(ValueError, match=words):
        product_ops.rows_by_weights(rows, laid, outputs, bias, False)


@pytest.mark.parametrize(
    ("words", "plus"),
    [
        (r"to 70 rows of 50 outputs one cannot add .* \(69, 50\)", th.zeros(69, 50)),
        ("cannot add torch.bfloat16", th.zeros(70, 50).bfloat16()),
        (r"cannot add .* strides \(100, 2\)", th.zeros(70, 100)[:, ::2]),
    ],
)
def test_what_cannot_be_added(words, plus):
    x, laid = _numbers(70, 40), product_ops.lay_out_weights(_numbers(50, 40), False)
    with pytest.raises(ValueError, match=words):
        product_ops.chain(x, plus, [laid], [th.zeros(50)], False)


def test_what_the_others_do_not_take():
    x, weight = _numbers(70, 40), _numbers(50, 40)
    laid = product_ops.lay_out_weights(weight, False)
    for words, call in {
        "40 inputs and 70 outputs in torch.float32": lambda: product_ops.chain(x, None, [laid], [th.zeros(70)], False),
        "30 inputs and 50 outputs": lambda: product_ops.chain(x[:, :30], None, [laid], [th.zeros(50)], False),
        "a bias for 50 outputs cannot be torch.float64": lambda: product_ops.chain(
            x, None, [laid], [th.zeros(50).double()], False
        ),
        r"a bias for 50 outputs cannot be .* \(50, 1\)": lambda: product_ops.chain(x, None, [laid], [th.zeros(50, 1)], False),
        "rows must be contiguous": lambda: product_ops.lay_out_weights(weight.T, True),
        r"transpose of .* \(70, 40\) .* with .* \(60, 40\)": lambda: product_ops.transposed_product(x, x[:60]),
        "with torch.bfloat16": lambda: product_ops.transposed_product(x, x.bfloat16()),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
    for call in (
        lambda: product_ops.lay_out_weights(weight.double(), False),
        lambda: product_ops.rows_by_weights(x.double(), laid, 50, None, False),
        lambda: product_ops.chain(x.double(), None, [laid], [th.zeros(50)], False),
        lambda: product_ops.transposed_product(x.double(), x.double()),
    ):
        with pytest.raises(TypeError, match=r"takes float32 and bfloat16, got .*float64"):
            call()


# -- tiles of others -------------------------------------------------------------------------------------------------------


SHAPES = """
#include <cstring>
#include <immintrin.h>
alignas(64) static unsigned char shapes[64], found[64];
extern "C" void set() {
    shapes[0] = 1, shapes[16] = 8, shapes[48] = 3, shapes[18] = 20, shapes[49] = 5;  // palette; bytes and rows of two tiles
    _tile_loadconfig(shapes);
}
extern "C" int kept() {
    _tile_storeconfig(found);
    _tile_release();
    return std::memcmp(shapes, found, 64) == 0;
}
"""


def test_others_find_their_tiles_as_they_left_them(tmp_path):
    """Somebody in this thread shaped tiles, as oneDNN does for more than one product."""
    (tmp_path / "shapes.cpp").write_text(SHAPES)
    flags = ["-march=native", "-shared", "-fPIC", "-o", str(tmp_path / "shapes.so")]
    subprocess.run([*build.find_compiler(), *flags, str(tmp_path / "shapes.cpp")], check=True)
    its = ctypes.CDLL(str(tmp_path / "shapes.so"))
    x, weight = _numbers(64, 40), _numbers(50, 40)
    laid = product_ops.lay_out_weights(weight, False)
    with threads_of(1):
        for call in (
            lambda: product_ops.rows_by_weights(x, laid, 50, None, False),
            lambda: product_ops.chain(x, None, [laid], [th.zeros(50)], False),
            lambda: product_ops.transposed_product(x, x),
        ):
            its.set()
            call()
            assert its.kept()


def test_products_of_others_in_between():
    """oneDNN's, which use tiles for bfloat16, before, between and behind ours."""
    x, weight = _numbers(300, 96, dtype=th.bfloat16), _numbers(70, 96, dtype=th.bfloat16, seed=1)
    odd, narrow = _numbers(37, 53, dtype=th.bfloat16), _numbers(11, 53, dtype=th.bfloat16, seed=1)
    exact, other = x.double() @ weight.double().T, odd.double() @ narrow.double().T
    laid = product_ops.lay_out_weights(weight, False)
    for count in (1, 2):
        with threads_of(count):
            for _ in range(5):
                theirs, small = F.linear(x, weight), F.linear(odd, narrow)
                ours = product_ops.rows_by_weights(x, laid, 70, None, False)
                gradient = product_ops.transposed_product(x, ours)
                assert th.allclose(theirs.double(), exact, rtol=2**-8, atol=1e-3)
                assert th.allclose(small.double(), other, rtol=2**-8, atol=1e-3)
                assert th.allclose(ours.double(), exact, rtol=2**-8, atol=1e-3)
                assert th.allclose(gradient.double(), x.double().T @ ours.double(), rtol=1e-4, atol=1e-2)
