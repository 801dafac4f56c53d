"""Adjoint of the initial accelerations of generalized-alpha, on the host as they are: three solves with M and J,

    M dv + J^T l = 0, J dv = -c',    M w + J^T m = f - f_int, J w = -c'',    M k + J^T n = 0, J k = R,

for the correction of velocities, accelerations and the jerk k, with R the rate of -c'' - J w by differences, and
a_0 = w + e k, v_0 = v + dv + l k. Each has multipliers (y, z) of its own, M y + J^T z = bar, J y = 0, and adds
-y.(dJ^T m + dM x) - z.(dJ x - dr). The rows' part is differentiated by a complex step in the vectors of their terms. Of
f - f_int it is the adjoint of a step with the strain rates of the state, b = -h.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.worlds import set_rows
from ..terms.gradients import COMPLEX_STEP, ForceGradient
from ..terms.protocols import Constrained, Differentiable
from ..terms.shape_gradients import MESH
from .consistent_initial_conditions import rates_of_vectors, right_sides, term_vectors

if TYPE_CHECKING:
    import warp as wp

    from ..model.model import Model
    from ..terms.gradients import StepAdjoint
    from .stepper import Stepper

__all__ = ["check_initial_conditions", "check_names", "step_back_to_initial"]


def check_names(initial: Any, names: Iterable[str]) -> None:
    """ModelError for a drive that is no control: its rates are accelerations too, by X where it turns nodes."""
    if initial is None:
        return
    laws, turn = initial.model.terms.time_laws, initial.model.terms.supports.rotation_drives
    if MESH in names and turn and any(laws.laws[k].control is None for k in turn.law.numpy().ravel().tolist()):
        raise ModelError(f"Adjoint: {MESH!r} has no derivative with rotations that generalized_alpha starts from")
    for name in names:
        if name in laws.names and name not in laws.controls and {*laws.indices_of(name)} & initial.drive_law_numbers():
            raise ModelError(f"Adjoint: {name!r} has no derivative with generalized_alpha: give it as a wf.Control")


def check_initial_conditions(model: Model, scheme: Any) -> None:
    """ModelError for constraints whose rates are not known by the vectors of their terms."""
    for term in model.terms.having(Constrained) if scheme.accelerated else ():
        if term.tables.formulas or term.tables.has_velocity_rows:
            raise ModelError(
                f"Adjoint: the initial accelerations of {scheme.name!r} have no adjoint with formulas and velocity rows"
            )


class RowsOfWorld:
    """Bars of the rows' vectors in one world.

    Attributes:
        vectors: of u, v before, v corrected, and w, with their bars; targets: right sides and their rates.
    """

    def __init__(self, tables: Any, fields: list[np.ndarray], laws: np.ndarray, s: float) -> None:
        self.tables, self.laws, self.s = tables, laws, s
        self.vectors = [term_vectors(tables, field) for field in fields]
        self.bars = [np.zeros_like(vector) for vector in self.vectors]
        self.target_bar = np.zeros(tables.count)

    def _along(self, G: np.ndarray, x: np.ndarray) -> np.ndarray:
        """J x of each row."""
        return np.einsum("rsc,rsc->r", G, x.reshape(-1, 3, 3))

    def add(self, work: Callable[..., np.ndarray]) -> None:
        """Add the derivatives of a sum of rows, work(u, v, v1, w, shift of the right sides), by the vectors."""
        for number, bar in enumerate(self.bars):
            for k in range(9):
                near = [vector.astype(complex) for vector in self.vectors]
                near[number].reshape(-1, 9)[:, k] += 1j * COMPLEX_STEP
                bar.reshape(-1, 9)[:, k] += work(*near, 0.0).imag / COMPLEX_STEP
        self.target_bar += work(*self.vectors, 1j * COMPLEX_STEP).imag / COMPLEX_STEP

    def solve_work(self, y: np.ndarray, z: np.ndarray, x: np.ndarray, m: np.ndarray, right: Any) -> None:
        """Add -y.J^T m - z.J x + z.right of a solve; right(u, v, v1, w, targets)."""
        Y, X = (term_vectors(self.tables, field) for field in (y, x))

        def work(*given: Any) -> np.ndarray:
            *vectors, shift = given
            targets = right_sides(self.tables, self.laws) + np.array([[1.0], [0.0], [0.0]]) * shift
            G, _, _ = rates_of_vectors(self.tables, vectors[0], vectors[1], targets)
            return -m * self._along(G, Y) - z * self._along(G, X) + z * right(*vectors, shift)

        self.add(work)

    def rates(self, u: np.ndarray, v: np.ndarray, shift: Any, x: float = 0.0) -> tuple[np.ndarray, ...]:
        """`rates_of_vectors` with the right sides after a time x."""
        taylor = [[1.0, x, x**2 / 2.0, x**3 / 6.0], [0.0, 1.0, x, x**2 / 2.0], [0.0, 0.0, 1.0, x]]
        targets = right_sides(self.tables, np.tensordot(taylor, self.laws, 1)) + np.array([[1.0], [0.0], [0.0]]) * shift
        return rates_of_vectors(self.tables, u, v, targets)

    def velocity_side(self, u: Any, v: Any, v1: Any, w: Any, shift: Any) -> np.ndarray:
        """-c'."""
        return -self.rates(u, v, shift)[1]

    def acceleration_side(self, u: Any, v: Any, v1: Any, w: Any, shift: Any) -> np.ndarray:
        """-c''."""
        return -self.rates(u, v1, shift)[2]

    def jerk_side(self, u: Any, v: Any, v1: Any, w: Any, shift: Any) -> np.ndarray:
        """R."""
        out = np.zeros(1)
        for x in (-self.s, self.s):
            G, _, second = self.rates(u + x * v1 + 0.5 * x**2 * w, v1 + x * w, shift, x)
            out = out - np.sign(x) * 0.5 / self.s * (second + self._along(G, w))
        return out

    def slots(self, number: int, count: int) -> np.ndarray:
        """Bar of a field (slots, 3)."""
        out, t = np.zeros((count, 3)), self.tables
        np.add.at(out, t.slot_host, t.weight_host[:, None] * self.bars[number][t.term_host])
        return out


