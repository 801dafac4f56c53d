"""Products H p by clusters of elements: a cluster reads each of its slots once and writes one sum of forces per slot.

A cluster is a run of elements that one block of threads processes. The fields at its slots and the forces of its
elements lie in shared memory; the forces are summed per slot in a fixed order. The number of sums is about a third of
that of element forces, and elements read their slots without global addresses. On the CPU one thread processes a
cluster, and arrays replace the shared memory.
"""

import functools
from collections.abc import Callable

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import KernelSet, kernel_set
from ..common.types import double_1d, int_1d, precision
from .element_slots import iterate_struct

__all__ = [
    "CLUSTER_SIZE",
    "DIRECTION",
    "DISPLACEMENT",
    "VELOCITY",
    "cluster_functions",
    "cluster_size",
    "cluster_struct",
    "pool_size",
    "pool_struct",
    "slot_capacity",
    "table_layout",
]

CLUSTER_SIZE = {"float64": 64, "float32": 128}
"""Elements of a cluster and threads of its block: the size of best GPU occupancy given shared memory and registers."""
SLOT_CAPACITY_FACTOR = {32: 24, 64: 32, 128: 46}
"""Slot capacity of a cluster, by its number of elements, in multiples of the slots of one element."""
SHARED_BYTES = 48 * 1024
"""Largest static shared memory of a CUDA block."""
RESIDENT_THREADS = {"float64": 384, "float32": 640}
"""Threads that must fit on a multiprocessor at once: bounds the registers of a thread."""
DISPLACEMENT, DIRECTION, VELOCITY = 0, 1, 2
"""The fields at the slots of a cluster: displacement, direction p, velocity."""
COPY_WORDS = 4
"""32-bit words of a table copied at once."""


def cluster_size(dtype: str, count: int, *, fit: bool) -> int:
    """Cluster size for an element block of `count` elements.

    `fit`: small element blocks get small clusters, so that few threads idle when thousands of worlds run at once.
    """
    return min(
        n for n in SLOT_CAPACITY_FACTOR if n == CLUSTER_SIZE[dtype] or (fit and count <= n < CLUSTER_SIZE[dtype])
    )


def slot_capacity(size: int, slots: int) -> int:
    """Maximum number of slots of a cluster of `size` elements with `slots` slots each."""
    return slots * SLOT_CAPACITY_FACTOR[size]


def pool_size(size: int, slots: int, fields: int) -> int:
    """Size of a cluster's memory: the fields at its slots, and the forces of its elements."""
    return 3 * (fields * slot_capacity(size, slots) + slots * size)


