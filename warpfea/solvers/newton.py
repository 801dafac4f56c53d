"""Newton's method with PCG: options, and the loop on the device."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..base.launch import launch_part
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.solvers.convergence import MAX_ERROR_ESTIMATES
from ..kernels.solvers.newton import newton_kernels
from ..kernels.solvers.newton_control import FLOOR_LANES
from ..kernels.solvers.perturbation import SAMPLES, perturbation_kernels
from ..kernels.solvers.vectors import vector_kernels
from ..terms.protocols import Constrained, Updated
from ..terms.term import Term
from .bicgstab import BiCGStab
from .direct import DirectSolver
from .pcg import PCG
from .plan import BLOCK_PRECONDITIONERS, PRECONDITIONERS, SolverPlan
from .preconditioner import BlockJacobi, Preconditioner
from .residual import Residual
from .twolevel import TwoLevel

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from ..terms.term import StepContext

__all__ = ["NewtonLoop", "NewtonPCG"]

MACHINE_EPSILON = {"float64": 2.0**-52, "float32": 2.0**-23}
MAX_ROUND_OFF_ERROR = {"float64": 1e-4, "float32": 2e-3}
"""Largest accepted error estimate (relative, energy norm) when round-off stops the residual."""
NEWTON_ITERATION_COST = {False: 20, True: 100}
"""CG iterations equivalent to one Newton iteration in `max_work`, without and with contact (line searches take many
evaluations). A slender column perturbed by 1e-4 of its load takes 8037 of the 10 000 in the load step that buckles it;
steps with contact rejected after 8 halvings take 500 to 800 of the 2000."""
ACCELERATION_SCALE = 9.81
"""Acceleration a, m/s^2, in the constraint tolerance a (dq/dv)^2 tol, m, of acceleration-level schemes."""
MIN_CONSTRAINT_TOL = 1e-14
"""Smallest constraint tolerance of acceleration-level schemes, over the model's size."""


