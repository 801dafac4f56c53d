"""Joints against mechanisms computed without warpfea: rigid ones, closed forms, recursions of the scheme.

Solver options are the defaults unless named by a row. no_drift takes long: it keeps a checkpoint beside --out, and
the same command resumes from it.
"""

from __future__ import annotations

import itertools
import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from .problems.rigid_double_pendulum import INERTIA, LINKS, MASS, STEEL, double_pendulum_links
from .rigid import STANDARD, double_pendulum_motion, double_pendulum_places
from .rigid import slider_crank_kinematics as kinematics
from .table import Row, Run, Table

__all__ = ["OUTER", "TABLE", "TIES", "double_pendulum", "fall_of_a_pair", "free_fall", "hanging_chain", "no_drift",
           "rigid_slider_crank", "swing"]  # fmt: skip

X, Y, Z = np.eye(3)
PLANE = [0, 2]


def EVERY(X: np.ndarray) -> np.ndarray:
    """All nodes, as a selection."""
    return X[:, 0] > -np.inf


def work(sim, seconds):
    """Steps, iterations, ms and violation of a run."""
    n = sim.steps
    return {"steps": n, "ms_per_step": 1e3 * seconds / n, "newton_per_step": float(sim.totals["newton"][0]) / n,
            "pcg_per_step": float(sim.totals["pcg"][0]) / n,
            "violation_over_size": sim.max_violation / sim.model.size}  # fmt: skip


def timed(sim, steps):
    """Do the steps; seconds."""
    began = clock.perf_counter()
    sim.step(steps)
    return clock.perf_counter() - began


def place(sim, name):
    """A probe in the plane of the mechanism, (steps, 2)."""
    return sim.probe(name).position[0][:, PLANE]


def slider_crank(device, *, speed, E, dt):
    """The slider-crank of STANDARD of rigid.py in the x-z plane with a rod of modulus E, at crank angle 0 with the
    rigid mechanism's velocities; the slider is a box of 2 cm."""
    data = STANDARD
    r, L, a, side = data["crank"], data["rod"], 0.02, data["side"]
    b = wf.ModelBuilder(gravity=(0, 0, 0))

    def law(E, density=data["density"]):
        return wf.SVK(E=E, nu=0.3, density=density)

    crank = b.add_beam([0 * X, r * X], elements=1, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law(E),
                       name="crank")  # fmt: skip
    rod = b.add_beam([r * X, (r + L) * X], elements=2, section=wf.Rectangle(side, side), normal=Z,
                     material=law(E), name="rod")  # fmt: skip
    box = wf.mesh.box((a, a, a), cells=(1, 1, 1), origin=(r + L - a / 2, -a / 2, -a / 2))
    slider = b.add_solid(box, material=law(E, data["slider_mass"] / a**3), name="slider")
    whole = slider.nodes(EVERY)
    b.add_joint("revolute", parent=wf.GROUND, child=crank.start, axis=-Y, drive=([0.0, 1e3], [0.0, 1e3 * speed]))
    b.add_joint("revolute", parent=crank.end, child=rod.start, axis=-Y)
    b.add_joint("revolute", parent=whole, child=rod.end, axis=-Y, anchor=(r + L) * X)
    b.add_joint("translational", parent=wf.GROUND, child=whole, axis=X)
    b.set_initial(crank, velocity=lambda P: speed * np.cross(-Y, P))
    b.set_initial(rod, velocity=lambda P: speed * r * (Z + np.cross(Y, P - r * X) / L))
    for name, point in (("slider", whole), ("start", rod.start), ("middle", rod.at((r + L / 2) * X)), ("end", rod.end)):
        b.add_probe(name, point)
    return wf.Simulation(b.finalize(device=device), dt=dt, integrator="bdf2")


def deflection(sim):
    """Middle of the rod from the chord between its pins, positive to the left of it, m."""
    chord = place(sim, "end") - place(sim, "start")
    middle = place(sim, "middle") - place(sim, "start")
    return (chord[:, 0] * middle[:, 1] - chord[:, 1] * middle[:, 0]) / np.linalg.norm(chord, axis=1)


