"""Solution of the adjoint of a step on the device, by the simulation's own operator and preconditioner.

The operator is the exact tangent at the converged state, from the elements or their matrix of this step: neither a
matrix of another iterate nor a predicted stress; residuals are those of products by either. With constraints its
penalties make it the augmented operator A = H + J^T R J, and mu += R J w after each solve (Uzawa's method) leads to the
bordered system [H J^T; J 0]. Each refinement solves for the residual. The first iterate is extrapolated from the steps
before on the way back; where a motion is smooth it leaves 1e-3 to 1e-7 of the right side. Where a term's tangent is not
symmetric, BiCGStab solves with the transposed products of all terms, preconditioned by the symmetric part.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.launch import launch_part
from ..kernels.common.structs import product_terms_struct, topology_struct
from ..kernels.solvers.adjoint import MAX_ORDER, adjoint_kernels, adjoint_struct
from ..kernels.step.adjoint import step_adjoint_kernels
from ..kernels.step.gather import gather_kernels
from ..kernels.terms.constraints import constraint_struct, multiplier_struct
from ..terms.gradients import with_fields
from ..terms.protocols import Constrained, Differentiable
from .bicgstab import BiCGStab

if TYPE_CHECKING:
    from .newton import NewtonLoop
    from .residual import Residual

__all__ = ["AdjointSolver", "ExactOperator"]


class ExactOperator:
    """Products with the exact H, or its transpose, of all terms: the operator of a `PCG` or `BiCGStab`."""

    def __init__(self, residual: Residual, *, transposed: bool) -> None:
        self.ctx, self.transposed = residual.ctx, transposed
        self.reduce, self.vector_kernels = residual.reduce, residual.vector_kernels
        m, w, traits = residual.model, residual.work, residual.ctx.traits
        self.constraint_data, self.product_terms = residual.constraint_data, residual.product_terms
        if traits.nonpotential and not traits.tangent:  # forces without a tangent in H have one here
            side = (m.worlds, m.terms.nonpotential_entries)
            w.nonpotential_tangent = w.array("adjoint nonpotential tangent", side, m.types.vec3)
            of = m.terms.nonpotential_topology
            table = {"contribution_start": of.contribution_start, "contribution_entry": of.contribution_entry}
            table["contribution"] = w.nonpotential_tangent
            self.product_terms = with_fields(product_terms_struct(m.dtype), residual.product_terms, **table)
        self.kernels = gather_kernels(m.dtype, traits._replace(tangent=traits.nonpotential))
        self.residual, self.clusters = residual, residual.clusters
        if not residual.elements.is_symmetric(self.ctx):
            self.clusters = None

        self.without_mass = with_fields(product_terms_struct(m.dtype), self.product_terms)
        self.without_mass.mass_factor = wp.zeros(m.worlds, dtype=wp.float64, device=m.device)

    def product(
        self, p: wp.array, out: wp.array, active: wp.array, topology: Any = None, *, start: bool = False
    ) -> None:  # fmt: skip
        """out = H p, on the free components of a topology, by default those of the model; p is 0 elsewhere then.

        `start`: (dq/dv) K p with the derivative K of the forces of a mid-point scheme by the start of the step.
        """
        ctx = self.ctx
        m, w, launch = ctx.model, ctx.work, ctx.launch
        clusters = None if topology else self.clusters
        for term in m.terms.having(Differentiable):
            if clusters and term is self.residual.elements:
                self.residual.cluster_products(p, active)
            else:
                term.exact_product(ctx, p, active, transposed=self.transposed, start=start)
        terms = self.without_mass if start else self.product_terms
        args = [clusters.topology if clusters else topology or m.topology, w.contribution, terms, p, active]
        total = self.kernels.with_mass_sum if clusters else self.kernels.operator_product
        size = (m.worlds, launch.padded(m.slots))
        launch(total, size, [*args, self.constraint_data, w.multipliers, out, w.warp_rows])


class AdjointSolver:
    """Adjoint of the step that a Newton loop is linearised at. The loop then serves it alone: its linear solver is
    replaced.

    Attributes:
        bars: derivatives of the loss by arrays of the state, by their names; `solve` replaces those at the end of a
            step by those at its start, as far as these do not act through a history. q_bar, v_bar: of displacements and
            velocities [world, slot].
        w: multipliers of the residual, m/N of the loss. mu: of the constraint rows, times h.
        drive_bar: derivatives by driven displacements. reactions: False where neither these nor bars of prescribed
            displacements at the start are wanted.
        control: norms of the residual.
    """

    def __init__(self, newton: NewtonLoop, integrator: Any, driven: wp.array, tol: float) -> None:
        self.newton, self.integrator, self.driven = newton, integrator, driven
        self.model, self.work, self.launch = newton.model, newton.work, newton.launch
        m, w = self.model, self.work
        self.constrained = m.terms.traits.constraint_rows
        self.kernels = adjoint_kernels(m.dtype, self.constrained)
        self.step_kernels = step_adjoint_kernels(m.dtype, integrator, newton.ctx.traits.impacts)

        def field(name: str) -> wp.array:
            return w.array(f"adjoint {name}", (m.worlds, m.slots), m.types.vec3)

        self.w, self.rhs, self.drive_bar = field("w"), field("right side"), field("drive")
        self.bars = {name: field(name) for name in ("displacement", "velocity")}
        for name in integrator.history_arrays:
            self.bars.setdefault(name, field(name))
        self.q_bar, self.v_bar = self.bars["displacement"], self.bars["velocity"]
        self.state_bars = [self.q_bar, self.v_bar, *(self.bars[name] for name in integrator.history_arrays)]
        tables = m.terms.find(Constrained).tables if self.constrained else None
        self.constraint_data: Any = tables.data if tables else constraint_struct()()
        self.operator = ExactOperator(newton.residual, transposed=True)
        self.linear = newton.pcg
        self.reactions = True
        self.force: Any = None  # of `step_forward`
        self.symmetric = all(term.is_symmetric(newton.ctx) for term in m.terms.having(Differentiable))
        if not self.symmetric:
            # a transposed tangent may resist translations that the tangent does not
            operator: Any = self.operator
            self.linear = BiCGStab(m, w, self.launch, operator, newton.preconditioner,
                max_iterations=w.pcg.max_iterations, max_work=w.pcg.max_work, deflate=False)  # fmt: skip
            newton.pcg = self.linear
        assembler = newton.residual.assembler
        if assembler and newton.residual.uses_matrix and self.symmetric:  # it is assembled in each step
            assembler.enlarge_chunks()
        self.mu = w.array("adjoint mu", (m.worlds, tables.count if tables else 1), wp.float64)
        count = (MAX_ORDER + 1, m.worlds)
        self.control: Any = w.struct(adjoint_struct(), m.worlds, sums=(3, m.worlds), difference_sums=count)
        self.control.tol = tol
        # exact factors need no first iterate, an equilibrium has none
        self.extrapolates = newton.ctx.inertia and not newton.plan.factors_operator
        kept = MAX_ORDER if self.extrapolates else 0
        self.differences = w.array("adjoint differences", (kept, m.worlds, m.slots), m.types.vec3)
        self.mu_differences = w.array("adjoint mu differences", (kept, *self.mu.shape), wp.float64)
        self.dim = (m.worlds, m.slots)
        self.scale = w.array("adjoint scale", (m.worlds,), wp.float64)
        self.ones = wp.ones(m.worlds, dtype=wp.float64, device=m.device)
        self.active = wp.zeros(m.worlds, dtype=wp.int32, device=m.device)
        # prescribed components too: products give their reactions
        unprescribed: wp.array = wp.zeros(m.slots, dtype=wp.uint8, device=m.device)
        self.topology = with_fields(topology_struct(m.dtype), m.topology, prescribed_bits=unprescribed)
        w.newton.solve.fixed_forcing = 1
        # with constraints each solve is one of Uzawa's method
        self.least_forcing = math.sqrt(tol) if self.constrained else 0.0

    def modules(self) -> set[wp.Module]:
        """Modules launched, besides those of the Newton loop."""
        return {self.kernels.module, self.step_kernels.module, self.operator.kernels.module} | self.linear.modules()

    def begin(self) -> None:
        """Begin to go through the steps of a run."""
        for array in (*self.bars.values(), self.control.residual, self.control.difference_sums):
            array.zero_()
        for array in (self.mu, self.differences, self.mu_differences):
            array.zero_()

    @property
    def running(self) -> wp.array:
        """Flags of the worlds of this step."""
        return self.work.step.running

    @launch_part("vectors")
    def solve(self) -> None:
        """Solve at the linearised step, and step back."""
        m, w, launch = self.model, self.work, self.launch
        active, step = self.running, w.step
        self.transpose(True)
        launch(self.step_kernels.right_side, self.dim, [step, *self.state_bars, active, self.rhs, self.w])
        w.Hp.zero_()
        self._solve_system(extrapolated=self.extrapolates)
        args = [step, m.topology, self.driven, self.w, w.gradient, active, *self.state_bars, self.drive_bar]
        launch(self.step_kernels.step_back, self.dim, args)
        if self.newton.ctx.midpoint:
            self.subtract_start_force(active)

    def subtract_start_force(self, active: wp.array) -> None:
        """Subtract from q_bar what w gives by the forces' derivatives at the start of the step."""
        w = self.work
        self.operator.product(self.w, w.Hp, active, self.topology, start=True)
        self.launch(self.kernels.subtract_force, self.dim, [w.Hp, w.step.dq_dv, active, self.q_bar])

    @launch_part("vectors")
    def step_forward(self, parameters: Callable[[], None], histories: Callable[[], None]) -> None:
        """Change of the state of the linearised step along a direction, of which the bars hold that of its start.

        `parameters` and `histories` add forces to `force`, and the former the change of driven positions to `drive`.
        """
        m, w, launch, k, step = self.model, self.work, self.launch, self.step_kernels, self.work.step
        active = self.running
        self.transpose(False)
        for array in (self.force, self.drive):
            array.zero_()
        parameters()
        args = [step, *self.state_bars, active, self.q_tilde, self.v_tilde, self.predicted]
        launch(k.predict_change, self.dim, args)
        args = [step, self.driven, m.topology.free, self.q_bar, self.drive, active, self.w]
        launch(k.prescribe_change, self.dim, args)
        if self.newton.ctx.midpoint:
            self.operator.product(self.q_bar, w.Hp, active, self.topology, start=True)
            launch(self.kernels.subtract_force, self.dim, [w.Hp, step.dq_dv, active, self.force])
        histories()
        launch(k.change_side, self.dim, [step, m.topology, self.predicted, self.force, active, self.rhs])
        self.operator.product(self.w, w.Hp, active, self.topology)
        self._solve_system()
        launch(k.change_state, self.dim, [step, self.w, self.q_tilde, self.v_tilde, active, *self.state_bars])

    def prepare_forward(self) -> None:
        """Allocate for `step_forward`."""
        if self.force is None:
            names = ("force", "predictor q", "predictor v", "predicted")
            arrays = (self.work.array(f"adjoint {name}", self.dim, self.model.types.vec3) for name in names)
            self.force, self.q_tilde, self.v_tilde, self.predicted = arrays
            self.drive = self.drive_bar

    def transpose(self, transposed: bool) -> None:
        """Take the operator and the rows of constraints, or their transposes."""
        mul = self.work.multipliers
        self.operator.transposed, self.multipliers = transposed, mul
        if not transposed and self.newton.ctx.midpoint:
            swapped = {"gradient": mul.end_gradient, "end_gradient": mul.gradient}
            self.multipliers = with_fields(multiplier_struct(), mul, **swapped)

    def _solve_system(self, *, extrapolated: bool = False) -> None:
        """Solve for w from the right side, at w and its product work.Hp, or at the values extrapolated."""
        m, w, launch = self.model, self.work, self.launch
        newton, active = w.newton, w.newton.active
        for flags in (newton.norms.component_converged, newton.floor.estimate_error, newton.solve.predicted_stress):
            flags.zero_()
        w.pcg.step_iterations.zero_()
        wp.copy(active, self.running)
        if self.symmetric or self.newton.plan.factors_operator:
            self.newton.residual.assemble_matrix(active)  # a matrix of the operator is that of this step
        if extrapolated:
            self._extrapolate()
        else:
            self.mu.zero_()
            self._check(start=1)
        wp.capture_while(self.control.any_active, self._refine)
        wp.copy(active, self.running)
        if self.constrained:  # the residual is that of the bordered system
            w.multipliers.penalty.zero_()
        if self.constrained or self.reactions:
            self._product(reactions=True)
            self._evaluate_residual()
        launch(self.kernels.note_residual, m.worlds, [self.control, active])
        if extrapolated:
            launch(self.kernels.add_differences, self.dim, [self.w, w.diagonal, active, self.differences, w.rows])
            self.newton.residual.reduce(w.rows, MAX_ORDER + 1, active, self.control.difference_sums)

    def _extrapolate(self) -> None:
        """First iterate w, mu from the steps before, where it is better than 0."""
        launch, k, ctl, running = self.launch, self.kernels, self.control, self.running
        launch(k.extrapolate, self.dim, [ctl, self.differences, running, self.w])
        if self.constrained:
            launch(k.extrapolate_multipliers, self.mu.shape, [ctl, self.mu_differences, running, self.mu])
        self._product()
        self._check(start=2)
        launch(k.discard_extrapolation, self.dim, [ctl, self.rhs, running, self.w, self.mu, self.work.gradient])

    def history_fields(self) -> Iterator[tuple[str, wp.array, wp.array]]:
        """State arrays in the strain rates of incremental damping, each with x and scale of `history_gradient`."""
        ctx, scheme = self.newton.ctx, self.integrator
        state, active = ctx.state, self.running
        parts = (0, 1, 2) if scheme.accelerated else (0, 2) if scheme.multistep else (0,)
        for part in parts:
            args = [self.work.step, part, state.displacement, state.velocity, ctx.u_before, active]
            self.launch(self.step_kernels.history_field, self.dim, [*args, self.work.p, self.scale])
            yield ("displacement", "velocity", scheme.history_arrays[0])[part], self.work.p, self.scale

    def add_predictor_bar(self, x: wp.array, active: wp.array) -> None:
        """Add bars x of q~ to those of the state at the start."""
        self.launch(self.step_kernels.add_predictor, self.dim, [self.work.step, x, active, *self.state_bars])

    def _refine(self) -> None:
        """Add the solution for the residual; worlds leave the flags of the Newton loop as they converge."""
        w, launch, k, active = self.work, self.launch, self.kernels, self.work.newton.active
        self.newton.preconditioner.prepare(active)
        self.linear.solve(active)
        self.newton.preconditioner.record_cost()
        launch(k.add_direction, self.dim, [w.direction, active, self.w])
        self._product()
        if self.constrained:
            args = [self.constraint_data, self.multipliers, self.w, w.step.dq_dv, active, self.mu]
            launch(k.update_multipliers, self.mu.shape, args)
        self._check(start=0)

    def _check(self, start: int) -> None:
        self._evaluate_residual()
        self.control.any_active.zero_()
        newton = self.work.newton
        args = [self.control, start, wp.float64(self.least_forcing), newton, newton.active]
        self.launch(self.kernels.check_residual, self.model.worlds, args)

    def _evaluate_residual(self) -> None:
        m, w, active = self.model, self.work, self.work.newton.active
        args = [m.topology.free, self.constraint_data, self.multipliers, self.mu, self.rhs, w.Hp, w.diagonal, active]
        self.launch(self.kernels.residual, self.dim, [*args, w.gradient, w.rows])
        self.newton.residual.reduce(w.rows, 2, active, self.control.sums)

    def _product(self, *, reactions: bool = False) -> None:
        """A w into work.Hp, by the solver's product where it is exact; `reactions`: on prescribed components too."""
        residual = self.newton.residual
        exact = self.symmetric and not residual.uses_predicted_stress and self.operator.transposed
        if exact and not reactions:
            residual.product(self.w, self.work.Hp, self.work.newton.active)
            return
        self.operator.product(self.w, self.work.Hp, self.work.newton.active, self.topology)
