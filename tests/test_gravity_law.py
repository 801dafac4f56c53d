"""Gravity as a time law."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf


@wp.func
def growing(t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(-10.0) * t)


SAMPLES = ((0.0, 1.0), ((0, 0, 0), (0, 0, -10.0)))
LAWS = {"samples": SAMPLES, "function": growing}


def cube(gravity, density=1000.0):
    b = wf.ModelBuilder(gravity=gravity)
    law = wf.SVK(E=1e6, nu=0.3, density=density)
    body = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=law, name="cube")
    return b, body


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "generalized_alpha"])
def test_a_free_body_falls_as_the_scheme_says(name, integrator):
    b, body = cube(LAWS[name])
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.01, integrator=integrator)
    sim.step(50)
    v = sim.velocities(body)[0]
    assert np.allclose(v, v[0], atol=1e-10)
    wanted = -10.0 * 0.5 * 0.5**2
    if integrator == "backward_euler":
        wanted = -10.0 * 0.01**2 * sum(range(1, 51))
    assert v[0, 2] == pytest.approx(wanted, rel=1e-9 if integrator == "backward_euler" else 1e-3)
    e = {k: x[0] for k, x in sim.energies().items()}
    assert abs(e["ledger_residual"]) < 1e-9 * e["kinetic"]


def test_the_ledger_closes_where_a_body_is_held():
    b, body = cube(SAMPLES)
    b.clamp(body.nodes("z-"))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.02, solver=wf.NewtonPCG(tol=1e-12))
    sim.step(50)
    e = {k: x[0] for k, x in sim.energies().items()}
    assert abs(e["ledger_residual"]) < 1e-10 * e["strain"]
    assert e["potential"] != 0.0


def test_statics_takes_a_law_at_the_part_of_the_load():
    tips = []
    tilt = ((0.0, 0.5, 1.0), ((0, 0, 0), (10.0, 0, -20.0), (5.0, 0, -10.0)))
    for gravity in ((5.0, 0, -10.0), tilt):
        b, body = cube(gravity)
        b.clamp(body.nodes("z-"))
        b.add_probe("tip", body.surface("z+"))
        found = wf.solve_static(b.finalize(device="cpu"), load_steps=4, tol=1e-12)
        tips.append(found.probe("tip").displacement[0])
    assert np.allclose(tips[0][-1], tips[1][-1], rtol=1e-9)
    assert tips[1][1, 2] == pytest.approx(2.0 * tips[1][-1, 2], rel=0.01)


def test_a_reset_begins_with_the_law_anew():
    b, body = cube(SAMPLES)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.1)
    sim.step(5)
    before = sim.velocities(body)
    sim.reset()
    sim.step(5)
    assert np.array_equal(sim.velocities(body), before)


def test_errors():
    model = cube(SAMPLES)[0].finalize(device="cpu")
    with pytest.raises(wf.ModelError, match="time law of gravity"):
        model.set_gravity((0, 0, -1.0))
    with pytest.raises(wf.ModelError, match="gravity"):
        cube(((0.0, 1.0), ((0, 0), (0, 1))))
    with pytest.raises(wf.ModelError, match=r"gravity.*wp\.func"):
        cube(lambda t: t)
    with pytest.raises(wf.ModelError, match="density"):
        cube(SAMPLES, density=None)[0].finalize(device="cpu")
