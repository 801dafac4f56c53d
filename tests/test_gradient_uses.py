"""Uses of gradients: their cost, and the examples of warpfea/simulation/EXAMPLES.md."""

from types import SimpleNamespace

import numpy as np
import parameter_models as models
import pytest
from gradient_models import TARGET, linked
from result_files import content_of

import warpfea as wf
from warpfea.solvers.choice import choose_adjoint_operator, choose_solver

MAX_RATIO = {"pendulum": 1.0, "finger": 1.0, "gripper": 2.5}  # that of contact is not symmetric


@pytest.mark.parametrize(("device", "worlds"), [("cpu", 1), ("h200", 4096), ("h100", 4096)])
def test_a_step_back_costs_no_more_than_one_forward(device, worlds):
    content = content_of(f"gradient_cost_{device}.json", "python tests/gradient_cost.py")
    rows = {row["label"]: row for row in content["rows"]}
    assert set(rows) == set(MAX_RATIO) - ({"gripper"} if device == "h100" else set())
    assert device == "cpu" or content["machine"]["gpu"].startswith(f"NVIDIA {device.upper()}")
    for name, row in rows.items():
        assert row["worlds"] == worlds
        assert row["ratio"] <= MAX_RATIO[name], name
        assert row["recomputed"] == 0


def test_gradients_beside_other_software():
    """The same derivative as torch-fem on a cube, in less time; a thrown block beside its own differences."""
    rows = {(row["label"], row["of"]): row for row in content_of("gradient_peers_cpu.json")["rows"]}
    ours, theirs = rows["cube", "warpfea"], rows["cube", "torch-fem"]
    assert ours["value"] == pytest.approx(theirs["value"], rel=1e-10)
    assert ours["derivative"] == pytest.approx(theirs["derivative"], rel=1e-10)
    assert max(ours["error"], theirs["error"]) < 1e-6
    assert ours["forward_s"] + ours["backward_s"] < theirs["forward_s"] + theirs["backward_s"]
    ours, theirs = rows["soft body", "warpfea"], rows["soft body", "newton"]
    assert ours["error"] < 1e-6 < max(theirs["error"])  # with points that come into contact, neither is smooth
    assert ours["forward_s"] + ours["backward_s"] < theirs["forward_s"] + theirs["backward_s"]


def test_a_gripper_learns_in_256_worlds():
    (row,) = content_of("gripper_learning_h200.json", "python tests/gripper_learning.py cuda")["rows"]
    assert row["worlds"] == 256
    assert row["losses"][-1] < 0.1 * row["losses"][0]


def counted(extrapolates, target):
    """Gradients of a body; PCG iterations of its steps back, and how often the preconditioner was built."""
    m = models.model(models.solid(), models.material(models.NEO))
    sim = wf.Simulation(m, dt=5e-4)
    tape = wf.Adjoint(sim, ["body.E", "initial.velocity"])
    tape.solver.extrapolates = extrapolates
    tape.run(len(target))
    newton, back, iterations, places = tape.stepper.newton, tape._step_back, [], []
    assert not newton.residual.uses_matrix  # no matrix of each step

    def step_back(*args):
        back(*args)
        iterations.append(int(tape.stepper.work.pcg.step_iterations.numpy()[0]))
        places.append(newton.preconditioner.reuse.linearisation_point.numpy().tobytes())

    tape._step_back = step_back
    loss = wf.loss.sum_of_squares(tape.probe("tip"), target)
    g = {name: array.numpy() for name, array in tape.backward(loss).items()}
    assert (tape.residual < 1e-10).all()
    a = tape.solver
    for array in a.bars.values():
        array.zero_()
    a.solve()
    assert not a.w.numpy().any()  # whatever the steps before
    return g, iterations, len(set(places))


