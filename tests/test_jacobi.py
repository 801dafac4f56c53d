"""wf.Jacobi: a few cheap iterations per step, against Newton's method; what is left is told, what fails is refused."""

from __future__ import annotations

import itertools
import json
import pathlib

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.cli import main
from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint
from warpfea.solvers import SOLVERS

RESULT = pathlib.Path(__file__).resolve().parent / "results" / "jacobi_cpu.json"
SOFT = wf.SVK(E=1e5, nu=0.3, density=1000.0)


def bar(
    *,
    device="cpu",
    dtype="float64",
    worlds=1,
    cells=(5, 2, 2),
    material=SOFT,
    clamp=True,
    pull=0.0,
    gravity=(0, 0, -9.81),
):
    """More slots than are inverted as a whole, so that there are tiles and a coarse space."""
    b = wf.ModelBuilder(gravity=gravity)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=cells), material=material)
    if clamp:
        b.clamp(body.nodes("x-"))
    if pull:
        b.add_traction(body.surface("x+"), (pull, 0, 0))
    b.add_probe("tip", body.surface("x+"))
    return b.finalize(device=device, dtype=dtype, worlds=worlds)


@pytest.fixture(scope="module")
def soft():
    """The model, and the tip's way with Newton's method."""
    model = bar()
    sim = wf.Simulation(model, dt=5e-3)
    sim.step(20)
    return model, sim.probe("tip").displacement[0]


def way(model, steps=20, **options):
    sim = wf.Simulation(model, dt=5e-3, solver=wf.Jacobi(**options))
    sim.step(steps)
    return sim, sim.probe("tip").displacement[0]


@pytest.mark.parametrize(("coarse", "bounds"), [(True, (5e-3, 2e-4, 2e-6)), (False, (3e-2, 2e-3, 1e-4))])
def test_it_comes_to_newtons_motion_with_its_iterations(soft, data, coarse, bounds):
    model, expected = soft
    for iterations, bound in zip((4, 8, 16), bounds):
        sim, found = way(model, iterations=iterations, coarse=coarse)
        assert data.error(found, expected) < bound
        assert sim.totals["newton"][0] == 20 * iterations


@pytest.mark.parametrize(("acceleration", "bound"), [("anderson", 5e-4), ("chebyshev", 2e-2), ("none", 1e-2)])
def test_other_accelerations(soft, data, acceleration, bound):
    model, expected = soft
    _, found = way(model, acceleration=acceleration)
    assert data.error(found, expected) < bound


def test_the_name_alone_means_the_defaults(soft):
    model, _ = soft
    named = wf.Simulation(model, dt=5e-3, solver="jacobi")
    named.step(3)
    assert np.array_equal(named.probe("tip").displacement[0], way(model, 3)[1])
    assert wf.Simulation(model, dt=5e-3, solver="newton-pcg").solver == wf.NewtonPCG()


def test_float32(soft, data):
    _, expected = soft
    sim, found = way(bar(dtype="float32"))
    assert data.error(found, expected) < 1e-3
    assert sim.last.residual[0] < 0.1


@pytest.mark.cuda
@pytest.mark.parametrize("coarse", [True, False])
def test_cuda_equals_cpu(data, coarse):
    for acceleration in ("secants", "chebyshev"):
        _, expected = way(bar(), coarse=coarse, acceleration=acceleration)
        sim, found = way(bar(device="cuda:0"), coarse=coarse, acceleration=acceleration)
        assert data.error(found, expected) < 1e-8
        assert sim.totals["rough"][0] == 20


def test_what_is_left_is_told(soft):
    model, _ = soft
    sim, _ = way(model, 5, iterations=2)
    report = sim.last
    assert not report.converged[0]
    assert report.status[0] == 0
    assert report.residual[0] > 1e-3
    g = sim.stepper.work.g.numpy()[0] * model.slot_table.free
    assert report.residual_force[0] == pytest.approx(np.linalg.norm(g), rel=1e-12)
    assert sim.totals["rough"][0] == 5
    assert sim.max_residual >= report.residual[0]
    # the ledger books what the solver left: g . dq
    e = sim.energies()
    assert abs(e["ledger_residual"][0]) > 1e-9
    assert e["ledger_residual"][0] == pytest.approx(e["unbalanced"][0], abs=1e-10)


def test_it_stops_early_within_the_tolerance(soft):
    model, _ = soft
    sim, _ = way(model, 5, iterations=50, tol=1e-3)
    assert sim.last.converged[0]
    assert sim.last.residual[0] <= 1e-3
    assert 2 <= sim.last.newton[0] < 25
    assert sim.totals["rough"][0] == 0


