"""Many worlds: each equals its own run bit for bit; the step neither allocates nor reads back."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

GRAVITIES = np.array([(0.0, 0.0, -9.81), (0.0, 3.0, -1.0), (5.0, 0.0, 0.0)])


def builder(clamped=True):
    b = wf.ModelBuilder()
    kelvin = wf.KelvinVoigt(50.0, 75.0)
    material = wf.SVK(E=1e5, nu=0.3, density=1000.0, damping=kelvin)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1)), material=material)
    if clamped:
        b.clamp(body.nodes("x-"))
    b.add_pressure(body.surface("z+"), 20.0)
    b.add_probe("tip", body.surface("x+"))
    return b


def rows(sim, world):
    return {name: values[world].tobytes() for name, values in sim.state.numpy().items() if name != "status"}


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"])
def test_each_world_equals_its_own_run(integrator):
    model = builder().finalize(device="cpu", worlds=3)
    model.set_gravity(GRAVITIES)
    sim = wf.Simulation(model, dt=5e-3, integrator=integrator)
    sim.step(4)
    sim.freeze([1])
    sim.step(6)
    for world, steps in ((0, 10), (1, 4), (2, 10)):
        single = builder().finalize(device="cpu")
        single.set_gravity(GRAVITIES[world])
        alone = wf.Simulation(single, dt=5e-3, integrator=integrator)
        alone.step(steps)
        assert rows(sim, world) == rows(alone, 0), world
    assert list(sim.status) == [0, 2, 0]


def test_a_failing_world_is_frozen_and_the_others_go_on():
    b = wf.ModelBuilder(gravity=(0, 0, -1.0))
    soft = wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.4, 0.4), cells=(2, 1, 1)), material=soft)
    b.clamp(body.nodes("x-"))
    model = b.finalize(device="cpu", worlds=2)
    model.set_gravity([(0, 0, -1.0), (-1e7, 0, 0)])
    sim = wf.Simulation(model, dt=1e-2, solver=wf.NewtonPCG(max_halvings=1))
    report = sim.step(3)
    assert list(report.status) == [0, 1]
    assert list(report.converged) == [True, False]
    assert sim.time == pytest.approx([0.03, 0.0])
    assert np.all(sim.displacements(body)[1] == 0.0)
    sim.reset([False, True])
    assert list(sim.status) == [0, 0]


def test_step_neither_allocates_nor_reads_back(monkeypatch):
    sim = wf.Simulation(builder().finalize(device="cpu"), dt=5e-3)
    sim.step(2)
    made, read = [], []
    original = wp.array.__init__
    monkeypatch.setattr(wp.array, "__init__", lambda self, *a, **k: (made.append(1), original(self, *a, **k))[1])
    numpy = wp.array.numpy
    monkeypatch.setattr(wp.array, "numpy", lambda self: (read.append(self.shape), numpy(self))[1])
    report = sim.stepper.work.report.shape
    sim.step(3)
    assert made == []
    assert read == [report] * 3


def test_captured_and_plain_launches_agree():
    results = []
    for capture in (True, False):
        sim = wf.Simulation(builder().finalize(device="cpu"), dt=5e-3, capture=capture)
        sim.step(3)
        results.append(rows(sim, 0))
    assert results[0] == results[1]


def test_a_registered_array_is_known_everywhere(tmp_path):
    model = builder().finalize(device="cpu")
    state = model.state()
    state.register("dummy", wp.float64, (3,), 7.0)
    sim = wf.Simulation(model, state, dt=5e-3)
    sizes = sim.bytes()
    assert sizes["state.dummy"] == 24
    assert sizes["backup.dummy"] == 24
    state.dummy.fill_(1.0)
    sim.step()
    from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint

    save_checkpoint(sim, tmp_path / "c.npz")
    assert np.all(np.load(tmp_path / "c.npz", allow_pickle=False)["state.dummy"] == 1.0)
    state.dummy.fill_(2.0)
    load_checkpoint(sim, tmp_path / "c.npz")
    assert np.all(state.dummy.numpy() == 1.0)
    sim.reset()
    assert np.all(state.dummy.numpy() == 7.0)


def test_sums_over_rows_longer_than_a_chunk():
    """More slots than one block sums: energies and norms must not see leftovers of other sums."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((3, 2, 1), cells=(14, 10, 6)), material=wf.SVK(E=7e8, nu=0.33, density=2700.0))
    b.clamp(body.nodes("x-"))
    b.add_point_load(body.nodes("x+"), (5000.0, 0, 0))
    model = b.finalize(device="cpu")
    assert model.slots > 4096
    sim = wf.Simulation(model, dt=1e-3)
    report = sim.step()
    assert report.converged.all()
    assert report.residual[0] < 1e-8
    assert sim.energies()["strain"][0] == pytest.approx(model.strain_energy(sim.state)[0], rel=1e-12)
    assert sim.energies()["viscous"][0] == 0.0
