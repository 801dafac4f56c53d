"""Tiled block-Jacobi descent with acceleration, at a fixed number of iterations per step: options and loop.

One iteration takes one residual evaluation and one application of B, the two-level preconditioner of H with or without
its coarse space: v += p, with p from z = B r, r = -g, and previous moves. B is reused by the rule of
kernels/solvers/reuse.py. Accelerations:

- "secants": with S the last moves and Y the resulting changes of r, p = S c + 0.7 z, where S c is the Galerkin solution
  on the moves, (S^T Y) c = S^T r, and z = B (r - Y c); p is made conjugate to the moves. This is a block BFGS update of
  B (Schnabel 1983), as used with L-BFGS by Liu, Bouaziz, Kavan 2017, "Quasi-Newton methods for real-time simulation of
  hyperelastic materials", and symmetrised Anderson acceleration of type I (Fang and Saad 2009). For constant H it
  reduces to conjugate gradients with step lengths delayed by one iteration.
- "anderson": without the conjugation, one reduction less: Anderson acceleration of type I.
- "chebyshev": the semi-iteration as in Wang 2015, "A Chebyshev semi-iterative approach for accelerating projective and
  position-based dynamics", for eigenvalues of B H between `LARGEST_EIGENVALUE` / max(4, iterations^2 / 4) and
  `LARGEST_EIGENVALUE`.
- "none": p = 0.5 z.

Measured (tests/results/jacobi_cpu.json): "secants" needs the fewest iterations on solids and joints, with a lead
that grows with their number; "anderson" is comparable up to 8, and better by a factor of two on a slender beam;
"chebyshev" is comparable on stiff bodies at about 8 iterations, stalls at eigenvalues outside its interval, and fails
with joints. Rejected after tests: Anderson type II in the D^-1 norm (like type I), a factor of 1 or 0.5 in place of 0.7
(no clear difference), multiplier updates in every iteration (diverges).

Constraints: the multipliers stay fixed during a step and are updated once, by rho c, on acceptance.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..base.launch import launch_part
from ..kernels.solvers.jacobi import MAX_PAIRS, jacobi_kernels, jacobi_struct
from ..terms.protocols import Updated
from .newton import NewtonLoop, NewtonPCG

if TYPE_CHECKING:
    from ..terms.term import StepContext
    from .plan import SolverPlan

__all__ = ["Jacobi", "JacobiLoop"]

ACCELERATIONS = ("secants", "anderson", "chebyshev", "none")
"""Accelerations of the module docstring."""
MAX_RESIDUAL_GROWTH = 10.0
"""Largest accepted ratio of the final to the initial residual of a step."""
MAX_VIOLATION = 1e-3
"""Largest accepted constraint violation over the model's size."""
STEP_LENGTH = {"secants": 0.7, "anderson": 0.7, "chebyshev": 1.0, "none": 0.5}
"""Factor of z = B r in the move, by acceleration."""
LARGEST_EIGENVALUE = 3.5
"""Assumed largest eigenvalue of B H, as for the coarse levels of the preconditioner."""


