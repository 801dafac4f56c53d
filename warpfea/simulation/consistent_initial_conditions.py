"""Consistent initial velocities and accelerations of generalized-alpha schemes.

At a state (q, v) at time t, with supports and constraints c(q, t) = 0, whose rates along the motion are c' and c'',

    M dv + J^T L = 0,    J (v + dv) + c_t = 0,        M w + J^T m = f - f_int,    J w = -(c'' without J w)

are solved on the host, by factors of the mass matrix and a dense matrix of the constraints. In prescribed directions
a_0 = w(t + (am - af) h), and v_0 is offset by h^2 (1/6 - beta - (am - af)/2) w', the limit of constant steps (Arnold,
Bruels and Cardona 2015): without it the first reactions are of first order.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import scipy.sparse.linalg as spl

from ..base.errors import ModelError
from ..base.worlds import device_flags, set_rows
from ..kernels.step.step_control import STATUS
from ..kernels.terms.constraints import ANGLE, DISTANCE, FORMULA
from ..terms.protocols import Constrained
from ..terms.term import StepContext, Term
from ..time_laws import TimeLaw
from .discontinuities import jump_intervals, kink_times

if TYPE_CHECKING:
    from ..model.model import Model
    from ..solvers.residual import Residual
    from .integrators import Integrator

__all__ = ["ConsistentInitialConditions"]

TIME_TOL = 1e-6
"""Tolerance of equal times, over a step."""
MAX_FACTORED_SLOTS = 20_000
"""Maximum slots of a factorised mass matrix; larger ones are solved iteratively."""
FIRST_DERIVATIVE = np.array([-25.0, 48.0, -36.0, 16.0, -3.0]) / 12.0
SECOND_DERIVATIVE = np.array([35.0, -104.0, 114.0, -56.0, 11.0]) / 12.0
THIRD_DERIVATIVE = np.array([-5.0, 18.0, -24.0, 14.0, -3.0]) / 2.0
"""Finite-difference weights of the third derivative at the first of five points."""
RANK_TOL = 1e-11
"""Relative singular value of the constraint matrix below which rows are redundant."""


class ConsistentInitialConditions:
    """Recompute consistent initial accelerations after a reset or a discontinuity.

    Attributes:
        restart_count: number of restarts per world.
    """

    def __init__(self, ctx: StepContext, residual: Residual, integrator: Integrator) -> None:
        self.ctx, self.residual, self.integrator = ctx, residual, integrator
        self.model = ctx.model
        supports = ctx.model.terms.supports
        self.has_drives = supports.displacement_drives is not None or supports.rotation_drives is not None
        self.restart_count = 0
        self._discontinuities: tuple[float, np.ndarray, np.ndarray] = (0.0, np.zeros(0), np.zeros((2, 0)))
        self._mass: dict[int, list[tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]]] = {}
        self._parameter_version = -1  # parameter version of the factors in _mass
        self._world = 0  # the world being restarted
        check_rho_inf(ctx.model, integrator, self.has_drives)

    def prepare(self, dt: float) -> np.ndarray:
        """Restart the worlds that need it, before a step of size dt, s; their flags (B,)."""
        state = self.ctx.state
        time, known = state.time.numpy(), state.acceleration_end.numpy()  # type: ignore[attr-defined]
        after_jump, slope_jump = self._discontinuities_at(time, dt)
        flags = (state.status.numpy() == STATUS["running"]) & ((known != time) | slope_jump)  # type: ignore[attr-defined]
        if flags.any():
            self._restart_worlds(flags, time, after_jump, dt)
        return flags

    def law_derivatives(self, flags: np.ndarray, dt: float) -> np.ndarray:
        """Values of the time laws just after a jump at the state, and their three rates, (4, B, laws, 3)."""
        return self._law_derivatives(flags, self._discontinuities_at(self.ctx.state.time.numpy(), dt)[0], dt)

    def unbalanced_force(self, flags: np.ndarray, dt: float) -> np.ndarray:
        """Evaluate the forces of the state, just after a jump there, before a step of size dt; (B, slots, 3), N."""
        return self._unbalanced_force(flags, self._discontinuities_at(self.ctx.state.time.numpy(), dt)[0], dt)

    @property
    def jerk_factors(self) -> tuple[float, float]:
        """Parts of the jerk, over dt and dt^2, in accelerations, which belong to a time before, and in velocities."""
        rho = self.integrator.parameter
        early = (rho - 1.0) / (rho + 1.0)  # a_n belongs to the time t + early dt
        return early, 1.0 / 6.0 - 1.0 / (rho + 1.0) ** 2 - 0.5 * early

    def begin_world(self, world: int) -> None:
        """Choose the world that is solved for."""
        self._forget_old_factors()
        self._world = world

    def _forget_old_factors(self) -> None:
        if self._parameter_version != self.model.parameters.version:
            self._parameter_version = self.model.parameters.version
            self._mass.clear()

    def _discontinuities_at(self, time: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (B,) just after a jump at the state, else its own; and flags of a kink within the previous step."""
        if self._discontinuities[0] != dt:
            self._discontinuities = dt, *self._find_discontinuities(dt)
        near = TIME_TOL * dt
        _, times, (begins, ends) = self._discontinuities
        there = time[:, None]
        found = np.any((times > there - dt + near) & (times <= there + near), axis=1)
        steep = (begins <= there + near) & (ends > there)
        after_jump = np.where(steep, ends, there).max(axis=1, initial=-np.inf)
        return np.maximum(after_jump, time), found

    def _find_discontinuities(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """Times of all kinks, and starts and ends of jumps (2, n), for a step dt, s."""
        laws = self.model.terms.time_laws.laws
        steep = np.concatenate([np.zeros((0, 2)), *(jump_intervals(law, dt) for law in laws)])
        # accelerations stay continuous across force kinks
        bent = [kink_times(law, dt) for number, law in enumerate(laws) if number in self.drive_law_numbers()]
        return np.concatenate([steep[:, 0], *bent]), steep.T

    def drive_law_numbers(self) -> set[int]:
        """Indices of the laws that prescribe positions."""
        terms = self.model.terms
        tables = [terms.supports.displacement_drives, terms.supports.rotation_drives]
        tables += [term.tables.data for term in terms.having(Constrained)]
        return {number for table in tables if table is not None for number in table.law.numpy().ravel().tolist()}

    def _restart_worlds(self, flags: np.ndarray, time: np.ndarray, after_jump: np.ndarray, dt: float) -> None:
        state: Any = self.ctx.state
        self._forget_old_factors()
        laws = self._law_derivatives(flags, after_jump, dt)
        u, v = state.displacement.numpy().astype(float), state.velocity.numpy().astype(float)
        before = self._kinetic_energy(v)
        for world in np.flatnonzero(flags).tolist():
            self._world = world
            v[world] += self._velocity_correction(u[world], v[world], laws[:, world])
        set_rows(state.velocity, flags, v[flags])
        g = self._unbalanced_force(flags, after_jump, dt)
        w, a = np.zeros_like(v), np.zeros_like(v)
        early, late = self.jerk_factors
        for world in np.flatnonzero(flags).tolist():
            self._world = world
            motion = u[world], v[world], laws[:, world]
            w[world] = self._acceleration(g[world], *motion)
            jerk = self._jerk(*motion, w[world], 0.25 * dt)
            a[world] = w[world] + early * dt * jerk
            v[world] += late * dt**2 * jerk  # prescribed: the limit of a scheme with constant steps
        set_rows(state.velocity, flags, v[flags])
        self._record_impulse(flags, self._kinetic_energy(v) - before)
        set_rows(state.acceleration, flags, w[flags])
        set_rows(state.algorithmic_acceleration, flags, a[flags])
        set_rows(state.previous_step, flags, dt)
        set_rows(state.acceleration_end, flags, time[flags])
        self.restart_count += 1

    def _kinetic_energy(self, v: np.ndarray) -> np.ndarray:
        """1/2 v.M v, (B,), J."""
        masses = self.model.masses
        return np.array([0.5 * np.sum(one * (masses.world_matrix(world) @ one)) for world, one in enumerate(v)])

    def _record_impulse(self, flags: np.ndarray, change: np.ndarray) -> None:
        """Add the kinetic energy of the velocity correction to the integrator column of the ledger."""
        state: Any = self.ctx.state
        if "ledger" in state.specs:
            columns = list(self.model.terms.ledger)
            ledger = state.ledger.numpy()
            ledger[flags, columns.index("kinetic")] += change[flags]
            ledger[flags, columns.index("integrator")] -= change[flags]
            state.ledger.assign(ledger)

    def _law_derivatives(self, flags: np.ndarray, time: np.ndarray, dt: float) -> np.ndarray:
        """Values of the time laws and their first three rates after the time (B,), (4, B, laws, 3).

        Samples have the slope after the time only; functions are differenced over dt.
        """
        laws = self.model.terms.time_laws.laws
        points = np.array([self._law_values(flags, time + 0.25 * dt * k) for k in range(len(FIRST_DERIVATIVE))])
        out = np.zeros((4, *points.shape[1:]))
        out[0] = points[0]
        for k, law in enumerate(laws):
            if law.function is not None:
                for order, weights in enumerate((FIRST_DERIVATIVE, SECOND_DERIVATIVE, THIRD_DERIVATIVE), start=1):
                    out[order, :, k] = np.tensordot(weights, points[:, :, k], 1) / (0.25 * dt) ** order
            else:
                out[1, :, k] = [slope_after(law, t + TIME_TOL * dt) for t in time]
        return out

    def _law_values(self, flags: np.ndarray, time: np.ndarray) -> np.ndarray:
        """Values of the time laws in the flagged worlds at times (B,), (B, laws, 3)."""
        ctx, w, active = self.ctx, self.ctx.work, device_flags(flags, self.model.device)
        set_rows(w.step.new_time, flags, time[flags])
        laws = self.model.terms.time_laws
        laws.evaluate(ctx.launch, ctx.state, w.step.new_time, w.step.load_factor, active, w.time_law_values)
        return w.time_law_values.numpy().copy()

    def _unbalanced_force(self, flags: np.ndarray, time: np.ndarray, dt: float) -> np.ndarray:
        """f_int + J^T lambda - f at the state in the flagged worlds, with the laws at times (B,); (B, slots, 3), N."""
        m, ctx, w = self.model, self.ctx, self.ctx.work
        active = device_flags(flags, self.model.device)
        # strain rates of the state: E~ = E - (dq/dv) dE/dt
        step = {"load_factor": 1.0, "h": dt, "dq_dv": dt, "b": -dt, "q_a": 0.0, "mass_factor": 1.0 / dt}
        for name, value in step.items():
            set_rows(getattr(w.step, name), flags, value)
        self._law_values(flags, time)
        m.terms.dead_loads.take_gravity(ctx.launch, w.time_law_values, active)
        u, v = ctx.state.displacement.numpy(), ctx.state.velocity.numpy()
        for array, values in ((w.u, u), (w.v, v), (w.v_tilde, v), (w.q_tilde, u - dt * v)):
            set_rows(array, flags, values[flags])
        for stage in ("begin", "prepare"):
            m.terms.call(ctx, Term, stage, active)
        self.residual.evaluate_forces(active)
        return w.g.numpy().astype(float)

    # supports and constraints

    def constraint_rows(self, u: np.ndarray, v: np.ndarray, laws: np.ndarray) -> tuple[Any, np.ndarray, np.ndarray]:
        """J (rows, 3 slots), c' and c'' without J w (rows,); None and no rows without constraints."""
        tables = self.model.constraints
        if tables is None:
            return None, np.zeros(0), np.zeros(0)
        gradients, first, second = constraint_rates(tables, u, v, laws)
        return tables.expand_jacobian(gradients), first, second

    def prescribed_rates(self, laws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Velocities and accelerations (slots, 3) of prescribed components, 0 for others."""
        rate, acceleration = np.zeros((2, self.model.slots, 3))
        supports = self.model.terms.supports
        if (d := supports.displacement_drives) is not None:
            slot, law = d.slot.numpy(), d.law.numpy()
            k, c = np.nonzero(law >= 0)
            rate[slot[k], c] = laws[1][law[k, c], c]
            acceleration[slot[k], c] = laws[2][law[k, c], c]
        if (d := supports.rotation_drives) is not None:
            slot, law, on = d.slot.numpy(), d.law.numpy(), d.components.numpy() != 0.0
            angle, first, second = (laws[k][law, 0][:, None] for k in range(3))
            turn = np.cross(d.axis.numpy(), d.arm.numpy())
            twice = np.cross(d.axis.numpy(), turn)
            along = np.cos(angle) * turn + np.sin(angle) * twice
            across = np.cos(angle) * twice - np.sin(angle) * turn
            for target, values in ((rate, first * along), (acceleration, second * along + first**2 * across)):
                target[slot] = np.where(on, values, target[slot])
        prescribed = self.model.slot_table.free == 0.0
        return np.where(prescribed, rate, 0.0), np.where(prescribed, acceleration, 0.0)

    # linear algebra

    def _velocity_correction(self, u: np.ndarray, v: np.ndarray, laws: np.ndarray) -> np.ndarray:
        """Velocity correction dv, m/s; zero if consistent."""
        jump = self.prescribed_rates(laws)[0] - np.where(self.model.slot_table.free == 0.0, v, 0.0)
        J, first, _ = self.constraint_rows(u, v, laws)
        if J is None and not jump.any():
            return jump
        return self._solve_saddle_point(np.zeros_like(v), jump, J, -first)

    def _acceleration(self, g: np.ndarray, u: np.ndarray, v: np.ndarray, laws: np.ndarray) -> np.ndarray:
        """Acceleration w, m/s^2."""
        J, _, second = self.constraint_rows(u, v, laws)
        return self._solve_saddle_point(-g, self.prescribed_rates(laws)[1], J, -second)

    def _jerk(self, u: np.ndarray, v: np.ndarray, laws: np.ndarray, w: np.ndarray, s: float) -> np.ndarray:
        """Jerk dw/dt, m/s^3, prescribed by supports and constraints, by differences over -s .. s.

        Elastic jerk is omitted: it is unresolved for stiff bodies.
        """
        if self.model.constraints is None and not self.has_drives:
            return np.zeros_like(w)
        return self.solve_jerk(u, v, laws, w, s)[0]

    def solve_jerk(
        self, u: np.ndarray, v: np.ndarray, laws: np.ndarray, w: np.ndarray, s: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Jerk, and its multipliers."""
        prescribed, constraint_rhs = np.zeros_like(w), None
        for sign in (-0.5 / s, 0.5 / s):
            x = np.copysign(s, sign)
            taylor = [[1.0, x, x**2 / 2.0, x**3 / 6.0], [0.0, 1.0, x, x**2 / 2.0], [0.0, 0.0, 1.0, x]]
            there = np.tensordot(taylor, laws, 1)
            prescribed += sign * self.prescribed_rates(there)[1]
            if self.model.constraints is not None:
                J, _, second = self.constraint_rows(u + x * v + 0.5 * x**2 * w, v + x * w, there)
                constraint_rhs = (0.0 if constraint_rhs is None else constraint_rhs) - sign * (second + J @ w.ravel())
        rows = self.constraint_rows(u, v, laws)[0]
        return self.solve_saddle_point(np.zeros_like(w), prescribed, rows, constraint_rhs)

    def _solve_saddle_point(self, *args: Any) -> np.ndarray:
        return self.solve_saddle_point(*args)[0]

    def solve_saddle_point(
        self, force: np.ndarray, prescribed: np.ndarray, J: Any = None, constraint_rhs: Any = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """x and m of M x + J^T m = force on free components, x = prescribed on others, J x = constraint_rhs."""
        m = self.model
        x = self._solve_mass(force - m.masses.world_matrix(self._world) @ prescribed) + prescribed
        if J is None:
            return x, np.zeros(0)
        free = m.slot_table.free.ravel() != 0.0
        columns = (J.toarray() * free).reshape(-1, m.slots, 3)
        inverse = np.array([self._solve_mass(row).ravel() for row in columns])  # rows of J M^-1
        matrix = J @ inverse.T
        multipliers = np.linalg.lstsq(matrix, J @ x.ravel() - constraint_rhs, rcond=RANK_TOL)[0]
        return x - (multipliers @ inverse).reshape(x.shape), multipliers

    def _solve_mass(self, force: np.ndarray) -> np.ndarray:
        """M^-1 force on the free components, 0 on others."""
        world = self._world if self.model.masses.varies_by_world else 0
        if world not in self._mass:
            self._mass[world] = [mass_solver(self.model, c, world) for c in range(3)]
        out = np.zeros_like(force)
        for c, (free, solve) in enumerate(self._mass[world]):
            if len(free) and force[free, c].any():
                out[free, c] = solve(force[free, c])
        return out


def mass_solver(model: Model, component: int, world: int = 0) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Free slots of a component, and a solver for their mass matrix."""
    free = np.flatnonzero(model.slot_table.free[:, component])
    M = model.masses.world_matrix(world)[free][:, free].astype(float).tocsc()
    if len(free) <= MAX_FACTORED_SLOTS:
        return free, spl.splu(M).solve if len(free) else lambda f: f
    scale = sp.diags(1.0 / M.diagonal())
    return free, lambda f: spl.cg(M, f, rtol=1e-14, atol=0.0, maxiter=2000, M=scale)[0]


def slope_after(law: TimeLaw, time: float) -> np.ndarray:
    """Slope (3,) of a sampled law in the interval that contains a time or begins there; 0 outside its samples."""
    k = int(np.searchsorted(law.times, time, side="right")) - 1
    if k < 0 or k >= len(law.times) - 1:
        return np.zeros(3)
    return (law.values[k + 1] - law.values[k]) / (law.times[k + 1] - law.times[k])


def constraint_rates(
    tables: Any, u: np.ndarray, v: np.ndarray, laws: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gradients (rows, 3, 3), first rates c' (rows,) m/s, and second rates without J w, m/s^2, of the rows of one
    world.

    u, v: (slots, 3); laws: (3 or 4, laws, 3), values, rates and second rates. See kernels/terms/constraints.py.
    """
    moved, speed = (term_vectors(tables, field) for field in (u, v))
    return rates_of_vectors(tables, moved, speed, right_sides(tables, laws))


def term_vectors(tables: Any, field: np.ndarray) -> np.ndarray:
    """Vectors (3 rows, 3) of the rows' terms of a field (slots, 3)."""
    out = np.zeros((3 * tables.count, 3))
    np.add.at(out, tables.term_host, tables.weight_host[:, None] * field[tables.slot_host])
    return out


def right_sides(tables: Any, laws: np.ndarray) -> np.ndarray:
    """Right sides of the rows and their first two rates, (3, rows)."""
    out = np.zeros((3, tables.count))
    out[0] = tables.data.constant_target.numpy()
    law, component = tables.data.law.numpy(), tables.data.law_component.numpy()
    on = law >= 0
    for k in range(3):
        out[k, on] += laws[k][law[on], component[on]]
    return out


def rates_of_vectors(
    tables: Any, moved: np.ndarray, speed: np.ndarray, targets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`constraint_rates` from the vectors of displacements and velocities and the right sides; real or complex."""
    count = tables.count
    a, b, a2 = (tables.reference_host + moved).reshape(count, 3, 3).swapaxes(0, 1)
    da, db, da2 = speed.reshape(count, 3, 3).swapaxes(0, 1)
    kind, scale = tables.data.kind.numpy(), tables.scale_host
    f, df, ddf = targets
    kind_of_numbers = np.result_type(moved, speed, targets)

    def dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sum(x * y, axis=1)

    G = np.stack([b, a, np.zeros_like(a)], axis=1).astype(kind_of_numbers)
    first, second = (dot(da, b) + dot(a, db) - df).astype(kind_of_numbers), 2.0 * dot(da, db) - ddf
    second = second.astype(kind_of_numbers)
    far = kind == DISTANCE
    size = np.where(far, np.sqrt(dot(a, a)), 1.0)
    n = a / size[:, None]
    G[far] = np.stack([n, 0 * a, 0 * a], axis=1)[far]
    first[far] = (dot(n, da) - df)[far]
    second[far] = ((dot(da, da) - dot(n, da) ** 2) / size - ddf)[far]
    turn = kind == ANGLE
    s, c, w, dw = (x[:, None] for x in (np.sin(f), np.cos(f), df, ddf))
    d, e = c * a2 - s * a, s * a2 + c * a
    rate = c * da2 - s * da - w * e
    bend = -2.0 * w * (s * da2 + c * da) - dw * e - w**2 * d
    G[turn] = np.stack([-s * b, d, c * b], axis=1)[turn]
    first[turn] = (dot(rate, b) + dot(d, db))[turn]
    second[turn] = (dot(bend, b) + 2.0 * dot(rate, db))[turn]
    G, first, second = scale[:, None, None] * G, scale * first, scale * second
    if tables.formulas or tables.has_velocity_rows:
        own, v = kind >= FORMULA, np.stack([da, db, da2], axis=1)
        gradients, curvature = tables.formula_derivatives(np.stack([a, b, a2], axis=1))
        G[own] = gradients[own]
        first[own] = (np.einsum("rsc,rsc->r", gradients, v) - scale * df)[own]
        second[own] = (np.einsum("rsc,rstcd,rtd->r", v, curvature, v) - scale * ddf)[own]
    return G, first, second


def check_rho_inf(model: Model, integrator: Integrator, driven: bool) -> None:
    """Raise ModelError if prescribed positions would make the accelerations of an undamped scheme grow."""
    if integrator.parameter < 1.0:
        return
    if model.constraints is not None or driven:
        what = f"joint {model.constraints.joints[0].name!r}" if model.constraints is not None else "a drive"
        raise ModelError(
            f"{integrator!r}: rho_inf = 1 is unstable with constraints, and the model has {what}: use rho_inf "
            "< 1, e.g. 0.2"
        )
