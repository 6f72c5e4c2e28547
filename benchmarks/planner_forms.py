"""What each form of the planned agent gains, and each switch within it: python benchmarks/planner_forms.py, paper size.

Forms (docstring of planning/prepared) and the same with a thing taken away, in turns; a ratio above one is what it saves.
Another processor takes a process of its own, with variables of tests/helpers/every_combination.py before Python starts.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from unittest import mock

import numpy as np
import torch as th
from common import Floor, interleaved, make_model, parser, report, set_threads

from sb3_dreamer_urlb import DreamerV2, native
from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.dreamer_v2 import policies
from sb3_dreamer_urlb.native import planner_ops, product_ops, rollout_ops
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.planning.prepared import native_parts, parts
from sb3_dreamer_urlb.planning.prepared.prepacked import PrepackedLinear

Patches = Callable[[], list[AbstractContextManager[object]]]


def _plain() -> list[AbstractContextManager[object]]:
    def planned(agent: Agent, skill: th.Tensor) -> PlannedAgent:
        return PlannedAgent(agent, skill)

    return [mock.patch.object(policies, "planned", planned)]


class _AsTheyAre(PrepackedLinear):
    def __init__(self, weight: th.Tensor, bias: th.Tensor | None, dtype: th.dtype):
        super().__init__(weight, bias, dtype)
        self.packed = None


def _weights_as_they_are() -> list[AbstractContextManager[object]]:
    return [mock.patch.object(parts, "PrepackedLinear", _AsTheyAre)]


def _step_by_step() -> list[AbstractContextManager[object]]:
    return [mock.patch.object(native_parts.NativeDynamics, "imagine", lambda *_: None)]


def _without_tiles() -> list[AbstractContextManager[object]]:
    return [mock.patch.object(product_ops, "available", lambda: False)]


def _without_halves() -> list[AbstractContextManager[object]]:
    same = mock.Mock(side_effect=lambda dtype: dtype)
    return [mock.patch.object(module, "rows_format", same) for module in (native_parts, planner_ops, rollout_ops)]


#: name → kernels, what is patched, the form it is compared with
FORMS: dict[str, tuple[str, Patches, str | None]] = {
    "plain, torch's kernels": ("eager", _plain, "prepared"),
    "prepared": ("eager", list, None),
    "prepared, weights not laid out": ("eager", _weights_as_they_are, "prepared"),
    "plain, kernels of our own": ("native", _plain, "native"),
    "native": ("native", list, "prepared"),
}
#: likewise, where the processor has lanes; halves and tiles
ON_LANES: dict[str, tuple[str, Patches, str | None]] = {
    "native, bfloat16 rows": ("native", _without_halves, "native"),
    "native, step by step": ("native", _step_by_step, "native"),
    "native, without tiles": ("native", lambda: [*_without_tiles(), *_step_by_step()], "native, step by step"),
}


@ending_with_its_reader()
def main() -> None:
    """Time ``predict`` on one environment in every form that this processor has."""
    options = parser(__doc__).parse_args()
    image = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3), np.uint8)
    set_threads(options)
    work: dict[str, Callable[[], object]] = {}
    floors: dict[str, Floor] = {}
    with native.using("native", "cpu"):
        forms = {**FORMS, **(ON_LANES if native.on_lanes() else {})}
    for precision in options.precision:
        models = {
            compile: make_model(
                options, precision=precision, planner="dyna_mpc", learning_starts=0, planner_delay=0, compile=compile
            )
            for compile in ("eager", "native")
        }
        for form, (compile, patches, compared) in forms.items():
            row = f"{form}, {precision}"
            work[row] = partial(_act, models[compile], image, patches)
            if compared is not None:
                floors[row] = Floor(f"{compared}, {precision}", 1.0)
    report("planner_forms", interleaved(work, options, th.device("cpu")), floors, options, th.device("cpu"))


def _act(model: DreamerV2, image: np.ndarray, patches: Patches) -> None:
    with ExitStack() as stack:
        for patch in patches():
            stack.enter_context(patch)
        model.predict(image)


if __name__ == "__main__":
    main()
