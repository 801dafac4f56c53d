"""Values of an element's slots, and the contributions of an element to them."""

import functools

import warp as wp

from ..common.types import precision

__all__ = ["iterate_struct", "slot_access_functions", "slot_values_type"]


@functools.cache
def slot_values_type(dtype: str, slots: int):
    """Slot values of an element: a matrix with one row per slot."""
    return wp.types.matrix(shape=(slots, 3), dtype=precision(dtype).T)


@functools.cache
def iterate_struct(dtype: str):
    """Iterate at which elements are evaluated; fields are [world, slot]."""
    p = precision(dtype)

    @wp.struct
    class Iterate:
        u: p.vec3_2d  # displacements, m; of a midpoint scheme those at the midpoint
        v: p.vec3_2d  # velocities, m/s; of a midpoint scheme half of the change of u, m
        base: p.vec3_2d  # v at the previous iterate, m/s
        use_prediction: wp.array(dtype=wp.int32)  # [world] 1: stress of the linear prediction; 2: without compression
        history: p.sym_2d  # [world, point] reference strains of incremental strain rates
        dq_dv: wp.array(dtype=wp.float64)  # [world] derivative of the end displacement by the velocity, s

    return Iterate


@functools.cache
def slot_access_functions(dtype: str, slots: int, Block) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Functions load_slots(block, field, world, elem), load_last_change and store_forces, see below.

    Args:
        Block: struct of the elements, with conn, is_position, contribution_offset and count.
    """
    p, Local, NS = precision(dtype), slot_values_type(dtype, slots), slots
    Iterate = iterate_struct(dtype)

    @wp.func
    def load_slots(block: Block, field: p.vec3_2d, world: int, elem: int) -> Local:
        """Slot values of an element; positions relative to the first slot, so that a translation has no strain."""
        U = Local()
        first = field[world, block.conn[0, elem]]
        for i in range(NS):
            U[i] = field[world, block.conn[i, elem]] - block.is_position[i] * first
        return U

    @wp.func
    def load_last_change(block: Block, iterate: Iterate, world: int, elem: int) -> Local:
        """Change of an element's slots in the last iteration, m, if `use_prediction` is 1; else zeros."""
        step = Local()
        if iterate.use_prediction[world] == 1:
            change = load_slots(block, iterate.v, world, elem) - load_slots(block, iterate.base, world, elem)
            step = p.T(iterate.dq_dv[world]) * change
        return step

    @wp.func
    def store_forces(block: Block, f: Local, world: int, elem: int, contribution: p.vec3_2d):
        """Forces on the slots of an element, into its entries of the contributions."""
        for i in range(NS):
            contribution[world, block.contribution_offset + i * block.count + elem] = f[i]

    return load_slots, load_last_change, store_forces
