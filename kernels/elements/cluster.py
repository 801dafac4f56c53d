"""Products of elements by clusters: each reads its slots once, and adds up for each what its elements give.

A cluster is a run of elements that one block of threads does. The fields at its slots lie in memory that the threads
share, and so do the elements' contributions until they are summed, in a fixed order. What it writes is one sum per
slot, about a third of the contributions, and to read a slot costs no address in global memory. On the CPU a cluster is
one thread's, and arrays stand for the shared memory.
"""

import functools
import types as _types
from collections.abc import Callable

import warp as wp

from ..common.lanes import lane_functions
from ..common.types import precision

__all__ = [
    "DIRECTION",
    "LARGEST",
    "U",
    "V",
    "cluster_functions",
    "cluster_size",
    "cluster_struct",
    "pool_size",
    "pool_struct",
    "slot_capacity",
    "table_layout",
]

LARGEST = {"float64": 64, "float32": 128}
"""Elements of a cluster, and threads of its block: as many as shared memory and registers let fill a device well."""
CAPACITY = {32: 24, 64: 32, 128: 46}
"""Slots that clusters of these sizes have room for, as multiples of the slots of an element."""
SHARED_BYTES = 48 * 1024
"""Shared memory that a block may have without asking."""
THREADS = {"float64": 384, "float32": 640}
"""Threads that registers must leave room for on a multiprocessor."""
U, DIRECTION, V = 0, 1, 2
"""Fields of a cluster."""
QUAD = 4
"""Words of a table that are read at once."""


def cluster_size(dtype: str, count: int, *, fit: bool) -> int:
    """Elements of a cluster in a block of so many.

    `fit`: small blocks have small clusters, so that few threads idle where thousands of worlds are done at once.
    """
    return min(n for n in CAPACITY if n == LARGEST[dtype] or (fit and count <= n < LARGEST[dtype]))


def slot_capacity(size: int, slots: int) -> int:
    """Slots that a cluster of `size` elements with so many has at most."""
    return slots * CAPACITY[size]


def pool_size(size: int, slots: int, fields: int) -> int:
    """Numbers that a cluster holds: fields at its slots, contributions of its elements."""
    return 3 * (fields * slot_capacity(size, slots) + slots * size)


