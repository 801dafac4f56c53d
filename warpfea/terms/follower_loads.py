"""Follower loads: pressure on faces, and moments."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.solvers.direct import direct_kernels, follower_pattern_struct
from ..kernels.terms.follower_loads import follower_struct, moment_kernels, pressure_kernels
from ..model import assembly
from ..model.description import Moment, Pressure
from ..time_laws import TimeLaw
from .protocols import Preconditioned
from .term import StepContext
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["FollowerLoad", "FollowerLoads", "FollowerMatrix"]


@dataclass(eq=False)
class FollowerLoad:
    """Pressure on faces or moment at points: device data, kernels of the force and of its symmetric tangent, and the
    number of faces or points."""

    data: Any
    force: Any
    product: Any
    count: int


class FollowerLoads(Preconditioned):
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
        data.conn = m.array("loads", conn.T, wp.int32)
        data.time_law = m.array("loads", np.full(len(conn), laws.add(law)), wp.int32)
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
        data.reference = m.array("loads", np.swapaxes(value, 0, 1), m.types.vec3)
        data.is_position = m.array("loads", position.T.astype(float), m.types.T)
        for name, table in (("shape", t.shape), ("shape_da", t.d_a), ("shape_db", t.d_b)):
            setattr(data, name, m.array("loads", np.moveaxis(table, 0, 2), m.types.T))
        data.weight = m.array("loads", t.weights[0], m.types.T)
        k = pressure_kernels(m.dtype)
        return FollowerLoad(data, k.pressure_force, k.pressure_tangent_product, len(t.conn))

    def _moment(self, moment: Moment, laws: TimeLawTable) -> FollowerLoad:
        m = self.model
        data = self._load_data(moment.slots + moment.body.slot_offset, moment.law, laws)
        data.vector_coefficients = m.array("loads", np.swapaxes(moment.vectors, 0, 1), m.types.vec3)
        data.reference_vectors = m.array("loads", moment.axes, m.types.mat33)
        data.moment_fraction = m.array("loads", np.full(len(moment.slots), 1.0 / len(moment.slots)), m.types.T)
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
        m, w = self.model, ctx.work
        for load in self.loads:
            args = [
                load.data,
                ctx.midpoint_factor,
                w.u_stage,
                w.time_law_stage_values,
                active,
                p,
                w.nonpotential_tangent,
            ]
            ctx.launch(load.product, (m.worlds, load.count), args)

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if not projected:
            loads = self.loads
            ctx.scratch[self.name] = [FollowerMatrix(self, ctx, load, matrix.pattern) for load in loads]

    def blocks(
        self, ctx: StepContext, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
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
        index = pattern.find_upper(conn[i, item], conn[j, item])
        chosen = np.flatnonzero(index >= 0)
        chosen = chosen[np.argsort(index[chosen], kind="stable")]
        entry, count = np.unique(index[chosen], return_counts=True)
        places = follower_pattern_struct()()
        values = (entry, np.concatenate([[0], np.cumsum(count)]), (i * self.count + item)[chosen], j[chosen])
        for name, value in zip(("entry", "start", "row", "column"), values):
            setattr(places, name, self.model.array("matrix pattern", value, wp.int32))
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
                args = [self.data, ctx.midpoint_factor, self.u, w.time_law_stage_values, active, self.direction, column]
                launch(self.load.product, (B, self.count), args)
        args = [self.model.topology, matrix.pattern.data, self.pattern_entries, self.columns, dq_dv, active, out]
        launch(k.add_follower_matrices, (B, self.entry_count), args)
