"""Kelvin-Voigt damping beside other things: other bodies, no loads, statics."""

import numpy as np
import pytest

import warpfea as wf

FORMS = ("incremental", "rate", "explicit")


def law(form=None):
    damping = wf.KelvinVoigt(50.0, 75.0, form=form) if form else None
    return wf.SVK(E=1e5, nu=0.3, density=1000.0, damping=damping)


def swing(forms, gravity=(0.0, 0.0, 0.0)):
    """Clamped bars that start with a velocity; their tips after some steps."""
    b = wf.ModelBuilder(gravity=gravity)
    bodies = []
    for k, form in enumerate(forms):
        body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law(form), name=f"bar{k}")
        b.clamp(body.nodes("x-"))
        b.set_initial(body, velocity=lambda X: np.outer(X[:, 0], (0, 0, 1.0)))
        bodies.append(body)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, solver=wf.NewtonPCG(tol=1e-11))
    sim.step(20)
    return [sim.displacements(body) for body in bodies], sim


@pytest.mark.parametrize("form", FORMS)
def test_a_damped_body_does_not_touch_its_neighbour(form):
    (damped, plain), _ = swing([form, None])
    alone = swing([form])[0][0], swing([None])[0][0]
    size = np.abs(plain).max()
    assert np.abs(damped - alone[0]).max() < 1e-9 * size
    assert np.abs(plain - alone[1]).max() < 1e-9 * size
    assert np.abs(damped - plain).max() > 1e-5 * size


@pytest.mark.parametrize("form", FORMS)
def test_no_loads_or_hardly_any_make_no_difference(form):
    without, bare = swing([form])
    hardly, _ = swing([form], gravity=(0.0, 0.0, -1e-30))
    assert np.abs(without[0] - hardly[0]).max() < 1e-12
    assert bare.energies()["viscous"][0] > 0.0


@pytest.mark.parametrize("form", FORMS)
def test_statics_has_no_rates(form):
    tips = []
    for kind in (form, None):
        b = wf.ModelBuilder(gravity=(0, 0, -1.0))
        body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law(kind))
        b.clamp(body.nodes("x-"))
        tips.append(wf.solve_static(b.finalize(device="cpu"), load_steps=2, tol=1e-11).displacements(body))
    assert np.array_equal(*tips)


def test_dynamics_goes_on_from_an_equilibrium():
    b = wf.ModelBuilder(gravity=(0, 0, -1.0))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law())
    b.clamp(body.nodes("x-"))
    model = b.finalize(device="cpu")
    static = wf.solve_static(model, load_steps=2, tol=1e-12)
    rest = static.displacements(body)
    sim = wf.Simulation(model, static.state, dt=1e-2)
    sim.run(0.1)
    assert sim.time[0] == pytest.approx(0.1)
    assert np.abs(sim.displacements(body) - rest).max() < 1e-8 * np.abs(rest).max()
    # and a changed load is solved anew from there
    model.set_gravity((0, 0, -2.0))
    again = wf.solve_static(model, load_steps=1, tol=1e-12, state=static.state)
    assert np.abs(again.displacements(body)).max() > 1.5 * np.abs(rest).max()


def test_a_scheme_takes_no_past_from_another():
    """BDF2, then backward Euler, then BDF2 on one state: the second stretch starts as from a fresh state."""
    b = wf.ModelBuilder(gravity=(0, 0, -1.0))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law())
    model = b.finalize(device="cpu")
    state = model.state()
    for scheme in ("bdf2", "backward_euler"):
        wf.Simulation(model, state, dt=1e-2, integrator=scheme, ledger=scheme == "bdf2").step(3)
    fresh = model.state()
    for name in ("displacement", "velocity", "time"):
        getattr(fresh, name).assign(getattr(state, name))
    results = []
    for start in (state, fresh):
        sim = wf.Simulation(model, start, dt=1e-2, integrator="bdf2")
        sim.step(3)
        results.append(sim.displacements(body))
        change = sim.energies()
        assert abs(change["ledger_residual"][0] - change["unbalanced"][0]) < 1e-9
    assert np.array_equal(*results)


def test_driven_nodes_keep_their_initial_velocity():
    """A body in uniform motion whose end is driven at that speed feels nothing."""
    for scheme in ("backward_euler", "bdf2"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law())
        b.drive(body.nodes("x-"), displacement=([0, 1], [(0, 0, 0), (1, 0, 0)]))
        b.set_initial(body, velocity=(1.0, 0, 0))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator=scheme)
        sim.step(5)
        assert np.abs(sim.displacements(body)[0] - (5e-3, 0, 0)).max() < 1e-12
