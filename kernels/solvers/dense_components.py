"""Block-diagonal matrices of uncoupled components, each a dense matrix: [world component, i, j]."""

import functools

import warp as wp

from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct
from ..common.types import int_1d, int_2d, precision

__all__ = ["dense_component_kernels"]


@functools.cache
def dense_component_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision. `slot`: [component, position] or -1; `component_of`, `position_of`: [slot]."""
    p = precision(dtype)
    T, mat33 = p.T, p.mat33
    Pattern = pattern_struct()
    scalar_sum = lane_functions(dtype).scalar_sum
    module = kernel_module(f"dense_components_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.kernel(module=module)
    def copy_flags_to_components(flags: int_1d, out: int_1d):
        """World flags copied to each component."""
        block = wp.tid()
        out[block] = flags[block / (out.shape[0] / flags.shape[0])]

    @wp.kernel(module=module)
    def fill_components(
        pattern: Pattern, value: p.mat33_2d, slot: int_2d,
        position_of: int_1d, flags: int_1d, scale: p.scalar_2d,
        matrix: p.scalar_3d,
    ):  # fmt: skip
        """A as dense matrices, and its diagonal; rows without a slot are zero."""
        block, row = wp.tid()
        if flags[block] == 0:
            return
        for j in range(matrix.shape[2]):
            matrix[block, row, j] = T(0.0)
        scale[block, row] = T(0.0)
        position = row / 3
        component = block % slot.shape[0]
        if position >= slot.shape[1]:
            return
        own = slot[component, position]
        if own < 0:
            return
        i = row % 3
        for k in range(pattern.start[own], pattern.start[own + 1]):
            A = value[block / slot.shape[0], k]
            other = pattern.column[k]
            for j in range(3):
                matrix[block, row, 3 * position_of[other] + j] = A[i, j]
            if other == own:
                scale[block, row] = A[i, i]

    @masked_kernel(module, "active")
    def apply_component_inverses(
        matrix: p.scalar_3d, slot: int_2d, lanes: int, r: p.scalar_2d,
        active: int_1d, x: p.scalar_2d,
    ):  # fmt: skip
        """x = A^-1 r with dense inverses, `lanes` threads per row."""
        world, index = wp.tid()
        n = 3 * slot.shape[1]
        row = wp.min(index / lanes, slot.shape[0] * n - 1)
        component = row / n
        i = row % n
        own = slot[component, i / 3]
        block = world * slot.shape[0] + component
        s = T(0.0)
        if own >= 0:
            for j in range(index % lanes, n, lanes):
                other = slot[component, j / 3]
                if other >= 0:
                    s += matrix[block, i, j] * r[world, 3 * other + j % 3]
        s = scalar_sum(s, lanes)
        if index % lanes == 0 and own >= 0:
            x[world, 3 * own + i % 3] = s

    return kernel_set(locals())
