"""Kernels that skip the worlds whose flag is 0."""

import uuid

import pytest
import warp as wp
from warpfea.kernels.common.modules import kernel_module, masked_kernel
from warpfea.kernels.common.types import double_2d, int_1d


@wp.struct
class Control:
    running: wp.array(dtype=wp.int32)


def new_module():
    """A module that no cache has: the cache knows the source of a kernel, not how its mask is made."""
    return kernel_module(f"test_masks_{uuid.uuid4().hex}")


def mask_of_an_argument():
    @masked_kernel(new_module(), "active")
    def mark(active: int_1d, out: double_2d):
        """1 in each row of a world."""
        world, row = wp.tid()
        out[world, row] = wp.float64(1.0)

    return mark


def mask_of_a_member():
    @masked_kernel(new_module(), "control.running")
    def mark(control: Control, out: double_2d):
        """1 in each row of a world."""
        world, row = wp.tid()
        out[world, row] = wp.float64(1.0)

    return mark


@pytest.mark.parametrize("kind", [mask_of_an_argument, mask_of_a_member])
def test_worlds_without_a_flag_are_skipped(kind):
    flags = wp.array([1, 0, 2, 0], dtype=wp.int32, device="cpu")
    given = flags
    if kind is mask_of_a_member:
        given = Control()
        given.running = flags
    out = wp.zeros((4, 3), dtype=wp.float64, device="cpu")
    wp.launch(kind(), dim=(4, 3), inputs=[given, out], device="cpu")
    assert out.numpy().tolist() == [[1.0] * 3, [0.0] * 3, [1.0] * 3, [0.0] * 3]
