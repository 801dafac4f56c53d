"""Sharp edges of bodies against each other, on coarse meshes."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turn

import warpfea as wf
from warpfea.contact.facets import FacetContact
from warpfea.model.pairs import PairContact
from warpfea.simulation.checkpoint import save_checkpoint

G, RHO, E, NU, WIDTH = 9.81, 1000.0, 1e7, 0.3, 0.04
HALF = WIDTH / np.sqrt(2.0)
"""Half the diagonal of a bar's section."""


def material(modulus=E, damped=True):
    return wf.SVK(E=modulus, nu=NU, density=RHO, damping=wf.KelvinVoigt(eta=2e-3 * modulus) if damped else None)


def bar(b, cells, axes, at, roll=0.25 * np.pi, kind="T10", **options):
    """A bar of 0.2 m along the first of `axes`, (3, 3) columns, turned about itself: on an edge."""
    turn = axes @ Turn.from_rotvec((roll, 0, 0)).as_matrix()
    size = (0.2, WIDTH, WIDTH)
    mesh = wf.mesh.box(size, cells=(cells, 1, 1), origin=tuple(-0.5 * np.array(size)), element=kind,
                       map=lambda X: X @ turn.T + at)  # fmt: skip
    return b.add_solid(mesh, material=material(**options))


def crossed(angle, cells=2, height=2e-4, roll=0.25 * np.pi, offset=(0.013, 0.007), kind="T10", **options):
    """A bar, and one across it at an angle, rad, a height above, edge on edge."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    low = bar(b, cells, np.eye(3), np.zeros(3), roll, kind, **options)
    top = 2.0 * HALF if roll else WIDTH
    at = np.array([*offset, top + height])
    high = bar(b, cells, Turn.from_rotvec((0, 0, angle)).as_matrix(), at, roll, kind, **options)
    return b, low, high, at


def run(b, pad, steps, dt=2e-3, **options):
    """Simulation after some steps, its record of the contact, and Newton iterations."""
    sim = wf.Simulation(b.finalize(device="cpu"), dt=dt, **options)
    newton = sum(int(sim.step().newton.max()) for _ in range(steps))
    return sim, sim.contact_record(pad), newton


@pytest.mark.parametrize(
    ("kind", "cells", "angle"),
    [("T10", 2, 90.0), ("T10", 5, 45.0), pytest.param("H3843", 2, 45.0, marks=pytest.mark.slow)],
)
def test_a_bar_lies_edge_on_edge(kind, cells, angle):
    """As deep as the weight over 10/(c_1/d_2 + c_2/d_1), c = (1 - nu^2)/E, d the depths of the elements, here both the
    width. Before, bars sank by 5 to 8 of 40 mm, until points met facets."""
    b, low, high, at = crossed(np.radians(angle), cells, kind=kind)
    b.clamp(low.nodes(lambda X: X[:, 2] < -0.3 * WIDTH))
    b.clamp(high.nodes(lambda X: X[:, 2] > at[2] + HALF - 1e-9), slots="position", components="xy")
    pad = b.add_contact(high, low, mu=0.3)
    sim, record, newton = run(b, pad, 60)
    weight = 0.2 * WIDTH**2 * RHO * G
    force = record.force[0, -1]
    assert force[2] == pytest.approx(weight, rel=1e-3)
    stiffness = 10.0 * E * WIDTH / (2.0 * (1.0 - NU**2))
    assert record.penetration[0, -1] == pytest.approx(np.linalg.norm(force) / stiffness, rel=0.03)
    assert at[2] - sim.positions(high)[0, :, 2].mean() < 3e-4  # 0.2 mm are the gap
    assert newton < 240
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-9
    nodal = sim.model.contact_force(sim.state)[0]
    for body, sign in ((high, 1.0), (low, -1.0)):
        positions = body.slots[body.slot_kind == 0]
        np.testing.assert_allclose(sign * nodal[positions].sum(axis=0), force, rtol=1e-6, atol=1e-6)


def test_rims_of_shells_and_edges_of_tetrahedra():
    """Two shells rim on rim, two tetrahedra edge on edge."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    bodies = []
    for k, axes in enumerate((np.eye(3), Turn.from_rotvec((0, 0, 1)).as_matrix())):
        turn = axes @ Turn.from_rotvec((0.5 * np.pi, 0, 0)).as_matrix()
        mesh = wf.mesh.grid((0.2, 0.1), cells=(2, 1), origin=(-0.1, -0.1 + 0.1 * k, 0),
                            map=lambda X, turn=turn, k=k: X @ turn.T + k * np.array([0.013, 0.007, 2e-4]))  # fmt: skip
        bodies.append(b.add_shell(mesh, thickness=0.01, material=material(1e8)))
    X = 0.05 * np.array([(-1, 0, 0), (1, 0, 0), (0, -1, -1), (0, 1, -1)], dtype=float)
    tets = [(X, [0, 1, 2, 3]), (X[:, [1, 0, 2]] * (1, 1, -1) + (0.006, 0.009, 2e-4), [0, 1, 2, 3])]
    for X, cell in tets:
        a, c, d, e = X + (1.0, 0.0, 0.0)
        cell = cell if np.dot(np.cross(c - a, d - a), e - a) > 0.0 else [1, 0, 2, 3]
        bodies.append(b.add_solid(wf.mesh.Mesh(np.array([a, c, d, e]), np.array([cell]), "tetra"), material=material()))
    for low, high in (bodies[:2], bodies[2:]):
        b.clamp(low.nodes(lambda X: X[:, 2] < -0.04))
        b.clamp(high.nodes(lambda X: X[:, 2] > 0.04), slots="position", components="xy")
    contacts = [b.add_contact(high, low, mu=0.3) for low, high in (bodies[:2], bodies[2:])]
    sim, _, _ = run(b, contacts[0], 60)
    for contact, weight in zip(contacts, (0.2 * 0.1 * 0.01 * RHO * G, 0.1 * 0.1 * 0.05 / 6.0 * RHO * G)):
        record = sim.contact_record(contact)
        assert record.force[0, -10:, 2].mean() == pytest.approx(weight, rel=0.02)
        assert record.penetration.max() < 5e-6


