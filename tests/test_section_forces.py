"""Section forces of beams under distributed loads and inertia."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.outputs.frames import field_label

AREA, RHO = 0.05 * 0.05, 1000.0
LAW = wf.SVK(E=1e9, nu=0.0, density=RHO)
SOFT = wf.SVK(E=1e6, nu=0.0, density=RHO)


def bar(b, law=LAW, name="beam"):
    section, line = wf.Rectangle(0.05, 0.05), [(0, 0, 0), (1, 0, 0)]
    return b.add_beam(line, elements=4, section=section, normal=(0, 0, 1), material=law, name=name)


@wp.func
def pull(x: wp.vec3, t: float):
    """Body force, N/kg."""
    return wp.vec3(0.0, 0.0, -10.0 - 10.0 * x[0])


class Halfway:
    """Q and M at half of a static load."""

    def __init__(self, beam):
        self.beam = beam

    def open(self, sim):
        pass

    def write(self, sim):
        if (sim.load == 0.5).all():
            self.values = np.stack([sim.field(f"section_force.{name}", self.beam) for name in ("Qz", "My")])

    def close(self, sim):
        pass


@pytest.mark.parametrize("load", ["weight", "weight over time", "traction"])
def test_cantilever_under_distributed_load(load):
    """Q = q (L - x) and M = q (L - x)^2 / 2 at every node, in worlds of their own gravity and density."""
    q = np.array([1e-3, 2e-3])  # N/m, in two worlds
    g = (0, 0, -q[0] / RHO / AREA)
    gravity = {"weight": g, "weight over time": ((0.0, 1.0), ((0, 0, 0), g)), "traction": (0, 0, 0)}[load]
    b = wf.ModelBuilder(gravity=gravity)
    beam = bar(b)
    b.clamp(beam.start, slots="all")
    if load == "traction":
        b.add_traction(beam.surface("normal+"), (0, 0, -q[0] / 0.05))
        b.add_traction(beam.surface("end"), (0, 0, -1.0))  # no load of the element
    model = b.finalize(device="cpu", worlds=2)
    if load == "weight":
        model.set_gravity(np.outer([q[0] / RHO / AREA, q[1] / 4 / RHO / AREA], (0, 0, -1.0)))
        model.set_parameter("beam.density", RHO * np.array([1.0, 4.0]))
    else:
        q[1] = q[0]
    tip = AREA if load == "traction" else 0.0
    halfway = Halfway(beam)
    r = wf.solve_static(model, load_steps=2, tol=1e-13, unstable="ignore", outputs=[halfway])
    N, Qy, Qz, T, My, Mz = np.moveaxis(r.field("section_force", beam), 2, 0)
    arm = 1.0 - np.linspace(0, 1, 5)
    assert np.abs(Qz + np.outer(q, arm) + tip).max() < 1e-10
    assert np.abs(My - np.outer(q, arm**2) / 2 - tip * arm).max() < 1e-9
    assert np.abs(np.stack([N, Qy, T, Mz])).max() < 1e-8
    assert np.abs(halfway.values - np.stack([Qz, My]) / 2).max() < 1e-9


@pytest.mark.parametrize("integrator", ["backward_euler", "generalized_alpha(rho_inf=0.5)"])
def test_falling_and_swinging(integrator):
    """Nothing in free fall; at a clamp the reaction, and nothing at a free end, in any motion."""
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    falling, swinging = bar(b, law=SOFT, name="falling"), bar(b, law=SOFT, name="swinging")
    b.clamp(swinging.start, slots="all")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator=integrator, solver=wf.NewtonPCG(tol=1e-12))
    assert not sim.field("section_force", falling).any()  # accelerations are unknown before the first step
    sim.run(0.1)
    weight = 10.0 * RHO * AREA
    assert np.abs(sim.field("section_force", falling)).max() < 1e-9 * weight
    force, moment = np.split(sim.field("section_force", swinging)[0], 2, axis=1)
    assert np.abs(sim.displacements(swinging)[0, -1, 2]) > 0.04  # m: falls 0.05 m when free
    reaction, moment_of_it = sim.reaction(swinging.start)[0], sim.reaction_moment(swinging.start)[0]
    assert np.linalg.norm(force[0]) == pytest.approx(np.linalg.norm(reaction), rel=1e-8)
    assert np.linalg.norm(moment[0]) == pytest.approx(np.linalg.norm(moment_of_it), rel=1e-8)
    assert np.abs(force[-1]).max() < 1e-8 * weight
    assert np.abs(moment[-1]).max() < 1e-8 * weight


def test_rotating_bar():
    """N = rho A omega^2 (l^2 - s^2) / 2 at s from the middle of a free bar of half length l that spins."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = bar(b)
    b.set_initial(beam, angular_velocity=(0, 0, 10.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.run(0.1)
    omega = np.linalg.norm(sim.velocities(beam)[0, 0]) / 0.5
    s = np.linspace(-0.5, 0.5, 5)
    exact = RHO * AREA * omega**2 * (0.25 - s**2) / 2
    assert [field_label(sim, f"section_force.{name}")[1] for name in ("Qz", "T")] == ["N", "N m"]
    found = sim.field("section_force", beam)[0]
    assert found[:, 0] == pytest.approx(exact, abs=1e-2 * exact.max())
    assert found[[0, -1]] == pytest.approx(0.0, abs=1e-6 * exact.max())


def test_pressure_body_force_and_contact_within_elements():
    """Q = int q under a small pressure and a body force; in contact, at a clamp the reaction and nothing at the tip."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = bar(b)
    b.clamp(beam.start, slots="all")
    b.add_pressure(beam.surface("normal+"), 20.0)
    b.add_body_force(pull)
    r = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-12, unstable="ignore")
    x = np.linspace(0, 1, 5)
    exact = 20.0 * 0.05 * (1 - x) + RHO * AREA * (10 * (1 - x) + 5 * (1 - x**2))
    assert np.abs(np.abs(r.field("section_force.Qz", beam)[0]) - exact).max() < 1e-4 * exact[0]
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = bar(b, law=SOFT)
    b.clamp(beam.start, slots="all")
    b.add_pressure(beam.surface("normal+"), 20.0)
    b.add_body_force(pull)
    b.add_contact(beam.surface("normal-"), b.add_collider(wf.HalfSpace((0, 0, 1), -0.03)), mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, solver=wf.NewtonPCG(tol=1e-10))
    sim.run(0.15)
    assert sim.field("contact_pressure", beam).max() > 100.0
    force, moment = np.split(sim.field("section_force", beam)[0], 2, axis=1)
    reaction, moment_of_it = sim.reaction(beam.start)[0], sim.reaction_moment(beam.start)[0]
    assert np.linalg.norm(force[0]) == pytest.approx(np.linalg.norm(reaction), rel=1e-9)
    assert np.linalg.norm(moment[0]) == pytest.approx(np.linalg.norm(moment_of_it), rel=1e-9)
    assert np.abs(force[-1]).max() < 1e-8 * exact[0]
    assert np.abs(moment[-1]).max() < 1e-8 * exact[0]