def table_layout(size: int, slots: int) -> tuple[int, int, int]:
    """Layout of a cluster's table: start of `place` and `sum_start` (16-bit numbers), and its 32-bit words."""
    place = slots * size
    words = place + slot_capacity(size, slots) // 2 + 1
    return place, 2 * place, COPY_WORDS * -(-words // COPY_WORDS)


@functools.cache
def cluster_struct():
    """Clusters of an element block.

    The table of a cluster holds three lists of 16-bit numbers: `sum_entry`, force indices local * size + element in the
    order of summation by slot; `place` [local, element], index of an element's slot among those of the cluster;
    `sum_start` [slot + 1], start of the forces on a slot in `sum_entry`.
    """

    @wp.struct
    class Clusters:
        element_start: wp.array(dtype=wp.int32)  # [cluster + 1] first element
        slot_start: wp.array(dtype=wp.int32)  # [cluster + 1] first sum, numbered within the block
        slot: wp.array2d(dtype=wp.int32)  # [cluster, position] slot; rows are padded with their last slot
        table: wp.array(dtype=wp.int32)  # [cluster * words]
        sum_offset: wp.int32  # of the block's sums among those of all blocks

    return Clusters


@functools.cache
def pool_struct(dtype: str):
    """Arrays that replace shared memory on the CPU; on CUDA they have one element and are unused."""
    T = precision(dtype).T

    @wp.struct
    class Pool:
        numbers: wp.array(dtype=T)
        table: wp.array(dtype=wp.int32)

    return Pool


def _pool_access(dtype: str, size: int) -> Callable:
    """Device function access: access(1, k, x, spare) stores x as number k, access(0, k, x, spare) returns it."""
    T = precision(dtype).T
    scalar = {"float64": "double", "float32": "float"}[dtype]
    # one function for both: two functions would declare two separate shared arrays
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
    def access(store: int, k: int, x: T, spare: wp.array(dtype=T)) -> T:
        """Store x as number k of the pool if `store` is set, and return number k."""

    return access


def _table_access(words: int) -> Callable:
    """Device function access for the table of a cluster.

    access(1, k, first, source, spare) copies its words COPY_WORDS k .. COPY_WORDS (k + 1) - 1 from the source, where
    the table begins at word `first`; access(0, k, first, source, spare) returns its 16-bit number k.
    """
    n = COPY_WORDS
    snippet = f"""
    #if defined(__CUDA_ARCH__)
    __shared__ __align__(16) int table[{words}];
    if (copy) {{ ((int4*)table)[k] = ((const int4*)(source.data + first))[k]; return 0; }}
    #else
    int* table = spare.data;
    if (copy) {{ for (int i = {n} * k; i < {n} * k + {n}; ++i) table[i] = source.data[first + i]; return 0; }}
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
    def access(copy: int, k: int, first: int, source: int_1d, spare: int_1d) -> int:
        """Copy COPY_WORDS words of the table if `copy` is set, else return its 16-bit number k."""

    return access


@functools.cache
def cluster_functions(dtype: str, size: int, slots: int, fields: int) -> KernelSet:
    """Functions for kernels of elements with `slots` slots each that are processed in clusters of `size` elements.

    On the device, `fetch(pool, field, i, at)` returns a field (DISPLACEMENT, DIRECTION, VELOCITY) at slot i of element
    `at` of the cluster; `set_force` and `add_force(pool, i, at, f)` store and add to the force of that element on its
    slot i. On the host, `make_product_kernel(module, Block, product, bounded)` makes the kernel.
    """
    p = precision(dtype)
    T, vec3, sym6 = p.T, p.vec3, p.sym
    Clusters, Pool, Iterate = cluster_struct(), pool_struct(dtype), iterate_struct(dtype)
    sync = lane_functions(dtype).sync
    NS, ELEMENTS, ROOM = slots, size, slot_capacity(size, slots)
    PLACE, SUM_START, WORDS = table_layout(size, slots)
    FORCES_START = 3 * fields * ROOM
    numbers = pool_size(size, slots, fields)
    assert numbers * (8 if dtype == "float64" else 4) + 4 * WORDS < SHARED_BYTES, "a cluster exceeds shared memory"
    number = _pool_access(dtype, numbers)
    bits = _table_access(WORDS)
    # loads in flight per thread before the first use
    SLOTS_AT_ONCE, COPIES_AT_ONCE = -(-ROOM // ELEMENTS), -(-WORDS // (COPY_WORDS * ELEMENTS))
    Slots = wp.types.vector(length=SLOTS_AT_ONCE, dtype=wp.int32)
    Values = wp.types.matrix(shape=(SLOTS_AT_ONCE, 3), dtype=T)

    @wp.func
    def store_vector(first: int, stride: int, at: int, x: vec3, pool: Pool):
        """Store x; its component k is number first + k * stride + at of the pool."""
        for k in range(3):
            number(1, first + k * stride + at, x[k], pool.numbers)

    @wp.func
    def load_vector(first: int, stride: int, at: int, pool: Pool) -> vec3:
        """Vector stored by `store_vector`."""
        x = vec3()
        for k in range(3):
            x[k] = number(0, first + k * stride + at, T(0.0), pool.numbers)
        return x

    @wp.func
    def table_entry(k: int, pool: Pool) -> int:
        """16-bit number k of the cluster's table."""
        return bits(0, k, 0, pool.table, pool.table)

    @wp.func
    def fetch(pool: Pool, field: int, i: int, at: int) -> vec3:
        """Field value at slot i of element `at` of the cluster."""
        return load_vector(3 * field * ROOM, ROOM, table_entry(PLACE + i * ELEMENTS + at, pool), pool)

    @wp.func
    def set_force(pool: Pool, i: int, at: int, f: vec3):
        """Store the force of element `at` on its slot i."""
        store_vector(FORCES_START + i * ELEMENTS, NS * ELEMENTS, at, f, pool)

    @wp.func
    def add_force(pool: Pool, i: int, at: int, f: vec3):
        """Add to the force of element `at` on its slot i."""
        set_force(pool, i, at, load_vector(FORCES_START + i * ELEMENTS, NS * ELEMENTS, at, pool) + f)

    @wp.func
    def copy_table(clusters: Clusters, cluster: int, lane: int, lanes: int, pool: Pool):
        """Copy the table of a cluster into the memory of the block; the lanes share the work."""
        for first in range(lane, WORDS / COPY_WORDS, COPIES_AT_ONCE * lanes):
            for j in range(COPIES_AT_ONCE):
                if first + j * lanes < WORDS / COPY_WORDS:
                    bits(1, first + j * lanes, cluster * WORDS, clusters.table, pool.table)

    @wp.func
    def load_slots(clusters: Clusters, cluster: int, first: int, lanes: int) -> Slots:
        """Next SLOTS_AT_ONCE slots of a lane, at the indices first, first + lanes, ... of the cluster."""
        slot = Slots()
        for j in range(SLOTS_AT_ONCE):
            slot[j] = clusters.slot[cluster, wp.min(first + j * lanes, ROOM - 1)]
        return slot

    @wp.func
    def copy_field(
        field: p.vec3_2d, into: int, slot: Slots, world: int, first: int, lanes: int, count: int, pool: Pool
    ):
        """Copy a field at these slots into the memory of the block, as field number `into`.

        All loads are started before the first value is stored, so that they overlap.
        """
        x = Values()
        for j in range(SLOTS_AT_ONCE):
            x[j] = field[world, slot[j]]
        for j in range(SLOTS_AT_ONCE):
            if first + j * lanes < count:
                store_vector(3 * into * ROOM, ROOM, first + j * lanes, x[j], pool)

    def make_product_kernel(module: wp.Module, Block, product: wp.Function, bounded: bool) -> wp.Kernel:
        """Kernel `with_mass_product`.

        `product` is the device function that sets the forces of one element; `bounded`: registers per thread are
        limited so that RESIDENT_THREADS threads fit on a multiprocessor.
        """

        @wp.kernel(module=module, launch_bounds=(ELEMENTS, RESIDENT_THREADS[dtype] // ELEMENTS) if bounded else None)
        def with_mass_product(
            block: Block, clusters: Clusters, iterate: Iterate, mass_factor: double_1d, active: int_1d,
            direction: p.vec3_2d, lanes: int, pool: Pool, sums: p.vec3_2d,
        ):  # fmt: skip
            """(c_M M + (dq/dv) K) p of straight elements, one sum per slot of each cluster.

            The mass of a straight element is the table of its parent times rho det J0. `lanes` threads process a
            cluster: one per element on CUDA, one for all on the CPU.
            """
            world, index = wp.tid()
            if active[world] == 0:
                return
            cluster = index / lanes
            lane = index % lanes
            slot = load_slots(clusters, cluster, lane, lanes)
            begin = clusters.slot_start[cluster]
            count = clusters.slot_start[cluster + 1] - begin
            copy_table(clusters, cluster, lane, lanes, pool)
            for first in range(lane, count, SLOTS_AT_ONCE * lanes):
                if first != lane:
                    slot = load_slots(clusters, cluster, first, lanes)
                copy_field(iterate.u, DISPLACEMENT, slot, world, first, lanes, count, pool)
                copy_field(direction, DIRECTION, slot, world, first, lanes, count, pool)
                if wp.static(fields == 3):
                    copy_field(iterate.v, VELOCITY, slot, world, first, lanes, count, pool)
            sync()
            first_elem = clusters.element_start[cluster]
            for elem in range(first_elem + lane, clusters.element_start[cluster + 1], lanes):
                dq = T(iterate.dq_dv[world])
                scale = T(mass_factor[world]) * block.density_det_J0[world % block.density_det_J0.shape[0], elem]
                product(block, pool, iterate.history, dq, scale, active[world], world, elem, elem - first_elem)
            sync()
            for k in range(lane, count, lanes):
                f = vec3()
                for e in range(table_entry(SUM_START + k, pool), table_entry(SUM_START + k + 1, pool)):
                    f += load_vector(FORCES_START, NS * ELEMENTS, table_entry(e, pool), pool)
                sums[world, clusters.sum_offset + begin + k] = f

        return with_mass_product

    return kernel_set(locals())
