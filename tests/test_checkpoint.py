"""Checkpoints: a resumed run equals the undisturbed one bit for bit; what does not fit is refused by name."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.simulation.checkpoint import Checkpoint, load_checkpoint, read_meta, save_checkpoint

DAMPED = wf.KelvinVoigt(eta=2e4, lambda_v=1e4)


def bar(
    *,
    damping=None,
    E=1e7,
    cells=2,
    gravity=(0, 0, -9.81),
    probe="tip",
    dtype="float64",
    worlds=1,
    pull=200,
    clamp="xyz",
):
    b = wf.ModelBuilder(gravity=gravity)
    material = wf.SVK(E=E, nu=0.3, density=1000.0, damping=damping)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(cells, 1, 1)), material=material)
    b.clamp(body.nodes("x-"), components=clamp)
    b.add_traction(body.surface("x+"), ([0, 0.02, 0.2], [(0, 0, 0), (0, 300, 0), (0, 0, pull)]))
    b.add_probe(probe, body.surface("x+"))
    return b.finalize(device="cpu", dtype=dtype, worlds=worlds)


def everything(sim):
    """All that a run leaves: state, probe records, totals."""
    record = sim.probe("tip")
    out = {f"state.{name}": values.copy() for name, values in sim.state.numpy().items()}
    out |= {f"probe.{name}": getattr(record, name) for name in ("time", "position", "displacement", "velocity")}
    out |= {f"total.{name}": values for name, values in sim.totals.items()}
    out |= {f"energy.{name}": values for name, values in sim.energies().items()}
    return out | {"steps": np.array(sim.steps), "max_residual": np.array(sim.max_residual)}


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A checkpoint of the bar after three steps, and the simulation that made it."""
    path = tmp_path_factory.mktemp("checkpoint") / "bar.npz"
    sim = wf.Simulation(bar(), dt=2e-3)
    sim.step(3)
    save_checkpoint(sim, path)
    return path, sim


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"])
@pytest.mark.parametrize("damping", [None, DAMPED], ids=["elastic", "damped"])
def test_a_resumed_run_equals_the_undisturbed_one(tmp_path, integrator, damping):
    path = tmp_path / "bar.npz"
    whole = wf.Simulation(bar(damping=damping), dt=2e-3, integrator=integrator)
    whole.run(0.024)
    first = wf.Simulation(bar(damping=damping), dt=2e-3, integrator=integrator)
    first.run(0.01, outputs=[Checkpoint(path, every=2)])
    second = wf.Simulation(bar(damping=damping), dt=2e-3, integrator=integrator)
    second.resume(path)
    assert second.steps == 5
    second.run(0.024)
    expected, found = everything(whole), everything(second)
    assert expected.keys() == found.keys()
    for name, values in expected.items():
        np.testing.assert_array_equal(found[name], values, err_msg=name, strict=True)
    assert found["probe.time"].shape == (12,)


