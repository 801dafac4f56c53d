"""Error messages of failed steps and initially violated joints, with a hint for implausibly large loads (nominal stress
over E)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ConstraintError, ConvergenceError
from ..kernels.solvers import newton_control as codes
from ..kernels.solvers.convergence import STALL_ROUNDINGS
from ..kernels.terms.constraints import SINGLE_ROUNDING
from ..model.assembly import element_volumes
from ..model.contact_points import effective_modulus
from ..solvers import NewtonPCG
from ..terms.evaluation import lowest_jacobian
from ..terms.protocols import Diagnosed
from .discontinuities import discontinuous_drives_text
from .energy_growth import growth_error_text

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["check_initial_constraints", "step_error"]

FAILURE_REASONS = {
    codes.Failure.ITERATIONS: "Newton's method did not converge",
    codes.Failure.LINE_SEARCH: "the line search found no decrease",
    codes.Failure.JACOBIAN: "an element reached J <= 0, where its law is not defined,",
    codes.Failure.NAN: "a force or energy was not finite",
    codes.Failure.CURVATURE: "no descent direction was found",
    codes.Failure.STEP_LIMIT: "a term allowed no step along Newton's direction",
    codes.Failure.RESIDUAL_GROWTH: "the residual grew more than tenfold",
    codes.Failure.ELEMENT_INVERTED: "an element inverted (J <= 0)",
    codes.Failure.LOCAL_ERROR: "the error tolerance was not met within 65536 substeps",
}
INDEFINITE_FAILURES = (codes.Failure.ITERATIONS, codes.Failure.LINE_SEARCH, codes.Failure.CURVATURE)
"""Failures that an indefinite tangent may explain."""
NO_ERROR_ESTIMATE = 1e30
"""Value of an unavailable error estimate."""
MAX_INITIAL_VIOLATION = 1e-4
"""Largest initial constraint violation (over the model size) accepted by dynamics."""
MIN_OVERLOAD_RATIO = 0.3
"""Smallest reported nominal stress over E."""

MAX_CRUSHED_J = 0.1
"""Ratio of volumes below which a message names the most compressed element."""


def step_error(sim: Any, world: int) -> ConvergenceError | ConstraintError:
    """Error of a world whose step was rejected after all halvings."""
    assert sim.last is not None
    work = sim.stepper.work
    code = int(sim.last.failure[world])
    time = float(sim.last.time[world])
    # no halving follows the last rejection
    halvings = min(int(sim.last.halvings[world]) - 1, sim.solver.max_halvings)
    if code == codes.Failure.ENERGY_GROWTH:
        text = f"{_step_text(sim, time, world)} was not taken in world {world}: {growth_error_text(sim, world)}"
        return ConvergenceError(text, time=time, world=world, state=sim.state)
    if code == codes.Failure.CONSTRAINT:
        return _constraint_error(sim, world, time, halvings)
    count = int(work.newton.iterations.numpy()[world]) + 1
    history = work.newton.norms.residual_history.numpy()[world, :count].tolist()
    J, element, where = lowest_jacobian(sim.model, work.u.numpy()[world].astype(float))
    if code not in (codes.Failure.JACOBIAN, codes.Failure.ELEMENT_INVERTED):
        crushed = f"; most compressed: {where}" if J < MAX_CRUSHED_J else ""
        element, where = _worst_element(sim.model, work.g.numpy()[world])
        where += crushed
    reason, hint = _failure_reason(sim, code, world)
    if sim.integrator.stabilise and work.step.mass_factor.numpy()[world] == 0.0:
        hint += (
            "; the stabilising springs vanish at full load, where supports and contact alone do not restrain the bodies"
        )
    hint += overload_text(sim.model)
    lumped = [c.name for c in sim.model.description.contacts if c.model == "sphere"] if sim.integrator.static else []
    if lumped and code != codes.Failure.ROUNDOFF:
        hint += f"; the single contact point of {lumped[0]!r} jumps as the body rolls: use model='patch' in statics"
    spent, most = int(sim.last.newton[world]), int(work.step.newton_budget)
    if code != codes.Failure.WORK and most and spent >= most and halvings < sim.solver.max_halvings:
        hint += f"; {spent} Newton iterations used up max_work = {sim.solver.max_work}"
    jumps = "" if code == codes.Failure.ROUNDOFF else discontinuous_drives_text(sim, world)
    kind: type[ConvergenceError] = ConvergenceError
    for term in sim.model.terms.having(Diagnosed):
        if (found := term.failure_reason(sim.stepper.ctx, world)) is not None:
            kind, text = found
            reason, hint = f"{text}; {reason}", ""
        else:
            hint += term.failure_note(sim.stepper.ctx, world)
    return kind(
        f"{_step_text(sim, time, world)} was not accepted in world {world}: "
        f"{reason} after {halvings} halvings; relative residuals "
        f"{', '.join(f'{x:.2e}' for x in history[-4:])}; worst {where}{hint}{jumps}",
        time=time, world=world, residuals=history, element=element, state=sim.state,
    )  # fmt: skip


def _failure_reason(sim: Any, code: int, world: int) -> tuple[str, str]:
    """Reason of a Newton failure, and a remedy."""
    work, dtype = sim.stepper.work, sim.model.dtype
    smaller = "; try more load steps" if sim.integrator.static else "; try a smaller dt"
    direct = sim.stepper.newton.direct
    if code == codes.Failure.CURVATURE and direct is not None and world in direct.singular_worlds:
        return "singular tangent matrix (unconstrained body or mechanism?)", ""
    near = _is_near_round_off(sim, world)
    parts = all(getattr(body, "rigid", False) for body in sim.model.bodies)
    finer = "; check the units, and inertias beside mass times size^2" if parts else (
        "; use fewer, stouter elements, or check the units")  # fmt: skip
    finer = "; use float64" if dtype == "float32" else finer
    adaptive = sim.stepper.step_size_control
    if code == codes.Failure.ROUNDOFF and adaptive and (least := adaptive.smallest_resolved_error(world)):
        hides = f"{dtype} round-off of displacements hides the local errors of substeps"
        return hides, f"{finer}, or error = {1.05 * least:.2g} or more"
    if code == codes.Failure.LOCAL_ERROR:
        return FAILURE_REASONS[code], f"; {'use float64, or ' if dtype == 'float32' else 'use '}a larger error"
    if code == codes.Failure.ROUNDOFF:
        eta = float(work.newton.floor.error_estimate.numpy()[world])
        left = ""
        if eta < NO_ERROR_ESTIMATE:
            left = f" (estimated error {eta:.2g})"
        return f"{dtype} round-off limit reached{left}", finer
    if code == codes.Failure.WORK:
        spent = f"the step took {int(work.pcg.step_iterations.numpy()[world])} CG iterations"
        limit = f"max_work = {sim.solver.max_work}"
        if near and dtype == "float32":
            return f"float32 round-off limit reached: {spent} ({limit})", finer
        slivers = f"; raise {limit} of NewtonPCG, or look for slivers and extreme contrasts of stiffness"
        return spent, "" if overload_text(sim.model) else slivers
    if code == codes.Failure.ELEMENT_INVERTED:
        return FAILURE_REASONS[code], f"{smaller}, or NeoHookean in place of SVK; inversion='report' lets it pass"
    bent = sim.integrator.static and int(work.newton.solve.met_negative_curvature.numpy()[world])
    if code in INDEFINITE_FAILURES and near and (dtype == "float32" or not bent):
        return f"{dtype} round-off limit reached", finer
    if code in INDEFINITE_FAILURES and bent and dtype == "float32":
        return f"{FAILURE_REASONS[code]}: forces in float32 have a direction without stiffness", (
            f"{finer}, which says whether the equilibrium is unstable, or more load steps"
        )
    if code in INDEFINITE_FAILURES and bent:
        return f"{FAILURE_REASONS[code]}: unstable equilibrium (buckling or snap-through)", (
            "; follow the post-critical path by damped dynamics or displacement control"
        )
    return FAILURE_REASONS.get(code, "unknown reason"), smaller


def _is_near_round_off(sim: Any, world: int) -> bool:
    """True if the residual, or in float32 a violation of constraints, may be round-off of the positions."""
    work = sim.stepper.work
    if float(work.newton.floor.rounding_ratio.numpy()[world]) <= STALL_ROUNDINGS:
        return True
    if sim.model.dtype == "float64" or sim.model.constraints is None:
        return False
    return bool(sim.stepper.newton.constraint_tol < SINGLE_ROUNDING * np.abs(work.u.numpy()[world]).max())


def _step_text(sim: Any, time: float, world: int) -> str:
    """Rejected step, by its time (s) or load fraction."""
    if sim.integrator.static:
        return f"load step from {100.0 * time:.4g} % to {100.0 * (time + sim.dt):.4g} % of the load"
    own = np.broadcast_to(sim.dt, sim.model.worlds)[world]
    dt = f"{own:g} s" if sim.error is None else f"'auto', error = {sim.error:g}"
    return f"step from t = {time:.6g} s with dt = {dt}"


def check_initial_constraints(sim: Any, mask: np.ndarray | None = None) -> None:
    """Raise ConstraintError if dynamics starts with violated constraints, in the worlds of the mask (B,)."""
    if sim.model.constraints is None or sim.integrator.static:
        return
    for world, values in enumerate(sim.stepper.work.multipliers.constraint_value.numpy()):
        if mask is not None and not mask[world]:
            continue
        names, worst = _violated_joints(sim.model, values, MAX_INITIAL_VIOLATION * sim.model.size)
        if names:
            time = float(sim.time[world])
            raise ConstraintError(
                f"joint or constraint {names[0]!r}: initial violation {worst[0]:.3g} m in world {world} at t = "
                f"{time:.6g} s: start its drive at the present value, move the bodies, or assemble with solve_static",
                joints=names, violations=worst, world=world, time=time, state=sim.state,
            )  # fmt: skip


def _constraint_error(sim: Any, world: int, time: float, halvings: int) -> ConstraintError:
    """Error of constraints that stay violated at equilibrium."""
    tol = sim.stepper.newton.constraint_tol
    names, values = _violated_joints(sim.model, sim.stepper.work.multipliers.constraint_value.numpy()[world], tol)
    listed = ", ".join(f"{name!r} by {value:.3g} m" for name, value in zip(names[:4], values[:4]))
    few = "" if isinstance(sim.solver, NewtonPCG) else ", or Jacobi's iterations are too few"
    away = float(np.abs(sim.stepper.work.u.numpy()[world]).max())
    why = "conflicting with each other or with supports, or not reachable"
    if tol < np.finfo(sim.model.dtype).eps * away:
        why = f"the round-off of positions {away:.3g} m from the reference is larger: give constraint_tol="
    return ConstraintError(
        f"{_step_text(sim, time, world)}: constraints could not be satisfied in world {world} after "
        f"{halvings} halvings: {listed}{', ...' if len(names) > 4 else ''}; {why} (tolerance {tol:.3g} m)"
        f"{few}{discontinuous_drives_text(sim, world)}",
        joints=names, violations=values, time=time, world=world, state=sim.state,
    )  # fmt: skip


def _violated_joints(model: Model, values: np.ndarray, tol: float) -> tuple[list[str], list[float]]:
    """Names of the joints whose rows (rows,) exceed the tolerance, worst first, and their violations, m."""
    constraints = model.constraints
    assert constraints is not None
    worst = np.array([np.abs(values[rows]).max() for rows in constraints.rows_of])
    order = [k for k in np.argsort(-worst, kind="stable") if not worst[k] <= tol]
    return [constraints.joints[k].name for k in order], [float(worst[k]) for k in order]


def _worst_element(m: Model, residual: np.ndarray) -> tuple[int, str]:
    """Model index and description of the element with the largest residual (slots, 3) on its slots."""
    g = np.abs(residual * m.slot_table.free).max(axis=1)
    g = np.where(np.isfinite(g), g, np.inf)
    best, index, text = -1.0, -1, "element unknown"
    for block in m.blocks:
        for part in block.host_blocks:
            values = g[part.conn + part.body.slot_offset].max(axis=1)
            k = int(np.argmax(values))
            if values[k] > best:
                best, index = float(values[k]), part.body.element_offset + int(part.elements[k])
                text = f"element {int(part.elements[k])} of body {part.body.name!r} (residual {best:.3g} N)"
    return index, text


def overload_text(model: Model) -> str:
    """Load with the largest nominal stress over E of its body, if above MIN_OVERLOAD_RATIO; else "".

    Nominal stress: the value of a traction or pressure; force over the mean section (volume over longest side) for a
    point load; density times g times the longest side for gravity.
    """
    d = model.description
    loads = [(pressure.surface.body, "pressure", _largest_value(pressure.law), "Pa") for pressure in d.pressures]
    loads += [(x.body, x.name, _largest_value(x.law), "Pa" if x.name == "traction" else "N") for x in d.dead_loads]
    volume: dict[Any, float] = {body: float(element_volumes(body).sum()) for body in model.bodies}
    side: dict[Any, float] = {b: float(np.ptp(b.mesh.bounding_box(), axis=0).max()) for b in model.bodies}
    g = float(np.linalg.norm(model.terms.dead_loads.gravity.numpy(), axis=1).max())
    loads += [(b, "weight", model.masses.total_of_body(b) / volume[b] * g * side[b], "Pa") for b in model.bodies]
    found = [(0.0, "", 0.0, "", "")]
    for loaded, what, value, unit in loads:
        stress = value if unit == "Pa" else value / (volume[loaded] / side[loaded])
        found.append((stress / effective_modulus(loaded)[0], what, value, unit, loaded.name))
    ratio, what, value, unit, name = max(found)
    if ratio < MIN_OVERLOAD_RATIO:
        return ""
    E = max(effective_modulus(body)[0] for body in model.bodies if body.name == name)
    nominal = "" if unit == "Pa" else ", as a stress,"
    return (
        f"; the {what} of {value:.3g} {unit} on body {name!r}{nominal} is {ratio:.3g} times E = {E:.3g} Pa: check the "
        "units of load and E"
    )


def _largest_value(law: Any) -> float:
    """Largest value of a time law, 0 for a function of time or a control."""
    return float(np.linalg.norm(law.values, axis=1).max()) if len(law.times) else 0.0
