"""Scenes of contact: they run without a refused step, and do what mechanics says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scene_runs import run_contact_scene
from scipy.integrate import solve_ivp

import warpfea as wf

G = 9.81


def simulate(name, t_end=None, **parameters):
    """A scene that was run, and times (steps,) and path (steps, 3) of its first probe."""
    sim = run_contact_scene(name, t_end, work="collider_work", **parameters)
    probe = sim.probe(sim.model.description.probes[0].name)
    return sim, np.asarray(probe.time), probe.position[0]


def contact_forces(sim):
    """(3,) N on the bodies, elastic."""
    (term,) = (term for term in sim.model.terms.all if term.name == "contact")
    return term.at_points(sim.state)[1][0].sum(axis=0)


@pytest.mark.parametrize("mu", [0.2, 0.3])
def test_block_slips_where_the_tangent_of_the_tables_angle_is_mu(mu):
    rate = math.radians(10.0)
    sim, time, path = simulate("tilting_table", mu=mu, t_end=math.atan(mu) / rate + 0.6)
    angle = rate * time
    along = path[:, 0] * np.cos(angle) - path[:, 2] * np.sin(angle)
    start = math.atan(mu) / rate
    stuck = time < start - 0.02
    assert np.ptp(along[stuck & (time > 0.5)]) < 1e-4

    def rigid(t, y):  # a point at height `height` over a plane that turns at a constant rate
        height = 0.025
        normal = G * math.cos(rate * t) - 2.0 * rate * y[1] - height * rate**2
        return y[1], G * math.sin(rate * t) + rate**2 * y[0] - mu * normal

    found = solve_ivp(rigid, (start, time[-1]), (along[stuck][-1], 0.0), rtol=1e-9, atol=1e-12)
    slid = found.y[0, -1] - found.y[0, 0]
    assert slid > 0.03
    assert along[-1] - along[stuck][-1] == pytest.approx(slid, rel=0.02)


@pytest.mark.parametrize("restitution", [0.5, 0.8])
def test_ball_comes_up_to_the_square_of_its_restitution(restitution):
    sim, _, path = simulate(
        "bouncing_ball", cells=2, restitution=restitution, t_end=0.45 if restitution > 0.6 else 0.36
    )
    height = path[:, 2] - 0.05
    low = int(np.argmin(height))
    assert height[low:].max() == pytest.approx(restitution**2 * 0.2, rel=0.03)
    assert 0.0 > height[low] > -0.01
    assert np.abs(path[:, :2]).max() < 1e-4


def test_gripper_lifts_the_block_and_holds_it():
    sim, _, path = simulate("gripper")
    lifted = path[-1, 2] - path[0, 2]
    assert 0.08 - 2e-3 < lifted < 0.08
    assert np.ptp(path[-20:, 2]) < 1e-5  # held: no creep
    assert np.abs(path[-1, :2]).max() < 1e-4
    block = sim.model.bodies[0]
    assert sim.positions(block)[0, :, 2].min() > 0.05
    assert contact_forces(sim)[2] == pytest.approx(1000.0 * 0.06**3 * G, rel=0.02)


def test_slippery_jaws_leave_the_block_on_the_floor():
    sim, _, path = simulate("gripper", mu=0.02)
    assert path[-1, 2] - path[0, 2] < 0.01


def test_beam_rests_on_the_cylinders_as_a_beam_on_two_supports():
    sim, _, path = simulate("beam_over_cylinders")
    load, rigidity = 1000.0 * 0.02**2 * G, 4e6 * 0.02**4 / 12.0
    span, over = 0.3, 0.15
    middle = load * span**2 * (24.0 * over**2 - 5.0 * span**2) / (384.0 * rigidity)
    end = load * over * (3.0 * over**3 + 6.0 * over**2 * span - span**3) / (24.0 * rigidity)
    sag = path[-1, 2] - sim.probe("end").position[0, -1, 2]
    assert sag == pytest.approx(middle + end, rel=0.04)
    assert contact_forces(sim)[2] == pytest.approx(load * 0.6, rel=0.02)
    assert abs(path[-1, 0]) < 1e-6


def test_block_lags_behind_the_belt_by_the_way_that_friction_needs():
    sim, time, path = simulate("belt")
    speed, mu = 0.6, 0.3
    lag = speed * (time[-1] - 0.1) - (path[-1, 0] - path[0, 0])
    assert lag == pytest.approx(speed**2 / (2.0 * mu * G), rel=0.02)
    mass = 1000.0 * 0.1 * 0.1 * 0.05
    e = sim.energies()
    assert e["kinetic"][0] == pytest.approx(0.5 * mass * speed**2, rel=1e-3)
    assert e["friction"][0] == pytest.approx(0.5 * mass * speed**2, rel=0.02)
    assert e["collider_work"][0] == pytest.approx(mass * speed**2, rel=0.01)


@pytest.mark.slow
def test_block_keeps_its_speed_over_bricks():
    """Side faces at the joints took two thirds of it once, and threw the block up."""
    sim, time, path = simulate("brick_floor")
    body, record = sim.model.bodies[0], sim.contact_record("on brick 18")
    assert record.normal_force.max() > 0.0  # passed over all but the last
    mass = sim.model.masses.lumped[0][body.slots]
    momentum = mass @ sim.state.velocity.numpy()[0, body.slots]
    assert momentum[0] == pytest.approx(1.5 * mass.sum(), rel=1e-6)
    speed = [sim.probe(side).velocity[0] for side in ("x-", "x+")]
    assert np.abs(0.5 * (speed[0] + speed[1])[:, 0] - 1.5).max() < 5e-6
    assert np.abs(speed[1] - speed[0])[:, 2].max() < 0.02 * 0.06  # spin, rad/s
    assert np.ptp(path[5:, 2]) < 2e-5
    assert path[-1, 0] - path[0, 0] == pytest.approx(1.5 * (time[-1] - time[0]), rel=1e-5)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("stretch", [0.0, 0.2])
def test_a_body_in_flight_takes_no_more_iterations_for_a_floor_below(dtype, stretch):
    """Stretched at the start it vibrates; in float32 its residual then stays at its rounding."""
    taken = []
    center = np.array((0.0, 0.0, 0.25))
    for contact in (False, True):
        b = wf.ModelBuilder()
        mesh = wf.mesh.sphere(0.05, cells=2, center=center)
        ball = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1100.0))
        b.set_initial(ball, velocity=lambda X: stretch * (X - center) + (0.0, 0.0, 1.5))
        if contact:
            b.add_contact(ball, b.add_collider(wf.HalfSpace((0, 0, 1))), model="sphere", radius=0.05, mu=0.3)
        sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=5e-4, integrator="bdf2")
        taken.append(sum(int(sim.step().newton[0]) for _ in range(40)))
    assert taken[1] <= taken[0] + 10


def test_a_sheet_overhangs_a_table():
    """0.24285 q a^4/(E I) of small deflections; 16 % more where the nearest points carry it."""
    sim = run_contact_scene("overhang")
    reach, t, E, density = 0.55, 1e-2, 8e8, 1200.0
    right = 0.24285 * density * 9.81 * reach**4 * 12.0 / (E * t**2)
    tip = -sim.probe("tip").displacement[0, -1, 2]
    assert tip == pytest.approx(right, rel=0.02)
    assert sim.contact_force("lie")[0, 2] == pytest.approx(density * 9.81 * t * 0.2 * 1.4, rel=0.02)
