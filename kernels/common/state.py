"""Masked copies of the state; arrays of any type are copied as rows of 32-bit words."""

import functools

import warp as wp

from .modules import KernelSet, kernel_module, kernel_set, masked_kernel
from .types import int_1d

__all__ = ["state_kernels"]


@functools.cache
def state_kernels() -> KernelSet:
    """Kernels for state arrays as [world, word]."""
    module = kernel_module("state")

    @masked_kernel(module, "flags")
    def copy_rows(flags: int_1d, source: wp.array2d(dtype=wp.uint32), target: wp.array2d(dtype=wp.uint32)):
        """Copy the rows of the flagged worlds."""
        world, word = wp.tid()
        target[world, word] = source[world, word]

    @masked_kernel(module, "flags")
    def clear_rows(flags: int_1d, target: wp.array2d(dtype=wp.uint32)):
        """Set the rows of the flagged worlds to zero."""
        world, word = wp.tid()
        target[world, word] = wp.uint32(0)

    return kernel_set(locals())