class InitialSolves:
    """The solves for the initial accelerations of some worlds, and their multipliers.

    Attributes:
        flags, chosen: of the worlds.
        u, before, corrected, acceleration: (worlds, slots, 3); velocities before and after their correction.
        first, jerk, first_bars, jerk_bars: solutions for velocities and jerk, and their multipliers y.
        rows: bars of the rows by world. h: size of the step, s.
    """

    def __init__(self, stepper: Stepper, at: StepAdjoint, restart: tuple[np.ndarray, np.ndarray, float]) -> None:
        self.flags, self.before, self.h = restart
        self.chosen = np.flatnonzero(self.flags).tolist()
        self.stepper, self.at, self.model = stepper, at, stepper.model
        assert stepper.initial_conditions is not None
        self.start = stepper.initial_conditions
        self.prescribed = self.model.slot_table.free == 0.0
        state: Any = stepper.state
        self.u, self.acceleration = state.displacement.numpy().copy(), state.acceleration.numpy().copy()
        self.first, self.jerk, self.first_bars, self.jerk_bars = (np.zeros_like(self.u) for _ in range(4))
        self.laws = self.start.law_derivatives(self.flags, self.h)
        self.corrected = self.before.copy()
        self.multipliers: dict[int, tuple[Any, Any]] = {}
        self.rows: dict[int, RowsOfWorld] = {}
        self.zero = np.zeros((self.model.slots, 3))
        self._correct_velocities()
        set_rows(state.velocity, self.flags, self.corrected[self.flags])

    def _correct_velocities(self) -> None:
        for world in self.chosen:
            self.start.begin_world(world)
            own, v = self.laws[:, world], self.before[world]
            J, rate, _ = self.start.constraint_rows(self.u[world], v, own)
            jump = self.start.prescribed_rates(own)[0] - np.where(self.prescribed, v, 0.0)
            self.first[world], m1 = self.start.solve_saddle_point(self.zero, jump, J, -rate)
            self.corrected[world] += self.first[world]
            self.multipliers[world] = J, m1

    def step_back_accelerations(self, a_bar: np.ndarray, w_bar: np.ndarray, v_bar: np.ndarray) -> np.ndarray:
        """Multipliers of the forces (worlds, slots, 3); adds to the bars of the corrected velocities."""
        h, start = self.h, self.start
        early, late = start.jerk_factors
        g, tables, count = start.unbalanced_force(self.flags, h), self.model.constraints, self.model.slots
        x = np.zeros_like(self.u)
        for world in self.chosen:
            start.begin_world(world)
            own, J = self.laws[:, world], self.multipliers[world][0]
            total, w = w_bar[world] + a_bar[world], self.acceleration[world]
            if J is None:
                x[world] = start.solve_saddle_point(total, self.zero)[0]
                continue
            motion = self.u[world], self.corrected[world], own
            second = start.constraint_rows(*motion)[2]
            m2 = start.solve_saddle_point(-g[world], start.prescribed_rates(own)[1], J, -second)[1]
            self.jerk[world], m3 = start.solve_jerk(*motion, w, 0.25 * h)
            fields = [self.u[world], self.before[world], self.corrected[world], w]
            r = self.rows[world] = RowsOfWorld(tables, fields, own, 0.25 * h)
            none = np.zeros(tables.count)
            y, z = start.solve_saddle_point(early * h * a_bar[world] + late * h**2 * v_bar[world], self.zero, J, none)
            self.jerk_bars[world] = y
            r.solve_work(y, z, self.jerk[world], m3, r.jerk_side)
            x[world], z = start.solve_saddle_point(total + r.slots(3, count), self.zero, J, none)
            r.solve_work(x[world], z, w, m2, r.acceleration_side)
            v_bar[world] += r.slots(2, count)
        return x

    def step_back_forces(self, x: np.ndarray, gradients: Any) -> None:
        """Forces of the state, with its corrected velocities."""
        solver, work, at = self.at.solver, self.stepper.work, self.at
        set_rows(work.v_tilde, self.flags, (self.corrected - self.h * self.acceleration)[self.flags])
        set_rows(solver.w, self.flags, x[self.flags])
        work.step.running.assign(self.flags.astype(np.int32))
        solver.mu.zero_()
        solver.drive_bar.zero_()
        solver.transpose(True)
        if solver.constrained:
            work.multipliers.penalty.zero_()
        solver.subtract_start_force(at.active)
        for term in self.model.terms.having(Differentiable):
            term.add_history_gradient(at)
        for add, out in gradients:
            add(at, out)

    def step_back_velocities(self, q_bar: np.ndarray, v_bar: np.ndarray) -> None:
        """From the bars of the corrected velocities to those of the velocities before."""
        start, count = self.start, self.model.slots
        for world in self.chosen:
            start.begin_world(world)
            J, m1 = self.multipliers[world]
            mass, target = self.model.masses.world_matrix(world), v_bar[world]
            y, z = start.solve_saddle_point(target, self.zero, J, np.zeros(len(m1)))
            self.first_bars[world] = y
            impulse = mass @ y  # prescribed components were stopped by one on the others
            if J is not None:
                impulse = impulse + (J.T @ z).reshape(count, 3)
                r = self.rows[world]
                r.solve_work(y, z, self.first[world], m1, r.velocity_side)
                q_bar[world] += r.slots(0, count)
                v_bar[world] = target + r.slots(1, count)
            v_bar[world] += np.where(self.prescribed, impulse - target, 0.0)


