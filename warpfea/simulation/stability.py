"""Stability of static equilibria: positive definiteness of the tangent H on the free components.

Conjugate gradients on H from a random force r_0, preconditioned by B as in the solves (Lanczos' method in the inner
product of B). A direction p with p.H p < 0 proves an equilibrium unstable. If all curvatures are positive, a mode phi
with H phi = -mu B^-1 phi, mu > 0, has phi.r_k = phi.r_0 prod(1 + mu / theta_i) with positive Ritz values theta_i: its
part of the residual never decreases. Once the residual norm has fallen to RESIDUAL_REDUCTION, such a mode would have
held less than that fraction of the random force (Kuczynski and Wozniakowski 1992 bound the probability). The
coefficients of the solves themselves don't suffice: a load may not excite the mode.

The mode of least w = p.H p / p.M p follows by locally optimal conjugate gradients (Knyazev 2001), from the direction
found. A float32 state uses the float64 tangent of a copy of the model unless all float32 curvatures are far above
round-off.
"""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.linalg
import warp as wp

from ..base.errors import StabilityError, StabilityWarning
from ..base.worlds import device_flags
from ..model.state import is_solver_history
from ..solvers import NewtonPCG
from ..terms.checks import overrides
from ..terms.term import Term
from .simulation import Simulation

__all__ = ["Stability", "check_stability", "report_unstable"]

RESIDUAL_REDUCTION = 1e-4
"""Relative residual, B norm, at which the search ends."""
ITERATIONS, SOLVE_FACTOR, MAX_ITERATIONS = 500, 0.3, 20_000
"""Iteration limits: larger of ITERATIONS and SOLVE_FACTOR times the solve's; with unstable="refuse" MAX_ITERATIONS."""
MIN_CURVATURE_ROUNDINGS = 64.0
"""Round-off units of p.D p (D: diagonal of H) below which the sign of p.H p is unknown."""
MIN_CLEAR_ROUNDINGS = 1024.0
"""The same units: float32 curvatures above need no float64 tangent."""
MIN_ROUND_OFF_CHANGES = 4.0
"""Smallest float32 |p.H p| of known sign, over its change by one more rounding of the state."""
MODE_ITERATIONS, MODE_CHANGE = 60, 1e-4
"""Iteration limit of the mode search, and the relative change of w at which it ends."""
TANGENT_TOL = 1e-3
"""Largest accepted relative difference between the true tangent of non-potential forces and that in H."""
MAX_FLOAT64_SLOTS = 200_000
"""Largest number of slots of all worlds for a float64 copy (about 7 kB each) of a float32 model."""


@dataclass(frozen=True, eq=False)
class Stability:
    """Stability of a static equilibrium.

    Attributes:
        stable: (worlds,) objects: True, False, or None if unknown.
        reasons: (worlds,) texts: the reason if unknown, else "".
        mode: (worlds, slots, 3) unstable mode, largest displacement 1 m; 0 if none.
        iterations: (worlds,) products H p of the search for negative curvature.
    """

    stable: np.ndarray
    reasons: list[str]
    mode: np.ndarray
    iterations: np.ndarray

    @property
    def text(self) -> str:
        """Stable, unstable or stability unknown, as text; with counts for several worlds."""
        kinds = ((True, "stable"), (False, "unstable"), (None, "stability unknown"))
        found = [(sum(s is value for s in self.stable), text) for value, text in kinds]
        several = len(self.stable) > 1
        return ", ".join(f"{count} {text}" if several else text for count, text in found if count)

    def __repr__(self) -> str:
        return f"Stability({self.text})"


