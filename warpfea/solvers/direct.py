"""The direct solver: a sparse factorisation of H, as a preconditioner that leaves one iteration to do.

All of H that PCG sees is factorised: c_M M + (dq/dv) K of the elements, J^T rho J and the curvature
sum lambda d2c/dq2 of the constraints, and the symmetric tangents of follower loads. Behind the seam of preconditioners
it needs no second path: PCG measures the residual with its own operator, so a factorisation that lost digits is
refined, and its rules for indefinite matrices hold. Where H is indefinite, so that H^-1 r leads uphill, or singular,
the matrix made positive at each quadrature point is factorised instead, and PCG ends at a direction of negative
curvature.

Models without constraints and follower loads keep the factors as long as the operator's matrix is kept.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.launch import labelled
from ..kernels.solvers.direct import direct_kernels, followed_struct
from ..kernels.terms.followers import follower_struct
from .assembled import Pattern
from .factor import Singular, make_factors

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.loads import FollowerPart
    from ..terms.workspace import Workspace
    from .residual import Residual

__all__ = ["Direct"]


class Direct:
    """See the module. The host takes part, so launches can't be recorded.

    Attributes:
        singular: worlds whose matrix could not be factorised at the last attempt.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> None:
        self.model, self.work, self.launch, self.residual = model, work, launch, residual
        assert residual.assembled is not None
        self.assembled = residual.assembled
        self.kernels = direct_kernels(model.dtype)
        self.dim = (model.worlds, launch.padded(model.slots))
        self.factors = make_factors(model, self.assembled.pattern.graph)
        self.followers = [
            Followers(model, work, launch, part, self.assembled.pattern) for part in model.loads.followers
        ]
        self.alone = not self.followers and residual.constraints is None
        self.spare: wp.array | None = None
        self.untried: set[int] = set()
        self.singular: set[int] = set()

    def register(self, state: State) -> None:
        """It remembers nothing."""

    def forget(self, flags: wp.array) -> None:
        """It remembers nothing."""

    def modules(self) -> set[wp.Module]:
        """Modules that it launches."""
        return {self.kernels.module} | self.assembled.modules()

    @labelled("build")
    def start(self, active: wp.array) -> None:
        """D and the inverses of its blocks."""
        self.residual.blocks(active)

    def follow(self, active: wp.array) -> None:
        """D stays that of the step's start."""

    def commit(self, accepted: wp.array) -> None:
        """Nothing to keep."""

    def judge(self, active: wp.array) -> None:
        """It does not learn."""

    @property
    def value(self) -> wp.array:
        """Room for a matrix, made when it is wanted."""
        if self.spare is None:
            self.spare = self.assembled.values("direct matrix")
        return self.spare

    @labelled("build")
    def prepare(self, active: wp.array) -> None:
        """Factorise H of the active worlds."""
        residual = self.residual
        own = self.alone and residual.by_matrix
        worlds = np.flatnonzero((residual.reuse.control.build if own and residual.keep else active).numpy())
        if not len(worlds):
            return
        if own:
            value = residual.matrix
        else:
            value = self.value
            self._assemble(active, value, projected=False)
        for world in worlds:
            self._factorise(int(world), value)

    def _assemble(self, flags: wp.array, value: wp.array, *, projected: bool) -> None:
        """H, or what of it is positive for sure."""
        m, w, launch, k = self.model, self.work, self.launch, self.kernels
        self.assembled.assemble(w.u, (w.step.mass_factor, w.step.dq_dv), flags, value, projected=projected)
        topology, pattern = m.topology, self.assembled.pattern.data
        if m.constraints and projected:
            mul = w.multipliers
            self.assembled.add_constraints(mul.gradient, mul.stiffness, w.step.dq_dv, flags, value)
        elif m.constraints:
            args = [topology, pattern, self.assembled.couplings, m.constraints.data, w.multipliers]
            launch(k.add_constraints, (m.worlds, self.assembled.coupled), [*args, w.step.dq_dv, flags, value])
        for part in [] if projected else self.followers:
            columns = part.columns_at(w.u, w.law_value, flags)
            args = [topology, pattern, part.places, columns, w.step.dq_dv, flags, value]
            launch(k.add_followers, (m.worlds, part.entries), args)

    def _factorise(self, world: int, value: wp.array) -> None:
        self.singular.discard(world)
        self.untried.add(world)
        try:
            self.factors.factorise(value, world)
        except Singular:
            self._retreat(world)

    def _retreat(self, world: int) -> None:
        """Factorise the positive matrix instead."""
        self.untried.discard(world)
        flags = np.zeros(self.model.worlds, dtype=np.int32)
        flags[world] = 1
        self._assemble(wp.array(flags, dtype=wp.int32, device=self.model.device), self.value, projected=True)
        try:
            self.factors.factorise(self.value, world)
        except Singular:
            self.singular.add(world)

    @labelled("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = H^-1 r; r.z and r.D^-1 r in parts."""
        w = self.work
        for world in map(int, np.flatnonzero(active.numpy())):
            if not self._solve(r, z, world):
                z[world].zero_()
        self.launch(self.kernels.dot_rows, self.dim, [r, z, w.diagonal, active, w.warp, w.warp_rows])

    def _solve(self, r: wp.array, z: wp.array, world: int) -> bool:
        """Whether the world has factors; the first solution shows what they are good for."""
        if world in self.singular:
            return False
        downhill = self.factors.solve(r, z, world)
        if world in self.untried and not downhill >= 0.0:
            self._retreat(world)
            if world in self.singular:
                return False
            downhill = self.factors.solve(r, z, world)
        self.untried.discard(world)
        if not np.isfinite(downhill):
            self.singular.add(world)
        return bool(np.isfinite(downhill))


class Followers:
    """Matrices of a follower load's items, column by column from the product with unit vectors at local slots."""

    def __init__(self, model: Model, work: Workspace, launch: Launcher, part: FollowerPart, pattern: Pattern) -> None:
        self.model, self.launch, self.part = model, launch, part
        self.kernels = direct_kernels(model.dtype)
        conn = part.data.conn.numpy()
        self.slots, self.count = conn.shape
        size = conn.size
        self.data = follower_struct(model.dtype)()
        for name in follower_struct(model.dtype).vars:
            setattr(self.data, name, getattr(part.data, name))
        own = np.arange(size, dtype=np.int32).reshape(conn.shape)
        self.data.conn = wp.array(own, dtype=wp.int32, device=model.device)
        self.data.offset = 0
        name = f"direct follower {part.data.offset}"
        vec3, B = model.types.vec3, model.worlds
        self.u = work.array(f"{name} u", (B, size), vec3)
        self.direction = work.array(f"{name} direction", (B, size), vec3)
        self.columns = work.array(f"{name} columns", (3 * self.slots, B, size), vec3)
        self.places, self.entries = self._find(conn, pattern)

    def _find(self, conn: np.ndarray, pattern: Pattern) -> tuple[Any, int]:
        """Entries of the pattern that the items' matrices add to."""
        n = np.int64(self.model.slots)
        upper = pattern.upper
        key = upper[:, 2].astype(np.int64) * n + upper[:, 3]
        i, j, item = (a.ravel() for a in np.indices((self.slots, self.slots, self.count)))
        wanted = conn[i, item].astype(np.int64) * n + conn[j, item]
        at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        chosen = np.flatnonzero(key[at] == wanted)
        chosen = chosen[np.argsort(at[chosen], kind="stable")]
        entry, count = np.unique(at[chosen], return_counts=True)
        places = followed_struct()()
        values = (entry, np.concatenate([[0], np.cumsum(count)]), (i * self.count + item)[chosen], j[chosen])
        for name, value in zip(("entry", "start", "row", "column"), values):
            setattr(places, name, self.model.array("matrix pattern", value, wp.int32))
        return places, len(entry)

    def columns_at(self, u: wp.array, law_value: wp.array, flags: wp.array) -> wp.array:
        """[3 local + axis, world, local * count + item]."""
        B, k, launch = self.model.worlds, self.kernels, self.launch
        launch(k.take_local, (B, self.slots, self.count), [self.part.data.conn, u, flags, self.u])
        for local in range(self.slots):
            for axis in range(3):
                args = [local, axis, self.count, self.direction]
                launch(k.unit_direction, (B, self.slots * self.count), args)
                out = self.columns[3 * local + axis]
                args = [self.data, self.u, law_value, flags, self.direction, out]
                launch(self.part.product, (B, self.count), args)
        return self.columns