def test_a_swinging_bar_gains_no_energy(soft):
    """Backward Euler only loses; four iterations may not add to that."""
    model, _ = soft
    # what it leaves turns an element of so soft a bar inside out
    sim = wf.Simulation(model, dt=1e-2, solver=wf.Jacobi(iterations=4), inversion="report")
    largest = 0.0
    for _ in range(100):
        sim.step()
        e = sim.energies()
        largest = max(largest, float(e["kinetic"][0] + e["strain"][0] + e["potential"][0]))
    assert largest < 1e-3 * float(-e["potential"][0])


def test_a_free_body_keeps_its_momentum():
    """However loose the solve is: the translation is solved for."""
    model = bar(clamp=False, pull=500.0, gravity=(0, 0, 0))
    sim = wf.Simulation(model, dt=5e-3, solver=wf.Jacobi(iterations=2))
    report = sim.step(10)
    assert report.residual[0] > 1e-6
    momentum = np.einsum("s,sc->c", model.masses.lumped[0], sim.state.velocity.numpy()[0])
    assert momentum == pytest.approx([500.0 * 0.04 * 0.05, 0, 0], abs=1e-12)


def test_worlds_equal_runs_of_their_own():
    gravity = [(0, 0, -9.81), (0, -3.0, 0), (1.0, 0, 0)]
    many = bar(worlds=3)
    many.set_gravity(gravity)
    sim = wf.Simulation(many, dt=5e-3, solver=wf.Jacobi(iterations=12, tol=1e-3))
    together = [sim.step() for _ in range(6)]
    for world, g in enumerate(gravity):
        own = wf.Simulation(bar(gravity=g), dt=5e-3, solver=wf.Jacobi(iterations=12, tol=1e-3))
        reports = [own.step() for _ in range(6)]
        assert np.array_equal(own.state.displacement.numpy()[0], sim.state.displacement.numpy()[world])
        assert [r.newton[0] for r in reports] == [r.newton[world] for r in together]
        assert [r.converged[0] for r in reports] == [r.converged[world] for r in together]


def test_the_graph_does_what_the_launches_do(soft):
    model, _ = soft
    plain = wf.Simulation(model, dt=5e-3, solver=wf.Jacobi(), capture=False)
    plain.step(3)
    assert np.array_equal(plain.probe("tip").displacement[0], way(model, 3)[1])


def test_a_resumed_run_equals_the_undisturbed_one(tmp_path):
    model = bar(cells=(8, 2, 2), material=wf.SVK(E=3e4, nu=0.3, density=1000.0))
    options = wf.Jacobi(iterations=6)
    whole = wf.Simulation(model, dt=1e-2, solver=options)
    builds = []
    for k in range(40):
        whole.step()
        builds.append(whole.state.preconditioner_displacement.numpy().copy())
        if k == 19:
            save_checkpoint(whole, tmp_path / "bar.npz")
    assert any(not np.array_equal(a, b) for a, b in itertools.pairwise(builds[20:]))  # made anew at times
    rest = wf.Simulation(model, dt=1e-2, solver=options)
    load_checkpoint(rest, tmp_path / "bar.npz")
    rest.step(20)
    for name, values in whole.state.numpy().items():
        assert np.array_equal(rest.state.numpy()[name], values), name
    assert np.array_equal(rest.totals["rough"], whole.totals["rough"])
    assert rest.totals["rough"][0] == 40


def test_mechanism():
    """Multipliers are changed once per step: joints give a little, and the report says how much."""
    scene = find("four_bar")
    model = scene.build(scene.resolve({})).finalize(device="cpu")
    exact = wf.Simulation(model, dt=scene.dt)
    cheap = wf.Simulation(model, dt=scene.dt, solver=wf.Jacobi(iterations=8))
    for _ in range(20):
        exact.step()
        report = cheap.step()
        assert report.violation[0] < 1e-5 * model.size
    expected = exact.state.displacement.numpy()
    assert np.abs(cheap.state.displacement.numpy() - expected).max() < 1e-3 * np.abs(expected).max()
    assert not report.converged[0]


def test_joints_that_come_apart_are_refused():
    scene = find("double_pendulum")
    model = scene.build(scene.resolve({})).finalize(device="cpu")
    sim = wf.Simulation(model, dt=scene.dt, solver=wf.Jacobi(iterations=1, max_halvings=1))
    with pytest.raises((wf.ConstraintError, wf.ConvergenceError), match=r"iterations are too few|grew more than"):
        sim.step(20)
    assert np.isfinite(sim.state.displacement.numpy()).all()


@wp.func
def breaks(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """No number from 12 ms on."""
    if t > wp.float64(0.012):
        return wp.vec3d(wp.sqrt(wp.float64(-1.0)), wp.float64(0.0), wp.float64(0.0))
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(-9.81))