@dataclass(frozen=True)
class Jacobi:
    """Tiled block-Jacobi descent (dense inverses of 48 unknowns) at a fixed cost per step; approximate.

    A step is accepted after `iterations` whatever its residual (`StepReport.residual`, `residual_force`);
    `StepReport.converged` is False above the tolerance. As with Newton's method a step is rejected and halved if its
    residual ends at ten times the initial one, a constraint stays violated by a thousandth of the model's size, a force
    is not finite or, with laws that need J > 0, an element has J <= 0. Meant for soft bodies and small steps.

    Args:
        iterations: maximum iterations per step, each one residual and one application of the tile inverses.
        coarse: add the affine motions of groups of tiles. Without them an iteration is cheaper, but stiff or long
            bodies respond far too softly or are torn apart by their loads.
        acceleration: "secants", "anderson", "chebyshev", or "none".
        tol: a step within this tolerance ends early and counts as converged; defaults of NewtonPCG.
        force_tol: as for NewtonPCG, N.
        max_halvings: maximum number of halvings of a rejected step.
        penalty: stiffness of a constraint over that of the tied slots. Low values let joints open, high ones slow down
            convergence.

    Raises:
        ModelError: a value out of range.
    """

    iterations: int = 8
    coarse: bool = True
    acceleration: str = "secants"
    tol: float | None = None
    force_tol: float = 0.0
    max_halvings: int = 8
    penalty: float = 100.0

    def __post_init__(self) -> None:
        if not (is_count(self.iterations) and self.iterations >= 1):
            raise ModelError(f"Jacobi: iterations = {self.iterations!r} must be a whole number, at least 1")
        if self.acceleration not in ACCELERATIONS:
            names = ", ".join(repr(name) for name in ACCELERATIONS)
            raise ModelError(f"Jacobi: acceleration = {self.acceleration!r} is none of {names}")
        if self.tol is not None and not (is_number(self.tol) and 0.0 < self.tol < 1.0):
            raise ModelError(f"Jacobi: tol = {self.tol!r} must lie between 0 and 1")
        if not (is_number(self.force_tol) and self.force_tol >= 0.0):
            raise ModelError(f"Jacobi: force_tol = {self.force_tol!r} must be zero or positive, N")
        if not (is_count(self.max_halvings) and 0 <= self.max_halvings <= 20):
            raise ModelError(f"Jacobi: max_halvings = {self.max_halvings!r} must be a whole number from 0 to 20")
        if not isinstance(self.coarse, bool):
            raise ModelError(f"Jacobi: coarse = {self.coarse!r} must be True or False")
        if not (is_number(self.penalty) and self.penalty > 0.0):
            raise ModelError(f"Jacobi: penalty = {self.penalty!r} must be positive")

    @property
    def newton_options(self) -> NewtonPCG:
        """Options of the Newton loop that this loop inherits."""
        return NewtonPCG(
            tol=self.tol,
            force_tol=self.force_tol,
            max_newton=self.iterations,
            max_pcg=1,
            max_halvings=self.max_halvings,
            preconditioner="two-level" if self.coarse else "tiles",
            operator="elements",  # no H p: no matrix of the iterate
            multipliers="outer",
            penalty=self.penalty,
        )

    @property
    def max_newton(self) -> int:
        """Maximum iterations per step."""
        return self.iterations

    def tolerance(self, dtype: str) -> float:
        """Relative tolerance for precision "float64" or "float32"."""
        return self.newton_options.tolerance(dtype)