def report_unstable(result: Any, *, refuse: bool) -> None:
    """Warn of unstable worlds of a StaticResult, or raise StabilityError for the first."""
    found, sim = result.stability, result.simulation
    worlds = [world for world, s in enumerate(found.stable) if s is False]
    if not worlds:
        return
    m, world = sim.model, worlds[0]
    size = np.linalg.norm(found.mode[world], axis=1) * m.slot_table.is_position
    slot = int(np.argmax(size))
    body = next(b for b in m.bodies if b.slot_offset <= slot < b.slot_offset + b.slot_count)
    place = m.slot_table.reference[slot] + body.origin + sim.state.displacement.numpy()[world, slot]
    where = ", ".join(f"{x + 0.0:.3g}" for x in np.round(place, 12))
    way = ", ".join(f"{x + 0.0:.2g}" for x in np.round(found.mode[world, slot], 3))
    many = f"{len(worlds)} of {m.worlds} worlds, the first of them {world}" if len(worlds) > 1 else f"world {world}"
    size_m = f"{1e-3 * m.size:.1g}"
    text = (
        f"the equilibrium is unstable in {many}: body {body.name!r} buckles or snaps through; its mode is largest at "
        f"({where}) m, along ({way}). To follow the bifurcated path add an imperfection: {size_m} * r.mode(body)"
        f"[{world}] added to the points it is built from, a small load across, or a damped motion from "
        f"r.perturbed({size_m}) (a static solve from there may return to this equilibrium)"
    )
    if refuse:
        raise StabilityError(text, time=1.0, world=world, state=sim.state, result=result)
    warnings.warn(text, StabilityWarning, stacklevel=4)


def check_stability(sim: Simulation, *, every: bool = False) -> Stability:
    """Determine the stability of the equilibrium of a `begin_static` simulation, before its time is reset to 0.

    Args:
        every: include float32 models whose float64 copy is large, at any cost.
    """
    model = sim.model
    out = Stability(
        np.full(model.worlds, None), [""] * model.worlds, np.zeros((model.worlds, model.slots, 3)),
        np.zeros(model.worlds, dtype=int),
    )  # fmt: skip
    for world, contact in _friction_contacts(sim):
        out.reasons[world] = f"contact {contact!r} has friction"
    single = model.dtype == "float32"
    if single and not every and model.worlds * model.slots > MAX_FLOAT64_SLOTS:
        out.reasons[:] = [text or "the float32 model is large; unstable='refuse' judges it" for text in out.reasons]
    if all(out.reasons):
        return out
    if single and not sim.stepper.newton.direct and _stable_in_float32(sim, out):
        return out
    # an inverse of an indefinite H is no preconditioner
    probe = TangentOperator(_float64_copy(sim) if single or sim.stepper.newton.direct else sim)
    strange = probe.unsymmetric_forces()
    for world in range(model.worlds):
        if strange[world] and not out.reasons[world]:
            names = ", ".join(term.name for term in model.terms if not term.potential)
            out.reasons[world] = f"non-conservative forces: {names}"
    most = np.full(model.worlds, MAX_ITERATIONS)
    if not every:
        most = np.maximum(ITERATIONS, (SOLVE_FACTOR * sim.totals["pcg"]).astype(int))
    curvature, p = _find_negative_curvature(probe, out, most)
    if single:
        _check_roundoff(probe, sim, out, curvature, p)
    unstable = np.array([s is False for s in out.stable])
    if unstable.any():
        out.mode[unstable] = _unstable_modes(probe, unstable, p)[unstable]
    return out


def _stable_in_float32(sim: Simulation, out: Stability) -> bool:
    """Decide by the float32 tangent if all its curvatures are far above round-off; False if float64 is needed.

    H in float32 is off by some roundings of p.D p: a world whose curvature exceeds MIN_CLEAR_ROUNDINGS of them in each
    direction of the search is stable. Unstable worlds and forces without a potential need float64.
    """
    if any(not term.potential for term in sim.model.terms):
        return False
    found = Stability(out.stable.copy(), list(out.reasons), out.mode, out.iterations.copy())
    most = np.full(sim.model.worlds, ITERATIONS)
    _find_negative_curvature(TangentOperator(sim), found, most, MIN_CLEAR_ROUNDINGS)
    if any(s is not True and not reason for s, reason in zip(found.stable, out.reasons)):
        return False
    out.stable[:], out.iterations[:] = found.stable, found.iterations
    return True