def rigid_slider_crank(run: Run) -> Iterator[Row]:
    """A stiff slider-crank against the closed form, over slightly more than a turn; no gravity, bdf2.

    Errors are over the length of crank + rod; `deformation` is the largest of the rod's bending and stretch over its
    length and of the crank's stretch over its own.
    """
    r, L = STANDARD["crank"], STANDARD["rod"]
    cases = [(15.0, E, 400) for E in (2e10, 2e11, 2e12, 2e13, 2e14)] + [(15.0, 2e13, 100), (150.0, 2e15, 400)]
    for speed, E, count in [(15.0, 2e13, 100)] if run.quick else cases:
        sim = slider_crank(run.device, speed=speed, E=E, dt=2.0 * np.pi / speed / count)
        seconds = timed(sim, count + count // 50)
        time = sim.probe("slider").time
        pin, slider, _ = kinematics(speed * time, r, L)
        start, end = place(sim, "start"), place(sim, "end")
        bend = np.abs(deflection(sim)).max() / L
        stretch = np.abs(np.linalg.norm(end - start, axis=1) / L - 1.0).max()
        crank = np.abs(np.linalg.norm(start, axis=1) / r - 1.0).max()
        yield {
      "speed": speed, "E": E, "dt": sim.dt, "turns": float(speed * time[-1] / (2.0 * np.pi)),
      "deformation": float(max(bend, stretch, crank)),
      "slider_error": float(np.abs(place(sim, "slider")[:, 0] - slider).max() / (r + L)),
      "pin_error": float(np.linalg.norm(start - pin, axis=1).max() / (r + L)),
      "off_line": float(np.abs(sim.probe("slider").position[0][:, 1:]).max() / (r + L)),
      **work(sim, seconds),
  }  # fmt: skip


def double_pendulum(run: Run) -> Iterator[Row]:
    """Two stiff links swinging for 2 s from rest, bdf2, against rigid ones with the boxes' mass, centre and inertia.

    Errors are the largest distances of elbow and tip over the length of both links. From the horizontal (1.571 rad) the
    links swing to -2.19 and 2.07 rad, from 45 degrees (0.785 rad) within 0.83 rad; neither turns over.
    """
    level, low = np.pi / 2, np.pi / 4
    cases = [("time", "3243", 2e12, dt, level) for dt in (2e-3, 1e-3, 5e-4, 2.5e-4)]
    cases += [("stiffness", "3243", E, 2.5e-4, level) for E in (2e9, 2e10, 2e11)]
    cases += [("low", "3243", 2e11, 5e-4, low), ("solid", "T10", 2e11, 5e-4, low)]
    last: tuple[str, float] | None = None
    for series, kind, E, dt, angle in [("quick", "3243", 2e11, 1e-3, low)] if run.quick else cases:
        model = double_pendulum_links(kind=kind, E=E, angle=angle).finalize(device=run.device)
        sim = wf.Simulation(model, dt=dt, integrator="bdf2")
        seconds = timed(sim, round((0.5 if run.quick else 2.0) / dt))
        times = np.concatenate([[0.0], sim.probe("tip").time])
        angles, _ = double_pendulum_motion(times, masses=MASS, lengths=LINKS, centers=[length / 2 for length in LINKS],
                                           inertias=INERTIA, angles=(angle, angle), rates=(0.0, 0.0))  # fmt: skip
        error = {}
        for name, exact in zip(("elbow", "tip"), double_pendulum_places(angles[1:], LINKS)):
            error[name] = float(np.linalg.norm(place(sim, name) - exact, axis=1).max() / sum(LINKS))
        worst = max(error.values())
        order = float(np.log2(last[1] / worst)) if last and last[0] == series == "time" else None
        last = series, worst
        yield {"series": series, "element": kind, "E": E, "dt": dt, "angle": angle, "elbow_error": error["elbow"],
               "tip_error": error["tip"], "order": order, "swing": [float(angles.min()), float(angles.max())],
               **work(sim, seconds)}  # fmt: skip


def chain(device, kind, element, links, E):
    """Links 10 cm long hanging from the ground: model, joints from the top, weight of a link (N)."""
    length, h = 0.1, 0.01
    b = wf.ModelBuilder()
    law = wf.SVK(E=E, nu=0.3, density=STEEL)
    above: Any = wf.GROUND
    joints = []
    top: Any
    low: Any
    for k in range(links):
        z = -k * length
        if element == "3243":
            link = b.add_beam([z * Z, (z - length) * Z], elements=1, section=wf.Rectangle(h, h), normal=Y, material=law)
            top, low = link.start, link.end
        else:
            mesh = wf.mesh.box((h, h, length), cells=(1, 1, 2), origin=(-h / 2, -h / 2, z - length))
            link = b.add_solid(mesh, material=law)
            top, low = link.surface("z+"), link.surface("z-")
        options: dict[str, Any] = {"revolute": {"axis": (X, Y)[k % 2]}, "universal": {"axis": X}}.get(kind, {})
        chosen = kind
        if kind == "fixed and held slides":
            chosen = ("fixed", "translational")[k % 2]
            options = {"axis": Z, "drive": 0.0} if k % 2 else {}
        joints.append(b.add_joint(chosen, parent=above, child=top, **options))
        above = low
    return b.finalize(device=device), joints, STEEL * h * h * length * 9.81


def hanging_chain(run: Run) -> Iterator[Row]:
    """Reaction of every joint of a chain of 10 steel links that hangs at rest, against the weight below it.

    By solve_static (one load step) if the joints leave no rigid mode, and by 20 steps of 10 ms of backward Euler,
    damped, from the straight unstressed chain. `force_error` is the largest of |F - W| / W,
    `moment_error` of the moment over weight x link length.
    """
    stiff = {"max_pcg": 20000}
    cases: list[tuple[str, str, str, dict[str, Any]]] = [
        ("static", "fixed", "3243", {}),
        ("static", "fixed and held slides", "3243", {}),
        ("static", "fixed", "T10", {}),
    ]
    cases += [("dynamic", kind, "3243", {}) for kind in ("fixed", "spherical", "revolute", "universal")]
    cases += [("dynamic", kind, "T10", stiff) for kind in ("fixed", "spherical", "revolute")]
    if run.quick:
        cases = [
            ("static", "fixed", "3243", {}),
            ("dynamic", "spherical", "3243", {}),
            ("dynamic", "revolute", "3243", {}),
        ]
    links, E = 10, 2e11
    for way, kind, element, options in cases:
        model, joints, weight = chain(run.device, kind, element, links, E)
        began = clock.perf_counter()
        if way == "static":
            sim = wf.solve_static(model, load_steps=1).simulation
        else:
            sim = wf.Simulation(model, dt=1e-2, solver=wf.NewtonPCG(**options))
            sim.step(20)
        seconds = clock.perf_counter() - began
        below = weight * np.arange(links, 0, -1)
        got = np.array([sim.joint_force(joint)[0] for joint in joints])
        error = np.linalg.norm(got[:, :3] - below[:, None] * Z, axis=1) / below
        assert sim.last is not None
        yield {"way": way, "joints": kind, "element": element, "links": links, "E": E, "solver": options,
               "force_error": float(error.max()), "errors": [float(e) for e in error],
               "moment_error": float((np.linalg.norm(got[:, 3:], axis=1) / (0.1 * below)).max()),
               "residual": float(sim.last.residual[0]), "seconds": seconds, **work(sim, seconds)}  # fmt: skip


DRIFT_STEPS = 100_000


def swing(device):
    """A soft beam on a ball joint with another on its end by a hinge, thrown from the horizontal, 48 unknowns."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1200.0)
    first, second = (
        b.add_beam(
            [0.5 * k * X, 0.5 * (k + 1) * X], elements=1, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law
        )
        for k in range(2)
    )
    joints = [b.add_joint("spherical", parent=wf.GROUND, child=first.start),
              b.add_joint("revolute", parent=first.end, child=second.start, axis=Y)]  # fmt: skip
    for beam in (first, second):
        b.set_initial(beam, velocity=lambda P: np.cross((0.0, 0.0, 2.0), P))
    for name, end in (("pivot", first.start), ("above", first.end), ("below", second.start), ("tip", second.end)):
        b.add_probe(name, end)
    return wf.Simulation(b.finalize(device=device), dt=1e-3, integrator="bdf2"), joints


def crossing(sim):
    """Cosine between the hinge's axis on one beam of `swing` and the directions across it on the other, at its ends."""
    above, below = (sim.node_gradients(beam)[0, k] for beam, k in zip(sim.model.bodies, (-1, 0)))
    return max(abs(above @ Y @ (below @ d)) / np.linalg.norm(above @ Y) / np.linalg.norm(below @ d) for d in (X, Z))


def no_drift(run: Run) -> Iterator[Row]:
    """Violation over 1e5 steps of 1 ms of bdf2: a soft double pendulum of two 3243 elements swings in space.

    `violation_*` are the joints' records at every step, over the model's size; `gap_*` is that of the pinned
    ends from their positions alone, `crossing` of the hinge from deformation gradients, every 100 steps since resumed.
    First and last: of the first and the last tenth.
    """
    sim, joints = swing(run.device)
    target, checkpoint = DRIFT_STEPS // 100 if run.quick else DRIFT_STEPS, run.checkpoint("no_drift")
    if checkpoint is not None and checkpoint.exists():
        sim.resume(checkpoint)
        print(f"    goes on from step {sim.steps} of {checkpoint}", flush=True)
    begun_at, halvings, crossed, began = sim.steps, 0, 0.0, clock.perf_counter()

    def watch(sim):
        nonlocal halvings, crossed
        halvings += int(sim.last.halvings[0])
        if sim.steps % 100 == 0:
            crossed = max(crossed, crossing(sim))
        if sim.steps % 10000 == 0:
            print(f"    step {sim.steps}: {clock.perf_counter() - began:.0f} s", flush=True)

    outputs = [wf.Checkpoint(checkpoint, every=5000)] if checkpoint is not None else []
    sim.run(target * sim.dt, outputs=outputs, on_step=watch, progress=False)
    seconds = clock.perf_counter() - began
    assert sim.steps == target
    size, tenth = sim.model.size, target // 10
    records = [sim.joint_record(joint) for joint in joints]
    violation = np.max([r.violation[0] for r in records], axis=0) / size
    at = {name: sim.probe(name).position[0] for name in ("pivot", "above", "below", "tip")}
    gap = np.maximum(np.linalg.norm(at["pivot"], axis=1), np.linalg.norm(at["above"] - at["below"], axis=1)) / size
    energy = sim.energies()
    row = {"element": "3243", "unknowns": int(sim.model.free_slots.sum()), "E": 1e7, "dt": sim.dt, "steps": target,
           "recorded": len(violation), "resumed_at": begun_at, "violation_max": float(violation.max()),
           "violation_first": float(violation[:tenth].max()), "violation_last": float(violation[-tenth:].max()),
           "max_by_tenths": [float(part.max()) for part in np.array_split(violation, 10)],
           "mean_by_tenths": [float(part.mean()) for part in np.array_split(violation, 10)],
           "gap_max": float(gap.max()), "gap_first": float(gap[:tenth].max()), "gap_last": float(gap[-tenth:].max()),
           "crossing": float(crossed), "halvings_since_resumed": halvings,
           "force_max": float(max(np.linalg.norm(r.force[0], axis=1).max() for r in records)),
           "swing_last": float(np.ptp(at["tip"][-tenth:], axis=0).max()),
           "ledger_residual": float(energy["ledger_residual"][0]), "potential": float(energy["potential"][0]),
           "ms_per_step": 1e3 * seconds / max(target - begun_at, 1),
           "newton_per_step": float(sim.totals["newton"][0]) / target,
           "pcg_per_step": float(sim.totals["pcg"][0]) / target}  # fmt: skip
    if checkpoint is not None:
        checkpoint.unlink(missing_ok=True)
    yield row


GRAVITY = np.array([0.3, -0.5, -9.81])
BOX = (0.5, 0.1, 0.1)


def fall(integrator, steps, v0):
    """Displacement and velocity of a free point after steps of the lengths given: the recursion of the scheme."""
    u, v, before = [np.zeros(3)], [np.asarray(v0, dtype=float)], None
    for h in steps:
        if integrator == "backward_euler" or before is None:
            u_tilde, v_tilde, beta = u[-1], v[-1], 1.0
        else:
            w = h / before
            u_tilde, v_tilde = (((1 + w) ** 2 * q[-1] - w**2 * q[-2]) / (1 + 2 * w) for q in (u, v))
            beta = (1 + w) / (1 + 2 * w)
        v.append(v_tilde + beta * h * GRAVITY)
        u.append(u_tilde + beta * h * v[-1])
        before = h
    return u[-1], v[-1]


class Pair:
    """Two boxes, or a box and a beam, end to end and tied by a joint; `None` for one box of both, "weld" for b.weld."""

    def __init__(self, device, tie, *, E, second="T10", velocity=(0.0, 0.0, 0.0), spin=None, extra=None):
        b = wf.ModelBuilder(gravity=GRAVITY)
        law = wf.SVK(E=E, nu=0.3, density=1000.0)
        origin = (0.0, -BOX[1] / 2, -BOX[2] / 2)
        if tie is None:
            mesh = wf.mesh.box((2 * BOX[0], *BOX[1:]), cells=(2, 1, 1), origin=origin)
            self.bodies = [b.add_solid(mesh, material=law, name="A")]
        else:
            first = b.add_solid(wf.mesh.box(BOX, cells=(1, 1, 1), origin=origin), material=law, name="A")
            face: Any
            far: Any
            if second == "T10":
                mesh = wf.mesh.box(BOX, cells=(1, 1, 1), origin=(BOX[0], *origin[1:]))
                other = b.add_solid(mesh, material=law, name="B")
                face, far = other.surface("x-"), other.at((1.5 * BOX[0], 0.0, 0.0))
            else:
                curve = [BOX[0] * X, 2.2 * BOX[0] * X]
                other = b.add_beam(
                    curve, elements=1, section=wf.Rectangle(0.05, 0.08), normal=Z, material=law, name="B"
                )
                face, far = other.start, other.end
            self.bodies = [first, other]
            if tie == "weld":
                b.weld(face, first.surface("x+"))
            elif tie == "distance":
                b.add_joint(tie, parent=first.at((0.5 * BOX[0], 0.0, 0.0)), child=far)
            else:
                axis: dict[str, Any] = {"axis": Z} if tie == "revolute" else {}
                b.add_joint(tie, parent=first.surface("x+"), child=face, **axis)
        if extra is not None:
            extra(b)
        self.velocity = np.asarray(velocity, dtype=float)
        if spin is not None:
            center = self._center(b.finalize(device=device))  # of a first model, for the velocities about it
            for body in self.bodies:
                b.set_initial(body, velocity=lambda P: self.velocity + np.cross(spin, P - center))
        self.model = b.finalize(device=device)
        self.mask = np.concatenate([body.slots for body in self.bodies])

    def _center(self, model):
        x = self._places(model, np.zeros((model.slots, 3)))
        own = np.concatenate([body.slots for body in self.bodies])
        m = model.masses.lumped[0][own]
        return m @ x[own] / m[model.slot_table.kind[own] == 0].sum()

    @staticmethod
    def _places(model, u):
        position = (model.slot_table.kind == 0)[:, None]
        origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
        return model.slot_table.reference + position * origin + u

    def motion(self, state):
        """Displacement and velocity of the centre of mass; positions and velocities (slots, 3) about it; L about it."""
        m, own = self.model, self.mask
        u, v = (array.numpy()[0].astype(float) for array in (state.displacement, state.velocity))
        lumped, position = m.masses.lumped[0][own], (m.slot_table.kind[own] == 0)[:, None]
        mass = lumped[position[:, 0]].sum()
        moved, pace = lumped @ u[own] / mass, lumped @ v[own] / mass
        x = self._places(m, u)[own]
        x = x - position * (lumped @ x / mass)
        v = v[own] - position * pace
        M = self.consistent
        return moved, pace, x, v, np.cross(x, M @ v).sum(axis=0)

    @property
    def consistent(self):
        """Mass matrix of the slots of both bodies, one component of three, kg."""
        return self.model.mass_matrix()[::3, ::3][self.mask][:, self.mask]

    def points_error(self, sim, exact):
        """Largest distance of all nodes from a common displacement, over it."""
        away = [np.abs(sim.displacements(body)[0] - exact).max() for body in self.bodies]
        return float(max(away) / np.abs(exact).max())


def attempt(row, sim, steps):
    """Do the steps one by one; halvings of each, or None with the reason in the row."""
    halvings = []
    try:
        for _ in range(steps):
            halvings.append(int(sim.step().halvings[0]))
    except wf.ConvergenceError as error:
        row |= {"converged": False, "why": str(error).partition(" in world")[2][3:80], "failed_step": len(halvings)}
        return None
    row |= {"converged": True, "steps": steps, "halvings": sum(halvings), "newton": int(sim.totals["newton"][0]),
            "violation_over_size": sim.max_violation / sim.model.size}  # fmt: skip
    return halvings


def cuts(count, dt):
    """All possible lists of substeps of a step with this number of halvings: a half may be halved again."""
    if count == 0:
        return [[dt]]
    return [a + b for k in range(count) for a in cuts(k, dt / 2) for b in cuts(count - 1 - k, dt / 2)]


def best_fall(integrator, halvings, dt, v0, distance):
    """Smallest distance to the fall of the substeps that these steps may have had, which are far apart from each other;
    None for too many to try."""
    choices = [cuts(n, dt) for n in halvings]
    if np.prod([float(len(c)) for c in choices]) > 64.0:
        return None
    return min(distance(fall(integrator, itertools.chain(*c), v0)[0]) for c in itertools.product(*choices))


TIES = ("spherical", "revolute", "fixed", "distance")
OUTER = {"multipliers": "outer"}
SOLVERS = [{}, {"penalty": 1.0}, {"penalty": 1e4}, {"max_newton": 1, "max_pcg": 1},
           OUTER | {"penalty": 1.0}, OUTER, OUTER | {"penalty": 1e4}, OUTER | {"max_outer": 1}]  # fmt: skip


def fall_of_a_pair(device, E, tie, second, integrator, options, steps=30, dt=1e-2):
    """Row of a pair released at rest; None as its error if the substeps are unknown."""
    pair = Pair(device, tie, E=E, second=second)
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "fall", "joint": tie, "second": second, "integrator": integrator, "E": E, "dt": dt,
           "solver": options, "error": None}  # fmt: skip
    halvings = attempt(row, sim, steps)
    if halvings is None:
        return row
    if integrator == "backward_euler" and not any(halvings):  # summed
        u, _ = fall(integrator, [dt] * steps, np.zeros(3))
        assert np.allclose(u, GRAVITY * dt**2 * steps * (steps + 1) / 2, rtol=1e-13, atol=0.0)
    row["error"] = best_fall(integrator, halvings, dt, np.zeros(3), lambda u: pair.points_error(sim, u))
    return row


