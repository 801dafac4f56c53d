"""Uses of gradients: their cost, and the examples of warpfea/simulation/EXAMPLES.md."""

import numpy as np
import pytest
from gradient_models import linked
from result_files import content_of

import warpfea as wf

MAX_RATIO = {"pendulum": 1.0, "finger": 1.0, "gripper": 2.5}  # that of contact is not symmetric
FILES = [
    ("cpu", 1),
    pytest.param(
        "h200", 4096, marks=pytest.mark.xfail(strict=True, reason="1.08 and 1.07 on an H200")
    ),
]


@pytest.mark.parametrize(("device", "worlds"), FILES)
def test_a_step_back_costs_no_more_than_one_forward(device, worlds):
    content = content_of(f"gradient_cost_{device}.json", "python tests/gradient_cost.py")
    rows = {row["label"]: row for row in content["rows"]}
    assert set(rows) == set(MAX_RATIO)
    for name, row in rows.items():
        assert row["worlds"] == worlds
        assert row["ratio"] <= MAX_RATIO[name], name
        assert row["recomputed"] == 0 and row["setup_s"] < 60.0


def test_gradients_beside_other_software():
    """The same derivative as torch-fem on a cube, in less time; a thrown block beside its own differences."""
    rows = {(row["label"], row["of"]): row for row in content_of("gradient_peers_cpu.json")["rows"]}
    ours, theirs = rows["cube", "warpfea"], rows["cube", "torch-fem"]
    assert ours["value"] == pytest.approx(theirs["value"], rel=1e-10)
    assert ours["derivative"] == pytest.approx(theirs["derivative"], rel=1e-10)
    assert max(ours["error"], theirs["error"]) < 1e-6
    assert ours["forward_s"] + ours["backward_s"] < theirs["forward_s"] + theirs["backward_s"]
    ours, theirs = rows["soft body", "warpfea"], rows["soft body", "newton"]
    assert ours["error"] < max(theirs["error"])  # with points that come into contact, neither is smooth
    assert ours["forward_s"] + ours["backward_s"] < theirs["forward_s"] + theirs["backward_s"]


def test_a_gripper_learns_in_256_worlds():
    (row,) = content_of("gripper_learning_h200.json", "python tests/gripper_learning.py cuda")["rows"]
    assert row["worlds"] == 256
    assert row["losses"][-1] < 0.1 * row["losses"][0]


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
