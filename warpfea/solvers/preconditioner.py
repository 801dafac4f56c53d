"""Interface of preconditioners, block Jacobi, and automatic selection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import warp as wp

from ..base.errors import ModelError
from ..base.launch import launch_part
from ..kernels.solvers.pcg import pcg_kernels
from ..terms.protocols import Constrained
from .band import MAX_FULL_FACTOR_SLOTS, find_band, thread_block_band
from .residual import Residual
from .twolevel import TwoLevel

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.workspace import Workspace

__all__ = ["PRECONDITIONERS", "BlockJacobi", "Preconditioner", "choose_preconditioner", "make_preconditioner"]


class Preconditioner(Protocol):
    """Interface of a preconditioner B ~ H^-1."""

    def register(self, state: State) -> None:
        """Register the data kept between steps in the state."""

    def invalidate(self, flags: wp.array) -> None:
        """Invalidate history of worlds whose state was set externally."""

    def modules(self) -> set[wp.Module]:
        """Modules launched."""

    def start(self, active: wp.array) -> None:
        """Compute work.diagonal and work.inverse at the first iterate of an attempt."""

    def discard(self, active: wp.array) -> None:
        """Discard the setup of the last `start`; the attempt restarts from another iterate."""

    def update(self, active: wp.array) -> None:
        """Update at every further iterate as far as needed."""

    def store_history(self, accepted: wp.array) -> None:
        """Store history after acceptance of the attempt."""

    def prepare(self, active: wp.array) -> None:
        """Compute the data of `apply` before a linear solve."""

    def record_cost(self, active: wp.array) -> None:
        """After a linear solve: record its iteration count for the reuse rule."""

    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = B r; per slot r.z in rows[0] and r.D^-1 r in rows[1]."""


class BlockJacobi:
    """3x3 diagonal blocks of H, made positive at each quadrature point."""

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> None:
        self.work, self.launch, self.residual = work, launch, residual
        work.allocate_diagonal_blocks()
        self.kernels = pcg_kernels(model.dtype, model.terms.traits.has_constraints)
        self.dim = (model.worlds, launch.padded(model.slots))

    def register(self, state: State) -> None:
        """Stateless."""

    def invalidate(self, flags: wp.array) -> None:
        """Stateless."""

    def modules(self) -> set[wp.Module]:
        """Module of the PCG kernel launched here."""
        return {self.kernels.module}

    @launch_part("build")
    def start(self, active: wp.array) -> None:
        """Assemble and invert the blocks."""
        self.residual.diagonal_blocks(active)

    update = start

    def discard(self, active: wp.array) -> None:
        """No-op: no stored setup."""

    def store_history(self, accepted: wp.array) -> None:
        """No-op: no history."""

    def prepare(self, active: wp.array) -> None:
        """No-op: the blocks of the iterate are available."""

    def record_cost(self, active: wp.array) -> None:
        """No reuse rule."""

    @launch_part("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = D^-1 r, with constraints (D + (dq/dv) J^T rho J)^-1 r."""
        w = self.work
        self.launch(
            self.kernels.apply_block_jacobi, self.dim, [w.inverse, r, w.diagonal, active, w.warp_size, z, w.warp_rows]
        )
        ctx = self.residual.ctx
        for term in self.residual.terms.having(Constrained) if ctx.options.deflate_constraints else ():
            term.precondition(ctx, r, z, active)


PRECONDITIONERS = ("two-level", "tiles", "banded", "deflated", "block-jacobi")
SMALL_BODY_SLOTS = 64
"""Mean number of slots of a body below which bodies on joints take block Jacobi."""


def choose_preconditioner(name: str, storage: str | None, model: Model) -> str:
    """Resolve a name of PRECONDITIONERS or "auto": banded factors for a narrow band, else block Jacobi if bodies on
    joints are too small for several groups of nodes.

    Raises:
        ModelError: "banded" for a larger model on a GPU, or with a storage precision other than the model's.
    """
    kept = storage in (None, model.dtype)
    banded = kept and (not model.device.is_cuda or thread_block_band(model) is not None)
    if name == "banded" and kept and not banded:
        raise ModelError(
            "NewtonPCG: preconditioner = 'banded' is for the CPU, and on a GPU for small models with a narrow band; "
            f"for this one on {model.device} take 'auto' or 'two-level'"
        )
    if name == "banded" and not banded:
        raise ModelError(
            f"NewtonPCG: preconditioner = 'banded' keeps its factors in the model's precision, {model.dtype}: leave "
            f"out preconditioner_dtype = {storage!r}, or take 'two-level'"
        )
    if name != "auto":
        return name
    if banded and not model.device.is_cuda and find_band(model) is not None:
        return "banded"
    small = model.slots < SMALL_BODY_SLOTS * (int(model.components.mesh_of_slot.max()) + 1)
    return (
        "deflated"
        if model.terms.traits.has_constraints and small and model.slots > MAX_FULL_FACTOR_SLOTS
        else "two-level"
    )


def make_preconditioner(
    name: str, storage: str | None, model: Model, work: Workspace, launch: Launcher, residual: Residual
) -> Preconditioner:
    """Construct the preconditioner `name` of PRECONDITIONERS."""
    if name in ("block-jacobi", "deflated"):
        return BlockJacobi(model, work, launch, residual)
    return TwoLevel(model, work, launch, residual, storage, kind=name)
