"""Statics of bodies that contact alone holds: springs that fade with the load."""

import math

import numpy as np
import pytest

import warpfea as wf

SIDE, G = 0.1, 9.81
MASS = 1000.0 * SIDE**3


def block(angle=0.0, *, mu=0.5, gap=0.0, E=1e6, density=1000.0, stiffness=None):
    """A cube on a floor of that incline (rad), `gap` above it, m."""
    b = wf.ModelBuilder(gravity=(G * math.sin(angle), 0.0, -G * math.cos(angle)) if density else (0, 0, 0))
    law = wf.SVK(E=E, nu=0.3, density=density)
    cube = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(2, 2, 2)), material=law, name="cube", element="T10")
    pad = b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1), -gap)), mu=mu, stiffness=stiffness, name="pad")
    b.add_probe("middle", cube.at((SIDE / 2,) * 3))
    return b.finalize(device="cpu"), pad


@pytest.mark.parametrize(("gap", "E", "stiffness"), [(0.0, 1e6, None), (1e-3, 1e6, None), (1e-2, 1e9, "region")])
def test_a_block_comes_to_rest_on_the_floor(gap, E, stiffness):
    """The stiffness of elements of 1e9 Pa leaves round-off of 2e-8 of the weight."""
    model, pad = block(gap=gap, E=E, stiffness=stiffness)
    found = wf.solve_static(model, stabilise=True, tol=1e-10)
    record = found.simulation.contact_record(pad)
    assert record.normal_force[0, -1] == pytest.approx(MASS * G, rel=1e-8)
    assert np.allclose(record.force[0, -1], (0, 0, MASS * G), atol=1e-8 * MASS * G)
    fallen = -found.probe("middle").displacement[0, -1, 2]
    assert gap < fallen < gap + 500.0 * G * SIDE / E


def test_springs_are_reported_and_vanish():
    model, _ = block(gap=1e-3)
    springs = wf.solve_static(model, stabilise=100.0, load_steps=4).stabilise
    assert springs.stiffness == 100.0
    assert springs.force.shape == (1, 4, 3)
    assert springs.energy.shape == (1, 4)
    assert np.all(springs.energy[0, :3] > 0.0)
    assert springs.energy[0, 3] == 0.0
    assert np.all(springs.force[0, 3] == 0.0)
    assert np.all(springs.force[0, :3, 2] > 0.0)
    hung = MASS * 100.0 * 0.75 * 1e-3  # it hangs until the gap is closed
    assert springs.force[0, 0, 2] == pytest.approx(hung, rel=0.3)


def test_without_them_nothing_changes():
    model, _ = block()
    with pytest.raises(wf.ModelError, match=r"'cube' has 6 unconstrained rigid-body modes.*stabilise=True"):
        wf.solve_static(model)
    b = wf.ModelBuilder()
    bar = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(4, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1000.0))
    b.clamp(bar.nodes("x-"))
    b.add_probe("tip", bar.surface("x+"))
    clamped = b.finalize(device="cpu")
    plain = wf.solve_static(clamped, tol=1e-12)
    held = wf.solve_static(clamped, tol=1e-12, stabilise=True)
    assert plain.stabilise is None
    assert np.allclose(held.probe("tip").displacement[:, -1], plain.probe("tip").displacement[:, -1], rtol=1e-9)


def test_friction_holds_a_block_on_an_incline():
    angle = 0.3
    model, pad = block(angle)
    found = wf.solve_static(model, stabilise=True)
    record = found.simulation.contact_record(pad)
    assert record.normal_force[0, -1] == pytest.approx(MASS * G * math.cos(angle), rel=1e-8)
    pull = (-MASS * G * math.sin(angle), 0, MASS * G * math.cos(angle))
    assert np.allclose(record.force[0, -1], pull, atol=1e-8 * MASS * G)


def test_what_nothing_holds_at_full_load_is_refused():
    model, _ = block(0.1, mu=0.0)
    with pytest.raises(wf.ConvergenceError, match=r"from 90 % to 100 %.*stabilising springs vanish"):
        wf.solve_static(model, stabilise=True, solver=wf.NewtonPCG(max_halvings=1))


@pytest.mark.parametrize("value", [-1.0, 0.0, float("nan"), float("inf"), "soft", (1.0,)])
def test_bad_stiffness(value):
    model, _ = block()
    with pytest.raises(wf.ModelError, match=r"stabilise = .*positive number"):
        wf.solve_static(model, stabilise=value)


def test_a_density_is_needed():
    model, _ = block(density=None)
    with pytest.raises(wf.ModelError, match="missing density of SVK, required by stabilise"):
        wf.solve_static(model, stabilise=True)
