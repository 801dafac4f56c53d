"""Empty kernel, to measure the cost of a launch."""

import functools

import warp as wp

from .modules import KernelSet, kernel_module, kernel_set
from .types import int_1d

__all__ = ["empty_kernels"]


@functools.cache
def empty_kernels() -> KernelSet:
    """Kernel `empty`."""
    module = kernel_module("empty")

    @wp.kernel(module=module)
    def empty(flags: int_1d):
        """Read one flag, write nothing."""
        if flags[0] > 1:
            flags[0] = 0

    return kernel_set(locals())
