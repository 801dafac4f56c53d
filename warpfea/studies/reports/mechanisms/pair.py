"""Two bodies tied by a joint, their fall and their momenta."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

import warpfea as wf

from .cases import X, Z

__all__ = ["BOX", "GRAVITY", "Pair", "attempt", "best_fall", "fall"]

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
        m = model.lumped_host[own]
        return m @ x[own] / m[model.slot_kind[own] == 0].sum()

    @staticmethod
    def _places(model, u):
        position = (model.slot_kind == 0)[:, None]
        origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
        return model.reference + position * origin + u

    def motion(self, state):
        """Displacement and velocity of the centre of mass; places and velocities (slots, 3) about it; L about it."""
        m, own = self.model, self.mask
        u, v = (array.numpy()[0].astype(float) for array in (state.displacement, state.velocity))
        lumped, position = m.lumped_host[own], (m.slot_kind[own] == 0)[:, None]
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
    """All lists of substeps that a step may have had which was halved so many times: a half may be halved again."""
    if count == 0:
        return [[dt]]
    return [a + b for k in range(count) for a in cuts(k, dt / 2) for b in cuts(count - 1 - k, dt / 2)]


def best_fall(integrator, halvings, dt, v0, distance):
    """Smallest distance to the fall of the substeps that these steps may have had, which are far apart from each other;
    None where they are too many to try."""
    choices = [cuts(n, dt) for n in halvings]
    if np.prod([float(len(c)) for c in choices]) > 64.0:
        return None
    return min(distance(fall(integrator, itertools.chain(*c), v0)[0]) for c in itertools.product(*choices))
