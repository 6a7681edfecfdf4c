"""Choice of the stages of a nested dissection, and of the batches of fronts of a stage (host).

Depths of the separator tree are merged into stages. A solve streams s (s + 2 b) numbers per front
with s own and b boundary unknowns, and 2 s^2 per leaf, whose coupling to the boundary is sparse.
Fronts of a stage are padded to one size and become one batched product, or a few where sizes
differ. Stages and batches minimise

    numbers streamed + batch cost * number of batches.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from jaxcontact.linear.dissection.layout import round_up

LAUNCH_COST = 10_000
"""Time of the kernels of one batch, in numbers streamed in that time (some 2 us on a CPU)."""

LEAF_COST = 1.0
"""Time to stream the two inverses of a leaf, in numbers streamed per entry: the sum over the rows
of many small matrices is shared between the cores, unlike the products of larger fronts."""

LEAF_BATCH = 3
"""Cost of a batch of leaves over that of another: its sums take longer to compile."""

COUPLING_COST = 30_000
"""Time of the kernels of the sparse coupling, in numbers streamed in that time."""

LEAF_BOUNDARY = 0.1
"""Weight of the boundary of a leaf, which costs time in the factorisation alone."""

COMPILE_COST = 0.003
"""Share of the streamed numbers that a batch must save to be worth its compilation."""


class Tree(NamedTuple):
    """Separator tree of the nodes: where each is eliminated, and the boundary of every part."""

    depth: np.ndarray
    """Depth at which each node is eliminated, (N,)."""
    part: np.ndarray
    """Its part of that depth, (N,)."""
    rank: np.ndarray
    """Its place in the order of elimination, (N,)."""
    boundary: list[tuple[np.ndarray, np.ndarray]]
    """Pairs (part, node) of each depth, sorted by part and rank."""
    own_size: list[np.ndarray]
    """Unknowns of each part of each depth."""
    boundary_size: list[np.ndarray]
    """Boundary unknowns of each part of each depth."""


def merge_depths(tree: Tree) -> tuple[list[int], bool]:
    """Choose the stages: the first depth of each, from the root; and whether the last are leaves.

    The fronts at the bottom of a small tree are not worth the sparse coupling of leaves.
    """
    cost, heads = _cheapest_stages(tree, with_leaves=False)
    leaf_cost, leaf_heads = _cheapest_stages(tree, with_leaves=True)
    if len(leaf_heads) > 1 and leaf_cost + COUPLING_COST < cost:
        return leaf_heads, True
    return heads, False


def _cheapest_stages(tree: Tree, with_leaves: bool) -> tuple[float, list[int]]:
    """Merge depths by dynamic programming: the cost, and the first depth of each stage.

    best[head] is the least cost of the depths from `head` on, choice[head] the end of their first
    stage.
    """
    n_depths = len(tree.own_size)
    batch_cost = cost_of_batch(tree)
    best, choice = [0.0] * (n_depths + 1), [0] * (n_depths + 1)
    for head in range(n_depths - 1, -1, -1):
        own, costs = np.zeros_like(tree.own_size[head]), []
        for end in range(head + 1, n_depths + 1):
            own = own + tree.own_size[end - 1].reshape(len(own), -1).sum(1)
            is_leaf = with_leaves and 0 < head and end == n_depths
            boundary = tree.boundary_size[head]
            cost = split_into_batches(own, boundary, is_leaf, batch_cost)[1]
            costs.append(cost + best[end])
            # Longer stages stream more than this whatever their boundary.
            if (own**2).sum() > 4 * min(costs):
                break
        best[head] = min(costs)
        choice[head] = head + 1 + int(np.argmin(costs))
    heads = [0]
    while choice[heads[-1]] < n_depths:
        heads.append(choice[heads[-1]])
    return best[0], heads


def cost_of_batch(tree: Tree) -> float:
    """Return the cost of one more batch, in numbers streamed."""
    sizes = zip(tree.own_size, tree.boundary_size, strict=True)
    return LAUNCH_COST + COMPILE_COST * sum(int((s * (s + 2 * b)).sum()) for s, b in sizes)


def split_into_batches(
    own: np.ndarray, boundary: np.ndarray, is_leaf: bool, batch_cost: float
) -> tuple[np.ndarray, float]:
    """Split fronts into batches of similar size: batch of each front (F,), and the cost.

    Fronts are sorted by their work, by their own or by their boundary unknowns, whichever is best.

    Args:
        own: own unknowns of each front, (F,).
        boundary: boundary unknowns of each front, (F,).
        is_leaf: whether the fronts are leaves.
        batch_cost: cost of one more batch, see `cost_of_batch`.
    """

    def work(s: np.ndarray, b: np.ndarray) -> np.ndarray:
        return LEAF_COST * s * (s + LEAF_BOUNDARY * b) if is_leaf else s * (s + 2.0 * b)

    if is_leaf:
        batch_cost = LEAF_BATCH * batch_cost
    orders = (
        np.argsort(work(own, boundary), kind="stable"),
        np.lexsort((boundary, own)),
        np.lexsort((own, boundary)),
    )
    splits = [_split(order, own, boundary, work, batch_cost) for order in orders]
    return min(splits, key=lambda split: split[1])


def _split(
    order: np.ndarray,
    own: np.ndarray,
    boundary: np.ndarray,
    work: Callable[[np.ndarray, np.ndarray], np.ndarray],
    batch_cost: float,
    n_cuts: int = 24,
) -> tuple[np.ndarray, float]:
    """Cut a sequence of fronts into batches by dynamic programming, at one of some places.

    best[j] is the least cost of the fronts before cut j, start[j] the cut where their last batch
    begins; a batch costs the work of its largest sizes for each of its fronts.
    """
    cuts = np.unique(np.linspace(0, len(own), min(len(own), n_cuts) + 1).astype(int))
    s = round_up(np.maximum.reduceat(own[order], cuts[:-1]))
    b = np.maximum.reduceat(boundary[order], cuts[:-1])
    best, start = [0.0], [0]
    for j in range(1, len(cuts)):
        s_max = np.maximum.accumulate(s[:j][::-1])[::-1]
        b_max = np.maximum.accumulate(b[:j][::-1])[::-1]
        count = cuts[j] - cuts[:j]
        costs = np.array(best) + batch_cost + count * work(s_max, b_max)
        best.append(costs.min())
        start.append(int(costs.argmin()))
    label, j = np.zeros(len(own), np.int64), len(cuts) - 1
    while j > 0:
        label[order[cuts[start[j]] : cuts[j]]] = start[j]
        j = start[j]
    return np.unique(label, return_inverse=True)[1], best[-1]


def own_size(tree: Tree, head: int, end: int) -> np.ndarray:
    """Return the unknowns that each part of depth `head` eliminates with the depths below `end`.

    The parts that a part is cut into are consecutive at every depth.
    """
    n_parts = len(tree.own_size[head])
    sizes = [tree.own_size[depth].reshape(n_parts, -1).sum(1) for depth in range(head, end)]
    return np.sum(sizes, axis=0)
