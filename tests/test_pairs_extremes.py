"""Contact between bodies at its limits, against closed forms: deep starts, edges that glide by, friction, tipping."""

from __future__ import annotations

import math

import numpy as np
import pytest
from pairwise import covering

import warpfea as wf
from warpfea.model.contact_points import corner_points
from warpfea.model.pairs import pair_points

G, SIDE = 9.81, 0.1


def law(E: float, nu: float = 0.3) -> wf.SVK:
    return wf.SVK(E=E, nu=nu, density=1000.0)


def box(b, name, size, cells, origin, E=1e6, nu=0.3, element="T10"):
    mesh = wf.mesh.box(size, cells=cells, origin=origin, element=element)
    return b.add_solid(mesh, material=law(E, nu), name=name)


def mean_velocity(sim: wf.Simulation, body: wf.Body) -> np.ndarray:
    """Of the mass of a body of positions, m/s."""
    m = sim.model.masses.lumped[0][body.slots]
    return np.asarray(m @ sim.state.velocity.numpy()[0, body.slots] / m.sum())


# starts


def sunk(depth, overlap):
    """A block that begins so deep inside a slab that is as thick as its side."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    slab = box(b, "slab", (2 * SIDE, 2 * SIDE, SIDE), (2, 2, 1), (-SIDE, -SIDE, -SIDE), element="T4")
    block = box(b, "block", (SIDE,) * 3, (1, 1, 1), (-0.5 * SIDE, -0.5 * SIDE, -depth), element="T4")
    b.clamp(slab.nodes("z-"))
    b.add_contact(
        block.surface("z-"),
        slab.surface("z+"),
        restitution=0.3,
        stiffness=("region", 10.0),
        name="pad",
        overlap=overlap,
    )
    return wf.Simulation(b.finalize(device="cpu"), dt=1e-3), block


@pytest.mark.parametrize("depth", [1e-4, 0.01, 0.02, 0.03, 0.049])
def test_overlaps_are_refused_to_half_the_thickness(depth):
    with pytest.raises(wf.ModelError, match=rf"body 'block' begins {depth:g} m inside body 'slab'"):
        sunk(depth, "refuse")


@pytest.mark.parametrize("depth", [0.01, 0.03])
def test_deep_overlaps_decay(depth):
    """In 0.1 s, at a speed that lets the block hop then."""
    sim, block = sunk(depth, "offset")
    sim.step(100)
    assert sim.displacements(block)[0, :, 2].mean() == pytest.approx(depth, abs=5e-4)


# edges


def glide(*, gap, gravity, steps=20, cells=(1, 9), mu=0.0, named=False, element="T4", speed=1.0, dt=1e-3, **kind):
    """Change of velocity of a block that moves along a plate, all of whose faces count; most iterations."""
    b = wf.ModelBuilder(gravity=(0, 0, -gravity))
    plate = box(b, "plate", (0.3, 0.2, 0.05), (13, cells[1], 1), (-0.1, -0.1, -0.05), E=1e7, element=element)
    low = (-0.5 * SIDE, -0.5 * SIDE, gap)
    block = box(b, "block", (SIDE, SIDE, 0.5 * SIDE), (cells[0], cells[0], 1), low, E=1e7, element=element)
    b.clamp(plate.nodes("z-"))
    b.set_initial(block, velocity=(speed, 0, 0))
    faces = (block.surface("z-"), plate.surface("z+")) if named else (block, plate)
    b.add_contact(*faces, mu=mu, restitution=0.3, stiffness=("region", 10.0))
    sim = wf.Simulation(b.finalize(device="cpu", **kind), dt=dt)
    most = max(int(sim.step().newton[0]) for _ in range(steps))
    return mean_velocity(sim, block) - (speed, 0, 0), most


@pytest.mark.parametrize("gap", [0.0, 1e-6, 1e-4, 1e-3, 3e-3])
def test_a_block_over_a_finer_plate_is_not_caught_by_its_edges(gap):
    """Nothing touches: its sides do not reach below its lower face."""
    change, _ = glide(gap=gap, gravity=0.0)
    assert np.abs(change).max() < 1e-9


@pytest.mark.parametrize(("cells", "named"), covering([(1, 9), (2, 9), (2, 3)], [False, True], strength=1))
def test_a_smooth_block_glides_on_a_plate(cells, named):
    """Points of the plate that come under its front are held by its lower face: it neither stops nor sinks."""
    change, most = glide(gap=0.0, gravity=G, steps=100, cells=cells, named=named)
    assert np.abs(change).max() < 1e-4
    assert most <= 10


@pytest.mark.parametrize("kind", [{"element": "T10"}, {"dtype": "float32"}])
def test_a_smooth_block_glides_in_every_kind(kind):
    change, _ = glide(gap=0.0, gravity=G, cells=(1, 5), **kind)
    assert np.abs(change).max() < 1e-3


def test_a_fast_block_glides_over_the_end_of_a_plate():
    """20 m/s, 4 mm in a step: faces at the end look the way that it goes."""
    change, _ = glide(gap=0.0, gravity=G, cells=(3, 10), steps=40, speed=20.0, dt=2e-4)
    assert abs(change[0]) < 1e-3


def test_a_block_that_glides_is_slowed_by_friction_alone():
    """mu g t."""
    change, _ = glide(gap=0.0, gravity=G, steps=60, mu=0.3)
    assert change[0] == pytest.approx(-0.3 * G * 60e-3, rel=1e-3)
    assert np.abs(change[1:]).max() < 1e-4


@pytest.mark.parametrize("mu", [0.0, 0.5])
def test_a_block_that_glides_in_touch_without_load_goes_on(mu):
    """All forces are rounding of gaps, of which no iterate has less."""
    change, most = glide(gap=0.0, gravity=0.0, mu=mu, cells=(2, 3), steps=60, named=True)
    assert np.abs(change).max() < 1e-12
    assert most <= 10


def test_an_offset_takes_no_more_iterations():
    """With offset 0 the same block takes at most 10 iterations in a step."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    slab = box(b, "slab", (2 * SIDE, 2 * SIDE, SIDE), (2, 2, 1), (-SIDE, -SIDE, -SIDE))
    block = box(b, "block", (SIDE,) * 3, (1, 1, 1), (-0.5 * SIDE, -0.5 * SIDE, 0.01))
    b.clamp(slab.nodes("z-"))
    b.add_contact(
        block.surface("z-"), slab.surface("z+"), mu=0.5, restitution=0.3, stiffness=("region", 10.0), offset=0.01
    )
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    assert max(int(sim.step().newton[0]) for _ in range(10)) <= 20


