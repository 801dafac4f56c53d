"""Rigid parts of round shapes touch by their true surface, not by the facets that are drawn."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.elements.quadrature import conical_triangle
from warpfea.model.assembly import facet_area_vectors, facet_positions, facet_tables
from warpfea.model.handles import SurfaceSet
from warpfea.model.pairs import master_facets

RADIUS, SLOPE, GRAVITY = 0.1, np.radians(20.0), 9.81


@pytest.mark.parametrize(
    "shape",
    [wf.Sphere((1, 2, 3), 0.5), wf.Capsule((0, 0, 0), (1, 1, 0), 0.3), wf.Cylinder((0, 0, 0), (0, 1, 1), 0.4)],
    ids=lambda shape: type(shape).__name__,
)
def test_facets_lie_on_the_shape(shape):
    """Cubics within 1e-4 of the radius, closed, and the facets of contact are the same."""
    part = wf.ModelBuilder().add_rigid(shape, density=1.0)
    surface = SurfaceSet(part, part.boundary)
    tables = facet_tables(surface, rules={0: conical_triangle(4)})
    X = facet_positions(part, tables)
    center, axes = shape.frame()
    radius, half, _ = shape.sizes
    local = (X - center) @ axes
    across, z = np.linalg.norm(local[..., :2], axis=2), local[..., 2]
    if isinstance(shape, wf.Cylinder):
        off = np.maximum(across - radius, np.abs(z) - half)
    else:
        off = np.hypot(across, z - np.clip(z, -half, half)) - radius
    assert np.abs(off).max() < 1e-4 * radius
    volume = np.einsum("fqk,fqk,fq->", X - part.com, facet_area_vectors(part, tables), tables.weights) / 3
    assert volume == pytest.approx(part.moments[0, 0], rel=1e-4)
    assert master_facets(surface).degree == 3


def rolled(h, t_end, shape=None, scheme="bdf2"):
    """Speeds of the centre and of the rim over the share of g sin(a) t that rolling leaves, 5/7 of a ball, and the
    depth over the radius, of a part on a slope."""
    shape = shape or wf.Sphere((0, 0, RADIUS), RADIUS)
    b = wf.ModelBuilder(gravity=(GRAVITY * np.sin(SLOPE), 0, -GRAVITY * np.cos(SLOPE)))
    part = b.add_rigid(shape, density=1000.0)
    contact = b.add_contact(part, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.5)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator=scheme)
    speeds = np.zeros((2, 2))
    for k in range(2):
        sim.run((k + 1) * t_end / 2)
        speeds[k, 0] = part.affine[0] @ sim.state.velocity.numpy()[0, part.slots, 0]
        speeds[k, 1] = sim.angular_velocity(part)[0, 1] * RADIUS
    exact = GRAVITY * np.sin(SLOPE) * t_end / (1.0 + part.inertia[1, 1] / (part.mass * RADIUS**2))
    record = sim.contact_record(contact)
    assert record.slip[0, -50:].max() == 0.0
    return speeds / exact, record.penetration[0, -1] / RADIUS, sim


def test_ball_rolls():
    speeds, _, _ = rolled(4e-3, 0.4)
    assert speeds[1] == pytest.approx([1.0, 1.0], abs=1e-2)


@pytest.mark.slow
def test_speed_of_a_ball_down_a_slope():
    """After 1 s; the sunk ball rolls on a radius R - d, and is slower by 4/7 d/R."""
    speeds, depth, _ = rolled(1e-3, 1.0)
    assert np.abs(speeds[1] - 1.0).max() < 0.6 * depth


ROLLERS = {kind: kind((0, -0.2, RADIUS), (0, 0.2, RADIUS), RADIUS) for kind in (wf.Cylinder, wf.Capsule)}


@pytest.mark.parametrize(
    ("kind", "scheme", "error"),
    [(wf.Cylinder, "bdf2", 5e-5), (wf.Cylinder, "energy_momentum", 5e-6), (wf.Capsule, "energy_momentum", 5e-6)],
)
def test_cylinders_and_capsules_roll(kind, scheme, error):
    """The gain of speed in the second half: the landing costs a part of a step. Nothing slips, and the nodal forces of
    the contact at the end are the weight and what keeps the rolling, at the bottom."""
    speeds, depth, sim = rolled(2e-3, 0.2, ROLLERS[kind], scheme)
    assert depth < 1e-6
    assert speeds[1] - speeds[0] == pytest.approx([0.5, 0.5], abs=error)
    assert abs(sim.energies()["integrator"][0]) < 40 * error * sim.energies()["kinetic"][0]
    part = sim.model.bodies[0]
    force = sim.model.contact_force(sim.state)[0, part.slots]
    x = part.reference + part.origin + sim.state.displacement.numpy()[0, part.slots]
    center = part.affine[0] @ x
    weight, inertia = part.mass * GRAVITY, part.inertia[1, 1] / RADIUS**2
    held = inertia / (part.mass + inertia) * np.sin(SLOPE)
    assert force.sum(axis=0) == pytest.approx(
        weight * np.array([-held, 0, np.cos(SLOPE)]), abs=(1e-3 if scheme == "bdf2" else 3e-3) * weight
    )
    moment = np.cross(x - center, force).sum(axis=0)
    assert moment == pytest.approx([0, -RADIUS * force.sum(axis=0)[0], 0], abs=1e-6 * weight)


def test_a_tilted_cylinder_comes_to_lie_on_its_end():
    """It turns flat from its rim: the point of the rim passes to the centre of the end."""
    tilt = 0.3
    axis = np.array([np.sin(tilt), 0, np.cos(tilt)])
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Cylinder(0 * axis, 0.1 * axis, 0.1), density=1000.0)
    b.add_contact(part, b.add_collider(wf.HalfSpace((0, 0, 1), -0.1 * np.sin(tilt) - 0.01)), mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=4e-3, integrator="bdf2")
    sim.run(0.4)
    assert sim.pose(part)[0][0, 2] == pytest.approx(0.04 - 0.1 * np.sin(tilt), abs=1e-6)
    assert np.abs(sim.velocities(part)).max() < 1e-5


def thrown(worlds=1, dtype="float64", device="cpu"):
    """A cylinder that slides, and then rolls."""
    b = wf.ModelBuilder()
    part = b.add_rigid(ROLLERS[wf.Cylinder], density=1000.0, name="part")
    b.add_contact(part, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3, name="floor")
    b.set_initial(part, velocity=(0.5, 0.1, 0))
    return b.finalize(device=device, worlds=worlds, dtype=dtype), part


def test_rolling_worlds_are_equal_to_lone_runs_and_checkpoints_go_on(tmp_path):
    mu, (model, part) = [0.3, 0.05], thrown(2)
    model.set_parameter("floor.mu", mu)
    sim = wf.Simulation(model, dt=2e-3)
    sim.run(0.04, outputs=[wf.Checkpoint(tmp_path / "c.npz", every=10)])
    sim.step(10)
    for world in range(2):
        alone, _ = thrown()
        alone.set_parameter("floor.mu", mu[world])
        one = wf.Simulation(alone, dt=2e-3)
        one.step(30)
        np.testing.assert_array_equal(one.state.displacement.numpy()[0], sim.state.displacement.numpy()[world])
    again = wf.Simulation(model, dt=2e-3)
    again.resume(tmp_path / "c.npz")
    again.step(10)
    np.testing.assert_array_equal(again.positions(part), sim.positions(part))


@pytest.mark.parametrize(
    ("device", "dtype"),
    [("cpu", "float32"), *(pytest.param("cuda", x, marks=pytest.mark.cuda) for x in ("float64", "float32"))],
)
def test_devices_and_precisions_agree(device, dtype):
    ends = []
    for where, precision in (("cpu", "float64"), (device, dtype)):
        model, part = thrown(dtype=precision, device=where)
        sim = wf.Simulation(model, dt=2e-3)
        sim.step(60)
        ends.append(sim.positions(part))
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-8 if dtype == "float64" else 1e-4)


@pytest.mark.parametrize("name", ["cylinder", "box"])
def test_a_body_lies_on_a_part_as_on_a_collider(name):
    """A soft block that is pressed on a held part: force and sinking are those on an obstacle of the same shape, and
    the forces on both sides cancel, with their moments."""
    shape = {
        "cylinder": wf.Cylinder((0, -0.2, -0.3), (0, 0.2, -0.3), 0.3),
        "box": wf.Box((0, 0, -0.1), (0.3, 0.4, 0.2)),
    }
    found = []
    for moves in (True, False):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        mesh = wf.mesh.box((0.1, 0.1, 0.05), cells=(4, 2, 2), origin=(-0.05, -0.05, 0.0))
        block = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
        b.drive(block.nodes("z+"), displacement=([0, 1], [(0, 0, 0), (0, 0, -2e-3)]))
        if moves:
            other = b.add_rigid(shape[name], density=1000.0)
            b.clamp(other.nodes(lambda X: X[:, 0] > -1.0))
        else:
            other = b.add_collider(shape[name])
        b.add_contact(block.surface("z-"), other, mu=0.3)
        model = b.finalize(device="cpu")
        r = wf.solve_static(model, load_steps=2)
        force = model.contact_force(r.state)[0]
        found.append(force[block.slots].sum(axis=0))
        if moves:
            x = np.concatenate([body.reference + body.origin for body in (block, other)])
            x += r.state.displacement.numpy()[0]
            assert np.abs(force.sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
            assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-12 * np.abs(force).sum()
    assert found[0] == pytest.approx(found[1], rel=5e-3, abs=1e-3 * found[1][2])
