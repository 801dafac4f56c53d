"""Masked copies of the state; arrays of any type are copied as rows of 32-bit words."""

import functools
import types as _types

import warp as wp

from .types import int_1d, kernel_module, kernel_set

__all__ = ["state_kernels"]


@functools.cache
def state_kernels() -> _types.SimpleNamespace:
    """Kernels for state arrays as [world, word]."""
    module = kernel_module("state")

    @wp.kernel(module=module)
    def copy_rows(flags: int_1d, source: wp.array2d(dtype=wp.uint32), target: wp.array2d(dtype=wp.uint32)):
        """Copy the rows of the flagged worlds."""
        world, word = wp.tid()
        if flags[world] != 0:
            target[world, word] = source[world, word]

    @wp.kernel(module=module)
    def clear_rows(flags: int_1d, target: wp.array2d(dtype=wp.uint32)):
        """Set the rows of the flagged worlds to zero."""
        world, word = wp.tid()
        if flags[world] != 0:
            target[world, word] = wp.uint32(0)

    return kernel_set(locals())