def test_a_step_back_begins_beside_its_solution_with_kept_factors():
    smooth = np.full((40, 3), TARGET)
    smooth[32] = 1.0  # with a jump
    runs = [counted(flag, smooth) for flag in (True, False)]
    for found, other in zip(runs[0][0].values(), runs[1][0].values()):
        assert found == pytest.approx(other, rel=1e-8, abs=1e-8 * np.abs(other).max())
    (_, quick, builds), (_, slow, _) = runs
    assert sum(quick[20:]) < 0.65 * sum(slow[20:])
    assert sum(quick[4:16]) < 0.93 * sum(slow[4:16])  # of low order about the jump
    assert builds <= 3
    rough = np.random.default_rng(3).normal(0.0, 0.1, (40, 3))
    runs = [counted(flag, rough) for flag in (True, False)]
    assert sum(runs[0][1]) <= 1.02 * sum(runs[1][1])  # extrapolations that are worse than 0 are left out


def test_the_solution_of_exact_factors_is_checked_by_one_product():
    sim = wf.Simulation(models.model(models.solid("T4"), models.material()), dt=2e-3)
    tape = wf.Adjoint(sim, "gravity")
    tape.run(3)
    tape.backward(wf.loss.sum_of_squares(tape.probe("tip"), np.full((3, 3), TARGET)))
    assert tape.stepper.newton.plan.exact
    assert tape.stepper.work.pcg.solved_directly.numpy().all()
    assert (tape.solver.control.refinements.numpy() == 2).all()  # checks: at 0, and of the solution
    assert (tape.residual < 1e-12).all()


def test_products_of_the_adjoint():
    gpu = SimpleNamespace(is_cuda=True)
    cases = {"T10": models.solid(), "T4": models.solid("T4"), "3243": models.beam()}
    found = {}
    for name, add in cases.items():
        m = models.model(add, models.material())
        plans = choose_solver(m, m.device), choose_solver(m, gpu, many=True)
        found[name] = [choose_adjoint_operator(m, plan, on_cuda) for plan, on_cuda in zip(plans, (False, True))]
    assert found == {"T10": ["elements", "elements"], "T4": ["auto", "auto"], "3243": ["auto", "elements"]}
    m = linked("motor")
    assert choose_adjoint_operator(m, choose_solver(m, m.device), False) == "auto"


def run_with(budget=None, folder=None, steps=30):
    """A tape of a bar on two joints, whose motor moves in every step, in two worlds, and its gradients."""
    sim = wf.Simulation(linked("motor", 2), dt=2e-3)
    tape = wf.Adjoint(sim, ["a.E", "gravity", "motor", "initial.velocity"], budget=budget, folder=folder)
    for k in range(steps):
        sim.controls["motor"][:] = [[0.002 * k], [0.001 * k]]
        tape.run(1)
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.zeros((steps, 3)))
    return tape, {name: array.numpy() for name, array in tape.backward(loss).items()}


def test_steps_computed_again_or_on_disk_give_the_same_bits(tmp_path):
    tape, exact = run_with()
    size, whole = tape.bytes()["step"], tape.kept.whole
    assert tape.bytes()["states"] == 31 * size
    assert tape.recomputed == 0
    budget = 4 * whole + 4 * size
    again, g = run_with(budget)
    assert 15 < again.recomputed < 150
    assert again.bytes()["states"] + again.bytes()["checkpoints"] <= budget + whole
    disk, h = run_with(4 * size, tmp_path)
    assert disk.recomputed == 0
    assert disk.bytes()["states"] <= 5 * size
    assert len(list(tmp_path.rglob("*.npz"))) > 20
    for name, values in exact.items():
        assert np.array_equal(g[name], values), name
        assert np.array_equal(h[name], values), name
    before = again.recomputed
    state = again.sim.state.displacement.numpy().copy()
    assert np.array_equal(again.backward()["a.E"].numpy(), exact["a.E"])
    assert again.recomputed > before
    assert np.array_equal(state, again.sim.state.displacement.numpy())
    assert np.array_equal(state, tape.sim.state.displacement.numpy())
    again.sim.step(3)
    tape.sim.step(3)  # the simulation goes on as if nothing had been computed again
    assert np.array_equal(again.sim.state.displacement.numpy(), tape.sim.state.displacement.numpy())
    assert (again.sim.totals["newton"] == tape.sim.totals["newton"]).all()
    disk.clear()
    del disk
    assert not list(tmp_path.rglob("*.npz"))
    with pytest.raises(wf.CapacityError, match="computed again"):
        run_with(3 * size)
