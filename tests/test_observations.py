"""Observations: one table of chosen values of all worlds, kept on the device."""

import numpy as np
import pytest
from loop_models import DEVICES, DT, QUIET, arms, cubes, flags

import warpfea as wf


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_observations_equal_the_values_of_the_simulation(dtype, device):
    model = cubes(2, dtype, device)
    sim = wf.Simulation(model, dt=DT, **QUIET)
    names = ("body.cube.position", "time", "probe.top.velocity", "probe.top.displacement", "contact.pad.force",
             "contact.pad.area", "body.cube.velocity")  # fmt: skip
    observed = sim.observe(*names)
    sim.step(30)
    table = observed.update().numpy()
    body, probe, record = model.bodies[0], sim.probe("top"), sim.contact_record("pad")
    expected = {
        "body.cube.position": sim.positions(body).reshape(2, -1),
        "body.cube.velocity": sim.velocities(body).reshape(2, -1),
        "time": sim.time[:, None],
        "probe.top.velocity": probe.velocity[:, -1],
        "probe.top.displacement": probe.displacement[:, -1],
        "contact.pad.force": record.force[:, -1],
        "contact.pad.area": record.area[:, -1:],
    }
    assert list(observed.columns) == list(names)
    assert table.dtype == dtype
    for name, wanted in expected.items():
        assert table[:, observed.columns[name]] == pytest.approx(wanted, rel=1e-6, abs=1e-7), name
        assert np.array_equal(observed[name].numpy(), table[:, observed.columns[name]])
    assert np.any(expected["contact.pad.force"] != 0.0)
    sim.reset(flags(1, of=2, device=device))
    assert not observed.update().numpy()[1, observed.columns["contact.pad.force"]].any()


def test_values_of_joints_are_observed_with_full_turns():
    sim = wf.Simulation(arms(2), dt=DT, **QUIET)
    observed = sim.observe("joint.motor.angle", "joint.rope.length", "joint.motor.moment", "joint.rope.violation")
    for k in range(300):
        sim.controls["motor"][:] = [0.025 * k, -0.01 * k]
        sim.step()
    table = observed.update().numpy()
    assert table[:, 0] == pytest.approx(sim.joint_value("motor"), rel=1e-12)
    assert table[0, 0] > 2.0 * np.pi
    assert table[:, 1] == pytest.approx(sim.joint_value("rope"), rel=1e-12)
    assert table[:, 2:5] == pytest.approx(sim.joint_force("motor")[:, 3:])
    assert table[:, 5] == pytest.approx(sim.violation("rope"))


def test_observations_share_their_memory():
    sim = wf.Simulation(cubes(2), dt=DT, **QUIET)
    observed = sim.observe("probe.top.position")
    shared = observed.array.numpy()
    sim.step(20)
    observed.update()
    assert np.array_equal(shared, observed.array.numpy())
    assert shared.ctypes.data == observed.array.ptr
    assert np.from_dlpack(observed).ctypes.data == observed.array.ptr


def test_observations_are_shared_with_torch():
    torch = pytest.importorskip("torch")
    sim = wf.Simulation(cubes(2), dt=DT, **QUIET)
    observed = sim.observe("probe.top.position")
    tensor = torch.from_dlpack(observed)
    sim.step(20)
    observed.update()
    assert np.array_equal(tensor.numpy(), observed.array.numpy())


def test_observations_of_a_simulation_that_reads():
    sim = wf.Simulation(cubes(), dt=DT)
    observed = sim.observe("contact.pad.force")
    assert not observed.update().numpy().any()
    sim.step(30)
    assert observed.update().numpy() == pytest.approx(sim.contact_record("pad").force[:, -1])


# bad input


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ((), "name what to observe"),
        ((3,), "3 is no name"),
        (("time", "time"), "'time' is there twice"),
        (("prob.top.position",), "did you mean 'probe'"),
        (("probe.tip.position",), "probe 'tip' is unknown; there are: 'top'"),
        (("probe.top.speed",), "'probe.top.speed' is unknown; of 'probe.top' there are: 'position', 'displacement'"),
        (("body.cub.position",), "body 'cub' is unknown"),
        (("contact.pad.forc",), "did you mean 'force'"),
        (("contact.pat.force",), "contact"),
        (("joint.motor.angle",), "joint"),
    ],
)
def test_names_of_observations_are_checked(names, text):
    sim = wf.Simulation(cubes(), dt=DT, **QUIET)
    with pytest.raises(wf.ModelError, match=text):
        sim.observe(*names)
