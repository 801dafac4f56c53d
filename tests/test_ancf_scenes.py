"""Scenes of beams, shells and ANCF solids: they build, run and do what mechanics says; their outputs."""

from __future__ import annotations

import pathlib

import numpy as np
import pytest
from scene_runs import scene_simulation

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.outputs.usd import validate_usd

ROOT = pathlib.Path(__file__).resolve().parent.parent
COARSE = {
    "pendulum": {"elements": 3},
    "plate_pendulum": {"cells": 2},
    "rollup": {"elements": 4},
    "spin": {"cells": (2, 1, 1)},
    "mixed": {"cells": 1},
}


def simulate(name, t_end=None, steps=None, dt=None, **parameters):
    """A scene at its own settings, run to t_end or for some steps."""
    sim = scene_simulation(name, dt, **parameters)
    if steps:
        for _ in range(steps):
            assert sim.step().converged.all()
    else:
        sim.run(t_end)
    return sim


@pytest.mark.parametrize("name", COARSE)
def test_scenes_are_described_and_build(name):
    scene = find(name)
    assert scene.description.endswith(".")
    assert all(p.doc and not p.required for p in scene.parameters.values())
    builder = scene()
    assert builder.description.probes
    assert scene.picture is None or scene.picture < scene.t_end


@pytest.mark.parametrize("name", COARSE)
def test_scenes_run_a_few_steps_on_coarse_meshes(name):
    sim = simulate(name, steps=3, **COARSE[name])
    energies = sim.energies()
    assert abs(energies["ledger_residual"][0]) < 1e-3 * max(abs(energies["kinetic"][0]), energies["strain"][0])


def test_integrations_are_parameters_of_scenes():
    for name, value in (("pendulum", "split"), ("pendulum", "full"), ("rollup", "split"), ("plate_pendulum", "full")):
        assert find(name)(integration=value).bodies[0].rule == value


def test_pendulum_loses_no_more_energy_than_bdf2_takes():
    lost = []
    for dt in (5e-3, 2.5e-3):
        sim = simulate("pendulum", t_end=0.5, dt=dt, elements=6)
        e = {name: float(value[0]) for name, value in sim.energies().items()}
        balance = e["kinetic"] + e["strain"] + e["potential"]
        assert e["integrator"] == pytest.approx(-balance, rel=1e-4)
        lost.append(-balance / -e["potential"])
    assert 0.0 < lost[1] < 0.005
    assert lost[0] > 2.0 * lost[1]
    y = sim.positions(sim.model.bodies[0])[0]
    assert np.abs(y[:, 1]).max() < 1e-9
    assert np.linalg.norm(y[0]) < 1e-12


def test_plate_pendulum_stays_symmetric():
    """About the diagonal plane through the pin."""
    sim = simulate("plate_pendulum", t_end=0.2, cells=3)
    plate = sim.model.bodies[0]
    x = sim.positions(plate)[0].reshape(4, 4, 3)
    tip = sim.probe("tip")
    np.testing.assert_allclose(x, x.transpose(1, 0, 2)[..., [1, 0, 2]], atol=1e-4)
    assert tip.displacement[0, -1, 2] < -0.05
    assert np.linalg.norm(sim.positions(plate)[0, 0]) < 1e-12


def test_rollup_closes_the_circle():
    """By Euler's theory the end returns to the start; strains of 6 % and 22 degrees per element leave a little."""
    model = find("rollup")(elements=16, duration=1.0, eta=0.0).finalize(device="cpu")
    result = wf.solve_static(model, load_steps=8, tol=1e-6)
    end = result.probe("end").position[0, -1]
    middle = result.probe("middle").position[0, -1]
    assert np.linalg.norm(end) < 0.06
    assert middle[2] == pytest.approx(1.0 / np.pi, rel=0.05)
    assert end[1] == 0.0


def test_rollup_of_full_integration_stays_open():
    model = find("rollup")(elements=16, duration=1.0, eta=0.0, integration="full").finalize(device="cpu")
    result = wf.solve_static(model, load_steps=8, tol=1e-6)
    assert np.linalg.norm(result.probe("end").position[0, -1]) > 0.2


