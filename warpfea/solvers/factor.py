"""Sparse factorisations of H on the free components: SuperLU on the host, cuDSS on the GPU."""

from __future__ import annotations

import importlib.util
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spla
import warp as wp

from ..base.errors import ModelError

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["CuDSS", "FreeMatrix", "SingularMatrix", "SparseFactors", "SuperLU", "make_factors"]

PIVOT_THRESHOLD = 1e-3
"""Smallest accepted diagonal pivot over its column maximum (matrix scaled to unit diagonal)."""


class SingularMatrix(Exception):
    """The factorisation failed."""


@dataclass(eq=False)
class FreeMatrix:
    """Free components of a symmetric matrix of 3x3 blocks; by symmetry the tables are both CSR and CSC.

    Attributes:
        free_components: (n,) components, 3 slot + axis, in row order.
        row_start, column_index: (n + 1,) and (m,), rows of the matrix in CSR.
        value_index: (m,) index of each entry in the flattened blocks.
        row_index: (m,) row of each entry.
        diagonal_entry: (n,) indices of the diagonal entries.
    """

    free_components: np.ndarray
    row_start: np.ndarray
    column_index: np.ndarray
    value_index: np.ndarray
    row_index: np.ndarray
    diagonal_entry: np.ndarray

    @classmethod
    def from_pattern(cls, graph: sp.csr_matrix, free: np.ndarray, *, ordered: bool) -> FreeMatrix:
        """Tables of a slot pattern and a (slots, 3) mask of free components; `ordered`: in minimum degree order."""
        count = len(graph.indices)
        place = np.arange(1.0, 9 * count + 1).reshape(count, 3, 3)
        n = 3 * graph.shape[0]
        whole = sp.bsr_matrix((place, graph.indices, graph.indptr), shape=(n, n)).tocsr()
        chosen = np.flatnonzero(free.ravel())
        matrix = whole[chosen][:, chosen].tocsr()
        if ordered:
            order = minimum_degree(matrix)
            chosen, matrix = chosen[order], matrix[order][:, order].tocsr()
        matrix.sort_indices()
        row = np.repeat(np.arange(len(chosen)), np.diff(matrix.indptr))
        return cls(
            free_components=chosen,
            row_start=matrix.indptr.astype(np.int32),
            column_index=matrix.indices.astype(np.int32),
            value_index=matrix.data.astype(np.int64) - 1,
            row_index=row,
            diagonal_entry=np.flatnonzero(row == matrix.indices),
        )


def minimum_degree(pattern: sp.csr_matrix) -> np.ndarray:
    """SuperLU's minimum degree order (n,) of a symmetric pattern, from an incomplete LU that drops every entry."""
    n = pattern.shape[0]
    dominant = sp.csc_matrix((np.full(len(pattern.data), -1e-6), pattern.indices, pattern.indptr), pattern.shape)
    dominant = (dominant + sp.identity(n)).tocsc()
    options = {"SymmetricMode": True}
    lu = spla.spilu(
        dominant, drop_tol=1.0, fill_factor=1.0, diag_pivot_thresh=0.0, permc_spec="MMD_AT_PLUS_A", options=options
    )
    return np.argsort(lu.perm_c)


class SparseFactors(Protocol):
    """Interface of sparse factors of the matrices of several worlds."""

    def factorise(self, values: wp.array, world: int) -> None:
        """Factorise one world's matrix from the blocks `values` [world, entry]. Raises SingularMatrix."""

    def solve(self, r: wp.array, z: wp.array, world: int) -> float:
        """z = A^-1 r in one world, 0 on prescribed components; returns r.z, possibly nan."""


