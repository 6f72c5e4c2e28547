"""Imagined trajectories as a torch operator: all layers of all steps in one pass (rollout.cpp)."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import torch as th

from sb3_dreamer_urlb.native import ops
from sb3_dreamer_urlb.native.planner_ops import _check, _whole, rows_format
from sb3_dreamer_urlb.native.product_ops import ChainLayer, chain_layers

_POINTER, _INDEX, _INT = ops._POINTER, ops._INDEX, ops._INT


class _Dynamics(ctypes.Structure):
    """As rollout.cpp has it."""

    _fields_ = (
        *((name, _POINTER) for name in ("rows", "action_rows", "bias")),
        *((name, _INDEX) for name in ("stride", "hidden", "actions", "deter", "variables", "classes")),
        ("gru", ChainLayer),
        *((name, _POINTER) for name in ("norm_weight", "norm_bias")),
        ("epsilon", ops._FLOAT),
        ("prior", ChainLayer * 2),
    )


FUNCTIONS = {
    "rollout_": (ctypes.POINTER(_Dynamics), *[_POINTER] * 6, _INDEX, _INDEX, _INT),
}
ops.OPTIONAL["has_tiles"].update(FUNCTIONS)
ops.OPTIONAL["has_half_rollouts"] = {name + "half": arguments for name, arguments in FUNCTIONS.items()}


@ops.operator(
    "rollout(Tensor start, Tensor addend, Tensor action, Tensor uniform, Tensor[] layers, float epsilon) -> (Tensor, Tensor)"
)
def rollout(
    start: th.Tensor, addend: th.Tensor, action: th.Tensor, uniform: th.Tensor, layers: list[th.Tensor], epsilon: float
) -> tuple[th.Tensor, th.Tensor]:
    """Sample H steps of the RSSM's prior from each of n states.

    :param start: deterministic states, float32 (n, D), contiguous
    :param addend: what the states' samples give the first layer, in the format of products (n, hidden), contiguous
    :param action: float32 (n, H, A), contiguous
    :param uniform: numbers in [0, 1), float32 (H, n, S), contiguous
    :param layers: three of ``input``, in ``planner_ops.whole_lines``: rows of the samples (S · K, hidden), rows of the actions
        (A, hidden), bias (hidden,); of the GRU its weights from ``product_ops.lay_out_weights`` and its bias, its norm's
        weight and bias; weights and bias of the prior's hidden layer and of its logits; all biases but the first float32
    :param epsilon: of the norm
    :return: of states 1 … H: classes, counted through all S · K, int64 (H, n, S); deterministic states in the format of
        products (H, n, D)
    """
    rows, action_rows, bias, gru, gru_bias, norm_weight, norm_bias, *prior = layers
    dtype, (n, deter), hidden, (_, horizon, actions) = addend.dtype, start.shape, addend.shape[1], action.shape
    variables = uniform.shape[-1]
    function, stride = _of_rows("rollout_", rows, dtype), _whole(hidden, rows.dtype)
    _check("a start", start, th.float32, (n, deter))
    _check("an addend", addend, dtype, (n, hidden))
    _check("actions", action, th.float32, (n, horizon, actions))
    _check("uniform numbers", uniform, th.float32, (horizon, n, variables))
    _check("rows of weights", rows, rows.dtype, (len(rows), stride))
    _check("other rows", action_rows, rows.dtype, (actions, stride))
    _check("a bias", bias, rows.dtype, (stride,))
    _check("a norm's weight", norm_weight, th.float32, (3 * deter,))
    _check("a norm's bias", norm_bias, th.float32, (3 * deter,))
    _check("a GRU's bias", gru_bias, th.float32, (3 * deter,))
    _check("a bias of logits", prior[3], th.float32, (len(rows),))
    if variables == 0 or len(rows) % variables:
        raise ValueError(f"{len(rows)} rows of weights cannot be those of {variables} variables.")
    places = [tensor.data_ptr() for tensor in (rows, action_rows, bias)]
    its_gru, its_prior = (
        chain_layers(hidden + deter, [gru], [gru_bias], dtype),
        chain_layers(deter, prior[::2], prior[1::2], dtype),
    )
    norm = (norm_weight.data_ptr(), norm_bias.data_ptr(), epsilon)
    sizes = (stride, hidden, actions, deter, variables, len(rows) // variables)
    dynamics = _Dynamics(*places, *sizes, its_gru[0], *norm, its_prior)
    classes = th.empty(horizon, n, variables, dtype=th.int64)
    deters = th.empty(horizon, n, deter, dtype=dtype)
    if deters.numel():
        places = [tensor.data_ptr() for tensor in (start, addend, action, uniform, classes, deters)]
        function(dynamics, *places, n, horizon, th.get_num_threads())
    return classes, deters


def _of_rows(name: str, rows: th.Tensor, dtype: th.dtype) -> Callable[..., None]:
    """The function for rows of weights in the format that products in ``dtype`` use."""
    if rows.dtype != rows_format(dtype):
        raise TypeError(f"rows of weights must be {rows_format(dtype)} for products in {dtype}, got {rows.dtype}.")
    return ops._function(name + "half") if rows.dtype == th.float16 else ops._of_format(name, rows)
