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
    T, module = p.T, kernel_module(f"fields_{dtype}")

    def gather(name: str, kind) -> wp.Kernel:
        """Kernel `name` of sums of numbers or tensors of a type."""

        def gather_sums(
            start: int_1d, column: int_1d, weight: p.scalar_1d, count: int, values: wp.array3d(dtype=kind),
            out: wp.array2d(dtype=kind),
        ):  # fmt: skip
            """out[world, row] += sum of weight times values[world, point, elem], column point * count + elem."""
            world, row = wp.tid()
            total = kind(T(0.0))
            for k in range(start[row], start[row + 1]):
                total += weight[k] * values[world, column[k] // count, column[k] % count]
            out[world, row] = out[world, row] + total

        return wp.Kernel(gather_sums, f"gather_{name}", module)

    scalars, symmetric, matrices = (
        gather(name, kind) for name, kind in (("scalars", T), ("symmetric", p.sym), ("matrices", p.mat33))
    )
    return kernel_set(locals())
