"""Point masses in the mass matrix, in weight, momentum and statics; on rigid parts."""

import numpy as np
import pytest
from spring_models import CENTRE, EXACT, HARD, cube, polar_inertia
from tight_solvers import SOLVERS

import warpfea as wf


def weighted(at, mass=3.0):
    """A cube with a point mass."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2), element="T4")
    body = b.add_solid(mesh, material=HARD, name="cube")
    b.add_point_mass(at(body), mass)
    return b, body


PLACES = {
    "point": (lambda c: c.at((0.03, 0.08, 0.05)), (0.03, 0.08, 0.05)),
    "face": (lambda c: c.surface("x+"), (0.1, 0.05, 0.05)),
    "nodes": (lambda c: c.nodes(lambda X: (X[:, 0] < 1e-9) | (X[:, 0] > 0.099)), CENTRE),
}


@pytest.mark.parametrize("where", list(PLACES))
def test_a_point_mass_counts_everywhere(where):
    """Mass, weight, centre, momentum, kinetic energy, all solvers and the reaction of statics see it."""
    b, body = weighted(PLACES[where][0])
    b.set_initial(body, angular_velocity=(0, 0, 2.0))
    model = b.finalize(device="cpu")
    assert model.mass == pytest.approx(4.0, rel=1e-12)
    centre = (CENTRE + 3.0 * np.array(PLACES[where][1])) / 4.0
    M, is_position = model.mass_matrix()[::3, ::3], model.slot_table.is_position
    np.testing.assert_allclose((is_position @ M @ (body.reference + body.origin)) / model.mass, centre, atol=1e-12)
    motions = {}
    for name, solver in SOLVERS.items():
        sim = wf.Simulation(model, dt=1e-3, solver=solver)
        sim.step(20)
        v = sim.state.velocity.numpy()[0].astype(float)
        np.testing.assert_allclose(is_position @ M @ v, [0, 0, -4.0 * 9.81 * 0.02], atol=1e-10)
        assert sim.energies()["kinetic"][0] == pytest.approx(0.5 * np.sum(v * (M @ v)), rel=1e-12)
        motions[name] = sim.state.displacement.numpy()
        assert np.abs(motions[name] - motions["matrix"]).max() < 1e-8 * np.abs(motions["matrix"]).max()
    b.clamp(body.nodes("z-"))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-10)
    assert static.reaction(body.nodes("z-"))[0, 2] == pytest.approx(4.0 * 9.81, rel=1e-8)


def test_the_inertia_of_a_point():
    """A torsion oscillator of the cube with I + J + m r^2."""
    b, body = cube()
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=body.surface("z-"), anchor=CENTRE, axis=(0, 0, 1))
    inertia = polar_inertia(body, CENTRE) + 2.0 * 0.04**2 + 0.01
    b.add_point_mass(body.at((0.05, 0.09, 0.05)), 2.0, inertia=0.01)
    assert polar_inertia(body, CENTRE) == pytest.approx(inertia, rel=1e-12)
    b.add_torsion_spring(hinge, stiffness=100.0 * inertia)
    b.set_initial(body, velocity=lambda X: np.cross([0, 0, 1.0], X - CENTRE))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator="energy_momentum", solver=EXACT)
    sim.run(0.4)
    assert sim.joint_value(hinge)[0] == pytest.approx(np.sin(4.0) / 10.0, abs=1e-5)


def test_rigid_parts_take_springs_and_masses():
    """A rigid cube as a torsion oscillator of 1e-5 at h = 1e-3 s, order 2, with a point mass and its inertia."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    part = b.add_rigid(wf.Box(CENTRE, (0.1, 0.1, 0.1)), density=1000.0, name="part")
    b.add_point_mass(part.at((0.05, 0.09, 0.05)), 2.0, inertia=0.01)
    inertia = 0.02 / 12.0 + 2.0 * 0.04**2 + 0.01
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=part.at(CENTRE), anchor=CENTRE, axis=(0, 0, 1))
    b.add_torsion_spring(hinge, stiffness=100.0 * inertia)
    b.set_initial(part, velocity=lambda X: np.cross([0, 0, 1.0], X - CENTRE))
    model = b.finalize(device="cpu")
    assert model.mass == pytest.approx(3.0, rel=1e-12)
    errors = []
    for h in (2e-3, 1e-3):
        sim = wf.Simulation(model, dt=h, integrator="energy_momentum", solver=EXACT, constraint_tol=1e-12)
        sim.run(0.4)
        errors.append(abs(sim.joint_value(hinge)[0] - np.sin(4.0) / 10.0))
    assert errors[1] < 1e-5, errors
    assert errors[0] > 3.5 * errors[1], errors
    assert abs(sim.energies()["integrator"][0]) < 1e-10 * sim.energies()["springs"][0]
