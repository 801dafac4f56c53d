"""Thin bodies in contact by default: stacks of sheets, long beams and shells that lift off, press fits."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

import warpfea as wf

E, RHO, G = 1e9, 1000.0, 9.81


# stacks


@pytest.mark.parametrize("cells", [(2, 2, 2), (2, 3, 2)])
def test_pressure_passes_through_a_stack_of_sheets(cells):
    """Sheets of 1 mm under 1e-3 E: each yields as SVK's law in uniaxial strain says, each contact by a tenth of the
    sheets beside it."""
    side, t, p = 0.1, 1e-3, 1e-3 * E
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    sheets = []
    for k, n in enumerate(cells):
        mesh = wf.mesh.grid((side, side), cells=(n, n), origin=(0, 0, (k + 0.5) * t))
        sheets.append(b.add_shell(mesh, thickness=t, material=wf.SVK(E=E, nu=0.0, density=RHO), name=f"sheet {k}"))
        for edge, axis in (("x-", "x"), ("y-", "y")):
            b.clamp(sheets[-1].edge(edge), slots="position", components=axis)
    contacts = [b.add_contact(sheets[0], b.add_collider(wf.HalfSpace((0, 0, 1))))]
    contacts += [b.add_contact(upper, lower) for lower, upper in itertools.pairwise(sheets)]
    b.add_pressure(sheets[-1].surface("top"), p)
    b.add_probe("top", sheets[-1].surface("top"))
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=1, stabilise=True)
    for contact in contacts:
        assert result.contact_force(contact)[0, 2] == pytest.approx(p * side**2, rel=1e-7)
    stretch = max(np.roots([0.5, 0.0, -0.5, p / E]).real)  # stress (s^3 - s)/2 = -p/E
    penetration = p / E * t / 10.0 * (2 * len(cells) - 1)
    assert -result.probe("top").displacement[0, -1, 2] == pytest.approx(
        len(cells) * t * (1.0 - stretch) + penetration, rel=1e-3
    )
    matching = len(set(cells)) == 1
    for sheet in sheets:
        pressure = result.field("contact_pressure", sheet)
        assert pressure == pytest.approx(np.full(pressure.shape, p), rel=0.05 if matching else 0.15)


# long beams and shells that lift off


def strip(b: wf.ModelBuilder, kind: str, elements: int) -> tuple[Any, Any, Any, float, float]:
    """A strip of 10 m and a thickness of 5 cm on z = 0: body, its end and lower face, weight, N/m, and E I, N m^2."""
    length, side, width, material = 10.0, 0.05, 0.1, wf.SVK(E=E, nu=0.3, density=RHO)
    if kind == "beam":
        line = [(0, 0, 0.5 * side), (length, 0, 0.5 * side)]
        section = wf.Rectangle(side, side)
        body = b.add_beam(line, elements=elements, section=section, normal=(0, 0, 1), material=material)
        start, end, lower, width = body.start, body.end, body.surface("normal-"), side
    else:
        mesh = wf.mesh.grid((length, width), cells=(elements, 1), origin=(0, 0, 0.5 * side))
        body = b.add_shell(mesh, thickness=side, material=material)
        start, end, lower = body.edge("x-"), body.edge("x+"), body.surface("bottom")
    b.clamp(start, slots="position", components="xy")
    b.clamp(end, slots="position", components="y")
    return body, end, lower, RHO * G * width * side, E * width * side**3 / 12.0


@pytest.mark.parametrize(("kind", "elements", "mu", "most"), [
    ("beam", 100, 0.0, 150), pytest.param("beam", 400, 0.0, 400, marks=pytest.mark.slow),
    pytest.param("shell", 200, 0.0, 150, marks=pytest.mark.slow),
    pytest.param("shell", 200, 0.5, 400, marks=pytest.mark.slow),
])  # fmt: skip
def test_a_heavy_strip_is_lifted_at_its_end(kind, elements, mu, most):
    """It lifts off over L: without curvature at the border the end carries q L/2 and rises by q L^4/(24 E I). Before,
    50 elements did not converge."""
    rise = 0.2
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body, end, lower, q, EI = strip(b, kind, elements)
    b.drive(end, displacement=([0, 1], [(0, 0, 0), (0, 0, rise)]), components="z")
    pad = b.add_contact(lower, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=mu)
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=2, stabilise=True)
    L = (24.0 * EI * rise / q) ** 0.25
    assert result.contact_force(pad)[0, 2] == pytest.approx(q * (10.0 - 0.5 * L), rel=1e-3)
    x = np.maximum(body.mesh.points[:, 0] - (10.0 - L), 0.0)
    lifted = result.displacements(body)[0, :, 2]
    assert lifted == pytest.approx(q / (24.0 * EI) * (2.0 * L * x**3 - x**4), abs=2e-3 * rise)
    assert result.newton[0] <= most


MANY = [("beam", 100), pytest.param("beam", 400, marks=pytest.mark.slow),
        pytest.param("shell", 200, marks=pytest.mark.slow)]  # fmt: skip


@pytest.mark.parametrize(("kind", "elements"), MANY)
def test_a_strip_lifts_off_behind_the_edge_where_its_end_is_pressed(kind, elements):
    """It overhangs a table by s: L = 2 sqrt((F s + q s^2/2)/q) lifts off behind the edge, and the tip sinks by
    (q L^3 s/24 + F s^3/3 + q s^4/8)/(E I). Before, 100 elements did not converge."""
    s, F = 1.0, 5.0
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body, end, lower, q, EI = strip(b, kind, elements)
    tip = body.mesh.points[:, 0] > 10.0 - 1e-9
    for point in body.mesh.points[tip]:
        b.add_point_load(body.at(point), force=(0, 0, -F / tip.sum()))
    table = b.add_collider(wf.Box((0.0, 0.0, -0.5), (2.0 * (10.0 - s), 4.0, 1.0)))
    pad = b.add_contact(lower, table)
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=2, stabilise=True)
    assert result.contact_force(pad)[0, 2] == pytest.approx(10.0 * q + F, rel=1e-7)
    L = 2.0 * math.sqrt((F * s + 0.5 * q * s**2) / q)
    sunk = (q * L**3 * s / 24.0 + F * s**3 / 3.0 + q * s**4 / 8.0) / EI
    moved = result.displacements(body)[0, :, 2]
    assert -moved[tip].mean() == pytest.approx(sunk, rel=5e-3)
    X = np.linspace(0.0, L, 1001)
    assert moved.max() == pytest.approx((q * L / 24.0 * X**3 - q * X**4 / 24.0).max() / EI, rel=1e-2)
    assert result.newton[0] <= 80


# press fits

A, B, C, DELTA = 0.05, 0.1, 0.15, 1e-4
"""Inner radius, radius of the fit, outer radius, interference, m."""


def ring(b: wf.ModelBuilder, kind: str, radii: tuple[float, float], elements: int, name: str) -> Any:
    """A ring of T10 (a quarter) or of H3843, 2 cm wide, free along its axis; of two elements over its thickness."""
    whole = kind == "H3843"
    turn, n = (2.0 * math.pi if whole else 0.5 * math.pi), 4 * elements if whole else elements
    base = wf.mesh.box((1, 1, 1), cells=(2, n, 1), element=kind)
    points, cells = base.points, base.cells
    if whole:
        key = np.round(points * (2, n, 1)).astype(int) % (3, n, 2)
        _, first, number = np.unique(key, axis=0, return_index=True, return_inverse=True)
        points, cells = points[first], number.ravel()[cells]
    radius, angle = radii[0] + (radii[1] - radii[0]) * points[:, 0], turn * points[:, 1]
    X = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.02 * points[:, 2]])
    options = {"element": kind} if whole else {}
    body = b.add_solid(
        wf.mesh.Mesh(X, cells, base.cell_type), material=wf.SVK(E=E, nu=0.3, density=RHO), name=name, **options
    )
    for axis, component in enumerate("xyz"):  # symmetry
        b.clamp(body.nodes(lambda X, k=axis: np.abs(X[:, k]) < 1e-9), slots="position", components=component)
    return body


@pytest.mark.filterwarnings("ignore:.*it is stored as an offset")
@pytest.mark.parametrize(
    ("kind", "elements", "error"), [("T10", (6, 6), 0.003), ("T10", (6, 8), 0.005), ("H3843", (6, 6), 0.003)]
)
def test_a_press_fit_has_the_pressure_of_lame(kind, elements, error):
    """In series with the contact, which yields by a tenth of the elements beside it (1 %); 24 % less with
    "region". H3843 have straight edges: polygons of unlike corners overlap by more than the interference."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    inner = ring(b, kind, (A, B + DELTA), elements[0], "inner")
    outer = ring(b, kind, (B, C), elements[1], "outer")

    def at_fit(body: Any) -> Any:
        return body.surface(lambda X: np.abs(np.hypot(X[:, 0], X[:, 1]) - B) < 2e-3)

    fit = b.add_contact(at_fit(inner), at_fit(outer))
    result = wf.solve_static(b.finalize(device="cpu"))
    lame = E * DELTA / B * (C**2 - B**2) * (B**2 - A**2) / (2.0 * B**2 * (C**2 - A**2))
    yielding = 2.0 * 0.025 * (1.0 - 0.3**2) / E / 10.0
    area = (1.0 if kind == "H3843" else 0.25) * 2.0 * math.pi * B * 0.02
    pressure = result.contact_record(fit).normal_force[0, -1] / area
    assert pressure == pytest.approx(1.0 / (1.0 / lame + yielding / DELTA), rel=error)
    X, u = outer.mesh.points, result.displacements(outer)[0]
    rim = np.abs(np.hypot(X[:, 0], X[:, 1]) - C) < 1e-3
    widened = np.linalg.norm((X + u)[rim, :2], axis=1) - np.linalg.norm(X[rim, :2], axis=1)
    assert widened.mean() == pytest.approx(pressure * 2.0 * B**2 * C / (C**2 - B**2) / E, rel=0.015)
