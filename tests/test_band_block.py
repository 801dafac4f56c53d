"""Factors of bands by a block of threads per world (one thread does the same on the CPU), against numpy."""

import numpy as np
import pytest
import warp as wp

from warpfea.kernels.solvers.band import BLOCK, band_kernels, column_type
from warpfea.kernels.solvers.band_block import band_block_kernels, window_numbers

SLOTS, WIDTH = 13, 3
ROWS = -(-3 * SLOTS // BLOCK)


def banded(rng, worlds, indefinite=False):
    """Matrices of 3 SLOTS unknowns whose blocks lie in the band."""
    n = 3 * SLOTS
    i, j = np.indices((n, n))
    near = np.abs(i // BLOCK - j // BLOCK) <= WIDTH
    A = rng.standard_normal((worlds, n, n)) * near
    A = A + np.swapaxes(A, 1, 2)
    A += np.eye(n) * np.abs(A).sum(axis=2, keepdims=True)
    if indefinite:
        A[0, 5, 5] = -1.0
    return A


def stored(A):
    """Lower halves as the kernels have them, ones beyond the unknowns."""
    B, n, _ = A.shape
    out = np.zeros((B, ROWS, BLOCK * (WIDTH + 1), BLOCK))
    full = np.tile(np.eye(BLOCK * ROWS), (B, 1, 1))
    full[:, :n, :n] = A
    for row in range(ROWS):
        for other in range(max(row - WIDTH, 0), row + 1):
            block = full[:, BLOCK * row : BLOCK * (row + 1), BLOCK * other : BLOCK * (other + 1)]
            at = BLOCK * (other - row + WIDTH)
            out[:, row, at : at + BLOCK] = np.swapaxes(block, 1, 2)
    return out


def factors(A, dtype, blocks):
    """(bad, the array of factors) by the kernels of blocks or by those of the CPU."""
    B = len(A)
    band = wp.array(stored(A), dtype=column_type(dtype), device="cpu")
    active, bad = wp.ones(B, dtype=wp.int32, device="cpu"), wp.zeros(B, dtype=wp.int32, device="cpu")
    if blocks:
        scalar = wp.dtype_from_numpy(np.dtype(dtype))
        outside = wp.zeros((B, window_numbers(WIDTH)), dtype=scalar, device="cpu")
        args = [1, outside, active, bad, band]
        wp.launch(band_block_kernels(dtype, ROWS, WIDTH).factor, B, args, device="cpu")
    else:
        wp.launch(band_kernels(dtype).factor, B, [WIDTH, active, bad, band], device="cpu")
    return bad.numpy(), band


@pytest.mark.parametrize("dtype, bound", [("float64", 1e-13), ("float32", 1e-5)])
@pytest.mark.parametrize("indefinite", [False, True])
def test_factors_are_those_of_the_cpu(dtype, bound, indefinite):
    A = banded(np.random.default_rng(1), 2, indefinite)
    (bad, mine), (other_bad, other) = factors(A, dtype, True), factors(A, dtype, False)
    np.testing.assert_array_equal(bad, other_bad)
    assert bool(bad[0]) == indefinite
    expected = other.numpy()
    first = [BLOCK * max(WIDTH - row, 0) for row in range(ROWS)]
    for row in range(ROWS):  # blocks before the first column are not used
        difference = np.abs(mine.numpy()[:, row, first[row] :] - expected[:, row, first[row] :])
        assert difference.max() <= bound * np.abs(expected).max()


@pytest.mark.parametrize("dtype, bound", [("float64", 1e-12), ("float32", 1e-4)])
def test_solutions(dtype, bound):
    rng = np.random.default_rng(2)
    A, order = banded(rng, 2), rng.permutation(SLOTS)
    _, band = factors(A, dtype, True)
    scalar = wp.dtype_from_numpy(np.dtype(dtype))
    vec3 = wp.types.vector(length=3, dtype=scalar)
    r = rng.standard_normal((2, SLOTS, 3))
    given, z = wp.array(r, dtype=vec3, device="cpu"), wp.zeros((2, SLOTS), dtype=vec3, device="cpu")
    outside = wp.zeros((2, BLOCK * ROWS + BLOCK), dtype=scalar, device="cpu")
    active = wp.ones(2, dtype=wp.int32, device="cpu")
    args = [1, outside, band, wp.array(order, dtype=wp.int32, device="cpu"), given, active, z]
    wp.launch(band_block_kernels(dtype, ROWS, WIDTH).solve, 2, args, device="cpu")
    expected = np.linalg.solve(A, r[:, order].reshape(2, -1, 1)).reshape(2, SLOTS, 3)
    assert np.abs(z.numpy()[:, order] - expected).max() <= bound * np.abs(expected).max()
