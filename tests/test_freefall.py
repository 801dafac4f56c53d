"""Unsupported bodies fall as backward Euler's closed form says, whatever the law, step, precision or iteration cap."""

import itertools

import numpy as np
import pytest
import warp as wp
from pairwise import covering

import warpfea as wf

GRAVITY = np.array([0.0, 0.0, -9.81])


@wp.func
def uniform_field(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(1.0) + t, wp.float64(-2.0), wp.float64(3.0) * wp.sin(t))


def field_value(t):
    return np.array([1.0 + t, -2.0, 3.0 * np.sin(t)])


def material(law, damping):
    kelvin = wf.KelvinVoigt(3e3, 4.5e3, form=damping) if damping else None
    if law == "svk":
        return wf.SVK(E=2e8, nu=0.3, density=1000.0, damping=kelvin)
    if law == "mooney_rivlin":
        return wf.MooneyRivlin(mu10=3e7, mu01=1e7, k=1e9, density=1000.0, damping=kelvin)
    return wf.NeoHookean(mu=4e7, k=1e9, density=1000.0, damping=kelvin)


def closed_form(load, h, steps, scheme="backward_euler"):
    u, v, t = np.zeros(3), np.zeros(3), 0.0
    for _ in range(steps):
        t += h
        v = v + h * (GRAVITY if load == "gravity" else field_value(t))
        u = u + h * v
    return u


def error_of(element, law, damping, dtype, load, cap, h, steps=8):
    b = wf.ModelBuilder(gravity=GRAVITY if load == "gravity" else (0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(3, 1, 1), element=element), material=material(law, damping))
    if load == "field":
        b.add_body_force(uniform_field)
    model = b.finalize(device="cpu", dtype=dtype)
    solver = wf.NewtonPCG(max_newton=cap, max_pcg=cap, max_halvings=0)
    sim = wf.Simulation(model, dt=h, solver=solver)
    sim.step(steps)
    exact = closed_form(load, h, steps)
    return np.abs(sim.displacements(body)[0] - exact).max() / np.abs(exact).max()


LAWS = ("svk", "mooney_rivlin", "neo_hookean")
FORMS = (None, "incremental", "rate", "explicit")


# each compiles two or three modules of its own
@pytest.mark.parametrize(
    ("kind", "damping", "dtype"),
    covering([*itertools.product(("T10", "T4"), LAWS)], FORMS, ("float64", "float32"), strength=1),
)
def test_free_fall_is_exact(kind, damping, dtype):
    bound = 1e-12 if dtype == "float64" else 1e-5
    for load in ("gravity", "field"):
        for cap in (1, 2, 50):
            for h in (1e-5, 1e-3, 0.1):
                assert error_of(*kind, damping, dtype, load, cap, h) < bound, (load, cap, h)


def test_free_fall_of_two_bodies_beside_a_clamped_one():
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((1, 0.1, 0.1), cells=(3, 1, 1))
    fall = [b.add_solid(mesh, material=material("svk", None), name=f"b{k}") for k in range(2)]
    held = b.add_solid(mesh, material=material("svk", None), name="held")
    b.clamp(held.nodes("x-"))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, solver=wf.NewtonPCG(tol=1e-4))
    sim.step(10)
    exact = closed_form("gravity", 1e-2, 10)
    for body in fall:
        assert np.abs(sim.displacements(body)[0] - exact).max() < 1e-12 * np.abs(exact).max()
    assert np.abs(sim.displacements(held)[0, :, 2]).max() > 0.0


def test_loose_tolerance_does_not_leak_momentum():
    """A body thrown spinning and vibrating, solved loosely: its centre of mass still follows the closed form."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1))
    body = b.add_solid(mesh, material=wf.SVK(E=1e5, nu=0.3, density=1000.0))
    b.set_initial(body, velocity=(1.0, 0.0, 0.0), angular_velocity=(0.0, 3.0, 0.0))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=5e-3, solver=wf.NewtonPCG(tol=1e-2))
    lumped = model.masses.lumped[0]
    before = lumped @ sim.state.velocity.numpy()[0]
    steps = 40
    sim.step(steps)
    after = lumped @ sim.state.velocity.numpy()[0]
    exact = before + lumped.sum() * GRAVITY * 5e-3 * steps
    assert np.abs(after - exact).max() < 1e-11 * np.abs(exact).max()


def test_bdf2_free_fall_is_exact():
    """BDF2 integrates constant acceleration exactly once its first, backward-Euler step is accounted for."""
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(3, 1, 1)), material=material("svk", None))
    h, steps = 1e-2, 12
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="bdf2")
    sim.step(steps)
    u, v = [np.zeros(3)], [np.zeros(3)]
    v.append(v[0] + h * GRAVITY)
    u.append(u[0] + h * v[1])
    for _ in range(steps - 1):
        v.append(4 / 3 * v[-1] - v[-2] / 3 + 2 / 3 * h * GRAVITY)
        u.append(4 / 3 * u[-1] - u[-2] / 3 + 2 / 3 * h * v[-1])
    assert np.abs(sim.displacements(body)[0] - u[-1]).max() < 1e-12 * np.abs(u[-1]).max()


def test_what_no_longer_vibrates_flies_on_in_few_iterations():
    """Its last vibrations are the round-off of its speed: without VELOCITY_ROUNDINGS steps take 30 iterations."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(1e3))
    body = b.add_solid(wf.mesh.box((0.2, 0.1, 0.1), cells=(2, 1, 1)), material=law)
    b.set_initial(body, velocity=(1.0, 0.3, 0.0))
    state = (model := b.finalize(device="cpu")).state()
    u = state.displacement.numpy()
    u[0, :, 0] += 1e-7 * np.cos(np.arange(u.shape[1]))
    state.displacement.assign(u)
    sim = wf.Simulation(model, state, dt=1e-3)
    sim.step(100)
    assert sum(int(sim.step().newton[0]) for _ in range(20)) <= 80
    assert np.ptp(sim.state.velocity.numpy()[0], axis=0).max() < 1e-11
