"""Scenes of rigid parts with motors: arm and crane."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.builder.scene import find

REACH = 0.58
"""From shoulder to wrist of the arm, m."""


def test_the_arm_lifts_the_box_and_turns_it():
    """One step per target, 20 ms, is within 1e-3 of the reach of four; with controls it is the same motion."""
    path = {}
    for h in (2e-2, 5e-3):
        sim = wf.Simulation(
            find("arm")().finalize(device="cpu"), dt=h, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-4)
        )
        sim.run(1.6)
        path[h] = sim.probe("box").position[0]
    coarse, fine = path[2e-2][4::5], path[5e-3][19::20]
    assert np.abs(coarse - fine).max() < 1e-3 * REACH
    end = coarse[-1]
    assert end[2] == pytest.approx(0.025 + 0.2, abs=2e-3)
    assert np.arctan2(end[1], end[0]) == pytest.approx(-0.7, abs=5e-3)
    model = find("arm")(controlled=True).finalize(device="cpu", worlds=2)
    many = wf.Simulation(model, dt=2e-2, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-4))
    assert set(many.controls) == {*(f"q{k}" for k in range(1, 8)), "grip"}
    laws = {spring.name: spring.schedule for spring in find("arm")().description.springs}
    for k in range(30):
        for joint in range(1, 8):
            many.controls[f"q{joint}"] = laws[f"motor {joint}"].values[k + 1, 0]
        many.controls["grip"] = laws["left grip"].values[k + 1, 0]
        many.step()
    assert np.abs(many.probe("box").position[:, -1] - path[2e-2][29]).max() < 1e-6


def test_the_cranes_motor_turns_its_load():
    scene = find("crane")
    sim = wf.Simulation(scene().finalize(device="cpu"), dt=1e-2, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-6))
    sim.step(100)
    assert sim.joint_rate("bearing")[0] == pytest.approx(0.8, abs=1e-6)
    sim.step(200)
    assert sim.joint_rate("bearing")[0] == pytest.approx(0.0, abs=1e-6)
    assert sim.joint_value("bearing")[0] == pytest.approx(0.8 * 2.0, rel=1e-3)
    e = sim.energies()
    assert abs(e["ledger_residual"][0]) < 1e-3
    assert e["work_joints"][0] > 30.0  # the load swings


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_worlds_of_the_arm_on_the_gpu(dtype):
    """64 worlds lift the box as one on the CPU."""
    ends = []
    for device, worlds in (("cpu", 1), ("cuda:0", 64)):
        model = find("arm")().finalize(device=device, dtype=dtype, worlds=worlds)
        sim = wf.Simulation(model, dt=2e-2, integrator="bdf2", solver=wf.NewtonPCG(tol=1e-4))
        sim.run(1.6)
        ends.append(sim.probe("box").position[:, -1])
    assert np.abs(ends[1] - ends[0]).max() < 1e-3