def _spinning(device, E, tie, second, integrator, options, steps=20, dt=1e-2):
    """About its centre of mass: its fall, and with backward Euler the moment balance of each step,

    L_n+1 - L_n = h sum M v_n+1 x v_n, which holds if the forces between the bodies are without a moment at q_n+1."""
    pair = Pair(device, tie, E=E, second=second, velocity=(1.0, 0.0, 2.0), spin=np.array([1.0, 2.0, 8.0]))
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "spin", "joint": tie, "second": second, "integrator": integrator, "E": E, "dt": dt,
           "solver": options, "error": None, "moment_balance": None, "kept": None}  # fmt: skip
    M = pair.consistent
    _, v0, _, v, start = pair.motion(sim.state)
    halvings, L, balance = [], start, 0.0
    for _ in range(steps):
        part: dict[str, Any] = {}
        done = attempt(part, sim, 1)
        if done is None:
            return row | part
        row |= part
        halvings += done
        moved, pace, _, v_new, L_new = pair.motion(sim.state)
        if done[0] == 0:
            away = L_new - L - dt * np.cross(v_new, M @ v).sum(axis=0)
            balance = max(balance, float(np.linalg.norm(away) / np.linalg.norm(start)))
        v, L = v_new, L_new
    row["error"] = best_fall(integrator, halvings, dt, v0, lambda u: float(np.abs(moved - u).max() / np.abs(u).max()))
    row |= {"steps": steps, "halvings": sum(halvings), "newton": int(sim.totals["newton"][0]),
            "kept": float(np.linalg.norm(L) / np.linalg.norm(start))}  # fmt: skip
    if integrator == "backward_euler" and not any(halvings):
        row["moment_balance"] = balance
    return row


