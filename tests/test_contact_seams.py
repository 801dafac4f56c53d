"""Seams between colliders: bodies pass flat ones as one surface, and steps as steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from contact_runs import DEVICES

import warpfea as wf
from warpfea.contact.colliders import ColliderContact
from warpfea.contact.facets import FacetContact
from warpfea.studies.stress.cases.contact import momentum

SIDE, SPEED, DT, G = 0.05, 1.0, 1e-3, 9.81
START = -0.0607
"""First place of the rear face: the front is 10.7 mm before the seam at x = 0."""


def boxes(gap=0.0, rise=0.0, height=0.1):
    """Two boxes with a seam in the plane x = 0, at z = 0; the second `rise` higher."""
    size = (0.4, 0.3, height)
    return [wf.Box((-0.2, 0.0, -0.5 * height), size), wf.Box((0.2 + gap, 0.0, rise - 0.5 * height), size)]


def meshes(gap=1e-6, rise=0.0, closed=True):
    """The boxes as meshes; not closed: their upper faces as sheets."""
    out = []
    for box in boxes(gap, rise):
        points, triangles = box.mesh()
        upper = np.array([(4, 5, 7), (4, 7, 6)])
        out.append(wf.TriMesh(points, triangles if closed else upper))
    return out


def joined(parts):
    """One mesh of several."""
    first = np.cumsum([0, *(len(part.points) for part in parts)])
    triangles = np.concatenate([part.triangles + k for part, k in zip(parts, first)])
    return [wf.TriMesh(np.concatenate([part.points for part in parts]), triangles)]


def floor_with_wall(top, bottom=-0.05):
    """A floor at z = 0, and a wall at x = 0 that reaches `top`."""
    return [wf.HalfSpace((0, 0, 1), 0.0), wf.Box((0.2, 0.0, 0.5 * (top + bottom)), (0.4, 0.3, top - bottom))]


def slabs(gap=0.0, rise=0.0, sides=((4, 3, 1), (4, 3, 1)), element="T10"):
    """The boxes as meshes of elements, a little wider, so that no face of theirs ends where one of the block does."""
    both = zip((-0.4, gap), (0.0, rise), sides)
    return [wf.mesh.box((0.4, 0.31, 0.1), cells=n, origin=(x, -0.155, z - 0.1), element=element) for x, z, n in both]


def one_slab(parts):
    """One mesh of several."""
    cells = np.concatenate([part.cells + k * len(parts[0].points) for k, part in enumerate(parts)])
    return [wf.mesh.Mesh(np.concatenate([part.points for part in parts]), cells, parts[0].cell_type, name="slab")]


def added(b, shape, name, path=None, part=False):
    """A collider of a shape, or with `part` a clamped rigid part; a clamped or driven body of a mesh."""
    if not isinstance(shape, wf.mesh.Mesh) and not part:
        return b.add_collider(shape, path=path, name=name)
    solid = isinstance(shape, wf.mesh.Mesh)
    material = wf.SVK(E=1e9, nu=0.3, density=1000.0)
    body = b.add_solid(shape, material=material, name=name) if solid else b.add_rigid(shape, density=1000.0, name=name)
    nodes = body.nodes(lambda X: X[:, 0] > -1e9)
    b.drive(nodes, displacement=path) if path else b.clamp(nodes)
    return body


@dataclass
class Slide:
    """End of a slide: velocity of the centre of mass, m/s, spin, rad/s, and positions of the lower front edge."""

    velocity: np.ndarray
    spin: np.ndarray
    edge: np.ndarray


def sliding(
    shapes, steps=100, *, E=1e8, paths=None, yaw=0.0, dtype="float64", device="cpu", integrator="backward_euler",
    part=False, **options,
):  # fmt: skip
    """A block that slides along x over shapes, or meshes as clamped bodies."""
    b = wf.ModelBuilder()
    c, s = np.cos(np.radians(yaw)), np.sin(np.radians(yaw))
    turn, middle = np.array([(c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)]), (START + 0.5 * SIDE, 0.0, 0.0)
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2, 1, 1), origin=(START, -0.5 * SIDE, 0.0),
                       map=lambda X: (X - middle) @ turn.T + middle)  # fmt: skip
    block = b.add_solid(mesh, material=wf.SVK(E=E, nu=0.3, density=1000.0), name="block")
    b.set_initial(block, velocity=(SPEED, 0.0, 0.0))
    for k, shape in enumerate(shapes):
        b.add_contact(block, added(b, shape, f"floor {k}", paths[k] if paths else None, part), **options)
    model = b.finalize(device=device, dtype=dtype)
    sim = wf.Simulation(
        model, dt=DT, integrator=integrator, solver=wf.NewtonPCG(tol=1e-10 if dtype == "float64" else 1e-6)
    )
    X = (block.reference[block.slot_kind == 0] + block.origin - middle) @ turn + middle
    lower = (np.abs(X[:, 0] - START - SIDE) < 1e-9) & (np.abs(X[:, 2]) < 1e-9)
    edge = []
    for _ in range(steps):
        sim.step()
        edge.append(sim.positions(block)[0, lower])
    mass = model.masses.lumped[0][block.slots] * (block.slot_kind == 0)
    velocity = momentum(sim, block) / mass.sum()
    x = block.reference + block.origin + sim.state.displacement.numpy()[0, block.slots]
    arm = x - mass @ x / mass.sum()
    v = sim.state.velocity.numpy()[0, block.slots] - velocity
    inertia = np.einsum("n,nk,nk->", mass, arm, arm) * np.eye(3) - np.einsum("n,ni,nj->ij", mass, arm, arm)
    return Slide(velocity, np.linalg.solve(inertia, mass @ np.cross(arm, v)), np.array(edge))


CONVEYOR = ([0, 1], [(0, 0, 0), (0.2, 0.1, 0)])
SEAMS = {
    "flat": (boxes(), {}),
    "overlap": (boxes(-0.01), {}),
    "gap": (boxes(0.002), {}),
    "stiff": (boxes(0.002), {"E": 1e9, "integrator": "bdf2"}),
    "plates": (boxes(0.002, height=0.004), {}),
    "conveyor": (boxes(), {"paths": [CONVEYOR, CONVEYOR]}),
    "meshes": (meshes(0.002), {}),
    "mesh of two parts": (joined(meshes(0.002)), {}),
    "mesh of overlapping parts": (joined(meshes(-0.0101)), {}),
    "sheets": (meshes(0.002, closed=False), {}),
    "sheet of two parts": (joined(meshes(0.002, closed=False)), {}),
    "low wall": (floor_with_wall(1e-6), {}),
}
FINE = {"sides": ((16, 12, 1), (16, 12, 1)), "element": "ENMC"}
"""Slabs of smaller facets than the block's: their points touch its facets."""
SEAMS |= {
    "bodies": (slabs(), {}),
    "bodies, gap": (slabs(0.002), {}),
    "bodies, overlap": (slabs(-0.01), {}),
    "bodies, stiff": (slabs(0.002), {"E": 1e9, "integrator": "bdf2"}),
    "bodies, alpha": (slabs(0.002), {"integrator": "generalized_alpha"}),
    "bodies, askew": (slabs(0.002), {"yaw": -35.0}),
    "bodies, segments": (slabs(0.002), {"clipping": True}),
    "fine bodies": (slabs(**FINE), {}),
    "fine bodies, gap": (slabs(0.002, **FINE), {}),
    "a fine body behind": (slabs(0.002, sides=((8, 6, 1), (16, 12, 1)), element="ENMC"), {}),
    "a fine body before": (slabs(0.002, sides=((16, 12, 1), (8, 6, 1)), element="ENMC"), {}),
    "body of two parts": (one_slab(slabs(0.002)), {}),
}
SEAMS |= {
    f"{kind}, {how}": ([*first[:1], *second[1:]], {})
    for how, gap in (("flat", 0.0), ("gap", 0.002), ("overlap", -0.01))
    for kind, first, second in (("box behind", slabs(gap), boxes(gap)), ("box before", boxes(gap), slabs(gap)))
}
SEAMS |= {
    "body in a half-space": ([wf.HalfSpace((0, 0, 1)), slabs()[1]], {}),
}
FAST = ("flat", "mesh of two parts", "low wall", "bodies", "bodies, gap", "body of two parts", "box behind, gap",
        "box before, gap")  # fmt: skip


