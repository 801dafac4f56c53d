"""Products of elements by clusters: each reads its slots once, and adds up for each what its elements give.

A cluster is a run of up to ELEMENTS elements that one block of threads does: the fields at its slots lie in memory that
the threads share, and so do the elements' contributions until they are summed, in a fixed order. What it writes is one
sum per slot, about a third of the contributions, and reads of neighbours' slots cost no addresses in global memory.
"""

import functools
import types as _types
from collections.abc import Callable

import warp as wp

from .lanes import lane_functions
from .types import precision

__all__ = ["ELEMENTS", "cluster_functions", "cluster_struct", "pool_size", "pool_struct", "slot_capacity", "table_layout"]

import os
ELEMENTS = int(os.environ.get("WF_EL", "64"))
"""Elements of a cluster, and threads of its block."""


def slot_capacity(slots: int) -> int:
    """Slots that a cluster of elements with so many has at most; half as many elements always fit."""
    return slots * ELEMENTS // 2


def pool_size(slots: int, fields: int) -> int:
    """Numbers that a cluster holds: fields at its slots, contributions of its elements."""
    return 3 * (fields * slot_capacity(slots) + slots * ELEMENTS)


def table_layout(slots: int) -> tuple[int, int, int]:
    """Where place and sum_start begin in a cluster's table of 16-bit numbers, and the table's size in words."""
    place = slots * ELEMENTS
    return place, 2 * place, place + slot_capacity(slots) // 2 + 1


@functools.cache
def cluster_struct():
    """The clusters of a block of elements.

    A table holds, in 16 bits each: sum_entry, local * ELEMENTS + element of the cluster, of the contributions in the
    order of the slots that they go to; place [local, element] of a slot in its cluster; sum_start [slot + 1].
    """

    @wp.struct
    class Clusters:
        start: wp.array(dtype=wp.int32)  # [cluster + 1] elements
        slot_start: wp.array(dtype=wp.int32)  # [cluster + 1] index into slot
        slot: wp.array(dtype=wp.int32)
        table: wp.array2d(dtype=wp.int32)  # [cluster, word]
        offset: wp.int32  # of the sums among those of all blocks

    return Clusters


@functools.cache
def pool_struct(dtype: str):
    """Memory that stands for the shared memory of a block on the CPU; a number each on CUDA."""
    T = precision(dtype).T

    @wp.struct
    class Pool:
        number: wp.array(dtype=T)
        table: wp.array(dtype=wp.int32)

    return Pool


def _pool_access(dtype: str, size: int) -> Callable:
    """put(1, k, x, spare) stores and put(0, k, x, spare) returns number k of the block's pool, on the CPU in `spare`."""
    T = precision(dtype).T
    scalar = {"float64": "double", "float32": "float"}[dtype]
    # one function for both: shared memory of two functions would be two memories
    snippet = f"""
    #if defined(__CUDA_ARCH__)
    __shared__ {scalar} pool[{size}];
    #else
    {scalar}* pool = spare.data;
    #endif
    if (put) pool[k] = x;
    return pool[k];
    """

    @wp.func_native(snippet)
    def access(put: int, k: int, x: T, spare: wp.array(dtype=T)) -> T: ...

    return access


def _table_access(size: int) -> Callable:
    """table(1, k, x, spare) stores word k of the block's table, table(0, k, x, spare) returns its k-th 16 bits."""
    snippet = f"""
    #if defined(__CUDA_ARCH__)
    __shared__ int table[{size}];
    #else
    int* table = spare.data;
    #endif
    if (put) {{ table[k] = x; return x; }}
    return ((const unsigned short*)table)[k];
    """

    @wp.func_native(snippet)
    def access(put: int, k: int, x: int, spare: wp.array(dtype=wp.int32)) -> int: ...

    return access


