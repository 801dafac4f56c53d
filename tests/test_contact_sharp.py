"""Needles, scissors and interlocked loops."""

import math

import numpy as np
import pytest

import warpfea as wf
from scenes.links import link_mesh


@pytest.mark.slow
@pytest.mark.parametrize("radius", [2e-4, 1e-3])
def test_a_needle_lifts_a_plate(radius):
    """Of 1/500 or 1/100 of a facet; it passes at none of two places, and the plate takes up its impulse."""
    for place in ((0.058, 0.044), (0.1, 0.1)):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        mesh = wf.mesh.box((0.2, 0.2, 0.02), cells=(2, 2, 1), element="T10")
        plate = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1000.0), name="plate")
        path = ([0, 1], [(0, 0, 0), (0, 0, 0.5)])
        needle = b.add_collider(wf.Cylinder((*place, -0.1), (*place, -1e-3), radius), path=path)
        pad = b.add_contact(plate.surface("z-"), needle)
        model = b.finalize(device="cpu")
        sim = wf.Simulation(model, dt=2e-3, solver=wf.NewtonPCG(tol=1e-9))
        sim.step(15)
        up = np.zeros((model.slots, 3))
        up[plate.slots[plate.slot_kind == 0], 2] = 1.0
        gained = (model.mass_matrix() @ up.ravel()) @ sim.state.velocity.numpy()[0].ravel()
        impulse = 2e-3 * sim.contact_record(pad).force[0, :, 2].sum()
        assert gained == pytest.approx(impulse, rel=1e-6)
        x = sim.positions(plate)[0]
        a, *slopes = np.linalg.lstsq(np.column_stack([np.ones(len(x)), x[:, :2]]), x[:, 2], rcond=None)[0]
        assert a + slopes @ np.array(place) - 0.01 > 0.5 * 0.03 - 1e-3 - 2e-3


def test_scissors_push_a_ball_out():
    """Blades that close at 1 rad/s from 2 x 0.4 rad: a ball between them is r/sin(angle) from the hinge."""
    r, half, speed = 0.01, 0.4, 1.0
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    ball = b.add_rigid(wf.Sphere((r / math.sin(half) + 1e-5, 0, 0), r), density=1000.0, name="ball")
    b.set_initial(ball, velocity=(speed * r * math.cos(half) / math.sin(half) ** 2, 0, 0))
    for sign, z in ((1.0, 0.001), (-1.0, -0.001)):
        along = np.array((math.cos(half), sign * math.sin(half), 0.0))
        up = np.array((-math.sin(half), sign * math.cos(half), 0.0))
        center = 0.1 * along + (0.005 * sign) * up * sign + (0.0, 0.0, z)
        blade = wf.Box(center, (0.2, 0.01, 0.002), axes=[along, sign * up, (0, 0, 1)])
        turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 0, 1), angle=([0, 1], [0, -sign * speed]))
        b.add_contact(ball, b.add_collider(blade, path=turn), name=f"blade {z}")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    for angle in (0.3, 0.2):
        sim.step(50)
        x, y, z = sim.pose(ball)[0][0]
        assert x == pytest.approx(r / math.sin(angle), rel=1e-2)  # 0.036 and 0.048 without the blades
        assert abs(y) < 1e-5
        assert abs(z) < 1e-9


def sections(mesh, loop, sim):
    """Centres (n, 3) of the sections of a loop, in order: means of the nodes near each place of its axis."""
    x, X = sim.positions(loop)[0], mesh.points
    angle = np.arctan2(X[:, 2], X[:, 0])
    part = np.floor((angle + math.pi) / (2.0 * math.pi) * 24 - 1e-9).astype(int)
    return np.array([x[part == k].mean(axis=0) for k in np.unique(part)])


def linking_number(first, second):
    """Gauss's sum over two closed polygons (n, 3)."""
    total = 0.0
    for a, a_next in zip(first, np.roll(first, -1, axis=0)):
        p, q = a - second, a_next - second
        p_next, q_next = np.roll(p, -1, axis=0), np.roll(q, -1, axis=0)
        for quad in zip(p, q, q_next, p_next):
            n = [np.cross(quad[k], quad[(k + 1) % 4]) for k in range(4)]
            n = [x / np.linalg.norm(x) for x in n]
            sign = np.sign(np.dot(np.cross(quad[0] - quad[3], quad[1] - quad[0]), quad[0]))
            total += sign * sum(math.asin(np.clip(n[k] @ n[(k + 1) % 4], -1, 1)) for k in range(4))
    return total / (4.0 * math.pi)


@pytest.mark.parametrize("way", [(0.6, 0, -0.8), pytest.param((0.0, 0.8, 0.6), marks=pytest.mark.slow)])
def test_interlocked_loops_stay_linked(way):
    """One of 1e7 Pa thrown at 3 m/s off another one whose end is held: the number of times they link stays one."""
    length, width, wire, around = 0.06, 0.032, 0.005, 4
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = link_mesh(length, width, wire, 2, around)
    material = wf.SVK(E=1e7, nu=0.3, density=1200.0)
    turned = np.array([(0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)])
    places = {"held": (np.eye(3), np.zeros(3)), "thrown": (turned, np.array((0.0, 0.0, 2.2 * wire - length)))}
    loops = [b.add_solid(mesh, material=material, transform=at, name=name) for name, at in places.items()]
    b.clamp(loops[0].nodes(lambda X: X[:, 2] > 0.5 * (length - width) - 1e-9))
    b.set_initial(loops[1], velocity=tuple(3.0 * np.array(way)))
    b.add_contact(*loops, name="link")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    axis = [sections(mesh, loop, sim) for loop in loops]
    assert abs(linking_number(*axis)) == pytest.approx(1.0, abs=1e-9)
    sim.step(40)
    axis = [sections(mesh, loop, sim) for loop in loops]
    assert abs(linking_number(*axis)) == pytest.approx(1.0, abs=1e-9)
    assert sim.contact_record("link").normal_force.max() > 1.0
    assert np.linalg.norm(axis[1].mean(axis=0) - axis[0].mean(axis=0)) < length
