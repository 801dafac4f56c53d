"""Cubes for contact that is compared with closed forms."""

from __future__ import annotations

import numpy as np
from warpfea.kernels.contact.structs import RECORD_NAMES

import warpfea as wf
from warpfea.contact.colliders import ColliderContact
from warpfea.model.contact_points import contact_points
from warpfea.model.handles import SurfaceSet

G = 9.81
STIFF = wf.SVK(E=1e9, nu=0.3, density=1000.0)
"""A cube of it, 0.1 m and 1 kg, is rigid beside a contact of `stiffness` 1e-5."""
TURN = np.array([[0.8, 0.36, 0.48], [0.0, 0.8, -0.6], [-0.6, 0.48, 0.64]])


def tilted(X):
    """A cube turned so that one corner is its lowest, at z = 0."""
    return X @ TURN.T + (0.0, 0.0, 0.06)


def everywhere(X):
    return np.ones(len(X), dtype=bool)


def cube(b, name="cube", map=None, origin=(0.0, 0.0, 0.0), material=STIFF):
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4", origin=origin, map=map)
    return b.add_solid(mesh, material=material, name=name)


def middle(map=None, origin=(0.0, 0.0, 0.0)):
    X = np.array([[0.05, 0.05, 0.05]]) + origin
    return tuple((X if map is None else map(X))[0])


def record(sim, contact):
    """Fields of the last step's record of a contact, by name."""
    term = sim.model.terms.find(ColliderContact)
    first = term.report_offset + len(RECORD_NAMES) * term.tables.number[contact.index]
    return dict(zip(RECORD_NAMES, sim.stepper.work.report.numpy()[0, first : first + len(RECORD_NAMES)]))


LOAD = 2e3


def flat_side(body, sign):
    """The faces at the lowest (1) or the highest (-1) z."""
    z = sign * contact_points(SurfaceSet(body, body.boundary)).X[..., 2]
    return body.surface(body.boundary[(np.ptp(z, axis=1) < 1e-12) & (z.mean(axis=1) < z.min() + 1e-9)])


def pressed(make, nu=0.3, **options):
    """Pressures at the points, Pa, and depths, m, of a body that a uniform dead load presses onto a plane, at rest."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = make(b, wf.SVK(E=1e6, nu=nu, density=1000.0))
    b.add_traction(flat_side(body, -1), (0, 0, -LOAD))
    surface = flat_side(body, 1)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), contact_points(surface).X[..., 2].min()))
    b.add_contact(surface, floor, restitution=0.3, **options)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=0.02, solver=wf.NewtonPCG(tol=1e-10), record=False)
    sim.step(600)  # what is left of the motion falls tenfold in 62 steps
    term = model.terms.find(ColliderContact)
    gap, force = term.at_points(sim.state)
    area = term.tables.host[0].area.ravel()
    used = area > 0.0
    return force[0, used, 2] / area[used], -gap[0, used], force[0, :, 2].sum()
