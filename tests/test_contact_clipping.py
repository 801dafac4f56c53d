"""Edges of obstacles and bodies within the facets that lie on them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from contact_runs import DEVICES

import warpfea as wf

E, RHO, G, THICK = 1e9, 1000.0, 9.81, 0.05


def table(b: wf.ModelBuilder, kind: str) -> Any:
    """A table whose edge is at x = 0 and top at z = 0."""
    if kind == "box":
        return b.add_collider(wf.Box((-5.0, 0.0, -0.5), (10.0, 2.0, 1.0)), name="table")
    if kind == "mesh":
        return b.add_collider(wf.TriMesh(*wf.Box((-5.0, 0.0, -0.5), (10.0, 2.0, 1.0)).mesh()), name="table")
    element, side = {"T4": ("T4", 0.5), "T10": ("T10", 0.5)}[kind]
    size = (5.0, 1.0, 0.2)
    mesh = wf.mesh.box(size, cells=(round(5 / side), round(1 / side), 1), element=element, origin=(-5.0, -0.5, -0.2))
    body = b.add_solid(mesh, material=wf.SVK(E=100 * E, nu=0.0, density=RHO), name="table")
    b.clamp(body.nodes(lambda X: X[:, 0] > -1e9))
    return body


def overhang(kind: str, on: str, place: float, *, reach: int = 5, side: float = 0.2, gravity: float = 0.01 * G,
             dtype: str = "float64", device: str = "cpu", **options: Any) -> tuple[Any, float, float]:  # fmt: skip
    """Result of a strip on a table of which an edge lies at `place` of a facet, tip over beam theory, and weight, N.

    A strip over an edge by a lifts off behind it; its tip sinks by 0.24285 q a^4/(E I): zero deflection, slope and
    moment where it lies again.
    """
    n = 6 * reach
    tip = (reach - 1 + place) * side
    b = wf.ModelBuilder(gravity=(0, 0, -gravity))
    material = wf.SVK(E=E, nu=0.0, density=RHO)
    if kind == "beam":
        line = [(tip - n * side, 0.0, 0.5 * THICK), (tip, 0.0, 0.5 * THICK)]
        section = wf.Rectangle(THICK, THICK)
        strip = b.add_beam(line, elements=n, section=section, normal=(0, 0, 1), material=material)
        lower, start, end, width = strip.surface("normal-"), strip.start, strip.end, THICK
    else:
        mesh = wf.mesh.grid((n * side, side), cells=(n, 1), origin=(tip - n * side, 0.0, 0.5 * THICK))
        strip = b.add_shell(mesh, thickness=THICK, material=material)
        lower, start, end, width = strip.surface("bottom"), strip.edge("x-"), strip.edge("x+"), side
    b.clamp(start, slots="position", components="xy")
    b.clamp(end, slots="position", components="y")
    b.add_contact(lower, table(b, on), name="lie", **options)
    b.add_probe("tip", end)
    model = b.finalize(device=device, dtype=dtype)
    result = wf.solve_static(model, load_steps=1, stabilise=True, **({"tol": 1e-8} if dtype == "float64" else {}))
    q, EI = RHO * gravity * width * THICK, E * width * THICK**3 / 12.0
    fall = -float(result.probe("tip").displacement[0, -1, 2])
    return result, fall / (0.24285 * q * tip**4 / EI), q * n * side


@pytest.mark.parametrize("on", ["box", "mesh", "T4", pytest.param("T10", marks=pytest.mark.slow)])
@pytest.mark.parametrize("place", [0.02, 0.25, 0.5, 0.95, 1.0])
def test_a_beam_overhangs_an_edge_within_a_facet(on, place):
    """0.3 % with facets of a fifth of the overhang, 23 % without."""
    result, ratio, weight = overhang("beam", on, place, clipping=True)
    assert ratio == pytest.approx(1.0, abs=5e-3)
    assert result.contact_force("lie")[0, 2] == pytest.approx(weight, rel=1e-7)


@pytest.mark.parametrize("place", [0.25, 0.5])
def test_a_shell_overhangs_an_edge_within_a_facet(place):
    """Ten facets of 0.2 m overhang."""
    _, ratio, _ = overhang("shell", "box", place, reach=10, clipping=True)
    assert ratio == pytest.approx(1.0, abs=1e-2)


@pytest.mark.parametrize("device", DEVICES)
def test_float32_overhangs_alike(device):
    _, ratio, _ = overhang("beam", "box", 0.5, dtype="float32", gravity=G, device=device, clipping=True)
    exact = overhang("beam", "box", 0.5, gravity=G, clipping=True)[1]
    assert ratio == pytest.approx(exact, rel=2e-3)


def test_without_clipping_the_edge_is_where_points_are():
    assert overhang("beam", "box", 0.5)[1] > 1.15


@pytest.mark.parametrize("on", ["box", "mesh"])
@pytest.mark.parametrize("place", [1.0, 1e-6])
def test_nodes_on_an_edge_lie_on_the_table(on, place):
    """As the beam bends its nodes at the edge move across it by 2 um; below it by the penetration, they met the side
    face: pushed off by half of the weight, 10 to 20 % of error."""
    result, ratio, weight = overhang("beam", on, place)
    assert ratio == pytest.approx(1.0, abs=5e-3)
    assert abs(result.contact_force("lie")[0, 0]) < 1e-9 * weight


# blocks at an edge


def tilted(d: float, on: str, *, time: float = 0.24, **options: Any) -> tuple[Any, float]:
    """Simulation of a block whose centre is d beyond an edge, m, from rest, and its angle, degrees."""
    a = 0.2
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    mesh = wf.mesh.box((a, a, a), cells=(2, 2, 2), element="T4", origin=(d - 0.5 * a, -0.5 * a, 0.0))
    block = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=RHO), name="block")
    b.add_contact(block, table(b, on), mu=0.5, name="stand", **options)
    for name, x in (("rear", -0.5 * a), ("front", 0.5 * a)):
        b.add_probe(name, block.at((d + x, 0.0, 0.5 * a)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    for _ in range(round(time / 2e-3)):
        sim.step()
    way = sim.probe("front").position[0, -1] - sim.probe("rear").position[0, -1]
    return sim, math.degrees(math.atan2(-way[2], way[0]))


@pytest.mark.parametrize("on", ["box", "T4"])
@pytest.mark.parametrize("d", [-0.03, -0.004])
def test_a_block_with_its_centre_over_the_table_stands(d, on):
    """Without clipping it stands on the nearest point and tips by 1.8 degrees in 0.24 s."""
    sim, angle = tilted(d, on, clipping=True)
    assert abs(angle) < 0.05
    assert sim.contact_force("stand")[0, 2] == pytest.approx(RHO * 0.2**3 * G, rel=0.02)


@pytest.mark.parametrize("on", ["box", "T4"])
@pytest.mark.parametrize(
    ("d", "error"), [pytest.param(0.004, 0.22, marks=pytest.mark.slow), (0.013, 0.06), (0.03, 0.06)]
)
def test_a_block_with_its_centre_beyond_the_edge_tips(d, error, on):
    """theta'' = m g (d + theta h)/I about the edge; the table's own edge yields by 0.8 mm of lever. 40 degrees
    without clipping at 4 mm, where 5 are right."""
    angle = tilted(d, on, time=0.16, clipping=True)[1]
    h, inertia = 0.1, 5.0 / 12.0 * 0.2**2
    right = math.degrees(d / h * (math.cosh(math.sqrt(G * h / inertia) * 0.16) - 1.0))
    assert angle == pytest.approx(right, rel=error)


@pytest.mark.parametrize("clipping", [False, True])
@pytest.mark.parametrize("on", ["box", "mesh"])
@pytest.mark.parametrize("place", [0.03, 0.05])
def test_a_block_slides_back_onto_a_table(on, place, clipping):
    """Without friction its speed stays: the points that sag below the edge are no bump. 0.38 of 0.5 m/s before."""
    a, speed = 0.2, -0.5
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    mesh = wf.mesh.box((a, a, a), cells=(2, 2, 2), element="T4", origin=(-0.5 * a - place, -0.5 * a, 0.0))
    block = b.add_solid(mesh, material=wf.SVK(E=1e7, nu=0.3, density=RHO), name="block")
    b.set_initial(block, velocity=(speed, 0.0, 0.0))
    b.add_contact(block, table(b, on), clipping=clipping)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(200)
    velocity = sim.state.velocity.numpy()[0].mean(axis=0)
    assert velocity[0] == pytest.approx(speed, rel=1e-4 if clipping else 1e-8)


def slid(
    shape: Any, yaw: float, *, E: float = 2e8, dt: float = 1.3e-3, speed: float = -0.29, dtype: str = "float64",
    device: str = "cpu", **options: Any
) -> Any:  # fmt: skip
    """Velocity over the first of a block turned about z that straddles an edge of a solid and slides onto it."""
    turn = np.array([(math.cos(yaw), -math.sin(yaw), 0.0), (math.sin(yaw), math.cos(yaw), 0.0), (0.0, 0.0, 1.0)])
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    mesh = wf.mesh.box((0.1, 0.06, 0.05), cells=(3, 3, 1), origin=(-0.05, -0.03, 0.0),
                       map=lambda X: X @ turn.T - (0.02, 0.0, 0.0))  # fmt: skip
    block = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=RHO), name="block")
    b.set_initial(block, velocity=(speed, 0.0, 0.0))
    if shape is None:
        mesh = wf.mesh.box((1.0, 1.0, 0.2), cells=(4, 4, 1), element="T4", origin=(-1.0, -0.5, -0.2))
        other: Any = b.add_solid(mesh, material=wf.SVK(E=1e9, nu=0.3, density=RHO), name="table")
        b.clamp(other.nodes(lambda X: X[:, 0] > -1e9))
    else:
        other = b.add_collider(shape)
    b.add_contact(block, other, **options)
    sim = wf.Simulation(b.finalize(device=device, dtype=dtype), dt=dt)
    sim.step(round(0.06 / abs(speed) / dt))
    mass = sim.model.masses.lumped[0][block.slots]
    return mass @ sim.state.velocity.numpy()[0][block.slots] / mass.sum() / speed


@pytest.mark.parametrize("kind", ["box", "mesh", "cylinder", "body"])
@pytest.mark.parametrize(("clipping", "yaw"), [(False, 17.0), (True, -35.0)])
@pytest.mark.parametrize("device", DEVICES)
def test_a_block_turned_about_the_vertical_slides_onto_a_solid(kind, yaw, clipping, device):
    """Its flanks face the side face in part: 0.67 of the speed was left on a body, 0.99 on a box."""
    box = wf.Box((-1.0, 0.0, -0.5), (2.0, 2.0, 1.0))
    shape = {"box": box, "mesh": wf.TriMesh(*box.mesh()), "body": None,
             "cylinder": wf.Cylinder((-1.0, 0.0, -1.0), (-1.0, 0.0, 0.0), 1.0)}[kind]  # fmt: skip
    assert slid(shape, math.radians(yaw), clipping=clipping, device=device) == pytest.approx((1, 0, 0), abs=1e-4)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", ["box", "body"])
def test_float32_slides_onto_a_solid(kind, device):
    shape = wf.Box((-1.0, 0.0, -0.5), (2.0, 2.0, 1.0)) if kind == "box" else None
    found = slid(shape, math.radians(17.0), E=1e7, clipping=True, dtype="float32", device=device)
    assert found == pytest.approx((1.0, 0.0, 0.0), abs=1e-3)


# reports, parameters, refusals


def test_reports_of_a_contact_include_its_edges():
    sim, _ = tilted(-0.004, "box", time=0.02, clipping=True)
    force, edges = sim.contact_force("stand"), sim.contact_force("stand edges")
    assert edges[0, 2] > 0.2 * force[0, 2]
    record, part = sim.contact_record("stand"), sim.contact_record("stand edges")
    assert record.force[0, -1] == pytest.approx(force[0, :3], rel=1e-12)
    assert record.normal_force[0, -1] > part.normal_force[0, -1] > 0.0
    assert (record.penetration >= part.penetration).all()
    assert ((record.stick <= 1.0) & (record.stick >= 0.0)).all()
    seen = sim.observe("contact.stand.force")
    assert seen.update().numpy()[0] == pytest.approx(force[0, :3], rel=1e-12)


def test_parameters_of_a_contact_are_those_of_its_edges():
    sim, _ = tilted(-0.004, "box", time=0.004, clipping=True)
    sim.model.set_parameter("stand.mu", 0.2)
    pairs = next(term for term in sim.model.terms.contacts if term.name == "pairs")
    assert pairs.tables.data.mu.numpy()[0].tolist() == [0.2]


def momenta(sim: Any) -> np.ndarray:
    """Linear and angular momentum of solids of T4."""
    bodies, state = sim.model.description.bodies, sim.state.numpy()
    x = np.concatenate([body.reference + body.origin for body in bodies]) + state["displacement"][0]
    p = sim.model.mass_matrix()[::3, ::3] @ state["velocity"][0]
    return np.concatenate([p.sum(axis=0), np.cross(x, p).sum(axis=0)])


@pytest.mark.parametrize("apart", [0.0, 0.4])
def test_bodies_with_clipping_conserve_momenta(apart):
    """Two free blocks, an edge of one within the facets of the other, cut by it if they are built near each other."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = wf.SVK(E=1e6, nu=0.3, density=RHO)
    first, second = (
        b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), element="T4", origin=origin), material=material, name=name)
        for name, origin in (("first", (0.03, 0.0, apart)), ("second", (0.0, 0.02, -0.1001)))
    )
    b.set_initial(first, velocity=(0.1, 0.0, -0.5), displacement=lambda X: np.tile((0.0, 0.0, -apart), (len(X), 1)))
    b.add_contact(first, second, mu=0.3, clipping=True, name="hit")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-4, integrator="energy_momentum", solver=wf.NewtonPCG(tol=1e-12))
    before = momenta(sim)
    sim.step(20)
    assert np.abs(sim.contact_record("hit edges" if apart else "hit").normal_force).max() > 0.0
    assert momenta(sim) == pytest.approx(before, abs=1e-12)


