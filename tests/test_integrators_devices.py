"""Every integrator on both devices and in both precisions, beside a run on the CPU in float64 with a direct solver."""

import functools
import math

import numpy as np
import pytest
from pairwise import on_devices

import warpfea as wf

INTEGRATORS = ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha(rho_inf=0.8)"]
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
FAMILIES = ["T10", "3243", "T4", "ENMC", "FN18", "H3843", "3443", "neo-Hookean"]
"""All on a GPU, the first two on the CPU."""
BARS = {"float64": 1e-7, "float32": 2e-4}
STEPS = 20


def swing(family):
    """A bar that is let go on a hinge, over a floor that it does not reach in these steps."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0)
    box = wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1))
    if family == "3243":
        body = b.add_beam([(0, 0, 0), (0.4, 0, 0)], elements=4, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1),
                          material=law)  # fmt: skip
    elif family == "3443":
        body = b.add_shell(wf.mesh.grid((0.4, 0.1), cells=(4, 1)), thickness=0.05, material=law)
    elif family == "neo-Hookean":
        body = b.add_solid(box, material=wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0), element="T10")
    else:
        kind = family if family in ("ENMC", "H3843") else "T4"
        mesh = box if family == "T10" else wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1), element=kind)
        body = b.add_solid(mesh, material=law, element=family)
    start = body.start if family == "3243" else body.edge("x-") if family == "3443" else body.surface("x-")
    b.add_joint("revolute", parent=wf.GROUND, child=start, axis=(0, 1, 0))
    b.add_probe("tip", body.end if family == "3243" else body.edge("x+") if family == "3443" else body.surface("x+"))
    return b


def run(family, integrator, device, dtype, **options):
    solver = wf.NewtonPCG(tol=None if dtype == "float32" else 1e-10, linear=options.pop("linear", "pcg"))
    model = swing(family).finalize(device=device, dtype=dtype, worlds=options.pop("worlds", 1))
    options.setdefault("dt", 2e-3)
    sim = wf.Simulation(model, integrator=integrator, solver=solver, **options)
    sim.run(t_end=STEPS * 2e-3)
    return sim


@functools.cache
def expected(family, integrator):
    sim = run(family, integrator, "cpu", "float64", linear="direct")
    return sim.probe("tip").displacement[0]


@pytest.mark.parametrize(
    ("device", "family", "integrator", "dtype"),
    on_devices(FAMILIES[:2], INTEGRATORS, BARS, cuda=(FAMILIES, INTEGRATORS, BARS)),
)
def test_tip_of_a_swinging_bar(family, integrator, device, dtype):
    sim = run(family, integrator, device, dtype)
    tip, right = sim.probe("tip").displacement[0], expected(family, integrator)
    assert np.abs(tip - right).max() <= BARS[dtype] * np.abs(right).max()
    e = {name: float(value[0]) for name, value in sim.energies().items()}
    assert abs(e["ledger_residual"]) <= BARS[dtype] * e["kinetic"]
    if integrator == "energy_momentum":
        assert abs(e["integrator"]) <= BARS[dtype] * e["kinetic"]


@pytest.mark.parametrize("dtype", BARS)
@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2"])
def test_adaptive_steps(integrator, device, dtype):
    """Worlds take their own steps, bit for bit those of single runs, and errors are as asked."""
    error = 1e-3
    gravities = [(0, 0, -9.81), (0, 0, 0.0), (0, 0, -2.0)]

    def simulate(chosen):
        model = swing("T10").finalize(device=device, dtype=dtype, worlds=len(chosen))
        model.set_gravity(chosen)
        sim = wf.Simulation(model, dt="auto", error=error, integrator=integrator)
        sim.run(t_end=STEPS * 2e-3)
        return sim

    sim = simulate(gravities)
    for world, g in enumerate(gravities):
        alone = simulate([g])
        assert alone.totals["substeps"][0] == sim.totals["substeps"][world]
        for name, values in alone.state.numpy().items():
            np.testing.assert_array_equal(values[0], sim.state.numpy()[name][world], err_msg=name)
    size = sim.model.size
    fine = run("T10", "bdf2", "cpu", "float64", dt=1.25e-4).probe("tip").displacement[0, -1]
    assert np.abs(sim.probe("tip").displacement[0, -1] - fine).max() <= 5.0 * error * size
    assert math.isclose(float(sim.time[0]), STEPS * 2e-3, rel_tol=1e-12)
