"""Distances to the nearest particles, from which APT and APS estimate the entropy of imagined states.

At paper size, 40 000 particles of 200 numbers, the matrix of all distances alone would take 6.4 GB, and its gradient as
much again. Here a few of its rows exist at a time, and only the neighbours' indices stay for the backward pass.
"""

from __future__ import annotations

import torch as th
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from sb3_dreamer_urlb.number_checks import check_integer

#: numbers of the largest temporary tensor: on a CPU few, which stay in its caches; a GPU wants few, large kernels
_CHUNK_NUMBERS = {"cpu": 2**23, "cuda": 2**25}
#: candidates beyond k: the further the last one is, the surer that no neighbour was missed
_SPARE = 4
#: columns of the distance matrix that are reduced to their minimum before anything is sorted
_GROUP = 32


def check_neighbours(k: int, particles: int | None = None) -> None:
    """
    :param k: neighbours of each particle, itself included
    :param particles: how many there are, None if that is not known yet
    :raises ValueError: if k is no integer between 1 and the number of particles
    """
    check_integer("k", k, 1)
    if particles is not None and k > particles:
        raise ValueError(f"k must be at most the number of particles, but k is {k} and there are {particles} particles.")


def knn_distances(particles: th.Tensor, k: int, chunk_size: int | None = None) -> th.Tensor:
    """Distances of each particle to its k nearest, itself included, with gradients to both ends of each distance.

    The same numbers as ``(x[:, None] - x[None]).norm(dim=-1).topk(k, largest=False).values``, in O(n·(k + d)) memory
    (docs/algorithm.md, "APT"). The gradient of a distance of exactly zero is zero; there are no second derivatives.

    :param particles: float32 (n, d); float64 works too
    :param k: neighbours of each, from 1 (itself) to n
    :param chunk_size: particles whose distances are in memory at a time; None chooses by device. No effect on the numbers
    :return: ascending distances (n, k), column 0 is 0
    :raises ValueError: if k is not between 1 and n, the particles are no matrix, or the chunk size is below 1
    """
    if particles.ndim != 2:
        raise ValueError(f"Particles must be a matrix (n, d), not of shape {tuple(particles.shape)}.")
    n, d = particles.shape
    check_neighbours(k, n)
    if chunk_size is None:
        numbers = _CHUNK_NUMBERS.get(particles.device.type, _CHUNK_NUMBERS["cpu"])
        chunk_size = max(1, numbers // max(n, d * (k + _SPARE)))
    if chunk_size < 1:
        raise ValueError(f"chunk_size must be at least 1, not {chunk_size}.")
    return _KNNDistances.apply(particles, k, chunk_size)  # type: ignore[no-untyped-call]


class _KNNDistances(Function):
    """Forward: search, exact distances. Backward: the same differences again, from the saved indices."""

    @staticmethod
    def forward(ctx: th.autograd.function.FunctionCtx, particles: th.Tensor, k: int, chunk_size: int) -> th.Tensor:
        particles = particles.contiguous()
        distances, neighbours = _neighbours(particles, k, chunk_size)
        ctx.save_for_backward(particles, distances, neighbours)
        ctx.chunk_size = chunk_size  # type: ignore[attr-defined]
        return distances

    @staticmethod
    @once_differentiable
    def backward(ctx: th.autograd.function.FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor, None, None]:
        particles, distances, neighbours = ctx.saved_tensors  # type: ignore[attr-defined]
        # ∂‖x − y‖/∂x = (x − y) / ‖x − y‖
        slopes = th.where(distances > 0, grad / distances, 0)
        result = th.zeros_like(particles)
        for rows in th.arange(len(particles), device=particles.device).split(ctx.chunk_size):  # type: ignore[attr-defined]
            pulls = _differences(particles, rows, neighbours[rows]).mul_(slopes[rows].unsqueeze(-1))
            result[rows] += pulls.sum(1)
            result.index_add_(0, neighbours[rows].flatten(), pulls.flatten(0, 1), alpha=-1)
        return result, None, None


def _neighbours(particles: th.Tensor, k: int, chunk_size: int) -> tuple[th.Tensor, th.Tensor]:
    """Exact distances to the k nearest (n, k) and their indices, int64 (n, k).

    Rows whose float32 search cannot be proved complete, say in tight clusters, are searched again in float64, which tells
    apart what is 1e-7 of the cloud's size from each other.
    """
    n = len(particles)
    distances, neighbours = particles.new_empty(n, k), particles.new_empty(n, k, dtype=th.int64)
    doubtful = th.arange(n, device=particles.device)
    for precision in (th.float32, th.float64) if particles.dtype == th.float32 else (th.float64,):
        proved = doubtful.new_zeros(len(doubtful), dtype=th.bool)
        search = _Search(particles, min(k + _SPARE, n), precision)
        for rows, sure in zip(doubtful.split(chunk_size), proved.split(chunk_size), strict=True):
            candidates, squared_bound = search(rows)
            exact = th.linalg.vector_norm(_differences(particles, rows, candidates), dim=-1)
            # stable: the particle itself, the first candidate, stays first among its duplicates
            exact, order = exact.sort(stable=True)
            distances[rows], neighbours[rows] = exact[:, :k], candidates.gather(1, order[:, :k])
            sure.copy_(search.complete(rows, squared_bound, exact[:, k - 1]))
        doubtful = doubtful[~proved]  # a GPU waits here, once a pass
        if len(doubtful) == 0:
            break
    return distances, neighbours


class _Search:
    """Finds candidates for the nearest particles by ‖x − y‖² − ‖x‖² = ‖y‖² − 2 x·y, one matrix product.

    Its rounding errors grow with ‖x‖ and ‖y‖, not with ‖x − y‖: too coarse for a reward, enough to find who is near.

    :param particles: (n, d)
    :param count: candidates of each particle, itself included
    :param precision: float type of the product
    """

    def __init__(self, particles: th.Tensor, count: int, precision: th.dtype):
        n, d = particles.shape
        # the rounding errors are least around the origin
        points = particles.to(precision)
        points = points - points.mean(0)
        self.squared_norms = points.double().square().sum(1)
        self.left = th.cat([-2 * points, th.ones_like(points[:, :1])], 1)
        self.right = th.cat([points, self.squared_norms[:, None].to(precision)], 1).T
        self.n, self.count = n, count
        self.groups = -(-n // _GROUP) if n >= 4 * count * _GROUP else 0
        # worst case of a sum of d + 1 products of rounded numbers
        self.relative_error = 2 * _input_roundoff(precision) + (d + 8) * th.finfo(precision).eps / 2

    def __call__(self, rows: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Candidates of some particles.

        :param rows: indices (c,)
        :return: indices (c, count), the particle itself first; and (c,) what the squared distances of all others reach
        """
        squares = self.left.new_empty(len(rows), max(self.n, self.groups * _GROUP))
        squares[:, self.n :].fill_(th.inf)
        with th.autocast(squares.device.type, enabled=False):  # in bfloat16 it would find the wrong particles
            th.mm(self.left[rows], self.right, out=squares[:, : self.n])
        squares.scatter_(1, rows[:, None], -th.inf)
        nearest, candidates = self._smallest(squares) if self.groups else squares.topk(self.count, largest=False)
        # with particles that are not finite the padding may be chosen
        return candidates.clamp_(max=self.n - 1), nearest[:, -1] + self.squared_norms[rows]

    def _smallest(self, squares: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """As ``squares.topk(count, largest=False)``, several times faster.

        The ``count`` smallest numbers lie in the ``count`` groups of smallest minimum: a number elsewhere is above the
        minimum of each of them.
        """
        grouped = squares.view(len(squares), _GROUP, self.groups)
        groups = grouped.amin(1).topk(self.count, largest=False, sorted=False).indices
        few = grouped.gather(2, groups[:, None].expand(-1, _GROUP, -1)).flatten(1)
        nearest, place = few.topk(self.count, largest=False)
        return nearest, place // self.count * self.groups + groups.gather(1, place % self.count)

    def complete(self, rows: th.Tensor, squared_bound: th.Tensor, farthest: th.Tensor) -> th.Tensor:
        """Whether no particle that was not a candidate can be nearer than the k-th neighbour found.

        :param rows: indices (c,)
        :param squared_bound: what the search returned (c,)
        :param farthest: distance to the k-th neighbour found (c,)
        :return: bool (c,)
        """
        if self.count == self.n:
            return th.ones_like(rows, dtype=th.bool)
        # one that were nearer would have at most the norm ‖x‖ + farthest, which bounds the error of its product
        norm, farthest = self.squared_norms[rows].sqrt(), farthest.double()
        largest_norm = norm + farthest
        magnitude = largest_norm * (2 * norm + largest_norm) + farthest.square()
        return squared_bound > farthest.square() + self.relative_error * magnitude


def _input_roundoff(precision: th.dtype) -> float:
    """Relative error of the numbers that enter a matrix product: users may allow TF32 or bfloat16 for float32."""
    if precision != th.float32:
        return 0.0
    try:
        return {"highest": 0.0, "high": 2.0**-10, "medium": 2.0**-7}[th.get_float32_matmul_precision()]
    except RuntimeError:  # torch has a newer setting for each backend, and does not sum them up
        return 2.0**-7


def _differences(particles: th.Tensor, rows: th.Tensor, others: th.Tensor) -> th.Tensor:
    """From some particles to others.

    :param particles: (n, d)
    :param rows: indices (c,)
    :param others: indices (c, m)
    :return: (c, m, d)
    """
    # index_select copies whole rows, twice as fast as particles[others]
    ends = particles.index_select(0, others.flatten()).view(*others.shape, -1)
    return particles[rows].unsqueeze(1) - ends