def step_back_to_initial(
    stepper: Stepper, at: StepAdjoint, restart: tuple[np.ndarray, np.ndarray, float], gradients: Any,
    sums: Mapping[str, wp.array],
) -> None:  # fmt: skip
    """Pass the bars of accelerations in the flagged worlds to those of the state before, and of parameters.

    Args:
        stepper: has the state with these accelerations.
        restart: flags (worlds,), velocities before (worlds, slots, 3), and the size of the step, s.
        gradients: functions of the parameters with their sums; sums: by name.
    """
    solver, flags = at.solver, restart[0]
    solves = InitialSolves(stepper, at, restart)
    bars = [solver.bars[name] for name in stepper.integrator.history_arrays]
    a_bar, w_bar = (bar.numpy().copy() for bar in bars)
    v_bar = solver.v_bar.numpy().copy()
    x = solves.step_back_accelerations(a_bar, w_bar, v_bar)
    for array, values in ((solver.v_bar, v_bar), *((bar, np.zeros_like(x)) for bar in bars)):
        set_rows(array, flags, values[flags])
    solves.step_back_forces(x, gradients)
    q_bar, v_bar = solver.q_bar.numpy().copy(), solver.v_bar.numpy().copy()
    solves.step_back_velocities(q_bar, v_bar)
    for array, values in ((solver.q_bar, q_bar), (solver.v_bar, v_bar)):
        set_rows(array, flags, values[flags])
    pairs = ((solves.first, solves.first_bars), (solves.jerk, solves.jerk_bars))
    _add_inertia(stepper, at, flags, solves.h, gradients, pairs)
    _add_targets(stepper.model, solves.rows, sums)


def _add_inertia(s: Stepper, at: StepAdjoint, flags: np.ndarray, h: float, gradients: Any, solves: Any) -> None:
    """Add -y . dM x of solves (x, y) to the derivatives by densities."""
    w = s.work
    w.step.load_factor.fill_(0.0)
    for x, y in solves:
        if not x.any():
            continue
        set_rows(w.v, flags, h * x[flags])
        set_rows(w.v_tilde, flags, 0.0 * x[flags])
        set_rows(at.solver.w, flags, y[flags])
        for add, out in gradients:
            if isinstance(add, ForceGradient) and add.inertia:
                add(at, out)


def _add_targets(m: Model, rows: Mapping[int, RowsOfWorld], sums: Mapping[str, wp.array]) -> None:
    """Add the bars of right sides that follow controls."""
    for (name, *_), law in m.terms.time_laws.control_laws.items():
        if name in sums and rows:
            values = sums[name].numpy().copy()
            for world, r in rows.items():
                for row in np.flatnonzero(r.tables.data.law.numpy() == law):
                    values[world, r.tables.data.law_component.numpy()[row]] += r.target_bar[row]
            sums[name].assign(values)
