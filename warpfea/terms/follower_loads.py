"""Follower loads: pressure on faces, and moments."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.solvers.direct import direct_kernels, follower_pattern_struct
from ..kernels.step.gather import gather_kernels
from ..kernels.terms.follower_loads import follower_struct, moment_kernels, pressure_kernels
from ..model import assembly
from ..model.description import Moment, Pressure
from ..time_laws import TimeLaw
from .gradients import ForceGradient, Gradient, StepAdjoint
from .protocols import Differentiable, Preconditioned
from .term import StepContext
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["FollowerLoads", "FollowerMatrix"]

SYMMETRIC = (1.0, 1.0)
"""Factors of a tangent and its transpose, of twice their sum: its symmetric part."""


@dataclass(eq=False)
class FollowerLoad:
    """Pressure on faces or moment at points: device data, kernels of the force and of its symmetric tangent, and the
    number of faces or points."""

    data: Any
    force: Any
    product: Any
    count: int


class FollowerLoads(Preconditioned, Differentiable):
    """Pressures and moments, non-potential in general; H contains the symmetric part of their tangent."""

    name = "followers"
    potential = False
    translation_invariant = True

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.loads: list[FollowerLoad] = []
        self._entry_count = 0

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {"follower pressure": bool(model.description.pressures), "moments": bool(model.description.moments)}

    def build(self, laws: TimeLawTable) -> None:
        self.loads = [self._pressure(p, laws) for p in self.model.description.pressures]
        self.loads += [self._moment(p, laws) for p in self.model.description.moments]

    def _load_data(self, conn: np.ndarray, law: TimeLaw, laws: TimeLawTable) -> Any:
        """Common device data; conn (items, local) in model slots."""
        m = self.model
        data = follower_struct(m.dtype)()
        m.memory.fill(data, "loads", conn=conn.T, time_law=np.full(len(conn), laws.add(law)))
        data.first_entry, data.item_count = self.offset + self._entry_count, len(conn)
        self.connectivity.append(conn)
        self._entry_count += conn.size
        return data

    def _pressure(self, pressure: Pressure, laws: TimeLawTable) -> FollowerLoad:
        m = self.model
        body = pressure.surface.body
        t = assembly.facet_tables(pressure.surface)
        data = self._load_data(t.conn + body.slot_offset, pressure.law, laws)
        position = body.slot_kind[t.conn] == 0
        value = body.reference[t.conn]
        value = np.where(position[:, :, None], value - value[:, :1], value)
        shape, shape_da, shape_db = (np.moveaxis(table, 0, 2) for table in (t.shape, t.d_a, t.d_b))
        tables = {"shape": shape, "shape_da": shape_da, "shape_db": shape_db, "weight": t.weights[0]}
        m.memory.fill(data, "loads", reference=np.swapaxes(value, 0, 1), is_position=position.T, **tables)
        k = pressure_kernels(m.dtype)
        return FollowerLoad(data, k.pressure_force, k.pressure_tangent_product, len(t.conn))

    def _moment(self, moment: Moment, laws: TimeLawTable) -> FollowerLoad:
        m = self.model
        data = self._load_data(moment.slots + moment.body.slot_offset, moment.law, laws)
        moment_fraction = np.full(len(moment.slots), 1.0 / len(moment.slots))
        tables = {"vector_coefficients": np.swapaxes(moment.vectors, 0, 1), "reference_vectors": moment.axes}
        m.memory.fill(data, "loads", moment_fraction=moment_fraction, **tables)
        k = moment_kernels(m.dtype, moment.body.family.spin_vectors)
        return FollowerLoad(data, k.moment_force, k.moment_tangent_product, len(moment.slots))

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {kernel.module for load in self.loads for kernel in (load.force, load.product)}

    def force(self, ctx: StepContext, active: wp.array) -> None:
        m, w = self.model, ctx.work
        for load in self.loads:
            args = [load.data, w.u_stage, w.time_law_stage_values, active, w.nonpotential_contribution]
            ctx.launch(load.force, (m.worlds, load.count), args)

    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """Symmetric tangent of the force times p."""
        self._tangent(ctx, p, active, SYMMETRIC)

    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        self._tangent(ctx, p, active, (0.0, 2.0) if transposed else (2.0, 0.0))

    def _tangent(self, ctx: StepContext, p: wp.array, active: wp.array, factors: tuple[float, float]) -> None:
        m, w = self.model, ctx.work
        for load in self.loads:
            args = [load.data, ctx.midpoint_factor, factors, w.u_stage, w.time_law_stage_values, active, p]
            ctx.launch(load.product, (m.worlds, load.count), [*args, w.nonpotential_tangent])

    def is_symmetric(self, ctx: StepContext) -> bool:
        return False

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        """w.df/dvalue: the forces are linear in the components of the value."""
        m = self.model
        loads = [load for load in self.loads if (load.data.time_law.numpy() == law).any()]
        units = np.zeros((3, *ctx.work.time_law_values.shape, 3))
        for c in range(3):
            units[c, :, law, c] = 1.0
        values: list[wp.array] = [wp.array(table, dtype=wp.vec3d, device=m.device) for table in units]
        gather = gather_kernels(m.dtype, ctx.traits).gather_force

        def force(at: StepAdjoint, k: int) -> None:
            w = at.ctx.work
            w.nonpotential_contribution.zero_()
            for load in loads:
                args = [load.data, w.u_stage, values[k], at.active, w.nonpotential_contribution]
                at.ctx.launch(load.force, (m.worlds, load.count), args)
            args = [m.terms.nonpotential_topology, w.nonpotential_contribution, at.active, at.scratch]
            at.ctx.launch(gather, at.dim, args)

        return ForceGradient(force) if loads else None

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if not projected:
            loads = self.loads
            ctx.scratch[self.name] = [FollowerMatrix(self, ctx, load, matrix.pattern) for load in loads]

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Minus the symmetric tangent of the force; indefinite, so nothing if projected."""
        if projected:
            return
        for matrices in ctx.scratch[self.name]:
            matrices.add(ctx, matrix, dq_dv, active, out)

    def hash(self, h: Any) -> None:
        for conn in self.connectivity:
            h.update(np.ascontiguousarray(conn).tobytes())
        for pressure in self.model.description.pressures:
            h.update(np.ascontiguousarray(pressure.surface.faces).tobytes())
        for moment in self.model.description.moments:
            h.update(np.ascontiguousarray(moment.vectors).tobytes())


