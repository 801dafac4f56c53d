"""Scenes of contact between bodies: they run without a refused step, and do what mechanics says."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
from scene_runs import run_contact_scene

import warpfea as wf

G = 9.81


def test_every_joint_of_a_stack_carries_what_is_above_it():
    sim = run_contact_scene("block_stack")
    blocks, weight = 4, 1000.0 * 0.1**3 * G
    for k in range(blocks):
        force = sim.contact_record(f"joint {k + 1}").force[0]
        assert force[-20:, 2].mean() == pytest.approx((blocks - k) * weight, rel=5e-3)
        assert np.abs(force[-1, :2]).max() < 2e-3 * force[-1, 2]
    top = sim.probe("top").displacement[0]
    assert np.abs(top[-1, :2]).max() < 1e-5
    assert np.ptp(top[-20:, 2]) < 1e-5


def test_ball_bends_the_plate_and_comes_up_again():
    sim = run_contact_scene("ball_on_plate", t_end=0.24)
    ball, plate = (sim.probe(name).displacement[0] for name in ("ball", "plate"))
    drop = 0.03
    low = int(np.argmin(ball[:, 2]))
    assert -drop - 0.03 < ball[low, 2] < -drop - 0.005
    assert plate[:, 2].min() < -2e-3
    assert 0.2 * drop < ball[low:, 2].max() - (-drop) < drop  # of its height something, and no more than that
    record = sim.contact_record("impact")
    assert (record.normal_force[0] >= 0.0).all()
    # the impulse of the plate turns the ball round
    impulse = 2e-3 * (record.force[0] @ np.array((0, 0, 1))).cumsum()
    slots = sim.model.bodies[1].slots
    mass = sim.model.masses.lumped[0][slots].sum()
    momentum = sim.model.masses.lumped[0][slots] @ sim.state.velocity.numpy()[0, slots]
    assert momentum[2] == pytest.approx(impulse[-1] - mass * G * 0.24, abs=1e-4)


def test_arch_stands_with_enough_friction():
    sim = run_contact_scene("arch")
    weight = 0.5 * sim.model.mass * G
    feet = [sim.contact_record(name).force[0, -1] for name in ("left foot", "right foot")]
    for foot in feet:
        assert foot[2] == pytest.approx(weight, rel=2e-3)
    assert feet[0][0] == pytest.approx(-feet[1][0], rel=1e-3)
    assert 0.1 < feet[0][0] / feet[0][2] < 0.6  # the thrust stays within the friction
    assert abs(sim.probe("crown").displacement[0, -1, 2]) < 3e-3
    assert np.abs(sim.probe("crown").velocity[0, -1]).max() < 1e-3


@pytest.mark.slow
def test_arch_falls_with_too_little_friction():
    sim = run_contact_scene("arch", t_end=0.8, mu=0.25)
    assert sim.probe("crown").displacement[0, -1, 2] < -0.2


@pytest.mark.slow
def test_driver_turns_the_wheel_the_other_way():
    sim = run_contact_scene("gears")
    turned = [sim.joint_value(f"{name} axle")[0] for name in ("driver", "wheel")]
    assert turned[0] == pytest.approx(8.0 * (0.3 - 0.05), rel=1e-3)
    # the wheel may run ahead or lag by the play of its teeth, less than half of their pitch
    assert turned[1] == pytest.approx(-turned[0], abs=math.pi / 6)
    assert sim.contact_record("mesh").normal_force.max() > 10.0


@pytest.mark.slow
def test_finger_pushes_the_beam_off_the_shell():
    sim = run_contact_scene("finger_beam_shell")
    probe, table, push = sim.probe("beam"), sim.contact_record("table"), sim.contact_record("push")
    beam, weight = probe.displacement[0], 1000.0 * 0.02**2 * 0.12 * G
    resting = (probe.time > 0.05) & (probe.time < 0.13)
    assert table.force[0, resting, 2].mean() == pytest.approx(weight, rel=0.05)
    pushed = push.normal_force[0] > 0.0
    assert pushed.sum() > 20
    assert push.force[0, pushed, 0].max() <= 0.0  # on the finger
    assert sim.probe("fingertip").displacement[0, :, 0].max() < 0.08
    slides = (probe.time > 0.16) & (probe.time < 0.24)
    assert -table.force[0, slides, 0] == pytest.approx(0.3 * table.normal_force[0, slides], rel=0.15)
    assert beam[-1, 0] > 0.05 - 0.02 + 0.01  # past the edge, and it falls freely
    assert table.normal_force[0, -10:].max() == push.normal_force[0, -10:].max() == 0.0
    assert (probe.velocity[0, -1, 2] - probe.velocity[0, -11, 2]) / 0.04 == pytest.approx(-G, rel=0.02)


@pytest.mark.slow
def test_every_link_of_a_chain_bears_the_weight_below_it():
    sim = run_contact_scene("links")
    slots = [body.slots for body in sim.model.bodies]
    weights = G * np.array([sim.model.masses.lumped[0][s].sum() for s in slots])
    for k in range(1, 10):
        force = sim.contact_record(f"joint {k}").force[0, -1]  # on the upper link
        assert -force[2] == pytest.approx(weights[k:].sum(), rel=1e-3)
        assert np.abs(force[:2]).max() < 1e-3 * -force[2]
    assert weights.sum() == pytest.approx(G * sim.model.mass, rel=1e-9)


@pytest.mark.slow
def test_layers_of_crossed_beams_bear_what_is_above_them():
    sim = run_contact_scene("crossed_beams")
    records = {c.name: sim.contact_record(c.name) for c in sim.model.description.contacts}
    beam, block = 0.3 * 0.02**2 * 1200.0 * G, 0.14**2 * 0.035 * 1200.0 * G
    for layer, above in (("load", block), ("crossing 2", block + 3 * beam), ("crossing 1", block + 6 * beam)):
        force = sum(record.force[0, -5:].mean(axis=0) for name, record in records.items() if name.startswith(layer))
        assert force[2] == pytest.approx(above, rel=5e-3)
        assert np.abs(force[:2]).max() < 5e-3 * above
    for record in records.values():
        assert record.penetration[0, -1] < 1e-2 * 0.02
    assert -0.03 < sim.probe("block").displacement[0, -1, 2] < -0.002


def test_teeth_of_a_comb_share_the_weight_of_a_bar():
    sim = run_contact_scene("comb")
    share = 0.2 * 0.02**2 * 1200.0 * G / 5
    EI, own, reach, length = 5e7 * 0.01**4 / 12.0, 0.01**2 * 1200.0 * G, 0.12, 0.15
    wanted = share * reach**2 * (3.0 * length - reach) / (6.0 * EI) + own * length**4 / (8.0 * EI)
    for k in range(1, 6):
        force = sim.contact_record(f"on tooth {k}").force[0, -5:].mean(axis=0)
        assert force[2] == pytest.approx(share, rel=5e-3)
        assert np.abs(force[:2]).max() < 5e-3 * share
        assert -sim.probe(f"tip {k}").displacement[0, -1, 2] == pytest.approx(wanted, rel=0.015)


@pytest.mark.slow
def test_a_peg_in_a_hole_follows_coulombs_wedge():
    """sin a + mu cos a on the way in, sin a - mu cos a on the way out; stuck between."""
    sim = run_contact_scene("peg_in_hole", work="work")
    records = [sim.contact_record(contact.name) for contact in sim.model.description.contacts]
    time, normal = records[0].time, sum(record.normal_force[0] for record in records)
    axial = sum(record.force[0, :, 2] for record in records)
    a, mu = np.arctan(0.1), 0.2
    inward = (time > 0.15) & (time < 0.36)
    assert normal[inward].min() > 100.0
    assert axial[inward] / normal[inward] == pytest.approx(np.sin(a) + mu * np.cos(a), rel=5e-3)
    outward = (time > 0.56) & (time < 0.65)
    assert axial[outward] / normal[outward] == pytest.approx(np.sin(a) - mu * np.cos(a), rel=5e-3)
    stuck = np.argmin(np.abs(time - 0.47))
    assert min(record.stick[0, stuck] for record in records) > 0.5
    assert max(record.penetration.max() for record in records) < 0.01 * 0.02


def test_first_touches_with_friction_take_few_iterations():
    """Two wedged points of a link that falls into another one stick; with the slip before they touched as friction's
    they would slide, and steps take up to 139 iterations; with its part updated to the end 51."""
    model = importlib.import_module("warpfea.scenes.links").links(count=5, mu=0.2).finalize()
    sim = wf.Simulation(model, dt=4e-3, solver=wf.NewtonPCG(tol=1e-6))
    reports = [sim.step() for _ in range(6)]
    assert max(int(r.newton[0]) for r in reports) <= 20
    assert not any(r.halvings.any() for r in reports)


def test_slip_that_ends_takes_few_iterations():
    """The arch settles: with the derivative of friction alone as its tangent, 20 steps take 147 iterations."""
    model = importlib.import_module("warpfea.scenes.arch").arch().finalize()
    sim = wf.Simulation(model, dt=1e-2, solver=wf.NewtonPCG(tol=1e-6))
    assert sum(int(sim.step().newton[0]) for _ in range(20)) <= 125


@pytest.mark.slow
def test_a_small_pile_comes_to_rest():
    """One body of each of three families on each other; thirty: `contact_speed_h200.json`."""
    sim = run_contact_scene("pile", t_end=1.5, count=3, across=1)
    e = sim.energies()
    assert e["kinetic"][0] < -1e-5 * e["potential"][0]
    assert float(sim.last.penetration.max()) < 0.02