class JacobiLoop(NewtonLoop):
    """Newton loop with one preconditioner application in place of the linear solve, and no line search."""

    def __init__(
        self, ctx: StepContext, options: Jacobi, plan: SolverPlan, *, constraint_tol: float, inversion: str = "refuse"
    ) -> None:
        super().__init__(ctx, options.newton_options, plan, constraint_tol=constraint_tol, inversion=inversion)
        model, work = ctx.model, ctx.work
        # multipliers are updated once, on acceptance: no outer loop, and convergence includes violations
        self.outer_multipliers = False
        work.newton.norms.constraint_tol = constraint_tol
        self.acceleration = options.acceleration
        self.uses_secants = options.acceleration in ("secants", "anderson")
        self.descent_kernels = jacobi_kernels(model.dtype, model.terms.traits, options.acceleration)
        B, m = model.worlds, MAX_PAIRS
        shape = (m, B, model.slots) if self.uses_secants else (1, 1, 1)
        self.previous_moves = work.array("jacobi moves", shape, model.types.vec3)
        self.residual_changes = work.array("jacobi changes", shape, model.types.vec3)
        shapes: dict[str, Any] = {
            "gram_matrix": (B, m, m),
            "gram_factor": (B, m, m),
            "right_side": (B, m),
            "gamma": (B, m),
            "sums": (2 * m, B),
        }
        self.control = work.struct(jacobi_struct(), B, **shapes)
        self.control.max_growth = MAX_RESIDUAL_GROWTH
        self.control.max_violation = MAX_VIOLATION * model.size
        self.control.step_length = STEP_LENGTH[options.acceleration]
        least = LARGEST_EIGENVALUE / max(4.0, 0.25 * options.iterations**2)
        self.control.eigenvalue_centre = 0.5 * (LARGEST_EIGENVALUE + least)
        self.control.eigenvalue_half_width = 0.5 * (LARGEST_EIGENVALUE - least)

    def modules(self) -> set[wp.Module]:
        """Modules launched by the loop, except those of reductions and constraints."""
        return super().modules() | {self.descent_kernels.module}

    def _solve(self, first: bool = False) -> None:
        """Iterate and report cost and reduction to the reuse rule."""
        w = self.work
        self.launch(self.descent_kernels.begin_iteration, self.model.worlds, [w.newton, self.control])
        self._reduce_flags(w.newton.active, self.any_iterating)
        wp.capture_while(self.any_iterating, self._iterate)
        self._run_if_rare(self._check_inversion)
        self.launch(
            self.descent_kernels.report_cost, self.model.worlds, [w.newton, self.control, w.pcg, w.step.running]
        )
        self.preconditioner.record_cost()
        w.newton.active.zero_()

    def _iterate(self) -> None:
        w, k, launch = self.work, self.descent_kernels, self.launch
        active = w.newton.active
        self._compute_step(active)
        if self.limits_step:
            launch(self.kernels.reset_step_limit, self.model.worlds, [w.newton])
        self.terms.call(self.ctx, Updated, "process_direction", active)
        launch(k.apply_move, self.dim, [w.newton, w.direction, w.v])
        self.residual.evaluate(active)
        launch(k.check_iterate, self.model.worlds, [w.newton, self.control])
        if self.terms.traits.stored:
            self.terms.call(self.ctx, Updated, "accept_trial", active)
            self.terms.call(self.ctx, Updated, "update_frozen", active)
        self._reduce_flags(active, self.any_iterating)

    @launch_part("vectors")
    def _compute_step(self, active: wp.array) -> None:
        """Write the next move p to work.direction."""
        m, w, k, launch, ctl = self.model, self.work, self.descent_kernels, self.launch, self.control
        args = [w.newton, w.gradient, m.topology.free, w.direction, w.p, w.r, self.previous_moves]
        args += [self.residual_changes, w.rows]
        launch(k.store_pair, self.dim, args)
        if self.uses_secants:
            self.residual.reduce(w.rows, 2 * MAX_PAIRS, active, ctl.sums)
            launch(k.solve_gram, m.worlds, [w.newton, ctl])
            launch(k.project_residual, self.dim, [w.newton, ctl, self.residual_changes, w.r])
        elif self.acceleration == "chebyshev":
            launch(k.chebyshev_coefficients, m.worlds, [w.newton, ctl])
        self.preconditioner.apply(w.r, w.z, active)
        if self.acceleration == "secants":
            launch(k.conjugation_dot_terms, self.dim, [w.newton, self.residual_changes, w.z, w.rows])
            self.residual.reduce(w.rows, MAX_PAIRS, active, ctl.sums)
            launch(k.conjugate_move, m.worlds, [w.newton, ctl])
        launch(k.combine_move, self.dim, [w.newton, ctl, self.previous_moves, w.z, w.direction])
        if self.pcg.deflate_translations:  # a loose tolerance then conserves the momentum of free bodies
            args = [w.newton, w.step.mass_factor, m.components.free_groups.lumped_mass, w.gradient]
            args += [m.topology.free, w.direction, w.r]
            launch(k.residual_after_move, self.dim, args)
            self.pcg.correct_translations(active)
