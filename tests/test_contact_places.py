"""Points at which a lumped contact acts: places between the points of a surface, and bodies that roll over them."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pairwise import covering

import warpfea as wf
from warpfea.model.contact_points import CONTACT_RULES, lagrange_basis


@pytest.mark.parametrize("count", [3, 4, 7, 9, 16, 25])
def test_polynomials_of_the_points(count):
    """1 at their own point and 0 at the others, a sum of 1 anywhere; on an edge only its points count."""
    rule = next(known[count] for known in CONTACT_RULES.values() if count in known)
    basis, power = lagrange_basis(rule.points)

    def functions(s):
        return np.prod(np.asarray(s)[:, None, :] ** power, axis=2) @ basis.T

    assert functions(rule.points) == pytest.approx(np.eye(count), abs=1e-11)
    inside = np.random.default_rng(1).uniform(0.0, 0.5, (20, 2))
    assert functions(inside).sum(axis=1) == pytest.approx(np.ones(20), abs=1e-11)
    edge = functions(np.stack([np.linspace(0.0, 1.0, 9), np.zeros(9)], axis=1))
    assert np.abs(edge[:, np.abs(rule.points[:, 1]) > 1e-12]).max() < 1e-11


STIFF = wf.SVK(E=2e6, nu=0.3, density=1000.0)


def pressed(mesh, shape, **options):
    """Force, N, and moment, N m, of one step in which a body, all nodes driven, goes down by 1 mm, and a free one."""
    b = wf.ModelBuilder()
    body = b.add_solid(mesh, material=STIFF, name="body")
    b.drive(body.nodes(lambda X: np.ones(len(X), dtype=bool)), displacement=([0.0, 0.1], [(0, 0, 0), (0, 0, -1e-3)]))
    b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(5, 0, 5)), material=STIFF)
    contact = b.add_contact(body, b.add_collider(shape), model="sphere", radius=0.3, **options)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.1)
    sim.step()
    record = sim.contact_record(contact)
    return record.force[0, -1], record.moment[0, -1], sim


@pytest.mark.parametrize("element", ["T4", "T10"])
@pytest.mark.parametrize(("x", "y"), [(0.031, 0.057), (0.083, 0.012)])
def test_a_flat_face_is_touched_between_its_points(element, x, y):
    """A cube of 0.1 m over a ball of 20 mm: Hertz's force at the ball's top, wherever that is on the face."""
    R = 0.02
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element=element)
    force, moment, sim = pressed(mesh, wf.Sphere((x, y, -R), R))
    hertz = 4.0 / 3.0 * 2e6 / (1.0 - 0.3**2) * math.sqrt(1.0 / (1.0 / 0.3 + 1.0 / R)) * 1e-3**1.5
    assert force == pytest.approx([0.0, 0.0, hertz], rel=1e-10, abs=1e-6 * hertz)
    assert moment / hertz == pytest.approx([y, -x, 0.0], abs=1e-6)
    assert sim.model.contact_force(sim.state)[0].sum(axis=0) == pytest.approx(force, rel=1e-9, abs=1e-9 * hertz)


def test_a_quadrilateral_is_touched_between_its_points():
    R, depth, at = 0.02, 1e-3, (0.031, 0.057)
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="H3843"), material=STIFF, element="H3843")
    b.add_contact(body.surface("z-"), b.add_collider(wf.Sphere((*at, -R), R)), model="sphere", radius=0.3)
    model = b.finalize(device="cpu")
    state = model.state()
    u = state.displacement.numpy()
    u[0, body.slots[body.slot_kind == 0]] = (0.0, 0.0, -depth)
    state.displacement.assign(u)
    force = model.contact_force(state)[0][body.slots[body.slot_kind == 0]]
    hertz = 4.0 / 3.0 * 2e6 / (1.0 - 0.3**2) * math.sqrt(1.0 / (1.0 / 0.3 + 1.0 / R)) * depth**1.5
    assert force.sum(axis=0) == pytest.approx([0.0, 0.0, hertz], rel=1e-10, abs=1e-6 * hertz)


def test_a_curved_face_is_touched_at_its_lowest_place():
    """The surface of a ball of T10 is within 2e-5 m of a sphere of 50 mm, that of its points within 1e-3."""
    R, low = 0.05, []
    for turn in np.linspace(0.0, 1.2, 7):
        c, s = math.cos(turn), math.sin(turn)
        frame = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
        ball = wf.mesh.sphere(R, cells=4)
        mesh = wf.mesh.Mesh(ball.points @ frame.T + (0.0, 0.0, R), ball.cells, ball.cell_type)
        force, _, _ = pressed(mesh, wf.HalfSpace((0, 0, 1)))
        low.append((force[2] / (4.0 / 3.0 * 2e6 / (1.0 - 0.3**2) * math.sqrt(0.3))) ** (2.0 / 3.0))
    assert np.array(low) == pytest.approx(1e-3, abs=2e-5)


@pytest.mark.parametrize(("integrator", "restitution"), covering(["backward_euler", "bdf2"], [1.0, 0.3], strength=1))
def test_a_rolling_ball(integrator, restitution):
    """5/7 g sin(0.2) down a slope; the integrator does not add energy, BDF2 by less than 3 % of what falls."""
    angle, R, T, dt = 0.2, 0.05, 0.3, 0.005
    n, t = (np.array(a) for a in ((math.sin(angle), 0, math.cos(angle)), (math.cos(angle), 0, -math.sin(angle))))
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    material = wf.NeoHookean.from_E_nu(E=1e6, nu=0.4, density=1000.0)
    ball = b.add_solid(wf.mesh.sphere(R, cells=4, center=tuple(n * R)), material=material, name="ball")
    slope = b.add_collider(wf.HalfSpace(tuple(n)))
    b.add_contact(ball, slope, model="sphere", radius=R, mu=0.5, restitution=restitution)
    b.add_probe("centre", ball.at(tuple(n * R)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=dt, integrator=integrator)
    reports = [sim.step() for _ in range(round(T / dt))]
    assert max(int(r.newton[0]) for r in reports) <= 30
    assert not any(r.halvings.any() for r in reports)
    gone = sim.probe("centre").displacement[0, -1] @ t
    pull = 9.81 * math.sin(angle)
    assert gone == pytest.approx(0.5 * 5.0 / 7.0 * pull * T**2, rel=0.03)
    fallen = 1000.0 * 4.0 / 3.0 * math.pi * R**3 * pull * gone
    e = {name: float(values[0]) for name, values in sim.energies().items()}
    assert e["integrator"] > (0.0 if integrator == "backward_euler" else -0.03) * fallen
    assert e["integrator"] + e["contact_loss"] + e["friction"] > 0.0
    assert abs(e["ledger_residual"]) < 1e-4 * fallen


@pytest.mark.parametrize(
    ("E", "cells", "most"),
    [(1e5, 4, 1.04), (1e6, 4, 1.04), (1e7, 4, 1.04), pytest.param(1e6, 6, 1.01, marks=pytest.mark.slow)],
)
def test_a_ball_rolls_by_default(E, cells, most):
    """5/7 g sin(0.2), of backward Euler's way a T (T + h)/2. A ball of four cells, whose elements are five contact
    radii long, sinks by 0.5 to 0.7 mm as it turns: it gains 10 % of its speed in the first hollow, 3 % of its way."""
    angle, R, T, dt = 0.2, 0.05, 0.3, 0.005
    n, t = (np.array(a) for a in ((math.sin(angle), 0, math.cos(angle)), (math.cos(angle), 0, -math.sin(angle))))
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    material = wf.NeoHookean.from_E_nu(E=E, nu=0.4, density=1000.0)
    ball = b.add_solid(wf.mesh.sphere(R, cells=cells, center=tuple(n * R)), material=material, name="ball")
    b.add_contact(ball, b.add_collider(wf.HalfSpace(tuple(n))), mu=0.5)
    b.add_probe("centre", ball.at(tuple(n * R)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=dt)
    sim.step(round(T / dt))
    rigid = 5.0 / 7.0 * 9.81 * math.sin(angle)
    probe = sim.probe("centre")
    assert 0.97 < probe.displacement[0, -1] @ t / (0.5 * rigid * T * (T + dt)) < most
    assert 0.97 < probe.velocity[0, -5:].mean(axis=0) @ t / (rigid * (T - 2 * dt)) < most
