"""Masked copies of the state; arrays of any type are copied as rows of 32-bit words."""

import functools
import types as _types

import warp as wp

from .types import kernel_module

__all__ = ["state_kernels"]


@functools.cache
def state_kernels() -> _types.SimpleNamespace:
    """Kernels for state arrays as [world, word]."""
    module = kernel_module("state")

    @wp.kernel(module=module)
    def copy_rows(
        flags: wp.array(dtype=wp.int32), source: wp.array2d(dtype=wp.uint32), target: wp.array2d(dtype=wp.uint32)
    ):
        """Copy the rows of the flagged worlds."""
        world, word = wp.tid()
        if flags[world] != 0:
            target[world, word] = source[world, word]

    @wp.kernel(module=module)
    def clear_rows(flags: wp.array(dtype=wp.int32), target: wp.array2d(dtype=wp.uint32)):
        """Set the rows of the flagged worlds to zero."""
        world, word = wp.tid()
        if flags[world] != 0:
            target[world, word] = wp.uint32(0)

    return _types.SimpleNamespace(module=module, copy_rows=copy_rows, clear_rows=clear_rows)
