"""The two-level preconditioner: what it promises of solves."""

from types import SimpleNamespace

import numpy as np
import pytest
from two_level_models import bar

import warpfea as wf
from warpfea.solvers import choose_solver
from warpfea.studies.bench.problems import PROBLEMS


def test_iterations_hardly_grow_with_the_mesh():
    counts = []
    for n in (1000, 9000):
        law = wf.SVK(E=1e11, nu=0.3, density=2700.0)
        sim = wf.Simulation(
            bar(n, law=law, traction=10.0).finalize(device="cpu"),
            dt=1e-2,
            solver=wf.NewtonPCG(tol=0.1, forcing=1e-8, max_newton=1, preconditioner="two-level"),
            ledger=False,
        )
        counts.append(int(sim.step().pcg[0]))
    assert counts[1] < 1.5 * counts[0]
    assert counts[1] < 80


@pytest.mark.parametrize(("name", "size"), [("bar", (7, 5, 2)), ("beam", 60), ("plate", 4)])
def test_it_needs_fewer_iterations_than_3x3_blocks(name, size):
    counts, tips = {}, {}
    for kind in ("two-level", "block-jacobi"):
        solver = wf.NewtonPCG(preconditioner=kind, tol=1e-10, operator="elements")
        sim = wf.Simulation(PROBLEMS[name].build(size).finalize(device="cpu"), dt=1e-3, solver=solver, ledger=False)
        counts[kind] = sum(int(sim.step().pcg[0]) for _ in range(3))
        tips[kind] = sim.probe("tip").displacement[0, -1]
    assert counts["two-level"] < 0.75 * counts["block-jacobi"]
    np.testing.assert_allclose(
        tips["two-level"], tips["block-jacobi"], rtol=0, atol=1e-8 * np.abs(tips["two-level"]).max()
    )


def spinner(**options):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    box = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(6, 2, 2)), material=wf.SVK(E=1e7, nu=0.3, density=1000.0))
    b.set_initial(box, angular_velocity=(0, 0, 40.0))
    solver = wf.NewtonPCG(**({"preconditioner": "two-level"} | options))
    return wf.Simulation(b.finalize(device="cpu"), dt=2e-3, solver=solver, ledger=False)


def test_it_is_kept_while_it_serves_and_made_anew_when_it_does_not():
    sim = spinner()
    made = 0
    place = sim.state.preconditioner_displacement.numpy().copy()
    for _ in range(40):  # three turns in all
        sim.step()
        now = sim.state.preconditioner_displacement.numpy().copy()
        made += not np.array_equal(now, place)
        place = now
    assert 2 <= made <= 20


def test_a_run_from_its_middle_makes_it_where_it_was_made():
    one = spinner(operator="matrix")
    one.step(13)
    middle = one.state.copy()
    assert np.abs(middle.preconditioner_displacement.numpy()).max() > 0.0
    one.step(12)
    other = spinner(operator="matrix")
    other.reset(state=middle)
    other.step(12)
    kept = ("preconditioner", "preconditioner_displacement", "operator", "operator_displacement")
    for name in ("displacement", "velocity", *kept):
        np.testing.assert_array_equal(getattr(one.state, name).numpy(), getattr(other.state, name).numpy())


def test_the_matrix_is_kept_from_step_to_step_while_newton_does_not_suffer():
    """A body at rest needs one; one that turns needs another now and then."""
    made = {}
    for name, speed in (("rest", 0.0), ("spin", 40.0)):
        b = wf.ModelBuilder(gravity=(0, 0, -1.0))
        box = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(6, 2, 2)), material=wf.SVK(E=1e7, nu=0.3, density=1000.0))
        b.set_initial(box, angular_velocity=(0, 0, speed))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, solver=wf.NewtonPCG(operator="matrix"), ledger=False)
        places, newton = set(), 0
        for _ in range(40):
            newton += int(sim.step().newton[0])
            places.add(sim.state.operator_displacement.numpy().tobytes())
        made[name] = len(places), newton
    assert made["rest"][0] <= 2
    assert 4 <= made["spin"][0] < made["spin"][1]