def test_a_resumed_run_in_contact_equals_the_undisturbed_one(tmp_path):
    """First iterates are judged by an energy that contact has a part in."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.NeoHookean.from_E_nu(E=1e5, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(10.0))
    body = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), origin=(0, 0, 1e-3)), material=law)
    b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), mu=0.3, restitution=0.3)
    model = b.finalize(device="cpu")
    whole, first, second = (wf.Simulation(model, dt=2e-3) for _ in range(3))
    whole.step(40)
    first.step(20)
    save_checkpoint(first, tmp_path / "half.npz")
    second.resume(tmp_path / "half.npz")
    second.step(20)
    ahead, values = whole.state.numpy(), second.state.numpy()
    assert all(np.array_equal(ahead[name], values[name], equal_nan=True) for name in ahead)


def test_a_resumed_run_crosses_a_refused_step(tmp_path):
    """Steps that are halved leave nothing behind that a checkpoint would miss."""
    solver = wf.NewtonPCG(max_newton=3)
    path = tmp_path / "bar.npz"
    whole, first, second = (wf.Simulation(bar(E=2e5), dt=0.05, solver=solver, integrator="bdf2") for _ in range(3))
    halved = [int(whole.step().halvings[0]) for _ in range(6)]
    assert max(halved) > 0
    first.step(3)
    save_checkpoint(first, path)
    second.resume(path)
    second.step(3)
    for name, values in everything(whole).items():
        np.testing.assert_array_equal(everything(second)[name], values, err_msg=name)


def test_worlds_are_kept_apart(tmp_path):
    path = tmp_path / "bar.npz"
    gravity = [(0, 0, -9.81), (0, -5.0, 0), (1.0, 0, 0)]
    sims = []
    for _ in range(3):
        model = bar(worlds=3)
        model.set_gravity(gravity)
        sims.append(wf.Simulation(model, dt=2e-3))
    whole, first, second = sims
    for sim in (whole, first):
        sim.step(2)
        sim.freeze([1])
    whole.step(4)
    first.step(2)
    save_checkpoint(first, path)
    second.resume(path)
    assert second.status.tolist() == [0, 2, 0]
    second.step(2)
    for name, values in everything(whole).items():
        if not name.startswith("total"):
            np.testing.assert_array_equal(everything(second)[name], values, err_msg=name)


def test_a_failure_after_resuming_is_raised(tmp_path):
    """The status of a failed step is not taken for one that had failed before."""
    path = tmp_path / "bar.npz"
    solver = wf.NewtonPCG(max_newton=1, max_halvings=0)
    sim = wf.Simulation(bar(E=2e5), dt=0.05, solver=solver)
    with pytest.raises(wf.ConvergenceError):
        sim.step()
    save_checkpoint(sim, path)
    again = wf.Simulation(bar(E=2e5), dt=0.05, solver=solver)
    again.resume(path)
    with pytest.raises(wf.ConvergenceError):
        again.step()


def test_registered_arrays_are_kept(tmp_path):
    """A checkpoint loops over the registry: an array of a later feature needs no line here."""
    path = tmp_path / "bar.npz"
    sims = []
    for _ in range(2):
        model = bar()
        state = model.state()
        state.register("dummy", wp.float64, (3,), 7.0)
        sims.append(wf.Simulation(model, state, dt=2e-3))
    sims[0].state.dummy.assign(np.array([[1.0, 2.0, 3.0]]))
    save_checkpoint(sims[0], path)
    sims[1].resume(path)
    assert sims[1].state.dummy.numpy().tolist() == [[1.0, 2.0, 3.0]]
    with pytest.raises(wf.CheckpointError, match="dummy"):
        wf.Simulation(bar(), dt=2e-3).resume(path)


def test_the_output_writes_every_n_steps_and_at_the_end(tmp_path, monkeypatch):
    path = tmp_path / "bar.npz"
    steps = []
    monkeypatch.setattr("warpfea.simulation.checkpoint.save_checkpoint", lambda sim, p: steps.append(sim.steps))
    wf.Simulation(bar(), dt=2e-3).run(0.014, outputs=[Checkpoint(path, every=3)])
    assert steps == [3, 6, 7]
    steps.clear()
    wf.Simulation(bar(), dt=2e-3).run(0.012, outputs=[Checkpoint(path, every=3)])
    assert steps == [3, 6]


def test_meta_says_what_the_file_holds(small):
    path, sim = small
    meta = read_meta(path)
    assert (meta["steps"], meta["dt"], meta["dtype"], meta["worlds"]) == (3, 2e-3, "float64", 1)
    assert meta["integrator"] == "backward_euler"
    assert meta["fingerprint"] == sim.model.fingerprint()
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("options", "integrator", "words"),
    [
        ({"dtype": "float32"}, "backward_euler", ["precision", "float64", "float32"]),
        ({"worlds": 2}, "backward_euler", ["number of worlds", "1", "2"]),
        ({}, "bdf2", ["integrator", "backward_euler", "bdf2"]),
        ({"cells": 3}, "backward_euler", ["number of slots"]),
        ({"probe": "end"}, "backward_euler", ["probes", "tip", "end"]),
        ({"E": 2e7}, "backward_euler", ["another model"]),
        ({"pull": 201}, "backward_euler", ["another model"]),
        ({"clamp": "yz"}, "backward_euler", ["another model"]),
        ({"damping": DAMPED}, "backward_euler", ["another model"]),
        ({"gravity": (0, 0, -1.0)}, "backward_euler", ["gravity", "-9.81", "-1.0"]),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(small, options, integrator, words):
    path, _ = small
    sim = wf.Simulation(bar(**options), dt=2e-3, integrator=integrator)
    sim.step()
    before = {name: values.copy() for name, values in sim.state.numpy().items()}
    with pytest.raises(wf.CheckpointError) as error:
        sim.resume(path)
    for word in [str(path), *words]:
        assert word in str(error.value)
    for name, values in before.items():
        np.testing.assert_array_equal(sim.state.numpy()[name], values)
    assert sim.steps == 1


SCHEMAS = {"schema": 9, "first schema": 1, "second schema": 2}


def damaged(path, tmp_path, how):
    file = tmp_path / "bad.npz"
    data = path.read_bytes()
    if how == "missing":
        return file
    if how == "truncated":
        file.write_bytes(data[: len(data) // 2])
    elif how == "empty":
        file.write_bytes(b"")
    elif how == "text":
        file.write_text("not a checkpoint")
    elif how == "npy":
        with open(file, "wb") as out:
            np.save(out, np.zeros(3))
    else:
        with np.load(path) as loaded:
            arrays = dict(loaded)
        if how == "no meta":
            del arrays["meta"]
        elif how == "no velocity":
            del arrays["state.velocity"]
        elif how == "no totals":
            del arrays["total.pcg"]
        elif how == "shape":
            arrays["state.velocity"] = arrays["state.velocity"][:, :-1]
        elif how in SCHEMAS:
            text = arrays["meta"].tobytes().replace(b'"schema": 3', b'"schema": %d' % SCHEMAS[how])
            arrays["meta"] = np.frombuffer(text, dtype=np.uint8)
        np.savez(file, **arrays)
    return file


@pytest.mark.parametrize(
    ("how", "word"),
    [
        ("missing", "no such checkpoint"),
        ("truncated", "not a readable checkpoint"),
        ("empty", "not a readable checkpoint"),
        ("text", "not a readable checkpoint"),
        ("npy", "not a readable checkpoint"),
        ("no meta", "not a readable checkpoint"),
        ("no velocity", "velocity"),
        ("no totals", "totals"),
        ("shape", "velocity"),
        ("schema", "schema 9"),
        ("first schema", "an older version of warpfea (schema 1;"),
        ("second schema", "an older version of warpfea (schema 2;"),
    ],
)
def test_a_damaged_checkpoint_is_refused(small, tmp_path, how, word):
    path, sim = small
    file = damaged(path, tmp_path, how)
    before = {name: values.copy() for name, values in sim.state.numpy().items()}
    with pytest.raises(wf.CheckpointError) as error:
        load_checkpoint(sim, file)
    assert str(file) in str(error.value)
    assert word in str(error.value)
    for name, values in before.items():
        np.testing.assert_array_equal(sim.state.numpy()[name], values)


def test_a_failed_write_leaves_the_old_checkpoint(small, tmp_path, monkeypatch):
    _, sim = small
    path = tmp_path / "bar.npz"
    save_checkpoint(sim, path)
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", fail)
    with pytest.raises(wf.OutputError, match="no space left"):
        save_checkpoint(sim, path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["bar.npz"]


@pytest.mark.parametrize("every", [0, -1, 1.5, True])
def test_bad_intervals_are_refused(tmp_path, every):
    with pytest.raises(wf.OutputError, match="every"):
        Checkpoint(tmp_path / "a.npz", every=every)


@pytest.mark.parametrize("name", ["a.npy", "no/where/a.npz"])
def test_bad_targets_are_refused_before_the_first_step(tmp_path, name):
    sim = wf.Simulation(bar(), dt=2e-3)
    with pytest.raises(wf.OutputError):
        sim.run(0.01, outputs=[Checkpoint(tmp_path / name)])
    assert sim.steps == 0
    assert not list(tmp_path.iterdir())
