"""Empty kernel, to measure the cost of a launch."""

import functools
import types as _types

import warp as wp

from .types import kernel_module

__all__ = ["empty_kernels"]


@functools.cache
def empty_kernels() -> _types.SimpleNamespace:
    """Kernel `empty`."""
    module = kernel_module("empty")

    @wp.kernel(module=module)
    def empty(flags: wp.array(dtype=wp.int32)):
        """Read one flag, write nothing."""
        if flags[0] > 1:
            flags[0] = 0

    return _types.SimpleNamespace(module=module, empty=empty)