@pytest.mark.parametrize("name", [n if n in FAST else pytest.param(n, marks=pytest.mark.slow) for n in SEAMS])
def test_a_block_slides_over_a_seam(name):
    """Without friction its velocity along the surface stays, and it does not turn."""
    shapes, options = SEAMS[name]
    out = sliding(shapes, **options)
    assert out.velocity[:2] == pytest.approx([SPEED, 0.0], abs=1e-6)
    assert np.abs(out.spin).max() < 1e-3
    assert np.abs(out.edge[-1, :, 2]).max() < 1e-4


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_block_slides_over_a_seam_of_bodies_in_both_precisions(device, dtype):
    """In float32 100 solves to 1e-6 leave 1e-7 on the CPU and 1.05e-6 on CUDA, in float64 1e-14."""
    out = sliding(slabs(0.002), E=1e7, dtype=dtype, device=device)
    assert out.velocity == pytest.approx([SPEED, 0.0, 0.0], abs=1e-12 if dtype == "float64" else 5e-6)
    assert np.abs(out.spin).max() < 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES)
def test_a_block_slides_from_a_body_onto_a_box_in_float32(device):
    out = sliding(SEAMS["box behind, gap"][0], E=1e7, dtype="float32", device=device)
    assert out.velocity == pytest.approx([SPEED, 0.0, 0.0], abs=5e-6)
    assert np.abs(out.spin).max() < 1e-3


