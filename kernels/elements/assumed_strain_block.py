"""Tables of elements with assumed shears, see assumed_strain.py, and the shears at their tying points."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import precision
from .element_slots import slot_values_type

__all__ = ["assumed_shear_functions", "assumed_strain_struct", "coupling_entry_function"]


@functools.cache
def assumed_strain_struct(dtype: str, dissipative: bool = False):
    """Constant data of a block of such elements, in one precision; `dissipative`: see `assumed_strain_kernels`."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class AssumedStrainBlock:
        conn: wp.array2d(dtype=wp.int32)  # [local, elem] slot
        is_position: wp.array(dtype=T)  # [local]
        derivative_a: wp.array3d(dtype=T)  # [tie, local, elem] ds_i/dxi_a
        derivative_b: wp.array3d(dtype=T)  # [tie, local, elem] ds_i/dxi_b
        X_a: wp.array2d(dtype=vec3)  # [tie, elem] reference X_a
        X_b: wp.array2d(dtype=vec3)  # [tie, elem] reference X_b
        coupling: wp.array3d(dtype=T)  # [tie, k, elem] A, k within the tie's run of ties; or world by world
        material: wp.array(dtype=wp.int32)  # [elem]
        coefficients: wp.array3d(dtype=T)  # [world or 0, material, NCOEF]; the first is mu
        contribution_offset: wp.int32
        element_offset: wp.int32
        history_offset: wp.int32
        count: wp.int32
        if dissipative:
            dissipation: T  # chi of kernels/elements/energy_momentum.py

    return AssumedStrainBlock


@functools.cache
def coupling_entry_function(dtype: str, worlds: bool, dissipative: bool = False) -> wp.Function:
    """Device function of an entry of A; `worlds`: A differs between worlds."""
    T, Block = precision(dtype).T, assumed_strain_struct(dtype, dissipative)

    @wp.func
    def coupling_entry(block: Block, tie: int, k: int, world: int, elem: int) -> T:
        """Entry k of a tie's row of A, within its run of coupled ties."""
        if wp.static(worlds):
            return block.coupling[tie, k, world * block.count + elem]
        else:
            return block.coupling[tie, k, elem]

    return coupling_entry


@functools.cache
def assumed_shear_functions(dtype: str, slots: int, ties: int, dissipative: bool = False) -> KernelSet:
    """Device functions of the shears; arguments as those of `assumed_strain_kernels`."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Block, Local = assumed_strain_struct(dtype, dissipative), slot_values_type(dtype, slots)
    Ties = wp.types.vector(length=ties, dtype=T)
    TieVectors = wp.types.matrix(shape=(ties, 3), dtype=T)
    NS, NT = slots, ties

    @wp.func
    def directional_derivative(table: p.scalar_3d, U: Local, tie: int, elem: int) -> vec3:
        """sum_i s_i,a u_i at a tie, with `table` the derivatives along one direction: contribution of U to x_a, m."""
        out = vec3()
        for i in range(NS):
            out += table[tie, i, elem] * U[i]
        return out

    @wp.func
    def kinematics(block: Block, U: Local, elem: int):
        """x_a, x_b (m) and the shears e (m^2) at the ties; e is formed without cancellation."""
        first, second = TieVectors(), TieVectors()
        e = Ties()
        for t in range(NT):
            a = directional_derivative(block.derivative_a, U, t, elem)
            d = directional_derivative(block.derivative_b, U, t, elem)
            first[t] = block.X_a[t, elem] + a
            second[t] = block.X_b[t, elem] + d
            e[t] = wp.dot(block.X_a[t, elem], d) + wp.dot(a, second[t])
        return first, second, e

    @wp.func
    def add_second_order(block: Block, D: Local, e: Ties, sign: T, elem: int) -> Ties:
        """Shears e plus `sign` times those of second order in a change D of the slots, m^2.

        1, with the half change of a step and the shears at its midpoint: the mean of those at both ends. -1, with the
        last change: the linear prediction from the previous iterate.
        """
        out = e
        for t in range(NT):
            out[t] = out[t] + sign * wp.dot(
                directional_derivative(block.derivative_a, D, t, elem),
                directional_derivative(block.derivative_b, D, t, elem),
            )
        return out

    @wp.func
    def step_shears(block: Block, x1: TieVectors, x2: TieVectors, D: Local, e: Ties, elem: int) -> Ties:
        """Shears in the stresses of a step, m^2: the mean, plus chi/2 of their change."""
        out = add_second_order(block, D, e, T(1.0), elem)
        if wp.static(dissipative):
            for t in range(NT):
                change = wp.dot(x1[t], directional_derivative(block.derivative_b, D, t, elem)) + wp.dot(
                    x2[t], directional_derivative(block.derivative_a, D, t, elem)
                )
                out[t] = out[t] + block.dissipation * change
        return out

    return kernel_set(locals())