@functools.cache
def cluster_functions(dtype: str, slots: int, fields: int) -> _types.SimpleNamespace:
    """What element kernels need: `fetch` of a field at a slot, and `by_clusters`, which makes the kernel."""
    p = precision(dtype)
    T, vec3, sym6 = p.T, p.vec3, p.sym
    Clusters, Pool = cluster_struct(), pool_struct(dtype)
    access = _pool_access(dtype, pool_size(slots, fields))
    sync = lane_functions(dtype).sync
    NS, CAPACITY = slots, slot_capacity(slots)
    PLACE, SUM_START, WORDS = table_layout(slots)
    table = _table_access(WORDS)
    # loads under way at once
    SLOTS_AT_ONCE, WORDS_AT_ONCE = -(-CAPACITY // ELEMENTS), -(-WORDS // ELEMENTS)
    Slots = wp.types.vector(length=SLOTS_AT_ONCE, dtype=wp.int32)
    Words = wp.types.vector(length=WORDS_AT_ONCE, dtype=wp.int32)
    Values = wp.types.matrix(shape=(SLOTS_AT_ONCE, 3), dtype=T)
    FORCE = 3 * fields * CAPACITY

    @wp.func
    def put(first: int, stride: int, at: int, x: vec3, pool: wp.array(dtype=T)):
        for k in range(3):
            access(1, first + k * stride + at, x[k], pool)

    @wp.func
    def get(first: int, stride: int, at: int, pool: wp.array(dtype=T)) -> vec3:
        x = vec3()
        for k in range(3):
            x[k] = access(0, first + k * stride + at, T(0.0), pool)
        return x

    @wp.func
    def fetch(pool: Pool, field: int, i: int, at: int) -> vec3:
        """Field number `field` at slot i of element `at` of a cluster."""
        place = table(0, PLACE + i * ELEMENTS + at, 0, pool.table)
        return get(3 * field * CAPACITY, CAPACITY, place, pool.number)

    @wp.func
    def set_force(pool: Pool, i: int, at: int, f: vec3):
        """What element `at` of a cluster gives to its slot i."""
        put(FORCE + i * ELEMENTS, NS * ELEMENTS, at, f, pool.number)

    @wp.func
    def add_force(pool: Pool, i: int, at: int, f: vec3):
        """Adds to it."""
        set_force(pool, i, at, get(FORCE + i * ELEMENTS, NS * ELEMENTS, at, pool.number) + f)

    @wp.func
    def take_table(clusters: Clusters, cluster: int, lane: int, lanes: int, pool: Pool):
        """The cluster's table."""
        for first in range(lane, WORDS, WORDS_AT_ONCE * lanes):
            x = Words()
            for j in range(WORDS_AT_ONCE):
                x[j] = clusters.table[cluster, wp.min(first + j * lanes, WORDS - 1)]
            for j in range(WORDS_AT_ONCE):
                if first + j * lanes < WORDS:
                    table(1, first + j * lanes, x[j], pool.table)

    @wp.func
    def take_field(
        field: wp.array2d(dtype=vec3), into: int, slot: Slots, world: int, first: int, lanes: int, count: int, pool: Pool
    ):
        """A field at the cluster's slots from `first` on."""
        x = Values()
        for j in range(SLOTS_AT_ONCE):
            x[j] = field[world, slot[j]]
        for j in range(SLOTS_AT_ONCE):
            if first + j * lanes < count:
                put(3 * into * CAPACITY, CAPACITY, first + j * lanes, x[j], pool.number)

    def by_clusters(module: wp.Module, Block, product: wp.Function) -> wp.Kernel:
        """The kernel `massive_product`; `product` gives what an element adds."""

        import os
        LB = (64, int(os.environ['WF_LB'])) if 'WF_LB' in os.environ else None
        @wp.kernel(module=module, launch_bounds=LB)
        def massive_product(
            block: Block,
            clusters: Clusters,
            u: wp.array2d(dtype=vec3),
            v: wp.array2d(dtype=vec3),
            history: wp.array2d(dtype=sym6),
            mass_factor: wp.array(dtype=wp.float64),
            dq_dv: wp.array(dtype=wp.float64),
            active: wp.array(dtype=wp.int32),
            direction: wp.array2d(dtype=vec3),
            lanes: int,
            pool: Pool,
            sums: wp.array2d(dtype=vec3),
        ):
            """c_M M p + (dq/dv) K p of straight elements, whose mass is one table times a number each."""
            world, index = wp.tid()
            if active[world] == 0:
                return
            cluster = index / lanes
            lane = index % lanes
            begin = clusters.slot_start[cluster]
            count = clusters.slot_start[cluster + 1] - begin
            take_table(clusters, cluster, lane, lanes, pool)
            for first in range(lane, count, SLOTS_AT_ONCE * lanes):
                slot = Slots()
                for j in range(SLOTS_AT_ONCE):
                    slot[j] = clusters.slot[begin + wp.min(first + j * lanes, count - 1)]
                take_field(u, 0, slot, world, first, lanes, count, pool)
                take_field(direction, 1, slot, world, first, lanes, count, pool)
                if wp.static(fields == 3):
                    take_field(v, 2, slot, world, first, lanes, count, pool)
            sync()
            first_elem = clusters.start[cluster]
            for elem in range(first_elem + lane, clusters.start[cluster + 1], lanes):
                dq = T(dq_dv[world])
                scale = T(mass_factor[world]) * block.density[elem]
                product(block, pool, history, dq, scale, world, elem, elem - first_elem)
            sync()
            for k in range(lane, count, lanes):
                f = vec3()
                for e in range(table(0, SUM_START + k, 0, pool.table), table(0, SUM_START + k + 1, 0, pool.table)):
                    f += get(FORCE, NS * ELEMENTS, table(0, e, 0, pool.table), pool.number)
                sums[world, clusters.offset + begin + k] = f

        return massive_product

    return _types.SimpleNamespace(
        fetch=fetch, set_force=set_force, add_force=add_force, by_clusters=by_clusters, Pool=Pool
    )
