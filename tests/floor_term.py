"""A term of one's own, in this file alone.

It is a penalty half-space z >= 0 with a spring that sticks where a node first touched: a potential with history, two
columns of the ledger, a field, a step limit, 3x3 blocks in every solver.
"""

import functools
import types
from typing import ClassVar

import numpy as np
import warp as wp
from warpfea.kernels.common.block_entries import add_block_function
from warpfea.kernels.common.modules import kernel_module
from warpfea.kernels.common.structs import pattern_struct, topology_struct
from warpfea.kernels.common.types import precision
from warpfea.kernels.solvers.newton_control import control_struct

from warpfea.terms.protocols import Preconditioned, Tied, Updated
from warpfea.terms.term import LOSS, STORED, Column, FieldSpec


@functools.cache
def floor_kernels(dtype):
    """Kernels of the half-space z >= 0; item k is one slot with the reference height `height[k]`."""
    p = precision(dtype)
    T, vec3, sym6, mat33 = p.T, p.vec3, p.sym, p.mat33
    f64 = wp.float64
    Newton, Topology, Pattern = control_struct(), topology_struct(dtype), pattern_struct()
    add_block = add_block_function(dtype)
    module = kernel_module(f"test_floor_{dtype}")

    @wp.func
    def spring(u: vec3, anchor: vec3, stuck: int) -> vec3:
        """Slip since the point stuck, in the plane."""
        return T(f64(stuck)) * vec3(u[0] - anchor[0], u[1] - anchor[1], T(0.0))

    @wp.kernel(module=module)
    def force(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), k: T, kt: T, u: wp.array2d(dtype=vec3),
        anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32), active: wp.array(dtype=wp.int32),
        offset: int, pool: wp.array2d(dtype=vec3), stiffness: wp.array2d(dtype=vec3), rows: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """k min(gap, 0) in z, kt times the slip in x and y of what sticks; the energy of both."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        x = u[world, slot[item]]
        gap = wp.min(height[item] + x[2], T(0.0))
        slip = spring(x, anchor[world, item], stuck[world, item])
        pool[world, offset + item] = kt * slip + vec3(T(0.0), T(0.0), k * gap)
        hard = T(0.0)
        if gap < T(0.0):
            hard = k
        soft = kt * T(f64(stuck[world, item]))
        stiffness[world, item] = vec3(soft, soft, hard)
        energy = f64(T(0.5) * (k * gap * gap + kt * wp.dot(slip, slip)))
        for row in range(3):
            rows[row, world, item] = energy

    @wp.kernel(module=module)
    def product(
        slot: wp.array(dtype=wp.int32), stiffness: wp.array2d(dtype=vec3), p: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), offset: int, pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """K p."""
        world, item = wp.tid()
        if active[world] != 0:
            pool[world, offset + item] = wp.cw_mul(stiffness[world, item], p[world, slot[item]])

    @wp.kernel(module=module)
    def diagonal(
        stiffness: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), offset: int, pool: wp.array2d(dtype=sym6)
    ):
        """K in Voigt order."""
        world, item = wp.tid()
        if active[world] != 0:
            s = stiffness[world, item]
            pool[world, offset + item] = sym6(s[0], s[1], s[2], T(0.0), T(0.0), T(0.0))

    @wp.kernel(module=module)
    def add(
        topo: Topology, pattern: Pattern, entry: wp.array(dtype=wp.int32), stiffness: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) K."""
        world, item = wp.tid()
        if active[world] != 0:
            A = T(dq_dv[world]) * wp.diag(stiffness[world, item])
            add_block(topo, pattern.upper[entry[item]], A, world, value)

    @wp.kernel(module=module)
    def limit(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), depth: T, u: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec3), newton: Newton,
    ):  # fmt: skip
        """No node gets deeper than `depth` in one step of Newton's method."""
        world, item = wp.tid()
        if newton.active[world] == 0:
            return
        room = height[item] + u[world, slot[item]][2] + depth
        fall = -T(newton.dq_dv[world]) * p[world, slot[item]][2]
        if room > T(0.0) and fall > room:
            wp.atomic_min(newton.search.limit, world, wp.max(f64(room / fall), f64(1.0e-3)))

    @wp.kernel(module=module)
    def energy_increments(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), k: T, kt: T, u: wp.array2d(dtype=vec3),
        anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32), accepted: wp.array(dtype=wp.int32),
        rows: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """History stored at the end of a step, and the energy lost by springs of points that leave."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        x = u[world, slot[item]]
        gap = wp.min(height[item] + x[2], T(0.0))
        slip = spring(x, anchor[world, item], stuck[world, item])
        tangential = f64(T(0.5) * kt * wp.dot(slip, slip))
        rows[0, world, item] = f64(T(0.5) * k * gap * gap)
        rows[1, world, item] = f64(0.0)
        if gap < T(0.0):
            rows[0, world, item] = rows[0, world, item] + tangential
        else:
            rows[1, world, item] = tangential

    @wp.kernel(module=module)
    def commit(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), u: wp.array2d(dtype=vec3),
        accepted: wp.array(dtype=wp.int32), anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        """Points that touch first stick where they are; those that leave let go."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        x = u[world, slot[item]]
        if height[item] + x[2] >= T(0.0):
            stuck[world, item] = 0
        elif stuck[world, item] == 0:
            stuck[world, item] = 1
            anchor[world, item] = x

    kernels = (force, product, diagonal, add, limit, energy_increments, commit)
    return types.SimpleNamespace(module=module, **{kernel.key.rsplit("__", 1)[-1]: kernel for kernel in kernels})