def _beside_an_impact(device, tie, integrator):
    """The pair, a soft box running against its clamp, which halves all steps, and a lone box falling with the pair:
    same displacement everywhere; with backward Euler the velocity is n h g for any substeps.
    """
    lone = []

    def extra(b):
        soft = wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0)
        hit = b.add_solid(wf.mesh.box((1.0, 0.4, 0.4), cells=(4, 2, 2), origin=(0, 2, 0)), material=soft, name="hit")
        b.clamp(hit.nodes("x-"))
        b.set_initial(hit, velocity=(-20.0, 0.0, 0.0))
        steel = wf.SVK(E=2e9, nu=0.3, density=1000.0)
        lone.append(b.add_solid(wf.mesh.box(BOX, cells=(1, 1, 1), origin=(0, 4, 0)), material=steel, name="lone"))

    pair = Pair(device, tie, E=2e9, extra=extra)
    dt, steps = 1e-2, 5
    options: dict[str, Any] = {"max_newton": 3}  # so that the impact halves steps
    sim = wf.Simulation(pair.model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(**options))
    row = {"case": "beside an impact", "joint": tie, "second": "T10", "integrator": integrator, "E": 2e9, "dt": dt,
           "solver": options, "error": None}  # fmt: skip
    if attempt(row, sim, steps) is None:
        return row
    row["error"] = pair.points_error(sim, sim.displacements(lone[0])[0].mean(axis=0))
    pace = pair.motion(sim.state)[1]
    row["velocity_error"] = None
    if integrator == "backward_euler":
        row["velocity_error"] = float(np.abs(pace / (GRAVITY * dt * steps) - 1.0).max())
    return row