@pytest.mark.parametrize("along", [(1.0, 0.0), (0.7, 0.7)])
def test_an_edge_slides_on_another_over_the_borders_of_elements(along):
    """Coulomb's ratio all the way, as the perpendicular passes from edge to edge on both sides."""
    steps, dt, travel = 100, 2e-3, 0.1
    b, low, high, at = crossed(0.5 * np.pi, 5, 1e-5, offset=(-0.07 * along[0], -0.07 * along[1]))
    b.clamp(low.nodes(lambda X: X[:, 2] < -0.3 * WIDTH))
    way = [(0, 0, 0), (0, 0, -3e-5), (travel * along[0], travel * along[1], -3e-5)]
    held = high.nodes(lambda X: X[:, 2] > at[2] - 1e-9)
    b.drive(held, displacement=([0, 4 * dt, steps * dt], way), slots="position")
    pad = b.add_contact(low, high, mu=0.3)
    sim, record, newton = run(b, pad, steps, dt)
    force = record.force[0, 10:]
    assert force[:, 2].max() < -1.3
    np.testing.assert_allclose(np.linalg.norm(force[:, :2], axis=1), -0.3 * force[:, 2], rtol=5e-3)
    assert record.penetration.max() < 2e-6
    assert newton < 10 * steps
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-8