def table_layout(size: int, slots: int) -> tuple[int, int, int]:
    """Where place and sum_start begin in a cluster's table of 16-bit numbers, and the words of the table."""
    place = slots * size
    words = place + slot_capacity(size, slots) // 2 + 1
    return place, 2 * place, QUAD * -(-words // QUAD)


@functools.cache
def cluster_struct():
    """The clusters of a block of elements.

    A table holds, in 16 bits each: sum_entry, local * size + element of the cluster, of the contributions in the
    order of the slots that they go to; place [local, element] of a slot in its cluster; sum_start [slot + 1].
    """

    @wp.struct
    class Clusters:
        start: wp.array(dtype=wp.int32)  # [cluster + 1] elements
        slot_start: wp.array(dtype=wp.int32)  # [cluster + 1] index into the sums of the block
        slot: wp.array2d(dtype=wp.int32)  # [cluster, place]; the last one fills the row
        table: wp.array(dtype=wp.int32)  # [cluster * words]
        offset: wp.int32  # of the block's sums among those of all blocks

    return Clusters


@functools.cache
def pool_struct(dtype: str):
    """What stands for the shared memory of a block on the CPU; a number each on CUDA."""
    T = precision(dtype).T

    @wp.struct
    class Pool:
        number: wp.array(dtype=T)
        table: wp.array(dtype=wp.int32)

    return Pool


def _pool_access(dtype: str, size: int) -> Callable:
    """access(1, k, x, spare) stores, access(0, k, x, spare) returns number k."""
    T = precision(dtype).T
    scalar = {"float64": "double", "float32": "float"}[dtype]
    # one function for both: shared memory of two functions would be two memories
    snippet = f"""
    #if defined(__CUDA_ARCH__)
    __shared__ {scalar} pool[{size}];
    #else
    {scalar}* pool = spare.data;
    #endif
    if (store) pool[k] = x;
    return pool[k];
    """

    @wp.func_native(snippet)
    def access(store: int, k: int, x: T, spare: wp.array(dtype=T)) -> T: ...

    return access


def _table_access(words: int) -> Callable:
    """access(1, k, first, source, spare) copies QUAD words k of a table that begins at word `first` of the source;
    access(0, k, first, source, spare) returns 16 bits of it."""
    snippet = f"""
    #if defined(__CUDA_ARCH__)
    __shared__ __align__(16) int table[{words}];
    if (copy) {{ ((int4*)table)[k] = ((const int4*)(source.data + first))[k]; return 0; }}
    #else
    int* table = spare.data;
    if (copy) {{ for (int i = {QUAD} * k; i < {QUAD} * k + {QUAD}; ++i) table[i] = source.data[first + i]; return 0; }}
    #endif
    #if defined(__CUDA_ARCH__)
    return ((const unsigned short*)table)[k];  // the block's barrier stands between this and the copy
    #else
    unsigned short x;
    memcpy(&x, (const char*)table + 2 * k, 2);
    return x;
    #endif
    """

    @wp.func_native(snippet)
    def access(
        copy: int, k: int, first: int, source: wp.array(dtype=wp.int32), spare: wp.array(dtype=wp.int32)
    ) -> int: ...

    return access


@functools.cache
def cluster_functions(dtype: str, size: int, slots: int, fields: int) -> _types.SimpleNamespace:
    """What kernels of elements with so many slots need to take part in clusters of `size`.

    `fetch(pool, field, i, at)`: a field (U, DIRECTION, V) at slot i of element `at` of the cluster; `set_force`
    and `add_force(pool, i, at, f)`: what it gives there; `by_clusters(module, Block, product, bounded)`:
    the kernel.
    """
    p = precision(dtype)
    T, vec3, sym6 = p.T, p.vec3, p.sym
    Clusters, Pool = cluster_struct(), pool_struct(dtype)
    sync = lane_functions(dtype).sync
    NS, ELEMENTS, ROOM = slots, size, slot_capacity(size, slots)
    PLACE, SUM_START, WORDS = table_layout(size, slots)
    FORCE = 3 * fields * ROOM
    numbers = pool_size(size, slots, fields)
    assert numbers * (8 if dtype == "float64" else 4) + 4 * WORDS < SHARED_BYTES, "smaller clusters are wanted"
    number = _pool_access(dtype, numbers)
    bits = _table_access(WORDS)
    # loads under way at once
    SLOTS_AT_ONCE, QUADS_AT_ONCE = -(-ROOM // ELEMENTS), -(-WORDS // (QUAD * ELEMENTS))
    Slots = wp.types.vector(length=SLOTS_AT_ONCE, dtype=wp.int32)
    Values = wp.types.matrix(shape=(SLOTS_AT_ONCE, 3), dtype=T)

    @wp.func
    def put(first: int, stride: int, at: int, x: vec3, pool: Pool):
        for k in range(3):
            number(1, first + k * stride + at, x[k], pool.number)

    @wp.func
    def get(first: int, stride: int, at: int, pool: Pool) -> vec3:
        x = vec3()
        for k in range(3):
            x[k] = number(0, first + k * stride + at, T(0.0), pool.number)
        return x

    @wp.func
    def entry(k: int, pool: Pool) -> int:
        """Number k of the table."""
        return bits(0, k, 0, pool.table, pool.table)

    @wp.func
    def fetch(pool: Pool, field: int, i: int, at: int) -> vec3:
        return get(3 * field * ROOM, ROOM, entry(PLACE + i * ELEMENTS + at, pool), pool)

    @wp.func
    def set_force(pool: Pool, i: int, at: int, f: vec3):
        put(FORCE + i * ELEMENTS, NS * ELEMENTS, at, f, pool)

    @wp.func
    def add_force(pool: Pool, i: int, at: int, f: vec3):
        set_force(pool, i, at, get(FORCE + i * ELEMENTS, NS * ELEMENTS, at, pool) + f)

    @wp.func
    def take_table(clusters: Clusters, cluster: int, lane: int, lanes: int, pool: Pool):
        for first in range(lane, WORDS / QUAD, QUADS_AT_ONCE * lanes):
            for j in range(QUADS_AT_ONCE):
                if first + j * lanes < WORDS / QUAD:
                    bits(1, first + j * lanes, cluster * WORDS, clusters.table, pool.table)

    @wp.func
    def slots_from(clusters: Clusters, cluster: int, first: int, lanes: int) -> Slots:
        slot = Slots()
        for j in range(SLOTS_AT_ONCE):
            slot[j] = clusters.slot[cluster, wp.min(first + j * lanes, ROOM - 1)]
        return slot

    @wp.func
    def take_field(
        field: wp.array2d(dtype=vec3),
        into: int,
        slot: Slots,
        world: int,
        first: int,
        lanes: int,
        count: int,
        pool: Pool,
    ):
        x = Values()
        for j in range(SLOTS_AT_ONCE):
            x[j] = field[world, slot[j]]
        for j in range(SLOTS_AT_ONCE):
            if first + j * lanes < count:
                put(3 * into * ROOM, ROOM, first + j * lanes, x[j], pool)

    def by_clusters(module: wp.Module, Block, product: wp.Function, bounded: bool) -> wp.Kernel:
        """The kernel `with_mass_product`; `product` sets what an element gives, `bounded`: registers go by THREADS."""

        @wp.kernel(module=module, launch_bounds=(ELEMENTS, THREADS[dtype] // ELEMENTS) if bounded else None)
        def with_mass_product(
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
            """c_M M p + (dq/dv) K p of straight elements, whose mass is one table times a number each.

            So many lanes do a cluster: a thread per element, or one alone.
            """
            world, index = wp.tid()
            if active[world] == 0:
                return
            cluster = index / lanes
            lane = index % lanes
            slot = slots_from(clusters, cluster, lane, lanes)
            begin = clusters.slot_start[cluster]
            count = clusters.slot_start[cluster + 1] - begin
            take_table(clusters, cluster, lane, lanes, pool)
            for first in range(lane, count, SLOTS_AT_ONCE * lanes):
                if first != lane:
                    slot = slots_from(clusters, cluster, first, lanes)
                take_field(u, U, slot, world, first, lanes, count, pool)
                take_field(direction, DIRECTION, slot, world, first, lanes, count, pool)
                if wp.static(fields == 3):
                    take_field(v, V, slot, world, first, lanes, count, pool)
            sync()
            first_elem = clusters.start[cluster]
            for elem in range(first_elem + lane, clusters.start[cluster + 1], lanes):
                dq = T(dq_dv[world])
                scale = T(mass_factor[world]) * block.density[elem]
                product(block, pool, history, dq, scale, world, elem, elem - first_elem)
            sync()
            for k in range(lane, count, lanes):
                f = vec3()
                for e in range(entry(SUM_START + k, pool), entry(SUM_START + k + 1, pool)):
                    f += get(FORCE, NS * ELEMENTS, entry(e, pool), pool)
                sums[world, clusters.offset + begin + k] = f

        return with_mass_product

    return _types.SimpleNamespace(
        Pool=Pool, fetch=fetch, set_force=set_force, add_force=add_force, by_clusters=by_clusters
    )
