"""Scenes as tests run them: at their own settings, on the CPU."""

from __future__ import annotations

import warpfea as wf
from warpfea.builder.scene import find


def scene_simulation(name, dt=None, **parameters):
    """A scene at its start, by default with its own step."""
    scene = find(name)
    model = scene(**parameters).finalize(device="cpu")
    solver = wf.NewtonPCG(tol=scene.tol)
    return wf.Simulation(model, dt=dt or scene.dt, integrator=scene.integrator, solver=solver)


def run_contact_scene(name, t_end=None, *, work="work", **parameters):
    """One with contact until t_end, with every step converged and its ledger closed; `work`: what its drives do."""
    scene = find(name)
    sim = scene_simulation(name, **parameters)
    for _ in range(round((t_end or scene.t_end) / scene.dt)):
        assert sim.step().converged.all()
    e = sim.energies()
    scale = max(abs(e[name][0]) for name in ("kinetic", "potential", "contact_loss", work))
    assert abs(e["ledger_residual"][0]) < 10.0 * scene.tol * scale
    return sim