# friction


@pytest.mark.parametrize("ratio", [0.99, 1.01])
def test_a_block_takes_its_plank_along_or_slides_on_it(ratio):
    """On a smooth floor: together at F/(m + M) up to mu m g (1 + m/M), beyond at (F - mu m g)/m and mu m g/M."""
    mu, m, M, h = 0.4, 0.5, 0.8, 1e-3
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    plank = box(b, "plank", (0.4, 0.1, 0.02), (4, 1, 1), (-0.2, -0.05, -0.02), E=1e9)
    block = box(b, "block", (SIDE, SIDE, 0.5 * SIDE), (1, 1, 1), (-0.05, -0.05, 0), E=1e7)
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), -0.02))
    b.add_contact(plank.surface("z-"), floor, restitution=0.3, stiffness=("region", 100.0))
    b.add_contact(block.surface("z-"), plank.surface("z+"), mu=mu, restitution=0.3, stiffness=("region", 100.0))
    force = ratio * mu * m * G * (1.0 + m / M)
    push = (force / (0.5 * SIDE**2), 0, 0)
    b.add_traction(block.surface("x-"), ([0, 0.05, 0.1, 9.0], [(0, 0, 0), (0, 0, 0), push, push]))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h)
    sim.step(120)
    before = [mean_velocity(sim, body)[0] for body in (block, plank)]
    sim.step(50)
    found = [(mean_velocity(sim, body)[0] - v) / (50 * h) for body, v in zip((block, plank), before)]
    together = force / (m + M)
    apart = ((force - mu * m * G) / m, mu * m * G / M)
    assert found == pytest.approx((together, together) if ratio < 1.0 else apart, rel=1e-3)


@pytest.mark.parametrize("swapped", [False, True])
def test_a_disc_on_a_disc_rubs_with_two_thirds_of_the_rim(swapped):
    """Under one pressure everywhere (nu = 0): 2/3 mu N R."""
    mu, R, p = 0.05, 0.1, 1e4
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    lower = wf.mesh.cylinder(1.3 * R, 0.03, cells=(4, 1), origin=(0, 0, -0.03))
    low = b.add_solid(lower, material=law(1e8, 0.0), name="low")
    top = b.add_solid(wf.mesh.cylinder(R, 0.03, cells=(4, 1)), material=law(1e8, 0.0), name="top")
    b.clamp(low.nodes("bottom"))
    b.add_traction(top.surface("top"), ([0, 0.02, 9], [(0, 0, 0), (0, 0, -p), (0, 0, -p)]))
    b.set_initial(top, velocity=lambda X: np.cross((0, 0, 40.0), X))
    faces = (top.surface("bottom"), low.surface("top"))
    pad = b.add_contact(*(faces[::-1] if swapped else faces), mu=mu, restitution=0.3, stiffness=("region", 10.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(50)
    record = sim.contact_record(pad)
    N = record.normal_force[0, -10:].mean()
    assert pytest.approx(p * math.pi * R**2, rel=5e-3) == N
    sign = 1.0 if swapped else -1.0
    assert record.moment[0, -10:, 2].mean() == pytest.approx(sign * 2.0 / 3.0 * mu * N * R, rel=5e-3)


@pytest.mark.parametrize("ratio", [0.98, 1.02])
def test_a_slender_block_tips_at_its_angle(ratio):
    """Width 0.1 m, height 0.2 m: beyond tan = 1/2."""
    angle = ratio * math.atan(0.5)
    b = wf.ModelBuilder(gravity=(G * math.sin(angle), 0, -G * math.cos(angle)))
    slab = box(b, "slab", (0.4, 0.2, 0.05), (3, 2, 1), (-0.2, -0.1, -0.05), E=1e8, nu=0.0)
    block = box(b, "block", (SIDE, SIDE, 2 * SIDE), (1, 1, 2), (-0.05, -0.05, 0), E=1e8, nu=0.0)
    b.clamp(slab.nodes("z-"))
    b.add_contact(block.surface("z-"), slab.surface("z+"), mu=2.0, restitution=0.2, stiffness=("region", 100.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(250)
    moved = sim.displacements(block)[0, :, 0].max()
    assert moved < 1e-3 if ratio < 1.0 else moved > 0.02


@pytest.mark.parametrize("element", ["T4", "T10", "H3843"])
def test_three_points_of_each_face_turn_outward(element):
    b = wf.ModelBuilder()
    body = box(b, "block", (0.1, 0.2, 0.3), (2, 1, 1), (0, 0, 0), element=element)
    p = pair_points(body.surface("z-"))
    a, c, d = (p.X[np.arange(len(p.X)), k] for k in corner_points(p).T)
    n = np.cross(c - a, d - a)
    assert np.einsum("fk,fk->f", n, p.normal[:, 0]) == pytest.approx(np.linalg.norm(n, axis=1))
    assert np.linalg.norm(n, axis=1).min() > 0.0