def _friction_contacts(sim: Simulation) -> list[tuple[int, str]]:
    """Worlds and names of contacts that touch with friction."""
    found = []
    for term in sim.model.terms.contacts:
        for contact in term.tables.contacts:
            mu = term.tables.data.mu_static.numpy()[:, term.tables.number[contact.index]]
            touching = sim.contact_record(contact).normal_force[:, -1] > 0.0
            found += [(int(world), contact.name) for world in np.flatnonzero((mu > 0.0) & touching)]
    return found


class TangentOperator:
    """Tangent H at the iterate of a simulation, its preconditioner B and diagonal, as host functions.

    Vectors are (worlds, slots, 3) float64, 0 where prescribed; `flags` (worlds,) selects worlds.
    """

    def __init__(self, sim: Simulation) -> None:
        self.sim, self.model, self.stepper = sim, sim.model, sim.stepper
        self.residual, self.work = sim.stepper.newton.residual, sim.stepper.work
        self.free_components = self.model.slot_table.free[None]
        self.linearise()

    def linearise(self) -> None:
        """Assemble H at the current iterate with its own stress (not the linearly predicted one)."""
        w = self.work
        every = self.flags(np.ones(self.model.worlds))
        w.newton.active.fill_(1)
        w.newton.norms.component_converged.zero_()
        w.newton.solve.predicted_stress.zero_()
        self.residual.assemble_matrix(every)
        self.stepper.newton.preconditioner.prepare(every)
        self.diagonal = np.where(self.free_components > 0.0, w.diagonal.numpy().astype(float), 1.0)

    def flags(self, chosen: np.ndarray) -> wp.array:
        """Device mask of worlds."""
        return device_flags(chosen, self.model.device)

    def product(self, p: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Product H p."""
        w = self.work
        w.p.assign(p)
        self.residual.product(w.p, w.Hp, self.flags(chosen))
        return self._host_values(w.Hp, chosen)

    def precondition(self, r: np.ndarray, chosen: np.ndarray) -> np.ndarray:
        """Preconditioner application B r."""
        w = self.work
        w.r.assign(r)
        self.stepper.newton.preconditioner.apply(w.r, w.z, self.flags(chosen))
        return self._host_values(w.z, chosen)

    def _host_values(self, array: wp.array, chosen: np.ndarray) -> np.ndarray:
        return np.where(chosen[:, None, None], array.numpy().astype(float) * self.free_components, 0.0)

    def unsymmetric_forces(self) -> np.ndarray:
        """Flags (worlds,) of non-potential forces whose tangent differs from that in H: unsymmetric (pressure on an
        open surface), or absent from H (field)."""
        m, w, ctx = self.model, self.work, self.stepper.ctx
        terms = [term for term in m.terms if not term.potential]
        if not terms:
            return np.zeros(m.worlds, dtype=bool)
        every, u = self.flags(np.ones(m.worlds)), w.u.numpy().copy()  # a view on the CPU
        gather = self.residual.gather_kernels.gather_force

        def gathered(call: str, pool: wp.array, *more: Any) -> np.ndarray:
            pool.zero_()
            for term in terms:
                if call != "product" or overrides(term, Term.product):
                    getattr(term, call)(ctx, *more, every)
            ctx.launch(gather, (m.worlds, m.slots), [m.terms.nonpotential_topology, pool, every, w.Hp])
            return self._host_values(w.Hp, np.ones(m.worlds, dtype=bool))

        step = 1e-5 * m.size
        p = step * np.random.default_rng(2).standard_normal(u.shape) * self.free_components
        forces = []
        for sign in (1.0, -1.0, 0.0):
            w.u.assign(u + sign * p)
            forces.append(gathered("force", w.nonpotential_contribution))
        true = 0.5 * (forces[0] - forces[1])
        w.p.assign(p)
        taken = gathered("product", w.nonpotential_tangent, w.p) if m.terms.traits.tangent else 0.0 * true
        size = _norm(true) + _norm(taken) + 1e-3 * step / m.size * _norm(forces[2])
        return _norm(true - taken) > TANGENT_TOL * size


def _norm(x: np.ndarray) -> np.ndarray:
    """Norms (worlds,) of vectors."""
    return np.sqrt(np.einsum("bsc,bsc->b", x, x))


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.einsum("bsc,bsc->b", x, y)


def _find_negative_curvature(
    probe: TangentOperator, out: Stability, most: np.ndarray, roundings: float | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Lanczos search for p.H p < 0 in undecided worlds, at most `most` (worlds,) iterations; sets `stable`, `reasons`.

    Curvatures below `roundings` round-off units, by default MIN_CURVATURE_ROUNDINGS, have no sign.

    Returns p.H p (worlds,) and the deciding directions p: the first negative one or the softest.
    """
    m = probe.model
    solver = probe.sim.solver
    kappa = solver.penalty_ratio(m) if m.constraints and isinstance(solver, NewtonPCG) else 0.0
    rounding = (roundings or MIN_CURVATURE_ROUNDINGS) * (1.0 + kappa) * float(np.finfo(m.dtype).eps)
    going = np.array([not reason for reason in out.reasons])
    random = np.random.default_rng(1).standard_normal((m.slots, 3))
    r = np.where(going[:, None, None], random * probe.free_components, 0.0)  # equal in all worlds
    z = probe.precondition(r, going)
    p, rz = z.copy(), _dot(r, z)
    first, softest, curvature = rz.copy(), np.full(m.worlds, np.inf), np.zeros(m.worlds)
    best = np.zeros_like(p)
    for count in range(1, int(most.max()) + 1):
        Hp = probe.product(p, going)
        pHp, pDp = _dot(p, Hp), _dot(p, probe.diagonal * p)
        ratio = pHp / np.where(pDp > 0.0, pDp, 1.0)
        soft = going & (ratio < softest)
        softest, curvature = np.where(soft, ratio, softest), np.where(soft, pHp, curvature)
        best[soft] = p[soft]
        out.iterations[going] = count
        for world in np.flatnonzero(going & ~(ratio > rounding)):
            if ratio[world] < -rounding:
                out.stable[world] = False
            else:
                out.reasons[world] = "zero stiffness within round-off (unconstrained body?)"
        going = going & (ratio > rounding)
        alpha = np.where(going, rz / np.where(going, pHp, 1.0), 0.0)[:, None, None]
        r = r - alpha * Hp
        z = probe.precondition(r, going)
        new = _dot(r, z)
        done = going & (new <= RESIDUAL_REDUCTION**2 * first)
        out.stable[done] = True
        going = going & ~done
        for world in np.flatnonzero(going & (count >= most)):
            out.reasons[world] = (
                f"not resolved in {most[world]} iterations; unstable='refuse' takes up to {MAX_ITERATIONS}"
            )
        going = going & (count < most)
        if not going.any():
            break
        p = z + np.where(going, new / np.where(going, rz, 1.0), 0.0)[:, None, None] * p
        rz = new
    return curvature, best


def _check_roundoff(
    probe: TangentOperator, sim: Simulation, out: Stability, curvature: np.ndarray, p: np.ndarray
) -> None:
    """Set the sign of p.H p to unknown if float32 round-off of the state can change it."""
    state, u = probe.sim.state, sim.state.displacement.numpy().astype(float)
    random = np.random.default_rng(3).uniform(-0.5, 0.5, u.shape)

    def move_to(displacement: np.ndarray) -> None:
        state.displacement.assign(displacement)
        _evaluate_state(probe.stepper)
        probe.linearise()

    move_to(u + random * np.finfo("float32").eps * np.abs(u) * probe.free_components)
    change = np.abs(_dot(p, probe.product(p, np.ones(len(u), dtype=bool))) - curvature)
    for world in range(len(u)):
        if out.stable[world] is not None and abs(curvature[world]) <= MIN_ROUND_OFF_CHANGES * change[world]:
            out.stable[world], out.reasons[world] = None, "within the rounding of float32"
    if any(s is False for s in out.stable):
        move_to(u)


def _unstable_modes(probe: TangentOperator, chosen: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Modes of least p.H p / p.M p (worlds, slots, 3), largest displacement 1 m, from directions x."""
    m = probe.model
    x = np.where(chosen[:, None, None], x, 0.0)
    own = m.masses.varies_by_world
    masses = [m.masses.world_matrix(world) if own else m.masses.matrix for world in range(m.worlds)]

    def mass(v: np.ndarray) -> np.ndarray:
        return np.stack([masses[b] @ v[b] if chosen[b] else v[b] for b in range(m.worlds)]) * probe.free_components

    before, basis, going = np.full(m.worlds, np.finfo(float).max), [x], chosen.copy()
    H, M = [probe.product(x, going)], [mass(x)]
    for _ in range(MODE_ITERATIONS):
        value = before.copy()
        # a converged world stays unchanged, independent of the others
        new = [[of[0].copy() for of in (basis, H, M)], [np.zeros_like(x) for _ in range(3)]]
        for b in np.flatnonzero(going):
            V, HV, MV = (np.stack([v[b].ravel() for v in of]) for of in (basis, H, M))
            size = np.sqrt(np.maximum(np.einsum("ij,ij->i", V, MV), 1e-300))
            V, HV, MV = V / size[:, None], HV / size[:, None], MV / size[:, None]
            s, Q = np.linalg.eigh(V @ MV.T)
            T = Q[:, s > 1e-10 * s[-1]] / np.sqrt(s[s > 1e-10 * s[-1]])
            values, y = scipy.linalg.eigh(T.T @ (V @ HV.T) @ T)
            value[b], y = values[0], T @ y[:, 0]
            last = y.copy()
            last[0] = 0.0
            for k, of in enumerate((V, HV, MV)):
                for j, weights in enumerate((y, last)):
                    new[j][k][b] = (weights @ of).reshape(m.slots, 3)
        (x, Hx, Mx), (p, Hp, Mp) = new
        going = going & (np.abs(value - before) > MODE_CHANGE * np.abs(value))
        if not going.any():
            break
        before = value
        r = Hx - value[:, None, None] * Mx
        w = probe.precondition(r, going)
        basis, H, M = [x, w, p], [Hx, probe.product(w, going), Hp], [Mx, mass(w), Mp]
    largest = (np.linalg.norm(x, axis=2) * m.slot_table.is_position).max(axis=1)
    return x / np.where(largest > 0.0, largest, 1.0)[:, None, None]


def _float64_copy(sim: Simulation) -> Simulation:
    """Float64 copy of the equilibrium with its forces, ready for conjugate gradients."""
    model = sim.model
    if "float64" not in model.cache:  # half of the time of a check of a small model
        model.cache["float64"] = model.resized(model.worlds, dtype="float64")
    twin = model.cache["float64"]
    if model.terms.parameter_updates:
        twin.parameters.copy_values(model.parameters.values)
        arrays = twin.terms.parameter_arrays()
        for name, array in model.terms.parameter_arrays().items():
            arrays[name].assign(array.numpy().astype(arrays[name].numpy().dtype))
    state = twin.state()
    assert isinstance(sim.solver, NewtonPCG)
    solver = NewtonPCG(multipliers=sim.solver.multipliers, penalty=sim.solver.penalty)
    out = Simulation(twin, state, dt=sim.dt, integrator=sim.integrator, solver=solver, ledger=False, capture=False)
    for name in state.names:
        if name in sim.state.names and not is_solver_history(name):
            array = getattr(state, name)
            array.assign(getattr(sim.state, name).numpy().astype(array.numpy().dtype))
    out.stepper.start_terms()
    _evaluate_state(out.stepper)
    return out


def _evaluate_state(stepper: Any) -> None:
    """Evaluate residual and tangent at the current state (no solve)."""
    w = stepper.work
    w.step.dt.zero_()
    stepper.launch(stepper.kernels.begin_step, stepper.model.worlds, [w.step, w.newton, w.pcg])
    stepper.begin_attempt()
    stepper.newton._clear_direction(w.step.running)
    stepper.newton._evaluate_first_iterate(w.step.running)
