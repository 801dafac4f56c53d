"""Factors of bands by a block of threads per world (one thread does the same on the CPU), against numpy."""

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.structs import pattern_struct
from warpfea.kernels.solvers.band import BLOCK, block_column_type
from warpfea.kernels.solvers.band_block import band_block_kernels, solution_memory_size, window_size

SLOTS = 37
ROWS = -(-3 * SLOTS // BLOCK)


def banded(rng, worlds, reach):
    """(order, matrices) of 3 x 3 blocks whose slots lie in a band once they are put in order."""
    n = 3 * SLOTS
    order = rng.permutation(SLOTS)
    near = np.abs(np.subtract.outer(np.arange(SLOTS), np.arange(SLOTS))) <= reach
    near &= (rng.random((SLOTS, SLOTS)) < 0.7) | np.eye(SLOTS, dtype=bool)
    near &= near.T
    A = rng.standard_normal((worlds, n, n)) * np.kron(near, np.ones((3, 3)))
    A = A + np.swapaxes(A, 1, 2)
    A += 1.2 * np.eye(n) * np.abs(A).sum(axis=2, keepdims=True)
    place = np.argsort(order)
    unknown = (3 * place[:, None] + np.arange(3)).ravel()  # of the slots as they are numbered
    return order, A[:, unknown][:, :, unknown], near[place][:, place]


def solved(A, graph, order, r, dtype, shift=0.0):
    """(z, bad): of the kernels."""
    B = len(A)
    rows, columns = np.nonzero(graph)
    place = np.argsort(order)
    width = int(((3 * place[rows] + 2) // BLOCK - 3 * place[columns] // BLOCK).max())
    scalar = wp.dtype_from_numpy(np.dtype(dtype))
    vec3, mat33 = wp.types.vector(length=3, dtype=scalar), wp.types.matrix(shape=(3, 3), dtype=scalar)
    kernels = band_block_kernels(dtype, ROWS, width)

    def array(values, kind):
        return wp.array(values, dtype=kind, device="cpu")

    pattern = pattern_struct()()
    pattern.start = array(np.concatenate([[0], np.cumsum(graph.sum(axis=1))]), wp.int32)
    pattern.column = array(columns, wp.int32)
    blocks = A.reshape(B, SLOTS, 3, SLOTS, 3).transpose(0, 1, 3, 2, 4)[:, rows, columns]
    slot_at, place_of, active = array(order, wp.int32), array(place, wp.int32), array(np.ones(B), wp.int32)
    bad = array(np.zeros(B), wp.int32)
    band = wp.zeros((B, ROWS, BLOCK * (width + 1)), dtype=block_column_type(dtype), device="cpu")
    outside = wp.zeros((B, window_size(width)), dtype=scalar, device="cpu")
    args = [1, outside, pattern, array(blocks, mat33), slot_at, place_of, array(np.full(B, shift), scalar)]
    wp.launch(kernels.factor, B, [*args, active, bad, band], device="cpu")
    outside = wp.zeros((B, solution_memory_size(ROWS, width)), dtype=scalar, device="cpu")
    z = wp.zeros((B, SLOTS), dtype=vec3, device="cpu")
    wp.launch(kernels.solve, B, [1, outside, band, slot_at, array(r, vec3), active, z], device="cpu")
    return z.numpy(), bad.numpy()


@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-13), ("float32", 1e-5)])
@pytest.mark.parametrize("reach", [1, 4, 11])
def test_solutions_are_those_of_numpy(dtype, bound, reach):
    rng = np.random.default_rng(reach)
    order, A, graph = banded(rng, 2, reach)
    r = rng.standard_normal((2, SLOTS, 3))
    z, bad = solved(A, graph, order, r, dtype)
    expected = np.linalg.solve(A, r.reshape(2, -1, 1)).reshape(2, SLOTS, 3)
    assert not bad.any()
    assert np.abs(z - expected).max() <= bound * np.abs(expected).max()


def test_a_shift_adds_to_the_diagonal():
    rng = np.random.default_rng(5)
    order, A, graph = banded(rng, 1, 2)
    r = rng.standard_normal((1, SLOTS, 3))
    z, _ = solved(A, graph, order, r, "float64", shift=0.25)
    shifted = A + 0.25 * np.eye(3 * SLOTS) * np.abs(np.einsum("bii->bi", A))[:, None]
    expected = np.linalg.solve(shifted, r.reshape(1, -1, 1)).reshape(1, SLOTS, 3)
    assert np.abs(z - expected).max() <= 1e-13 * np.abs(expected).max()


def test_what_is_not_positive_is_counted_and_leaves_a_positive_operator():
    rng = np.random.default_rng(6)
    order, A, graph = banded(rng, 1, 2)
    slot = order[SLOTS // 2]
    A[0, 3 * slot : 3 * slot + 3] *= 40.0  # beside the diagonal: |diagonal| no longer dominates
    A[0, :, 3 * slot : 3 * slot + 3] *= 40.0
    A[0, 3 * slot : 3 * slot + 3, 3 * slot : 3 * slot + 3] /= 1600.0**1.5
    basis = np.eye(3 * SLOTS).reshape(-1, SLOTS, 3)
    columns = []
    for r in basis:
        z, bad = solved(A, graph, order, r[None], "float64")
        assert bad[0] > 0
        columns.append(z.ravel())
    B = np.array(columns)
    np.testing.assert_allclose(B, B.T, atol=1e-10 * np.abs(B).max())
    assert np.linalg.eigvalsh(0.5 * (B + B.T)).min() > 0.0