class SuperLU:
    """SciPy's SuperLU on the host; matrix and vectors of a GPU are copied both ways.

    The matrix is scaled to a unit diagonal. The ordering is computed once from the pattern alone, so that a resumed run
    repeats the same arithmetic.
    """

    def __init__(self, model: Model, graph: sp.csr_matrix) -> None:
        if "direct order" not in model.cache:
            model.cache["direct order"] = FreeMatrix.from_pattern(graph, model.slot_table.free, ordered=True)
        self.matrix: FreeMatrix = model.cache["direct order"]
        self.factors: dict[int, tuple[Any, np.ndarray]] = {}
        self.size, self.dtype = model.slots, np.dtype(model.dtype)

    def factorise(self, values: wp.array, world: int) -> None:
        """See SparseFactors."""
        m = self.matrix
        data = values[world].numpy().reshape(-1)[m.value_index].astype(float)
        diagonal = np.abs(data[m.diagonal_entry])
        scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        data *= scale[m.row_index] * scale[m.column_index]
        self.factors.pop(world, None)
        if not np.isfinite(data).all():
            raise SingularMatrix
        matrix = sp.csc_matrix((data, m.column_index, m.row_start), shape=(len(m.free_components),) * 2)
        try:
            lu = spla.splu(
                matrix, permc_spec="NATURAL", diag_pivot_thresh=PIVOT_THRESHOLD, options={"SymmetricMode": True}
            )
        except RuntimeError as error:
            if "singular" not in str(error):
                raise
            raise SingularMatrix from error
        self.factors[world] = lu, scale

    def solve(self, r: wp.array, z: wp.array, world: int) -> float:
        """See SparseFactors."""
        free = self.matrix.free_components
        lu, scale = self.factors[world]
        b = r[world].numpy().reshape(-1)[free].astype(float)
        x = scale * lu.solve(scale * b)
        out = np.zeros(3 * self.size)
        out[free] = x
        z[world].assign(out.reshape(-1, 3).astype(self.dtype))
        return float(b @ x)


class CuDSS:
    """cuDSS of nvmath-python; matrix and vectors stay on the GPU as CuPy arrays. Untested."""

    def __init__(self, model: Model, graph: sp.csr_matrix) -> None:
        import cupy

        self.device, self.cupy = model.device, cupy
        self.matrix = FreeMatrix.from_pattern(graph, model.slot_table.free, ordered=False)
        with cupy.cuda.Device(self.device.ordinal):
            self.value_index = cupy.asarray(self.matrix.value_index)
            self.free = cupy.asarray(self.matrix.free_components)
        self.solvers: dict[int, Any] = {}

    def _plan_solver(self, data: Any) -> Any:
        """Planned solver, its matrix with the values `data`, and its right-hand side."""
        import cupyx.scipy.sparse as csp
        from nvmath.sparse.advanced import DirectSolver, DirectSolverMatrixType, DirectSolverOptions

        m, cp = self.matrix, self.cupy
        n = len(m.free_components)
        a = csp.csr_matrix((data, cp.asarray(m.column_index), cp.asarray(m.row_start)), shape=(n, n))
        b = cp.zeros(n)
        solver = DirectSolver(a, b, options=DirectSolverOptions(sparse_system_type=DirectSolverMatrixType.SYMMETRIC))
        solver.plan()
        return solver, a, b

    def factorise(self, values: wp.array, world: int) -> None:
        """See SparseFactors."""
        cp = self.cupy
        wp.synchronize_device(self.device)
        with cp.cuda.Device(self.device.ordinal):
            data = cp.asarray(values)[world].reshape(-1)[self.value_index].astype(cp.float64)
            if not bool(cp.isfinite(data).all()):
                raise SingularMatrix
            if world not in self.solvers:
                self.solvers[world] = self._plan_solver(data)
            solver, a, _ = self.solvers[world]
            a.data[:] = data
            solver.factorize()

    def solve(self, r: wp.array, z: wp.array, world: int) -> float:
        """See SparseFactors."""
        cp = self.cupy
        wp.synchronize_device(self.device)
        with cp.cuda.Device(self.device.ordinal):
            solver, _, b = self.solvers[world]
            b[:] = cp.asarray(r)[world].reshape(-1)[self.free]
            x = solver.solve()
            out = cp.asarray(z)[world].reshape(-1)
            out[:] = 0.0
            out[self.free] = x
            return float(b @ x)


def make_factors(model: Model, graph: sp.csr_matrix) -> SparseFactors:
    """cuDSS on a GPU if installed, else SuperLU with a warning on a GPU.

    Raises:
        ModelError: a model without free components.
    """
    if not model.slot_table.free.any():
        raise ModelError("linear='direct': every component of the model is prescribed, there is nothing to solve for")
    if not model.device.is_cuda:
        return SuperLU(model, graph)
    missing = [name for name in ("nvmath", "cupy") if importlib.util.find_spec(name) is None]
    if not missing:
        return CuDSS(model, graph)
    warnings.warn(
        f"linear='direct' on {model.device}: {' and '.join(missing)} not found, so SuperLU solves on the host; "
        "pip install 'warpfea[cudss]' to stay on the GPU",
        stacklevel=2,
    )
    return SuperLU(model, graph)