@pytest.mark.parametrize("clamped", [True, False])
def test_a_resumed_run_of_crossed_edges_has_the_same_bits(clamped, tmp_path):
    """Also beside another simulation of the same model, and with rigid body modes in the preconditioner."""
    b, low, high, at = crossed(1.0, 5)
    b.clamp(low.nodes(lambda X: X[:, 2] < -0.3 * WIDTH))
    if clamped:
        b.clamp(high.nodes(lambda X: X[:, 2] > at[2] + HALF - 1e-9), slots="position", components="xy")
    pad = b.add_contact(high, low, mu=0.3)
    model = b.finalize(device="cpu")
    first, beside = (wf.Simulation(model, dt=2e-3) for _ in range(2))
    first.step(12)
    beside.step(9)
    save_checkpoint(first, tmp_path / "half.npz")
    second = wf.Simulation(model, dt=2e-3)
    second.resume(tmp_path / "half.npz")
    for sim in (first, second):
        sim.step(12)
    beside.step(15)
    assert first.contact_record(pad).force[0, -1].any()
    for sim in (second, beside):
        np.testing.assert_array_equal(sim.state.displacement.numpy(), first.state.displacement.numpy())


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0])
def test_faces_on_faces_have_no_forces_of_edges(angle, monkeypatch):
    """No double count: the same bits as without edges, where these cross at the border of what touches."""
    found = []
    for without in (False, True):
        b, low, high, at = crossed(np.radians(angle), roll=0.0, offset=(0.0, 0.0))
        b.clamp(low.nodes(lambda X: X[:, 2] < -0.49 * WIDTH))
        pad = b.add_contact(high, low, mu=0.3)
        if without:
            monkeypatch.setattr(PairContact, "sharp_edges", lambda contact: None)
        sim, record, _ = run(b, pad, 12)
        assert record.force[0, :, 2].max() > 0.0
        found.append(sim.positions(high))
    np.testing.assert_array_equal(*found)


def test_struck_edges_keep_the_momenta():
    """Free bars that strike each other, with friction, `energy_momentum`, and in single precision."""
    force = []
    for dtype in ("float64", "float32"):
        b, low, high, _ = crossed(np.pi / 3.0, height=1e-3, offset=(0.03, 0.02), damped=False)
        b.set_initial(high, velocity=(0.1, 0.2, -0.5))
        pad = b.add_contact(low, high, mu=0.3)
        model = b.finalize(device="cpu", dtype=dtype)
        model.set_gravity((0, 0, 0))
        tol = 1e-12 if dtype == "float64" else 1e-6
        sim = wf.Simulation(model, dt=2e-3, integrator="energy_momentum", solver=wf.NewtonPCG(tol=tol))
        M = model.mass_matrix()

        def momenta(sim=sim, model=model, M=M):
            u, v = (field.numpy()[0].astype(float) for field in (sim.state.displacement, sim.state.velocity))
            x = np.zeros_like(u)
            for body in model.bodies:
                x[body.slots] = body.reference + body.origin + u[body.slots]
            p = (M @ v.ravel()).reshape(-1, 3)
            return np.array([p.sum(axis=0), np.cross(x, p).sum(axis=0)])

        before = momenta()
        sim.step(40)
        force.append(sim.contact_record(pad).force[0])
        assert np.abs(force[-1]).max() > 1.0
        least = (1e-12 if dtype == "float64" else 2e-5) * np.abs(before).max()
        np.testing.assert_allclose(momenta(), before, atol=least)
    np.testing.assert_allclose(force[1].sum(axis=0), force[0].sum(axis=0), rtol=1e-3, atol=1e-3)


def test_bodies_without_sharp_edges_have_no_points_on_edges():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    for k in range(2):
        ball = wf.mesh.sphere(0.05, cells=4, center=(0, 0, 0.2 * k)) if k else wf.mesh.sphere(0.05, cells=4)
        b.add_solid(ball, material=material(), name=f"ball {k}")
    block = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(2, 2, 2), origin=(0, 0, 0.5)), material=material())
    first, second = b.description.bodies[:2]
    b.add_contact(first, second)
    b.add_contact(first, block)
    b.add_contact(block, second, stiffness="region")
    terms = [term for term in b.finalize(device="cpu").terms.all if isinstance(term, FacetContact)]
    assert [term.tables.edge_groups for term in terms] == [[]]