def test_worlds_have_their_own():
    b = bar(1000)
    model = b.finalize(device="cpu", worlds=3)
    gravity = np.array([(0, 0, -1.0), (0, 0, -300.0), (50.0, 0, 0)])
    model.set_gravity(gravity)
    solver = wf.NewtonPCG(operator="matrix", preconditioner="two-level")
    sim = wf.Simulation(model, dt=5e-3, solver=solver)
    sim.step(6)
    for world in range(3):
        single = bar(1000).finalize(device="cpu")
        single.set_gravity(gravity[world])
        own = wf.Simulation(single, dt=5e-3, solver=solver)
        own.step(6)
        for name in ("displacement", "preconditioner_displacement", "operator", "operator_displacement"):
            row = getattr(sim.state, name).numpy()[world]
            np.testing.assert_array_equal(row, getattr(own.state, name).numpy()[0])


def test_storage_in_single_precision_changes_the_way_but_not_the_end():
    ends = []
    for storage in (None, "float32"):
        solver = wf.NewtonPCG(tol=1e-11, preconditioner="two-level", preconditioner_dtype=storage)
        sim = wf.Simulation(bar(1000).finalize(device="cpu"), dt=1e-3, solver=solver, ledger=False)
        reports = [sim.step() for _ in range(5)]
        ends.append((sim.probe("tip").displacement[0, -1, 0], sum(int(r.pcg[0]) for r in reports), sim.bytes()))
    assert ends[0][0] == pytest.approx(ends[1][0], rel=1e-9)
    assert ends[1][1] <= 1.1 * ends[0][1]
    assert ends[1][2]["work.level 0 stored"] < 0.51 * ends[0][2]["work.level 0 inverse"]


def test_a_tolerance_in_newtons():
    reports = []
    for tol in (0.0, 5e-4):
        solver = wf.NewtonPCG(tol=1e-12, force_tol=tol, preconditioner="block-jacobi")
        sim = wf.Simulation(bar(300).finalize(device="cpu"), dt=1e-3, solver=solver, ledger=False)
        reports.append(sim.step())
        free = sim.model.slot_table.free
        g = np.linalg.norm(sim.stepper.work.g.numpy()[0] * free)
        assert reports[-1].residual_force[0] == pytest.approx(g, rel=1e-12)
    assert reports[0].residual_force[0] < 1e-6 < reports[1].residual_force[0] <= 5e-4
    assert reports[1].newton[0] < reports[0].newton[0]


def test_forcing_is_the_relative_residual_of_a_solve():
    sim = wf.Simulation(
        bar(1000).finalize(device="cpu"),
        dt=1e-3,
        solver=wf.NewtonPCG(forcing=1e-5, tol=1e-9, preconditioner="two-level"),
        ledger=False,
    )
    sim.step()
    control = sim.stepper.work.pcg
    assert 1e-7 < control.norm.numpy()[0] / control.first_norm.numpy()[0] <= 1e-5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"operator": "magic"}, "'auto', 'elements', 'matrix'"),
        ({"preconditioner_dtype": "float16"}, "'float32', 'float64'"),
        ({"force_tol": -1.0}, "zero or positive"),
        ({"forcing": 2.0}, "between 0 and 1"),
    ],
)
def test_options_out_of_range_are_named(options, message):
    with pytest.raises(wf.ModelError, match=message):
        wf.NewtonPCG(**options)


def test_an_unknown_preconditioner_lists_those_there_are():
    model = bar(300).finalize(device="cpu")
    with pytest.raises(wf.ModelError, match="auto, two-level, tiles, banded, deflated, block-jacobi"):
        wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(preconditioner="ilu"))


@pytest.mark.parametrize(("links", "kind"), [(10, "two-level"), (40, "deflated")])
def test_many_small_bodies_on_joints_take_the_deflated_blocks(links, kind):
    from warpfea.builder.scene import find

    scene = find("chain")
    model = scene.build(scene.resolve({"links": links})).finalize(device="cpu")
    counts = {}
    assert choose_solver(model, model.device).preconditioner == "banded"
    assert choose_solver(model, SimpleNamespace(is_cuda=True)).preconditioner == kind
    for name in (kind, "block-jacobi"):
        sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(preconditioner=name, max_pcg=20000), ledger=False)
        counts[name] = sum(int(sim.step().pcg[0]) for _ in range(3))
    assert 2 * counts[kind] < counts["block-jacobi"]
