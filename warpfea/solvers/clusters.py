"""Host tables for products by clusters of straight elements, see kernels/elements/element_clusters.py."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.common.structs import topology_struct
from ..kernels.elements.element_clusters import cluster_struct, pool_size, pool_struct, slot_capacity, table_layout
from ..model import assembly

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["ClusterTables", "ModelClusters", "cluster_tables", "make_cluster_memory", "make_clusters"]


@dataclass(eq=False)
class ClusterTables:
    """Element clusters of a block, as the device struct of kernels/elements/element_clusters.py.

    The slots of a cluster are sorted by falling valence to balance the warp.
    """

    start: np.ndarray
    slot_start: np.ndarray
    slot: np.ndarray
    table: np.ndarray


def cluster_tables(conn: np.ndarray, size: int) -> ClusterTables:
    """Tables of clusters of up to `size` consecutive elements with slots `conn` (E, S).

    A range of elements with more slots than a cluster holds is halved.
    """
    count, slots = conn.shape
    start = np.append(np.arange(0, count, size), count)
    while True:
        cluster = np.repeat(np.arange(len(start) - 1), np.diff(start))
        # each distinct pair (cluster, slot) is one sum
        _, first, pair, times = np.unique(
            cluster[:, None] * (conn.max() + 1) + conn, return_index=True, return_inverse=True, return_counts=True
        )
        owner, slot = cluster[first // slots], conn.ravel()[first]
        full = np.bincount(owner) > slot_capacity(size, slots)
        if not full.any():
            break
        start = np.sort(np.concatenate([start, (start[:-1] + start[1:])[full] // 2]))
    order = np.lexsort((slot, -times, owner))
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    pair = rank[pair].reshape(conn.shape)
    slot_start = np.concatenate([[0], np.cumsum(np.bincount(owner))])
    within = np.arange(count) - start[cluster]
    at_place, at_start, words = table_layout(size, slots)
    table = np.zeros((len(start) - 1, 2 * words), dtype=np.uint16)
    by_slot = np.argsort(pair.T.ravel(), kind="stable")
    local, elem = np.divmod(by_slot, count)
    own = np.repeat(owner[order], times[order])  # cluster of each force
    table[own, np.arange(len(own)) - slots * start[own]] = local * size + within[elem]
    for k in range(slots):
        table[cluster, at_place + k * size + within] = pair[:, k] - slot_start[cluster]
    end = np.cumsum(times[order]) - slots * start[owner[order]]
    table[owner[order], at_start + 1 + np.arange(len(order)) - slot_start[owner[order]]] = end
    return ClusterTables(start, slot_start, slot[order], table.view(np.int32).ravel())


@dataclass(eq=False)
class ModelClusters:
    """Clusters of a model.

    Attributes:
        blocks: device struct and number of clusters of each block.
        topology: device struct of the slot gather, with the cluster sums as contributions.
        sum_count: number of cluster sums.
    """

    blocks: list[tuple[Any, int]]
    topology: Any
    sums: int


def make_clusters(model: Model) -> ModelClusters:
    """Clusters of a model with straight elements only, mass included in the product."""
    blocks, slots, offset = [], [], 0
    for block in model.blocks:
        tables = cluster_tables(block.connectivity, block.cluster_size)
        data = cluster_struct()()
        data.element_start = model.array("clusters", tables.start, wp.int32)
        data.slot_start = model.array("clusters", tables.slot_start, wp.int32)
        data.table = model.array("clusters", tables.table, wp.int32)
        data.sum_offset = offset
        count = np.diff(tables.slot_start)
        place = np.minimum(np.arange(slot_capacity(block.cluster_size, block.slots)), count[:, None] - 1)
        data.slot = model.array("clusters", tables.slot[tables.slot_start[:-1, None] + place], wp.int32)
        blocks.append((data, len(count)))
        slots.append(tables.slot)
        offset += len(tables.slot)
    topo = topology_struct(model.dtype)()
    start, entry = assembly.gather_table([of[:, None] for of in slots], model.slots)
    topo.contribution_start = model.array("clusters", start, wp.int32)
    topo.contribution_entry = model.array("clusters", entry, wp.int32)
    topo.prescribed_bits = model.topology.prescribed_bits
    return ModelClusters(blocks, topo, offset)


def make_cluster_memory(model: Model, work: Workspace, *, midpoint: bool) -> Any:
    """Device struct of the arrays that replace shared memory on the CPU; empty on CUDA."""
    pool, to_host = pool_struct(model.dtype)(), not model.device.is_cuda
    numbers = max(
        pool_size(b.cluster_size, b.slots, 3 if midpoint or b.key.damping == "rate" else 2) for b in model.blocks
    )
    words = max(table_layout(b.cluster_size, b.slots)[2] for b in model.blocks)
    pool.numbers = work.array("cluster numbers", (numbers if to_host else 1,), model.types.T)
    pool.table = work.array("cluster table", (words if to_host else 1,), wp.int32)
    return pool
