"""A model linearised at a state at rest, with its joints: of modes of vibration and of buckling."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import LinearOperator, splu

from ..base.errors import ModelError
from ..model.model import Model
from ..model.state import State
from ..terms.checks import overrides
from ..terms.protocols import Touching
from ..terms.term import Congruence, Term
from .checks import check_state

__all__ = ["LinearSystem", "linearise"]

COMPLIANCE = 1e-11
"""Compliance of joints over that of the elements: an error of frequencies of this size. A bound: any value between
round-off and the accuracy wanted does."""


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """A model linearised at a state, on the free components.

    Attributes:
        model: the model. index: free components.
        parts: of the stiffness. J: constraint gradients, rows of length 1. C: parts of damping, on all components.
    """

    model: Model
    index: np.ndarray
    parts: list[Congruence]
    J: sp.csr_matrix
    C: list[Congruence]

    @cached_property
    def K(self) -> sp.csr_matrix:
        """The stiffness, with that of rigid parts."""
        K = sum((part.product() for part in self.parts), sp.csr_matrix((len(self.index),) * 2))
        return 0.5 * (K + K.T).tocsr()

    def project(self, Z: np.ndarray) -> np.ndarray:
        """Z^T K Z of motions that the constraints allow."""
        out = sum((part.project(Z) for part in self.parts), np.zeros((Z.shape[1],) * 2))
        return 0.5 * (out + out.T)

    def restrict(self, matrix: sp.csr_matrix) -> sp.csr_matrix:
        """Rows and columns of the free components."""
        return matrix[self.index][:, self.index]

    def expand(self, vectors: np.ndarray) -> np.ndarray:
        """(count, slots, 3) from columns (free, count)."""
        out = np.zeros((vectors.shape[1], 3 * self.model.slots))
        out[:, self.index] = vectors.T
        return out.reshape(len(out), -1, 3)

    def null_space(self) -> np.ndarray:
        """Orthonormal basis (free, n) of the motions that the constraints allow."""
        if not self.J.shape[0]:
            return np.eye(len(self.index))
        return scipy.linalg.null_space(self.J.toarray(), rcond=1e-9)

    def inverse(self, A: sp.csr_matrix) -> LinearOperator:
        """x of A x + J^T y = b, J x = 0."""
        scale = float(np.median(np.abs(A.diagonal())))
        n, rows = len(self.index), self.J.shape[0]
        border = scale * self.J
        corner = -COMPLIANCE * scale * sp.identity(rows)
        bordered = sp.bmat([[A, border.T], [border, corner]]) if rows else A
        try:
            factor = splu(bordered.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.01)
        except RuntimeError as error:
            raise ModelError(f"the stiffness is singular ({error}): hold the model, or give another shift") from error
        zero = np.zeros(rows)
        return LinearOperator((n, n), matvec=lambda b: factor.solve(np.append(b, zero))[:n], dtype=float)


def linearise(what: str, model: Model, state: State, count: int, world: int) -> LinearSystem:
    """The model at a state. ModelError as `modes`."""
    check_state(model, state)
    if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
        raise ModelError(f"{what}: count = {count!r} must be a positive whole number")
    if isinstance(world, bool) or not isinstance(world, (int, np.integer)) or not 0 <= world < model.worlds:
        raise ModelError(f"{what}: world = {world!r} must be a number from 0 to {model.worlds - 1}")
    if model.dtype != "float64":
        raise ModelError(f"{what}: float32 can't resolve the stiffness; take finalize(dtype='float64')")
    if not np.isfinite(state.displacement.numpy()[world]).all():
        raise ModelError(f"{what}: positions of world {world} are not finite in this state")
    index = np.flatnonzero(model.free_slots.ravel())
    if not len(index):
        raise ModelError(f"{what}: every component of every node is prescribed")
    found: tuple[list[Congruence], list[Congruence]] = [], []
    for term in model.terms:
        if isinstance(term, Touching):
            if term.nodal_force(state)[world].any():
                names = ", ".join(repr(contact.name) for contact in term.tables.contacts)
                raise ModelError(f"{what}: contact is active in this state ({names}); take a state without contact")
            continue
        if not overrides(term, Term.matrices):
            raise ModelError(
                f"{what}: the stiffness of {term.name!r} is not known (pressure, moments, force fields and terms of "
                "your own depend on the motion); build the model without, and give the loaded state"
            )
        for parts, matrix in zip(found, term.matrices(state, world)):
            parts += Congruence.parts_of(matrix)
    J = sp.csr_matrix((0, len(index)))
    if model.constraints is not None:
        J = model.evaluation.constraint_jacobian(state, world)[:, index]
        size = np.sqrt(np.asarray(J.multiply(J).sum(axis=1)).ravel())
        J = (sp.diags(1.0 / np.where(size > 0.0, size, 1.0)) @ J)[size > 0.0]
    return LinearSystem(model, index, [part.restrict(index) for part in found[0]], J.tocsr(), found[1])
