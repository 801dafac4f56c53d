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


def rolled(h, t_end):
    """Speeds of the centre and of the rim over 5/7 g sin(a) t, and the depth over the radius, of a ball on a slope."""
    b = wf.ModelBuilder(gravity=(GRAVITY * np.sin(SLOPE), 0, -GRAVITY * np.cos(SLOPE)))
    ball = b.add_rigid(wf.Sphere((0, 0, RADIUS), RADIUS), density=1000.0)
    contact = b.add_contact(ball, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.5)
    assert (contact.model, contact.radius) == ("sphere", RADIUS)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="bdf2")
    sim.run(t_end)
    exact = 5 / 7 * GRAVITY * np.sin(SLOPE) * t_end
    record = sim.contact_record(contact)
    assert record.slip[0, -50:].max() == 0.0
    speed = ball.affine[0] @ sim.state.velocity.numpy()[0, ball.slots, 0]
    return speed / exact, sim.angular_velocity(ball)[0, 1] * RADIUS / exact, record.penetration[0, -1] / RADIUS


def test_ball_rolls():
    speed, rim, _ = rolled(4e-3, 0.4)
    assert speed == pytest.approx(1.0, abs=1e-2)
    assert rim == pytest.approx(1.0, abs=1e-2)


@pytest.mark.slow
def test_speed_of_a_ball_down_a_slope():
    """After 1 s; the sunk ball rolls on a radius R - d, and is slower by 4/7 d/R."""
    speed, rim, depth = rolled(1e-3, 1.0)
    assert abs(speed - 1.0) < 0.6 * depth
    assert abs(rim - 1.0) < 0.6 * depth