class Floor(Updated, Tied, Preconditioned):
    """A penalty half-space z >= 0 under all nodes of a model, k and kt in N/m."""

    name = "floor"
    columns = (Column("floor_stored", STORED), Column("floor_lost", LOSS))
    fields: ClassVar = {"floor_gap": FieldSpec("height over the floor", "m")}
    parts: ClassVar = {"floor": "a penalty half-space"}

    def __init__(self, model, k=2e4, kt=1e4, depth=5e-3):
        super().__init__(model)
        self.k, self.kt, self.depth = k, kt, depth
        self.kernels = floor_kernels(model.dtype)

    def build(self, laws):
        m = self.model
        slots = np.flatnonzero(m.slot_table.kind == 0)
        origin = np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in m.bodies])
        self.height_host = (m.slot_table.reference + origin)[slots, 2]
        self.slots, self.dim = slots, (m.worlds, len(slots))
        self.slot, self.height = m.array("floor", slots, wp.int32), m.array("floor", self.height_host, m.types.T)
        self.connectivity, self.rows = [slots[:, None]], len(slots)

    def mark_constrained(self, free):
        free[:] = 0.0

    def hash(self, h):
        h.update(f"{self.k} {self.kt} {self.depth}".encode())

    def register(self, ctx):
        ctx.state.register("floor_anchor", self.model.types.vec3, (len(self.slots),))
        ctx.state.register("floor_stuck", wp.int32, (len(self.slots),))

    def allocate(self, work, ctx):
        stiffness = work.array("floor stiffness", self.dim, self.model.types.vec3)
        ctx.scratch[self.name] = stiffness, work.array("floor rows", (2, *self.dim), wp.float64)

    def modules(self, ctx):
        return {self.kernels.module}

    def force(self, ctx, active):
        w, s = ctx.work, ctx.state
        args = [self.slot, self.height, self.k, self.kt, w.u, s.floor_anchor, s.floor_stuck, active, self.offset]
        args += [w.pool_force, ctx.scratch[self.name][0], w.rows_of(self)]
        with ctx.launch.part("floor"):
            ctx.launch(self.kernels.force, self.dim, args)

    prepare = force

    def process_direction(self, ctx, active):
        w = ctx.work
        ctx.launch(self.kernels.limit, self.dim, [self.slot, self.height, self.depth, w.u, w.direction, w.newton])

    def product(self, ctx, p, active):
        args = [self.slot, ctx.scratch[self.name][0], p, active, self.offset, ctx.work.pool_product]
        ctx.launch(self.kernels.product, self.dim, args)

    def diagonal(self, ctx, active):
        ctx.launch(
            self.kernels.diagonal, self.dim, [ctx.scratch[self.name][0], active, self.offset, ctx.work.pool_block]
        )

    def cached_inputs(self, ctx):
        return [("floor", ctx.scratch[self.name][0])]

    def allocate_blocks(self, ctx, matrix, *, projected):
        self.entry = self.model.array("floor", matrix.pattern.find_upper(self.slots, self.slots), wp.int32)

    def blocks(self, ctx, matrix, cached, dq_dv, active, out, *, projected):
        args = [self.model.topology, matrix.pattern.data, self.entry, *cached, dq_dv, active, out]
        ctx.launch(self.kernels.add, self.dim, args)

    def energy_increments(self, ctx, accepted):
        w, s, rows = ctx.work, ctx.state, ctx.scratch[self.name][1]
        args = [self.slot, self.height, self.k, self.kt, w.u, s.floor_anchor, s.floor_stuck, accepted, rows]
        ctx.launch(self.kernels.energy_increments, self.dim, args)
        return rows

    def commit(self, ctx, accepted):
        s = ctx.state
        args = [self.slot, self.height, ctx.work.u, accepted, s.floor_anchor, s.floor_stuck]
        ctx.launch(self.kernels.commit, self.dim, args)

    def stored_energy(self, ctx):
        u, s = ctx.state.displacement.numpy().astype(float)[:, self.slots], ctx.state
        gap = np.minimum(self.height_host + u[:, :, 2], 0.0)
        slip = np.linalg.norm((u - s.floor_anchor.numpy())[:, :, :2], axis=2) * s.floor_stuck.numpy()
        return {"floor_stored": 0.5 * (self.k * gap**2 + self.kt * slip**2).sum(axis=1)}

    def samples(self, field, body, state):
        first = body.slot_offset + body.node_slot
        return body.mesh.points[:, 2] + state.displacement.numpy()[:, first, 2].astype(float)
