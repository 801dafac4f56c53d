"""A refused step names the drive that jumps within it, and no other."""

import numpy as np
import pytest

import warpfea as wf

DT = 1e-3
LAW = wf.SVK(E=2e7, nu=0.3, density=1100.0)


def crank(times, angle):
    """An arm of beams that a revolute joint turns: at times (s) by 0, 0, angle, angle rad."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    line, section = [(0, 0, 0), (0.3, 0, 0)], wf.Rectangle(0.02, 0.02)
    arm = b.add_beam(line, elements=4, section=section, normal=(0, 0, 1), material=LAW, name="arm")
    drive = (times, [0.0, 0.0, angle, angle])
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, -1, 0), drive=drive, name="crank")
    return wf.Simulation(b.finalize(device="cpu"), dt=DT)


def moved(times, ways, halvings=2):
    """Two bars with driven ends: that of one is moved by `ways` (m) at times (s), that of the other stays."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((0.3, 0.02, 0.02), cells=(6, 1, 1)), material=LAW, name="bar")
    still = b.add_solid(wf.mesh.box((0.3, 0.02, 0.02), cells=(6, 1, 1)), material=LAW, name="still")
    for body, part in ((bar, 1.0), (still, 0.0)):
        b.clamp(body.nodes("x-"))
        b.drive(body.nodes("x+"), displacement=(times, [(part * way, 0.0, 0.0) for way in ways]))
    return wf.Simulation(b.finalize(device="cpu"), dt=DT, solver=wf.NewtonPCG(max_halvings=halvings))


def refusal(sim):
    with pytest.raises(wf.ConvergenceError) as caught:
        sim.step(9)
    return str(caught.value)


def test_a_joint_that_jumps_is_named():
    text = refusal(crank([0.0, 2.5 * DT, 2.500001 * DT, 1.0], 4.0))
    assert "discontinuous drive within 3.91e-06 s: joint 'crank' by 4 rad" in text


def test_an_even_turn_that_halving_resolves_is_none():
    assert "jumps" not in refusal(crank([0.0, 2.0 * DT, 3.0 * DT, 1.0], 4.0))


def test_driven_nodes_that_jump_are_named_and_those_that_stay_are_not():
    text = refusal(moved([0.0, 2.5 * DT, 2.500001 * DT, 1.0], [0.0, 0.0, -0.6, -0.6]))
    assert "discontinuous drive within 0.00025 s: the drive of body 'bar' by 0.6 m: use a ramp" in text
    assert "'still'" not in text


def test_a_travel_as_fast_as_before_is_no_jump():
    """The end goes by more than an element in each step: out, and back until that is refused."""
    text = refusal(moved([0.0, 3.0 * DT, 9.0 * DT], [0.0, 0.24, -0.24], halvings=0))
    assert not text.startswith("step from t = 0 s")
    assert "jumps" not in text


def test_looking_for_jumps_leaves_the_values_of_the_step():
    sim = crank([0.0, DT, 5.0 * DT, 1.0], 0.2)
    sim.step(2)
    work = sim.stepper.work
    arrays = (work.step.new_time, work.step.load_factor, work.time_law_values)
    before = [array.numpy().copy() for array in arrays]
    np.testing.assert_allclose(sim.stepper.law_values(3.0 * DT)[0, 0, 0], 0.1, rtol=1e-12)
    for array, values in zip(arrays, before):
        np.testing.assert_array_equal(array.numpy(), values)
