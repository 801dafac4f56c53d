"""Constraints by an augmented Lagrangian: values, forces, part of H, and multipliers.

The classical method solves g(v; lambda) = 0 at fixed lambda, then adds rho c, until |c| <= tol. Here lambda is updated
with every Newton step by rho (c + (dq/dv) J p), the same formula for the constraint linearised at the iterate: Newton's
method on the pair (v, lambda), with 1/rho on the diagonal that keeps redundant rows solvable. No outer loop is needed,
and the curvature sum lambda d2c/dq2 is free of rho c. The classical update is `NewtonPCG(multipliers="outer")`.
Multipliers converge as far as rho exceeds the inertia that they move, which in a chain of rigid parts is its heaviest.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.launch import Launcher
from ..kernels.solvers.deflation import deflation_kernels
from ..kernels.solvers.newton_control import TERM_ROWS
from ..kernels.solvers.reuse import reuse_kernels
from ..kernels.terms.constraint_blocks import constraint_block_kernels
from ..kernels.terms.constraint_products import exact_product_kernel
from ..kernels.terms.constraints import ANGLE, JOINT_COLUMNS, constraint_kernels, multiplier_struct
from ..kernels.terms.joint_angles import joint_angle_kernels
from ..kernels.terms.velocity_rows import velocity_kernels
from ..model import assembly
from .constraint_tables import ConstraintTables
from .gradients import Gradient, StepAdjoint
from .protocols import CachedInputs, Constrained, Differentiable, Preconditioned, Tied, Updated
from .term import NUMERICAL, WORK, Column, StepContext, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["Constraints"]

CHAIN_SHARE = 0.01
"""Share of kappa in the least penalty over the stiffness of a chain's stiffest row. With a tenth of it a link that
carries 1e9 times its mass takes 60 % more iterations, with ten times 20 % less. In float32 no value carries more than
a hundred times."""
MAX_THREAD_ROWS = 16
"""Maximum rows of a cluster whose matrix one thread inverts; larger ones take a launch per pivot."""


class Constraints(Constrained, Updated, Tied, Preconditioned, Differentiable):
    """Joints, welds and single constraints of a model.

    Attributes:
        tables: their rows on the device.
    """

    name = "constraints"
    columns = (Column("work_joints", WORK), Column("", NUMERICAL))
    parts = {"constraints": "values, multipliers and work of joints"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.tables = ConstraintTables(model, model.description.joints)
        self.kernels = self.tables.kernels
        self.rows = self.tables.count
        self.report_columns = JOINT_COLUMNS * len(self.tables.joints)
        self.dim = (model.worlds, self.tables.count)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {"constraints": bool(model.description.joints)}

    def tied_slots(self) -> list[np.ndarray]:
        return self.tables.joint_slots()

    def build(self, laws: TimeLawTable) -> None:
        self.tables.build(self.model.components.of_slot, laws)

    def mark_constrained(self, free: np.ndarray) -> None:
        self.tables.mark_constrained(free)

    def restraints(self, state: State, component: int) -> sp.csr_matrix:
        return self.jacobian(state, 0)[np.flatnonzero(self.tables.component_host == component)]

    def incidence(self) -> tuple[np.ndarray, np.ndarray, int]:
        return self.tables.term_host // 3, self.tables.slot_host, self.tables.count

    def hash(self, h: Any) -> None:
        self.tables.hash(h)

    # simulation setup

    def integrator_kernels(self, ctx: StepContext) -> Any:
        """Kernels specialised for the integrator of a simulation."""
        return constraint_kernels(self.model.dtype, ctx.midpoint)

    def _make_multipliers(self, make: Callable[[str, tuple[int, ...], Any], wp.array], *, midpoint: bool) -> Any:
        """Multiplier struct with arrays from make(name, shape, dtype), but the rows of the potential."""
        mul, con = multiplier_struct()(), self.tables
        B, M = self.dim
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("gradient", "end_gradient", "product"), (B, 3 * M))
        shapes |= {
            "curvature": (B, 9 * M),
            **dict.fromkeys(("violation", "stiffest"), (B, self.model.components.count + 1)),
            "compliance_block": (B, max(con.block_count, 1)),
            "inverse_matrix": (B, con.matrix_entries),
            "coupling": (B, max(con.coupling_count, 1)),
        }
        curved = con.formulas or con.has_velocity_rows
        absent = ("rows", *(() if curved else ("curvature",)), *(() if midpoint else ("end_gradient",)))
        for name, var in multiplier_struct().vars.items():
            if isinstance(var.type, wp.array) and name not in absent:
                setattr(mul, name, make(name, shapes.get(name, self.dim), var.type.dtype))
        if not midpoint:
            mul.end_gradient = mul.gradient
        return mul

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        """Allocate multipliers and matrices, work.multipliers."""
        work.multipliers = self._make_multipliers(
            lambda name, shape, dtype: work.array(f"Multipliers.{name}", shape, dtype), midpoint=ctx.midpoint
        )
        work.multipliers.rows = work.rows_of(self)

    def register(self, ctx: StepContext) -> None:
        ctx.state.register("constraint_force", wp.float64, (self.tables.count,))
        ctx.state.register("constraint_target", wp.float64, (self.tables.count,), np.nan)
        self.tables.angles.register(ctx)

    def configure(self, ctx: StepContext) -> None:
        """Read the solver's options: classical updates or not, kappa, and whether constraint directions are
        deflated."""
        ctx.work.newton.norms.violation = ctx.work.multipliers.violation
        mul, options = ctx.work.multipliers, ctx.options
        mul.outer_updates, mul.penalty_ratio = int(options.outer_multipliers), options.penalty_ratio
        chains = self.model.dtype == "float64" and any(body.rigid for body in self.model.bodies)
        if self.model.dtype == "float32":
            mul.rounding_limit = ctx.work.newton.floor.max_error * self.model.size
        mul.chain_ratio = CHAIN_SHARE * options.penalty_ratio if chains else 0.0
        if options.deflate_constraints:
            self.large = self.tables.clusters_above(MAX_THREAD_ROWS)

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        formulas = {kernels.module for _, kernels in self.tables.formula_kernels(ctx.midpoint)}
        own = {self.integrator_kernels(ctx).module, deflation_kernels(self.model.dtype).module}
        return own | formulas | self.tables.angles.modules()

    def start(self, ctx: StepContext, active: wp.array) -> None:
        """Initialise right-hand sides missing in the state, and the violation at the start."""
        state, mul = ctx.state, ctx.work.multipliers
        self.begin(ctx, active)
        self.prepare(ctx, active)
        known = state.constraint_target.numpy()
        state.constraint_target.assign(np.where(np.isnan(known), mul.target.numpy(), known))

    # in a step

    @part("constraints")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Warm start of an attempt from the multipliers and right-hand sides of the state; rho is not known yet."""
        args = [ctx.state.constraint_force, ctx.state.constraint_target, active, ctx.work.multipliers]
        ctx.launch(self.integrator_kernels(ctx).load_multipliers, self.dim, args)

    @part("constraints")
    def force(self, ctx: StepContext, active: wp.array) -> None:
        """Evaluate c, J and the rows of the augmented potential at work.u."""
        w, k = ctx.work, self.integrator_kernels(ctx)
        ctx.launch(k.reset_violation, w.multipliers.violation.shape, [active, w.multipliers])
        args = [self.tables.data, w.u, w.u_stage, w.time_law_values, w.newton.search.alpha, active, w.multipliers]
        start, span = (ctx.state.displacement, w.step.h) if ctx.midpoint else (w.q_tilde, w.step.dq_dv)
        more = [w.time_law_stage_values, w.newton.search.alpha, active, w.multipliers]
        more += [start, ctx.state.displacement, span, w.newton.frozen.contact_active]
        self._evaluate_rows(ctx.launch, ctx.midpoint, args, more)

    def _evaluate_rows(self, launch: Launcher, midpoint: bool, args: list[Any], more: list[Any]) -> None:
        launch(constraint_kernels(self.model.dtype, midpoint).evaluate, self.dim, args)
        for kind, kernels in self.tables.formula_kernels(midpoint):
            launch(kernels.evaluate, self.dim, [kind, *args])
        if self.tables.has_velocity_rows:
            launch(velocity_kernels(self.model.dtype).evaluate, self.dim, [*args[:2], *more])

    prepare = force  # J, for rho

    def scale(self, ctx: StepContext, active: wp.array) -> None:
        self.invert_cluster_matrices(ctx, active, penalty=True)

    def prepare_solve(self, ctx: StepContext, active: wp.array) -> None:
        self.invert_cluster_matrices(ctx, active)

    @part("build")
    def invert_cluster_matrices(self, ctx: StepContext, active: wp.array, *, penalty: bool = False) -> None:
        """Assemble and invert the cluster matrices from the inverse diagonal blocks; `penalty`: set rho from them."""
        deflate = ctx.options.deflate_constraints
        if not (deflate or penalty):
            return
        m, w, con, k, launch = self.model, ctx.work, self.tables, deflation_kernels(self.model.dtype), ctx.launch
        data, mul = con.data, w.multipliers
        launch(k.assemble_pair_blocks, (m.worlds, con.block_count), [data, w.inverse, active, mul])
        launch(k.assemble_cluster_matrices, self.dim, [data, active, mul])
        launch(k.assemble_cluster_couplings, (m.worlds, con.coupling_count), [data, active, mul])
        if penalty:
            launch(k.compute_penalty, self.dim, [data, w.step.dq_dv, active, mul])
        if not deflate:
            return
        clusters = len(con.cluster_sizes)
        launch(k.invert_clusters, (m.worlds, clusters), [data, w.step.dq_dv, MAX_THREAD_ROWS, active, mul])
        numbers, count, largest = self.large
        for pivot in range(largest):
            dim = (m.worlds, count, largest)
            launch(k.eliminate_pivot, dim, [data, numbers, pivot, active, mul])
            launch(k.scale_pivot_row, dim[:2], [data, numbers, pivot, active, mul])

    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        """Constraint part of H p, for the gather."""
        w = ctx.work
        args = [self.tables.data, w.multipliers, p, w.step.dq_dv, active]
        ctx.launch(self.integrator_kernels(ctx).product_terms, self.dim, args)

    @part("constraints")
    def predict_multipliers(self, ctx: StepContext, active: wp.array) -> None:
        """Multiplier part of the Newton step in work.direction."""
        w = ctx.work
        args = [self.tables.data, w.multipliers, w.direction, w.newton.norms.component_converged, w.step.dq_dv, active]
        ctx.launch(self.integrator_kernels(ctx).predict_change, self.dim, args)

    def accept_trial(self, ctx: StepContext, flags: wp.array) -> None:
        """Accept the trial's multipliers with every Newton step; the classical method uses its outer loop."""
        if not ctx.options.outer_multipliers:
            self.update_multipliers(ctx, flags)

    @part("constraints")
    def update_multipliers(self, ctx: StepContext, flags: wp.array) -> None:
        """Accept the trial's multipliers."""
        ctx.launch(self.integrator_kernels(ctx).accept_trial, self.dim, [flags, ctx.work.multipliers])

    @part("constraints")
    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array:
        """Work of drives and the constraint work of the chord at rest, J, over an accepted substep."""
        w, state = ctx.work, ctx.state
        args = [self.tables.data, w.multipliers, w.u, state.displacement, state.constraint_target, accepted]
        ctx.launch(self.integrator_kernels(ctx).work_terms, self.dim, args)
        return w.multipliers.rows

    @part("constraints")
    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        """Store multipliers, right-hand sides and turns of an accepted substep."""
        args = [accepted, ctx.work.multipliers, ctx.state.constraint_force, ctx.state.constraint_target]
        kernel, angles = self.integrator_kernels(ctx).store_multipliers, self.tables.angles
        if angles.joints:
            kernel = joint_angle_kernels(self.model.dtype).store_with_angles
            args += [*angles.tables, ctx.work.u, ctx.state.joint_angle]  # turns to the positions of the step
        ctx.launch(kernel, self.dim, args)

    def report(self, ctx: StepContext) -> None:
        """Report the force and moment on the child and the violation of each joint."""
        w, con, state = ctx.work, self.tables, ctx.state
        args = [con.data, w.multipliers, con.joint_data, state.displacement, state.constraint_force]
        dim = (self.model.worlds, len(con.joints))
        ctx.launch(self.integrator_kernels(ctx).joint_report, dim, [*args, self.report_offset, w.report])

    # in a linear solve

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        mul = ctx.work.multipliers
        return [("gradient", mul.gradient), ("stiffness", mul.penalty)]

    def copy_cached(self, ctx: StepContext, kept: CachedInputs, reuse: Any, accepted: wp.array) -> bool:
        args = [reuse, accepted, *kept.live, *kept.state, *kept.cached]
        ctx.launch(reuse_kernels(self.model.dtype).transfer_constraint_rows, self.dim, args)
        return True

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if "couplings" not in self.model.cache:
            self.model.cache["couplings"] = self.tables.pattern_couplings(matrix.pattern)

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """J^T rho J and, unless projected, sum lambda d2c/dq2."""
        k = constraint_block_kernels(self.model.dtype)
        pairs, count = self.model.cache["couplings"]
        args = [self.model.topology, matrix.pattern.data, pairs]
        kernel, more = k.add_penalties, list[Any](cached)
        if not projected:
            kernel, more = k.add_tangent, [self.tables.data, ctx.work.multipliers, ctx.midpoint_factor]
        ctx.launch(kernel, (self.model.worlds, count), [*args, *more, dq_dv, active, out])

    def block_modules(self) -> set[wp.Module]:
        return {constraint_block_kernels(self.model.dtype).module}

    @part("preconditioner")
    def precondition(
        self, ctx: StepContext, r: wp.array, z: wp.array, active: wp.array, into: wp.array | None = None
    ) -> None:
        """z -= D^-1 J^T (1/((dq/dv) rho) + J D^-1 J^T)^-1 J z on the constrained slots, z = D^-1 r; and r.z.

        With `into` the result is added to it instead.
        """
        m, w, k, launch = self.model, ctx.work, deflation_kernels(self.model.dtype), ctx.launch
        data, mul = self.tables.data, w.multipliers
        launch(k.restrict_to_constraints, self.dim, [data, mul, z, active])
        sizes = self.tables.colour_sizes
        if len(sizes) == 1:
            launch(k.apply_cluster_inverses, self.dim, [data, mul, active])
        else:
            first = np.concatenate([[0], np.cumsum(sizes)])
            for c in range(len(sizes)):
                launch(k.gauss_seidel_sweep, (m.worlds, int(sizes[c])), [data, mul, int(first[c]), 1, active])
            for c in range(len(sizes) - 2, -1, -1):
                launch(k.gauss_seidel_sweep, (m.worlds, int(sizes[c])), [data, mul, int(first[c]), 0, active])
        args = [data, mul, w.inverse, r, z, int(into is not None), active, w.warp_size]
        launch(
            k.subtract_constraint_part,
            (m.worlds, launch.padded(m.slots)),
            [*args, z if into is None else into, w.warp_rows],
        )

    def not_differentiable(self, ctx: StepContext) -> str | None:
        data = self.tables.data
        if ctx.midpoint and (self.tables.formulas or self.tables.has_velocity_rows):
            return "formulas and velocity rows with 'energy_momentum'"
        turned = ((data.kind.numpy() == ANGLE) & (data.law.numpy() >= 0)).any()
        return "driven angles with 'energy_momentum'" if ctx.midpoint and turned else None

    def is_symmetric(self, ctx: StepContext) -> bool:
        return not ctx.midpoint

    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        if not ctx.midpoint:
            return self.product(ctx, p, active)
        w = ctx.work
        args = [self.tables.data, w.multipliers, w.u, w.u_stage, p, w.step.dq_dv, int(start), int(transposed), active]
        ctx.launch(exact_product_kernel(self.model.dtype), self.dim, args)
        return None

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        def add(at: StepAdjoint, out: wp.array) -> None:
            w = at.ctx.work
            args = [self.tables.data, w.multipliers, at.mu, at.w, w.step.dq_dv, w.u, law, at.active, at.sums]
            at.ctx.launch(at.kernels.right_side_sums, self.model.worlds, args)
            at.accumulate(out, 1.0)

        return add if (self.tables.data.law.numpy() == law).any() else None

    # evaluation at a state

    def evaluate(self, state: State, multipliers: np.ndarray | None = None) -> Any:
        """Multiplier struct with the rows evaluated at a state, for given multipliers (rows,) and no penalty."""
        m, con, B = self.model, self.tables, self.model.worlds
        launch = Launcher(m.device)

        def zeros(shape: tuple[int, ...], dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=m.device)

        value, all_worlds = m.terms.time_laws.values_at_state(launch, state)
        mul = self._make_multipliers(lambda name, shape, dtype: zeros(shape, dtype), midpoint=False)
        mul.rows = zeros((TERM_ROWS, *self.dim), wp.float64)
        if multipliers is not None:
            mul.multiplier.assign(np.tile(multipliers, (B, 1)))
        mul.last_target.fill_(np.nan)  # any number of turns is valid
        u, zero = state.displacement, zeros((B,), wp.float64)
        if con.has_velocity_rows:  # at rest
            con.update_velocity_rows(launch, u, all_worlds, mul)
        rest = [value, zero, all_worlds, mul]
        self._evaluate_rows(launch, False, [con.data, u, u, *rest], [*rest, u, u, zero, zeros((B,), wp.int32)])
        return mul

    def values(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Values [world, row], gradients [world, 3 row + side, 3] and right-hand sides [world, row] at a state."""
        mul = self.evaluate(state)
        return mul.constraint_value.numpy(), mul.gradient.numpy(), mul.target.numpy()

    def jacobian(self, state: State, world: int) -> sp.csr_matrix:
        """dc/dq of one world, (rows, 3 slots) CSR."""
        return self.tables.expand_jacobian(self.values(state)[1][world].reshape(-1, 3, 3))

    def curvature(self, state: State, multipliers: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """sum_i multipliers_i d2c_i/dq2 direction, [world, slot, 3]; multipliers (rows,), direction (slots, 3)."""
        return self._curvature(self.evaluate(state, multipliers), direction)

    def _curvature(self, mul: Any, direction: np.ndarray) -> np.ndarray:
        """`curvature` of rows that are evaluated."""
        m, con = self.model, self.tables
        host = np.tile(direction, (m.worlds, 1, 1))
        p: Any = wp.array(host.astype(np.dtype(m.dtype)), dtype=m.types.vec3, device=m.device)
        one = wp.ones(m.worlds, dtype=wp.float64, device=m.device)
        all_worlds = wp.ones(m.worlds, dtype=wp.int32, device=m.device)
        Launcher(m.device)(self.kernels.product_terms, self.dim, [con.data, mul, p, one, all_worlds])
        out = np.zeros((m.worlds, m.slots, 3))
        terms = mul.product.numpy()
        for world in range(m.worlds):
            np.add.at(out[world], con.slot_host, con.weight_host[:, None] * terms[world, con.term_host])
        return out

    def matrices(self, state: State, world: int) -> tuple[sp.csr_matrix | None, sp.csr_matrix | None]:
        """Geometric stiffness of the joint forces of a state, by one product per colour of slots and axis."""
        if "constraint_force" not in state.names or not state.constraint_force.numpy()[world].any():
            return None, None
        m = self.model
        mul = self.evaluate(state, state.constraint_force.numpy()[world])
        rows, slots, count = self.incidence()
        touched = sp.csr_matrix((np.ones(len(rows)), (rows, slots)), shape=(count, m.slots))
        graph = (touched.T @ touched).tocoo()
        colour = assembly.greedy_colouring(graph.tocsr())
        entries = []
        for c in range(int(colour[slots].max()) + 1):
            row, column = (index[colour[graph.col] == c] for index in (graph.row, graph.col))
            for axis in range(3):
                direction = np.zeros((m.slots, 3))
                direction[np.unique(column), axis] = 1.0
                values = self._curvature(mul, direction)[world]
                entries += [(values[row, k], 3 * row + k, 3 * column + axis) for k in range(3)]
        value, row, column = (np.concatenate(part) for part in zip(*entries))
        return sp.csr_matrix((value, (row, column)), shape=(3 * m.slots,) * 2), None