class FollowerMatrix:
    """Matrices of a follower load's items, built by columns as products with unit vectors at local slots."""

    def __init__(self, term: FollowerLoads, ctx: StepContext, load: FollowerLoad, pattern: Any) -> None:
        model, work = term.model, ctx.work
        self.model, self.load = model, load
        self.kernels = direct_kernels(model.dtype)
        conn = load.data.conn.numpy()
        self.slots, self.count = conn.shape
        size = conn.size
        self.data = follower_struct(model.dtype)()
        for name in follower_struct(model.dtype).vars:
            setattr(self.data, name, getattr(load.data, name))
        own = np.arange(size, dtype=np.int32).reshape(conn.shape)
        self.data.conn = wp.array(own, dtype=wp.int32, device=model.device)
        self.data.first_entry = 0
        name = f"direct follower {load.data.first_entry}"
        vec3, B = model.types.vec3, model.worlds
        self.u = work.array(f"{name} u", (B, size), vec3)
        self.direction = work.array(f"{name} direction", (B, size), vec3)
        self.columns = work.array(f"{name} columns", (3 * self.slots, B, size), vec3)
        self.pattern_entries, self.entry_count = self._find_pattern_entries(conn, pattern)

    def _find_pattern_entries(self, conn: np.ndarray, pattern: Any) -> tuple[Any, int]:
        """Pattern entries of the items' matrices."""
        i, j, item = (a.ravel() for a in np.indices((self.slots, self.slots, self.count)))
        chosen, entry, start = assembly.grouped_items(pattern.find_upper(conn[i, item], conn[j, item]))
        places = follower_pattern_struct()()
        row = (i * self.count + item)[chosen]
        self.model.memory.fill(places, "matrix pattern", entry=entry, start=start, row=row, column=j[chosen])
        return places, len(entry)

    def add(self, ctx: StepContext, matrix: Any, dq_dv: wp.array, active: wp.array, out: wp.array) -> None:
        """out -= (dq/dv) times the items' matrices."""
        B, k, w, launch = self.model.worlds, self.kernels, ctx.work, ctx.launch
        launch(k.gather_local, (B, self.slots, self.count), [self.load.data.conn, w.u_stage, active, self.u])
        for local in range(self.slots):
            for axis in range(3):
                args = [local, axis, self.count, self.direction]
                launch(k.set_unit_direction, (B, self.slots * self.count), args)
                column = self.columns[3 * local + axis]
                args = [self.data, ctx.midpoint_factor, SYMMETRIC, self.u, w.time_law_stage_values, active]
                launch(self.load.product, (B, self.count), [*args, self.direction, column])
        args = [self.model.topology, matrix.pattern.data, self.pattern_entries, self.columns, dq_dv, active, out]
        launch(k.add_follower_matrices, (B, self.entry_count), args)