@pytest.mark.parametrize(
    ("gap", "reverse"),
    [(0.0, False), *(pytest.param(*x, marks=pytest.mark.slow) for x in ((0.0, True), (0.002, True)))],
)
def test_a_block_slides_between_a_body_and_a_rigid_part(gap, reverse):
    shapes = [slabs(gap)[0], boxes(gap)[1]] if not reverse else [boxes(gap)[0], slabs(gap)[1]]
    out = sliding(shapes, part=True)
    assert out.velocity == pytest.approx([SPEED, 0.0, 0.0], abs=1e-9)
    assert np.abs(out.spin).max() < 1e-9


def test_a_body_that_sinks_leaves_a_real_step():
    """Level with the box as built, driven 1 mm lower before the block is there: its front stays behind the box."""
    sink = ([0, 0.008, 1], [(0, 0, 0), (0, 0, -1e-3), (0, 0, -1e-3)])
    out = sliding(SEAMS["box behind, flat"][0], 40, E=1e9, paths=[sink, None])
    assert out.edge[:, :, 0].max() < 1e-4
    assert out.velocity[0] < 0.9 * SPEED


def test_a_seam_with_a_collider_that_moves_is_warned_of():
    """0.36 m/s and 13 rad/s would be left."""
    with pytest.warns(wf.ModelWarning, match="'block' touches collider 'floor 1', which moves, and body 'floor 0'"):
        sliding(SEAMS["box behind, flat"][0], 0, paths=[None, CONVEYOR])


def test_a_block_slides_onto_a_body_that_came_near_it_later():
    """Built 3 cm apart, beyond the reach of a seam by default: `seam=` looks at any distance."""
    join = ([0, 0.008, 1], [(0, 0, 0), (-0.03, 0, 0), (-0.03, 0, 0)])
    out = sliding(slabs(0.03), paths=[None, join], seam=5e-5)
    assert out.velocity[:2] == pytest.approx([SPEED, 0.0], abs=1e-6)
    assert np.abs(out.spin).max() < 1e-3


SMALL_STEPS = {
    "boxes up": boxes(rise=1e-5), "boxes down": boxes(rise=-1e-5), "mesh up": joined(meshes(rise=1e-5)),
    "mesh down": joined(meshes(rise=-1e-5)), "sheets up": meshes(rise=1e-5, closed=False),
    "bodies up": slabs(rise=1e-5), "bodies down": slabs(rise=-1e-5), "fine bodies up": slabs(rise=1e-5, **FINE),
    "fine bodies down": slabs(rise=-1e-5, **FINE), "body of two parts up": one_slab(slabs(1e-6, 1e-5)),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL_STEPS)
def test_a_small_step_is_a_seam(name):
    out = sliding(SMALL_STEPS[name])
    assert out.velocity[0] == pytest.approx(SPEED, abs=3e-4)
    assert np.abs(out.spin).max() < 1e-3


REAL_STEPS = [boxes(rise=1e-3), slabs(rise=1e-3), joined(meshes(rise=1e-3)), slabs(rise=1e-3, **FINE)]


@pytest.mark.parametrize(
    "shapes", [s if k < 2 else pytest.param(s, marks=pytest.mark.slow) for k, s in enumerate(REAL_STEPS)]
)
def test_a_real_step_holds_the_front_edge(shapes):
    """The edge is behind the step, but for its penetration, until it is above it."""
    out = sliding(shapes, 60, E=1e9)
    x, _, z = np.moveaxis(out.edge, 2, 0)
    assert z[(x > 1e-4)].min(initial=1.0) > 0.9e-3 or x.max() < 1e-4
    assert x.max() < 0.02  # without the step it is at 0.05
    assert out.velocity @ out.velocity + out.spin @ out.spin * SIDE**2 / 6.0 < SPEED**2


ROLLS = {
    "overlap": boxes(-0.01), "gap": boxes(0.002), "mesh": joined(meshes()), "sheets": meshes(closed=False),
    "low wall": floor_with_wall(1e-6),
}  # fmt: skip


