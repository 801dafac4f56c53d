"""Fields at nodes and drawn points: weighted sums of the values at the quadrature points of a block."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set
from ..common.types import int_1d, precision

__all__ = ["field_kernels"]


@functools.cache
def field_kernels(dtype: str) -> KernelSet:
    """Kernels of fields in one precision."""
    p = precision(dtype)
    T, sym6, mat33 = p.T, p.sym, p.mat33
    module = kernel_module(f"fields_{dtype}")

    @wp.kernel(module=module)
    def gather_scalars(
        start: int_1d, column: int_1d, weight: p.scalar_1d, count: int, values: p.scalar_3d, out: p.scalar_2d
    ):
        """out[world, row] += sum of weight times values[world, point, elem], column point * count + elem."""
        world, row = wp.tid()
        total = T(0.0)
        for k in range(start[row], start[row + 1]):
            total += weight[k] * values[world, column[k] // count, column[k] % count]
        out[world, row] = out[world, row] + total

    @wp.kernel(module=module)
    def gather_symmetric(
        start: int_1d, column: int_1d, weight: p.scalar_1d, count: int, values: wp.array3d(dtype=sym6), out: p.sym_2d
    ):
        """As gather_scalars, of tensors in Voigt order."""
        world, row = wp.tid()
        total = sym6()
        for k in range(start[row], start[row + 1]):
            total += weight[k] * values[world, column[k] // count, column[k] % count]
        out[world, row] = out[world, row] + total

    @wp.kernel(module=module)
    def gather_matrices(
        start: int_1d, column: int_1d, weight: p.scalar_1d, count: int, values: wp.array3d(dtype=mat33), out: p.mat33_2d
    ):
        """As gather_scalars, of matrices."""
        world, row = wp.tid()
        total = mat33()
        for k in range(start[row], start[row + 1]):
            total += weight[k] * values[world, column[k] // count, column[k] % count]
        out[world, row] = out[world, row] + total

    return kernel_set(locals())