def test_not_a_number_is_refused():
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=SOFT)
    b.clamp(body.nodes("x-"))
    b.add_body_force(breaks, bodies=[body])
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, solver=wf.Jacobi(max_halvings=2))
    sim.step(2)
    before = sim.state.displacement.numpy().copy()
    with pytest.raises(wf.ConvergenceError, match="not finite"):
        sim.step()
    assert np.array_equal(sim.state.displacement.numpy(), before)


def test_an_inverted_element_is_refused():
    """Steps are halved as far as they go; a refused one leaves the state as it was."""
    rubber = wf.NeoHookean.from_E_nu(E=1e5, nu=0.4, density=1000.0)
    sim = wf.Simulation(bar(material=rubber, cells=(2, 1, 1), pull=-1e7), dt=2e-2, solver=wf.Jacobi(max_halvings=2))
    with pytest.raises(wf.ConvergenceError, match=r"J <= 0|grew more than tenfold"):
        sim.step(5)
    assert np.isfinite(sim.state.displacement.numpy()).all()


def test_unknown_names_and_values_out_of_range(soft):
    model, _ = soft
    for wrong in ("newton", 3, wf.Jacobi):
        with pytest.raises(wf.ModelError, match="'newton-pcg', 'jacobi'"):
            wf.Simulation(model, dt=1e-3, solver=wrong)
    for name, value in {
        "iterations": 0, "acceleration": "fast", "tol": 2.0, "force_tol": -1.0, "max_halvings": 21, "penalty": 0.0,
    }.items():  # fmt: skip
        with pytest.raises(wf.ModelError, match=f"Jacobi: {name}"):
            wf.Jacobi(**{name: value})
    with pytest.raises(wf.ModelError, match="solve_static: solver"):
        wf.solve_static(model, solver=wf.Jacobi())


def test_newtons_method_pays_nothing_for_it(soft):
    model, _ = soft
    sim = wf.Simulation(model, dt=5e-3)
    assert not any("jacobi_" in name for name in sim.stepper.launch.modules)
    assert not any(name.startswith("jacobi") for name in sim.stepper.work.bytes)


def test_command_line_says_so(tmp_path, capfd):
    command = ["run", "cantilever", "--t-end", "0.01", "--device", "cpu", "--no-progress"]
    out = tmp_path / "a.json"
    assert main([*command, "--solver", "jacobi", "--json", str(out)]) == 0
    text = capfd.readouterr().out
    assert "NOT CONVERGED  tolerance 1e-08 reached in 0 of 4 steps (0%)" in text
    assert "8.0 of Jacobi per step" in text
    summary = json.loads(out.read_text())
    assert (summary["steps"], summary["rough_steps"], summary["status"]) == (4, 4, "done")
    assert main([*command, "--solver", "newton-pcg", "--json", str(out)]) == 0
    assert "NOT CONVERGED" not in capfd.readouterr().out
    assert json.loads(out.read_text())["rough_steps"] == 0
    assert main([*command, "--solver", "gauss"]) == 2
    err = capfd.readouterr().err
    assert all(name in err for name in SOLVERS)


def test_the_committed_table():
    """tests/results/jacobi_cpu.json, made at 51a4e5d: what helps, and what it does not do."""
    content = json.loads(RESULT.read_text())
    assert content["machine"]["device"].startswith("cpu")
    assert len(content["commit"]) >= 40
    rows = content["rows"]
    scenes = {r["scene"] for r in rows}
    assert len(scenes) == 4
    table = {}
    for r in rows:
        if r["solver"] == "jacobi":
            table[r["scene"], r["coarse"], r["acceleration"], r["iterations"]] = r
    assert len(table) == 4 * 2 * 4 * 5
    for scene in scenes:
        own = [table[scene, True, "secants", n] for n in (4, 8, 16, 32)]
        errors = [r["tip_error"] for r in own]
        assert errors == sorted(errors, reverse=True)
        assert errors[-1] < 5e-3
        assert all(r["outcome"] == "done" for r in own)
        # cheaper than Newton's method at any tolerance in the table, up to 8 iterations
        newton = [r["ms_per_step"] for r in rows if r["scene"] == scene and r["solver"] == "newton-pcg"]
        assert own[1]["ms_per_step"] < min(newton)
        # what is left is told: a step in error says that its residual is large
        for r in rows:
            if r["scene"] == scene and r["outcome"] == "done" and r["tip_error"] > 1e-2:
                assert r["residual"] > 0.02
                assert r["converged"] < 0.5
    for iterations in (8, 16, 32):
        for scene in scenes:
            best = table[scene, True, "secants", iterations]["tip_error"]
            for other in ("chebyshev", "none"):
                r = table[scene, True, other, iterations]
                assert r["outcome"] != "done" or best < r["tip_error"]
    # tiles alone carry no stiff body
    stiff = next(s for s in scenes if s.startswith("stiff"))
    assert table[stiff, False, "secants", 32]["tip_error"] > 1.0