@pytest.mark.parametrize(("shape", "options", "text"), [
    (wf.Box((0, 0, -1), (1, 1, 2)), {"treatment": "explicit", "law": "paper"}, "explicit"),
    (wf.Box((0, 0, -1), (1, 1, 2)), {"model": "sphere", "radius": 0.1}, "sphere"),
])  # fmt: skip
def test_refusals(shape, options, text):
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=RHO))
    floor = b.add_collider(shape)
    with pytest.raises(NotImplementedError, match=text):
        b.add_contact(block, floor, clipping=True, **options)
    with pytest.raises(wf.ModelError, match="must be True or False"):
        b.add_contact(block, floor, clipping="yes", **options)


@pytest.mark.parametrize("shape", [wf.HalfSpace((0, 0, 1)), wf.Sphere((0, 0, -1), 1.0)])
def test_shapes_without_edges_cost_nothing(shape):
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=RHO))
    assert b.add_contact(block, b.add_collider(shape), clipping=True).edges is None


def test_edges_are_those_of_the_shape():
    """Box: 12 edges, each for both faces; cylinder: two rims; a smooth ball: none."""
    from warpfea.model.edge_points import obstacle_edges

    box = obstacle_edges(wf.Box((0.1, 0.2, 0.3), (1.0, 2.0, 3.0)), 0.1)
    assert box.area[:, :-1].sum() == pytest.approx(2 * 4 * 6.0, rel=1e-12)
    cylinder = obstacle_edges(wf.Cylinder((0, 0, 0), (0, 0, 2), 0.5), 0.1)
    assert cylinder.area[:, :-1].sum() == pytest.approx(2 * 2 * math.pi, rel=1e-3)
    np.testing.assert_allclose(np.abs(cylinder.X[:, :-1, 2] - 1.0), 1.0, atol=1e-12)