def rolling(shapes):
    """State of a ball of facets after it has rolled over x = 0 with friction."""

    def ball(X):
        a, b, c = (X.T / 0.03) ** 2
        parts = [1 - b / 2 - c / 2 + b * c / 3, 1 - a / 2 - c / 2 + a * c / 3, 1 - a / 2 - b / 2 + a * b / 3]
        return X * np.sqrt(np.column_stack(parts)) + (-0.02, 0.0, 0.03)

    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.06,) * 3, cells=(4, 4, 4), origin=(-0.03,) * 3, element="T4", map=ball)
    body = b.add_solid(mesh, material=wf.SVK(E=1e7, nu=0.3, density=1000.0), name="ball")
    b.set_initial(body, velocity=(0.5, 0.0, 0.0), angular_velocity=(0.0, 0.5 / 0.03, 0.0))
    for k, shape in enumerate(shapes):
        b.add_contact(body, added(b, shape, f"floor {k}"), mu=0.5)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=DT)
    sim.step(80)
    return sim.state.velocity.numpy()[0, body.slots]


@pytest.mark.slow
def test_a_ball_rolls_over_seams_as_over_one_box():
    wanted = rolling([wf.Box((0.0, 0.0, -0.05), (0.8, 0.3, 0.1))])
    for name, shapes in ROLLS.items():
        assert rolling(shapes) == pytest.approx(wanted, abs=1e-6), name


@pytest.mark.slow
@pytest.mark.parametrize("gap", [0.0, 0.002])
def test_a_ball_rolls_over_seams_as_over_one_body(gap):
    wanted = rolling([wf.mesh.box((0.8, 0.31, 0.1), cells=(8, 3, 1), origin=(-0.4, -0.155, -0.1), element="T10")])
    found = rolling(slabs(gap))
    assert found == pytest.approx(wanted, abs=5e-6)  # the tolerance of friction
    assert found.mean(axis=0) == pytest.approx(wanted.mean(axis=0), abs=1e-6)


def test_seam_divides_a_seam_from_a_step():
    """By default a thousandth of the width of the surface, 5e-5 m."""
    for make in (boxes, slabs):
        for rise, seam, passes in ((1e-4, None, False), (1e-4, 1.1e-4, True), (1e-5, 0.0, False)):
            speed = sliding(make(rise=rise), 40, seam=seam, stiffness="region").velocity[0]
            assert (abs(speed - SPEED) < 1e-4) == passes, (make, rise, seam)


def floor_model(shapes, paths=(None, None), **options):
    b = wf.ModelBuilder()
    block = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1e3))
    for shape, path in zip(shapes, paths):
        b.add_contact(block, b.add_collider(shape, path=path), **options)
    return b.finalize(device="cpu").terms.find(ColliderContact)


def test_colliders_without_seams_cost_nothing():
    """Alone, apart, on different paths, or round, they have no tables and the kernels of models without seams."""
    with_seam = floor_model(boxes())
    assert with_seam.tables.geometry == "colliders_seams"
    assert with_seam.tables.shapes.neighbor.numpy().tolist() == [1, 0]
    ball = wf.Sphere((0.3, 0.0, 0.0), 0.1)
    groups = [boxes()[:1], boxes(0.1), [boxes()[0], ball], [wf.HalfSpace((0, 0, 1)), wf.HalfSpace((1, 0, 1), -0.1)]]
    for term in [*map(floor_model, groups), floor_model(boxes(), (None, CONVEYOR))]:
        assert term.tables.geometry == "colliders"
        assert term.tables.seams is None
        assert term.tables.shapes.neighbor is None or not term.tables.shapes.neighbor.size


def test_bodies_without_seams_cost_nothing():
    """One, or two apart: no tables, and the kernels of models without seams."""
    for shapes, seams in ((slabs(), True), (slabs()[:1], False), (slabs(0.3), False)):
        b = wf.ModelBuilder()
        block = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1e3))
        for k, shape in enumerate(shapes):
            b.add_contact(block, added(b, shape, f"floor {k}"))
        term = b.finalize(device="cpu").terms.find(FacetContact)
        assert bool(term.tables.seams) == seams
        assert len(term.tables.surfaces) == len(shapes)
        assert term.search_kernels.module.name.endswith("_seams") == seams