def free_fall(run: Run) -> Iterator[Row]:
    """Two bodies tied by a joint fall as one, against the scheme's recursion; backward Euler's q = g h^2 n (n + 1) / 2.

    fall: all nodes of a pair let go at rest, over the fall. spin: the centre of mass of a pair thrown spinning at 8.3
    rad/s, 20 steps of 1/8 turn per 10 ms at most; with max_newton steps are halved; `moment_balance` is the change
    of angular momentum by the joint's forces in a step, over it; `kept` is L_end / L_start. beside an impact: steps
    halved by another body. welded: `kept` of the pair against one body of both, `from_one_body` their difference
    over the loss.
    """
    device, quick, schemes, soft, stiff = run.device, run.quick, ("backward_euler", "bdf2"), 1e5, 2e9
    for tie, scheme in itertools.product(TIES, schemes[: 1 if quick else 2]):
        falls = [(soft, "T10", o) for o in SOLVERS] + [(stiff, s, o) for s in ("T10", "3243") for o in SOLVERS[:3]]
        for E, second, how in falls + ([] if quick else [(stiff, "T10", o) for o in SOLVERS[4:]]):
            yield fall_of_a_pair(device, E, tie, second, scheme, how)
    for tie, (scheme, limit) in itertools.product(TIES[1:3] if quick else TIES, zip(schemes, (4, 3))):
        some = [{}] if quick else [{}, {"tol": 1e-3}, {"penalty": 1e4}, OUTER | {"penalty": 1.0}]
        for how in (*some, {"max_newton": limit}):
            yield _spinning(device, stiff, tie, "T10", scheme, how, steps=4 if quick else 20)
        if not quick:
            yield _spinning(device, stiff, tie, "3243", scheme, {})
    for tie, scheme in itertools.product(("revolute",) if quick else TIES, schemes):
        yield _beside_an_impact(device, tie, scheme)
    for E in () if quick else (2e7, 2e8, 2e9, 2e10):
        one = _spinning(device, E, None, "T10", "backward_euler", {})
        for joint in (None, "weld", "fixed", "revolute", "spherical"):
            row = _spinning(device, E, joint, "T10", "backward_euler", {}) if joint else dict(one)
            away = abs(row["kept"] - one["kept"]) / (1.0 - one["kept"])
            yield row | {"joint": joint or "one body", "from_one_body": away, "case": "welded"}


PARTS = (rigid_slider_crank, double_pendulum, hanging_chain, free_fall, no_drift)
TABLE = Table(
    about=__doc__,
    parts={part.__name__: part for part in PARTS},
    results={"mechanisms.json": "mechanisms --out tests/results/mechanisms.json"},
    takes="about an hour",
    apart=True,
)
