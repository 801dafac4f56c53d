"""Pressure and total stiffness of contact through each family."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from contact_cubes import LOAD, STIFF, flat_side, pressed

import warpfea as wf
from warpfea.contact.colliders import ColliderContact
from warpfea.contact.tables import contact_constants

SIZE = np.array([0.3, 0.24, 0.12])


def bulged(X):
    """Nodes moved so that faces are cut unevenly but stay flat."""
    t = np.asarray(X) / SIZE
    return SIZE * (t + 0.3 * t * (1 - t) * (t - 0.2) * (1 + t[:, [1, 2, 0]]))


def solid(b, element, material, cells=(3, 2, 2)):
    kind = element if element in ("T10", "ENMC", "H3843") else "T4"
    mesh = wf.mesh.box(tuple(SIZE), cells=cells, element=kind)
    points = bulged(mesh.points)
    if kind == "T10":
        c = mesh.cells
        for k, (i, j) in enumerate(((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))):
            points[c[:, 4 + k]] = 0.5 * (points[c[:, i]] + points[c[:, j]])
    return b.add_solid(replace(mesh, points=points), material=material, element=element)


def plate(b, material, integration):
    mesh = wf.mesh.grid(tuple(SIZE[:2]), cells=(3, 2))
    return b.add_shell(
        replace(mesh, points=bulged(mesh.points)), thickness=0.02, integration=integration, material=material
    )


def bar(b, material, integration):
    line = [(x, 0.0, 0.0) for x in (0.0, 0.1, 0.16, 0.3)]
    options = {"section": wf.Rectangle(0.04, 0.03), "integration": integration, "material": material}
    return b.add_beam(line, elements=3, normal=(0, 0, 1), **options)


FAMILIES = {name: lambda b, m, name=name: solid(b, name, m) for name in ("T4", "T10", "ENMC", "FN", "FN18", "H3843")}
for integration in ("tied", "full"):
    FAMILIES[f"3443, {integration}"] = lambda b, m, how=integration: plate(b, m, how)
for integration in ("tied", "split", "full"):
    FAMILIES[f"3243, {integration}"] = lambda b, m, how=integration: bar(b, m, how)


@pytest.mark.parametrize("family", FAMILIES)
def test_uniform_pressure_on_a_flat_collider(family):
    pressure, _, _ = pressed(FAMILIES[family])
    assert np.ptp(pressure) < 1e-8 * pressure.mean()


def test_total_stiffness_does_not_depend_on_the_mesh():
    totals = []
    for cells in ((2, 2, 1), (4, 4, 2), (6, 6, 3)):
        _, depth, force = pressed(lambda b, m, cells=cells: solid(b, "T4", m, cells), stiffness="region")
        totals.append(force / depth.mean())
    assert np.ptp(totals) < 0.01 * totals[0]


@pytest.mark.parametrize("integration", ["full", "tied"])
def test_shells_are_uniform_without_contact(integration):
    """Between two equal loads the thickness of a plate of nu = 0.3 changes by the same at each node."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = plate(b, wf.SVK(E=1e6, nu=0.3, density=1000.0), integration)
    for sign in (1, -1):
        b.add_traction(flat_side(body, sign), (0, 0, sign * LOAD))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.02, solver=wf.NewtonPCG(tol=1e-10), record=False)
    sim.step(400)
    z = sim.state.displacement.numpy()[0, :, 2]
    stretch = z[np.abs(z) > 0.5 * np.abs(z).max()]  # of the gradients across the plate
    assert np.ptp(stretch) < 1e-8 * np.abs(stretch).mean()


def carried(turn, depth, cells):
    """Force on a cube of 0.1 m, N, turned by `turn`, at a depth, over its stiffness per area, N/m^3."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(cells,) * 3, element="T4", map=lambda X: X @ np.array(turn).T)
    body = b.add_solid(mesh, material=STIFF)
    contact = b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), stiffness="region")
    model = b.finalize(device="cpu")
    state = model.state()
    u = state.displacement.numpy()
    u[:, :, 2] = -depth - mesh.points[:, 2].min()
    state.displacement.assign(u)
    term = model.terms.find(ColliderContact)
    _, force = term.at_points(state)
    assert np.abs(force[0, :, :2]).max() == 0.0
    return force[0, :, 2].sum() * term.tables.host[0].area.sum() / contact_constants(contact)["normal_stiffness"]


def test_a_corner_and_an_edge_carry_what_their_area_says():
    r, s, t = 1 / math.sqrt(2), 1 / math.sqrt(3), 1 / math.sqrt(6)
    depth = 0.03
    corner = carried([[r, -r, 0.0], [t, t, -2.0 * t], [s, s, s]], depth, 16)
    assert corner == pytest.approx(1.5 * depth**3, rel=0.02)
    edge = carried([[r, -r, 0.0], [0.0, 0.0, -1.0], [r, r, 0.0]], depth, 16)
    ends = 2.0 * depth**3 / 3.0  # two triangles of area d^2 with a mean depth of d/3
    assert edge == pytest.approx(math.sqrt(2.0) * 0.1 * depth**2 + ends, rel=0.02)
