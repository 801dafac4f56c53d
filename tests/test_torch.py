"""wf.torch.rollout: derivatives against differences and those of the tape, what is shared, what is refused."""

import pathlib
import re

import numpy as np
import pytest
from gradient_models import SOLVER, controls, linked
from gripper_learning import learn

import warpfea as wf

torch = pytest.importorskip("torch", reason="needs the extra 'torch'")

WORLDS, STEPS = 4, 3
F64 = {"dtype": torch.float64, "requires_grad": True}


@pytest.fixture(scope="module")
def sim():
    model = linked("motor", WORLDS)
    model.set_parameter("a.E", 1e6)  # per world from the start
    return wf.Simulation(model, dt=2e-3, solver=SOLVER, constraint_tol=1e-12, ledger=False)


def inputs(sim):
    """A motor, a modulus and a gravity of each world, of order 1, and a start."""
    rng = np.random.default_rng(3)
    motor = controls("motor", STEPS)["motor"] + 0.02 * rng.standard_normal((WORLDS, STEPS, 1))
    start = np.zeros((2, WORLDS, sim.model.slots, 3))
    start[1, ..., 1] = 1.0 - sim.model.slot_table.reference[:, 0]  # m/s, none at the motor's axis
    given = (motor, 1.0 + 0.1 * np.arange(WORLDS), np.tile([0.0, 3.0, -9.81], (WORLDS, 1)), 0.01 * start[1])
    return [torch.tensor(values, **F64) for values in given]


def outputs(sim, motor, modulus, gravity, velocity):
    zero = torch.zeros_like(velocity)
    given = {"a.E": 1e6 * modulus, "gravity": gravity}
    out = wf.torch.rollout(sim, {"motor": motor}, given, (zero, velocity))["tip"]
    return 1e3 * out.displacement, 1e2 * out.velocity, 1e3 * out.position


def test_derivatives_against_differences(sim):
    """Random projections of the matrix of derivatives, of all inputs by all outputs."""
    torch.manual_seed(1)
    args = inputs(sim)
    assert torch.autograd.gradcheck(
        lambda *given: outputs(sim, *given), args, eps=1e-5, atol=1e-6, rtol=1e-5, fast_mode=True
    )


def test_one_rollout(sim):
    """The motion and the gradient of a tape, float32 inputs of all worlds; rollouts do not wait for each other."""
    motor = torch.tensor(controls("motor", STEPS)["motor"], dtype=torch.float32, requires_grad=True)
    out = wf.torch.rollout(sim, {"motor": motor})["tip"]
    (out.position**2).sum().backward()
    sim.reset()
    tape = wf.Adjoint(sim, "motor")
    for value in motor.detach().numpy():
        sim.controls["motor"][:] = value
        tape.run(1)
    loss = wf.loss.sum_of_squares(tape.probe("tip").position, np.zeros((STEPS, 3)))
    g = tape.backward(loss)["motor"].numpy()
    assert np.array_equal(out.position.detach().numpy(), tape.probe("tip").position.numpy())
    assert motor.grad.numpy() == pytest.approx(g.sum(axis=0), rel=1e-6)
    early = (wf.torch.rollout(sim, {"motor": motor})["tip"].position ** 2).sum()
    wf.torch.rollout(sim, {"motor": 2.0 * motor})
    assert torch.equal(torch.autograd.grad(early, motor)[0], motor.grad)
    given = {"motor": motor}, {"a.E": 1e6}
    early = (wf.torch.rollout(sim, *given)["tip"].position ** 2).sum()
    (undisturbed,) = torch.autograd.grad(early, motor, retain_graph=True)
    wf.torch.rollout(sim, {"motor": motor.detach()}, {"a.E": 2e6})  # without derivatives
    assert torch.equal(torch.autograd.grad(early, motor)[0], undisturbed)
    with pytest.raises(wf.ModelError, match="give steps= for 'motor'"):
        wf.torch.rollout(sim, {"motor": torch.zeros(3)})
    with pytest.raises(wf.ModelError, match="not clear"):
        wf.torch.rollout(sim)
    with pytest.raises(wf.ModelError, match=r"'motor': \(4, 3, 1\)"):
        wf.torch.rollout(sim, {"motor": torch.zeros(3, 2)})
    later = wf.torch.rollout(sim, steps=1, state=sim.state)["tip"]
    assert not later.position.requires_grad


def test_the_page():
    text = (pathlib.Path(wf.__file__).parent / "simulation" / "EXAMPLES.md").read_text()
    names = {}
    exec(re.search(r"```py\n(import torch.*?)```", text, re.DOTALL)[1], names)
    first = wf.torch.rollout(names["sim"], {"pull": 0.0 * names["pull"]})["tip"].displacement[0, -1].norm()
    assert names["loss"] < 0.9 * first


@pytest.mark.slow
def test_a_gripper_learns():
    """Its loss falls tenfold, by far."""
    losses, height = learn("cpu", WORLDS)
    assert losses[-1] < 0.1 * losses[0]
    assert len(set(height)) == WORLDS
