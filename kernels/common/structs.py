"""What kernels of slots share: who contributes to a slot, patterns of matrices, the balance of forces."""

import functools

import warp as wp

from .types import precision

__all__ = ["additions_struct", "balance_struct", "pattern_struct", "topology_struct"]


@functools.cache
def pattern_struct():
    """Rows of a matrix of 3x3 blocks."""

    @wp.struct
    class Pattern:
        start: wp.array(dtype=wp.int32)  # [slot + 1]
        column: wp.array(dtype=wp.int32)  # [entry] slot
        upper: wp.array(dtype=wp.vec4i)  # entry, its mirror, row, column; of the diagonal and above

    return Pattern


@functools.cache
def topology_struct(dtype: str):
    """Who contributes to a slot, the scalar mass matrix in CSR, and which components are free."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class Topology:
        start: wp.array(dtype=wp.int32)  # [slot + 1]
        entry: wp.array(dtype=wp.int32)  # indices into the contributions
        mass_start: wp.array(dtype=wp.int32)  # [slot + 1]
        mass_column: wp.array(dtype=wp.int32)
        mass_value: wp.array(dtype=T)  # kg
        free: wp.array(dtype=vec3)  # [slot] 1 where a component is an unknown, 0 where prescribed
        held: wp.array(dtype=wp.uint8)  # [slot] bit k is set where component k is prescribed

    return Topology


@functools.cache
def balance_struct(dtype: str):
    """The balance of forces at an iterate, [world, slot]: what it is made of, and its parts."""
    vec3 = precision(dtype).vec3

    @wp.struct
    class Balance:
        u: wp.array2d(dtype=vec3)
        v: wp.array2d(dtype=vec3)
        v_tilde: wp.array2d(dtype=vec3)
        dead: wp.array2d(dtype=vec3)  # loads that do not depend on the iterate, and the sum of their magnitudes
        dead_magnitude: wp.array2d(dtype=vec3)
        nonpotential: wp.array2d(dtype=vec3)  # forces without a potential, and those that Phi holds in a line search
        nonpotential_held: wp.array2d(dtype=vec3)
        direction: wp.array2d(dtype=vec3)  # of the search
        diagonal: wp.array2d(dtype=vec3)  # D
        inertia: wp.array2d(dtype=vec3)
        internal: wp.array2d(dtype=vec3)
        g: wp.array2d(dtype=vec3)
        gradient: wp.array2d(dtype=vec3)
        rows: wp.array3d(dtype=wp.float64)  # [row, world, slot] to be summed
        mass_factor: wp.array(dtype=wp.float64)  # [world]
        dq_dv: wp.array(dtype=wp.float64)

    return Balance


@functools.cache
def additions_struct(dtype: str):
    """What a product needs besides the elements' part: factors, and the tangents of follower loads."""
    vec3 = precision(dtype).vec3

    @wp.struct
    class Additions:
        start: wp.array(dtype=wp.int32)  # of follower loads: [slot + 1]
        entry: wp.array(dtype=wp.int32)  # indices into their contributions
        contribution: wp.array2d(dtype=vec3)
        mass_factor: wp.array(dtype=wp.float64)  # [world]
        dq_dv: wp.array(dtype=wp.float64)
        warp: wp.int32  # threads that a partial sum stands for

    return Additions
