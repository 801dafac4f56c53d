"""Springs under every solver, with values per world, on both devices, resumed."""

import functools

import numpy as np
import pytest
from spring_models import CENTRE, EXACT, SCHEMES, cube, linked
from tight_solvers import SOLVERS

import warpfea as wf
from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint


@functools.cache
def motion(solver, scheme="bdf2"):
    model, (first, second) = linked()
    sim = wf.Simulation(model, dt=5e-3, integrator=scheme, solver=SOLVERS[solver], constraint_tol=1e-12)
    v = sim.state.velocity.numpy()
    v[0, model.slot_table.kind == 0, 1] = 0.5
    sim.state.velocity.assign(v)
    sim.step(20)
    return sim.state.displacement.numpy(), sim.totals["pcg"][0], sim.totals["newton"][0], sim.energies()


@pytest.mark.parametrize("solver", list(SOLVERS))
def test_solvers_agree(solver):
    expected, pcg, _, _ = motion("block-jacobi")
    found, own, newton, energies = motion(solver)
    assert np.abs(found - expected).max() < 1e-9 * np.abs(expected).max()
    assert abs(energies["ledger_residual"][0]) < 1e-9 * energies["kinetic"][0]
    if solver == "direct":
        assert own <= 1.2 * newton
    elif solver in ("banded", "two-level"):
        assert own < 0.7 * pcg


def test_stiff_springs_converge():
    """A spring far stiffer than the cube's own stiffness is in D and in the preconditioners."""
    b, body = cube(gravity=(0, 0, -9.81))
    b.add_spring((0.05, 0.05, 1.0), body.surface("z+"), stiffness=1e12, name="s")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(20)
    assert sim.totals["newton"][0] <= 60
    assert np.abs(sim.state.displacement.numpy()).max() < 1e-3


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_parameters_per_world(dtype):
    """A world with its own values is bit-equal to a run of its own; bad values are named."""
    values = {"s.stiffness": [100.0, 400.0, 50.0], "s.damping": [0.0, 2.0, 1.0], "s.rest": [0.03, 0.05, 0.02]}
    if dtype == "float64":
        six = np.arange(18.0).reshape(3, 6)
        values |= {"m.stiffness": 10.0 * six, "m.damping": 0.1 * six}

    def model(worlds):
        b, body = cube()
        b.add_spring((0.0, 0.05, 0.05), body.at(CENTRE), stiffness=1.0, name="s")
        if dtype == "float64":
            b.add_bushing(body.at(CENTRE), wf.GROUND, stiffness=1.0, damping=1.0, name="m")
        b.set_initial(body, velocity=(0.1, 1.0, 0.2))
        return b.finalize(device="cpu", dtype=dtype, worlds=worlds)

    many = model(3)
    for name, of_world in values.items():
        many.set_parameter(name, of_world)
    sim = wf.Simulation(many, dt=2e-3)
    sim.step(20)
    for world in range(3):
        own = model(1)
        for name, of_world in values.items():
            own.set_parameter(name, of_world[world])
        one = wf.Simulation(own, dt=2e-3)
        one.step(20)
        np.testing.assert_array_equal(sim.state.displacement.numpy()[world], one.state.displacement.numpy()[0])
    with pytest.raises(wf.ModelError, match="0 or more"):
        many.set_parameter("s.stiffness", -1.0)


def test_a_changed_parameter_does_work():
    """Stiffness doubled on the way: the energy that it adds is work of fields, none of the integrator's."""
    b, body = cube()
    b.add_spring((0.0, 0.05, 0.05), body.at(CENTRE), stiffness=100.0, rest=0.03, name="s")
    b.set_initial(body, velocity=(0.1, 1.0, 0.2))
    model = b.finalize(device="cpu", worlds=2)
    sim = wf.Simulation(model, dt=2e-3, integrator="energy_momentum", solver=EXACT)
    sim.step(20)
    before = sim.energies()
    model.set_parameter("s.stiffness", 200.0, mask=[True, False])
    sim.step(20)
    e = sim.energies()
    assert np.abs(e["integrator"]).max() < 1e-10
    np.testing.assert_allclose(e["work_fields"], [before["springs"][0], 0.0], rtol=1e-9)
    assert np.abs(e["ledger_residual"]).max() < 1e-10


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_devices_agree(scheme, dtype):
    """All kinds of springs and laws, and a point mass."""
    found = []
    for device in ("cpu", "cuda"):
        model = linked(dtype=dtype, device=device)[0]
        sim = wf.Simulation(model, dt=5e-3, integrator=scheme)
        sim.step(20)
        found.append(sim.state.displacement.numpy())
    assert np.abs(found[1] - found[0]).max() < (1e-6 if dtype == "float64" else 1e-2) * np.abs(found[0]).max()


def test_resumed_runs_go_on_bit_for_bit(tmp_path):
    model, _ = linked()
    whole = wf.Simulation(model, dt=5e-3)
    v = whole.state.velocity.numpy()
    v[0, model.slot_table.kind == 0, 1] = 0.5
    whole.state.velocity.assign(v)
    whole.step(6)
    save_checkpoint(whole, tmp_path / "c.npz")
    whole.step(6)
    resumed = wf.Simulation(linked()[0], dt=5e-3)
    load_checkpoint(resumed, tmp_path / "c.npz")
    resumed.step(6)
    for name, values in whole.state.numpy().items():
        np.testing.assert_array_equal(resumed.state.numpy()[name], values, err_msg=name)
    other, _ = linked(law="no foundation")
    with pytest.raises(wf.CheckpointError, match="another model"):
        load_checkpoint(wf.Simulation(other, dt=5e-3), tmp_path / "c.npz")
