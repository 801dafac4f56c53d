"""Values of an element's slots, and the contributions of an element to them."""

import functools

import warp as wp

from ..common.types import precision

__all__ = ["slot_access_functions", "slot_values_type"]


@functools.cache
def slot_values_type(dtype: str, slots: int):
    """Slot values of an element: a matrix with one row per slot."""
    return wp.types.matrix(shape=(slots, 3), dtype=precision(dtype).T)


@functools.cache
def slot_access_functions(dtype: str, slots: int, Block) -> tuple[wp.Function, wp.Function, wp.Function]:
    """Functions load_slots(block, field, world, elem), load_last_change and store_forces, see below.

    Args:
        Block: struct of the elements, with conn, is_position, contribution_offset and count.
    """
    p, Local, NS = precision(dtype), slot_values_type(dtype, slots), slots

    @wp.func
    def load_slots(block: Block, field: p.vec3_2d, world: int, elem: int) -> Local:
        """Slot values of an element; positions relative to the first slot, so that a translation has no strain."""
        U = Local()
        first = field[world, block.conn[0, elem]]
        for i in range(NS):
            U[i] = field[world, block.conn[i, elem]] - block.is_position[i] * first
        return U

    @wp.func
    def load_last_change(
        block: Block, v: p.vec3_2d, base: p.vec3_2d, use_prediction: int, dq: p.T, world: int, elem: int
    ) -> Local:
        """Change of an element's slots in the last iteration, m, if `use_prediction` is 1; else zeros."""
        step = Local()
        if use_prediction == 1:
            step = dq * (load_slots(block, v, world, elem) - load_slots(block, base, world, elem))
        return step

    @wp.func
    def store_forces(block: Block, f: Local, world: int, elem: int, contribution: p.vec3_2d):
        """Forces on the slots of an element, into its entries of the contributions."""
        for i in range(NS):
            contribution[world, block.contribution_offset + i * block.count + elem] = f[i]

    return load_slots, load_last_change, store_forces