def test_a_body_and_a_collider_apart_cost_nothing():
    """At another level, or beyond the reach of a seam, no level faces and no levels."""
    for gap, rise, seam in ((0.0, 0.0, True), (0.1, 0.0, False), (0.0, 1e-3, False)):
        b = wf.ModelBuilder()
        block = b.add_solid(wf.mesh.box((SIDE,) * 3, cells=(1, 1, 1), origin=(-0.1, 0, max(rise, 0.0))),
                            material=wf.SVK(E=1e6, nu=0.3, density=1e3))  # fmt: skip
        for k, shape in enumerate((slabs()[0], boxes(gap, rise)[1])):
            b.add_contact(block, added(b, shape, f"floor {k}"))
        terms = b.finalize(device="cpu").terms
        facets, colliders = terms.find(FacetContact), terms.find(ColliderContact)
        assert bool(facets.tables.mixed) == bool(facets.tables.seams) == seam
        assert colliders.tables.geometry == "colliders" + "_seams" * seam
        assert len(facets.tables.surfaces) == 1 + seam
        assert facets.search_kernels.module.name.endswith("_seams") == seam


def test_bad_seams_are_refused():
    with pytest.raises(wf.ModelError, match=r"seam = -0\.1 must be a length of 0 or above, m"):
        floor_model(boxes(), seam=-0.1)


def walled(bottom, top=0.1, on="box", wall="box"):
    """A floor, and a wall on it at x = 0 whose lower face is at `bottom`."""
    floor = wf.HalfSpace((0, 0, 1), 0.0) if on == "half-space" else wf.Box((0.0, 0.0, -0.05), (0.8, 0.3, 0.1))
    box = wf.Box((0.2, 0.0, 0.5 * (bottom + top)), (0.4, 0.3, top - bottom))
    return [floor, wf.TriMesh(*box.mesh()) if wall == "mesh" else box]


@pytest.mark.parametrize(("top", "shapes"), [
    (0.1, walled(0.0)), (0.1, walled(1e-6, on="half-space")), (0.02, walled(0.0, 0.02)),
    *(pytest.param(0.1, walled(bottom), marks=pytest.mark.slow) for bottom in (-1e-6, 1e-6, 1e-5)),
    pytest.param(0.1, walled(0.0, wall="mesh"), marks=pytest.mark.slow),
])  # fmt: skip
def test_a_wall_on_a_floor_holds_as_one_that_reaches_into_it(top, shapes):
    """Before: points at its foot met its lower face, no solution, or thrown back at 4 cm/s."""
    known, out = sliding(walled(-0.05, top), 25), sliding(shapes, 25)
    np.testing.assert_allclose(out.velocity, known.velocity, atol=1e-6)
    np.testing.assert_allclose(out.spin, known.spin, atol=1e-3)
    assert out.edge[:, :, 0].max() < 2e-6


def knife():
    """A prism of 30 degrees that stands on its edge, the y axis, in the corner of x = 0 and z = 0."""
    a = np.radians(45.0) + np.radians(15.0) * np.array([-1.0, 1.0])
    triangle = np.vstack([np.zeros(3), 0.1 * np.stack([np.cos(a), 0.0 * a, np.sin(a)], axis=1)])
    points = np.concatenate([triangle + (0.0, y, 0.0) for y in (0.0, 0.05, 0.1)])
    cells = np.concatenate([np.array([[0, 1, 2, 3], [1, 5, 2, 3], [1, 4, 5, 3]]) + k for k in (0, 3)])
    x = points[cells]
    turned = np.linalg.det(x[:, 1:] - x[:, :1]) < 0.0
    cells[turned] = cells[turned][:, [0, 1, 3, 2]]
    return wf.mesh.Mesh(points, cells, "tetra", name="knife")


@pytest.mark.parametrize("E", [1e6, 1e8])
def test_an_edge_rests_in_the_corner_of_a_floor_and_a_wall(E):
    """Each bears the weight along its normal. Before, the top of the wall, 1 m above, took the place of the floor: the
    edge sank, and was thrown out with 50 times its weight."""
    b = wf.ModelBuilder(gravity=(-G, 0, -G))
    body = b.add_solid(knife(), material=wf.NeoHookean.from_E_nu(E=E, nu=0.3, density=1000.0))
    sides = [wf.HalfSpace((0, 0, 1)), wf.Box((-0.5, 0, 0), (1, 2, 2))]
    pads = [b.add_contact(body, b.add_collider(side)) for side in sides]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(60)
    weight = 0.5 * 0.1**2 * 0.5 * 0.1 * 1000.0 * G
    for pad, axis in zip(pads, (2, 0)):
        force = sim.contact_record(pad).force[0, :, axis]
        assert force[-10:].mean() == pytest.approx(weight, rel=2e-3)
        assert force.max() < 2.0 * weight