@dataclass(frozen=True)
class NewtonPCG:
    """Newton's method with a line search; linear systems by preconditioned conjugate gradients or a factorisation.

    Args:
        tol: |g| over the free components <= tol x max(|f_int|, |f_ext|, |M a|) in the D^-1 norm (D: diagonal of H), for
            each connected part of the model and each group of similar stiffness in it. A thousandth of the reactions
            counts with f_int: a scale for a prescribed, stressed body without loads. None: 1e-8 in float64, 1e-4 in
            float32. If round-off stops the residual above it, the remaining error is estimated and reported
            (`StepReport.floor`); above 1e-4 in float64, 2e-3 in float32, the step is rejected.
        force_tol: absolute tolerance of |g|, plain norm over the free components, N (gradient slots in N m), sufficient
            for acceptance; 0: unused.
        forcing: relative residual of the linear solves; None: Eisenstat and Walker's, no further than needed.
        max_newton: iterations before a step is rejected.
        max_pcg: iterations per linear solve.
        max_halvings: maximum number of halvings of a rejected step.
        max_work: CG iterations in a step, rejected attempts included, at which the step fails, also within a solve. A
            rejected attempt is not halved either once the step's Newton iterations, each counted as 20 of those, with
            contact as 100, have reached it (not with dt="auto").
        preconditioner: "two-level" (dense tiles of 48 unknowns and affine motions of groups of them, reused while
            effective; in statics of short chains of beams factors of the whole), "tiles" (the tiles alone), "banded"
            (Cholesky factors of the whole, reused too, for chains, strips and slender or small bodies; on a GPU for
            small models only),
            "deflated" (3x3 blocks of every iterate, and inverted constraint directions), "block-jacobi" (the blocks
            alone), or "auto": "banded" for a narrow band or small model, on a GPU only for many worlds, else "deflated"
            for many small bodies on joints, else "two-level".
        linear: "pcg", or "direct": a sparse factorisation, by SuperLU or on a GPU by cuDSS if installed.
        preconditioner_dtype: storage precision of the inverses of "two-level", "float32" or "float64"; None: the
            model's. They are computed in the model's precision; float32 halves the memory traffic of an application. A
            precision other than the model's excludes "banded".
        operator: H p from the "elements", from the "matrix" of 3x3 blocks, or "auto", the cheaper one. In dynamics
            without constraints the matrix of an earlier iterate is reused while Newton's method converges as fast.
        multipliers: solution of constraint forces: "newton", with every Newton step, or "outer", the classical
            augmented Lagrangian, in a loop around the Newton solves.
        penalty: kappa, the penalty of a constraint over the stiffness of the tied slots; None: 1000 in float64, 100 in
            float32, where larger values cost tile inverses their positive definiteness by round-off.
        max_outer: multiplier updates of the classical method.

    Raises:
        ModelError: a value out of range.
    """

    tol: float | None = None
    force_tol: float = 0.0
    forcing: float | None = None
    max_newton: int = 30
    max_pcg: int = 2000
    max_halvings: int = 8
    max_work: int = 200_000
    preconditioner: str = "auto"
    linear: str = "pcg"
    preconditioner_dtype: str | None = None
    operator: str = "auto"
    multipliers: str = "newton"
    penalty: float | None = None
    max_outer: int = 100

    def __post_init__(self) -> None:
        for name in ("tol", "forcing"):
            value = getattr(self, name)
            if value is not None and not (is_number(value) and 0.0 < value < 1.0):
                raise ModelError(f"NewtonPCG: {name} = {value!r} must lie between 0 and 1")
        if not (is_number(self.force_tol) and self.force_tol >= 0.0):
            raise ModelError(f"NewtonPCG: force_tol = {self.force_tol!r} must be zero or positive, N")
        if self.penalty is not None and not (is_number(self.penalty) and self.penalty > 0.0):
            raise ModelError(f"NewtonPCG: penalty = {self.penalty!r} must be positive")
        self._check_choices()
        for name in ("max_newton", "max_pcg", "max_outer", "max_work"):
            if not (is_count(getattr(self, name)) and getattr(self, name) >= 1):
                raise ModelError(f"NewtonPCG: {name} = {getattr(self, name)!r} must be a whole number, at least 1")
        if not (is_count(self.max_halvings) and 0 <= self.max_halvings <= 20):
            raise ModelError(f"NewtonPCG: max_halvings = {self.max_halvings!r} must be a whole number from 0 to 20")

    def _check_choices(self) -> None:
        """ModelError for a name that is none of an option's, and for options that a direct solver does not have."""
        if self.linear not in ("pcg", "direct"):
            raise ModelError(f"NewtonPCG: linear = {self.linear!r} is neither 'pcg' nor 'direct'")
        idle = {"preconditioner": "auto", "preconditioner_dtype": None, "forcing": None}
        for name, default in idle.items() if self.linear == "direct" else ():
            if getattr(self, name) != default:
                raise ModelError(f"NewtonPCG: {name} = {getattr(self, name)!r} is not for linear = 'direct'")
        if self.preconditioner not in ("auto", *PRECONDITIONERS):
            known = ", ".join(PRECONDITIONERS)
            raise ModelError(f"preconditioner {self.preconditioner!r} is unknown; there are auto, {known}")
        if self.preconditioner_dtype not in (None, "float32", "float64"):
            raise ModelError(
                f"NewtonPCG: preconditioner_dtype = {self.preconditioner_dtype!r} is none of 'float32', 'float64', None"
            )
        if self.operator not in ("auto", "elements", "matrix"):
            raise ModelError(f"NewtonPCG: operator = {self.operator!r} is none of 'auto', 'elements', 'matrix'")
        if self.multipliers not in ("newton", "outer"):
            raise ModelError(f"NewtonPCG: multipliers = {self.multipliers!r} is neither 'newton' nor 'outer'")

    def newton_budget(self, contact: bool) -> int:
        """Newton iterations in a step, with or without contact, that use up `max_work`."""
        return max(self.max_work // NEWTON_ITERATION_COST[contact], 1)

    def tolerance(self, dtype: str) -> float:
        """Relative tolerance for precision "float64" or "float32"."""
        return self.tol if self.tol is not None else {"float64": 1e-8, "float32": 1e-4}[dtype]

    def penalty_ratio(self, model: Model) -> float:
        """Constraint penalty ratio kappa, the penalty over the stiffness of the tied slots.

        By default 1e3, 1e2 in float32. With rigid parts 1e5: they yield only by their mass, and chains of them with a
        heavy end converge by 0.9 an iteration with 1e3.
        """
        if self.penalty is not None:
            return self.penalty
        if any(body.rigid for body in model.bodies):
            return {"float64": 1e5, "float32": 1e3}[model.dtype]
        return {"float64": 1e3, "float32": 1e2}[model.dtype]


@dataclass(frozen=True)
class TermOptions:
    """Solver options that terms need.

    Attributes:
        outer_multipliers: multipliers are updated in an outer loop.
        penalty_ratio: kappa, penalty of a constraint over the stiffness of the tied slots.
        deflate_constraints: the preconditioner lacks the penalties; terms correct it.
    """

    outer_multipliers: bool
    penalty_ratio: float
    deflate_constraints: bool


class NewtonLoop:
    """Newton loop of all worlds: conditional loops on the device, one code path with and without capture.

    Attributes:
        plan: the methods.
    """

    def __init__(
        self,
        ctx: StepContext,
        options: NewtonPCG,
        plan: SolverPlan,
        *,
        constraint_tol: float,
        inversion: str = "refuse",
    ) -> None:
        model, work, launch, inertia = ctx.model, ctx.work, ctx.launch, ctx.inertia
        self.ctx, self.model, self.work, self.launch, self.terms = ctx, model, work, launch, model.terms
        self.plan, self.constraint_tol = plan, constraint_tol
        traits = ctx.traits
        self.kernels, self.vector_kernels = newton_kernels(traits), vector_kernels(model.dtype, traits.has_constraints)
        self.limits_step = traits.limited
        self.outer_multipliers = traits.has_constraints and options.multipliers == "outer"
        self.max_outer = options.max_outer
        penalty_ratio = options.penalty_ratio(model)
        ctx.options = TermOptions(self.outer_multipliers, penalty_ratio, plan.deflates_constraints)
        work.newton.floor.max_error = MAX_ROUND_OFF_ERROR[model.dtype]
        self.terms.call(ctx, Constrained, "configure")
        self.residual = Residual(ctx, plan)
        self.direct = DirectSolver(ctx, self.residual) if plan.linear == "direct" else None
        kind = BlockJacobi if plan.preconditioner in BLOCK_PRECONDITIONERS else TwoLevel
        self.preconditioner: Preconditioner = self.direct or kind(model, work, launch, self.residual)
        linear_solver = BiCGStab if plan.krylov == "bicgstab" else PCG
        self.pcg = linear_solver(
            model, work, launch, self.residual, self.preconditioner,
            max_iterations=options.max_pcg, max_work=options.max_work, deflate=inertia,
        )  # fmt: skip
        # in float32 negative curvature may be noise; factors meet it at the first direction
        work.pcg.leaves_saddles = int(not inertia and model.dtype == "float64" and self.direct is None)
        self.dim = (model.worlds, model.slots)
        ctl = work.newton
        ctl.dq_dv = work.step.dq_dv
        ctl.solve.first_forcing, ctl.solve.fixed_forcing = plan.first_forcing, int(options.forcing is not None)
        ctl.norms.force_tol, ctl.norms.tol = options.force_tol, options.tolerance(model.dtype)
        ctl.floor.eps = MACHINE_EPSILON[model.dtype]
        # in exact arithmetic conjugate gradients end after as many iterations as there are unknowns
        spent = model.dtype == "float32" and self.direct is None and options.max_pcg >= 3 * model.slots
        ctl.solve.max_stalled_solves = MAX_ERROR_ESTIMATES if spent else 0
        ctl.is_static, ctl.model_size = int(not inertia), float(model.size)
        ctl.norms.component_of_group = model.components.residual_groups.component
        ctl.max_iterations = options.max_newton
        ctl.refuse_inversion = int(inversion == "refuse")
        ctl.linear_stress = int(all(block.key.law in DEFINED_FOR_ANY_J for block in model.blocks))
        rate = inertia and any(b.key.damping == "rate" for b in model.blocks)
        ctl.has_nonpotential = int(traits.nonpotential or rate)
        ctl.classical_multipliers = int(self.outer_multipliers)
        ctl.norms.penalty_norm_ratio = 1.0 / math.sqrt(1.0 + penalty_ratio)
        ctl.norms.constraint_tol = 1e300 if self.outer_multipliers else constraint_tol  # inner solves converge g only
        if ctx.accelerated and model.dtype == "float64":  # float32 positions have a larger round-off
            ctl.norms.constraint_acceleration_tol = max(constraint_tol / model.size, ctl.norms.tol) * ACCELERATION_SCALE
            ctl.norms.constraint_tol_min = MIN_CONSTRAINT_TOL * model.size
        # double precision has no such round-off; forces at a mid-point are not those of the positions
        self.perturbation_kernels = None
        if model.dtype == "float32" and not ctx.midpoint:
            self.perturbation_kernels = perturbation_kernels(model.dtype)
            self.perturbed_worlds = work.array("perturbed", (model.worlds,), wp.int32)
        self.first_iterate_candidates: Sequence[Callable[[], None]] = ()
        self.any_iterating = work.any_flag[0:1]
        self.any_searching = work.any_flag[1:2]

    def register(self, state: State) -> None:
        """Register the solver history in the state."""
        self.preconditioner.register(state)
        self.residual.register(state)

    def invalidate(self, flags: wp.array) -> None:
        """Invalidate solver history of the flagged worlds."""
        self.preconditioner.invalidate(flags)
        self.residual.invalidate(flags)

    def store_history(self, accepted: wp.array) -> None:
        """Store solver history in the state."""
        self.preconditioner.store_history(accepted)
        self.residual.store_history(accepted)

    def modules(self) -> set[wp.Module]:
        """Modules launched by the loop, except those of reductions and terms."""
        out = {self.kernels.module} | self.pcg.modules()
        out |= {self.perturbation_kernels.module} if self.perturbation_kernels else set()
        return out | self.preconditioner.modules() | self.residual.modules()

    def run(self) -> None:
        """Iterate from work.v until every active world has converged or failed.

        `first_iterate_candidates` write other first iterates to work.v in worlds whose `start.has_alternatives` is set.
        """
        w = self.work
        self._clear_direction(w.newton.active)
        self._evaluate_first_iterate(w.newton.active)
        self._solve(first=True)
        if self.outer_multipliers:
            self._check_constraints()
            wp.capture_while(self.any_iterating, self._update_multipliers)

    def _evaluate_first_iterate(self, flags: wp.array, *, rebuild: bool = False) -> None:
        """Evaluate the first iterate; its convergence check needs D, so the blocks come first."""
        self.residual.update_positions(flags)
        self.terms.call(self.ctx, Term, "prepare", flags)
        self.preconditioner.start(flags, rebuild=rebuild)
        self.terms.call(self.ctx, Constrained, "scale", flags)
        self.residual.evaluate(flags, freeze=True)

    def _solve(self, first: bool = False) -> None:
        """Newton iteration from the current residual; `first`: first solve of an attempt."""
        w = self.work
        choose = bool(self.first_iterate_candidates) and first
        self.launch(self.kernels.begin_iteration, self.model.worlds, [w.newton, int(choose)])
        self._run_if_rare(self._choose_first_iterate if choose else self._check_inversion)
        if self.terms.traits.unilateral:  # the first iterate may be the solution, as in free fall
            self._update_frozen()
        self._reduce_flags(w.newton.active, self.any_iterating)
        wp.capture_while(self.any_iterating, self._iterate)

    @launch_part("control")
    def _choose_first_iterate(self) -> None:
        """Select the best first iterate (J > 0 first, then lowest Phi)."""
        w, k, launch = self.work, self.kernels, self.launch
        choose, better = w.newton.start.has_alternatives, w.newton.search.active
        launch(k.compare_first_iterates, self.model.worlds, [w.newton, 1, better])
        launch(self.vector_kernels.copy_active, self.dim, [w.v, better, w.best_velocity])
        for put in self.first_iterate_candidates:
            put()
            self.residual.evaluate(choose, freeze=True)
            launch(k.compare_first_iterates, self.model.worlds, [w.newton, 0, better])
            launch(self.vector_kernels.copy_active, self.dim, [w.v, better, w.best_velocity])
        launch(self.vector_kernels.copy_active, self.dim, [w.best_velocity, choose, w.v])
        self._evaluate_first_iterate(choose, rebuild=True)
        launch(k.begin_iteration, self.model.worlds, [w.newton, 2])
        self._check_inversion()

    def _check_constraints(self) -> None:
        w = self.work
        args = [w.newton, w.step.running, self.constraint_tol, self.max_outer]
        self.launch(self.kernels.check_constraints, self.model.worlds, args)
        self._reduce_flags(w.newton.active, self.any_iterating)

    def _update_multipliers(self) -> None:
        """Update multipliers, lambda += rho c, in worlds with violated constraints; solve again from the current v."""
        w = self.work
        self.terms.call(self.ctx, Constrained, "update_multipliers", w.newton.search.trial_accepted)
        self.residual.evaluate(w.newton.active, freeze=True)
        self._solve()
        self._check_constraints()

    def _iterate(self) -> None:
        w, k, launch = self.work, self.kernels, self.launch
        active = w.newton.active
        self.residual.linearise(active)
        if self.perturbation_kernels:
            with launch.rare():
                wp.capture_if(w.newton.floor.any_estimate_error, self._average_perturbed_residuals)
        self.preconditioner.prepare(active)
        self.pcg.solve(active)
        self.residual.freeze_nonpotential(active)
        self.residual.tangent_curvature(active)
        self.preconditioner.record_cost()
        if self.limits_step:
            launch(k.reset_step_limit, self.model.worlds, [w.newton])
        self.terms.call(self.ctx, Updated, "process_direction", active)
        self.terms.call(self.ctx, Updated, "predict_frozen", active)
        self.terms.call(self.ctx, Constrained, "predict_multipliers", active)
        launch(self.vector_kernels.set_base, self.dim, [w.newton, w.v, w.base_velocity, w.best_velocity])
        launch(self.vector_kernels.dot_terms, self.dim, [w.gradient, w.direction, active, w.rows])
        self.residual.reduce(w.rows, 1, active, w.newton.search.slope_sum)
        launch(k.begin_search, self.model.worlds, [w.newton, w.pcg])
        self._line_search()
        self._run_if_rare(self._run_rare_branch)
        if self.terms.traits.unilateral:
            self._update_frozen()
        if self.preconditioner.follows_iterates:
            self.preconditioner.start(active)
        self.terms.call(self.ctx, Constrained, "prepare_solve", active)
        self._reduce_flags(active, self.any_iterating)

    @launch_part("control")
    def _average_perturbed_residuals(self) -> None:
        """Replace the residual by its mean over perturbed positions before the error estimate.

        The round-off of the residual depends on the bits of the iterate. Newton's method converges to iterates where it
        cancels, which hides the error, most of all along soft directions.
        """
        w, k, launch, flags = self.work, self.perturbation_kernels, self.launch, self.perturbed_worlds
        assert k is not None
        launch(k.begin_samples, self.dim, [w.newton, flags, w.p, w.z])
        for sample in range(SAMPLES):
            self.residual.update_positions(flags)
            launch(k.perturb_positions, self.dim, [w.newton, flags, sample, w.u, w.p])
            self.residual.evaluate_forces(flags)
            launch(k.add_sample, self.dim, [flags, w.gradient, w.z])
        self.residual.product(w.p, w.Hp, flags)
        args = [self.model.topology, w.step.mass_factor, flags, w.p, w.Hp, w.z, w.gradient]
        launch(k.mean_gradient, self.dim, args)
        w.newton.floor.any_estimate_error.zero_()

    @launch_part("control")
    def _update_frozen(self) -> None:
        """Update frozen quantities of terms (friction limits) where the residual is at most `FROZEN_UPDATE_RESIDUAL` or
        within round-off, or no iteration is left."""
        w, flags = self.work, self.work.newton.search.trial_accepted
        self.launch(self.kernels.begin_frozen_update, self.model.worlds, [w.newton, flags])
        self._reduce_flags(flags, self.any_searching)
        wp.capture_if(self.any_searching, self._reevaluate_frozen)

    def _reevaluate_frozen(self) -> None:
        w, flags = self.work, self.work.newton.search.trial_accepted
        self.terms.call(self.ctx, Updated, "update_frozen", w.newton.frozen.update_due)
        self.residual.reevaluate_frozen(flags)
        self.launch(self.kernels.end_frozen_update, self.model.worlds, [w.newton, flags])
        self._run_if_rare(self._check_inversion)

    @launch_part("control")
    def _run_rare_branch(self) -> None:
        """Rare branch: error estimate, step length of non-monotone trials, further searches, inversion check."""
        m, w, k = self.model, self.work, self.kernels
        parts = m.components.error_estimate_groups
        args = [w.newton, parts.slot_start, parts.slot, parts.element_start, parts.element]
        args += [w.gradient, w.direction, w.inertia, w.v, w.v_tilde, w.u, w.energy_rows]
        self.launch(self.vector_kernels.floor_partials, (m.worlds, parts.count, FLOOR_LANES), args)
        self.launch(k.check_rounding_floor, m.worlds, [w.newton, parts.component])
        if self.perturbation_kernels:
            self.residual.evaluate(self.perturbed_worlds)
            self.perturbed_worlds.zero_()
        self._line_search()
        self.residual.elements.measure_direction_gradient(self.ctx, w.direction, w.newton.active)
        self.launch(k.limit_nonmonotone_step, m.worlds, [w.newton])
        self._line_search()
        self._check_inversion()

    def _check_inversion(self) -> None:
        """Flag worlds with an element inverted by the accepted iterate."""
        w = self.work
        self.residual.elements.check_inversion(self.ctx, w.newton.inversion_suspected)
        w.newton.any_rare_branch.zero_()

    def _line_search(self) -> None:
        """Try step lengths until no world searches."""
        self._reduce_flags(self.work.newton.search.active, self.any_searching)
        wp.capture_while(self.any_searching, self._try_step_length)

    def _try_step_length(self) -> None:
        w, k, launch = self.work, self.kernels, self.launch
        args = [w.newton, w.base_velocity, w.direction, w.best_velocity, w.v]
        launch(self.vector_kernels.trial_velocity, self.dim, args)
        self.residual.evaluate(w.newton.search.active)
        launch(k.check_trial, self.model.worlds, [w.newton])
        if self.terms.traits.stored:
            self.terms.call(self.ctx, Updated, "accept_trial", w.newton.search.trial_accepted)
        self._reduce_flags(w.newton.search.active, self.any_searching)

    def _run_if_rare(self, do: Callable[[], None]) -> None:
        """Run `do` if any world needs the rare branch."""
        with self.launch.rare():
            wp.capture_if(self.work.newton.any_rare_branch, do)

    def _reduce_flags(self, flags: wp.array, out: wp.array) -> None:
        out.zero_()
        self.launch(self.vector_kernels.set_any_flag, self.model.worlds, [flags, out])

    def _clear_direction(self, active: wp.array) -> None:
        self.launch(self.pcg.kernels.initialise_residual, self.dim, [self.work.g, self.model.topology.free, active,
                                                       self.work.direction, self.work.r])  # fmt: skip
