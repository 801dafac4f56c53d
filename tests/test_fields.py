"""Scalar fields: each is defined once, and those of the elements are exact in a uniform deformation."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.model.surfaces import reference_points
from warpfea.simulation.results import Results
from warpfea.terms.fields import field_at_nodes, field_at_points, voigt

STRETCH = np.array([(0.1, 0.05, 0.0), (0.02, -0.04, 0.03), (0.0, 0.01, 0.06)])
LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)


def deformed():
    """A model of bodies of several families, and a state with F = I + STRETCH everywhere."""
    b = wf.ModelBuilder()
    for element in ("T4", "T10"):
        b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element=element), material=LAW, name=element)
    b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4"), material=LAW, element="ENMC", name="ENMC")
    b.add_beam([(0, 0, 0), (1, 0, 0)], elements=3, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=LAW)
    b.add_shell(wf.mesh.grid((1, 1), cells=(2, 2)), thickness=0.1, material=LAW)
    model = b.finalize(device="cpu")
    state = model.state()
    origin = np.concatenate([np.where(body.slot_kind[:, None] == 0, body.origin, 0.0) for body in model.bodies])
    state.displacement.assign(((model.slot_table.reference + origin) @ STRETCH.T)[None])
    return model, state


def test_fields_of_elements_are_exact_in_a_uniform_deformation():
    model, state = deformed()
    F = np.eye(3) + STRETCH
    E = 0.5 * (F.T @ F - np.eye(3))
    lam, mu = LAW.lame
    for body in model.bodies:
        names = [name for name, spec in model.terms.fields.items() if not spec.cell_type]
        fields = {name: field_at_nodes(model.terms, name, body, state) for name in names}
        drawn = {name: field_at_points(model.terms, name, body, state, body.skin) for name in names}
        for strain in (fields["green_lagrange"], drawn["green_lagrange"]):
            assert np.abs(strain - voigt(E)).max() < 1e-12
        exact = F @ (lam * np.trace(E) * np.eye(3) + 2 * mu * E) @ F.T / np.linalg.det(F)
        if body.family.solid:
            assert np.abs(drawn["cauchy"] - voigt(exact)).max() < 1e-12 * exact.max()
        assert fields["J"] == pytest.approx(np.linalg.det(F), rel=1e-13)
        assert drawn["J"] == pytest.approx(np.linalg.det(F), rel=1e-13)
        moved = np.linalg.norm(body.mesh.points @ STRETCH.T, axis=1)
        assert fields["displacement"][0] == pytest.approx(moved, abs=1e-15)
        density = fields["strain_energy_density"]
        assert np.ptp(density) < 1e-12 * density.max()
        if body.family.solid:  # others integrate parts of the law
            assert density == pytest.approx(lam / 2 * np.trace(E) ** 2 + mu * np.trace(E @ E), rel=1e-12)


def test_energy_density_adds_up_to_the_energy_of_a_bent_body():
    model, state = deformed()
    u = state.displacement.numpy()
    u[0, :, 2] += 30.0 * u[0, :, 0] ** 2
    state.displacement.assign(u)
    body = model.bodies[0]  # T4: the mean over a node's elements, weighted by volume, keeps the sum
    density = field_at_nodes(model.terms, "strain_energy_density", body, state)[0]
    volume = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4")
    X = volume.points[volume.cells]
    size = np.abs(np.linalg.det(X[:, 1:] - X[:, :1])) / 6.0
    share = np.bincount(volume.cells.ravel(), weights=np.repeat(size / 4.0, 4))
    alone = wf.ModelBuilder()
    alone.add_solid(volume, material=LAW)
    one = alone.finalize(device="cpu")
    single = one.state()
    single.displacement.assign(u[:, body.slots])
    assert share @ density == pytest.approx(one.strain_energy(single)[0], rel=1e-12)
    assert np.ptp(density) > 0.1 * density.max()


def test_titles_and_units_come_from_the_registry():
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=LAW)
    free = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    scalars = ["von_mises", "displacement", "J", "strain_energy_density", "viscous_dissipation", "tresca", "pressure"]
    assert list(free.model.terms.scalar_fields) == scalars
    b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1), -1.0)))
    touching = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    assert list(touching.model.terms.scalar_fields) == [*scalars, "contact_pressure", "gap"]
    assert all(spec.title for spec in touching.fields.values())
    assert touching.fields["contact_pressure"].units == "Pa"


@pytest.mark.parametrize("limit", [0, 20000], ids=["along a curve", "in the mesh's order"])
def test_results_do_not_depend_on_the_order_of_the_slots(limit, monkeypatch):
    """Slots of large bodies are numbered along a space-filling curve."""
    monkeypatch.setattr("warpfea.model.discretisation.ORDERED_NODES", limit)
    b = wf.ModelBuilder()
    bodies = [
        b.add_solid(wf.mesh.box((1, 0.4, 0.3), cells=(2, 2, 1), element="T10"), material=LAW, name="T10"),
        b.add_solid(wf.mesh.box((1, 0.4, 0.3), cells=(2, 2, 1), element="T4"), material=LAW, element="ENMC"),
    ]
    for body in bodies:
        b.set_initial(body, displacement=lambda X: X @ STRETCH.T, velocity=lambda X: X @ STRETCH)
    model = b.finalize(device="cpu")
    results = Results(model, model.state())
    for body in bodies:
        ordered = np.array_equal(body.node_slot, np.sort(body.node_slot))
        assert ordered == (limit > 0)
        X, skin = body.mesh.points, reference_points(body, body.skin.slot_weights)
        assert results.displacements(body)[0] == pytest.approx(X @ STRETCH.T, abs=1e-15)
        assert results.velocities(body)[0] == pytest.approx(X @ STRETCH, abs=1e-15)
        assert results.skin_points(body)[0] == pytest.approx(skin + skin @ STRETCH.T, abs=1e-14)
        moved = np.linalg.norm(X @ STRETCH.T, axis=1)
        assert results.field("displacement", body)[0] == pytest.approx(moved, abs=1e-15)
    gradients = results.node_gradients(bodies[1])[0]
    assert np.nanmax(np.abs(gradients - np.eye(3) - STRETCH)) < 1e-12
