"""Shared structs: gather tables of slots, sparsity patterns, the balance of forces, the terms of a product H p."""

import functools

import warp as wp

from .modules import KernelSet, kernel_set
from .types import int_1d, precision

__all__ = [
    "IMPACT_FOUND",
    "IMPACT_IGNORED",
    "IMPACT_REPEATED",
    "RESTART_FOUND",
    "RESTART_REPEATED",
    "balance_struct",
    "pattern_struct",
    "product_terms_struct",
    "topology_struct",
]

RESTART_FOUND, IMPACT_FOUND, RESTART_REPEATED, IMPACT_REPEATED = 1, 2, 3, 4
"""Values of `impact` of the step control: what the scheme remembers of the step before does not fit the forces of the
attempt, or it does not resolve an impact; for the larger one that is found it is taken again, by backward Euler."""
IMPACT_IGNORED = -1
"""That attempt failed: it is as the scheme takes it."""


@functools.cache
def pattern_struct():
    """The sparsity pattern of a matrix of 3x3 blocks, by rows of slots (CSR)."""

    @wp.struct
    class Pattern:
        start: wp.array(dtype=wp.int32)  # [slot + 1] first entry of a row
        column: wp.array(dtype=wp.int32)  # [entry] slot of the column
        upper: wp.array(dtype=wp.vec4i)  # entries on and above the diagonal: (entry, its transpose, row, column)

    return Pattern


@functools.cache
def topology_struct(dtype: str):
    """Gather tables of slots (CSR): contributions of elements, rows of the mass matrix, the pool of terms.

    The pool is one array [world, entry] of the contributions of all terms with a potential to their slots.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class Topology:
        contribution_start: wp.array(dtype=wp.int32)  # [slot + 1] first contribution of a slot
        contribution_entry: wp.array(dtype=wp.int32)  # indices of the contributions, in a fixed order
        mass_start: wp.array(dtype=wp.int32)  # [slot + 1]
        mass_column: wp.array(dtype=wp.int32)
        mass_value: wp.array2d(dtype=T)  # [world or 0, entry] kg
        free: wp.array(dtype=vec3)  # [slot] 1 where a component is an unknown, 0 where prescribed
        prescribed_bits: wp.array(dtype=wp.uint8)  # [slot] bit k: component k is prescribed; `free` in one byte
        pool_start: wp.array(dtype=wp.int32)  # [slot + 1] first pool entry of a slot; with pooled terms
        pool_entry: wp.array(dtype=wp.int32)  # indices into the pool

    return Topology


@functools.cache
def entry_sum_function(dtype: str) -> wp.Function:
    """Device function: sum of the entries of a slot by a gather table."""
    p = precision(dtype)
    vec3 = p.vec3

    @wp.func
    def entry_sum(start: int_1d, entries: int_1d, values: p.vec3_2d, world: int, slot: int) -> vec3:
        """Sum of `values` [world, entry] over a slot's entries, in order."""
        s = vec3()
        for k in range(start[slot], start[slot + 1]):
            s += values[world, entries[k]]
        return s

    return entry_sum


@functools.cache
def mass_functions(dtype: str) -> KernelSet:
    """Device functions of the mass matrix of a world."""
    p = precision(dtype)
    T, vec3, Topology = p.T, p.vec3, topology_struct(dtype)

    @wp.func
    def mass_entry(topo: Topology, world: int, k: int) -> T:
        """Entry k of the matrix, kg."""
        return topo.mass_value[world % topo.mass_value.shape[0], k]

    @wp.func
    def mass_times(topo: Topology, x: p.vec3_2d, world: int, slot: int) -> vec3:
        """M x at a slot."""
        s = vec3()
        for k in range(topo.mass_start[slot], topo.mass_start[slot + 1]):
            s += mass_entry(topo, world, k) * x[world, topo.mass_column[k]]
        return s

    return kernel_set(locals())


@functools.cache
def free_components_function(dtype: str):
    """Device function: components of a vector by `Topology.free`."""
    T, vec3 = precision(dtype).T, precision(dtype).vec3

    @wp.func
    def free_components(free: vec3, new: vec3, old: vec3) -> vec3:
        """Components of `new` where free, else those of `old`."""
        out = new
        for k in range(3):
            if free[k] == T(0.0):
                out[k] = old[k]
        return out

    return free_components


@functools.cache
def balance_struct(dtype: str):
    """Balance of forces at an iterate, Eq. (17): inputs and parts, [world, slot]; forces in N."""
    vec3 = precision(dtype).vec3

    @wp.struct
    class Balance:
        u: wp.array2d(dtype=vec3)  # displacements, m
        v: wp.array2d(dtype=vec3)  # velocities, m/s
        v_tilde: wp.array2d(dtype=vec3)  # the inertia term is c_M M (v - v_tilde)
        dead: wp.array2d(dtype=vec3)  # loads independent of the iterate, and the sum of their magnitudes
        dead_magnitude: wp.array2d(dtype=vec3)
        nonpotential: wp.array2d(dtype=vec3)  # non-conservative forces, and their values frozen in a line search
        nonpotential_frozen: wp.array2d(dtype=vec3)
        direction: wp.array2d(dtype=vec3)  # p, search direction
        diagonal: wp.array2d(dtype=vec3)  # D, the diagonal of H, which weights the norms
        inertia: wp.array2d(dtype=vec3)  # inertia and internal force
        internal: wp.array2d(dtype=vec3)
        g: wp.array2d(dtype=vec3)  # the residual
        gradient: wp.array2d(dtype=vec3)  # of the augmented potential: right side of the Newton step
        pool_force: wp.array2d(dtype=vec3)  # [world, entry] forces of pooled terms
        rows: wp.array3d(dtype=wp.float64)  # [row, world, slot] to be summed
        mass_factor: wp.array(dtype=wp.float64)  # [world] c_M of the inertia term, 1/s
        dq_dv: wp.array(dtype=wp.float64)  # [world] derivative of the end displacement by the velocity, s
        gap_displacement: wp.float64  # displacement whose round-off is that of a gap, a difference of positions, m

    return Balance


@functools.cache
def product_terms_struct(dtype: str):
    """Parts of a product H p beyond the elements: inertia, and tangents of the terms times p."""
    vec3 = precision(dtype).vec3

    @wp.struct
    class ProductTerms:
        contribution_start: wp.array(dtype=wp.int32)  # [slot + 1] of non-conservative forces
        contribution_entry: wp.array(dtype=wp.int32)  # indices into their contributions
        contribution: wp.array2d(dtype=vec3)  # [world, entry] their tangent times p
        pool_start: wp.array(dtype=wp.int32)  # as in Topology; with pooled terms
        pool_entry: wp.array(dtype=wp.int32)
        pool: wp.array2d(dtype=vec3)  # [world, entry] K p of pooled terms
        mass_factor: wp.array(dtype=wp.float64)  # [world] c_M of the inertia term, 1/s
        dq_dv: wp.array(dtype=wp.float64)  # [world] derivative of the end displacement by the velocity, s
        warp_lanes: wp.int32  # number of threads per partial sum

    return ProductTerms
