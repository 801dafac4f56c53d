"""Cures that a StabilityWarning names lead to a stable, buckled equilibrium; a static solve from the mode may not."""

import dataclasses
import warnings

import numpy as np
import pytest

import warpfea as wf


def column(dtype, across):
    """A cantilever beam under 1.1 of Euler's load."""
    law = wf.SVK(E=2e9, nu=0.0, density=1000.0, damping=wf.KelvinVoigt(eta=1e6))
    load = 1.1 * np.pi**2 * 2e9 * 0.075 * 0.05**3 / 12.0 / 4.0
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    section = wf.Rectangle(0.075, 0.05)
    body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=8, section=section, normal=(0, 0, 1), material=law)
    b.clamp(body.start, slots="position+section")
    b.add_point_load(body.end, (-load, 0, across * load))
    return b.finalize(device="cpu", dtype=dtype), body


def plate(dtype, across, imperfection=0.0):
    """A simply supported plate of 4 x 4 shells under 1.5 of Bryan's load."""
    thick, nu = 0.01, 0.3
    load = 1.5 * 4.0 * np.pi**2 * 2e11 * thick**3 / 12.0 / (1.0 - nu**2)
    law = wf.SVK(E=2e11, nu=nu, density=7850.0, damping=wf.KelvinVoigt(eta=2e8))
    mesh = wf.mesh.grid((1, 1), cells=(4, 4))
    points = np.column_stack([mesh.points, np.zeros((len(mesh.points), 3 - mesh.points.shape[1]))]) + imperfection
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_shell(dataclasses.replace(mesh, points=points), thickness=thick, material=law)
    for edge, components in (("x-", "xz"), ("x+", "z"), ("y-", "yz"), ("y+", "z")):
        b.clamp(body.edge(edge), components=components, slots="position")
    b.add_traction(body.surface("x+"), (-load / thick, 0, 0))
    if across:
        b.add_point_load(body.at((0.5, 0.5, 0)), (0, 0, across * load))
    return b.finalize(device="cpu", dtype=dtype), body


def solve(model, body, **options):
    """The static result, and its largest displacement across, m."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wf.StabilityWarning)
        found = wf.solve_static(model, **options)
    return found, np.abs(found.displacements(body)[0, :, 2]).max()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize(("make", "deflection"), [(column, 0.521), (plate, 0.01706)])
def test_cures_lead_to_the_buckled_state(make, deflection, dtype):
    model, body = make(dtype, 0.0)
    straight, _ = solve(model, body)
    assert straight.report.stable.tolist() == [False]
    size = 1e-3 * model.size
    sim = wf.Simulation(model, straight.perturbed(size), dt=0.02)
    sim.step(300)
    found = [solve(model, body, state=sim.state, load_steps=1), solve(*make(dtype, 1e-3))]
    if make is plate:
        found.append(solve(*plate(dtype, 0.0, size * straight.mode(body)[0])))
    for k, (result, largest) in enumerate(found):
        assert result.report.stable.tolist() == [True]
        assert largest == pytest.approx(deflection, rel=0.04 if k else 1e-3)


def test_the_warning_says_that_statics_from_the_mode_may_return():
    """101 iterations from 1e-3 m back to the straight column."""
    model, body = column("float64", 0.0)
    with pytest.warns(wf.StabilityWarning, match=r"r\.perturbed\(0\.001\) \(a static solve from there may return"):
        straight = wf.solve_static(model)
    again, largest = solve(model, body, state=straight.perturbed(1e-3), load_steps=1)
    assert again.report.stable.tolist() == [largest > 0.1]