def spin_momenta(sim):
    """Linear and angular momentum from the mass matrix and all slots."""
    model = sim.model
    body = model.bodies[0]
    mass = model.mass_matrix()[::3, ::3]
    u, v = (array.numpy()[0] for array in (sim.state.displacement, sim.state.velocity))
    x = body.reference + u
    p = mass @ v
    linear = p[body.slot_kind == 0].sum(axis=0)
    return linear, np.sum(np.cross(x, p), axis=0)


def test_spin_of_a_stiff_body_loses_what_bdf2_takes():
    """|amplitude| of BDF2 on an oscillation is 1 - (rate dt)^4 / 4 per step; angular momentum goes with its square."""
    rate, dt = 18.0, 4e-3
    sim = simulate("spin", t_end=0.08, cells=(2, 1, 1), E=1e7)  # past the first step, of backward Euler, and its waves
    _, before = spin_momenta(sim)
    sim.run(0.8)
    linear, after = spin_momenta(sim)
    drift = np.linalg.norm(after - before) / np.linalg.norm(before)
    assert drift == pytest.approx(2.0 * rate**4 * dt**3 / 4.0 * 0.72, rel=0.25)
    assert np.abs(linear).max() < 1e-6 * sim.model.info()["mass"]


def test_spin_keeps_its_momenta_better_with_smaller_steps():
    drift = []
    for dt in (4e-3, 2e-3):
        sim = simulate("spin", steps=1, dt=dt, cells=(2, 1, 1))
        _, before = spin_momenta(sim)
        sim.run(0.4)
        linear, after = spin_momenta(sim)
        drift.append(np.linalg.norm(after - before) / np.linalg.norm(before))
        assert np.abs(linear).max() < 1e-6 * sim.model.info()["mass"]
    assert drift[0] < 0.01
    assert drift[0] > 3.0 * drift[1]


def test_spin_turns_over():
    sim = simulate("spin", t_end=0.5, cells=(4, 2, 1))
    body = sim.model.bodies[0]
    X, x = body.mesh.points, sim.positions(body)[0]
    axis = x[X[:, 1] > 0.01].mean(axis=0) - x[X[:, 1] < -0.01].mean(axis=0)
    assert axis[1] / np.linalg.norm(axis) < -0.5


def test_mixed_tips_move_together():
    sim = simulate("mixed", t_end=0.2, dt=0.01)
    z = np.array([sim.probe(name).displacement[0, :, 2] for name in ("beam", "shell", "ENMC", "H3843", "T10")])
    assert z.min() < -0.1
    assert np.abs(z - z.mean(axis=0)).max() < 0.05 * abs(z.min())
    solids = z[2:]
    assert np.abs(solids - solids.mean(axis=0)).max() < 0.02 * abs(z.min())


# outputs


def hexahedra_volume(points, cells):
    """Sum of six tetrahedra each."""
    tets = cells[:, [[0, 1, 3, 4], [1, 2, 3, 6], [1, 3, 4, 6], [1, 4, 5, 6], [3, 4, 6, 7]]].reshape(-1, 4)
    a, b, c, d = np.moveaxis(points[tets], 1, 0)
    return float(np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)).sum() / 6.0)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A few steps of a beam and a shell, to USD and VTU."""
    folder = tmp_path_factory.mktemp("ancf")
    for name in ("pendulum", "plate_pendulum"):
        scene = find(name)
        sim = wf.Simulation(scene(**COARSE[name]).finalize(device="cpu"), dt=0.01, integrator=scene.integrator)
        sim.run(0.05, outputs=[wf.USDWriter(folder / f"{name}.usdc"), wf.VTUWriter(folder / name)])
    return folder


@pytest.mark.parametrize(("name", "lengths"), [("pendulum", (1.0, 0.02, 0.02)), ("plate_pendulum", (0.5, 0.5, 0.01))])
def test_outputs_of_beams_and_shells_have_their_volume(written, name, lengths):
    import meshio

    assert not validate_usd(str(written / f"{name}.usdc"))
    frames = sorted((written / name).glob("*.vtu"))
    assert len(frames) >= 5
    mesh = meshio.read(frames[-1])
    (block,) = mesh.cells
    assert block.type == "hexahedron"
    volume = float(np.prod(lengths))
    reference = mesh.points - mesh.point_data["displacement"]
    assert hexahedra_volume(reference, block.data) == pytest.approx(volume, rel=1e-9)
    assert hexahedra_volume(mesh.points, block.data) == pytest.approx(volume, rel=0.02)
    assert np.isfinite(mesh.point_data["von_mises"]).all()
