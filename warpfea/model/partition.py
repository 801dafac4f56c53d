"""Node clustering by recursive bisection, and a locality-preserving node order."""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp

__all__ = ["bisect_groups", "connected_groups", "morton_order"]


def bisect_groups(places: np.ndarray, weights: np.ndarray, labels: np.ndarray, capacity: int) -> np.ndarray:
    """Group of each item: groups are compact, of one label, and of a total weight up to `capacity`.

    Groups are halved across their longest side until they fit; those of twice the capacity are unions of those of
    the capacity.

    Args:
        places: (n, 3) m.
        weights: (n,) whole numbers, each up to the capacity.
        labels: (n,) items of different labels never share a group.

    Returns:
        (n,) group numbers from 0, without gaps.

    Raises:
        ValueError: an item that weighs more than the capacity.
    """
    if np.any(weights > capacity):
        raise ValueError(f"an item of weight {weights.max()} does not fit into a group of {capacity}")
    # multiples of the largest weight can be filled for any split of the weights
    room = capacity // int(weights.max()) * int(weights.max())
    group = np.unique(labels, return_inverse=True)[1].ravel().astype(np.int64)
    while True:
        total = np.bincount(group, weights=weights)
        parts = np.ceil(total / room - 1e-9).astype(np.int64)
        if parts.max() <= 1:
            return group
        order = np.argsort(group, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(group))])[:-1]
        sorted_places = places[order]
        extent = np.maximum.reduceat(sorted_places, start) - np.minimum.reduceat(sorted_places, start)
        axis = np.argmax(extent, axis=1)
        along = places[np.arange(len(places)), axis[group]]
        order = np.lexsort((along, group))
        before = np.cumsum(weights[order]) - weights[order]
        before = before - before[start][group[order]]  # weight of the preceding items of its group
        left = parts // 2
        share = np.where(parts > 1, total * left / np.maximum(parts, 1), np.inf)
        second = np.zeros(len(group), dtype=np.int64)
        second[order] = before + 0.5 * weights[order] >= share[group[order]]
        group = np.unique(2 * group + second, return_inverse=True)[1].ravel()


def connected_groups(group: np.ndarray, graph: sp.csr_matrix) -> np.ndarray:
    """(n,) group numbers after splitting into connected parts; `graph`: adjacency of the items."""
    links = graph.tocoo()
    inside = group[links.row] == group[links.col]
    within = sp.coo_matrix(
        (np.ones(int(inside.sum()), dtype=np.int8), (links.row[inside], links.col[inside])), graph.shape
    )
    return np.asarray(sp.csgraph.connected_components(within.tocsr(), directed=False)[1])


def morton_order(places: np.ndarray) -> np.ndarray:
    """(n,) order of points (n, 3) along a Morton curve over their bounding box."""
    low = places.min(axis=0)
    extent = max(float(np.ptp(places, axis=0).max()), 1e-300)
    cell = np.minimum((places - low) / extent * 2**20, 2**20 - 1).astype(np.uint64)
    code = np.zeros(len(places), dtype=np.uint64)
    for bit in range(20):
        for axis in range(3):
            code |= ((cell[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
