"""Record a function once, replay it without Python: CUDA graphs for whole updates, observations and plans.

On a GPU this agent is bound by the launches of thousands of small kernels, not by arithmetic. A CUDA graph launches them
all at once. What is recorded must always do the same: read and write the same memory, take no decision from a value on the
device, and change nothing in Python that a replay should change, too. What differs from call to call is therefore

- copied into inputs that stay where they are (batches, states),
- on the device (learning rates, counters), or
- part of the ``situation``, of which each has a recording of its own (``explore``, a fixed skill).

The first calls of a situation run as they always did, and warm up what torch sets up once. The one after them records.
Where that fails, everything runs as without graphs, after one warning that says why.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Iterator
from typing import Any, Generic, Protocol, TypeVar

import torch as th
from torch import nn

#: values of ``compile``
COMPILE = ("auto", "eager", "native", "cuda_graphs")
#: calls of a situation before it is recorded
WARM_UPS = 3
#: new situations after which a function no longer counts as one that does the same again and again
MAX_SITUATIONS = 30

Result = TypeVar("Result")


class Recording(Protocol):
    """A sequence of kernels that can be launched again."""

    def replay(self) -> None:
        """Do once more, to the same memory, what was recorded."""


class Backend(Protocol):
    """Whatever can record."""

    def warm_up(self, work: Callable[[], Result]) -> tuple[Result, str | None]:
        """Do the work as usual.

        :return: what it gave, and why it cannot be recorded, None if nothing was found
        """

    def record(self, work: Callable[[], Result], generator: th.Generator | None) -> tuple[Recording, Result]:
        """Record the work without doing it.

        :param generator: source of randomness of the work besides the global one
        :return: the recording, and where each replay puts its results
        :raises RuntimeError: if it cannot be recorded
        """


def make_backend(compile: str, device: th.device | str) -> Backend | None:
    """What records on a device.

    :param compile: one of ``COMPILE``
    :param device: where the networks are
    :return: None where everything runs as it is
    """
    device = th.device(device)
    return CudaGraphs(device) if compile in ("auto", "cuda_graphs") and device.type == "cuda" else None


def warn_if_in_vain(compile: str, device: th.device | str) -> None:
    """Say so where graphs are asked for and there cannot be any."""
    device = th.device(device)
    if compile == "cuda_graphs" and device.type != "cuda":
        warnings.warn(f'compile="cuda_graphs" needs a CUDA device, the networks are on {device.type!r}: they run eager.')


class Recorder(Generic[Result]):
    """A function that is recorded where a backend can, and called where not.

    :param function: of trees of tensors, a generator and the situation; returns a tree of tensors. A tree is a tensor, None,
        or a dict, list, tuple or dataclass of trees.
    :param backend: None calls the function
    :param reads: all tensors outside of the inputs that the function reads or writes. When one of them lies elsewhere than
        before (a new optimiser's state, another device), the recording is out of date.
    :param name: of the function, for the warning
    :param keep: recordings to keep at a time; each holds the memory that its work needs
    """

    def __init__(
        self,
        function: Callable[..., Result],
        backend: Backend | None,
        reads: Callable[[], Iterable[th.Tensor]],
        name: str,
        keep: int = 1,
    ):
        self.function = function
        self.backend = backend
        self.reads = reads
        self.name = name
        self.keep = keep
        #: by situation, the latest last
        self._situations: OrderedDict[Hashable, _Situation[Result]] = OrderedDict()
        self._new_situations = 0

    def __call__(self, inputs: Any, generator: th.Generator | None = None, situation: tuple[Hashable, ...] = ()) -> Result:
        """Call the function, or replay what it does.

        :param inputs: tree of tensors
        :param generator: source of randomness besides the global one; goes on as if the function had drawn from it
        :param situation: the function's further arguments; all else that decides what it does
        :return: a tree that no later call changes
        """
        if self.backend is None:
            return self.function(inputs, generator, *situation)
        its = self._situation(inputs, generator, situation)
        if its is None:
            return self.function(inputs, generator, *situation)
        if its.recorded is None and its.calls < WARM_UPS:
            its.calls += 1
            result, refusal = self.backend.warm_up(lambda: self.function(inputs, generator, *situation))
            # Whatever torch sets up once may wait; what still waits in the last of them always will.
            if its.calls == WARM_UPS and refusal is not None:
                self.give_up(refusal)
            return result
        if its.recorded is None:
            try:
                its.recorded = _Recorded(self.function, self.backend, inputs, generator, situation)
            except RuntimeError as error:
                self.give_up(str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__)
                return self.function(inputs, generator, *situation)
        return its.recorded(inputs, generator)

    @property
    def recordings(self) -> int:
        """How many there are at present."""
        return sum(situation.recorded is not None for situation in self._situations.values())

    def _situation(
        self, inputs: Any, generator: th.Generator | None, situation: tuple[Hashable, ...]
    ) -> _Situation[Result] | None:
        shapes = tuple((tensor.shape, tensor.dtype, tensor.device) for tensor in tensors(inputs))
        places = tuple(tensor.data_ptr() for tensor in self.reads())
        key = (shapes, generator is not None, situation, places)
        if key in self._situations:
            self._situations.move_to_end(key)
            return self._situations[key]
        self._new_situations += 1
        if self._new_situations > MAX_SITUATIONS:
            self.give_up(f"sizes, settings or memory changed {MAX_SITUATIONS} times")
            return None
        # First out, then in: two recordings of an update may not fit.
        while len(self._situations) >= self.keep:
            self._situations.popitem(last=False)
        self._situations[key] = _Situation()
        return self._situations[key]

    def give_up(self, reason: str) -> None:
        """Call the function from now on; warns where it would have been recorded.

        :param reason: for the warning
        """
        if self.backend is not None:
            warnings.warn(f"{self.name} runs without CUDA graphs, slower: {reason}")
        self.backend = None
        self._situations.clear()

    def __getstate__(self) -> dict[str, Any]:
        # A copy records anew, and counts anew.
        return {**self.__dict__, "_situations": OrderedDict(), "_new_situations": 0}


@dataclasses.dataclass
class _Situation(Generic[Result]):
    calls: int = 0
    recorded: _Recorded[Result] | None = None


class _Recorded(Generic[Result]):
    """A recording with its own inputs, results and generator."""

    def __init__(
        self,
        function: Callable[..., Result],
        backend: Backend,
        inputs: Any,
        generator: th.Generator | None,
        situation: tuple[Hashable, ...],
    ):
        self.inputs = map_tensors(lambda tensor: tensor.detach().clone(), inputs)
        self.generator = None if generator is None else th.Generator(generator.device)
        self.recording, self.results = backend.record(
            lambda: function(self.inputs, self.generator, *situation), self.generator
        )

    def __call__(self, inputs: Any, generator: th.Generator | None) -> Result:
        for own, given in zip(tensors(self.inputs), tensors(inputs), strict=True):
            own.copy_(given, non_blocking=True)
        # A generator's state is on the host, on a GPU too: nothing waits here.
        if self.generator is not None and generator is not None:
            self.generator.set_state(generator.get_state())
        self.recording.replay()
        if self.generator is not None and generator is not None:
            generator.set_state(self.generator.get_state())
        results: Result = map_tensors(th.clone, self.results)
        return results


class CudaGraphs:
    """Records with :class:`torch.cuda.CUDAGraph`.

    :param device: a CUDA device
    """

    #: what torch says of an operation for which the host waits
    WAITS = "synchronizing CUDA operation"

    def __init__(self, device: th.device):
        self.device = device

    def warm_up(self, work: Callable[[], Result]) -> tuple[Result, str | None]:
        """On a stream of its own, as torch asks for; work that waits for the device is found out before it is recorded."""
        with th.cuda.device(self.device):
            side, main = th.cuda.Stream(), th.cuda.current_stream()
            side.wait_stream(main)
            mode = th.cuda.get_sync_debug_mode()
            with warnings.catch_warnings(record=True) as caught, th.cuda.stream(side):
                warnings.simplefilter("always")
                th.cuda.set_sync_debug_mode("warn")
                try:
                    result = work()
                finally:
                    th.cuda.set_sync_debug_mode(mode)
            main.wait_stream(side)
        waits = [warning for warning in caught if self.WAITS in str(warning.message)]
        for warning in caught:
            # The other one is torch's own about this way of finding out.
            if warning not in waits and "Synchronization debug mode" not in str(warning.message):
                warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
        return result, f"{waits[0].filename}:{waits[0].lineno} waits for the device" if waits else None

    def record(self, work: Callable[[], Result], generator: th.Generator | None) -> tuple[Recording, Result]:
        """Capture; a failed attempt leaves stream and generators as they were."""
        with th.cuda.device(self.device):
            graph, stream = th.cuda.CUDAGraph(), th.cuda.current_stream()
            everyone = th.cuda.default_generators[th.cuda.current_device()]
            before = everyone.clone_state()
            if generator is not None:
                graph.register_generator_state(generator)
            try:
                # Another thread may well fetch a batch meanwhile. A stream of this device: torch's own is of the first one.
                with th.cuda.graph(graph, stream=th.cuda.Stream(), capture_error_mode="thread_local"):
                    results = work()
            except BaseException:
                # torch would go on in the broken capture's stream, and count draws as the capture's.
                th.cuda.set_stream(stream)
                everyone.graphsafe_set_state(before)
                raise
            return graph, results


# -- trees -----------------------------------------------------------------------------------------------------------------


def map_tensors(function: Callable[[th.Tensor], th.Tensor], tree: Any) -> Any:
    """The tree of what the function makes of each tensor.

    :raises TypeError: for anything that is no tree
    """
    if isinstance(tree, th.Tensor):
        return function(tree)
    if tree is None:
        return None
    if isinstance(tree, dict):
        return {name: map_tensors(function, part) for name, part in tree.items()}
    if isinstance(tree, (list, tuple)):
        return type(tree)(map_tensors(function, part) for part in tree)
    if dataclasses.is_dataclass(tree) and not isinstance(tree, type):
        parts = {field.name: map_tensors(function, getattr(tree, field.name)) for field in dataclasses.fields(tree)}
        return dataclasses.replace(tree, **parts)
    raise TypeError(f"Tensors, or dicts, lists, tuples and dataclasses of them, are recorded; got {type(tree).__name__}.")


def tensors(tree: Any) -> Iterator[th.Tensor]:
    """All tensors of a tree, in order."""
    found: list[th.Tensor] = []

    def take(tensor: th.Tensor) -> th.Tensor:
        found.append(tensor)
        return tensor

    map_tensors(take, tree)
    return iter(found)


def memory_of(*modules: nn.Module | None) -> Iterator[th.Tensor]:
    """Parameters and buffers of modules."""
    for module in modules:
        if module is not None:
            yield from module.parameters()
            yield from module.buffers()
